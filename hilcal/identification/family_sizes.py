"""What an arm is made of: how large each family of effects is, and how well the readings tell it.

The standard deviation of a family's parameters is estimated with those of all others (see
`mixed.variances`); the curvature of the log posterior gives its interval.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES
from hilcal.identification.fit import Fit
from hilcal.identification.mixed_fit import mixed_fit_at

WIDTH = 1.96
"""Standard errors of log s that a 95 % interval reaches on either side."""


@dataclass(frozen=True, slots=True)
class FamilySize:
    """The size of a family: the standard deviation of its parameters.

    Attributes:
        name: of the family.
        effect: of its effect.
        named: whether the readings prove the effect.
        std: root of the mean square over the parameters, SI.
        low: lower end of its 95 % interval, SI.
        high: upper end, SI.
        ordinary: the same of an ordinary arm, SI.
        unit: SI unit.
        moves_m: root of the mean square of what its estimated parameters move the measured
            positions by, m.
    """

    name: str
    effect: str
    named: bool
    std: float
    low: float
    high: float
    ordinary: float
    unit: str
    moves_m: float

    def to_json(self) -> dict[str, object]:
        """Return the attributes by name, SI."""
        return {name: getattr(self, name) for name in type(self).__slots__}


def family_sizes(fit: Fit) -> tuple[FamilySize, ...]:
    """Return the size of each family of a fit with a background; what moves most comes first."""
    model = fit.model
    if not model.background:
        return ()
    kept = fit.readings[~fit.outlier].as_stated()
    found = mixed_fit_at(model, kept, fit.mode, fit.theta)
    problem, log_std = found.equations.problem, found.log_std
    error = np.sqrt(np.diag(found.covariance))
    jacobian = model.jacobian(fit.solution.prediction, fit.theta, 3)
    moves = fit.whitening.raw(jacobian) * fit.theta
    units = [p.unit for e in model.effects for p in e.parameters]
    roles = {e.name: e.role for e in model.effects}
    out = []
    for k, f in enumerate(problem.families.random):
        if roles[f.effect] in FRAME_ROLES:
            continue
        magnitude = float(np.sqrt(np.mean(f.magnitude**2)))
        low, middle, high = np.exp(log_std[k] + WIDTH * error[k] * np.array([-1.0, 0.0, 1.0]))
        moved = moves[:, :, f.parameters].sum(axis=2)
        out.append(
            FamilySize(
                name=f.name,
                effect=f.effect,
                named=f.effect not in model.background,
                std=float(middle) * magnitude,
                low=float(low) * magnitude,
                high=float(high) * magnitude,
                ordinary=float(np.exp(f.prior.mean)) * magnitude,
                unit=units[int(f.parameters[0])],
                moves_m=float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
            )
        )
    return tuple(sorted(out, key=lambda s: -s.moves_m))
