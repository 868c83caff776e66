"""Next steps that messages name in states that are reached less often; see test_next_steps."""

import html
import re
from dataclasses import replace

import pandas as pd
import pytest

from hilcal.campaign.campaign import Campaign
from hilcal.campaign.changes import change_cell
from hilcal.diagnosis.order_step import OrderStep
from hilcal.diagnosis.verdict import diagnose
from hilcal.diagnosis.wrong_figures import WrongFigure
from hilcal.discovery.discovery import Discovery
from hilcal.errors import CannotAnswerError, InputError
from hilcal.present.diagnosis import addition_lines, no_law_sentence
from hilcal.present.story import build_story
from hilcal.procedure.next_plan import doubt_to_settle
from hilcal.robot.catalogue import configs_dir, load_arm
from hilcal.store.campaign_file import CampaignFile
from hilcal.tables.parquet_stream import open_stream
from hilcal.tables.table import write_table
from tests.cli.test_fit_beside_run import spoil
from tests.cli.test_next_steps import fitted, follow, run
from tests.support.cli_cases import CELL, imported, ok, refused, rehearsal

__all__ = ["fitted", "run"]


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
def test_a_revision_of_other_targets(run, capsys):
    ok(capsys, "identify", run)
    with CampaignFile.open(run) as file:
        record = file.revisions()[-1]
        stored = record.parameters_json
        twice = {**stored, "targets": [stored["target"], stored["target"]]}
        file.append_revision(replace(record, parameters_json=twice))
    assert "2 targets, the cell has 1; run hilcal identify again" in refused(
        capsys, 2, "diagnose", run
    )
    ok(capsys, "identify", run)
    ok(capsys, "diagnose", run)


@pytest.mark.long
def test_a_bad_revision_is_set_aside_and_fitted_again(fitted, capsys):
    run = fitted
    with Campaign.open(run) as o:
        found = o.fit()
    spoil(run, found, "damage")
    said = refused(capsys, 2, "diagnose", run)
    told = follow(capsys, said, f"hilcal repair '{run}'").out
    follow(capsys, told, f"hilcal identify '{run}'")
    ok(capsys, "diagnose", run)


def test_what_a_file_for_others_lacks(run, tmp_path, capsys):
    ok(capsys, "identify", run, "--effects", "joint_compliance,creep", "--readings", "absolute")
    told = ok(capsys, "export", run, "--urdf", tmp_path / "arm.urdf").out
    assert "as not constant" in told
    assert "hilcal compensate corrects it" in told
    (points := tmp_path / "p.csv").write_text(
        "q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,load\n0.1,-1.5,1.2,-1.0,0.7,0.2,5kg\n"
    )
    ok(capsys, "compensate", run, points, "--json")


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


@pytest.mark.long
def test_an_addition_that_breaks_its_promise(run, capsys):
    ok(capsys, "add", run, "hysteresis")
    with Campaign.open(run) as o:
        suspect = next(iter(diagnose(o.fit(), o.history()).suspects))
    said = " ".join(addition_lines(replace(suspect, effect="hysteresis", kept=0.1)))
    follow(capsys, said, "hilcal remove RUN hysteresis", RUN=run)


PLAN_AFTER = "hilcal plan CELL.toml -o PLAN.json --after {run}"


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


@pytest.mark.long
def test_a_law_that_effects_explain_as_well(run, capsys):
    ok(capsys, "identify", run)
    with Campaign.open(run) as o:
        said = no_law_sentence(Discovery(o.fit(), "catalogue", catalogue=("hysteresis",)))
    assert "hilcal refine adds them" in said
    assert ok(capsys, "refine", run, "--json").document["revisions"][-1]["added"] == "hysteresis"


@pytest.mark.long
def test_what_a_recording_names(run, tmp_path, capsys):
    ok(capsys, "identify", run, "--scaling", "gu")
    with Campaign.open(run) as o:
        assert (
            "run hilcal diagnose for a verdict"
            in build_story(o.chapters()).revisions[-1].panels["verdict"][0]
        )
    ok(capsys, "identify", run)
    ok(capsys, "diagnose", run)
    with Campaign.open(run) as o:
        assert "run hilcal" not in build_story(o.chapters()).revisions[-1].panels["verdict"][0]
    assert "hysteresis" in ok(capsys, "refine", run).out
    ok(capsys, "view", run, "--record", tmp_path / "run.rrd")


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


@pytest.mark.long
def test_a_page_with_a_validation_names_its_command(run, tmp_path, capsys, monkeypatch):
    other = imported(tmp_path / "other one.hilcal", seed=2)
    ok(capsys, "refine", run)
    page = tmp_path / "page.html"
    ok(capsys, "report", run, "--validation", other, "--appendix", "-o", page)
    (step,) = re.findall(r"hilcal validate [^<]*", html.unescape(page.read_text()))
    monkeypatch.chdir(tmp_path)
    follow(capsys, step, step)


@pytest.mark.long
def test_the_page_says_how_to_be_judged(run, tmp_path, capsys):
    page = tmp_path / "page.html"
    ok(capsys, "identify", run, "--scaling", "gu")
    ok(capsys, "report", run, "-o", page)
    text = " ".join(page.read_text().split())
    assert "hilcal identify --scaling gc, then hilcal diagnose" in text
    assert "hilcal report --limit LENGTH" in text
    ok(capsys, "identify", run, "--scaling", "gc")
    ok(capsys, "diagnose", run)
    ok(capsys, "report", run, "-o", page, "--limit", "2 mm")
    text = " ".join(page.read_text().split())
    assert "Not judged" not in text
    assert "No limit was given" not in text
