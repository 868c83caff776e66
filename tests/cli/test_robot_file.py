"""A campaign of a robot with a file of its own is whole without that file."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import hilcal as hc
from hilcal.calibration.handover import urdf
from hilcal.cell import cell_from_config
from hilcal.config import CellConfig, load_config
from hilcal.errors import InputError
from hilcal.robot.catalogue import configs_dir, load_arm
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.kept_texts import ROBOT_FILE
from hilcal.store.plan import Plan, Step
from hilcal.store.run_log import check_same_cell
from tests.support.cli_cases import ok, refused
from tests.unit.discovery.test_discover import campaign as simulated


@pytest.fixture
def sent(tmp_path: Path) -> tuple[Path, CellConfig]:
    """A campaign that was sent: its robot's file stays where it was measured."""
    there, here = tmp_path / "there", tmp_path / "here"
    there.mkdir()
    here.mkdir()
    (there / "own.urdf").write_text(urdf(load_arm("ur10e")), encoding="utf-8")
    config = load_config(configs_dir() / "cells" / "demo_ur10e.toml")
    robot = config.robot.model_copy(update={"model": "own.urdf"})
    config = config.model_copy(update={"robot": robot})
    with CampaignFile.create(there / "run.hilcal", config.to_json(), str(there), "made") as file:
        file.append_readings(simulated().readings)
    shutil.copy(there / "run.hilcal", here)
    shutil.rmtree(there)
    return here / "run.hilcal", config


def test_a_campaign_that_was_sent_is_fitted_and_exported_without_the_robots_file(
    sent: tuple[Path, CellConfig], capsys: pytest.CaptureFixture[str]
) -> None:
    path, _ = sent
    told = json.loads(ok(capsys, "identify", path, "--json").out)
    found = {p["name"]: p["value"] for p in told["parameters"]}
    fitted = simulated()
    for e in fitted.parameters:
        if e.name.startswith("joint_compliance") and e.value is not None:
            assert found[e.name] == pytest.approx(e.value, rel=1e-3)
    cell = path.parent / "out" / "cell.toml"
    cell.parent.mkdir()
    ok(capsys, "export", path, "--cell", cell)
    with hc.Campaign.open(path) as run:
        np.testing.assert_allclose(hc.Cell.load(cell).arm.links, run.cell.arm.links, atol=1e-12)


def test_another_robots_file_beside_the_exported_cell_is_not_replaced(
    sent: tuple[Path, CellConfig], capsys: pytest.CaptureFixture[str]
) -> None:
    path, _ = sent
    other, cell = path.parent / "own.urdf", path.parent / "cell.toml"
    other.write_text("another", encoding="utf-8")
    assert "own.urdf: another file is there" in refused(capsys, 2, "export", path, "--cell", cell)
    assert other.read_text(encoding="utf-8") == "another"
    ok(capsys, "export", path, "--cell", cell, "--force")
    assert other.read_text(encoding="utf-8").startswith("<")


def test_a_run_does_not_go_on_with_another_robot(
    sent: tuple[Path, CellConfig], tmp_path: Path
) -> None:
    path, config = sent
    with CampaignFile.open(path, read_only=True) as campaign:
        kept = campaign.about(ROBOT_FILE)
        assert kept is not None
        (tmp_path / "own.urdf").write_text(kept, encoding="utf-8")
        check_same_cell(campaign, config, tmp_path)
        (tmp_path / "own.urdf").write_text(urdf(load_arm("ur5e")), encoding="utf-8")
        with pytest.raises(InputError, match=r"own\.urdf is not what it was when"):
            check_same_cell(campaign, config, tmp_path)


def test_a_campaign_reads_no_file_that_it_names(
    sent: tuple[Path, CellConfig], tmp_path: Path
) -> None:
    """The arm is the one that is kept, whatever stands at the path now."""
    path, config = sent
    with CampaignFile.open(path, read_only=True) as file:
        kept, place = file.about(ROBOT_FILE), Path(file.base_dir)
    place.mkdir()
    (place / "own.urdf").write_text(urdf(load_arm("ur5e")), encoding="utf-8")
    with hc.Campaign.open(path) as run:
        assert run.cell.arm.name == "own"
        np.testing.assert_allclose(run.cell.arm.links[2], load_arm("ur10e").links[2], atol=1e-9)
    assert not np.allclose(
        cell_from_config(config, place).arm.links, cell_from_config(config, None, kept).arm.links
    )


def test_a_calibration_has_the_robot_beside_the_cell_that_is_given(tmp_path: Path) -> None:
    """Neither one in the working directory, nor one where the campaign says that it was."""
    there, moved, run = tmp_path / "there", tmp_path / "moved", tmp_path / "run.hilcal"
    there.mkdir()
    (there / "own.urdf").write_text(urdf(load_arm("ur10e")), encoding="utf-8")
    example = (configs_dir() / "cells" / "demo_ur10e.toml").read_text(encoding="utf-8")
    (there / "CELL.toml").write_text(example.replace('"ur10e"', '"own.urdf"'), encoding="utf-8")
    begun = hc.Procedure.at(run, hc.Cell.load(there / "CELL.toml"))
    begun.begin(Plan(("P1",), np.zeros((1, 6)), (Step("P1", "none", 0),)), begun.config)
    with CampaignFile.open(run) as file:
        assert file.about(ROBOT_FILE) == (there / "own.urdf").read_text(encoding="utf-8")
    there.rename(moved)
    there.mkdir()
    (there / "own.urdf").write_text(urdf(load_arm("ur5e")), encoding="utf-8")
    assert hc.Procedure.at(run, hc.Cell.load(moved / "CELL.toml")).next().kind == "measure"
