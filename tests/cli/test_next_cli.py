"""`next`, a further plan in the same campaign, and `demo --ambiguous`."""

import re
from pathlib import Path

import numpy as np
import pytest

from hilcal.config import load_config
from hilcal.errors import InputError
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import (
    REFERENCE,
    Plan,
    Step,
    joined,
    load_plan,
    unknown_keys,
    with_new_names,
)
from hilcal.store.run_log import RunLog, create_run
from tests.cli.test_until_goal import site
from tests.support.campaigns import configuration
from tests.support.cli_cases import imported, ok, refused, stored_readings
from tests.support.next_cases import SMALL, doubtful, fine_error
from tests.unit.data.test_run_log import MADE, STEPS, _campaign, _reading

TILT, LINK, BASE = "joint_tilt_compliance", "link_compliance", "base_compliance"


def stored(path, effect, seed):
    """Write a small campaign, as `hilcal import` would."""
    return stored_readings(path, doubtful(effect, seed).rehearsal.readings, SMALL)


@pytest.fixture
def ambiguous(tmp_path):
    assert doubtful(BASE, 2).suspects == (BASE, TILT)
    return stored(tmp_path / "run.hilcal", BASE, 2)


@pytest.mark.long
def test_next_in_json_and_in_words(ambiguous, tmp_path, capsys):
    ok(capsys, "identify", ambiguous)
    plan, table = tmp_path / "next.json", tmp_path / "next.csv"
    arguments = ("--quick", "--poses", "4", "--csv", table, "--json")
    result = ok(capsys, "next", ambiguous, "-o", plan, *arguments)
    d = result.document
    assert d["suspects"] == [BASE, TILT]
    assert d["criterion"] == "separate"
    assert {(e, f) for e, f, _ in d["separates"]} == {(BASE, TILT), (TILT, BASE)}
    now = {(e, f): p for e, f, p in d["separates_now"]}
    assert all(0 <= now[e, f] < p <= 1 for e, f, p in d["separates"])
    assert 0.9 < d["efficiency"] <= 1
    made = load_plan(plan)
    assert unknown_keys(made) == ()
    assert d["readings"] == len(made.steps)
    assert made.about["suspects"] == [BASE, TILT]
    assert d["poses"] > 0
    assert set(d["predicted_std"]) > {"joint_compliance.j1"}
    assert len(table.read_text(encoding="utf-8").splitlines()) == 1 + d["readings"]
    assert "rule out" in result.err  # words are on stderr

    again = tmp_path / "again.json"
    words = ok(capsys, "next", ambiguous, "-o", again, "--quick", "--poses", "4", "--details").out
    assert again.read_bytes() == plan.read_bytes()
    for part in (
        f"In doubt: {BASE} or {TILT}.",
        "chance to rule out",
        "What separates the weakest pair comes from ",
        "power to separate the leading suspects",
        f"hilcal export {ambiguous} --readings READINGS.csv",
        "hilcal import READINGS.csv --config CELL.toml",
    ):
        assert part in " ".join(words.split())
    wrapped = [line for line in words.splitlines() if not line.startswith("  hilcal ")]
    assert max(map(len, wrapped)) <= 100  # commands are not, to be copied


@pytest.mark.slow
def test_a_prior_makes_the_powers_of_now_larger_and_is_not_stored(ambiguous, tmp_path, capsys):
    plan = tmp_path / "next.json"
    old = imported(tmp_path / "old.hilcal", "nothing", 3, 12, ("identify",))
    ok(capsys, "identify", ambiguous)
    words = ("--suspects", f"{BASE},{TILT}", "--quick", "--poses", "4", "--json")
    alone, known = (
        ok(capsys, "next", ambiguous, "-o", plan, *words, *more).document["separates_now"]
        for more in ((), ("--prior", old))
    )
    assert all(b[:2] == a[:2] and b[2] > a[2] for a, b in zip(alone, known, strict=True))
    assert ok(capsys, "info", ambiguous, "--json").document["revisions"][-1]["revision"] == 1


def test_a_revision_with_a_prior_takes_no_other(ambiguous, tmp_path, capsys):
    old = imported(tmp_path / "old.hilcal", "nothing", then=("identify",))
    ok(capsys, "identify", ambiguous, "--prior", old)
    said = refused(capsys, 2, "next", ambiguous, "-o", tmp_path / "p.json", "--prior", old)
    assert "has a prior already, old.hilcal" in said


@pytest.mark.long
def test_an_effect_that_was_added_in_doubt_is_in_doubt_still(ambiguous, tmp_path, capsys):
    """`refine` has added the leading suspect: the newest model is adequate, and may be wrong."""
    refined = ok(capsys, "refine", ambiguous, "--json").document
    assert refined["verdict"] == "ambiguous"
    added = refined["revisions"][-1]["added"]
    arguments = ("--quick", "--poses", "4", "--json")
    d = ok(capsys, "next", ambiguous, "-o", tmp_path / "n.json", *arguments).document
    assert d["suspects"][0] == added
    assert len(d["suspects"]) > 1


@pytest.mark.long
def test_a_misfit_of_the_pose_alone_asks_for_new_poses(tmp_path, capsys):
    path = stored_readings(tmp_path / "run.hilcal", fine_error()[1], configuration())
    ok(capsys, "identify", path, "--readings", "absolute")
    plan = tmp_path / "next.json"
    result = ok(capsys, "next", path, "-o", plan, "--poses", "10", "--json")
    d = result.document
    assert d["suspects"][0] == "transmission_error"
    assert d["poses"] == 10
    assert set(d["readings_by_load"]) == {"none"}
    assert {e for e, _, _ in d["separates"]} == {"transmission_error"}
    assert all(0.0 <= p <= 1.0 for _, _, p in (*d["separates"], *d["separates_now"]))
    assert "unloaded readings at 10 poses" in " ".join(result.err.split())


@pytest.mark.long
def test_four_suspects_fit_one_screen(tmp_path, capsys, monkeypatch):
    """By default the pair of each suspect that is separated least; all under --details."""
    stored(tmp_path / "run.hilcal", TILT, 1)
    monkeypatch.chdir(tmp_path)  # names of files are short, as people have them
    path = "run.hilcal"
    ok(capsys, "identify", path)
    suspects = ("--suspects", f"{TILT},{LINK},{BASE},load_point", "--poses", "4")
    brief = ok(capsys, "next", path, "-o", "n.json", *suspects).out
    assert len(brief.splitlines()) <= 25
    assert "Efficiency of the plan: at least " in " ".join(brief.split())
    assert "at least 0.0 %" not in brief
    full = ok(capsys, "next", path, "-o", "m.json", *suspects, "--details").out
    assert full.count("load_point  ") > brief.count("load_point  ")
    for heading in ("Predicted standard uncertainty", "Comparison of criteria", "Sample-size"):
        assert heading in full
        assert heading not in brief


def test_pairs_that_nothing_separates_are_refused(tmp_path, capsys):
    path = stored(tmp_path / "run.hilcal", "nothing", 1)
    ok(capsys, "identify", path)
    suspects = ("--suspects", "tracker_scale,hysteresis")
    line = refused(capsys, 4, "next", path, "-o", tmp_path / "n.json", *suspects)
    assert "no measurement separates them" in line


# the demo


@pytest.mark.slow
def test_the_demo_settles_a_doubt(tmp_path, capsys):
    path = tmp_path / "demo.hilcal"
    arguments = ("demo", "--without-devices", "--ambiguous", "--hide", LINK, "--seed", "2")
    result = ok(capsys, *arguments, "-o", path, "--json")
    d = result.document
    assert d["hidden"] == LINK
    assert d["doubt"]["verdict"] == "ambiguous"
    assert {TILT, LINK} <= set(d["doubt"]["suspects"])
    assert all(p > 0.5 for _, _, p in d["doubt"]["separates"])
    assert (d["found"], d["verdict"]) == (True, "adequate")
    assert d["diagnoses"][0]["suspects"][0]["effect"] == LINK
    assert d["diagnoses"][0]["suspects"][0]["same_as"] == []
    with CampaignFile.open(path) as campaign:
        records, readings = campaign.revisions(), campaign.readings()
    assert [r.added for r in records] == [None, None, LINK]
    assert records[0].data_hash != records[1].data_hash
    assert d["doubt"]["verdict"] == records[0].result_json["diagnose"]["verdict"]
    match = re.search(r"(\d+) readings were added. All (\d+)", result.err)
    assert 0 < int(match[1]) < int(match[2]) == len(readings)
    viewed = ok(capsys, "view", path, "--record", tmp_path / "demo.rrd", "--json").document
    assert viewed["revisions"] == [2, 3]


__all__ = ["site"]


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
    site.bench.world.restart()
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
def test_an_append_that_was_stopped_is_resumed(site, capsys):
    ok(capsys, *site.command(*site.fresh))
    site.bench.world.restart()
    further = str(further_plan(site))
    with CampaignFile.open(site.directory / "run.hilcal") as campaign:  # stopped before it moved
        log = RunLog(campaign)
        log.append(log.with_new_names(load_plan(Path(further))))
    line = refused(capsys, 2, *site.command("--append", "--plan", further))
    assert "go on with --resume" in line
    d = ok(capsys, *site.command("--resume", "--json")).document
    assert d["readings"] == d["planned"] == len(site.plan.steps) + 15


@pytest.mark.long
def test_what_an_appended_plan_leaves_out_is_said(site, capsys):
    path, further = site.directory / "run.hilcal", str(further_plan(site))
    config = load_config(site.directory / "cell.toml")
    create_run(path, config, site.directory, site.plan).close()
    result = ok(capsys, *site.command("--append", "--plan", further, "--json"))
    missing = f"{len(site.plan.steps)} readings of the previous plan are missing"
    assert missing in " ".join(result.err.split())
    moved = 'its pose "reference" is up to 0.02 rad from that of the campaign'
    assert moved in " ".join(result.err.split())
    assert "previous plan" not in ok(capsys, *site.command("--resume", "--json")).err


@pytest.mark.long
def test_a_load_that_hung_when_the_last_session_was_killed_is_said(site, capsys):
    said = "load 3kg may still be on the arm"
    ok(capsys, *site.command(*site.fresh))
    assert said not in ok(capsys, *site.command("--resume")).err
    with CampaignFile.open(site.directory / "run.hilcal") as campaign:
        RunLog(campaign).event("load", {"hanging": "3kg"})  # killed behind a last loaded reading
    assert said in ok(capsys, *site.command("--resume")).err


def test_wrong_ways_to_append(site, capsys):
    further = str(further_plan(site))
    line = refused(capsys, 2, *site.command("--append", "--plan", further))
    assert "no such campaign file" in line
    config = load_config(site.directory / "cell.toml")
    create_run(site.directory / "run.hilcal", config, site.directory, site.plan).close()
    assert "--plan" in refused(capsys, 2, *site.command("--append"))
    assert "give one" in refused(capsys, 2, *site.command("--append", "--resume"))
    assert "--append" in refused(capsys, 2, *site.command("--plan", further))
