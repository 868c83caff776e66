"""A disk that fills up while a command writes: the old file is whole, or there is none."""

import os
import pty
import resource
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

import hilcal as hc
from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.tables.table import write_table
from tests.support.cli_cases import CELL, ok, rehearsal, run, stored_readings
from tests.support.paths import ROOT
from tests.support.rows import first

POINTS = "pose,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad\n" + "\n".join(
    f"w{k},{0.1 + 0.01 * k},-1.2,1.4,-1.7,-1.5,0.2" for k in range(40)
)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A folder with a campaign of one revision, points and a table."""
    folder = tmp_path_factory.mktemp("full")
    readings = rehearsal("nothing").readings
    path = stored_readings(folder / "run.hilcal", readings, covers=INSTRUMENT_AND_ARM)
    with hc.Campaign.open(path) as opened:
        model = hc.baseline(opened.cell, opened.readings, "absolute")
        opened.append(hc.fit(model, opened.readings, "absolute"))
        opened.calibration().compensate(readings.states.q[:1])  # keeps machine code on the disk
    (folder / "points.csv").write_text(POINTS)
    write_table(readings, folder / "table.csv", INSTRUMENT_AND_ARM)
    return folder


@contextmanager
def full_after(size):
    """No file grows beyond a size: writes fail in the system, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_an_import_that_finds_no_room_leaves_the_campaign_that_was_there(
    capsys, fitted, monkeypatch
):
    """Whatever room there is: for nothing, for an empty campaign, for some readings."""
    monkeypatch.chdir(fitted)
    old, new = Path("old.hilcal"), Path("new.hilcal")
    old.write_bytes(Path("run.hilcal").read_bytes())
    ok(capsys, "import", "table.csv", "--config", CELL, "-o", new)
    whole, kept = new.stat().st_size, old.read_bytes()
    new.unlink()
    here = set(Path().iterdir())
    for size in (0, whole // 2, whole - 4096):
        for output, force in ((old, ["--force"]), (new, [])):
            with full_after(size):
                ended = run(capsys, "import", "table.csv", "--config", CELL, "-o", output, *force)
            assert ended.code == 3
            assert f"error: {output}: cannot be written" in ended.err
            assert old.read_bytes() == kept
            assert set(Path().iterdir()) == here


@pytest.mark.long
def test_output_that_finds_no_room_is_one_line(fitted):
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            [sys.executable, "-m", "hilcal", "info", str(fitted / "run.hilcal")],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=full,
            stderr=subprocess.PIPE,
            check=False,
            text=True,
        )
    assert ended.returncode == 3
    assert "cannot be written (No space left on device): make room" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize("missing", first(1, [False, True]))
def test_a_command_whose_reader_has_left_goes_on_to_its_end(fitted, tmp_path, missing):
    """As in `hilcal ... | head -1`: the file is written, and the exit code is the command's own."""
    reader, writer = os.pipe()
    os.close(reader)
    points = fitted / ("none.csv" if missing else "points.csv")
    words = ["compensate", str(fitted / "run.hilcal"), str(points), "-o", str(tmp_path / "o.csv")]
    with os.fdopen(writer, "wb") as nobody:
        ended = subprocess.run(
            [sys.executable, "-m", "hilcal", *words],
            cwd=ROOT, stdout=nobody, stderr=nobody, check=False, timeout=120,
        )  # fmt: skip
    assert ended.returncode == (2 if missing else 0)
    assert (tmp_path / "o.csv").exists() is not missing


@pytest.mark.parametrize(
    ("words", "code"), first(1, [(("info", "no.hilcal"), 2), (("effects",), 0)])
)
def test_a_command_whose_terminal_is_closed_ends_with_its_own_exit_code(tmp_path, words, code):
    """Its streams fail then, with EIO."""
    master, slave = pty.openpty()
    os.close(master)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ended = subprocess.run(
        [sys.executable, "-m", "hilcal", *words],
        cwd=tmp_path, stdin=slave, stdout=slave, stderr=slave, env=environment, check=False,
    )  # fmt: skip
    os.close(slave)
    assert ended.returncode == code


@pytest.mark.parametrize("closed", first(1, ["<&- >&- 2>&-", "<&-", ">&-", "2>&-"]))
def test_a_command_whose_streams_are_closed_opens_no_file_in_their_place(fitted, closed):
    """Child processes would write into it what they say."""
    code = (
        "import sys, os, typer; from hilcal import cli; app = typer.Typer()\n"
        "@app.command()\n"
        "def f(): print('x'); os.open('run.hilcal', os.O_RDONLY) > 2 or os._exit(1)\n"
        "cli.execute(lambda: app, 'f', [])"
    )
    ended = subprocess.run(
        ["sh", "-c", f'"$0" -c "$1" {closed}', sys.executable, code],
        cwd=fitted, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False,
    )  # fmt: skip
    assert ended.returncode == 0


def test_a_key_that_types_half_a_character_is_no_answer_and_no_failure():
    """As a letter of Latin-1, or one of two bytes of which Backspace has deleted one."""
    code = (
        "import typer; from hilcal import cli\n"
        "from hilcal.cli.terminal import confirmed, terminal\n"
        "app = typer.Typer()\n"
        "@app.command()\n"
        "def f(): assert confirmed(terminal(False), 'Go?')\n"
        "cli.execute(lambda: app, 'f', [])"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "utf-8:strict"}
    ended = subprocess.run(
        [sys.executable, "-c", code],
        input=b"\xc3\ny\n", env=environment, check=False, capture_output=True,
    )  # fmt: skip
    assert (ended.returncode, ended.stderr.count(b"is not an answer")) == (0, 1)


def test_a_directory_that_has_been_deleted_is_named(tmp_path):
    shutil.copy(ROOT / "configs" / "cells" / "demo_ur10e.toml", tmp_path / "cell.toml")
    line = 'mkdir gone; cd gone; rmdir ../gone; "$0" -m hilcal check ../cell.toml'
    ended = subprocess.run(
        ["sh", "-c", line, sys.executable],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False,
        text=True, capture_output=True,
    )  # fmt: skip
    assert (ended.returncode, ended.stderr.splitlines()[-1]) == (
        2, "error: the working directory has been deleted: change to another one",
    )  # fmt: skip
