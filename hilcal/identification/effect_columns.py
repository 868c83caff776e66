"""The columns of effects outside of a fitted model, at the parameters of the fit.

The columns of many effects are computed and whitened together.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import numpy as np

from hilcal.effects.protocol import Effect
from hilcal.identification.fit import Fit
from hilcal.readings.whitening import Whitening
from hilcal.types import Bools, Floats

TOGETHER = 4_000_000  # most numbers computed together, 32 MB; freed with the last effect of them


@dataclass(frozen=True, eq=False)
class EffectColumns:
    """The columns of an effect in ordinary magnitudes of its parameters."""

    effect: Effect
    scale: Floats  # (P,) ordinary magnitudes, SI
    together: Floats  # (R, Q) columns of all effects whitened together
    within: slice  # the P columns of this effect
    of_readings: Floats  # (N, m, P) motion of the fitted readings, sensor axes, m and rad
    whitening: Whitening  # of the readings
    bare: Bools  # (N,) unloaded readings

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
    """Return the columns of an effect outside of the model, at the parameters of the fit."""
    return next(columns_of_each(fit, (effect,)))


def columns_of_each(fit: Fit, effects: Sequence[Effect]) -> Iterator[EffectColumns]:
    """Yield `effect_columns` of several effects."""
    return chain.from_iterable(columns_in_parts(fit, effects))


def columns_in_parts(fit: Fit, effects: Sequence[Effect]) -> Iterator[tuple[EffectColumns, ...]]:
    """Yield `effect_columns` of several effects in order, in parts that are computed together.

    A part has up to `TOGETHER` numbers; the equilibrium is differentiated once for each part.
    """
    w, s = fit.whitening, fit.solution
    count, bare = len(s.prediction.situation.angle) * w.m, fit.readings[~fit.outlier].unloaded
    ends = np.cumsum([0, *(count * len(e.magnitudes) for e in effects)])
    start = 0
    while start < len(effects):
        fitting = int(np.searchsorted(ends, ends[start] + TOGETHER, side="right")) - 1
        stop = max(fitting, start + 1)
        part, start = tuple(effects[start:stop]), stop
        scales = [e.magnitudes for e in part]
        columns = fit.model.jacobian_of(
            part, s.prediction, s.theta, w.m, scale=np.concatenate(scales)
        )
        white, edges = w.whiten_readings(columns), np.cumsum([0, *map(len, scales)])
        yield tuple(
            EffectColumns(e, e.magnitudes, white, within, columns[:, :, within], w, bare)
            for e, within in zip(part, map(slice, edges[:-1], edges[1:]), strict=True)
        )
