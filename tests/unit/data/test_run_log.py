"""What a run writes: readings with their details, steps exactly once, events, durable."""

import gc
import sqlite3
import subprocess
import sys
from subprocess import PIPE

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.errors import DeviceError, InputError
from hilcal.names import escaped
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, Step, load_plan, read_plan
from hilcal.store.run_log import PLAN, RunLog
from hilcal.store.schema import transaction
from tests.support.paths import ROOT
from tests.support.readings_cases import readings_at
from tests.support.refusals import refusal, refusal_of, refusals, refuses, with_edits

STEPS = tuple(Step(pose, load, 0) for pose in ("p1", "p2", "p3") for load in ("none", "5kg"))
MADE = Plan(("p1", "p2", "p3"), np.arange(18.0).reshape(3, 6) / 10, STEPS, {"seed": 3})


def _reading(step):
    names = {"load_names": (step.load,), "pose_names": (step.pose,)}
    q = MADE.joints(step.pose)[None]
    return readings_at(q, np.ones((1, 3)), cycle=np.array([step.cycle]), **names)


def _campaign(path):
    return CampaignFile.create(path, "{}", ".", "test", more_texts={PLAN: MADE.to_json()})


def test_what_was_recorded_comes_back_after_reopening(tmp_path):
    path = tmp_path / "run.hilcal"
    with _campaign(path) as campaign:
        log = RunLog(campaign)
        assert log.readings() is None
        for k, step in enumerate(STEPS[:3]):
            log.record(_reading(step), step, {"k": k})
        log.event("stopped", {"why": "test"})
    with CampaignFile.open(path) as campaign:
        log = RunLog(campaign)
        assert log.done() == frozenset(STEPS[:3])
        assert [d["k"] for d in log.details()] == [0, 1, 2]
        assert log.details()[1]["step"] == {"pose": "p1", "load": "5kg", "cycle": 0}
        assert [(e["kind"], e["why"]) for e in log.events()] == [("stopped", "test")]
        assert log.plan.without(log.done()).steps == STEPS[3:]
        readings = log.readings()
        assert len(readings) == 3


def test_a_step_is_never_there_twice_and_its_refusal_leaves_no_reading(tmp_path):
    with _campaign(tmp_path / "run.hilcal") as campaign:
        log = RunLog(campaign)
        log.record(_reading(STEPS[0]), STEPS[0], {})
        with pytest.raises(InputError, match="p1, none, cycle 0 has been measured already"):
            log.record(_reading(STEPS[0]), STEPS[0], {})
        assert campaign.n_readings == 1


def test_what_is_missing_goes_on_without_a_pose_that_is_skipped(tmp_path):
    path = tmp_path / "run.hilcal"
    with _campaign(path) as campaign:
        log = RunLog(campaign)
        log.record(_reading(STEPS[0]), STEPS[0], {})
        log.record(_reading(STEPS[2]), STEPS[2], {})  # p2 without its load
        log.skip(["p2"])
    with CampaignFile.open(path) as campaign:
        log = RunLog(campaign)
        # loads are changed at p1, where no pose is the reference
        assert log.plan.without(log.done()).steps == (STEPS[1], *STEPS[4:])
        assert {STEPS[0], STEPS[2]} < set(log.plan.steps)
        assert np.array_equal(log.plan.joints("p2"), MADE.joints("p2"))
        assert log.plan.about["left_out"] == [{"point": "p2", "why": "left out by the operator"}]
        assert log.plan.about["seed"] == 3
        assert "p2" in refusal("valid: p1, p3$", log.skip, ["p2"])
        log.record(_reading(STEPS[1]), STEPS[1], {})
        log.skip(["p3"])  # nothing is left to be measured: the arm goes home and reads
        assert log.plan.without(log.done()).steps == (Step("p1", "none", 1),)
        assert [x["point"] for x in log.plan.about["left_out"]] == ["p2", "p3"]


MEASURES = """
import sys
from hilcal.store.campaign_file import CampaignFile
campaign = CampaignFile.open(sys.argv[1])
campaign.measure_alone()
print("measures", flush=True)
sys.stdin.read()
"""


def test_one_process_measures_and_a_killed_one_holds_nobody_off(tmp_path):
    path = tmp_path / "run.hilcal"
    with _campaign(path) as campaign:
        command = [sys.executable, "-c", MEASURES, str(path)]
        with subprocess.Popen(command, stdin=PIPE, stdout=PIPE, cwd=ROOT) as other:
            assert other.stdout is not None
            assert other.stdout.readline() == b"measures\n"
            refusal("another hilcal is measuring this campaign", campaign.measure_alone)
            RunLog(campaign).record(_reading(STEPS[0]), STEPS[0], {})  # as fits may store
            path.read_bytes()
            refusal("another hilcal is measuring this campaign", campaign.measure_alone)
            other.kill()
            other.wait()
            campaign.measure_alone()
        campaign.measure_alone()
        with CampaignFile.open(path) as second:
            refusal("another hilcal is measuring", second.measure_alone)
        refusal("another hilcal is measuring", CampaignFile.open(path).measure_alone)
    with CampaignFile.open(path) as campaign:
        campaign.measure_alone()


def test_a_table_cannot_be_resumed(tmp_path):
    made = CampaignFile.create(tmp_path / "run.hilcal", "{}", ".", "a table")
    with made as campaign, pytest.raises(InputError, match="cannot be resumed"):
        RunLog(campaign)


def test_a_full_database_stores_all_or_nothing(tmp_path):
    path = tmp_path / "run.hilcal"
    with _campaign(path) as campaign:
        log = RunLog(campaign)
        (pages,) = campaign.connection.execute("PRAGMA page_count").fetchone()
        campaign.connection.execute(f"PRAGMA max_page_count = {pages + 2}")

        def fill():
            for step in (Step("p1", "none", k) for k in range(100)):
                log.record(_reading(step), step, {"filler": "x" * 300})

        refusal_of(DeviceError, "make room on the disk", fill)
        stored = campaign.n_readings
    assert 0 < stored < 100
    with CampaignFile.open(path) as campaign:
        assert campaign.n_readings == len(RunLog(campaign).done()) == stored


names = st.text(min_size=1, max_size=6).filter(lambda name: escaped(name) == name)


@given(
    st.lists(names, min_size=1, max_size=4, unique=True),
    st.lists(st.tuples(st.integers(0, 3), names, st.integers(0, 3)), min_size=1, max_size=8),
    st.floats(-7, 7),
)
def test_a_plan_is_read_back_as_written(poses, rows, angle):
    steps = tuple(dict.fromkeys(Step(poses[p % len(poses)], ld, c) for p, ld, c in rows))
    q = angle * np.arange(1.0, 1 + 6 * len(poses)).reshape(-1, 6) / 7.0
    again = read_plan(Plan(tuple(poses), q, steps, {"note": 1}).to_json(), "plan")
    assert again.pose_names == tuple(poses)
    assert np.array_equal(again.q, q)
    assert again.steps == steps
    assert again.about == {"note": 1}


@refusals("plans")
def test_what_is_not_a_plan_is_refused_in_one_line(case, given, tmp_path):
    path = tmp_path / "plan.json"
    path.write_text(with_edits(given, MADE=MADE.to_json()))
    refuses(case, lambda: load_plan(path), path)


def test_an_interrupt_between_a_transaction_s_begin_and_its_block_leaves_nothing(
    tmp_path, monkeypatch
):
    """The block is never entered: nobody ends the transaction but the next one, or the close."""
    complaints = []
    monkeypatch.setattr("sys.unraisablehook", complaints.append)
    connection = sqlite3.connect(tmp_path / "x", isolation_level=None)
    connection.execute("CREATE TABLE t (x)")
    interrupted = [transaction(connection) for _ in range(2)]
    interrupted[0].__enter__().execute("INSERT INTO t VALUES (1)")
    with transaction(connection) as begun:
        begun.execute("INSERT INTO t VALUES (2)")
    assert connection.execute("SELECT x FROM t").fetchall() == [(2,)]
    interrupted[1].__enter__()
    connection.close()
    interrupted.clear()
    gc.collect()
    assert complaints == []


def test_a_file_that_was_written_over_the_open_campaign_is_not_measured_on(tmp_path):
    """As `cp old.hilcal run.hilcal` does it: the file stays the same one for the system."""
    path = tmp_path / "run.hilcal"
    with _campaign(path) as campaign:
        log = RunLog(campaign)
        log.record(_reading(STEPS[0]), STEPS[0], {})
        copy = path.read_bytes()
        log.record(_reading(STEPS[1]), STEPS[1], {})
        path.write_bytes(copy)
        with pytest.raises(InputError, match="reading 2 is gone: another program has written"):
            log.record(_reading(STEPS[2]), STEPS[2], {})
        with pytest.raises(InputError, match="reading 2 is gone"):
            log.event("finished", {"readings": 3})
    with CampaignFile.open(path) as campaign:
        assert RunLog(campaign).done() == frozenset(STEPS[:1])
        RunLog(campaign).record(_reading(STEPS[1]), STEPS[1], {})
