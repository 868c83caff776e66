"""Refinements of campaigns with gross errors in a share of their readings."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.config import CellConfig
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.prediction.full_prediction import gross_errors
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import MODES, Mode
from hilcal.refinement import refine
from hilcal.types import Ints
from studies.study_cases import study_case

ARMS = ("ur3", "ur3e", "ur5", "ur5e", "ur10", "ur10e", "ur16e", "ur20", "ur30")
POSES = (4, 6, 10, 20, 30)
"""Numbers of poses, with six readings each."""
STRENGTHS = (3.0, 10.0, 20.0)
"""Strengths of the hidden effect in units of the noise: 20 is about 0.4 mm."""


HIDDEN: dict[Mode, tuple[str, ...]] = {
    "absolute": (
        "encoder_offset",
        "transmission_error",
        "link_geometry",
        "hysteresis",
        "thermal_growth",
    ),
    "deflection": (
        "base_compliance",
        "joint_tilt_compliance",
        "hysteresis",
        "backlash",
        "tracker_drift",
    ),
}


@dataclass(frozen=True, slots=True)
class GrossErrorCase:
    """Settings of a campaign.

    Attributes:
        share: share of the readings with a gross error.
        size_m: size of each error, m.
        seed: of everything random.
    """

    share: float
    size_m: float
    seed: int


@dataclass(frozen=True, slots=True)
class GrossErrorCounts:
    """Result of the refinement of a campaign.

    Attributes:
        case: settings of the campaign.
        mode: of its readings.
        readings: number of readings.
        wrong: number of gross errors.
        found: number of gross errors set aside.
        false: number of good readings listed as gross errors.
        said: whether the program reports that too many readings disagree.
        outcome: the verdict; "refused" where the program declined to fit or judge.
        what: arm, number of poses, hidden effect, and the message of a refusal.
    """

    case: GrossErrorCase
    mode: Mode
    readings: int
    wrong: int
    found: int
    false: int
    said: bool
    outcome: str
    what: str


def spoil(
    readings: Readings, share: float, size: float, rng: np.random.Generator
) -> tuple[Readings, Ints]:
    """Shift a share of the readings, a third of these in one coordinate, else in any direction."""
    rows = rng.choice(len(readings), round(share * len(readings)), replace=False)
    shift = rng.normal(size=(len(rows), 3))
    axial = rng.random(len(rows)) < 1 / 3
    count = axial.sum()
    shift[axial] = np.eye(3)[rng.integers(3, size=count)] * rng.choice([-1, 1], (count, 1))
    sizes = size * 1.25 ** rng.uniform(-1, 1, (len(rows), 1))
    value = readings.value.copy()
    value[rows, :3] += sizes * shift / np.linalg.norm(shift, axis=1, keepdims=True)
    return replace(readings, value=value), rows


def count(config: CellConfig, asked: GrossErrorCase) -> GrossErrorCounts:
    """Draw a campaign, refine it as a user does, and count the readings set aside."""
    rng = np.random.default_rng([30, asked.seed])
    robot, mode = str(rng.choice(ARMS)), MODES[asked.seed % 2]
    poses = int(rng.choice(POSES))
    hidden = (str(rng.choice(HIDDEN[mode])),) if rng.random() < 0.5 else ()
    strength = float(rng.choice(STRENGTHS))
    case = study_case(config, robot, mode, hidden, strength, asked.seed, n_poses=poses)
    readings, wrong = spoil(case.readings, asked.share, asked.size_m, rng)
    text = f"{robot}, {poses} poses, {' + '.join(hidden) or 'nothing'} hidden ({strength:g} σ)"
    try:
        refined = refine(baseline(case.cell, readings, mode), readings, mode)
    except (InputError, CannotAnswerError) as error:
        text = f"{text}: {error}"
        return GrossErrorCounts(
            asked, mode, len(readings), len(wrong), 0, 0, False, "refused", text
        )
    listed = {g.row for g in gross_errors(refined.fit)}
    return GrossErrorCounts(
        asked,
        mode,
        len(readings),
        len(wrong),
        int(refined.fit.outlier[wrong].sum()),
        len(listed.difference(wrong.tolist())),
        refined.fit.disagreement is not None,
        refined.verdict,
        text,
    )
