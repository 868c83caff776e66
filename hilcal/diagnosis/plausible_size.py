"""Largest plausible strength of an effect: what it states, and what absolute positions allow.

Deflections show errors of geometry and encoders in the second order only, so that such an effect
would need to be large to explain them. The unloaded readings of the same campaign show it in the
first order: with the frames of base and target estimated, its displacements there can hardly be
larger than what the model misses,

    t g ≤ `ALLOWED` s,    s² = mean |P y|²,    g² = mean Σ_p |P x_p|²

y the residual of the unloaded readings, x_p their displacement by an ordinary magnitude of
parameter p, P the projection off the frames. Elastic effects are not held to that: a controller may
compensate for what gravity does.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.effects.protocol import Effect
from hilcal.identification.effect_columns import EffectColumns, columns_of_each
from hilcal.identification.fit import Fit
from hilcal.types import Floats

ALLOWED = 2.0
"""Displacement that an effect may make in unloaded readings, in units of what the model misses
there: as much again may be hidden by other errors. A choice."""
ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Unloaded:
    """The unloaded readings of a campaign of deflections.

    Attributes:
        frames: (K, F) orthonormal displacements by the frames.
        missed: s, m.
    """

    frames: Floats
    missed: float

    def most(self, of: EffectColumns) -> float:
        """Return the largest strength of an effect that they allow."""
        if of.effect.elastic:
            return np.inf
        x = of.unloaded.reshape(-1, len(of.scale))
        free = (x - self.frames @ (self.frames.T @ x)).ravel()
        moved = float(np.sqrt(free @ free / len(x)))
        return ALLOWED * self.missed / moved if moved > ROUNDING * self.missed else np.inf


def frame_effects(fit: Fit) -> tuple[Effect, ...]:
    """Effects whose columns `unloaded_readings` needs; none for a fit of absolute readings."""
    if fit.mode == "absolute":
        return ()
    states, model = fit.readings[~fit.outlier].states, fit.model
    kinds = model.catalogue.with_role("registration", "target")
    return tuple(kind(model.cell, states) for kind in kinds)


def unloaded_readings(fit: Fit, frames: Sequence[EffectColumns] | None = None) -> Unloaded | None:
    """Return the unloaded readings; None for a fit of absolute readings, which shows all itself.

    Args:
        fit: the fit.
        frames: columns of `frame_effects`; computed where they are not given.
    """
    if fit.mode == "absolute":
        return None
    if frames is None:
        frames = list(columns_of_each(fit, frame_effects(fit)))
    readings = fit.readings[~fit.outlier]
    rows = readings.unloaded
    columns = np.concatenate([each.unloaded for each in frames], axis=2)
    columns = columns.reshape(3 * int(rows.sum()), -1)
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    u = u[:, s > ROUNDING * s.max(initial=0.0)]
    off = readings.value[:, :3] - fit.solution.prediction.observation.position
    y = off[rows].reshape(-1)
    missed = y - u @ (u.T @ y)
    free = max(len(y) - u.shape[1], 1)
    return Unloaded(u, float(np.sqrt(missed @ missed / free)))


def most(of: EffectColumns, unloaded: Unloaded | None) -> float:
    """Return the largest plausible strength of an effect, in ordinary magnitudes."""
    own = of.effect.most()
    return own if unloaded is None else min(own, unloaded.most(of))
