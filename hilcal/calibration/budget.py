"""Uncertainty budget of a calibration in the sense of the GUM (JCGM 100:2008).

The measurand is where the tool is (in deflection mode: how far a load deflects it) less where the
calibration predicts it. Its combined standard uncertainty is

    u² = tr κ J C Jᵀ + tr F Fᵀ + 3 s²

of the parameters (the instrument's noise, and all that the readings leave open, enter by them), of
the arm's scatter from one arrival to the next, and of what the model misses beyond the noise; see
`calibration`. The expanded uncertainty is U = k u with k = 2. u is that of a 3-D distance: U
contains at least about 95 % of positions, more where several axes contribute.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.scatter import ScatterSource
from hilcal.calibration.tool import tool_of
from hilcal.identify.fit import Fit
from hilcal.robot.chain import evaluate
from hilcal.types import Floats

COVERAGE = 2.0
"""Coverage factor k, as is usual (GUM, 6.3.3)."""


@dataclass(frozen=True, slots=True, eq=False)
class Budget:
    """Standard uncertainties (D,) of the 3-D position of each fitted measurement, m.

    Attributes:
        parameters: of the estimated parameters.
        scatter: of the arm's own repeatability.
        scatter_source: what that is from.
        misfit: of what the model misses beyond the noise.
    """

    parameters: Floats
    scatter: Floats
    scatter_source: ScatterSource
    misfit: Floats

    @property
    def combined(self) -> Floats:
        """(D,) combined standard uncertainty u, m."""
        return np.sqrt(self.parameters**2 + self.scatter**2 + self.misfit**2)

    @property
    def expanded(self) -> Floats:
        """(D,) expanded uncertainty U = k u, m."""
        return COVERAGE * self.combined


def budget(fit: Fit) -> Budget:
    """Return the uncertainty of what a fit predicts at its own poses and loads.

    Raises:
        InputError: a fit of another scaling than gc.
    """
    c = Calibration.of(fit)
    states = fit.readings[~fit.outlier].states[fit.whitening.reading]
    tool = tool_of(c.model, c.theta, None)
    found = c.poses(tool, states, c.nominal(tool, states), std=True)
    assert found.covariance is not None  # noqa: S101  (asked for by `std`)
    arm = c.model.cell.arm
    chain = evaluate(arm, states.q)
    at = chain.point(tool.nominal[:3, 3])
    total = np.trace(found.covariance, axis1=1, axis2=2)
    scatter = np.trace(c.scatter.covariance(c.model.cell, chain, at), axis1=1, axis2=2)
    misfit = np.full(len(total), 3 * c.misfit)
    return Budget(
        parameters=np.sqrt(np.maximum(total - scatter - misfit, 0.0)),
        scatter=np.sqrt(scatter),
        scatter_source=c.scatter.source,
        misfit=np.sqrt(misfit),
    )
