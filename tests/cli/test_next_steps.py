"""Every message that names a next step names one that works: it is taken as it stands.

`TAKEN` has the tests that take the steps of each module; a module whose messages name commands and
that is not in it fails `test_every_message_is_taken`.
"""

import ast
import html
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pytest

import hilcal as hc
from hilcal.cli.commands import COMMANDS
from hilcal.store.campaign_file import CampaignFile
from tests.support.cli_cases import CELL, Outcome, ok, refused, table
from tests.support.cli_cases import run as command
from tests.support.paths import ROOT

Capsys = pytest.CaptureFixture[str]


def follow(capsys: Capsys, said: str, step: str, **places: str | Path) -> Outcome:
    """Take a step that a message names; its words in capitals stand for places."""
    assert step in " ".join(said.split()), said
    chosen = [str(places.get(word, word)) for word in shlex.split(step)]
    assert chosen[0] == "hilcal"
    return ok(capsys, *chosen[1:])


def imported(capsys: Capsys, path: Path, hidden: str = "hysteresis", seed: int = 1) -> Path:
    """A campaign without revisions, the name of which must be quoted."""
    ok(
        capsys,
        "import",
        table(path.with_suffix(".csv"), hidden, seed, 8),
        "--config",
        CELL,
        "-o",
        path,
    )
    return path


@pytest.fixture
def run(tmp_path: Path, capsys: Capsys) -> Path:
    return imported(capsys, tmp_path / "a run.hilcal")


def test_without_a_revision(run: Path, tmp_path: Path, capsys: Capsys) -> None:
    out, later = tmp_path / "p.json", imported(capsys, tmp_path / "later.hilcal", seed=2)
    for arguments in (
        ("accept", run),
        ("export", run, "--parameters", out),
        ("export", run, "--calibration", out),
        ("identify", later, "--prior", run),
    ):
        assert "hilcal identify" in refused(capsys, 2, *arguments)
    assert "hilcal identify or refine makes one" in ok(capsys, "info", run).out
    assert "hilcal identify keeps it" in " ".join(ok(capsys, "diagnose", run).err.split())
    assert "hilcal refine makes a model" in " ".join(ok(capsys, "compare", run, later).err.split())
    ok(capsys, "identify", run)
    for arguments in (("accept", run), ("export", run, "--parameters", out), ("diagnose", run)):
        assert "no revision" not in ok(capsys, *arguments).err
    ok(capsys, "refine", run)
    assert "no revision" not in ok(capsys, "compare", run, later).err


def test_readings_were_appended(run: Path, capsys: Capsys) -> None:
    ok(capsys, "identify", run)
    ok(capsys, "accept", run)
    with hc.Campaign.open(run) as opened:
        first = opened.readings[opened.readings.pose == 0]
    with CampaignFile.open(run) as file:
        file.append_readings(replace(first, pose_names=("one more", *first.pose_names[1:])))
    said = refused(capsys, 2, "diagnose", run)
    assert "run hilcal identify again" in said
    ok(capsys, "identify", run)
    follow(capsys, said, f"hilcal accept '{run}' --release")
    ok(capsys, "diagnose", run)


def test_another_scaling_or_parameters_of_another_version(run: Path, capsys: Capsys) -> None:
    ok(capsys, "identify", run, "--scaling", "gu")
    said = refused(capsys, 2, "diagnose", run)
    follow(capsys, f"{said} hilcal identify RUN", "hilcal identify RUN", RUN=run)
    ok(capsys, "diagnose", run)
    with CampaignFile.open(run) as file:
        record = file.revisions()[-1]
        stored = record.parameters_json
        names = [f"{n}_as_it_was" for n in stored["names"]]
        file.append_revision(replace(record, parameters_json={**stored, "names": names}))
    assert "other parameters; run hilcal identify again" in refused(capsys, 2, "diagnose", run)
    ok(capsys, "identify", run)
    ok(capsys, "diagnose", run)


def test_an_effect_of_ones_own(run: Path, tmp_path: Path, capsys: Capsys) -> None:
    empty, path = tmp_path / "empty.py", tmp_path / "my effect.py"
    empty.write_text("")
    said = refused(capsys, 2, "effects", "--effects-from", empty)
    assert "hilcal effects new NAME writes one" in said
    said = ok(capsys, "effects", "new", "my_effect", "-o", path).out
    for step in ("effects --effects-from", "diagnose RUN.hilcal --effects-from"):
        follow(capsys, said, f"hilcal {step} '{path}'", **{"RUN.hilcal": run})
    ok(capsys, "add", run, "my_effect", "--effects-from", path)
    path.write_text(f"{path.read_text()}\n# changed\n")
    said = refused(capsys, 2, "diagnose", run, "--effects-from", path)
    assert "fit again: hilcal identify or refine" in said
    ok(capsys, "identify", run, "--effects-from", path)
    ok(capsys, "diagnose", run, "--effects-from", path)


def test_deflections_lack_the_unloaded_arm(run: Path, tmp_path: Path, capsys: Capsys) -> None:
    ok(capsys, "identify", run, "--readings", "deflection")
    said = refused(capsys, 4, "export", run, "--urdf", tmp_path / "arm.urdf")
    follow(capsys, said, "hilcal identify RUN --readings absolute", RUN=run)
    ok(capsys, "export", run, "--urdf", tmp_path / "arm.urdf")


def test_nothing_to_carry_over(run: Path, tmp_path: Path, capsys: Capsys) -> None:
    table(csv := tmp_path / "later.csv", "hysteresis", 1, 9)
    ok(capsys, "import", csv, "--config", CELL, "-o", later := tmp_path / "later.hilcal")
    ok(capsys, "identify", run, "--readings", "absolute", "--effects", "base_frame")
    said = refused(capsys, 4, "identify", later, "--prior", run)
    assert "run hilcal refine first" in said
    ok(capsys, "refine", run)
    told = ok(capsys, "identify", later, "--prior", run)
    assert "nothing to carry over" not in told.err
    assert "--prior OTHER.hilcal" in refused(capsys, 2, "identify", later, "--drift", "creep=1")
    ok(capsys, "identify", later, "--prior", run, "--drift", "joint_compliance=1")


def test_what_a_diagnosis_says(run: Path, tmp_path: Path, capsys: Capsys) -> None:
    ok(capsys, "add", run, "hysteresis")
    ok(capsys, "add", run, "tool_compliance")
    said = ok(capsys, "diagnose", run).out
    follow(capsys, said, "hilcal remove RUN tool_compliance", RUN=run)
    assert "hilcal remove" not in ok(capsys, "diagnose", run).out


def test_what_next_says(tmp_path: Path, capsys: Capsys) -> None:
    cell, plan = tmp_path / "cell.toml", tmp_path / "PLAN.json"
    cell.write_text(re.sub(r"candidates = \d+", "candidates = 60\nagainst = []", CELL.read_text()))
    run = imported(capsys, tmp_path / "run.hilcal", "nothing")
    ok(capsys, "identify", run)
    said = refused(capsys, 4, "next", run, "-o", plan)
    places = {"CELL.toml": cell, "PLAN.json": plan}
    follow(capsys, said, f"hilcal plan CELL.toml -o PLAN.json --after {run}", **places)
    run = imported(capsys, tmp_path / "one.hilcal")
    ok(capsys, "identify", run)
    said = refused(capsys, 4, "next", run, "-o", tmp_path / "n.json")
    follow(capsys, said, f"hilcal add {run} hysteresis")


def test_what_a_comparison_says(run: Path, tmp_path: Path, capsys: Capsys) -> None:
    table(csv := tmp_path / "later.csv", "creep", 1, 9)
    ok(capsys, "import", csv, "--config", CELL, "-o", later := tmp_path / "later.hilcal")
    ok(capsys, "identify", run)
    said = command(capsys, "compare", run, later).out
    follow(capsys, said, f"hilcal refine {later} --prior '{run}'")
    said = ok(capsys, "identify", later, "--prior", run).out
    follow(capsys, said, "hilcal compare EARLIER LATER", EARLIER=run, LATER=later)


def test_files_that_are_not_there_yet(run: Path, tmp_path: Path, capsys: Capsys) -> None:
    assert "make one with: hilcal plan" in refused(
        capsys, 2, "check", CELL, "--plan", tmp_path / "plan.json"
    )
    unsafe = tmp_path / "unsafe.json"
    poses = [{"name": n, "q_rad": [9.0, -1.5, 0.5, 0.0, 0.0, 0.0]} for n in "ab"]
    steps = [{"pose": n, "load": "none", "cycle": 0} for n in "ab"]
    head = {"format": "hilcal-plan", "version": 1}
    unsafe.write_text(json.dumps({**head, "poses": poses, "steps": steps}))
    said = refused(capsys, 2, "run", CELL, "--plan", unsafe, "-o", tmp_path / "r.hilcal")
    assert "hilcal check --plan shows all" in said
    shown = command(capsys, "check", CELL, "--plan", unsafe)
    assert shown.code == 2
    assert "pose a: shoulder_pan is at 9 rad" in shown.out
    assert "pose b: shoulder_pan is at 9 rad" in shown.out
    other = tmp_path / "other.csv"
    text = run.with_suffix(".csv").read_text().splitlines()
    header = text[0].replace("q1_rad", "A1").replace("x_m", "X")
    other.write_text("\n".join([header, *text[1:]]))
    said = refused(capsys, 2, "import", other, "--config", CELL, "-o", tmp_path / "o.hilcal")
    follow(capsys, said, "hilcal import TABLE --preview", TABLE=other)
    assert "hilcal config explains every key" in command(capsys, "doctor", other).out
    follow(capsys, "hilcal config", "hilcal config")


def test_what_a_report_names(
    run: Path, tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "page.html"
    ok(capsys, "report", run, "-o", page)
    assert "hilcal refine finds the effects that are missing" in page.read_text()
    ok(capsys, "refine", run)
    ok(capsys, "report", run, "-o", page, "--appendix")
    text = html.unescape(page.read_text())
    assert "hilcal accept RUN N chooses another" in text
    monkeypatch.chdir(tmp_path)
    named = set(re.findall(r"hilcal (?:info|compare|diagnose) 'a run.hilcal'[^<]*", text))
    assert len(named) == 3
    for step in sorted(named):
        follow(capsys, text, step)
    ok(capsys, "accept", run, "1")


def test_a_campaign_that_calibrate_did_not_make(run: Path, capsys: Capsys) -> None:
    said = refused(capsys, 2, "calibrate", CELL, "-o", run)
    follow(capsys, said, f"hilcal info '{run}'")


HERE = "tests/cli/test_next_steps.py"
TAKEN = {
    "calibration/corrected": f"{HERE}::test_deflections_lack_the_unloaded_arm",
    "calibration/points": "tests/unit/calibration/test_points.py"
    "::test_poses_without_joint_values_by_a_mapping",
    "campaign/campaign": f"{HERE}::test_readings_were_appended",
    "campaign/revisions": f"{HERE}::test_another_scaling_or_parameters_of_another_version",
    "cli/campaigns": f"{HERE}::test_without_a_revision",
    "cli/comparing": f"{HERE}::test_without_a_revision",
    "cli/demo": "tests/cli/test_demo.py::test_the_demo_in_words",
    "cli/discovering": "tests/cli/test_discover.py"
    "::test_a_law_is_found_written_added_and_the_model_is_adequate",
    "cli/doctor": f"{HERE}::test_files_that_are_not_there_yet",
    "cli/exporting": f"{HERE}::test_without_a_revision",
    "cli/fits": f"{HERE}::test_nothing_to_carry_over",
    "cli/fitting": "tests/cli/test_calibrate.py",
    "cli/init": "tests/cli/test_init.py::test_the_file_is_planned_without_an_edit",
    "cli/looking_up": f"{HERE}::test_an_effect_of_ones_own",
    "cli/planning": "tests/cli/test_next_append.py",
    "cli/running": "tests/cli/test_until_goal.py::test_run_until",
    "cli/showing": "tests/cli/test_workbench_page.py"
    "::test_a_table_becomes_a_calibration_at_one_page",
    "config/cell": "tests/wire/test_polyscope_x_cell.py"
    "::test_the_controllers_kinematics_are_checked_written_stored_and_judged",
    "config/template": "tests/cli/test_init.py::test_the_file_is_planned_without_an_edit",
    "design/checked_plan": f"{HERE}::test_files_that_are_not_there_yet",
    "discovery/write_effect": "tests/cli/test_discover.py"
    "::test_a_law_is_found_written_added_and_the_model_is_adequate",
    "effects/from_file": f"{HERE}::test_an_effect_of_ones_own",
    "identification/earlier": f"{HERE}::test_another_scaling_or_parameters_of_another_version",
    "identification/learnt": f"{HERE}::test_nothing_to_carry_over",
    "identification/weight": "tests/unit/identification/test_weight.py"
    "::test_without_the_weight_they_are_too_soft_and_that_is_said",
    "measuring/kinematics": "tests/wire/test_polyscope_x_cell.py"
    "::test_the_controllers_kinematics_are_checked_written_stored_and_judged",
    "measuring/run": f"{HERE}::test_files_that_are_not_there_yet",
    "present/campaign": f"{HERE}::test_what_a_report_names",
    "present/comparison": f"{HERE}::test_what_a_comparison_says",
    "present/diagnosis": f"{HERE}::test_what_a_diagnosis_says",
    "present/discovery": f"{HERE}::test_without_a_revision",
    "present/fit": f"{HERE}::test_what_a_comparison_says",
    "present/html/certificate": f"{HERE}::test_what_a_report_names",
    "present/html/first_screen": f"{HERE}::test_another_scaling_or_parameters_of_another_version",
    "present/html/other_pages": f"{HERE}::test_what_a_comparison_says",
    "present/html/sections": f"{HERE}::test_what_a_report_names",
    "present/preparing": f"{HERE}::test_files_that_are_not_there_yet",
    "present/story": f"{HERE}::test_without_a_revision",
    "present/verdict": f"{HERE}::test_deflections_lack_the_unloaded_arm",
    "present/viewer/live_scene": f"{HERE}::test_without_a_revision",
    "procedure/state": f"{HERE}::test_a_campaign_that_calibrate_did_not_make",
    "procedure/next_plan": f"{HERE}::test_what_next_says",
    "store/campaign_file": "tests/cli/test_fit_beside_run.py",
    "store/plan": f"{HERE}::test_files_that_are_not_there_yet",
    "store/purpose": "tests/cli/test_calibrate.py",
    "store/robot_file": "tests/cli/test_robot_file.py::test_a_campaign_reads_no_file_that_it_names",
    "tables/columns": f"{HERE}::test_files_that_are_not_there_yet",
    "tables/guessing/proposal": "tests/cli/test_import_tables.py",
    "tables/parquet_stream": "tests/cli/test_import_tables.py",
    "transfer/compare": "tests/cli/test_compare.py::test_deflections_need_a_loaded_reading",
    "workbench/cards": "tests/cli/test_workbench_page.py"
    "::test_a_table_becomes_a_calibration_at_one_page",
    "workbench/guard": "tests/cli/test_workbench_page.py"
    "::test_only_the_browser_with_the_address_is_let_in",
    "workbench/session": "tests/cli/test_workbench_page.py"
    "::test_the_next_measurement_is_planned_and_the_arm_is_seen",
    "write_report": f"{HERE}::test_what_a_report_names",
}
"""The tests that take the steps that messages of a module name."""
NO_STEP = {
    "present/viewer/fleet",
    "present/viewer/plan",
    "procedure/shared",
    "store/run_log",
    "workbench/server",
}
"""Modules that name commands as where something comes from, or as a title."""


def named_in(path: Path) -> bool:
    """Whether a string of a module, no docstring and no help of an option, names a command."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    bare = {
        id(s.value) for s in ast.walk(tree) if isinstance(s, ast.Expr)
    }  # docstrings, and texts after a constant
    helps = {
        id(a)
        for c in ast.walk(tree)
        if isinstance(c, ast.Call) and getattr(c.func, "id", "") in ("option", "argument")
        for a in c.args
    }
    commands = "|".join(COMMANDS)
    return any(
        re.search(rf"\bhilcal ({commands})\b", s.value)
        for s in ast.walk(tree)
        if isinstance(s, ast.Constant)
        and isinstance(s.value, str)
        and id(s) not in bare
        and id(s) not in helps
    )


def test_every_message_is_taken() -> None:
    package = ROOT / "hilcal"
    found = {
        str(p.relative_to(package).with_suffix("")) for p in package.rglob("*.py") if named_in(p)
    }
    assert found - NO_STEP == TAKEN.keys()


@pytest.mark.parametrize("test", sorted(set(TAKEN.values())))
def test_the_tests_that_take_them_are_there(test: str) -> None:
    path, _, name = test.partition("::")
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    names = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    assert not name or name in names
