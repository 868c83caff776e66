"""Which readings lie outside of what a model was fitted to: in which variable, and by how much.

A model may be wrong wherever nothing was measured, however well it predicts poses left out among
those that were. A variable is left where a reading is beyond the fitted ones' smallest or largest
value by more than `MARGIN` of their range; an angle is where it is whole turns on, too, unless the
model tells them apart (`whole_turns`). Joint angles inside of their ranges can be far from all
fitted ones as well; then the leverage of a reading is large: the variance of its prediction over
that of the noise, (J C Jᵀ) V⁻¹ σ⁻² with the largest eigenvalue, compared with h/(1 − h) of the
fitted measurements, each predicted without itself.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.identification.predictive import Predictive
from hilcal.identification.residual import ErrorBlock
from hilcal.identification.robot_frames import whole_turns
from hilcal.identification.validation import Validation
from hilcal.readings.ranges import ranges_of, turning_variables, variables
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening, inverse_root
from hilcal.types import Bools, Floats

FAR = 2.0
"""Leverage from which a reading is outside, in units of that which only one in a hundred of the
fitted measurements exceeds; a choice."""


@dataclass(frozen=True, slots=True)
class Beyond:
    """Readings beyond the fitted range of one variable.

    Attributes:
        variable: e.g. "joint 2 angle", "force", "leverage".
        unit: SI.
        low: smallest fitted value.
        high: largest fitted value; of the leverage, the limit.
        count: number of measurements beyond.
        most: how far the farthest is beyond.
    """

    variable: str
    unit: str
    low: float
    high: float
    count: int
    most: float


@dataclass(frozen=True, slots=True, eq=False)
class Extrapolation:
    """What a fit states of readings that it has not seen, and which of them lie outside.

    Attributes:
        outside: (D,) measurements that lie outside in any variable.
        variables: those that are left, most measurements first.
        stated_m: (D,) standard deviation that the fit states of the 3-D position error, m.
        z: (D,) error over the stated standard deviation, rms of the elements.
        inside_error: of the measurements inside; None where there are none.
        outside_error: of those outside; None where there are none.
    """

    outside: Bools
    variables: tuple[Beyond, ...]
    stated_m: Floats
    z: Floats
    inside_error: ErrorBlock | None
    outside_error: ErrorBlock | None

    def to_dict(self) -> dict[str, object]:
        """Return the keys of `validate --json` on extrapolation and stated standard deviations."""
        z, outside = self.z, self.outside
        errors = {"inside": self.inside_error, "outside": self.outside_error}
        members = {"inside": ~outside, "outside": outside}
        return {
            "stated_rms_m": _rms(self.stated_m),
            "z_rms": _rms(z),
            "extrapolation": {
                "n_outside": int(outside.sum()),
                "variables": [
                    {
                        "variable": v.variable,
                        "unit": v.unit,
                        "measured": [v.low, v.high],
                        "n_outside": v.count,
                        "beyond": v.most,
                    }
                    for v in self.variables
                ],
                **{f"error_{k}": None if e is None else e.to_json() for k, e in errors.items()},
                **{f"z_{k}": _rms(z[mine]) if mine.any() else None for k, mine in members.items()},
            },
        }


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))


def extrapolation(p: Predictive, fitted: Readings, found: Validation) -> Extrapolation:
    """Compare readings with those that a model was fitted to.

    Args:
        p: what the fit knows.
        fitted: the readings that it was fitted to.
        found: the other readings, predicted.
    """
    w, other = found.whitening, found.readings
    prediction = p.model.predict(other.states, p.theta)
    spread, noise = p.of_prediction(prediction, w), p.of_noise(w)
    total = spread + noise
    root = inverse_root(noise)
    leverage = np.linalg.eigvalsh(root @ spread @ np.swapaxes(root, 1, 2))[:, -1]
    outside = np.zeros(len(w.reading), dtype=np.bool_)
    beyond_any = []
    units = p.model.cell.arm.units
    known = {r.variable: r for r in ranges_of(fitted.states, units)}
    turning = turning_variables(whole_turns(p.model, p.theta))
    for name, unit, values in variables(other.states, units):
        if name not in known:
            continue
        r, after, turns = known[name], values[w.reading], name in turning
        far = r.beyond(after, turning=turns)
        if far.any():
            most = float(r.over(after[far], turning=turns).max())
            beyond_any.append(Beyond(name, unit, r.low, r.high, int(far.sum()), most))
        outside |= far
    limit = FAR * float(np.quantile(p.leverage / (1 - p.leverage), 0.99))
    far = leverage > max(limit, 1e-12)
    if far.any():
        most = float(leverage.max() - limit)
        beyond_any.append(Beyond("leverage", "1", 0.0, limit, int(far.sum()), most))
    outside |= far
    root = inverse_root(total)
    white = np.einsum("dij,dj->di", root, found.raw)
    read = np.maximum(np.count_nonzero(np.any(root != 0, axis=2), axis=1), 1)
    return Extrapolation(
        outside=outside,
        variables=tuple(sorted(beyond_any, key=lambda v: -v.count)),
        stated_m=np.sqrt(np.trace(total[:, :3, :3], axis1=1, axis2=2)),
        z=np.sqrt(np.sum(white**2, axis=1) / read),
        inside_error=_error(found.raw, w, ~outside),
        outside_error=_error(found.raw, w, outside),
    )


def _error(raw: Floats, w: Whitening, mine: Bools) -> ErrorBlock | None:
    """Errors of some measurements, each whitened by itself."""
    if not mine.any():
        return None
    root = inverse_root(w.covariance[mine])
    white = np.einsum("dij,dj->di", root, raw[mine])
    return ErrorBlock.of(raw[mine], white, int(np.count_nonzero(np.any(root != 0, axis=2))))
