"""Compare each new reading with a model fitted to the readings before it, while measuring."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.effects.catalogue import installed
from hilcal.errors import HilcalError
from hilcal.identification.baseline import with_effects
from hilcal.identification.carried.carried_prior import scales_of
from hilcal.identification.fit import mahalanobis2
from hilcal.identification.folds import distinct_poses
from hilcal.identification.gauss_newton import solve, whitened_jacobian
from hilcal.identification.noise.full_covariance import with_joint_scatter
from hilcal.identification.residual import residual
from hilcal.measuring.progress import LiveResidual
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import whitening
from hilcal.regression.schur import inverse_root
from hilcal.types import Floats

FEWEST_POSES = 8  # distinct poses from which a registration is estimated; a guess
GROWTH = 1.15  # factor of the number of readings after which the model is fitted again; a guess
PRIOR_STD = 3.0
"""Prior standard deviation of every parameter, in units of its ordinary magnitude; a guess."""


@dataclass(frozen=True, slots=True, eq=False)
class _FittedModel:
    """A model fitted to the first readings of a campaign."""

    model: Model
    theta: Floats  # (P,)
    covariance: Floats  # (P, P) of the parameters, for noise of the stated size
    rms: float  # rms 3-D distance of the readings from the fit, m
    count: int  # number of readings fitted
    loaded: bool  # whether any of them was loaded

    def compared(self, last: Readings) -> tuple[Floats, Floats, Floats]:
        """Residual (m,) of a reading, covariance J C Jᵀ (m, m) of its prediction, axes (3, 3)."""
        predicted = self.model.predict(last.states, self.theta)
        error = residual(last, predicted, whitening(last, "absolute", "gc"))[0]
        jacobian = self.model.jacobian(predicted, self.theta, last.m)[0]
        covariance = jacobian @ self.covariance @ jacobian.T
        return error, covariance, predicted.observation.axes[0]

    def live_residual(self, last: Readings) -> LiveResidual:
        """Compare one reading with the model."""
        error, predicted, axes = self.compared(last)
        covariance = predicted + last.covariance[0]
        live = LiveResidual(
            float(np.linalg.norm(error[:3])),
            float(np.sqrt(mahalanobis2(error[None], covariance[None])[0] / last.m)),
            bool(np.trace(predicted[:3, :3]) > np.trace(last.covariance[0, :3, :3])),
            vector=tuple((axes.T @ error[:3]).tolist()),
            covariance=tuple((axes.T @ covariance[:3, :3] @ axes).ravel().tolist()),
        )
        s = last.states
        if not np.any(s.wrench):
            return live
        unloaded = replace(last, states=replace(s, wrench=np.zeros_like(s.wrench)))
        deflection, predicted, _ = self.compared(unloaded)
        std = float(np.sqrt(self.rms**2 + np.trace(predicted[:3, :3])))
        size = float(np.linalg.norm(deflection[:3]))
        return replace(live, deflection=size, deflection_std=std)


class LiveModel:
    """Predicts each reading from those before it, by the frames and joint compliance.

    The newest reading takes no part in the fit; its residual is whitened by its covariance plus
    that of the prediction, J C Jᵀ. Deflections are relative to the predicted unloaded position,
    since the unloaded reading of a pose may come later. The result serves the operator only, so the
    model is fitted again only when the readings have grown by `GROWTH`.
    """

    def __init__(self, cell: Cell) -> None:
        """Prepare for a cell."""
        self._cell = cell
        self._scatter = cell.configured().repeatability.per_joint(cell.arm.n)
        self._fitted: _FittedModel | None = None

    def __call__(self, readings: Readings) -> LiveResidual:
        """Compare the last reading with the previous ones; empty while these are too few."""
        # sigma is sqrt(rᵀ (V + J C Jᵀ)⁻¹ r / m): about 1 where the model is right.
        readings = with_joint_scatter(self._cell, readings, self._scatter)
        try:
            fitted = self._refitted(readings[:-1])
            return LiveResidual() if fitted is None else fitted.live_residual(readings[-1:])
        except HilcalError:
            return LiveResidual()

    def _refitted(self, readings: Readings) -> _FittedModel | None:
        """Return the model, fitted anew if it is stale; None while the poses are too few."""
        fitted, count = self._fitted, len(readings)
        loaded = bool(np.any(readings.states.wrench))
        stale = fitted is None or loaded != fitted.loaded or count > GROWTH * fitted.count
        if stale and len(np.unique(distinct_poses(readings))) >= FEWEST_POSES:
            # Unloaded readings need compliant joints, too: the arm bends under its own weight.
            names = [kind.name for kind in installed().with_role("baseline")]
            model = with_effects(self._cell, readings, "absolute", names)
            w = whitening(readings, "absolute", "gc")
            solution = solve(model, readings, w)
            rms = float(np.sqrt(np.mean(np.sum(solution.raw[:, :3] ** 2, axis=1))))
            scale, live = PRIOR_STD * scales_of(model), solution.live
            a = np.zeros((w.m * len(w), model.size))
            rows = whitened_jacobian(model, solution.prediction, solution.theta, w, live)
            a[:, live] = rows * scale[live]
            root = inverse_root(a.T @ a + np.eye(model.size)) * scale
            self._fitted = _FittedModel(model, solution.theta, root.T @ root, rms, count, loaded)
        return self._fitted
