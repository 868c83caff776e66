"""The recorded variables in which picked readings differ from the others.

This is a description, no test: readings that somebody picked for their errors, or for their pose,
are no random sample, so a p-value would be meaningless.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.diagnosis.recorded import state_variables
from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import linearise
from hilcal.types import Bools, Floats

CLEAR = 0.85
"""Probability from which a difference is clear: that a random picked reading has a larger (or a
smaller) value than a random one of the others. A choice."""


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
    picked: float  # median of the picked readings, or the share of that name among them
    others: float  # the same of the others
    larger: float  # probability that a picked reading has the larger value, ties counted half

    @property
    def clear(self) -> bool:
        """Whether the difference is worth naming, see `CLEAR`."""
        return max(self.larger, 1 - self.larger) >= CLEAR


def recorded_values(fit: Fit) -> tuple[Recorded, ...]:
    """Return the recorded variables that vary in the readings of a fit, and the target's place."""
    used, readings = ~fit.outlier, fit.readings[~fit.outlier]
    target = fit.solution.prediction.observation.base_position
    varying = [(v.name, v.unit, v.values) for v in state_variables(linearise(fit))]
    loads = np.unique(readings.load)
    names = tuple(readings.load_names[k] for k in loads) if len(loads) > 1 else ()
    if names:
        varying.append(("load", "", np.searchsorted(loads, readings.load).astype(float)))
    varying += [
        ("distance from the base axis", "m", np.hypot(target[:, 0], target[:, 1])),
        ("height above the base", "m", target[:, 2]),
    ]
    out = []
    for name, unit, values in varying:
        of_all = np.full(len(used), np.nan)
        of_all[used] = values
        out.append(Recorded(name, unit, of_all, names if name == "load" else ()))
    return tuple(out)


def distinguish(fit: Fit, picked: Bools) -> tuple[Difference, ...]:
    """Compare picked readings (N,) with the others in every variable; clearest difference first.

    Only measurements are compared: the unloaded readings of deflections do not count as others.
    """
    from scipy.stats import rankdata  # slow to import

    measured = np.zeros(len(picked), dtype=bool)
    measured[np.flatnonzero(~fit.outlier)[fit.whitening.reading]] = True
    inside, outside = picked & measured, ~picked & measured
    if not (inside.any() and outside.any()):
        return ()
    differences = []
    for v in recorded_values(fit):
        members = [
            (f"{v.name} {name}", (v.values == k).astype(float)) for k, name in enumerate(v.labels)
        ]
        middle = np.mean if members else np.median
        for name, x in members or [(v.name, v.values)]:
            a, b = x[inside], x[outside]
            ranks = rankdata(np.concatenate([a, b]))[: len(a)]
            larger = float((ranks.sum() - len(a) * (len(a) + 1) / 2) / (len(a) * len(b)))
            differences.append(Difference(name, v.unit, float(middle(a)), float(middle(b)), larger))
    return tuple(sorted(differences, key=lambda d: -abs(d.larger - 0.5)))
