"""Arms of other makers in rehearsal: seven and eight joints, slides among them, on the wire."""

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.drivers.simulated.arm import open_arm
from hilcal.drivers.simulated.rehearsal import SimulationCase, case_of_plan, simulated_cell
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.connect import connect
from hilcal.robot.chain import evaluate
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, Step
from tests.support.cli_cases import Capsys, ok

FR3 = np.array([0.0, -0.6, 0.0, -2.2, 0.0, 1.8, 0.5])
EIGHT = "\n".join(
    [
        'title = "Eight joints, two of them slides"\nconvention = "modified"\n',
        *(
            f'[[joints]]\nname = "{name}"\na_m = {a}\nd_m = {d}\nalpha_deg = {alpha}\n{more}\n'
            for name, a, d, alpha, more in (
                ("track", 0.0, 0.0, 90.0, 'type = "prismatic"\nq_min_m = 0.0\nq_max_m = 2.0'),
                ("lift", 0.0, 0.4, -90.0, 'type = "prismatic"\nq_min_m = 0.0\nq_max_m = 0.6'),
                *((f"j{k}", *row, "q_min_deg = -170\nq_max_deg = 170\nmass_kg = 2.0")
                  for k, row in enumerate(((0.0, 0.3, 0.0), (0.05, 0.0, -90.0), (0.4, 0.0, 0.0),
                                           (0.05, 0.4, -90.0), (0.0, 0.0, 90.0),
                                           (0.0, 0.1, -90.0)), start=1)),
            )
        ),
    ]
)  # fmt: skip


def config_of(model: str, **simulation: object) -> CellConfig:
    return CellConfig.model_validate(
        {
            "robot": {"model": model},
            "tool": {"target_m": [0.06, 0.02, 0.12], "load_point_m": [0.06, 0.0, 0.1]},
            "loads": [{"name": "2kg", "mass_kg": 2.0}],
            "limits": {"workspace_min_m": [-4.0, -4.0, -1.0]},
            "simulation": {"clock": 50.0, **simulation},
        }
    )


def case_of(config: CellConfig, q: np.ndarray, base_dir: Path) -> SimulationCase:
    plan = Plan(("a",), q[None], (Step("a", "none", 0), Step("a", "2kg", 0)))
    return case_of_plan(config, plan, "nothing", 1, base_dir=base_dir)


@pytest.fixture
def fr3(tmp_path: Path) -> Iterator[object]:
    config = config_of("fr3")
    with simulated_cell(case_of(config, FR3, tmp_path), 1, tmp_path) as cell:
        yield cell


def test_the_simulated_arm_keeps_the_rules_of_a_real_one(fr3) -> None:
    arm = open_arm(fr3.config)
    np.testing.assert_allclose(arm.sample().q, FR3, atol=1e-4)  # where the plan begins
    with pytest.raises(DeviceError, match="without control"):
        arm.start_move(FR3, 0.5, 0.5)
    arm.take_control(1.5, np.array([0.0, 0.0, 0.1]))
    sample = arm.sample()
    assert (sample.payload, sample.payload_com.tolist()) == (1.5, [0.0, 0.0, 0.1])
    with pytest.raises(DeviceError, match="beyond the limits of fr3"):
        arm.start_move(FR3 + np.eye(7)[3] * 3.0, 0.5, 0.5)
    with pytest.raises(DeviceError, match="fr3 has 7 joints"):
        arm.start_move(FR3[:6], 0.5, 0.5)
    goal = FR3 + 0.3
    arm.start_move(goal, 1.0, 1.0)
    while arm.moving():
        time.sleep(0.01)
    np.testing.assert_allclose(arm.sample().q, goal, atol=1e-4)
    # nobody looks: it stops by itself, on its way
    arm.start_move(FR3, 0.002, 0.02)
    time.sleep(1.2)
    assert not arm.moving()
    assert np.abs(arm.sample().q - FR3).max() > 0.01
    # a safety stop ends a motion, says so, and hinders the next until it is released
    arm.start_move(FR3, 0.002, 0.02)
    fr3.ask("arm", "protective_stop")
    with pytest.raises(DeviceError, match="protective stop; release it"):
        arm.moving()
    assert arm.report().problems == ("it is in a protective stop",)
    arm.stop()
    with pytest.raises(DeviceError, match="in a protective stop"):
        arm.start_move(FR3, 0.002, 0.02)
    fr3.ask("arm", "release")
    arm.start_move(FR3, 1.0, 1.0)
    arm.stop()
    # after a power cut it stands where it stood
    stood = arm.sample().q_target
    fr3.kill("arm")
    with pytest.raises(DeviceError, match=r"arm\.sock"):
        arm.sample()
    fr3.restart("arm")
    np.testing.assert_allclose(arm.sample().q, stood, atol=1e-3)
    arm.close()


def test_a_simulated_arm_outside_of_its_cell_is_refused() -> None:
    config = config_of("fr3")
    robot = config.robot.model_copy(update={"driver": "hilcal.drivers.simulated.arm:open_arm"})
    with pytest.raises(InputError, match=r"lacks socket.*a real arm needs the driver of its maker"):
        open_arm(config.model_copy(update={"robot": robot}))


def test_eight_joints_with_two_slides_stand_where_their_kinematics_say(tmp_path: Path) -> None:
    (tmp_path / "eight.toml").write_text(EIGHT)
    config = config_of("eight.toml")
    q = np.array([1.2, 0.3, 0.4, -1.0, 0.6, 0.2, 1.0, -0.5])
    secret = case_of(config, q, tmp_path)
    with simulated_cell(secret, 1, tmp_path) as cell:
        rig, answers = connect(cell.config)
        assert rig is not None, [answer.failure for answer in answers]
        try:
            rig.arm.take_control(0.0, np.zeros(3))
            goal = q + np.array([0.5, 0.2, *[0.3] * 6])
            rig.arm.start_move(goal, 0.5, 0.8)
            while rig.arm.moving():
                time.sleep(0.01)
            sample = rig.arm.sample()
            np.testing.assert_allclose(sample.q, goal, atol=1e-4)
            time.sleep(0.3)
            seen = rig.tracker.measure().value
        finally:
            rig.close()
    truth = secret.world
    arm = cell_from_config(config, tmp_path).arm
    chain = evaluate(arm, goal[None])
    point = chain.point(np.array([0.06, 0.02, 0.12]))[0]
    expected = truth.registration[:3, :3] @ point + truth.registration[:3, 3]
    # what the drives give way under the arm's weight, and the noise of the tracker
    assert np.linalg.norm(seen[:3] - expected) < 5e-3


@pytest.mark.long
def test_a_campaign_of_seven_joints_is_rehearsed(tmp_path: Path, capsys: Capsys) -> None:
    (tmp_path / "cell.toml").write_text(
        """[robot]
model = "fr3"
[tool]
target_m = [0.06, 0.02, 0.12]
load_point_m = [0.06, 0.0, 0.1]
[[loads]]
name = "2kg"
mass_kg = 2.0
[limits]
workspace_min_m = [-2.0, -2.0, -0.5]
[planning]
candidates = 100
[simulation]
clock = 100.0
"""
    )
    cell, plan, run = (tmp_path / n for n in ("cell.toml", "plan.json", "run.hilcal"))
    ok(capsys, "plan", cell, "--poses", "3", "-o", plan)
    done = ok(capsys, "run", cell, "--plan", plan, "-o", run, "--rehearse", "--json").document
    assert done["readings"] == done["planned"] > 6
    with CampaignFile.open(run) as campaign:
        assert campaign.readings().states.q.shape[1] == 7
