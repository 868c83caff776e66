"""Each new reading against a model fitted to the readings before it, while measuring."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.effects.catalogue import installed
from hilcal.errors import HilcalError
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import mahalanobis2
from hilcal.identification.folds import distinct_poses
from hilcal.identification.full_covariance import with_joint_scatter
from hilcal.identification.gauss_newton import solve, whitened_jacobian
from hilcal.identification.priors import scales_of
from hilcal.identification.residual import residual
from hilcal.measuring.progress import LiveResidual
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import whitening
from hilcal.regression.schur import inverse_root
from hilcal.types import Floats

LEAST = 8  # distinct poses from which a registration is estimated; a guess
GROWTH = 1.15  # the model is fitted again after so many times as many readings; a guess
ORDINARY = 3.0
"""Prior standard deviation of every parameter, in units of its ordinary magnitude; a guess."""


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """A model as fitted to the first readings of a campaign."""

    model: Model
    theta: Floats  # (P,)
    covariance: Floats  # (P, P) of the parameters, for noise of the stated size
    rms: float  # 3-D distance of the readings from the fit, root mean square, m
    count: int  # readings that it was fitted to
    loaded: bool  # whether any of them was loaded

    def compared(self, last: Readings) -> tuple[Floats, Floats, Floats]:
        """Residual (m,) of a reading, covariance J C Jᵀ (m, m) of its prediction, axes (3, 3)."""
        predicted = self.model.predict(last.states, self.theta)
        off = residual(last, predicted, whitening(last, "absolute", "gc"))[0]
        jacobian = self.model.jacobian(predicted, self.theta, last.m)[0]
        spread = jacobian @ self.covariance @ jacobian.T
        return off, spread, predicted.observation.axes[0]


class LiveModel:
    """Predicts each reading from those before it, by the frames and joint compliance.

    The newest reading took no part in the fit; its residual is divided by the reading's covariance
    plus that of the prediction, J C Jᵀ. Where the unloaded reading of a pose comes later than a
    loaded one, the deflection is taken from the predicted unloaded position. The result serves the
    operator only, so the model is fitted again only when the readings have grown by `GROWTH`.
    """

    def __init__(self, cell: Cell, config: CellConfig) -> None:
        """Prepare for a cell."""
        self._cell = cell
        self._scatter = config.repeatability.per_joint(cell.arm.n)
        self._known: _Known | None = None

    def __call__(self, readings: Readings) -> LiveResidual:
        """Compare the last reading with those before it; empty while they are too few.

        sigma is sqrt(rᵀ (V + J C Jᵀ)⁻¹ r / m): about 1 where the model is right.
        """
        readings = with_joint_scatter(self._cell, readings, self._scatter)
        before, last = readings[:-1], readings[-1:]
        try:
            known = self._renewed(before)
            return LiveResidual() if known is None else _live_residual(known, last)
        except HilcalError:
            return LiveResidual()

    def _renewed(self, readings: Readings) -> _Known | None:
        """Return the model, fitted anew where much has come since."""
        known, count = self._known, len(readings)
        loaded = bool(np.any(readings.states.wrench))
        stale = known is None or loaded != known.loaded or count > GROWTH * known.count
        if stale and len(np.unique(distinct_poses(readings))) >= LEAST:
            # The arm's own weight bends it, too, so unloaded readings need the joints to give.
            names = [kind.name for kind in installed().with_role("baseline")]
            model = with_effects(self._cell, readings, "absolute", names)
            w = whitening(readings, "absolute", "gc")
            found = solve(model, readings, w)
            rms = float(np.sqrt(np.mean(np.sum(found.raw[:, :3] ** 2, axis=1))))
            scale = ORDINARY * scales_of(model)
            a = np.zeros((w.m * len(w), model.size))
            rows = whitened_jacobian(model, found.prediction, found.theta, w, found.live)
            a[:, found.live] = rows * scale[found.live]
            root = inverse_root(a.T @ a + np.eye(model.size)) * scale
            self._known = _Known(model, found.theta, root.T @ root, rms, count, loaded)
        return self._known


def _live_residual(known: _Known, last: Readings) -> LiveResidual:
    """Compare one reading with a fitted model."""
    off, own, axes = known.compared(last)
    spread = own + last.covariance[0]
    residual_m = float(np.linalg.norm(off[:3]))
    found = LiveResidual(
        residual_m,
        float(np.sqrt(mahalanobis2(off[None], spread[None])[0] / last.m)),
        bool(np.trace(own[:3, :3]) > np.trace(last.covariance[0, :3, :3])),
        vector=tuple((axes.T @ off[:3]).tolist()),
        covariance=tuple((axes.T @ spread[:3, :3] @ axes).ravel().tolist()),
    )
    if not np.any(last.states.wrench):
        return found
    rest = replace(last, states=replace(last.states, wrench=np.zeros_like(last.states.wrench)))
    off, own, _ = known.compared(rest)
    deflection_std = float(np.sqrt(known.rms**2 + np.trace(own[:3, :3])))
    deflection = float(np.linalg.norm(off[:3]))
    return replace(found, deflection=deflection, deflection_std=deflection_std)
