"""The commands from import to view: exit codes, documents, words, one verdict everywhere."""

import json
from dataclasses import replace

import numpy as np
import pytest

from hilcal import __version__
from hilcal.campaign.campaign import Campaign
from hilcal.config import load_config
from hilcal.diagnosis.diagnosis import in_doubt
from hilcal.diagnosis.verdict import diagnose
from hilcal.drivers.simulated.rehearsal import simulate
from hilcal.effects.catalogue import installed
from hilcal.present.story import build_story
from hilcal.present.verdict import message
from hilcal.store.campaign_file import CampaignFile
from studies.diagnosis import judgement
from studies.study_cases import study_case
from tests.support.cli_cases import CELL, ok, refused, rehearsal, run, stored_readings
from tests.support.next_cases import SMALL, doubtful

ERROR = {"rms_m", "mean_m", "max_m", "rms_sigma"}


def test_import_says_what_was_read(campaign, tmp_path, capsys):
    path, csv = tmp_path / "new.hilcal", campaign.with_suffix(".csv")
    words = ok(capsys, "import", csv, "--config", CELL, "-o", path).out
    for part in ("70 readings of 14 poses", "ur10e", "10kg", "covariance: from the table"):
        assert part in words
    refused(capsys, 2, "import", csv, "--config", CELL, "-o", path)
    document = ok(capsys, "import", csv, "--config", CELL, "-o", path, "--force", "--json").document
    assert (document["n_readings"], document["n_poses"]) == (70, 14)
    assert document["loads"][0] == "none"


def test_identify_reports_what_the_contract_asks_for(campaign, capsys):
    d = ok(capsys, "identify", campaign, "--json").document
    assert d["model"] == ["base_frame", "joint_compliance"]
    assert d["readings"] == "deflection"
    assert d["scaling"] == "gc"
    assert d["n_readings"] == 70
    assert d["rank"] + d["dof"] == pytest.approx(3 * 56, abs=6)
    assert set(d["condition"]) == {"unscaled", "scaled"}
    assert d["condition"]["scaled"] < d["condition"]["unscaled"]
    low, high = d["variance_factor_interval"]
    assert low < d["variance_factor"] < high
    assert set(d["error"]) == {"before", "fit", "holdout"}
    assert all(set(block) == ERROR for block in d["error"].values())
    by_name = {p["name"]: p for p in d["parameters"]}
    j2 = by_name["joint_compliance.j2"]
    assert set(j2) == {"name", "value", "std", "unit", "identifiable"}
    assert j2["identifiable"]
    assert 1e-6 < j2["value"] < 1e-4
    assert 0 < j2["std"] < j2["value"]
    assert j2["unit"] == "rad/(N·m)"
    unseen = by_name["base_frame.x"]  # cancels in deflections
    assert (unseen["identifiable"], unseen["value"], unseen["std"]) == (False, None, None)
    assert d["inflated"] is True
    assert d["outliers"] == []
    assert len(d["registration"]) == 4
    words = ok(capsys, "identify", campaign, "--details").out
    for part in ("µrad/(N·m)", "Condition number", "widened", "Not determined", "noise alone"):
        assert part in words
    assert max(map(len, words.splitlines())) <= 100


@pytest.mark.long
def test_all_scalings_stand_side_by_side(campaign, capsys):
    d = ok(capsys, "identify", campaign, "--scaling", "all", "--json").document
    assert d["scaling"] == "gc"
    assert set(d["scalings"]) == {"none", "gu", "gc"}
    assert all(value["scaling"] == name for name, value in d["scalings"].items())
    assert d["scalings"]["gc"]["parameters"] == d["parameters"]
    assert d["scalings"]["none"]["parameters"] != d["parameters"]
    with CampaignFile.open(campaign) as stored:
        assert [r.options["scaling"] for r in stored.revisions()] == ["gc"]
    words = ok(capsys, "identify", campaign, "--scaling", "all").out
    assert "The same readings with every scaling" in words


@pytest.mark.long
def test_the_baseline_is_taken_where_there_is_no_revision_and_kept_by_what_changes_it(
    campaign, capsys
):
    result = ok(capsys, "compare", campaign, "--json")
    assert "no revision yet: using the baseline" in result.err
    d = result.document
    assert d["revision"] is None
    assert {"fit", "holdout"} == set(d["error"])
    assert all(set(w) == {"variable", "share", "p_value"} for w in d["where"])
    assert d["where"][0]["share"] > 0.3
    strongest = next(w for w in d["where"] if not w["variable"].startswith("direction"))
    assert "approach" in strongest["variable"]  # what hysteresis depends on
    assert d["worst"][0]["sigma"] > d["worst"][-1]["sigma"] > 3
    with CampaignFile.open(campaign) as stored:
        assert stored.revisions() == ()
    assert "made the baseline, revision 1" in ok(capsys, "add", campaign, "load_point").err
    again = ok(capsys, "compare", campaign, "--revision", "1", "--json")
    assert again.document["error"]["fit"] == pytest.approx(d["error"]["fit"])
    assert "baseline" not in again.err


def test_diagnose_names_the_missing_effect(campaign, capsys):
    d = ok(capsys, "diagnose", campaign, "--json").document
    assert d["verdict"] == "missing_effect"
    assert "hysteresis" in d["message"]
    first = d["suspects"][0]
    keys = {"effect", "p_value", "share", "holdout_share", "delta_bic", "same_as"}
    assert keys <= set(first)
    assert first["effect"] == "hysteresis"
    assert {"model", "variance_factor", "predictable_share", "where"} <= set(d)
    words = ok(capsys, "diagnose", campaign).out
    assert "an effect is missing" in words
    assert "hysteresis is missing" in words


def test_add_shows_the_error_before_and_after(campaign, capsys):
    d = ok(capsys, "add", campaign, "hysteresis", "--json").document
    before, after = d["revisions"]
    assert (before["revision"], before["added"]) == (1, None)
    assert (after["revision"], after["added"]) == (2, "hysteresis")
    assert set(after["error"]) == {"fit", "holdout"}
    assert after["error"]["holdout"]["rms_sigma"] < 0.6 * before["error"]["holdout"]["rms_sigma"]
    assert after["variance_factor"] < before["variance_factor"]
    assert d["verdict"] == "adequate"
    check_document(d)
    shown = {p["name"] for p in d["parameters"]}
    assert {"hysteresis.j1", "joint_compliance.j1"} <= shown
    in_file, _ = latest(campaign)
    assert (in_file["verdict"], in_file["message"]) == (d["verdict"], d["message"])
    assert "already" in refused(capsys, 2, "add", campaign, "hysteresis")
    words = ok(capsys, "add", campaign, "base_compliance").out
    assert "base_compliance.x" in words  # its parameters, and no others
    assert "hysteresis.j1" not in words
    assert "does not fall" in words  # the model is adequate without


@pytest.mark.long
def test_remove_takes_out_what_is_needless_and_says_what_is_not(campaign, capsys):
    ok(capsys, "add", campaign, "hysteresis")
    ok(capsys, "add", campaign, "tracker_scale")
    d = ok(capsys, "diagnose", campaign, "--json").document
    assert d["needless"] == ["tracker_scale"]
    words = " ".join(ok(capsys, "diagnose", campaign).out.split())
    assert "explained as well without tracker_scale" in words
    assert "hilcal remove RUN tracker_scale" in words
    d = ok(capsys, "remove", campaign, "tracker_scale", "--json").document
    assert (d["revisions"][-1]["added"], d["revisions"][-1]["removed"]) == (None, "tracker_scale")
    assert d["revisions"][-1]["model"] == ["base_frame", "joint_compliance", "hysteresis"]
    assert d["verdict"] == "adequate"
    result = ok(capsys, "remove", campaign, "hysteresis")
    assert "− hysteresis" in result.out
    assert "it is needed" in result.out
    assert "not in the model" in refused(capsys, 2, "remove", campaign, "hysteresis")
    assert "unknown effect" in refused(capsys, 2, "remove", campaign, "friction")


def test_refine_ends_adequate_and_keeps_every_revision(campaign, capsys):
    result = ok(capsys, "refine", campaign, "--json")
    d = result.document
    assert d["verdict"] == "adequate"
    errors = [r["error"]["holdout"]["rms_sigma"] for r in d["revisions"]]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1.3 < 2 < errors[0]
    assert d["revisions"][-1]["model"] == ["base_frame", "joint_compliance", "hysteresis"]
    low, high = d["revisions"][-1]["variance_factor_interval"]
    assert low < 1 < high
    assert "adding hysteresis" in result.err  # progress
    with CampaignFile.open(campaign) as stored:
        records = stored.revisions()
    assert [r.added for r in records] == [None, "hysteresis"]
    assert records[-1].result_json["diagnose"]["verdict"] == "adequate"


@pytest.mark.long
def test_refine_can_start_elsewhere(campaign, capsys):
    refused(capsys, 2, "refine", campaign, "--from-latest")
    ok(capsys, "add", campaign, "hysteresis")
    d = ok(capsys, "refine", campaign, "--from-latest", "--json").document
    assert [r["revision"] for r in d["revisions"]] == [2]  # adequate already: nothing is stored
    with CampaignFile.open(campaign) as stored:
        assert len(stored.revisions()) == 2
    refused(capsys, 2, "refine", campaign, "--from-latest", "--effects", "hysteresis")
    chosen = ("--effects", "hysteresis,joint_compliance", "--readings", "absolute")
    d = ok(capsys, "refine", campaign, *chosen, "--json").document
    assert d["revisions"][0]["model"] == ["base_frame", "hysteresis", "joint_compliance"]
    assert {r["readings"] for r in d["revisions"]} == {"absolute"}
    with CampaignFile.open(campaign) as stored:  # what was fitted last is what is gone on with
        assert stored.revisions()[-1].options["readings"] == "absolute"
    assert ok(capsys, "identify", campaign, "--json").document["readings"] == "absolute"


@pytest.mark.long
def test_what_is_stored_already_is_not_stored_again(campaign, capsys):
    def numbers():
        with CampaignFile.open(campaign, read_only=True) as stored:
            return [r.number for r in stored.revisions()]

    first = ok(capsys, "identify", campaign, "--json").document
    assert ok(capsys, "identify", campaign, "--json").document == first
    words = " ".join(ok(capsys, "identify", campaign).out.split())
    assert f"Revision 1 of {campaign} is this fit already; nothing was stored." in words
    ok(capsys, "identify", campaign, "--scaling", "gu")  # another one
    assert numbers() == [1, 2]
    refined = ok(capsys, "refine", campaign, "--json").document
    assert [r["revision"] for r in refined["revisions"]] == [3, 4]
    assert ok(capsys, "refine", campaign, "--json").document == refined
    assert "Revision 4 is this model already" in ok(capsys, "refine", campaign).out
    again = ok(capsys, "refine", campaign, "--revision", "3", "--json").document
    assert [r["revision"] for r in again["revisions"]] == [3, 4]
    assert numbers() == [1, 2, 3, 4]
    # the latest revision is what is used: an earlier one is made again
    assert ok(capsys, "identify", campaign, "--json").document["revision"] == 5
    assert "Revision 5" not in ok(capsys, "refine", campaign).out
    assert numbers() == [1, 2, 3, 4, 5, 6, 7]


@pytest.mark.long
def test_validate_finds_the_place_of_a_tracker_that_was_set_up_anew(campaign, tmp_path, capsys):
    ok(capsys, "refine", campaign)
    r = rehearsal("hysteresis")
    readings, rng = r.readings, np.random.default_rng(3)
    state = readings.states, readings.pose, readings.load, readings.cycle, readings.load_names
    moved = np.eye(4)
    moved[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    moved[:3, 3] = 2.0, 1.5, -0.4
    there = replace(r.world, registration=moved)
    far = stored_readings(tmp_path / "far.hilcal", simulate(there, *state, rng), r.config)
    assert "--register" in ok(capsys, "validate", campaign, far).out
    again = ok(capsys, "validate", campaign, far, "--register", "--json").document
    assert set(again["error"]) == ERROR
    assert again["registered"] is True
    assert again["error"]["rms_sigma"] < 1.3
    page, place = tmp_path / "page.html", "--register fits its place first"
    options = "report", campaign, "--validation", far, "--limit", "1 mm", "-o", page, "--json"
    assert ok(capsys, *options).document["passed"] is False
    assert place in page.read_text(encoding="utf-8")
    assert ok(capsys, *options, "--register").document["passed"] is True
    assert place not in page.read_text(encoding="utf-8")


def test_effects_lists_the_catalogue(capsys):
    d = ok(capsys, "effects", "--json").document
    assert [e["name"] for e in d["effects"]] == list(installed().names)
    assert all(e["law"] and e["parameters"] for e in d["effects"])
    assert {e["source"] for e in d["effects"]} == {"built in"}
    words = ok(capsys, "effects").out
    assert all(name in words for name in installed().names)
    assert "expected 1e-05 rad" in words  # half of 2e-5 rad, not 9.9e-06


def test_study_scaling_and_a_scheduler_that_anybody_can_reach(capsys):
    d = ok(capsys, "study", "scaling", "--runs", "20", "--json").document
    assert d["runs"] == 20
    assert set(d["summary"]) == {"none", "gu", "gc"}
    given = ("study", "scaling", "--workers", "2", "--scheduler", "tcp://127.0.0.1:1")
    said, error = run(capsys, *given).err.splitlines()
    assert said.startswith("--scheduler tcp://127.0.0.1:1: without TLS")
    assert error.startswith("error: ")


def test_version_and_help(capsys):
    assert ok(capsys, "--version").out == f"hilcal {__version__}\n"
    result = run(capsys)
    assert result.code == 2
    assert "refine" in result.out + result.err
    assert "Traceback" not in result.err


UR5E = load_config(CELL).with_keys("robot", model="ur5e")


def study(mode, *hidden, seed=1, **options):
    c = study_case(UR5E, "ur5e", mode, hidden, options.pop("strength", 3.0), seed, **options)
    return UR5E, c.readings


def doubtful_at_first():
    return SMALL, doubtful("base_compliance", 2).rehearsal.readings


LOADS, POSITIONS = "deflection", "absolute"
CASES = {
    "missing": (LOADS, "missing_effect", lambda: study(LOADS, "creep", n_poses=12)),
    "ambiguous": (POSITIONS, "ambiguous", doubtful_at_first),
    "unknown although tried": (
        LOADS,
        "unknown_effect",
        lambda: study(LOADS, "relaxing bench", n_poses=12),
    ),
    "noise": (LOADS, "noise_misjudged", lambda: study(LOADS, stated=0.5, cycles=2)),
}
"""By case: kind of readings, the verdict on the baseline, and what makes cell and readings."""


def check_document(d):
    """One document, one verdict; and it is without contradiction."""
    inner = d.get("diagnosis", d)
    assert (d["verdict"], d["message"]) == (inner["verdict"], inner["message"])
    if "revisions" in d:
        assert d["revisions"][-1]["verdict"] == d["verdict"]
    suspects = inner["suspects"]
    words = d["message"]
    rejected = inner["rejected"]
    for name in rejected:
        assert f"{name} is missing" not in words
    if "does not" in words and "lower the error" in words:
        assert "is missing" not in words
    if d["verdict"] == "missing_effect" or inner["beyond"] is not None:
        assert words.startswith(suspects[0]["effect"])
    passing = [s["effect"] for s in suspects if s["significant"]]
    assert passing == [s["effect"] for s in suspects[: len(passing)]]
    evidence = [s["log_evidence"] for s in suspects[: len(passing)]]
    assert evidence == sorted(evidence, reverse=True)
    assert set(passing).isdisjoint(rejected)


def latest(path):
    """The diagnosis as it is in the file, and as the library makes it."""
    with Campaign.open(path) as campaign:
        record = campaign.latest()
        return record.result_json["diagnose"], diagnose(campaign.fit(), campaign.history())


def check_doors(path, expected, capsys, tmp_path):
    """Every way to the diagnosis of the latest revision ends in the same verdict and message."""
    said = (expected["verdict"], expected["message"])
    d = ok(capsys, "diagnose", path, "--json").document
    check_document(d)
    assert (d["verdict"], d["message"]) == said
    with Campaign.open(path) as campaign:
        judged = diagnose(campaign.fit(), campaign.history())
        story = build_story(campaign.chapters())
    assert (judged.verdict, message(judged)) == said
    kept = judgement(judged)
    assert (kept.verdict, kept.message) == said
    assert kept.lead == d["suspects"][0]["effect"]
    last = story.revisions[-1]
    assert last.verdict == said[0]
    assert str(last.panels["verdict"][0]).removesuffix(".")[1:] == said[1].removesuffix(".")[1:]
    result = run(
        capsys, "next", path, "-o", tmp_path / "n.json", "--quick", "--poses", "1", "--json"
    )
    if said[0] == "ambiguous":
        assert result.code == 0, result.err
        assert tuple(result.document["suspects"]) == in_doubt(judged)
    else:
        assert result.code == 4, result.err
        assert "no suspects to separate" in result.err


FAST = ("missing", "unknown although tried")
"""The doors of an ambiguous one are those of these, but for `next`: see test_next_cli."""


@pytest.mark.parametrize(
    "case",
    [pytest.param(c, marks=pytest.mark.long if c in FAST else pytest.mark.slow) for c in CASES],
)
def test_one_verdict_through_every_door(case, tmp_path, capsys):
    mode, verdict, make = CASES[case]
    config, readings = make()
    path = stored_readings(tmp_path / "run.hilcal", readings, config)
    ok(capsys, "identify", path, "--readings", mode)
    first = ok(capsys, "diagnose", path, "--json").document
    assert first["verdict"] == verdict, first["message"]
    check_doors(path, first, capsys, tmp_path)

    refined = ok(capsys, "refine", path, "--readings", mode, "--json").document
    check_document(refined)
    assert refined["rejected"] == refined["diagnosis"]["rejected"]
    in_file, judged = latest(path)
    assert (in_file["verdict"], in_file["message"]) == (refined["verdict"], refined["message"])
    assert json.loads(json.dumps(judged.to_dict()["rejected"])) == refined["rejected"]
    check_doors(path, refined, capsys, tmp_path)
    with CampaignFile.open(path) as file:
        for record, row in zip(file.revisions()[1:], refined["revisions"], strict=True):
            assert record.result_json["diagnose"]["verdict"] == row["verdict"]
    again = ok(capsys, "refine", path, "--from-latest", "--json").document
    assert (again["verdict"], again["message"]) == (refined["verdict"], refined["message"])
