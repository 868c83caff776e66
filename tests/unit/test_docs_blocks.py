"""Every block of the how-to pages is what the program takes: cells, arms, drivers, effects."""

import sys
import tomllib
from pathlib import Path
from textwrap import dedent
from types import ModuleType
from typing import Any

import pytest

from hilcal.config import CellConfig, load_config
from hilcal.effects.catalogue import ENTRY_POINT_GROUP
from hilcal.measuring.devices import TRACKERS
from hilcal.robot.catalogue import load_arm
from hilcal.store.campaign_file import CampaignFile
from hilcal.toml import check_section
from studies.random_campaigns import rehearse
from tests.support import readme
from tests.support.cli_cases import CELL, ok
from tests.support.paths import ROOT
from tests.unit.test_docs import blocks

HOW_TO = ROOT / "docs" / "how-to"


def in_a_cell(text: str) -> CellConfig:
    """The README's cell with the sections of a block in place of its own."""
    cell: dict[str, Any] = tomllib.loads(readme.cell())
    return check_section({**cell, **tomllib.loads(text)}, CellConfig, "block")


def test_the_cells_of_the_guides_are_accepted() -> None:
    urdf, _, signs = blocks(HOW_TO / "add-a-robot.md", "toml")
    assert in_a_cell(urdf).robot.tip_link == "tool0"
    assert in_a_cell(signs).robot.joint_sign == (1, 1, 1, -1, 1, 1)
    _, driver = blocks(HOW_TO / "add-a-device.md", "toml")
    assert in_a_cell(driver).tracker.options == {"averaging": 4}
    text = (HOW_TO / "measure-several-targets.md").read_text(encoding="utf-8")
    lines = [line[4:] for line in text.splitlines() if line.startswith("    ")]
    assert [t.name for t in in_a_cell("\n".join(lines)).tool.targets] == ["R1", "R2", "R3"]


def test_the_arm_of_the_guide_is_an_arm(tmp_path: Path) -> None:
    path = tmp_path / "my_arm.toml"
    path.write_text(blocks(HOW_TO / "add-a-robot.md", "toml")[1], encoding="utf-8")
    assert load_arm(str(path)).n == 1


def test_the_entry_points_of_the_guides_are_those_that_are_read() -> None:
    found = {}
    for page in ("add-a-device.md", "add-an-effect.md"):
        for text in blocks(HOW_TO / page, "toml"):
            found |= tomllib.loads(text).get("project", {}).get("entry-points", {})
    assert set(found) == {TRACKERS, ENTRY_POINT_GROUP}


def test_the_driver_of_the_guide_opens_and_reports() -> None:
    (code,) = blocks(HOW_TO / "add-a-device.md")
    known: dict[str, Any] = {"__name__": "mytracker"}
    exec(dedent(code), known)
    tracker = known["open_tracker"](load_config(CELL))
    assert tracker.report().device == "tracker"


def test_the_commands_of_the_guide_to_effects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    guide = HOW_TO / "add-an-effect.md"
    monkeypatch.chdir(tmp_path)
    config = load_config(CELL)
    with CampaignFile.create("run.hilcal", config.to_json(), str(CELL.parent), "test") as file:
        file.append_readings(rehearse(config, "nothing", 3, 6).readings)
    lines = guide.read_text(encoding="utf-8").splitlines()
    commands = [line.split("#")[0].split()[1:] for line in lines if line.startswith("    hilcal ")]
    rehearsed = [words for words in commands if words[0] in ("demo", "simulate")]
    assert [words[0] for words in commands[: -len(rehearsed) or None]] == ["effects", "diagnose"]
    for words in commands:
        if words not in rehearsed:  # hiding an effect of one's own: test_own_law
            ok(capsys, *words)
    module = ModuleType("cable_pull")
    law, check, *_ = blocks(guide)
    exec(law, module.__dict__)
    monkeypatch.setitem(sys.modules, "cable_pull", module)
    known: dict[str, Any] = {}
    exec(check, known)
    known["test_the_law_is_consistent"]()
