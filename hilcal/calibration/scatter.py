"""The arm's scatter from one arrival to the next, as a covariance of the tool's position.

Every arm scatters. Where the fit has not estimated the scatter and the cell does not state it,
repeated readings show it. With S = Σ |e − ē|² over the position residuals e of k readings of one
state, C their stated covariance and J the Jacobian of the target,

    E S = N + σ² G,   N = Σ (1 − 1/k) tr C,   G = Σ (1 − 1/k) tr J Jᵀ,   u(S) = max(S, N) √(2/ν)

is solved for σ², one for all joints. Where S − N is below its standard uncertainty u, min(S, u)
replaces it. Where C contains the arm's scatter already, all of S counts as scatter. Without repeats
the scatter is what the arm's maker states.

An uncertainty budget in the sense of the GUM (JCGM 100:2008): the measurand is a position (in
deflection mode: a deflection) as the instrument measures it at a pose that was not fitted, minus
the position that the calibration predicts. Its combined standard uncertainty is the root mean
square over such poses,

    u² = κ c² + e² + s² + n²

of the parameters estimated without the pose, c (see `predictive`), of the model's misfit beyond the
noise, e, of the arm's scatter from one arrival to the next, s, and of the instrument, n. κ makes u
at least the error at held-out poses. The expanded uncertainty is U = k u with k = 2.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hilcal.cell import Cell
from hilcal.diagnosis.noise import FEWEST_DOF, RP_PER_RMS, repeat_classes, stated_repeatability
from hilcal.errors import InputError
from hilcal.identification.fit import Fit
from hilcal.identification.noise.full_covariance import joint_factors
from hilcal.identification.prediction.predictive import position_factor, predictive
from hilcal.identification.residual import noise_floor
from hilcal.readings.whitening import whitening
from hilcal.robot.chain import Chain, drive_jacobian, evaluate
from hilcal.types import Floats

ScatterSource = Literal["estimated", "stated", "repeats", "maker", "industry", "unknown"]
"""Source of a scatter:

- estimated: the fit, from its residuals;
- stated: `[repeatability]` of the cell;
- repeats: scatter of repeated readings beyond the instrument's noise;
- maker: the pose repeatability that the robot's file states;
- industry: that of industrial arms, where the robot's file states none;
- unknown: a calibration file of an older program, which assumed zero.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Standard deviations of one arrival."""

    joint_std: Floats  # (n,) of the drives, rad
    std_m: float  # of the position along each axis, in addition, m
    source: ScatterSource

    @property
    def known(self) -> bool:
        """Whether the scatter is of this very arm."""
        return self.source in ("estimated", "stated", "repeats")

    def covariance(self, cell: Cell, chain: Chain, position: Floats) -> Floats:
        """(N, 3, 3) covariance of points (N, 3) on the flange, base axes, m²."""
        j = drive_jacobian(cell.arm, chain, position)[:, :3] * self.joint_std
        return j @ np.swapaxes(j, 1, 2) + self.std_m**2 * np.eye(3)


def scatter_of(fit: Fit) -> Scatter:
    """Return the arm's scatter by the best source; never zero."""
    cell, n, estimated = fit.model.cell, fit.model.cell.arm.n, fit.readings.arm_scatter
    if estimated is not None and estimated.kind == "isotropic":
        return Scatter(np.zeros(n), estimated.std[0], "estimated")
    if estimated is not None:
        return Scatter(np.broadcast_to(np.array(estimated.std), (n,)).copy(), 0.0, "estimated")
    stated = np.zeros(n) if cell.config is None else cell.config.repeatability.per_joint(n)
    if stated.any():
        return Scatter(stated, 0.0, "stated")
    shown = _shown_by_repeats(fit)
    if shown is not None:
        return Scatter(np.full(n, shown), 0.0, "repeats")
    std_m = stated_repeatability(cell.arm) / RP_PER_RMS / np.sqrt(3.0)
    source: ScatterSource = "industry" if cell.arm.repeatability is None else "maker"
    return Scatter(np.zeros(n), float(std_m), source)


def _shown_by_repeats(fit: Fit) -> float | None:
    """Standard deviation of each joint, rad; None where there are too few repeats."""
    inliers = fit.readings[~fit.outlier]
    _, kind, count = np.unique(repeat_classes(inliers), return_inverse=True, return_counts=True)
    dof = 3 * (len(inliers) - len(count))
    if dof < FEWEST_DOF:
        return None
    residual = inliers.value[:, :3] - fit.solution.prediction.observation.position
    mean = np.zeros((len(count), 3))
    np.add.at(mean, kind, residual)
    deviation = residual - (mean / count[:, None])[kind]
    share = (1.0 - 1.0 / count)[kind]
    jacobian = joint_factors(fit.model.cell, inliers, np.ones(fit.model.cell.arm.n))[:, :3]
    scatter = float(np.sum(deviation**2))
    noise = float(share @ np.trace(inliers.covariance[:, :3, :3], axis1=1, axis2=2))
    if inliers.scatter_stated:
        noise = 0.0
    gain = float(share @ np.sum(jacobian**2, axis=(1, 2)))
    unsure = max(scatter, noise) * np.sqrt(2.0 / dof)
    std = np.sqrt(max(scatter - noise, min(scatter, unsure)) / gain)
    return float(std) if std > 0.0 else None


COVERAGE = 2.0  # coverage factor k, as is usual (GUM, 6.3.3)


@dataclass(frozen=True, slots=True)
class Budget:
    """Standard uncertainties of what is read at a pose that was not fitted, m; 3-D of positions."""

    parameters: float  # of the parameters, estimated without the pose
    misfit: float  # of the model's misfit beyond the noise
    scatter: float  # of the arm's own repeatability; of both arrivals of a deflection
    scatter_source: ScatterSource
    instrument: float  # of the instrument's noise, as stated

    @property
    def combined(self) -> float:
        """Combined standard uncertainty u, m."""
        return float(np.linalg.norm((self.parameters, self.misfit, self.scatter, self.instrument)))

    @property
    def expanded(self) -> float:
        """Expanded uncertainty U = k u, m."""
        return COVERAGE * self.combined


def budget(fit: Fit) -> Budget:
    """Return the uncertainty of a fit's predictions at similar poses that were not fitted."""
    if fit.scaling != "gc":
        raise InputError(f"an uncertainty budget needs scaling gc, this fit has {fit.scaling}")
    used, cell = fit.readings[~fit.outlier], fit.model.cell
    p = predictive(fit.model, fit.theta, fit.solution.prior, used, fit.mode, fit.holdout.rms_sigma)
    arm_scatter = scatter_of(fit)
    chain = evaluate(cell.arm, used.states.q[fit.whitening.reading])
    covariance = arm_scatter.covariance(cell, chain, chain.point(cell.target[:3, 3]))
    arrivals = 2 if fit.mode == "deflection" else 1
    axes = fit.model.predict(used.states, fit.theta).observation.axes[fit.whitening.reading]
    read = axes @ covariance @ np.swapaxes(axes, 1, 2)  # of a distance or height, one element
    scatter = arrivals * float(np.trace(read, axis1=1, axis2=2).mean())
    # Beside an estimated scatter the fit's covariance is in units of the estimated noise.
    stated = noise_floor(whitening(used.as_stated(), fit.mode).covariance) ** 2
    instrument = max(stated - scatter, 0.0) if used.scatter_stated else stated
    included = used.scatter_stated or used.arm_scatter is not None
    noise = instrument + scatter * included
    return Budget(
        parameters=float(np.sqrt(position_factor(p, fit.holdout.rms_m) * p.left_out_m2)),
        misfit=float(np.sqrt(max(p.scatter_m2 - noise, 0.0))),
        scatter=float(np.sqrt(scatter)),
        scatter_source=arm_scatter.source,
        instrument=float(np.sqrt(instrument)),
    )
