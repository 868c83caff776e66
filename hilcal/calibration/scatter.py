"""The arm's scatter from one arrival to the next, as a covariance of the tool's position.

Every arm scatters. Where neither the fit has estimated it nor the cell states it, it is what
repeated readings show: with S = Σ |e − ē|² over the positions' residuals e of k readings of one
state, C their stated covariance and J the Jacobian of the target,

    E S = N + σ² G,   N = Σ (1 − 1/k) tr C,   G = Σ (1 − 1/k) tr J Jᵀ,   u(S) = max(S, N) √(2/ν)

is solved for σ², one for all joints; where S − N is below its standard uncertainty u, the arm may
scatter as much as that. Where C has the arm's scatter already, all of S is taken for it. Without
repeats it is what the arm's maker states.

An uncertainty budget in the sense of the GUM (JCGM 100:2008): the measurand is a position (in
deflection mode: a deflection) as the instrument measures it at a pose that was not fitted, less
where the calibration predicts it. Its combined standard uncertainty is the root mean square over
such poses,

    u² = κ c² + e² + s² + n²

of the parameters without the pose (see `predictive`), of what the model misses beyond the
noise, of the arm's scatter from one arrival to the next, and of the instrument. κ makes u at least
what poses left out show. The expanded uncertainty is U = k u with k = 2.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hilcal.cell import Cell
from hilcal.diagnosis.noise import FEWEST, RP_PER_RMS, classes, stated_repeatability
from hilcal.errors import InputError
from hilcal.identification.fit import Fit
from hilcal.identification.full_covariance import joint_factors
from hilcal.identification.predictive import position_factor, predictive
from hilcal.identification.residual import noise_floor
from hilcal.robot.chain import Chain, drive_jacobian, evaluate
from hilcal.types import Floats

ScatterSource = Literal["estimated", "stated", "repeats", "maker", "industry", "unknown"]
"""What a scatter is from:

- estimated: the fit, from its residuals;
- stated: `[repeatability]` of the cell;
- repeats: what repeated readings scatter by beyond the instrument's noise;
- maker: the pose repeatability that the robot's file states;
- industry: that of industrial arms, where the robot's file states none;
- unknown: a calibration file of an older program, which took it for zero.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Standard deviations of one arrival."""

    joint_std: Floats  # (n,) of the drives, rad
    std_m: float  # of the position along each axis beside that, m
    source: ScatterSource  # what they are from

    @property
    def known(self) -> bool:
        """Whether it is of this very arm."""
        return self.source in ("estimated", "stated", "repeats")

    def covariance(self, cell: Cell, chain: Chain, position: Floats) -> Floats:
        """(N, 3, 3) covariance of points (N, 3) that the flange carries, base axes, m²."""
        j = drive_jacobian(cell.arm, chain, position)[:, :3] * self.joint_std
        return j @ np.swapaxes(j, 1, 2) + self.std_m**2 * np.eye(3)


def scatter_of(fit: Fit) -> Scatter:
    """Return the arm's scatter by the best that is known of it; never zero."""
    cell, n, found = fit.model.cell, fit.model.cell.arm.n, fit.readings.arm_scatter
    if found is not None and found.kind == "isotropic":
        return Scatter(np.zeros(n), found.std[0], "estimated")
    if found is not None:
        return Scatter(np.broadcast_to(np.array(found.std), (n,)).copy(), 0.0, "estimated")
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
    kept = fit.readings[~fit.outlier]
    _, kind, count = np.unique(classes(kept), return_inverse=True, return_counts=True)
    dof = 3 * (len(kept) - len(count))
    if dof < FEWEST:
        return None
    off = kept.value[:, :3] - fit.solution.prediction.observation.position
    mean = np.zeros((len(count), 3))
    np.add.at(mean, kind, off)
    away = off - (mean / count[:, None])[kind]
    share = (1.0 - 1.0 / count)[kind]
    moved = joint_factors(fit.model.cell, kept, np.ones(fit.model.cell.arm.n))[:, :3]
    scatter = float(np.sum(away**2))
    stated = kept.covariance[:, :3, :3] if not kept.scatter_stated else np.zeros((len(kept), 3, 3))
    noise = float(share @ np.trace(stated, axis1=1, axis2=2))
    gain = float(share @ np.sum(moved**2, axis=(1, 2)))
    unsure = max(scatter, noise) * np.sqrt(2.0 / dof)
    std = np.sqrt(max(scatter - noise, min(scatter, unsure)) / gain)
    return float(std) if std > 0.0 else None


COVERAGE = 2.0
"""Coverage factor k, as is usual (GUM, 6.3.3)."""


@dataclass(frozen=True, slots=True)
class Budget:
    """Standard uncertainties of a 3-D position or deflection at a pose that was not fitted, m."""

    parameters: float  # of the parameters, estimated without the pose
    misfit: float  # of what the model misses beyond the noise
    scatter: float  # of the arm's own repeatability; of both arrivals of a deflection
    scatter_source: ScatterSource  # what that is from
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
    """Return the uncertainty of what a fit predicts at poses like its own that it has not seen."""
    if fit.scaling != "gc":
        raise InputError(f"an uncertainty budget needs scaling gc, this fit has {fit.scaling}")
    used, cell = fit.readings[~fit.outlier], fit.model.cell
    p = predictive(fit.model, fit.theta, fit.solution.prior, used, fit.mode, fit.holdout.rms_sigma)
    of = scatter_of(fit)
    chain = evaluate(cell.arm, used.states.q[fit.whitening.reading])
    one = of.covariance(cell, chain, chain.point(cell.target[:3, 3]))
    arrivals = 2 if fit.mode == "deflection" else 1
    scatter = arrivals * float(np.trace(one, axis1=1, axis2=2).mean())
    stated = noise_floor(fit.whitening.covariance) ** 2
    inside = used.scatter_stated or used.arm_scatter is not None
    return Budget(
        parameters=float(np.sqrt(position_factor(p, fit.holdout.rms_m) * p.left_out_m2)),
        misfit=float(np.sqrt(max(p.scatter_m2 - stated, 0.0))),
        scatter=float(np.sqrt(scatter)),
        scatter_source=of.source,
        instrument=float(np.sqrt(max(stated - scatter, 0.0) if inside else stated)),
    )
