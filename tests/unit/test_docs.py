"""The documents: links lead somewhere, their Python runs, each block is what the program takes."""

import re
import sys
import tomllib
from pathlib import Path
from textwrap import dedent
from types import ModuleType

import pytest

import hilcal as hc
from hilcal.config import CellConfig
from hilcal.config.reference import to_toml
from hilcal.effects.catalogue import ENTRY_POINT_GROUP
from hilcal.measuring.devices import TRACKERS
from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.robot.catalogue import configs_dir, load_arm
from hilcal.store.campaign_file import CampaignFile
from hilcal.tables.mapping import Mapping
from hilcal.tables.table import write_table
from hilcal.toml import check_section
from studies.page_figures import NAMES
from studies.random_campaigns import rehearse
from tests.support import readme
from tests.support.campaigns import configuration
from tests.support.cli_cases import ok, quickly_planned, stored_readings
from tests.support.paths import ROOT

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
HOW_TO = ROOT / "docs" / "how-to"
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.py"))


def blocks(path, language="python"):
    """Fenced code of a document."""
    return re.findall(
        rf"^ *```{language}\n(.*?)^ *```$", path.read_text(), re.DOTALL | re.MULTILINE
    )


@pytest.mark.parametrize("path", [*DOCUMENTS, *TUTORIALS], ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_to_files_of_the_tree(path):
    links = re.findall(r"\]\(([^)#:]+)\)", path.read_text())
    drawn = {ROOT / "docs" / name for name in NAMES}  # in the build of the site
    places = [(path.parent / link).resolve() for link in links]
    assert [place for place in places if not place.exists() and place not in drawn] == []


def test_each_figure_that_is_drawn_is_on_a_page():
    text = "".join(path.read_text() for path in DOCUMENTS)
    assert [name for name in NAMES if f"/{name})" not in text] == []


@pytest.fixture
def campaign_of(tmp_path, monkeypatch):
    """Go to a folder, and make run.hilcal of so many poses with an effect there."""
    monkeypatch.chdir(tmp_path)

    def make(effect, poses, config=None):
        config = config or configuration()
        stored_readings(Path("run.hilcal"), rehearse(config, effect, 3, poses).readings, config)

    return make


def test_the_effect_of_the_guide_is_a_working_effect():
    code = blocks(HOW_TO / "add-an-effect.md")
    known = {"__name__": "cable_pull"}
    exec(code[0], known)
    effect = known["CablePull"]
    assert issubclass(effect, hc.Effect)
    hc.check_effect(effect)


@pytest.mark.long
def test_the_guide_to_the_library_runs_as_it_stands(campaign_of, monkeypatch):
    config = quickly_planned(configuration())
    campaign_of("creep", 10, config)
    Path("CELL.toml").write_text(to_toml(config), encoding="utf-8")
    with CampaignFile.open("run.hilcal") as file:
        write_table(file.readings(), Path("readings.csv"), INSTRUMENT_AND_ARM)
    pyplot = ModuleType("matplotlib.pyplot")
    drawn = []
    monkeypatch.setattr(pyplot, "plot", lambda *given: drawn.append(given), raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", ModuleType("matplotlib"))
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", pyplot)
    known = {}
    for code in blocks(HOW_TO / "use-the-library.md"):
        exec(code, known)
    assert len(drawn) == 1
    assert Path("plan.json").is_file()
    with hc.Campaign.open("run.hilcal") as run:
        assert "creep" in run.fit().model.names


def test_the_python_of_the_readme_runs_as_it_stands(campaign_of, capsys):
    section = (ROOT / "README.md").read_text().split("\n## From Python\n")[1].split("\n## ")[0]
    code = "\n".join(line[4:] for line in section.splitlines() if line.startswith("    "))
    campaign_of("joint_tilt_compliance", 10)
    exec(code, {})
    assert "missing_effect" in capsys.readouterr().out
    with hc.Campaign.open("run.hilcal") as run:
        assert "joint_tilt_compliance" in run.fit().model.names


@pytest.mark.parametrize(
    ("name", "printed"), [("compensate.md", "e-0"), ("hand-over.md", "encoder_offset.j2")]
)
def test_the_guides_to_compensation_and_handing_over_run_as_they_stand(
    name, printed, campaign_of, capsys
):
    guide = HOW_TO / name
    campaign_of("nothing", 20)
    given = ("--effects", "joint_compliance,encoder_offset")
    ok(capsys, "identify", "run.hilcal", "--readings", "absolute", *given)
    for table in blocks(guide, "csv"):
        Path("points.csv").write_text(table)
    for line in "".join(blocks(guide, "sh")).splitlines():
        ok(capsys, *line.split()[1:])
    if name == "compensate.md":
        written = ("corrected.csv", "corrected.script", "corrected.json", "arm.urdf", "arm.yaml")
        assert min(Path(name).stat().st_size for name in (*written, "frames.json")) > 100
    else:
        with hc.Campaign.open("run.hilcal") as a, hc.Campaign.open("again.hilcal") as b:
            assert a.file.data_hash() == b.file.data_hash()
        assert "tracker_in_base_mm_rad" in Path("frames.json").read_text()
    (code,) = blocks(guide)
    exec(code, {})
    assert printed in capsys.readouterr().out


def test_the_guide_to_imports_is_what_the_commands_do(tmp_path, monkeypatch, capsys):
    guide = HOW_TO / "import-a-table.md"
    monkeypatch.chdir(tmp_path)
    Path("CELL.toml").write_bytes((configs_dir() / "cells" / "demo_ur10e.toml").read_bytes())
    tracker, robot, bar = blocks(guide, "csv")
    for name, text in (("tracker.csv", tracker), ("robot.csv", robot)):
        Path(name).write_text(text, encoding="utf-8")
    commands = [text.split()[1:] for text in blocks(guide, "console")]
    for command in commands:
        ok(capsys, *command)
    proposed, more = blocks(guide, "toml")
    assert tomllib.loads(Path("mapping.toml").read_text()) == tomllib.loads(proposed)
    cell = hc.Cell.load("CELL.toml")
    readings = hc.read_table("tracker.csv", cell, "mapping.toml")
    assert (len(readings), readings.m, readings.load_names) == (8, 6, ("none", "5 kg"))
    joints = {"columns": [f"A{k} [°]" for k in range(1, 7)], "unit": "deg"}
    bars = check_section({"joints": joints, **tomllib.loads(more)}, Mapping, "block")
    used = {*bars.joints.columns, *bars.torques.columns, bars.distance.column}
    used |= {bars.distance.name_column, bars.distance.std_column}
    assert used <= set(bar.strip().split(";"))


def in_a_cell(text):
    """The README's cell with the sections of a block in place of its own."""
    cell = tomllib.loads(readme.cell())
    return check_section({**cell, **tomllib.loads(text)}, CellConfig, "block")


def test_the_cells_of_the_guides_are_accepted():
    urdf, _, _, signs, factory = blocks(HOW_TO / "add-a-robot.md", "toml")
    assert in_a_cell(factory).robot.kinematics == "factory"
    assert in_a_cell(urdf).robot.tip_link == "tool0"
    assert in_a_cell(signs).robot.joint_sign == (1, 1, 1, -1, 1, 1)
    _, driver = blocks(HOW_TO / "add-a-device.md", "toml")
    assert in_a_cell(driver).tracker.options == {"averaging": 4}
    text = (HOW_TO / "measure-several-targets.md").read_text(encoding="utf-8")
    lines = [line[4:] for line in text.splitlines() if line.startswith("    ")]
    assert [t.name for t in in_a_cell("\n".join(lines)).tool.targets] == ["R1", "R2", "R3"]


def test_the_arm_of_the_guide_is_an_arm(tmp_path):
    path = tmp_path / "my_arm.toml"
    _, arm, track, *_ = blocks(HOW_TO / "add-a-robot.md", "toml")
    path.write_text(arm, encoding="utf-8")
    assert load_arm(str(path)).n == 1
    path.write_text(f"{arm}\n{track}", encoding="utf-8")
    assert load_arm(str(path)).units == ("rad", "m")


def test_the_driver_of_the_guide_reports_and_entry_points_are_those_that_are_read():
    (code,) = blocks(HOW_TO / "add-a-device.md")
    known = {"__name__": "mytracker"}
    exec(dedent(code), known)
    tracker = known["open_tracker"](configuration())
    assert tracker.report().device == "tracker"
    groups = {}
    for page in ("add-a-device.md", "add-an-effect.md"):
        for text in blocks(HOW_TO / page, "toml"):
            groups |= tomllib.loads(text).get("project", {}).get("entry-points", {})
    assert set(groups) == {TRACKERS, ENTRY_POINT_GROUP}


def test_the_commands_of_the_guide_to_effects(campaign_of, monkeypatch, capsys):
    guide = HOW_TO / "add-an-effect.md"
    campaign_of("nothing", 6)
    lines = guide.read_text(encoding="utf-8").splitlines()
    commands = [line.split("#")[0].split()[1:] for line in lines if line.startswith("    hilcal ")]
    rehearsed = [words for words in commands if words[0] in ("demo", "simulate")]
    assert [words[0] for words in commands[: -len(rehearsed) or None]] == ["effects", "diagnose"]
    for words in commands:
        if words not in rehearsed:  # hiding an effect of one's own: test_user_effect
            ok(capsys, *words)
    module = ModuleType("cable_pull")
    law, check, *_ = blocks(guide)
    exec(law, module.__dict__)
    monkeypatch.setitem(sys.modules, "cable_pull", module)
    known = {}
    exec(check, known)
    known["test_the_law_is_consistent"]()
