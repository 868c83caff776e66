"""Uncertainty budget of a calibration in the sense of the GUM (JCGM 100:2008).

The measurand is a position (in deflection mode: a deflection) as the instrument measures it at a
pose that was not fitted, less where the calibration predicts it. Its combined standard uncertainty
is the root mean square over such poses,

    u² = κ c² + e² + s² + n²

of the parameters without the pose (see `predictive`), of what the model misses beyond the
noise, of the arm's scatter from one arrival to the next, and of the instrument. κ makes u at least
what poses left out show. The expanded uncertainty is U = k u with k = 2.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.calibration.scatter import ScatterSource, scatter_of
from hilcal.errors import InputError
from hilcal.identification.fit import Fit
from hilcal.identification.predictive import position_factor, predictive
from hilcal.identification.residual import noise_floor
from hilcal.robot.chain import evaluate

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
