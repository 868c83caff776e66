"""A cell with a UR15 on PolyScope X, and the kinematics that its factory measured."""

import json

import numpy as np
import pytest

import hilcal as hc
from hilcal.config import CellConfig
from hilcal.config.reference import to_toml
from hilcal.drivers.simulated.cell_processes import SimulatedCell
from hilcal.robot.catalogue import load_arm
from hilcal.robot.factory import flange_difference, of_dict, read_factory, with_factory
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.run_log import RunLog
from tests.support.cli_cases import ok, refused, run
from tests.support.factory_cases import write
from tests.support.living_cell import config, world_of

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


def written(tmp_path, told: CellConfig, **robot):
    path = tmp_path / "cell.toml"
    update = {"robot": told.robot.model_copy(update=robot)} if robot else {}
    path.write_text(to_toml(told.model_copy(update=update)))
    return path


@pytest.mark.long
def test_the_controllers_kinematics_are_checked_written_stored_and_judged(
    tmp_path, capsys, told
) -> None:
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


def refused_out(capsys, *arguments) -> str:
    said = run(capsys, *arguments)
    assert said.code == 3
    return said.out + said.err


@pytest.mark.slow
def test_calibrate_alone_calibrates_a_ur15_on_polyscope_x(tmp_path, capsys) -> None:
    made = config(
        robot={"model": "ur15"},
        simulation={"clock": 40.0, "controller_version": X, "seed": 4},
        planning={"candidates": 150},
        repeatability={"joint_std_rad": 1e-5},
    )
    cell, file = tmp_path / "CELL.toml", tmp_path / "run.hilcal"
    cell.write_text(to_toml(made))
    document = ok(
        capsys, "calibrate", cell, "-o", file, "--rehearse", "--yes", "--poses", "10",
        "--validation", "6", "--json",
    ).document  # fmt: skip
    assert json.dumps(document)
    with CampaignFile.open(file) as kept:
        (arm, *_) = RunLog(kept).last("devices")["answers"]
    assert arm["fields"]["controller_version"] == X
    assert "UR15" in arm["name"]
