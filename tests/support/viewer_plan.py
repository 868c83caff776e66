"""A plan and its recording, for the tests of what the viewer gets."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig, load_config
from hilcal.design.run_order import Confounding, Duration
from hilcal.design.summary import (
    CriterionResult,
    CurvePoint,
    DetectableEffect,
    PlanSummary,
    PredictedParameter,
)
from hilcal.present.viewer.plan import record_plan
from hilcal.robot.chain import evaluate
from hilcal.store.plan import REFERENCE, UNLOADED, Plan, Step

CELL = Path(__file__).parents[2] / "configs" / "cells" / "demo_ur10e.toml"
TRACKER = np.array([-2.5, 1.0, 1.3])
Q = np.array(
    [
        [-0.6, -1.6, 1.6, -1.6, -1.5, 0.0],
        [0.4, -1.3, 1.2, -1.4, -1.4, 0.5],
        [-1.5, -1.8, 1.9, -1.7, -1.3, -0.4],
        [0.9, -2.0, 1.7, -1.2, -1.6, 0.9],
    ]
)
PLAN = Plan(
    (REFERENCE, "p1", "p2", "p3"),
    Q,
    (
        Step(REFERENCE, UNLOADED),
        Step("p1", UNLOADED),
        Step("p2", UNLOADED),
        Step("p3", UNLOADED),
        Step(REFERENCE, UNLOADED, 1),
        Step("p1", "10kg"),
        Step("p2", "10kg"),
        Step("p3", "pull x"),
        Step("p1", "pull x"),
        Step(REFERENCE, UNLOADED, 2),
    ),
)
ORDER = Confounding(4, 0.14, "fz", 0.0, 1000.0, 5e-9, 5e-6, 0.0, None)
SUMMARY = PlanSummary(
    poses=3,
    readings=10,
    loads={UNLOADED: 6, "10kg": 2, "pull x": 2},
    duration=Duration(60.0, 90.0, 180.0),
    criterion="D",
    efficiency=0.98768,
    parameters=(
        PredictedParameter("joint_compliance.j1", 4e-8, 4e-6, "rad/(N·m)"),
        PredictedParameter("joint_compliance.j2", 6e-7, 6e-6, "rad/(N·m)"),
        PredictedParameter("target_offset.x", 2.2e-5, 0.0, "m"),
        PredictedParameter("base_frame.x", 1.2e-5, None, "m"),
    ),
    position_std_m=12e-6,
    position="deflection under each load at 100 feasible poses",
    criteria=(
        CriterionResult("D", 12e-6, 24e-6, 0.038, 132.0, 0.02, 4.0, 0.98768),
        CriterionResult("I", 9e-6, 30e-6, None, 66.0, 0.01, 2.0, None),
    ),
    curve=(CurvePoint(2, 24e-6), CurvePoint(3, 12e-6), CurvePoint(6, 11.5e-6)),
    detectable=(
        DetectableEffect("hysteresis", 6e-6),
        DetectableEffect("joint_tilt", 3e-6),
        DetectableEffect("tracker_drift", None),
    ),
    longer=0.03,
    confounding=ORDER,
    shortest=replace(ORDER, correlation=0.63),
    remarks=("only 3 candidates are left of load 10kg.",),
)
BARE = PlanSummary(3, 10, {UNLOADED: 10}, Duration(1.0, 2.0, 0.0), "made by hand", None, (), None)


def configured(**sections):
    config_sections = load_config(CELL).model_dump(mode="json", exclude_none=True)
    config = CellConfig.model_validate(config_sections | sections)
    return cell_from_config(config)


def target(cell, pose):
    return evaluate(cell.arm, Q[pose : pose + 1]).point(cell.target[:3, 3])[0]


@pytest.fixture(scope="module")
def shadowed():
    """A screen stands between the tracker and the target in pose p1; a pillar stands apart."""
    cell = configured()
    middle = 0.45 * target(cell, 1) + 0.55 * TRACKER
    return configured(
        obstacles=[
            {"name": "screen", "center_m": middle.tolist(), "size_m": [0.1, 0.1, 0.3]},
            {"name": "pillar", "bottom_m": [1.2, 1.2, 0.0], "radius_m": 0.1, "height_m": 1.6},
        ],
        sight={"tracker_m": TRACKER.tolist()},
    )


@pytest.fixture(scope="module")
def recording(shadowed, tmp_path_factory):
    path = tmp_path_factory.mktemp("plan") / "plan.rrd"
    record_plan(shadowed, PLAN, SUMMARY, path)
    return path


def rgb(value):
    return value >> 24 & 255, value >> 16 & 255, value >> 8 & 255


def turned(quaternion):
    """(K, 3) where quaternions x y z w lead the z axis."""
    x, y, z, w = np.asarray(quaternion).T
    return np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], 1)
