"""The documents: links lead somewhere, and the Python in them runs."""

import re
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

import hilcal as hc
from hilcal.config import load_config
from hilcal.config.write import to_toml
from hilcal.readings.covariance import WHOLE
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from hilcal.tables.table import write_table
from studies.random_campaigns import rehearse
from tests.support.cli_cases import ok, quickly_planned
from tests.support.paths import ROOT

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(path: Path, language: str = "python") -> list[str]:
    """Fenced code of a document."""
    return re.findall(
        rf"^ *```{language}\n(.*?)^ *```$", path.read_text(), re.DOTALL | re.MULTILINE
    )


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_to_files_of_the_tree(path: Path) -> None:
    links = re.findall(r"\]\(([^)#:]+)\)", path.read_text())
    missing = [link for link in links if not (path.parent / link).exists()]
    assert missing == []


def test_the_effect_of_the_guide_is_a_working_effect() -> None:
    code = blocks(ROOT / "docs" / "how-to" / "add-an-effect.md")
    known: dict[str, object] = {"__name__": "cable_pull"}
    exec(code[0], known)
    effect = known["CablePull"]
    assert isinstance(effect, type)
    assert issubclass(effect, hc.Effect)
    hc.check_effect(effect)


def test_the_guide_to_the_library_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell = configs_dir() / "cells" / "demo_ur10e.toml"
    config = quickly_planned(load_config(cell))
    readings = rehearse(config, "creep", 3, 10).readings
    monkeypatch.chdir(tmp_path)
    Path("CELL.toml").write_text(to_toml(config), encoding="utf-8")
    write_table(readings, Path("readings.csv"), WHOLE)
    with CampaignFile.create("run.hilcal", config.to_json(), str(cell.parent), "test") as file:
        file.append_readings(readings)
    pyplot = ModuleType("matplotlib.pyplot")
    drawn: list[object] = []
    monkeypatch.setattr(pyplot, "plot", lambda *given: drawn.append(given), raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", ModuleType("matplotlib"))
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", pyplot)
    known: dict[str, object] = {}
    for code in blocks(ROOT / "docs" / "how-to" / "use-the-library.md"):
        exec(code, known)
    assert len(drawn) == 1
    assert Path("plan.json").is_file()
    with hc.Campaign.open("run.hilcal") as run:
        assert "creep" in run.fit().model.names


def test_the_python_of_the_readme_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    section = (ROOT / "README.md").read_text().split("\n## From Python\n")[1].split("\n## ")[0]
    code = "\n".join(line[4:] for line in section.splitlines() if line.startswith("    "))
    cell = configs_dir() / "cells" / "demo_ur10e.toml"
    config = load_config(cell)
    monkeypatch.chdir(tmp_path)
    with CampaignFile.create("run.hilcal", config.to_json(), str(cell.parent), "test") as file:
        file.append_readings(rehearse(config, "joint_tilt_compliance", 3, 10).readings)
    exec(code, {})
    assert "missing_effect" in capsys.readouterr().out
    with hc.Campaign.open("run.hilcal") as run:
        assert "joint_tilt_compliance" in run.fit().model.names


def test_the_guide_to_compensation_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    guide = ROOT / "docs" / "how-to" / "compensate.md"
    cell = configs_dir() / "cells" / "demo_ur10e.toml"
    config = load_config(cell)
    monkeypatch.chdir(tmp_path)
    with CampaignFile.create("run.hilcal", config.to_json(), str(cell.parent), "test") as file:
        file.append_readings(rehearse(config, "nothing", 3, 20).readings)
    given = ("--effects", "joint_compliance,encoder_offset")
    ok(capsys, "identify", "run.hilcal", "--readings", "absolute", *given)
    (table,) = blocks(guide, "csv")
    Path("points.csv").write_text(table)
    for line in "".join(blocks(guide, "sh")).splitlines():
        ok(capsys, *line.split()[1:])
    written = ("corrected.csv", "corrected.script", "corrected.json", "arm.urdf", "arm.yaml")
    for name in (*written, "frames.json"):
        assert Path(name).stat().st_size > 100
    (code,) = blocks(guide)
    exec(code, {})
    assert "e-0" in capsys.readouterr().out


def test_the_guide_to_handing_over_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    guide = ROOT / "docs" / "how-to" / "hand-over.md"
    cell = configs_dir() / "cells" / "demo_ur10e.toml"
    config = load_config(cell)
    monkeypatch.chdir(tmp_path)
    with CampaignFile.create("run.hilcal", config.to_json(), str(cell.parent), "test") as file:
        file.append_readings(rehearse(config, "nothing", 3, 20).readings)
    given = ("--effects", "joint_compliance,encoder_offset")
    ok(capsys, "identify", "run.hilcal", "--readings", "absolute", *given)
    for line in "".join(blocks(guide, "sh")).splitlines():
        ok(capsys, *line.split()[1:])
    with hc.Campaign.open("run.hilcal") as a, hc.Campaign.open("again.hilcal") as b:
        assert a.file.data_hash() == b.file.data_hash()
    (code,) = blocks(guide)
    exec(code, {})
    assert "encoder_offset.j2" in capsys.readouterr().out
    assert "tracker_in_base_mm_rad" in Path("frames.json").read_text()


def test_the_guide_to_imports_is_what_the_commands_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    guide = ROOT / "docs" / "how-to" / "import-a-table.md"
    monkeypatch.chdir(tmp_path)
    Path("CELL.toml").write_bytes((configs_dir() / "cells" / "demo_ur10e.toml").read_bytes())
    for name, text in zip(("tracker.csv", "robot.csv"), blocks(guide, "csv"), strict=True):
        Path(name).write_text(text, encoding="utf-8")
    commands = [text.split()[1:] for text in blocks(guide, "console")]
    for command in commands:
        ok(capsys, *command)
    (proposed,) = blocks(guide, "toml")
    assert tomllib.loads(Path("mapping.toml").read_text()) == tomllib.loads(proposed)
    cell = hc.Cell.load("CELL.toml")
    readings = hc.read_table("tracker.csv", cell, "mapping.toml")
    assert (len(readings), readings.m, readings.load_names) == (8, 6, ("none", "5 kg"))


def test_the_first_example_of_the_library_is_short() -> None:
    """A fit, its diagnosis and a plot of the residuals with one import of hilcal."""
    first = blocks(ROOT / "docs" / "how-to" / "use-the-library.md")[0]
    assert len([line for line in first.splitlines() if line.strip()]) <= 8
