"""Campaigns for the tests of the command line, and a way to run it."""

import atexit
import contextlib
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from hilcal.cli import main
from hilcal.config import load_config
from hilcal.readings.covariance import COVERS_KEY, INSTRUMENT_AND_ARM
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from hilcal.tables.table import write_table
from studies.__main__ import main as studies
from studies.random_campaigns import rehearse

Capsys = pytest.CaptureFixture[str]
CELL = configs_dir() / "cells" / "demo_ur10e.toml"
POSES = 14


def quickly_planned(config):
    """The same cell, whose plans take a second: few candidates, no effect to look out for."""
    return config.with_keys("planning", candidates=60, against=())


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str

    @property
    def document(self):
        """What stdout holds: one JSON document and nothing else."""
        return dict(json.loads(self.out))


def run(capsys, *arguments):
    """Run a command in this process; one of `python -m studies` where it begins with "studies"."""
    capsys.readouterr()
    command, given = (
        (studies, arguments[1:]) if arguments[:1] == ("studies",) else (main, arguments)
    )
    with pytest.raises(SystemExit) as ended:
        command([str(a) for a in given])
    captured = capsys.readouterr()
    assert isinstance(ended.value.code, int)
    return Outcome(ended.value.code, captured.out, captured.err)


def ok(capsys, *arguments):
    result = run(capsys, *arguments)
    assert result.code == 0, result.err
    return result


def done(*arguments):
    """Run a command that must succeed, where a fixture makes something once for many tests."""
    with (
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()) as said,
        pytest.raises(SystemExit) as ended,
    ):
        main([str(a) for a in arguments])
    assert ended.value.code == 0, said.getvalue()


def refused(capsys, code, *arguments):
    """Run a command that must be refused; returns the one line on stderr that says why."""
    result = run(capsys, *arguments)
    assert result.code == code, result
    assert result.out == ""
    lines = [line for line in result.err.splitlines() if not line.startswith("[")]
    assert len(lines) == 1, result.err
    assert lines[0].startswith("error: ")
    assert "Traceback" not in result.err
    return lines[0]


def start(*arguments, **options):
    """Start the program as a process of its own."""
    root = str(Path(__file__).resolve().parents[2])
    return subprocess.Popen(
        [sys.executable, "-m", "hilcal", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": root, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def rehearsal(hidden, seed=1, poses=POSES):
    return rehearse(load_config(CELL), hidden, seed, poses)


def stored_readings(path, readings, config=None, covers=None):
    """Write a campaign file that holds readings alone; in the cell of the demo unless given."""
    content, base_dir = (config or load_config(CELL)).to_json(), str(CELL.parent)
    more = {} if covers is None else {COVERS_KEY: covers}
    CampaignFile.create(
        path, content, base_dir, "a test", overwrite=True, more_texts=more, readings=readings
    ).close()
    return path


def table(path, hidden, seed=1, poses=POSES):
    write_table(rehearsal(hidden, seed, poses).readings, path, INSTRUMENT_AND_ARM)
    return path


@cache
def _imported(hidden, seed, poses, then):
    """A campaign as a command has left it; made once in a process."""
    folder = Path(tempfile.mkdtemp(prefix="hilcal-tests-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    run = folder / "run.hilcal"
    if then:
        shutil.copy(_imported(hidden, seed, poses, ()), run)
        done(then[0], run, *then[1:])
    else:
        csv = table(folder / "run.csv", hidden, seed, poses)
        done("import", csv, "--config", CELL, "-o", run)
    return run


def imported(path, hidden="hysteresis", seed=1, poses=8, then=()):
    """A campaign imported from a table into the cell of the demo, and what one command adds.

    The table lies beside the campaign.
    """
    made = _imported(hidden, seed, poses, tuple(then))
    shutil.copy(made, path)
    shutil.copy(_imported(hidden, seed, poses, ()).with_suffix(".csv"), path.with_suffix(".csv"))
    return path
