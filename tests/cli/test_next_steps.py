"""Every message that names a next step names one that works: it is taken as it stands."""

import html
import json
import re
import shlex
from dataclasses import replace

import pytest

import hilcal as hc
from hilcal.diagnosis.comparison import Comparison
from hilcal.store.campaign_file import CampaignFile
from tests.support.cli_cases import CELL, imported, ok, refused
from tests.support.cli_cases import run as command


def follow(capsys, said, step, **places):
    """Take a step that a message names; its words in capitals stand for places."""
    assert step in " ".join(said.split()), said
    chosen = [str(places.get(word, word)) for word in shlex.split(step)]
    assert chosen[0] == "hilcal"
    return ok(capsys, *chosen[1:])


@pytest.fixture
def run(tmp_path):
    """A campaign without revisions; its name must be quoted."""
    return imported(tmp_path / "a run.hilcal")


@pytest.fixture
def fitted(tmp_path):
    """The same with the baseline."""
    return imported(tmp_path / "a run.hilcal", then=("identify",))


@pytest.mark.long
def test_without_a_revision(run, tmp_path, capsys):
    out, later = tmp_path / "p.json", imported(tmp_path / "later.hilcal", seed=2)
    for arguments in (
        ("accept", run),
        ("export", run, "--parameters", out),
        ("export", run, "--calibration", out),
        ("identify", later, "--prior", run),
    ):
        assert "hilcal identify" in refused(capsys, 2, *arguments)
    assert "hilcal identify and refine make one" in ok(capsys, "info", run).out
    assert "hilcal identify stores it" in " ".join(ok(capsys, "diagnose", run).err.split())
    assert "hilcal refine makes a model" in " ".join(ok(capsys, "compare", run, later).err.split())
    ok(capsys, "identify", run)
    for arguments in (("accept", run), ("export", run, "--parameters", out), ("diagnose", run)):
        assert "no revision" not in ok(capsys, *arguments).err
    ok(capsys, "refine", run)
    assert "no revision" not in ok(capsys, "compare", run, later).err


def test_readings_were_appended(fitted, capsys):
    run = fitted
    ok(capsys, "accept", run)
    with hc.Campaign.open(run) as opened:
        first = opened.readings[opened.readings.pose == 0]
    with CampaignFile.open(run) as file:
        file.append_readings(replace(first, pose_names=("one more", *first.pose_names[1:])))
    said = refused(capsys, 2, "diagnose", run)
    assert "run hilcal identify again" in said
    ok(capsys, "identify", run)
    follow(capsys, said, f"hilcal accept '{run}' --release")
    ok(capsys, "diagnose", run)


@pytest.mark.long
def test_another_scaling_or_parameters_of_another_version(run, capsys):
    ok(capsys, "identify", run, "--scaling", "gu")
    said = refused(capsys, 2, "diagnose", run)
    follow(capsys, f"{said} hilcal identify RUN", "hilcal identify RUN", RUN=run)
    ok(capsys, "diagnose", run)
    with CampaignFile.open(run) as file:
        record = file.revisions()[-1]
        stored = record.parameters_json
        names = [f"{n}_as_it_was" for n in stored["names"]]
        file.append_revision(replace(record, parameters_json={**stored, "names": names}))
    assert "other parameters; run hilcal identify again" in refused(capsys, 2, "diagnose", run)
    ok(capsys, "identify", run)
    ok(capsys, "diagnose", run)


@pytest.mark.long
def test_an_effect_of_ones_own(run, tmp_path, capsys):
    empty, path = tmp_path / "empty.py", tmp_path / "my effect.py"
    empty.write_text("")
    said = refused(capsys, 2, "effects", "--effects-from", empty)
    assert "hilcal effects new NAME writes one" in said
    said = ok(capsys, "effects", "new", "my_effect", "-o", path).out
    for step in ("effects --effects-from", "diagnose RUN.hilcal --effects-from"):
        follow(capsys, said, f"hilcal {step} '{path}'", **{"RUN.hilcal": run})
    ok(capsys, "add", run, "my_effect", "--effects-from", path)
    path.write_text(f"{path.read_text()}\n# changed\n")
    said = refused(capsys, 2, "diagnose", run, "--effects-from", path)
    assert "fit again: hilcal identify or refine" in said
    ok(capsys, "identify", run, "--effects-from", path)
    ok(capsys, "diagnose", run, "--effects-from", path)


def test_deflections_lack_the_unloaded_arm(run, tmp_path, capsys):
    ok(capsys, "identify", run, "--readings", "deflection")
    said = refused(capsys, 4, "export", run, "--urdf", tmp_path / "arm.urdf")
    follow(capsys, said, "hilcal identify RUN --readings absolute", RUN=run)
    ok(capsys, "export", run, "--urdf", tmp_path / "arm.urdf")


@pytest.mark.long
def test_nothing_to_carry_over(run, tmp_path, capsys):
    later = imported(tmp_path / "later.hilcal", poses=9)
    ok(capsys, "identify", run, "--readings", "absolute", "--effects", "base_frame")
    said = refused(capsys, 4, "identify", later, "--prior", run)
    assert "run hilcal refine first" in said
    ok(capsys, "refine", run)
    told = ok(capsys, "identify", later, "--prior", run)
    assert "nothing to carry over" not in told.err
    assert "--prior OTHER.hilcal" in refused(capsys, 2, "identify", later, "--drift", "creep=1")
    ok(capsys, "identify", later, "--prior", run, "--drift", "joint_compliance=1")


@pytest.mark.long
def test_what_a_comparison_says(run, tmp_path, capsys):
    later = imported(tmp_path / "later.hilcal", "creep", poses=9)
    ok(capsys, "identify", run)
    said = command(capsys, "compare", run, later).out
    follow(capsys, said, f"hilcal refine {later} --prior '{run}'")
    said = ok(capsys, "identify", later, "--prior", run).out
    follow(capsys, said, "hilcal compare EARLIER LATER", EARLIER=run, LATER=later)


def test_files_that_are_not_there_yet(run, tmp_path, capsys):
    assert "make one with: hilcal plan" in refused(
        capsys, 2, "check", CELL, "--plan", tmp_path / "plan.json"
    )
    unsafe = tmp_path / "unsafe.json"
    poses = [{"name": n, "q_rad": [9.0, -1.5, 0.5, 0.0, 0.0, 0.0]} for n in "ab"]
    steps = [{"pose": n, "load": "none", "cycle": 0} for n in "ab"]
    head = {"format": "hilcal-plan", "version": 1}
    unsafe.write_text(json.dumps({**head, "poses": poses, "steps": steps}))
    said = refused(capsys, 2, "run", CELL, "--plan", unsafe, "-o", tmp_path / "r.hilcal")
    assert "hilcal check --plan shows all" in said
    shown = command(capsys, "check", CELL, "--plan", unsafe)
    assert shown.code == 2
    assert "pose a: shoulder_pan is at 9 rad" in shown.out
    assert "pose b: shoulder_pan is at 9 rad" in shown.out
    other = tmp_path / "other.csv"
    text = run.with_suffix(".csv").read_text().splitlines()
    header = text[0].replace("q1_rad", "A1").replace("x_m", "X")
    other.write_text("\n".join([header, *text[1:]]))
    said = refused(capsys, 2, "import", other, "--config", CELL, "-o", tmp_path / "o.hilcal")
    follow(capsys, said, "hilcal import TABLE --preview", TABLE=other)
    assert "hilcal config explains every key" in command(capsys, "doctor", other).out
    follow(capsys, "hilcal config", "hilcal config")


@pytest.mark.long
def test_what_a_report_names(run, tmp_path, capsys, monkeypatch):
    page = tmp_path / "page.html"
    ok(capsys, "report", run, "-o", page)
    assert "hilcal refine finds the effects that are missing" in page.read_text()
    ok(capsys, "refine", run)
    ok(capsys, "report", run, "-o", page, "--appendix")
    text = html.unescape(page.read_text())
    assert "hilcal accept RUN N chooses another" in text
    monkeypatch.chdir(tmp_path)
    named = set(re.findall(r"hilcal (?:info|compare|diagnose) 'a run.hilcal'[^<]*", text))
    assert len(named) == 3
    for step in sorted(named):
        follow(capsys, text, step)
    ok(capsys, "accept", run, "1")


def test_a_campaign_that_calibrate_did_not_make(run, capsys):
    said = refused(capsys, 2, "calibrate", CELL, "-o", run)
    follow(capsys, said, f"hilcal info '{run}'")


@pytest.mark.long
def test_another_arm_is_calibrated_by_itself(run, tmp_path, capsys, monkeypatch):
    later = imported(tmp_path / "later.hilcal", seed=2)
    ok(capsys, "identify", run)
    monkeypatch.setattr(Comparison, "another_arm", True)
    follow(capsys, ok(capsys, "compare", run, later).out, f"hilcal refine {later}")
