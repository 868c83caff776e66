"""Every message that names a next step names one that works: it is taken as it stands."""

import html
import json
import re
import shlex
from dataclasses import replace

import pandas as pd
import pytest

import hilcal as hc
from hilcal.campaign.campaign import Campaign
from hilcal.campaign.changes import change_cell
from hilcal.diagnosis.order_step import OrderStep
from hilcal.diagnosis.verdict import diagnose
from hilcal.diagnosis.wrong_figures import WrongFigure
from hilcal.errors import CannotAnswerError, InputError
from hilcal.procedure.next_plan import doubt_to_settle
from hilcal.refinement import refine
from hilcal.robot.catalogue import configs_dir, load_arm
from hilcal.store.campaign_file import CampaignFile
from hilcal.tables.parquet_stream import open_stream
from hilcal.tables.table import write_table
from tests.support.cli_cases import CELL, imported, ok, refused, rehearsal
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
    result = ok(capsys, "identify", later, "--prior", run)
    assert "nothing to carry over" not in result.err
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


def quiet(text):
    """Take progress."""


@pytest.mark.long
def test_a_revision_in_a_cell_that_was_changed(fitted, capsys):
    run = fitted
    with Campaign.open(run) as o:
        change_cell(o, 1, o.fit(), {"tool": {"mass_kg": 1.4}}, quiet)
    said = refused(capsys, 2, "diagnose", run, "--revision", "1")
    follow(capsys, said, f"hilcal accept '{run}' 1")
    ok(capsys, "diagnose", run, "--revision", "1")


def test_what_accept_says(fitted, capsys):
    run = fitted
    ok(capsys, "identify", run, "--effects", "joint_compliance")
    follow(capsys, ok(capsys, "accept", run, "1").out, f"hilcal accept '{run}' --release")
    assert ok(capsys, "info", run, "--json").document["accepted"] is None


@pytest.mark.long
def test_masses_that_a_description_lacks(tmp_path, capsys):
    text = (configs_dir() / "robots" / "ur10e.toml").read_text()
    arm, cell, path = tmp_path / "arm.toml", tmp_path / "cell.toml", tmp_path / "run.hilcal"
    arm.write_text(re.sub(r"(?m)^(mass_kg|com_m|weight_kg) = .*\n", "", text))
    cell.write_text(CELL.read_text().replace('model = "ur10e"', f'model = "{arm}"'))
    write_table(rehearsal("nothing", 1, 12).readings, csv := tmp_path / "t.csv")
    ok(capsys, "import", csv, "--config", cell, "-o", path)
    options = ("--readings", "absolute", "--effects", "base_frame,joint_compliance")
    said = ok(capsys, "identify", path, *options).out
    follow(capsys, said, "hilcal add RUN link_mass", RUN=path)
    assert "hilcal add" not in ok(capsys, "info", path).out


@pytest.mark.long
def test_an_effect_that_an_earlier_model_lacks(run, tmp_path, capsys):
    later = imported(tmp_path / "later.hilcal", seed=2)
    ok(capsys, "identify", run)
    said = ok(capsys, "compare", run, later).out
    follow(capsys, said, "hilcal refine EARLIER", EARLIER=run)
    assert "for this comparison alone" not in ok(capsys, "compare", run, later).out


def test_what_a_diagnosis_says(fitted, capsys):
    said = ok(capsys, "diagnose", fitted).out
    assert "falls from" in follow(capsys, said, f"hilcal add '{fitted}' hysteresis").out
    said = ok(capsys, "diagnose", fitted, "--revision", "1").out
    follow(capsys, said, f"hilcal add '{fitted}' hysteresis --revision 1")


@pytest.mark.long
def test_what_a_diagnosis_says_of_a_background(fitted, capsys, monkeypatch, tmp_path):
    def judged(*args):
        return replace(diagnose(*args), reason="background", suspects=())

    monkeypatch.setattr("hilcal.cli.refining.judge", judged)
    said = ok(capsys, "diagnose", fitted).out
    step = f"hilcal plan CELL.toml -o PLAN.json --after '{fitted}'"
    places = {"CELL.toml": CELL, "PLAN.json": tmp_path / "plan.json"}
    said = follow(capsys, said, step, **places).out
    places = {"READINGS.csv": tmp_path / "t.csv"}
    follow(capsys, said, f"hilcal export '{fitted}' --readings READINGS.csv", **places)
    assert f"hilcal import READINGS.csv --config {CELL} -o NEW.hilcal" in " ".join(said.split())


DISCOVER = "hilcal discover {run} -o law.py"
PLAN_AFTER = "hilcal plan CELL.toml -o PLAN.json --after {run}"


@pytest.mark.parametrize(
    ("name", "reason", "step"),
    [
        ("diagnose", "no_suspect", DISCOVER),
        ("refine", "no_suspect", DISCOVER),
        ("refine", "background", PLAN_AFTER),
    ],
)
def test_the_last_line_is_the_next_command(run, capsys, monkeypatch, name, reason, step):
    def unexplained(d):
        return replace(d, reason=reason, suspects=())

    def refined(*args):
        refinement = refine(*args)
        last = refinement.steps[-1]
        last = replace(last, diagnosis=unexplained(last.diagnosis))
        return replace(refinement, steps=(*refinement.steps[:-1], last))

    monkeypatch.setattr("hilcal.cli.refining.judge", lambda *a: unexplained(diagnose(*a)))
    monkeypatch.setattr("hilcal.cli.refining.refine_model", refined)
    said = ok(capsys, name, run).out
    assert said.splitlines()[-1].strip() == step.format(run=f"'{run}'")


@pytest.mark.parametrize(("reason", "words", "step"), [
    ("wrong_figure", "a figure of the cell", "hilcal diagnose {run}"),
    ("step", "moved in the middle", "hilcal export {run} --readings READINGS.csv"),
    ("one_suspect", "hysteresis alone is missing", "hilcal add {run} hysteresis"),
    *(
        pytest.param(*further, marks=pytest.mark.long)
        for further in (
            ("misjudged_noise", "the noise is misjudged", "hilcal diagnose {run}"),
            ("no_suspect", "no effect of the catalogue explains", "hilcal diagnose {run}"),
            ("background", "one by one", PLAN_AFTER),
            ("residual_is_noise", "is adequate", PLAN_AFTER),
        )
    )])  # fmt: skip
def test_what_next_says_of_each_verdict(fitted, tmp_path, capsys, reason, words, step):
    run = fitted
    cell = tmp_path / "cell.toml"
    cell.write_text(re.sub(r"candidates = \d+", "candidates = 60\nagainst = []", CELL.read_text()))
    with Campaign.open(run) as o:
        d = diagnose(o.fit(), o.history())
        if reason == "step":
            shifted = OrderStep(("target",), 20, 19, 1e-5, 1e-3, 0.9)
            d = replace(d, reason="no_suspect", step=shifted)
        else:
            d = replace(d, reason=reason)
        wrong = (
            (WrongFigure("mass", "5kg", (5.0,), (9.8,), "kg", 1e-4, 2e-5),)
            if "figure" in reason
            else ()
        )
        with pytest.raises(CannotAnswerError, match=words) as said:
            doubt_to_settle(o, replace(d, wrong_figures=wrong), quiet)
    places = {"CELL.toml": cell, "PLAN.json": tmp_path / "p.json"}
    places["READINGS.csv"] = tmp_path / "t.csv"
    follow(capsys, str(said.value), step.format(run=f"'{run}'"), **places)


def test_a_stream_of_several_targets(run, tmp_path, capsys):
    frame = pd.read_csv(run.with_suffix(".csv")).assign(target="one")
    frame.drop(columns=["pose", "load"]).to_parquet(path := tmp_path / "t.parquet")
    with pytest.raises(InputError, match="import a table of several with `hilcal import`"):
        open_stream(path, load_arm("ur10e"), None, None)
    cell = tmp_path / "cell.toml"
    one = r'targets = [{ name = "one", target_m = \1 }]'
    cell.write_text(re.sub(r"(?m)^target_m = (.*)$", one, CELL.read_text()))
    frame.to_parquet(path)
    ok(capsys, "import", path, "--config", cell, "-o", tmp_path / "t.hilcal")


def test_sections_of_a_cell(tmp_path, capsys):
    said = ok(capsys, "config").out
    follow(capsys, said, "hilcal config SECTION", SECTION="tracker")
    assert "hilcal init writes a file" in said
    ok(capsys, "init", path := tmp_path / "CELL.toml", "--robot", "ur3")
    assert "hilcal config SECTION explains" in path.read_text()
