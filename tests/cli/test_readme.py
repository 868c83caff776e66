"""The README and the tutorials, done as they say."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from itertools import pairwise
from pathlib import Path

import numpy as np
import openpyxl
import pytest

from hilcal.cell import cell_from_config
from hilcal.cli import planning
from hilcal.cli.commands import COMMANDS
from hilcal.config import load_config
from hilcal.design.planner import PlanRequest, plan_readings
from hilcal.drivers.simulated.rehearsal import case_of_plan, simulate_plan
from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import load_plan, with_new_names
from hilcal.store.run_log import RunLog, create_run
from hilcal.tables.columns import joint_columns
from hilcal.tables.table import write_table
from tests.support import readme
from tests.support.cli_cases import run
from tests.support.paths import ROOT

FEW = "candidates = 60\nagainst = []\n"
"""In [planning]: so that planning takes a second."""
SEED = 3
ELSEWHERE = {"simulate", "demo", "init", "workbench"}
"""Commands of the section that other tests run."""


def test_the_blocks_are_one_cell(tmp_path):
    path = tmp_path / "CELL.toml"
    path.write_text(readme.cell(), encoding="utf-8")
    config = load_config(path)
    assert config.planning.work_min_m is not None
    assert [load.name for load in config.loads] == ["5kg"]
    assert tomllib.loads(readme.cell())["tracker"]["driver"] == "geocom"


def test_every_command_and_option_is_one_of_the_program(capsys):
    used = set()
    for words in readme.commands(options=True):
        shown = run(capsys, words[0], "--help").out
        assert all(word in shown for word in words if word.startswith("--")), words
        used.add(words[0])
    assert used <= set(COMMANDS)
    assert {"check", "plan", "run", "import", "identify", "refine", "next", "validate"} <= used


def test_the_one_command_is_as_the_readme_says(tmp_path, capsys):
    section = (ROOT / "README.md").read_text().split("\n## A real campaign by one command\n")[1]
    lines = [x.strip() for x in section.split("\n## ")[0].splitlines() if x.startswith("    ")]
    assert len(lines) == 3
    shown = run(capsys, "calibrate", "--help").out
    for line in lines:
        words = shlex.split(line, comments=True)
        assert words[:2] == ["hilcal", "calibrate"]
        assert all(w in shown for w in words if w.startswith("--"))


@pytest.mark.long
def test_every_command_in_order(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = readme.cell().replace("[planning]\n", f"[planning]\n{FEW}")
    Path("CELL.toml").write_text(text, encoding="utf-8")
    monkeypatch.setattr(planning, "connect", nobody)
    config = load_config(Path("CELL.toml"))
    others(config, tmp_path)
    shown = {}
    for words in readme.commands():
        if words[0] in ELSEWHERE:
            continue
        if words[0] == "run":
            draw(config, words)
            continue
        if words[0] == "compensate" and words[2].endswith(".src"):
            program(Path(words[2]), Path(words[4]))
        elif words[0] == "compensate":
            points(Path(words[1]), Path(words[2]))
        quick = ["--quick"] if words[0] in ("plan", "next") else []
        if "--plan" in words and words[words.index("--plan") + 1] == "next.json":
            continue
        if words == ["compare", "run.hilcal", "later.hilcal"]:
            draw(config, ["run", "CELL.toml", "--plan", "plan.json", "-o", "later.hilcal"], 9)
        result = run(capsys, *words, *quick)
        if words[0] == "next" and result.code == 4:  # nothing is hidden, nothing is in doubt
            assert "no suspects to separate" in result.err
            continue
        assert result.code == 0, (words, result.err)
        shown[" ".join(words)] = result
        if words[0] == "plan" and not Path("other.hilcal").exists():
            draw(config, ["run", "CELL.toml", "--plan", words[3], "-o", "other.hilcal"], 7)
    printed = said(shown, "plan CELL.toml -o plan.json")
    assert "joint_compliance.j1: not determined" in printed
    assert "joint 1 needs a side pull" in printed
    assert "it is not the accuracy of the robot" in printed
    assert "joint_compliance.j1" in said(shown, "identify run.hilcal")
    assert "adequate" in said(shown, "refine run.hilcal")
    assert "2 points compensated" in said(shown, "compensate run.hilcal")


def said(shown, command):
    """What the first command that begins so has printed, on one line."""
    return " ".join(next(r for c, r in shown.items() if c.startswith(command)).out.split())


def nobody(config):
    """No device is asked: their addresses are those of the README's author."""
    return None, ()


def draw(config, words, noise=1):
    """Stand in for `run`: draw the readings of a plan in a world where nothing is hidden."""
    given = dict(pairwise(words))
    path = Path(given["-o"])
    if "--resume" in words or not Path(given.get("--plan", "")).is_file():
        return  # nothing is missing; nothing was to be separated; a person is asked
    made = load_plan(Path(given["--plan"]))
    if "--append" in words:
        with CampaignFile.open(path) as c:
            first = RunLog(c).plans[0]
            RunLog(c).append(RunLog(c).with_new_names(made))
            further = with_new_names(made, first, 2)
            secret = case_of_plan(config, first, "nothing", SEED)
            c.append_readings(simulate_plan(secret, further, [SEED, 2], 3000.0).readings)
        return
    with create_run(path, config, path.absolute().parent, made) as c:
        c.append_readings(readings(config, made, noise))


def program(weld, frames):
    """Write a KRL program of one point, and what the controller keeps of its tool and base."""
    Path("corrected").mkdir()
    q = np.degrees(load_plan(Path("plan.json")).q[0])
    way = f"PTP {{{', '.join(f'A{k} {v:.4f}' for k, v in enumerate(q, 1))}}}"
    weld.write_text(f"DEF weld( )\n$TOOL = TOOL_DATA[1]\n$BASE = BASE_DATA[1]\n{way}\nEND\n")
    tool = "TOOL_DATA[1]={X 60.0,Y 20.0,Z 120.0,A 0.0,B 0.0,C 0.0}"
    base = "BASE_DATA[1]={X 0.0,Y 0.0,Z 0.0,A 0.0,B 0.0,C 0.0}"
    frames.write_text(f"DEFDAT $CONFIG PUBLIC\n{tool}\n{base}\nENDDAT\n")


def readings(config, plan, noise):
    """Readings of a plan in the one world of this file."""
    return simulate_plan(case_of_plan(config, plan, "nothing", SEED), plan, [SEED, noise]).readings


def points(run, path):
    """Write a table with two of the poses that were measured."""
    with CampaignFile.open(run, read_only=True) as c:
        q = c.readings().states.q[:2]
    header = ",".join(["pose", *joint_columns(q.shape[1])])
    rows = [",".join([name, *map(str, row)]) for name, row in zip("ab", q.tolist(), strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")


def others(config, directory):
    """Somebody else's tables: one in the exchange format, one as a spreadsheet in their units."""

    plan = plan_readings(
        cell_from_config(config), PlanRequest(8), np.random.default_rng(2)
    ).ordered.plan
    r = readings(config, plan, 5)
    write_table(r, directory / "readings.csv", INSTRUMENT_AND_ARM)
    book = openpyxl.Workbook()
    sheet = book.active
    joints = [f"A{k} [deg]" for k in range(1, 7)]
    sheet.append(["pose", "load", *joints, "X [mm]", "Y [mm]", "Z [mm]"])
    for q, x, pose, load in zip(r.states.q, r.value, r.pose, r.load, strict=True):
        row = [r.pose_names[pose], r.load_names[load], *np.rad2deg(q), *(1e3 * x)]
        sheet.append([v if isinstance(v, str) else float(v) for v in row])
    book.save(directory / "theirs.xlsx")


TRIES = 5
DEVICE_FAILED = 3


def measured(capsys, words):
    """Measure, and go on after a lost link, as an operator would: a busy machine loses some."""
    result = run(capsys, *words)
    for _ in range(TRIES):
        if result.code != DEVICE_FAILED:
            break
        plan = words.index("--plan") if "--plan" in words else len(words)
        words = [*words[:plan], *words[plan + 2 :]]
        words = [w for w in words if w not in ("--resume", "--append")] + ["--resume"]
        result = run(capsys, *words)
    return result


FOLDER = ROOT / "docs" / "tutorials"
SHELL = re.compile(r"^# !(.+)$", re.MULTILINE)
"""A line of a script that is a command of the shell in a notebook, as jupytext writes it."""


@pytest.mark.slow
@pytest.mark.parametrize("script", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_a_tutorial_runs(script, tmp_path):
    shutil.copytree(FOLDER / "data", tmp_path / "data")
    text, count = SHELL.subn(
        lambda m: f"__import__('subprocess').run({m[1]!r}, shell=True, check=True)",
        script.read_text(encoding="utf-8"),
    )
    assert count  # of the commands that a user would type
    assert "assert " in text
    (tmp_path / "cells.py").write_text(text, encoding="utf-8")
    here = str(Path(sys.executable).parent)
    path = {"PATH": f"{here}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "error", "cells.py"]
    done = subprocess.run(
        command, cwd=tmp_path, env={**os.environ, **path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_the_table_of_the_other_arm_is_what_the_simulation_gives():
    assert len(list(FOLDER.glob("*.py"))) == 3
    from hilcal.cell import Cell
    from studies.another_arm import CELL, table

    kept = (FOLDER / "data" / "irb120.csv").read_bytes().decode("utf-8")
    assert table(Cell.load(CELL)) == kept
