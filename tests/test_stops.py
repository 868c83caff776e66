"""A campaign that is stopped, in every way, at every moment; and then goes on.

The arm stands within half a second, no process is left, and the resumed campaign has every
reading exactly once.
"""

import signal
import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from campaign_cases import Run, Site, failed, finish, right, site, stopped_within, whole

from hilcal.data.campaign import Campaign
from hilcal.data.run_log import RunLog

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("stops")]

KILLS = 3
KILLS_SLOW = 100
LONGEST = 9.0
"""The moment of a kill is drawn up to here, s after the start; a run takes longer."""


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with site(tmp_path_factory.mktemp("stops"), poses=4) as made:
        yield made


@pytest.fixture(autouse=True)
def nothing_goes_on(cell: Site) -> Iterator[None]:
    yield
    cell.end_runs()


@pytest.fixture(scope="module")
def path(cell: Site) -> Path:
    return cell.directory / "run.hilcal"


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_plea_to_end_stops_the_arm_first(kind: signal.Signals, cell: Site, path: Path) -> None:
    run = Run(cell, path)
    run.some_readings()
    run.moving()
    since = time.monotonic()
    if kind == signal.SIGINT:
        run.interrupt()  # a terminal sends it to the whole group
    else:
        run.process.send_signal(kind)
    assert "interrupted" in failed(run, 130)
    stopped_within(cell, since)
    right(cell, path)
    with Campaign.open(path) as campaign:
        assert RunLog(campaign).events()[-1]["kind"] == "interrupted"


def test_ctrl_c_twice_in_a_row_stops_it_too(cell: Site, path: Path) -> None:
    run = Run(cell, path)
    run.some_readings()
    run.moving()
    since = time.monotonic()
    run.interrupt()
    time.sleep(0.05)
    run.interrupt()
    code, words = run.end()
    assert code in (3, 130)
    assert "Traceback" not in words
    stopped_within(cell, since)
    assert run.left_behind() == []
    right(cell, path)


def _kill_at_random(cell: Site, path: Path, kills: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for moment in rng.uniform(0.0, LONGEST, kills):
        run = Run(cell, path)
        end = time.monotonic() + moment
        while time.monotonic() < end and run.process.poll() is None:
            run.family()
            time.sleep(0.02)
        since = time.monotonic()
        run.kill()
        run.process.wait()
        assert run.left_behind() == []
        if cell.ask("arm", "state")["moving"]:
            stopped_within(cell, since)
        if path.exists():
            _sound(path)


def _sound(path: Path) -> None:
    with Campaign.open(path) as campaign:
        log = RunLog(campaign)
        assert campaign.n_readings == len(log.done()) == len(log.details())


def test_kill_minus_nine_at_random_moments(cell: Site, tmp_path: Path) -> None:
    short = cell.shorter(tmp_path, poses=2)
    path = tmp_path / "killed.hilcal"
    _kill_at_random(short, path, KILLS, 1)
    finish(short, path)


@pytest.mark.slow
def test_kill_minus_nine_at_a_hundred_random_moments(cell: Site, tmp_path: Path) -> None:
    long = cell.shorter(tmp_path, poses=60)
    path = tmp_path / "killed.hilcal"
    _kill_at_random(long, path, KILLS_SLOW, 2)
    finish(long, path)


def test_a_full_disk_stops_the_arm_and_loses_nothing(cell: Site, tmp_path: Path) -> None:
    short = cell.shorter(tmp_path, poses=1)
    path = tmp_path / "full.hilcal"
    run = Run(short, path, limit=56 << 10)
    line = failed(run)
    assert "make room on the disk" in line
    assert not cell.ask("arm", "state")["moving"]
    finish(short, path)


def test_two_programs_at_one_cell(cell: Site, tmp_path: Path) -> None:
    short = cell.shorter(tmp_path, poses=2)
    first = Run(short, tmp_path / "first.hilcal")
    first.some_readings()
    second = Run(short, tmp_path / "second.hilcal")
    line = failed(second)
    assert line.count("in use by another program") == 2  # both serial ports
    code, words = first.end()
    assert code == 0, words
    whole(short, tmp_path / "first.hilcal")


def test_two_programs_at_one_campaign_file(cell: Site, tmp_path: Path) -> None:
    short = cell.shorter(tmp_path, poses=1)
    path = tmp_path / "locked.hilcal"
    run = Run(short, path)
    run.some_readings()
    with sqlite3.connect(path, isolation_level=None) as other:
        other.execute("BEGIN EXCLUSIVE")
        line = failed(run, 2)
        other.execute("ROLLBACK")
    other.close()
    assert "another program" in line
    assert not cell.ask("arm", "state")["moving"]
    finish(short, path)


def test_the_stopped_campaign_has_every_reading_exactly_once(cell: Site, path: Path) -> None:
    finish(cell, path)
