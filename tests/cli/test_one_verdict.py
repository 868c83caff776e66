"""One diagnosis: the same verdict and message through every command, the library and the file."""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hilcal.campaign.campaign import Campaign
from hilcal.config import CellConfig, load_config
from hilcal.diagnosis.diagnosis import Diagnosis, in_doubt
from hilcal.diagnosis.document import to_json
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit
from hilcal.present.story import build_story
from hilcal.present.verdict import message
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode
from hilcal.refinement import refine
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from studies.diagnosis import judgement
from studies.serial_noise import serial_readings
from studies.study_cases import study_case
from tests.support.cli_cases import CELL, ok, run
from tests.support.next_cases import SMALL, doubtful

Capsys = pytest.CaptureFixture[str]
CELLS = str(configs_dir() / "cells")
UR5E = load_config(CELL).model_copy(
    update={"robot": load_config(CELL).robot.model_copy(update={"model": "ur5e"})}
)


def stored(path: Path, config: CellConfig, readings: Readings, mode: Mode) -> Path:
    """A campaign file with its readings alone."""
    with CampaignFile.create(path, config.to_json(), CELLS, "a test") as file:
        file.append_readings(readings)
    return path


def study(mode: Mode, *hidden: str, seed: int = 1, **options: Any) -> tuple[CellConfig, Readings]:
    c = study_case(UR5E, "ur5e", mode, hidden, options.pop("strength", 3.0), seed, **options)
    return UR5E, c.readings


def correlated() -> tuple[CellConfig, Readings]:
    c = study_case(UR5E, "ur5e", "absolute", (), 1.0, 3, n_poses=12)
    return UR5E, serial_readings(c, 0.9, np.random.default_rng(3))


CASES = {
    "missing": ("deflection", lambda: study("deflection", "creep", n_poses=12)),
    "ambiguous": (
        "absolute",
        lambda: (SMALL, doubtful("base_compliance", 2).rehearsal.readings),
    ),
    "unknown": ("absolute", lambda: study("absolute", "swaying bench")),
    "unknown although tried": (
        "deflection",
        lambda: study("deflection", "relaxing bench", n_poses=12),
    ),
    "adequate": ("deflection", lambda: study("deflection")),
    "noise": ("deflection", lambda: study("deflection", stated=0.5, cycles=2)),
    "correlated": ("absolute", lambda: correlated()),
}
FIRST = {
    "missing": "missing_effect",
    "ambiguous": "ambiguous",
    "unknown": "unknown_effect",
    "unknown although tried": "unknown_effect",
    "adequate": "adequate",
    "noise": "noise_misjudged",
    "correlated": "adequate",
}


def check_document(d: Mapping[str, Any]) -> None:
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


def latest(path: Path) -> tuple[Mapping[str, Any], Diagnosis]:
    """The diagnosis as it is in the file, and as the library makes it."""
    with Campaign.open(path) as campaign:
        record = campaign.latest()
        assert record is not None
        return record.result_json["diagnose"], diagnose(campaign.fit(), campaign.history())


def check_doors(path: Path, expected: Mapping[str, Any], capsys: Capsys, tmp_path: Path) -> None:
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
def test_one_verdict_through_every_door(case: str, tmp_path: Path, capsys: Capsys) -> None:
    mode, make = CASES[case]
    path = stored(tmp_path / "run.hilcal", *make(), mode)
    ok(capsys, "identify", path, "--readings", mode)
    first = ok(capsys, "diagnose", path, "--json").document
    assert first["verdict"] == FIRST[case], first["message"]
    check_doors(path, first, capsys, tmp_path)

    refined = ok(capsys, "refine", path, "--readings", mode, "--json").document
    check_document(refined)
    assert refined["rejected"] == refined["diagnosis"]["rejected"]
    in_file, judged = latest(path)
    assert (in_file["verdict"], in_file["message"]) == (refined["verdict"], refined["message"])
    assert json.loads(json.dumps(to_json(judged)["rejected"])) == refined["rejected"]
    check_doors(path, refined, capsys, tmp_path)
    with CampaignFile.open(path) as file:
        for record, row in zip(file.revisions()[1:], refined["revisions"], strict=True):
            assert record.result_json["diagnose"]["verdict"] == row["verdict"]
    again = ok(capsys, "refine", path, "--from-latest", "--json").document
    assert (again["verdict"], again["message"]) == (refined["verdict"], refined["message"])


def test_adding_gives_the_verdict_that_is_stored_and_diagnosed(
    tmp_path: Path, capsys: Capsys
) -> None:
    path = stored(tmp_path / "run.hilcal", *study("deflection", "creep", n_poses=12), "deflection")
    ok(capsys, "identify", path)
    for name in ("creep", "hysteresis"):
        d = ok(capsys, "add", path, name, "--json").document
        check_document(d)
        in_file, _ = latest(path)
        assert (in_file["verdict"], in_file["message"]) == (d["verdict"], d["message"])
        again = ok(capsys, "diagnose", path, "--json").document
        assert (again["verdict"], again["message"]) == (d["verdict"], d["message"])


@pytest.mark.long
def test_the_steps_of_a_refinement_carry_what_it_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    """The effect that each step adds is the first suspect of the step before."""
    c = study_case(UR5E, "ur5e", "deflection", ("relaxing bench",), 3.0, 0, n_poses=12)
    answers = iter([False])  # the first trial does not lower the error on poses left out

    def predicts_better(before: Fit, after: Fit) -> bool:
        return next(answers, None) is None and judged(before, after)

    refinement = sys.modules["hilcal.refinement"]  # hilcal.refine is a function of the library
    judged = refinement.predicts_better
    monkeypatch.setattr(refinement, "predicts_better", predicts_better)
    start = baseline(c.cell, c.readings, "deflection")
    r = refine(start, c.readings, "deflection", background=False)
    assert len(r.rejected) == 1
    assert r.diagnosis is r.steps[-1].diagnosis
    for before, after in zip(r.steps, r.steps[1:], strict=False):
        if after.removed is None:
            assert before.diagnosis.suspects[0].effect == after.added
    for step in r.steps:
        assert set(step.diagnosis.significant).isdisjoint(step.diagnosis.history.rejected)
