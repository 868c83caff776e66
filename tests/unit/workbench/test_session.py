"""The workbench without a page: what is shown is the library's, and nothing is appended twice."""

import os

import numpy as np
import pytest

from hilcal.calibration.calibration import Calibration
from hilcal.campaign.campaign import Campaign
from hilcal.cli.fitting import fitted_with
from hilcal.diagnosis.verdict import diagnose
from hilcal.errors import CannotAnswerError
from hilcal.identification.carried.carried_prior import carried_prior
from hilcal.present.campaign import left_out_m, two_revisions, verdict_of
from hilcal.store.campaign_file import CampaignFile
from hilcal.whole_file import replace_file
from hilcal.workbench.session import WorkbenchSession
from tests.support.bench_cases import BASE, few_effects, store_campaign
from tests.support.campaigns import campaign, configuration
from tests.support.refusals import refusal


@pytest.fixture
def run(tmp_path):
    return store_campaign(tmp_path / "run.hilcal")


@pytest.fixture
def session(run):
    return WorkbenchSession(run, few_effects())


@pytest.fixture
def snapshot(session):
    return session.load()


def revisions(path):
    with Campaign.open(path, read_only=True) as o:
        return [(r.added, r.removed, r.made_from) for r in o.file.revisions()]


def test_an_operator_adds_removes_and_goes_back(run, session):
    before = run.read_bytes()
    snapshot = session.load()
    assert (run.read_bytes(), list(run.parent.iterdir())) == (before, [run])  # only looked at
    assert (snapshot.number, snapshot.records, snapshot.in_use) == (None, (), None)
    with Campaign.open(run, few_effects(), read_only=True) as o:
        assert snapshot.diagnosis.to_dict() == diagnose(o.fit_in_use()[1]).to_dict()
    assert snapshot.diagnosis.significant[0] == BASE
    assert snapshot.removable == ("joint_compliance",)

    r = session.evidence(snapshot, BASE)
    assert 0.5 < float(r.x @ r.y / (r.x @ r.x)) < 2.0
    assert session.evidence(snapshot, "no_such_effect") is None

    for effect, why in (
        ("no_such_effect", "unknown"),
        ("joint_compliance", "already"),
        (f"{BASE}, joint_tilt_compliance", "has 2 effects; valid: one"),
    ):
        refusal(why, session.add, snapshot, effect)
    refusal("no revision 7", session.go_back, snapshot, 7)
    assert revisions(run) == []

    added = session.add(snapshot, BASE)
    assert (added.number, [r.added for r in added.records]) == (2, [None, BASE])
    assert added.fit.holdout.rms_m < 0.8 * snapshot.fit.holdout.rms_m
    assert [c.number for c in added.chapters] == [1, 2]
    assert left_out_m(added.records[1]) == added.fit.holdout.rms_m
    judged = [snapshot.diagnosis.verdict, added.diagnosis.verdict]
    assert [verdict_of(r) for r in added.records] == [v.replace("_", " ") for v in judged]

    # the second of a double click
    refusal("has changed since that click; nothing was done", session.add, snapshot, BASE)
    refusal("has changed", session.plan, snapshot, None, run.with_name("p.json"))
    assert len(revisions(run)) == 2

    removed = session.remove(added, BASE)
    assert removed.fit.holdout.rms_m == pytest.approx(snapshot.fit.holdout.rms_m, rel=1e-3)
    back = session.go_back(removed, 2)
    assert (back.number, back.accepted, back.in_use) == (2, 2, 2)
    assert revisions(run) == [(None, None, None), (BASE, None, 1), (None, BASE, 2)]
    with Campaign.open(run, read_only=True) as o:
        assert o.in_use().number == 2  # what every command takes
    assert session.go_back(back, 3).accepted is None  # the latest: none needs to be accepted
    first = session.load(revision=1)

    os.utime(run)  # another command wrote to it
    assert session.stale
    refusal(r"run\.hilcal was changed by another command", session.add, first, BASE)
    assert session.load().number == 3
    assert not session.stale
    run.unlink()
    assert session.stale
    refusal("cannot be read", session.load)


def test_a_changed_cell_keeps_how_the_model_was_reached(run, session, snapshot):
    """A verdict that doubts an addition doubts it in another cell, too, also when read again."""
    mass = {("tool", "mass_kg"): "1.4"}
    same = {("tool", "mass_kg"): " 0.8 "}
    refusal("no value differs from what is used already", session.change_cell, snapshot, same)
    added = session.add(snapshot, BASE)
    refusal("has changed since that click", session.change_cell, snapshot, mass)
    extended = session.change_cell(added, mass)
    assert (extended.number, extended.changes) == (3, {"tool": {"mass_kg": 1.4}})
    assert extended.diagnosis.history == added.diagnosis.history
    assert extended.diagnosis.verdict == added.diagnosis.verdict
    again = WorkbenchSession(run, few_effects()).load()
    assert (again.number, again.diagnosis.verdict) == (3, extended.diagnosis.verdict)
    assert [c.number for c in again.chapters] == [3]
    assert next(f.text for f in again.cell_keys if f.key == "mass_kg") == "1.4"
    before = WorkbenchSession(run, few_effects()).load(revision=2)
    assert (before.changes, before.diagnosis.verdict) == ({}, added.diagnosis.verdict)
    rows = {row[0]: row for row in two_revisions(*again.records[1:]).rows}
    assert (rows["cell"][2], rows["model"][3]) == ("[tool] mass_kg = 1.4", "")
    assert two_revisions(*again.records[:2]).rows[0][3] == f"+ {BASE}"


def test_a_calibration_is_of_a_revision_that_is_kept(run, session, snapshot):
    name, content = session.document(snapshot, "calibration")
    assert name == "run-calibration.json"
    assert (session.snapshot.number, revisions(run)) == (1, [(None, None, None)])
    replace_file(run.with_name(name), content)
    assert Calibration.load(run.with_name(name)).source["revision"] == 1


def test_readings_that_came_later_are_fitted_anew(run, session, snapshot):
    with Campaign.open(run, few_effects()) as o:
        o.append(snapshot.fit)
        o.file.append_readings(o.file.readings()[:6])
    refusal("was fitted before readings were appended", session.load)
    extended = session.refit(snapshot)  # on a snapshot older than the file
    assert session.snapshot is extended
    assert not session.stale
    assert (extended.number, extended.fit.model.names) == (2, snapshot.fit.model.names)
    assert len(extended.fit.readings) == len(snapshot.fit.readings) + 6


def test_readings_that_come_during_a_fit_are_noticed(run, session, snapshot):
    """As `hilcal run --append` writes them while the workbench computes."""
    came = []

    def meanwhile(text):
        if not came:
            came.append(text)
            with CampaignFile.open(run) as file:
                file.append_readings(file.readings()[:6])

    extended = session.add(snapshot, BASE, meanwhile)
    assert session.snapshot is extended
    assert session.stale
    refusal("changed by another command; read it again first", session.add, extended, BASE)
    assert len(session.refit(extended).fit.readings) == len(snapshot.fit.readings) + 6
    assert not session.stale


@pytest.mark.long
def test_fitting_anew_keeps_the_prior_of_another_campaign(run):
    earlier, later = run.with_name("earlier.hilcal"), run.with_name("later.hilcal")
    measured = campaign(BASE, "deflection", poses=16).readings
    for path, part in ((earlier, measured.pose < 8), (later, measured.pose >= 8)):
        with CampaignFile.create(path, configuration().to_json(), "", "a test") as file:
            file.append_readings(measured[part])
    with Campaign.open(earlier, few_effects()) as o:
        o.append(o.fit_in_use()[1])
        prior = carried_prior(o.posterior(), "arm", {}, o.catalogue)
    with Campaign.open(later, few_effects()) as o:
        o.append(fitted_with(prior, o, o.fit_in_use()[1]))
    anew = WorkbenchSession(later, few_effects()).refit(None)
    kept = anew.fit.model.prior
    assert kept.with_drift(None).to_json() == prior.to_json()  # the drift is chosen anew
    with Campaign.open(later, few_effects(), read_only=True) as o:
        assert o.fit(2).model.prior is not None


def test_a_plan_names_what_it_separates_or_why_there_is_none(run, session, snapshot):
    exists = run.with_name("there.json")
    exists.touch()
    refusal("the file exists; choose another name", session.plan, snapshot, None, exists)
    refusal("the plan file has no name", session.plan, snapshot, None, exists.parent)
    kept = session.remove(snapshot, "joint_compliance")
    assert kept.diagnosis.verdict != "ambiguous"
    with pytest.raises(CannotAnswerError, match="no suspects to separate"):
        session.plan(kept, None, run.with_name("plan.json"))


def test_the_readings_that_were_picked_are_told_apart(run, session, snapshot):
    story = snapshot.story
    pulled = np.flatnonzero(np.array(story.load_names) == "pull y")
    by_variable = {d.variable: d for d in session.differences(snapshot, pulled)}
    difference = by_variable["load pull y"]
    assert (difference.picked, difference.others, difference.larger, difference.clear) == (
        1.0,
        0.0,
        1.0,
        True,
    )
    reach = session.recorded(snapshot)["distance from the base axis"].values
    far = np.flatnonzero(reach > np.median(reach))
    by_variable = {d.variable: d for d in session.differences(snapshot, far)}
    assert by_variable["distance from the base axis"].larger == 1.0
    assert session.differences(snapshot, np.arange(len(story))) == ()  # no others
