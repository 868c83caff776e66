"""The columns of effects that are not in a fitted model, at the parameters of the fit.

Those of many effects are computed and whitened together.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hilcal.effects.protocol import Effect
from hilcal.identification.fit import Fit
from hilcal.readings.whitening import Whitening
from hilcal.types import Bools, Floats

TOGETHER = 4_000_000  # numbers of columns computed together, 32 MB, kept while one effect is


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

    The equilibrium is differentiated, and columns are whitened, once for as many of them as have
    `TOGETHER` numbers.
    """
    w, s = fit.whitening, fit.solution
    count, bare = len(s.prediction.situation.angle) * w.m, fit.readings[~fit.outlier].unloaded
    ends = np.cumsum([0, *(count * len(e.magnitudes) for e in effects)])
    start = 0
    while start < len(effects):
        more = int(np.searchsorted(ends, ends[start] + TOGETHER, side="right")) - 1
        stop = max(more, start + 1)
        part, start = tuple(effects[start:stop]), stop
        scale = np.concatenate([e.magnitudes for e in part])
        columns = fit.model.jacobian_of(part, s.prediction, s.theta, w.m, scale=scale)
        white, at = w.whiten_readings(columns), np.cumsum([0, *(len(e.magnitudes) for e in part)])
        yield tuple(
            EffectColumns(e, e.magnitudes, white, within, columns[:, :, within], w, bare)
            for e, within in zip(part, map(slice, at[:-1], at[1:]), strict=True)
        )
