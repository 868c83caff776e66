"""A further plan in a campaign: names, cycles, the file, and `hilcal run --append`."""

import os
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hilcal.errors import InputError
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import REFERENCE, Plan, Step, joined, load_plan, with_new_names
from hilcal.store.run_log import RunLog
from hilcal.workbench.session import WorkbenchSession
from tests.cli.test_until_goal import site
from tests.support.cli_cases import ok, refused
from tests.unit.data.test_run_log import MADE, STEPS, _campaign, _reading

__all__ = ["site"]
ROOT = Path(__file__).resolve().parents[2]


def made(*names, shift=0.0):
    """Every pose unloaded and under a load; poses of one name are those of `MADE` if not moved."""
    q = np.array([np.arange(6.0) / 10 + int(n[-1]) if n[-1].isdigit() else np.zeros(6)
                  for n in names])  # fmt: skip
    steps = tuple(Step(name, load) for load in ("none", "5kg") for name in names)
    return Plan(names, q + shift, steps)


# names and cycles


def test_new_poses_get_names_of_their_own():
    before, further = made(REFERENCE, "p1", "p2"), made(REFERENCE, "p1", "p3", shift=0.2)
    out = with_new_names(further, before, 2)
    assert out.pose_names == (REFERENCE, "p1-2", "p3")
    assert np.array_equal(out.joints(REFERENCE), before.joints(REFERENCE))
    assert np.array_equal(out.joints("p1-2"), further.joints("p1"))
    assert [(s.pose, s.load, s.cycle) for s in out.steps] == [
        (REFERENCE, "none", 1), ("p1-2", "none", 0), ("p3", "none", 0),
        (REFERENCE, "5kg", 1), ("p1-2", "5kg", 0), ("p3", "5kg", 0),
    ]  # fmt: skip
    third = with_new_names(further, joined(before, frozenset(before.steps), out), 3)
    assert third.pose_names == (REFERENCE, "p1-3", "p3")
    assert {s.cycle for s in third.steps if s.pose == "p3"} == {1}
    assert {s.cycle for s in third.steps if s.pose == REFERENCE} == {2}


def test_the_same_poses_again_are_new_cycles_with_references_of_their_own():
    plan = made(REFERENCE, "p1")
    again = with_new_names(plan, plan, 2)
    assert again.pose_names == plan.pose_names
    assert {s.cycle for s in again.steps} == {1}
    assert not set(again.steps) & set(plan.steps)
    loaded = {(s.pose, s.cycle) for s in again.steps if s.load != "none"}
    assert loaded <= {(s.pose, s.cycle) for s in again.steps if s.load == "none"}


def test_a_name_that_was_made_up_is_not_taken_twice():
    before = made("p1", "p1-2")
    further = made("p1", shift=0.1)
    assert with_new_names(further, before, 2).pose_names == ("p1-2-2",)


@pytest.mark.parametrize(("plan", "words"), [
    (made("p1"), 'only the campaign has a pose "reference"'),
    (Plan((REFERENCE,), np.zeros((1, 7)), (Step(REFERENCE, "none"),)), "7 joint angles"),
])  # fmt: skip
def test_what_does_not_go_together(plan, words):
    with pytest.raises(InputError, match=words):
        with_new_names(plan, made(REFERENCE, "p1"), 2)


# the file


def test_what_was_not_measured_before_is_given_up(tmp_path):
    path = tmp_path / "run.hilcal"
    further = made("p1", "p7", shift=0.3)
    with _campaign(path) as campaign:
        log = RunLog(campaign)
        for step in STEPS[:3]:
            log.record(_reading(step), step, {})
        assert log.plan.steps == MADE.steps
        fitted = log.with_new_names(further)
        log.append(fitted)
        assert log.plan.steps == (*STEPS[:3], *fitted.steps)
        with pytest.raises(InputError, match="in the campaign already, and 4 of its 4 readings"):
            log.with_new_names(further)
    with CampaignFile.open(path) as campaign:
        log = RunLog(campaign)
        assert [len(p.steps) for p in log.plans] == [6, 4]
        assert log.plan.steps == (*STEPS[:3], *fitted.steps)
        assert log.plan.without(log.done()).steps == fitted.steps
        assert log.plan.pose_names == ("p1-2", "p7", "p1", "p2")


_KILLED = """
import os, sys
from pathlib import Path
from tests.cli.test_next_append import made
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.run_log import RunLog
with CampaignFile.open(Path(sys.argv[1])) as campaign:
    log = RunLog(campaign)
    log.append(log.with_new_names(made("p8", "p9")))
    os._exit(9)
"""


@pytest.mark.long
def test_an_appended_plan_survives_a_kill(tmp_path):
    path = tmp_path / "run.hilcal"
    _campaign(path).close()
    search = str(ROOT)
    child = subprocess.run(
        [sys.executable, "-c", _KILLED, path],
        env={**os.environ, "PYTHONPATH": search},
        timeout=60,
        check=False,
    )
    assert child.returncode == 9
    with CampaignFile.open(path) as campaign:
        assert RunLog(campaign).plans[1].pose_names == ("p8", "p9")


# the command


def further_plan(site):
    """Half of the site's poses, a little elsewhere, at another reference."""
    plan = site.plan
    q = plan.q + 0.02
    names = plan.pose_names[:5]
    steps = tuple(s for s in plan.steps if s.pose in names)
    path = site.directory / "next.json"
    path.write_text(Plan(names, q[:5], steps).to_json(), encoding="utf-8")
    return path


@pytest.mark.long
def test_a_further_plan_is_measured_into_the_campaign(site, capsys):
    path, first = site.directory / "run.hilcal", len(site.plan.steps)
    ok(capsys, *site.command(*site.fresh))
    site.bench.world.again()
    further = further_plan(site)
    d = ok(capsys, *site.command("--append", "--plan", str(further), "--json")).document
    added = d["readings"] - first
    assert (added, d["planned"]) == (15, d["readings"])
    with CampaignFile.open(path) as campaign:
        readings, events = campaign.readings(), RunLog(campaign).events()
    old, new = readings[slice(0, first)], readings[slice(first, None)]
    names = readings.pose_names
    assert {names[p] for p in new.pose} == {
        REFERENCE, *(f"{n}-2" for n in site.plan.pose_names[1:5])
    }  # fmt: skip
    keys = [{(p, c) for p, c in zip(r.pose, r.cycle, strict=True)} for r in (old, new)]
    assert not keys[0] & keys[1]
    assert keys[1] == {(p, c) for p, c in zip(new.pose[new.unloaded], new.cycle[new.unloaded],
                                               strict=True)}  # fmt: skip
    assert readings.states.time is not None
    assert (np.diff(readings.states.time) > 0).all()  # time goes on
    assert [e["kind"] for e in events].count("start") == 2
    fitted = ok(capsys, "identify", path, "--json").document
    assert fitted["n_readings"] == len(readings)
    again = ok(capsys, *site.command("--resume", "--json")).document  # nothing is missing
    assert again["readings"] == len(readings)


@pytest.mark.long
def test_the_line_that_next_prints(site, capsys):
    """As `next` and the workbench print it; the cell that they do not know is CELL.toml there."""
    ok(capsys, *site.command(*site.fresh))
    site.bench.world.again()
    path, further = site.directory / "run.hilcal", further_plan(site)
    planned: Any = SimpleNamespace(path=path, planned=(None, further))
    line = WorkbenchSession.run_line(planned)
    named = line.replace("CELL.toml", str(site.directory / "cell.toml"))
    assert ok(capsys, *shlex.split(named)[1:]).code == 0


@pytest.mark.long
def test_an_append_that_was_stopped_is_resumed(site, capsys):
    ok(capsys, *site.command(*site.fresh))
    site.bench.world.again()
    further = str(further_plan(site))
    with CampaignFile.open(site.directory / "run.hilcal") as campaign:  # stopped before it moved
        log = RunLog(campaign)
        log.append(log.with_new_names(load_plan(Path(further))))
    line = refused(capsys, 2, *site.command("--append", "--plan", further))
    assert "go on with --resume" in line
    d = ok(capsys, *site.command("--resume", "--json")).document
    assert d["readings"] == d["planned"] == len(site.plan.steps) + 15


def test_wrong_ways_to_append(site, capsys):
    further = str(further_plan(site))
    line = refused(capsys, 2, *site.command("--append", "--plan", further))
    assert "no such campaign file" in line
    ok(capsys, *site.command(*site.fresh))
    assert "--plan" in refused(capsys, 2, *site.command("--append"))
    assert "give one" in refused(capsys, 2, *site.command("--append", "--resume"))
    assert "--append" in refused(capsys, 2, *site.command("--plan", further))
