"""The README's campaign over wires: every command of its blocks, on the devices of `simulate`."""

import time
from pathlib import Path

import pytest

from hilcal.config import load_config
from tests.cli.test_readme import ELSEWHERE, FEW, others, points, program
from tests.support import readme
from tests.support.cli_cases import run, start

FAST = "[simulation]\nclock = 20.0\n"
"""The world of the devices goes twenty times faster than a clock."""
READY_S = 120.0
TRIES = 5
DEVICE_FAILED = 3


def words_of(result):
    return " ".join(result.out.split())


def run_(capsys, words):
    return run(capsys, *words)


def measured(capsys, words):
    """Measure, and go on after a lost link, as an operator would: a busy machine loses some."""
    result = run_(capsys, words)
    for _ in range(TRIES):
        if result.code != DEVICE_FAILED:
            break
        plan = words.index("--plan") if "--plan" in words else len(words)
        words = [*words[:plan], *words[plan + 2 :]]
        words = [w for w in words if w not in ("--resume", "--append")] + ["--resume"]
        result = run_(capsys, words)
    return result


@pytest.mark.slow
def test_every_command_on_devices(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = readme.cell().replace("[planning]\n", f"[planning]\n{FEW}") + FAST
    Path("CELL.toml").write_text(text, encoding="utf-8")
    others(load_config(Path("CELL.toml")), tmp_path)
    devices = start("simulate", "CELL.toml", "-o", "DIR", cwd=tmp_path)
    try:
        there = Path("DIR/cell.toml")
        ended = time.monotonic() + READY_S
        while not there.is_file():
            assert devices.poll() is None
            assert time.monotonic() < ended, "no DIR/cell.toml"
            time.sleep(0.2)
        separated = True
        for words in readme.commands(options=True):
            if words[0] in ELSEWHERE or ("--append" in words and not separated):
                continue
            given = [str(there) if w == "CELL.toml" else w for w in words]
            if words[0] == "compensate" and words[2].endswith(".src"):
                program(Path(words[2]), Path(words[4]))
            elif words[0] == "compensate":
                points(Path(words[1]), Path(words[2]))
            if words == ["compare", "run.hilcal", "later.hilcal"]:
                later = ["--plan", "plan.json", "-o", "later.hilcal"]
                assert measured(capsys, ["run", str(there), *later]).code == 0
            if words[0] == "validate":
                plan = ["--plan", "plan.json", "-o", "other.hilcal"]
                assert measured(capsys, ["run", str(there), *plan]).code == 0
            result = (measured if words[0] == "run" else run_)(capsys, given)
            if words[0] == "next":
                separated = result.code == 0
                assert separated or "no suspects to separate" in result.err
                continue
            assert result.code == 0, (words, result.err)
            if "--until" in words:
                assert "standard uncertainty (rms) of the predicted deflection" in words_of(result)
    finally:
        devices.terminate()
        devices.communicate(timeout=30)  # closes its pipes
