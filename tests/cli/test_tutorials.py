"""The tutorials run as they stand: their claims are asserted in them."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT

FOLDER = ROOT / "docs" / "tutorials"
SHELL = re.compile(r"^# !(.+)$", re.MULTILINE)
"""A line of a script that is a command of the shell in a notebook, as jupytext writes it."""


def test_there_are_three():
    assert len(list(FOLDER.glob("*.py"))) == 3


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
    from hilcal.cell import Cell
    from studies.another_arm import CELL, table

    kept = (FOLDER / "data" / "irb120.csv").read_bytes().decode("utf-8")
    assert table(Cell.load(CELL)) == kept
