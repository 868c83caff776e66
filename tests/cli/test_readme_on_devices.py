"""The README's campaign over wires: every command of its blocks, on the devices of `simulate`."""

import time
from pathlib import Path

import pytest

from hilcal.config import load_config
from tests.cli.test_readme import ELSEWHERE, FEW, others
from tests.support import readme
from tests.support.cli_cases import run, start

FAST = "[simulation]\nclock = 20.0\n"
"""The world of the devices goes twenty times faster than a clock."""
READY_S = 120.0


@pytest.mark.slow
def test_every_command_on_devices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
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
            if words[0] == "validate":
                plan = ["--plan", "plan.json", "-o", "other.hilcal"]
                assert run(capsys, "run", there, *plan).code == 0
            result = run(capsys, *given)
            if words[0] == "next":
                separated = result.code == 0
                assert separated or "no suspects to separate" in result.err
                continue
            assert result.code == 0, (words, result.err)
            if "--until" in words:
                assert "standard uncertainty (rms) of the predicted deflection" in result.out
    finally:
        devices.terminate()
        devices.wait(30)
