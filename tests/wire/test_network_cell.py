"""The simulated cell with instruments in the network, and what is calibrated with them alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.campaign.campaign import estimated_noise
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.cell_processes import SimulatedCell
from hilcal.errors import InputError
from hilcal.measuring.connect import connect
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.run_log import RunLog
from tests.support.calibrate_process import CELL
from tests.support.cli_cases import Capsys, ok
from tests.support.living_cell import config, world_of
from tests.support.rows import first

NETFT = {"driver": "netft", "host": "192.168.1.1", "origin_m": [0.0, 0.0, 0.04]}


@pytest.mark.parametrize(
    ("driver", "options", "sigma"),
    first(1, [("emscon", {"target": "pose"}, 6.0), ("emscon", {}, 6.0), ("natnet", {}, 60.0)]),
)
def test_instruments_see_the_one_world(
    tmp_path: Path, driver: str, options: dict[str, Any], sigma: float
) -> None:
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
            assert rig.force is not None
            bias = np.array(cell.ask("force", "state")["bias"])
            wrench = rig.force.average(0.2).wrench
            assert wrench == pytest.approx(truth["sensor_wrench"] + bias, abs=0.05)
        finally:
            rig.close()


def test_a_tracker_that_cannot_be_simulated_is_refused(tmp_path: Path) -> None:
    made = config(tracker={"driver": "mytracker"})
    with pytest.raises(InputError, match="no simulated tracker 'mytracker'; valid: geocom, emscon"):
        SimulatedCell.start(world_of(made), made, tmp_path, 3)


@pytest.mark.slow
def test_a_lab_of_today_calibrates_by_one_command(tmp_path: Path, capsys: Capsys) -> None:
    """A UR15 on PolyScope X, an AT401 and a Net F/T."""
    toml, out = tmp_path / "cell.toml", tmp_path / "run.hilcal"
    sensor = '[force_sensor]\ndriver = "netft"\nhost = "192.168.1.1"\n'
    cell = CELL.replace("ur10e", "ur15") + 'controller_version = "10.12.0.1"\n'
    toml.write_text(f'{cell}{sensor}[tracker]\ndriver = "emscon"\n', encoding="utf-8")
    size = ("--poses", "4", "--validation", "3")
    told = ok(capsys, "calibrate", toml, "-o", out, "--rehearse", "--yes", "--json", *size)
    error = told.document["improvement"]["error"]
    assert error["after"]["rms_m"] < 0.3 * error["before"]["rms_m"]
    about = ok(capsys, "info", out).out
    assert "SIM AT401, serial 391234" in about
    assert "SIM NET F/T" in about
    with CampaignFile.open(out, read_only=True) as kept:
        arm = next(a for a in RunLog(kept).last("devices")["answers"] if a["device"] == "arm")
    assert arm["fields"]["controller_version"].startswith("10.12")


@pytest.mark.slow
def test_the_noise_of_cameras_is_estimated_and_not_believed(tmp_path: Path, capsys: Capsys) -> None:
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
    assert noise is not None
    assert noise.along_m == pytest.approx(71e-6, rel=0.5)
    assert noise.across_m == pytest.approx(71e-6, rel=0.5)
    assert noise.orientation_rad == pytest.approx(710e-6, rel=0.3)
