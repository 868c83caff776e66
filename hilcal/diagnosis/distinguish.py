"""What sets some readings apart from the others: the recorded variables in which they differ.

This describes and tests nothing: readings that somebody picked because they err, or because they
are of one pose, are no random choice, so no p-value would be one.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.diagnosis.recorded import state_variables
from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import linearise
from hilcal.types import Bools, Floats

CLEAR = 0.85
"""Chance from which a difference is named: that one of the picked readings, drawn at random, has
the larger value (or the smaller one) than one of the others. A choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """A recorded variable of all readings."""

    name: str  # e.g. "joint 2 torque"
    unit: str  # SI; "" for a pure number
    values: Floats  # (N,) of all readings; NaN where a reading was set aside
    labels: tuple[str, ...] = ()  # names of the values 0, 1, ... where they are not numbers


@dataclass(frozen=True, slots=True)
class Difference:
    """How the picked readings differ from the others in one variable."""

    variable: str  # e.g. "joint 2 torque"; "load 5 kg" for one of several names
    unit: str  # SI; "" for a share
    picked: float  # median of the picked readings; the share of that name among them
    others: float  # the same of the others
    larger: float  # probability that a picked reading has the larger value, ties counted half

    @property
    def clear(self) -> bool:
        """Whether the difference is worth naming, see `CLEAR`."""
        return max(self.larger, 1 - self.larger) >= CLEAR


def recorded_values(fit: Fit) -> tuple[Recorded, ...]:
    """Return what was recorded of the readings of a fit and varies, and where the target was."""
    used, readings = ~fit.outlier, fit.readings[~fit.outlier]
    at = fit.solution.prediction.observation.base_position
    varying = [(v.name, v.unit, v.values) for v in state_variables(linearise(fit))]
    loads = np.unique(readings.load)
    names = tuple(readings.load_names[k] for k in loads) if len(loads) > 1 else ()
    if names:
        varying.append(("load", "", np.searchsorted(loads, readings.load).astype(float)))
    varying += [
        ("distance from the base axis", "m", np.hypot(at[:, 0], at[:, 1])),
        ("height above the base", "m", at[:, 2]),
    ]
    out = []
    for name, unit, values in varying:
        everywhere = np.full(len(used), np.nan)
        everywhere[used] = values
        out.append(Recorded(name, unit, everywhere, names if name == "load" else ()))
    return tuple(out)


def distinguish(fit: Fit, picked: Bools) -> tuple[Difference, ...]:
    """Compare picked readings (N,) with the others in every variable; clearest difference first.

    Measurements alone are compared: the unloaded readings of deflections do not count as others.
    """
    from scipy.stats import rankdata  # slow to import

    measured = np.zeros(len(picked), dtype=bool)
    measured[np.flatnonzero(~fit.outlier)[fit.whitening.reading]] = True
    mine, others = picked & measured, ~picked & measured
    if not (mine.any() and others.any()):
        return ()
    found = []
    for v in recorded_values(fit):
        kinds = [
            (f"{v.name} {name}", (v.values == k).astype(float)) for k, name in enumerate(v.labels)
        ]
        middle = np.mean if kinds else np.median
        for name, x in kinds or [(v.name, v.values)]:
            a, b = x[mine], x[others]
            ranks = rankdata(np.concatenate([a, b]))[: len(a)]
            larger = float((ranks.sum() - len(a) * (len(a) + 1) / 2) / (len(a) * len(b)))
            found.append(Difference(name, v.unit, float(middle(a)), float(middle(b)), larger))
    return tuple(sorted(found, key=lambda d: -abs(d.larger - 0.5)))
