"""Simulated cells of other instruments, arms and controllers."""

import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import hilcal as hc
from hilcal.campaign.campaign import estimated_noise
from hilcal.config import CellConfig
from hilcal.config.reference import to_toml
from hilcal.drivers.simulated.arm import open_arm
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.cell_processes import SimulatedCell
from hilcal.drivers.simulated.rehearsal import case_of_plan, simulated_cell
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.connect import connect
from hilcal.robot.catalogue import load_arm
from hilcal.robot.factory import flange_difference, of_dict, read_factory, with_factory
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, Step
from hilcal.store.run_log import RunLog
from tests.support.cli_cases import ok, refused, run
from tests.support.factory_cases import write
from tests.support.rows import first
from tests.support.running_world import config, world_of

NETFT = {"driver": "netft", "host": "192.168.1.1", "origin_m": [0.0, 0.0, 0.04]}


@pytest.mark.parametrize(
    ("driver", "options", "sigma"),
    first(1, [("emscon", {"target": "pose"}, 6.0), ("emscon", {}, 6.0), ("natnet", {}, 60.0)]),
)
def test_instruments_see_the_one_world(tmp_path, driver, options, sigma):
    made = config(tracker={"driver": driver, "options": options}, force_sensor=NETFT)
    with SimulatedCell.start(world_of(made), made, tmp_path, 3) as cell:
        rig, answers = connect(cell.config)
        assert rig is not None, [a.failure for a in answers]
        try:
            assert [a.problems for a in answers] == [()] * 4
            sample = rig.tracker.measure()
            truth = Blackboard(tmp_path / "world.bin").read("truth")
            off = sample.value.copy()
            off[:3] -= truth["target"]
            if len(off) == 6:
                back = Rotation.from_matrix(truth["target_rotation"]).inv()
                off[3:] = (Rotation.from_rotvec(sample.value[3:]) * back).as_rotvec()
            assert np.all(np.abs(off) < sigma * np.sqrt(np.diag(sample.covariance)))
            bias = np.array(cell.ask("force", "state")["bias"])
            wrench = rig.force.average(0.2).wrench
            assert wrench == pytest.approx(truth["sensor_wrench"] + bias, abs=0.05)
        finally:
            rig.close()


def test_a_tracker_that_cannot_be_simulated_is_refused(tmp_path):
    made = config(tracker={"driver": "mytracker"})
    with pytest.raises(InputError, match="no simulated tracker 'mytracker'; valid: geocom, emscon"):
        SimulatedCell.start(world_of(made), made, tmp_path, 3)


@pytest.mark.slow
def test_the_noise_of_cameras_is_estimated_and_not_believed(tmp_path, capsys):
    """Their samples scatter by 50 µm and an average by 11; they err by 71 µm from pose to pose."""
    toml, plan, out = (tmp_path / name for name in ("cell.toml", "plan.json", "run.hilcal"))
    place = ("--target", "0.06,0.02,0.12")
    ok(capsys, "init", toml, "--robot", "ur10e", "--tracker", "natnet", *place)
    words = toml.read_text(encoding="utf-8")
    toml.write_text(words.replace("clock = 20.0", "clock = 10.0"), encoding="utf-8")
    ok(capsys, "plan", toml, "-o", plan, "--poses", "40")
    ok(capsys, "run", toml, "--plan", plan, "--rehearse", "-o", out)
    with CampaignFile.open(out, read_only=True) as campaign:
        noise = estimated_noise(campaign)
    assert noise.along_m == pytest.approx(71e-6, rel=0.5)
    assert noise.across_m == pytest.approx(71e-6, rel=0.5)
    assert noise.orientation_rad == pytest.approx(710e-6, rel=0.3)


FR3 = np.array([0.0, -0.6, 0.0, -2.2, 0.0, 1.8, 0.5])


def config_of(model, **simulation):
    return CellConfig.model_validate(
        {
            "robot": {"model": model},
            "tool": {"target_m": [0.06, 0.02, 0.12], "load_point_m": [0.06, 0.0, 0.1]},
            "loads": [{"name": "2kg", "mass_kg": 2.0}],
            "limits": {"workspace_min_m": [-4.0, -4.0, -1.0]},
            "simulation": {"clock": 50.0, **simulation},
        }
    )


def case_of(config, q, base_dir):
    plan = Plan(("a",), q[None], (Step("a", "none", 0), Step("a", "2kg", 0)))
    return case_of_plan(config, plan, "nothing", 1, base_dir=base_dir)


@pytest.fixture
def fr3(tmp_path):
    config = config_of("fr3")
    with simulated_cell(case_of(config, FR3, tmp_path), 1, tmp_path) as cell:
        yield cell


def test_the_simulated_arm_keeps_the_rules_of_a_real_one(fr3):
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


ROBOT = {"model": "ur15", "kinematics": "factory", "calibration": "cal.toml"}
X = "10.14.0.0"


@pytest.fixture
def told(tmp_path):
    """The configuration of a running simulated cell, relative to the directory of its file."""
    made = write(tmp_path / "cal.toml", "ur15")
    simulation = {"clock": 40.0, "controller_version": X, "seed": 4}
    planning = {"candidates": 150, "readings": "absolute"}
    parts = config(
        robot={**ROBOT, "calibration": str(tmp_path / "cal.toml")},
        simulation=simulation,
        planning=planning,
        repeatability={"joint_std_rad": 1e-5},
    )
    with SimulatedCell.start(world_of(parts), parts, tmp_path / "cell", 3) as cell:
        yield cell.config, made


def written(tmp_path, told, **robot):
    path = tmp_path / "cell.toml"
    update = {"robot": told.robot.model_copy(update=robot)} if robot else {}
    path.write_text(to_toml(told.model_copy(update=update)))
    return path


@pytest.mark.long
def test_the_controllers_kinematics_are_checked_written_stored_and_judged(tmp_path, capsys, told):
    config, made = told
    cell = written(tmp_path, config)
    file = tmp_path / "told.toml"
    shown = ok(capsys, "check", cell, "--save-calibration", file).out
    assert "UR15" in shown
    assert "measured by the factory" in shown
    nominal = load_arm("ur15")
    np.testing.assert_allclose(read_factory(file, nominal).rows, made.rows, rtol=1e-9, atol=1e-9)
    refused(capsys, 2, "check", cell, "--save-calibration", file)  # it is there

    write(tmp_path / "other.toml", "ur15", seed=9)
    other = written(tmp_path, config, calibration=str(tmp_path / "other.toml"))
    assert "are not those of [robot] calibration" in refused_out(capsys, "check", other)
    wrong = written(tmp_path, config, model="ur18", kinematics="nominal", calibration=None)
    out = refused_out(capsys, "check", wrong)
    assert "not those of a ur18" in out

    cell, kept_in = written(tmp_path, config), tmp_path / "f.hilcal"
    document = ok(capsys, "check", cell, "--factory", kept_in, "--yes", "--json").document
    assert document["factory"]["changed"] is False
    assert document["factory"]["nominal_m"] > 2.0 * document["factory"]["factory_m"]
    again = ok(capsys, "check", cell, "--factory", kept_in, "--json").document  # without measuring
    assert again["factory"] == document["factory"]
    with CampaignFile.open(kept_in) as kept:
        (arm, *_) = RunLog(kept).last("devices")["answers"]
        stored = of_dict(arm["fields"]["kinematics"], "stored")
    np.testing.assert_allclose(stored.rows, made.rows, rtol=1e-9, atol=1e-9)
    (tmp_path / "cal.toml").unlink()  # the campaign holds it
    with hc.Campaign.open(kept_in) as campaign:
        assert flange_difference(campaign.cell.arm, with_factory(nominal, made))[1] < 1e-9


def refused_out(capsys, *arguments):
    said = run(capsys, *arguments)
    assert said.code == 3
    return said.out + said.err
