"""A real arm against itself: half of its poses are the earlier campaign, 15 others the later one.

Nothing changed between the two, so no change must be claimed. Then a joint's zero is moved in the
later readings by the fitted model; this change must be found.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from hilcal.cell import Cell
from hilcal.diagnosis.change import find_changes
from hilcal.diagnosis.comparison import with_missing_effects
from hilcal.identification.baseline import with_effects
from hilcal.identification.carried.later_readings import EarlierFit, earlier_fit, later_readings
from hilcal.identification.fit import fit
from hilcal.library import read_table
from hilcal.readings.readings import Readings
from hilcal.robot import se3
from hilcal.robot.catalogue import configs_dir

EFFECTS = ("transmission_error", "link_geometry", "link_compliance", "joint_tilt_compliance")
"""Result of a refinement of the whole series (`studies real`)."""
ZERO_RAD = 0.5e-3
"""Change of a joint's zero: half a millimetre at one metre."""


@dataclass(frozen=True, slots=True)
class RealCase:
    """One comparison on real readings.

    Attributes:
        joint: joint with a moved zero; 0 for none.
        anew: whether the tracker's place was estimated anew.
        parts: parts that the program names.
        explained: whether the residual is scatter.
        z: (estimated − true)/std of the zero, if it is named.
    """

    joint: int
    anew: bool
    parts: tuple[str, ...]
    explained: bool
    z: float | None


@dataclass(frozen=True, slots=True)
class RealStudy:
    """Settings of the study.

    Attributes:
        path: `measurements_joint_configurations.csv` of the IPA UR10 accuracy data.
        count: number of comparisons without a change, which come first, and of those with one.
        seed: of halves and draws.
        count_b: readings of the later campaign.
    """

    path: Path
    count: int
    seed: int
    count_b: int


def real_case(k: int, study: RealStudy) -> RealCase:
    """Return the k-th comparison of readings of one half of a series with the other half."""
    earlier, draws = _halves(study)
    later, joint = draws[k]
    anew = bool(k % 2)
    if joint:
        later = _moved(earlier, later, joint - 1)
    changes = find_changes(later_readings(earlier, later, anew=anew))
    z = [
        (c.sizes[0].value - ZERO_RAD) / c.sizes[0].std
        for c in changes.found
        if c.candidate.name == f"encoder_offset.j{joint}"
    ]
    parts = tuple(dict.fromkeys(c.candidate.part for c in changes.found))
    return RealCase(joint, anew, parts, changes.explained, z[0] if z else None)


@cache
def _halves(study: RealStudy) -> tuple[EarlierFit, list[tuple[Readings, int]]]:
    """Fit one half, and draw later readings and a joint, or 0, for each comparison.

    Cached in each process, as sending the fit would take longer than computing it.
    """
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    readings, rng = read_table(study.path, cell, "ipa-ur10"), np.random.default_rng(study.seed)
    poses = rng.permutation(np.unique(readings.pose))
    half = np.isin(readings.pose, poses[: len(poses) // 2])
    model = with_effects(cell, readings[half], "absolute", EFFECTS)
    fitted, _ = with_missing_effects(fit(model, readings[half], "absolute"), (), lambda _: None)
    earlier, other_half = earlier_fit(fitted), np.flatnonzero(~half)
    out = []
    for k in range(2 * study.count):
        later = readings[np.sort(rng.choice(other_half, study.count_b, replace=False))]
        joint = int(rng.integers(2 if k % 2 else 1, 7)) if k >= study.count else 0
        out.append((later, joint))
    return earlier, out


def _moved(earlier: EarlierFit, later: Readings, j: int) -> Readings:
    """Return the readings as if the zero of a joint had moved, by the fitted model."""
    model, theta, s = earlier.fit.model, earlier.fit.theta, later.states
    step = ZERO_RAD * np.eye(s.q.shape[1])[j]
    actual = None if s.q_actual is None else s.q_actual + step
    before = model.predict(s, theta).observation
    after = model.predict(replace(s, q=s.q + step, q_actual=actual), theta).observation
    value = later.value.copy()
    value[:, :3] += after.position - before.position
    if later.m == 6:
        turn = after.rotation @ np.swapaxes(before.rotation, 1, 2)
        value[:, 3:] = se3.rotation_vector(turn @ se3.rotation(later.value[:, 3:]))
    return replace(later, value=value)
