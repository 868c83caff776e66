"""`hilcal next` and `hilcal demo --ambiguous`: what they say, write and refuse."""

import re
from pathlib import Path

import pytest

from hilcal.cli import demo
from hilcal.cli.rehearsing import RehearsalSettings
from hilcal.config import load_config
from hilcal.diagnosis.diagnosis import History, in_doubt
from hilcal.diagnosis.evidence import Evidence
from hilcal.diagnosis.verdict import judge
from hilcal.drivers.simulated.injected_effects import HARD_TO_SEPARATE
from hilcal.drivers.simulated.rehearsal import case_of_plan, read_plan
from hilcal.effects.catalogue import installed
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import load_plan
from tests.support.campaigns import configuration
from tests.support.cli_cases import CELL, ok, refused, table
from tests.support.next_cases import SMALL, doubtful
from tests.unit.design.test_many_poses import fine_error

Capsys = pytest.CaptureFixture[str]
TILT, LINK, BASE = "joint_tilt_compliance", "link_compliance", "base_compliance"
CELLS = str(configs_dir() / "cells")


def stored(path: Path, effect: str, seed: int) -> Path:
    """Write a small campaign, as `hilcal import` would."""
    with CampaignFile.create(path, SMALL.to_json(), CELLS, "a test", overwrite=True) as campaign:
        campaign.append_readings(doubtful(effect, seed).rehearsal.readings)
    return path


@pytest.fixture
def ambiguous(tmp_path: Path) -> Path:
    assert doubtful(BASE, 2).suspects == (BASE, TILT)
    return stored(tmp_path / "run.hilcal", BASE, 2)


def test_next_in_json_and_in_words(ambiguous: Path, tmp_path: Path, capsys: Capsys) -> None:
    ok(capsys, "identify", ambiguous)
    plan, table = tmp_path / "next.json", tmp_path / "next.csv"
    arguments = ("--quick", "--poses", "8", "--csv", table, "--json")
    result = ok(capsys, "next", ambiguous, "-o", plan, *arguments)
    d = result.document
    assert d["suspects"] == [BASE, TILT]
    assert d["criterion"] == "separate"
    assert {(e, f) for e, f, _ in d["separates"]} == {(BASE, TILT), (TILT, BASE)}
    now = {(e, f): p for e, f, p in d["separates_now"]}
    assert all(0 <= now[e, f] < p <= 1 for e, f, p in d["separates"])
    assert 0.9 < d["efficiency"] <= 1
    made = load_plan(plan)
    assert d["readings"] == len(made.steps)
    assert made.about["suspects"] == [BASE, TILT]
    assert d["poses"] > 0
    assert set(d["predicted_std"]) > {"joint_compliance.j1"}
    assert len(table.read_text(encoding="utf-8").splitlines()) == 1 + d["readings"]
    assert "ruled out" in result.err  # words are on stderr

    again = tmp_path / "again.json"
    words = ok(capsys, "next", ambiguous, "-o", again, "--quick", "--poses", "8", "--details").out
    assert again.read_bytes() == plan.read_bytes()
    for part in (
        f"In doubt: {BASE} or {TILT}.",
        "this is ruled out",
        "What separates the weakest pair comes from ",
        "power to separate the leading suspects",
        f"--append --plan {again}",
    ):
        assert part in " ".join(words.split())
    assert max(map(len, words.splitlines())) <= 100


@pytest.mark.slow
def test_a_prior_makes_the_powers_of_now_larger_and_is_not_stored(
    ambiguous: Path, tmp_path: Path, capsys: Capsys
) -> None:
    old, plan = tmp_path / "old.hilcal", tmp_path / "next.json"
    ok(capsys, "import", table(tmp_path / "a.csv", "nothing", 3, 12), "--config", CELL, "-o", old)
    ok(capsys, "identify", old)
    ok(capsys, "identify", ambiguous)
    words = ("--suspects", f"{BASE},{TILT}", "--quick", "--poses", "4", "--json")
    alone, known = (
        ok(capsys, "next", ambiguous, "-o", plan, *words, *more).document["separates_now"]
        for more in ((), ("--prior", old))
    )
    assert all(b[:2] == a[:2] and b[2] > a[2] for a, b in zip(alone, known, strict=True))
    assert ok(capsys, "info", ambiguous, "--json").document["revisions"][-1]["revision"] == 1


def test_a_revision_with_a_prior_takes_no_other(
    ambiguous: Path, tmp_path: Path, capsys: Capsys
) -> None:
    old = tmp_path / "old.hilcal"
    ok(capsys, "import", table(tmp_path / "a.csv", "nothing", 3, 8), "--config", CELL, "-o", old)
    ok(capsys, "identify", old)
    ok(capsys, "identify", ambiguous, "--prior", old)
    said = refused(capsys, 2, "next", ambiguous, "-o", tmp_path / "p.json", "--prior", old)
    assert "has a prior already, old.hilcal" in said


@pytest.mark.long
def test_an_effect_that_was_added_in_doubt_is_in_doubt_still(
    ambiguous: Path, tmp_path: Path, capsys: Capsys
) -> None:
    """`refine` has added the leading suspect: the newest model is adequate, and may be wrong."""
    refined = ok(capsys, "refine", ambiguous, "--json").document
    assert refined["verdict"] == "ambiguous"
    added = refined["revisions"][-1]["added"]
    arguments = ("--quick", "--poses", "4", "--json")
    d = ok(capsys, "next", ambiguous, "-o", tmp_path / "n.json", *arguments).document
    assert d["suspects"][0] == added
    assert len(d["suspects"]) > 1


@pytest.mark.long
def test_a_misfit_of_the_pose_alone_asks_for_new_poses(tmp_path: Path, capsys: Capsys) -> None:
    path = tmp_path / "run.hilcal"
    with CampaignFile.create(path, configuration().to_json(), CELLS, "a test") as campaign:
        campaign.append_readings(fine_error()[1])
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
def test_four_suspects_fit_one_screen(
    tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
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


@pytest.mark.long
def test_named_suspects_need_no_diagnosis(tmp_path: Path, capsys: Capsys) -> None:
    path = stored(tmp_path / "run.hilcal", "nothing", 1)
    arguments = ("--suspects", f"{TILT},load_point", "--quick", "--poses", "3", "--json")
    d = ok(capsys, "next", path, "-o", tmp_path / "n.json", *arguments).document
    assert d["suspects"] == [TILT, "load_point"]
    assert all(p > 0.5 for _, _, p in d["separates"])


@pytest.mark.long
def test_nothing_in_doubt_is_said_so(tmp_path: Path, capsys: Capsys) -> None:
    plan = tmp_path / "next.json"
    path = stored(tmp_path / "run.hilcal", "nothing", 1)
    line = refused_after(capsys, "next", path, "-o", plan)
    assert "the model is adequate" in line
    assert "--after" in line
    assert doubtful("sensor_misalignment", 1).suspects == ("sensor_misalignment",)
    path = stored(tmp_path / "one.hilcal", "sensor_misalignment", 1)
    line = refused_after(capsys, "next", path, "-o", plan)
    assert "hilcal add" in line
    assert not plan.exists()


def refused_after(capsys: Capsys, *arguments: str | Path) -> str:
    """The line of a refusal with exit 4, of a campaign that has its baseline."""
    ok(capsys, "identify", arguments[1])
    return refused(capsys, 4, *arguments)


def test_pairs_that_nothing_separates_are_refused(tmp_path: Path, capsys: Capsys) -> None:
    path = stored(tmp_path / "run.hilcal", "nothing", 1)
    ok(capsys, "identify", path)
    suspects = ("--suspects", "tracker_scale,hysteresis")
    line = refused(capsys, 4, "next", path, "-o", tmp_path / "n.json", *suspects)
    assert "no measurement separates them" in line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--suspects", "gremlins,hysteresis"), ("gremlins", "valid")),
        (("--suspects", "hysteresis"), ("--suspects", "2 to 4")),
        (("--suspects", "hysteresis,hysteresis"), ("--suspects", "twice")),
        (("--poses", "0"), ("--poses", "from 1")),
        (("--seed", "-1"), ("--seed",)),
        (("--record", "no/where.rrd"), ("no folder",)),
        (("--cell", "nothing.toml"), ("nothing.toml",)),
    ],
)
def test_wrong_options(
    arguments: tuple[str, ...], words: tuple[str, ...], tmp_path: Path, capsys: Capsys
) -> None:
    path = stored(tmp_path / "run.hilcal", "nothing", 1)
    line = refused(capsys, 2, "next", path, "-o", tmp_path / "n.json", *arguments)
    assert all(word in line for word in words)


# the demo


@pytest.mark.slow
def test_the_demo_settles_a_doubt(tmp_path: Path, capsys: Capsys) -> None:
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
    told = re.search(r"(\d+) readings were added. All (\d+)", result.err)
    assert told is not None
    assert 0 < int(told[1]) < int(told[2]) == len(readings)
    viewed = ok(capsys, "view", path, "--record", tmp_path / "demo.rrd", "--json").document
    assert viewed["revisions"] == [2, 3]


@pytest.mark.slow
def test_a_demo_without_devices_can_be_viewed(tmp_path: Path, capsys: Capsys) -> None:
    path = tmp_path / "demo.hilcal"
    ok(capsys, "demo", "--without-devices", "--hide", "nothing", "--poses", "6", "-o", path)
    ok(capsys, "view", path, "--record", tmp_path / "demo.rrd", "--json")


def rehearsal_of(seed: int, path: Path) -> RehearsalSettings:
    return RehearsalSettings(load_config(CELL), "random", seed, path, CELL.parent, installed())


def in_doubt_at_first(seed: int, path: Path) -> bool:
    """Whether the first readings of an ambiguous demo, which the seed determines, leave a doubt."""
    case, plan, doubtful = demo.doubtful_case(rehearsal_of(seed, path), None, print)
    assert doubtful
    assert case.choice in HARD_TO_SEPARATE
    secret = case_of_plan(case.config, plan, case.choice, case.seed)
    r = read_plan(secret, plan, [case.seed, 1])  # as `in_process` draws them
    d = judge(Evidence(fit(baseline(r.cell, r.readings, r.mode), r.readings, r.mode)), History())
    return d.verdict == "ambiguous" and case.choice in in_doubt(d)


@pytest.mark.long
def test_an_ambiguous_demo_is_in_doubt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "DRAWS", 2)
    assert in_doubt_at_first(2, tmp_path / "x")


@pytest.mark.slow
def test_every_ambiguous_demo_is_in_doubt(tmp_path: Path) -> None:
    assert all(in_doubt_at_first(seed, tmp_path / "x") for seed in range(10))


@pytest.mark.long
def test_a_case_without_a_doubt_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An effect that everything separates is hidden all the same, if that is asked for."""
    monkeypatch.setattr(demo, "TRIES", 2)
    monkeypatch.setattr(demo, "_resembled", lambda r, case: False)
    case, _, doubtful = demo.doubtful_case(rehearsal_of(0, tmp_path / "x"), "creep", print)
    assert case.choice == "creep"
    assert not doubtful
