"""A plan of spread poses: every limit kept, every load hung once, the same again from the seed."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilcal.acquire.dry_run import dry_run
from hilcal.cell import cell_from_config
from hilcal.config import CellConfig, Limits
from hilcal.data.plan import REFERENCE, UNLOADED, Step
from hilcal.errors import CannotAnswerError, InputError
from hilcal.plan.spread import spread_plan
from tests.support.campaigns import configuration

ROBOTS = ("ur3e", "ur5e", "ur10e", "ur16e")


def _cell(robot: str, masses: list[float], margin: float, low: float) -> CellConfig:
    return CellConfig.model_validate(
        {
            "robot": {"model": robot},
            "tool": {"target_m": [0.05, 0.0, 0.1], "load_point_m": [0.04, 0.0, 0.1]},
            "loads": [{"name": f"m{k}", "mass_kg": m} for k, m in enumerate(masses)],
            "limits": {"joint_margin_rad": margin, "workspace_min_m": [-2.0, -2.0, low]},
        }
    )


@settings(max_examples=12, deadline=None)
@given(
    st.sampled_from(ROBOTS),
    st.lists(st.floats(0.5, 2.5), min_size=1, max_size=3),
    st.floats(0.0, 0.3),
    st.floats(-0.1, 0.1),
    st.integers(0, 99),
)
def test_no_plan_breaks_a_limit(
    robot: str, masses: list[float], margin: float, low: float, seed: int
) -> None:
    config = _cell(robot, masses, margin, low)
    cell = cell_from_config(config)
    plan = spread_plan(cell, config, 6, np.random.default_rng(seed))
    assert dry_run(cell, config, plan).problems == ()


def test_every_pose_is_measured_under_every_load_and_has_its_unloaded_reading() -> None:
    config = configuration()
    cell = cell_from_config(config)
    plan = spread_plan(cell, config, 12, np.random.default_rng(2), repeats=3)
    steps = set(plan.steps)
    poses = [name for name in plan.pose_names if name != REFERENCE]
    assert len(poses) == 12
    for load in (UNLOADED, *(load.name for load in config.loads)):
        assert {Step(pose, load) for pose in poses} <= steps
    assert all(Step(s.pose, UNLOADED, s.cycle) in steps for s in plan.steps)
    assert sum(s.cycle == 1 and s.pose != REFERENCE for s in plan.steps) == 3
    done = dry_run(cell, config, plan)
    assert done.problems == ()
    assert done.remarks == ()
    assert done.load_changes == len(config.loads) + 1  # each hung once, the last taken off
    returns = [s.cycle for s in plan.steps if s.pose == REFERENCE and s.load == UNLOADED]
    assert returns == list(range(len(returns)))
    assert plan.steps[0].pose == plan.steps[-1].pose == REFERENCE


def test_the_same_seed_gives_the_same_plan_and_another_one_another() -> None:
    config = configuration()
    cell = cell_from_config(config)
    made = [spread_plan(cell, config, 5, np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert made[0].to_json() == made[1].to_json()
    assert made[0].to_json() != made[2].to_json()


def test_poses_are_farther_apart_than_random_ones() -> None:
    config = configuration()
    cell = cell_from_config(config)

    def gap(q: np.ndarray) -> float:
        point = np.exp(1j * q)
        far = np.linalg.norm(point[:, None] - point, axis=2) + 9.0 * np.eye(len(q))
        return float(far.min())

    spread = spread_plan(cell, config, 20, np.random.default_rng(0)).q[1:]
    lots = [
        gap(np.random.default_rng(k).uniform(spread.min(0), spread.max(0), spread.shape))
        for k in range(20)
    ]
    assert gap(spread) > np.median(lots)


def test_what_leaves_no_pose_is_named() -> None:
    config = configuration()
    cell = cell_from_config(config)
    narrow = config.model_copy(update={"limits": Limits(joint_margin_rad=3.2)})
    with pytest.raises(CannotAnswerError, match="joint_margin_rad leaves joint"):
        spread_plan(cell, narrow, 4, np.random.default_rng(0))
    box = Limits(workspace_min_m=(0.3, 0.3, 0.3), workspace_max_m=(0.35, 0.35, 0.35))
    with pytest.raises(CannotAnswerError, match="workspace"):
        spread_plan(cell, config.model_copy(update={"limits": box}), 4, np.random.default_rng(0))
    weak = replace(cell, arm=replace(cell.arm, torque_max=np.full(6, 1.0)))
    with pytest.raises(CannotAnswerError, match="torque_share"):
        spread_plan(weak, config, 4, np.random.default_rng(0))
    with pytest.raises(InputError, match="at least one pose"):
        spread_plan(cell, config, 0, np.random.default_rng(0))
