"""The columns of effects that are not in a fitted model, at the parameters of the fit.

Those of many effects are computed and whitened together. A wide effect, as the harmonics of a
transmission error, is kept by its factors (`wide_suspects`).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hilcal.effects.protocol import Effect
from hilcal.identification.fit import Fit
from hilcal.identification.wide_suspects import WideColumns, wide_effect
from hilcal.readings.whitening import Whitening
from hilcal.regression.factored import Tall, written
from hilcal.types import Bools, Floats

TOGETHER = 8_000_000
"""Numbers of the columns of effects that are computed together, 64 MB; a choice by memory."""
WHITENED = 2_000_000
"""Numbers of the columns that are whitened together, 16 MB, and kept while one of their effects is;
a choice by memory."""


@dataclass(frozen=True, eq=False)
class EffectColumns:
    """The columns of an effect in ordinary magnitudes of its parameters.

    Attributes:
        effect: the effect.
        scale: (P,) ordinary magnitudes, SI.
        together: (R, Q) whitened columns of all effects that were whitened together; None for one
            that is kept by its factors.
        within: which of them are this effect's, P.
        of_readings: (N, m, P) motion of the fitted readings, sensor axes, m and rad; or its
            factors.
        whitening: of the readings.
        bare: (N,) which readings are unloaded.
    """

    effect: Effect
    scale: Floats
    together: Floats | None
    within: slice
    of_readings: Floats | WideColumns
    whitening: Whitening
    bare: Bools

    @property
    def tall(self) -> Tall:
        """(R, P) whitened columns, by their factors where they are kept so."""
        if isinstance(self.of_readings, WideColumns):
            return self.of_readings.white
        assert self.together is not None  # noqa: S101 - one of the two is there
        return self.together[:, self.within]

    @property
    def white(self) -> Floats:
        """(R, P) whitened columns."""
        return written(self.tall)

    @property
    def numbers(self) -> int:
        """How many numbers are kept."""
        of = self.of_readings
        return of.numbers if isinstance(of, WideColumns) else of.size

    @cached_property
    def motion(self) -> Floats:
        """(D, 3, P) displacement of each measured position, m."""
        of = self.of_readings
        moved = of.readings(slice(None)) if isinstance(of, WideColumns) else of
        return self.whitening.raw(moved[:, :3])

    @cached_property
    def unloaded(self) -> Floats:
        """(U, 3, P) displacement of the target in each unloaded reading, sensor axes, m."""
        of = self.of_readings
        moved = of.readings(self.bare) if isinstance(of, WideColumns) else of[self.bare]
        return np.asarray(moved[:, :3])


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
    wide = {e.name: found for e in effects if (found := wide_effect(e, s, w)) is not None}

    def numbers(effect: Effect) -> int:
        return count * len(effect.magnitudes) * (1 if effect.name in wide else w.m)

    for group in _groups(effects, numbers, TOGETHER):
        narrow = tuple(e for e in group if e.name not in wide)
        scale = np.concatenate([np.zeros(0), *(e.magnitudes for e in narrow)])
        drives = np.empty((count, w.m, fit.model.cell.arm.n))
        jacobian = fit.model.jacobian_of(
            narrow, solution.prediction, solution.theta, w.m, scale=scale, drives=drives
        )
        white_drives = w.whiten_readings(drives) if len(narrow) < len(group) else drives
        parts, start = tuple(_groups(group, numbers, WHITENED)), 0
        for part in parts:
            sizes = [len(e.magnitudes) if e.name not in wide else 0 for e in part]
            ends = np.cumsum([0, *sizes]).tolist()
            own = jacobian[:, :, start : start + ends[-1]]
            start += ends[-1]
            if len(parts) > 1:  # what is kept of a part does not keep the others
                own = own.copy()
            white = w.whiten_readings(own)
            out = []
            for e, within in zip(part, map(slice, ends[:-1], ends[1:]), strict=True):
                if e.name in wide:
                    of = wide[e.name].columns(drives, white_drives)
                    out.append(EffectColumns(e, e.magnitudes, None, within, of, w, bare))
                else:
                    mine = own[:, :, within]
                    out.append(EffectColumns(e, e.magnitudes, white, within, mine, w, bare))
            yield tuple(out)


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
