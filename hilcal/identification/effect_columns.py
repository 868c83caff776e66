"""The columns of effects that are not in a fitted model, at the parameters of the fit.

Those of many effects are computed and whitened together.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hilcal.effects.protocol import Effect
from hilcal.identification.fit import Fit
from hilcal.readings.whitening import Whitening
from hilcal.types import Bools, Floats

TOGETHER = 8_000_000  # numbers of columns that are computed together, 64 MB; a choice by memory
WHITENED = 2_000_000  # numbers that are whitened together, 16 MB, and kept while one effect is


@dataclass(frozen=True, eq=False)
class EffectColumns:
    """The columns of an effect in ordinary magnitudes of its parameters."""

    effect: Effect
    scale: Floats  # (P,) ordinary magnitudes, SI
    together: Floats  # (R, Q) whitened columns of all effects that were whitened together
    within: slice  # which of them are this effect's, P
    of_readings: Floats  # (N, m, P) motion of the fitted readings, sensor axes, m and rad
    whitening: Whitening  # of the readings
    bare: Bools  # (N,) which readings are unloaded

    @property
    def white(self) -> Floats:
        """(R, P) whitened columns."""
        return self.together[:, self.within]

    @property
    def numbers(self) -> int:
        """How many numbers are kept."""
        return self.of_readings.size

    @cached_property
    def motion(self) -> Floats:
        """(D, 3, P) displacement of each measured position, m."""
        return self.whitening.raw(self.of_readings[:, :3])

    @cached_property
    def unloaded(self) -> Floats:
        """(U, 3, P) displacement of the target in each unloaded reading, sensor axes, m."""
        return np.asarray(self.of_readings[self.bare, :3])


def computable(fit: Fit, effect: Effect) -> bool:
    """Whether the fitted readings have the columns that an effect needs."""
    return type(effect).computable(fit.solution.prediction.situation.states)


def effect_columns(fit: Fit, effect: Effect) -> EffectColumns:
    """Return the columns of an effect that is not in the model, at the parameters of the fit."""
    return next(columns_of_each(fit, (effect,)))


def columns_of_each(fit: Fit, effects: Sequence[Effect]) -> Iterator[EffectColumns]:
    """Yield `effect_columns` of several effects."""
    return (of for part in columns_in_parts(fit, effects) for of in part)


def columns_in_parts(fit: Fit, effects: Sequence[Effect]) -> Iterator[tuple[EffectColumns, ...]]:
    """Yield `effect_columns` of several effects in order, those computed together in one part.

    The equilibrium is differentiated once for as many of them as have `TOGETHER` numbers; as many
    as have `WHITENED` are whitened together.
    """
    w, solution = fit.whitening, fit.solution
    s = solution.prediction.situation
    count, bare = len(s.angle), fit.readings[~fit.outlier].unloaded

    def numbers(effect: Effect) -> int:
        return count * len(effect.magnitudes) * w.m

    for group in _groups(effects, numbers, TOGETHER):
        scale = np.concatenate([e.magnitudes for e in group])
        jacobian = fit.model.jacobian_of(
            group, solution.prediction, solution.theta, w.m, scale=scale
        )
        parts, start = tuple(_groups(group, numbers, WHITENED)), 0
        for part in parts:
            ends = np.cumsum([0, *(len(e.magnitudes) for e in part)]).tolist()
            own = jacobian[:, :, start : start + ends[-1]]
            start += ends[-1]
            if len(parts) > 1:  # what is kept of a part does not keep the others
                own = own.copy()
            white = w.whiten_readings(own)
            yield tuple(
                EffectColumns(e, e.magnitudes, white, within, own[:, :, within], w, bare)
                for e, within in zip(part, map(slice, ends[:-1], ends[1:]), strict=True)
            )


def _groups(
    effects: Sequence[Effect], numbers: Callable[[Effect], int], most: int
) -> Iterator[tuple[Effect, ...]]:
    """Split effects into successive groups of at most `most` numbers, or of one effect."""
    group: list[Effect] = []
    size = 0
    for effect in effects:
        if group and size + numbers(effect) > most:
            yield tuple(group)
            group, size = [], 0
        group.append(effect)
        size += numbers(effect)
    if group:
        yield tuple(group)
