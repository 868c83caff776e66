"""A campaign that is stopped, in every way, at every moment; and then goes on.

The arm stands within half a second, no process is left, and the resumed campaign has every
reading exactly once.
"""

import re
import signal
import sqlite3
import time
from contextlib import closing

import numpy as np
import pytest

from hilcal.store.campaign_file import CampaignFile
from hilcal.store.run_log import RunLog
from tests.support import campaign_cases as cases

pytestmark = pytest.mark.usefixtures("nothing_goes_on")

LONGEST = 5.0  # the moment of a kill is drawn up to here, s; a run takes longer
SLOW = 0.3  # position of the speed slider meanwhile: the arm moves for about half of the time


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(signal.SIGINT, marks=pytest.mark.long),
        pytest.param(signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, marks=pytest.mark.slow),
    ],
)
def test_a_plea_to_end_stops_the_arm_first(kind, cell, path):
    run, goal = cases.start_run(cell, path, cases.Run.moving)
    since = time.monotonic()
    if kind == signal.SIGINT:
        run.interrupt()  # a terminal sends it to the whole group
    else:
        run.process.send_signal(kind)
    assert "interrupted" in cases.failed(run, 130)
    cases.check_stopped_on_its_way(cell, since, goal)
    cases.check_readings(cell, path)
    with CampaignFile.open(path) as campaign:
        assert RunLog(campaign).events()[-1]["kind"] == "interrupted"


@pytest.mark.slow
def test_ctrl_c_twice_in_a_row_stops_it_too(cell, path):
    run, goal = cases.start_run(cell, path, cases.Run.moving)
    since = time.monotonic()
    run.interrupt()
    time.sleep(0.05)
    run.interrupt()
    code, words = run.end()
    # the interpreter, once it is about to end, takes a signal in the way of the system
    assert code in (3, 130, -signal.SIGINT)
    assert words.splitlines()[-1].startswith("error: ")
    assert "Traceback" not in words
    cases.check_stopped_on_its_way(cell, since, goal)
    assert run.orphans() == []
    cases.check_readings(cell, path)


@pytest.mark.long
def test_a_campaign_that_another_program_locks_says_how_to_go_on(cell, path):
    run, _ = cases.start_run(cell, path, cases.Run.measuring)
    with closing(sqlite3.connect(path, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        line = cases.failed(run, 2)
        assert re.search(r"another program has kept .* locked .* --resume$", line), line
    cases.check_readings(cell, path)


def _kill_at_random(cell, path, kills, seed):
    """Kill one run after the other; returns in how many of them the arm moved."""
    rng = np.random.default_rng(seed)
    killed = moved = starved = 0
    cell.slider(SLOW)
    while killed < kills:
        run = cases.Run(cell, path)
        moment = rng.uniform(0.0, LONGEST)
        try:
            if killed % 2 == 1:
                run.wait_until(lambda run=run: cases.STARTED in run.output, "a beginning")
            end = time.monotonic() + moment
            run.wait_until(lambda end=end: time.monotonic() >= end, "it was killed")
        except cases.EndedError as error:
            starved += 1
            if starved > 1 + kills // 20 or not cases.STARVED.search(str(error)):
                raise
            continue
        killed += 1
        since = time.monotonic()
        run.kill()
        run.process.wait()
        moves = cell.ask("arm", "state")["moving"]
        assert run.orphans() == []
        assert "error:" not in run.output
        if moves:
            cases.check_stopped_within(cell, since)
        moved += moves
        if path.exists():
            _sound(path)
    cell.slider(1.0)
    return moved


def _sound(path):
    with CampaignFile.open(path) as campaign:
        log = RunLog(campaign)
        assert campaign.n_readings == len(log.done()) == len(log.details())


@pytest.mark.parametrize(
    ("kills", "poses"),
    [pytest.param(2, 2, marks=pytest.mark.long), pytest.param(100, 25, marks=pytest.mark.slow)],
)
def test_kill_minus_nine_at_random_moments(cell, tmp_path, kills, poses):
    long = cell.shorter(tmp_path, poses=poses)
    path = tmp_path / "killed.hilcal"
    assert _kill_at_random(long, path, kills, seed=poses) > (10 if kills > 10 else -1)
    cases.finish(long, path)


@pytest.mark.slow
def test_the_stopped_campaign_has_every_reading_exactly_once(cell, path):
    cases.finish(cell, path)
