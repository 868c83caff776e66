"""A calibration from the plan to the measured improvement, stopped at every step."""

import shutil
import time
from dataclasses import replace

import numpy as np
import pytest

import hilcal as hc
from hilcal.calibration.improvement import Improvement, refuted
from hilcal.campaign.campaign import Campaign
from hilcal.campaign.posteriors import load_posterior
from hilcal.config.cell import Repeatability
from hilcal.config.reference import to_toml
from hilcal.drivers.simulated.rehearsal import simulate_plan
from hilcal.identification.carried.carried_prior import carried_prior
from hilcal.present.calibration import REFUTED, improvement_report, validation_lines
from hilcal.present.html.report import limit_words
from hilcal.procedure.state import DECIDED, FROZEN
from hilcal.readings.same_readings import found_among
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import REFERENCE
from hilcal.store.procedure_log import IMPROVED, ProcedureLog, purpose_of, release
from hilcal.store.run_log import RunLog, check_same_arm
from hilcal.write_report import ReportOptions, content_of
from tests.support.cli_cases import ok
from tests.support.paths import ROOT
from tests.support.procedure_cases import (
    ARM,
    DrawnCalibration,
    KilledError,
    drawn_calibration,
    reopened,
    small_config,
)
from tests.support.refusals import refusal
from tests.unit.test_docs import blocks

FIRST = ["plan", "measure", "refine", "decide"]
LAST = ["validate", "correct", "measure_corrected", "compare"]
ALL = [*FIRST, "plan_validation", "measure_validation", *LAST]


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A calibration that was stopped after each step, and in each measurement."""
    d = drawn_calibration(tmp_path_factory.mktemp("run") / "run.hilcal", validation=6)
    improvement = None
    while (step := d.procedure.next()).kind != "done":
        if step.moves and step.missing > 2:
            d.dies_after = step.missing - 2
            with pytest.raises(KilledError):
                d.do(step)
        else:
            improvement = d.do(step)
        d = reopened(d)
    assert isinstance(improvement, Improvement)
    return d, improvement


def test_it_goes_on_after_any_stop(done):
    d, _ = done
    assert list(dict.fromkeys(d.kinds)) == ALL
    files, places = d.procedure.files, []
    for path in (files.run, files.validation, files.corrected):
        with CampaignFile.open(path) as campaign:
            log = RunLog(campaign)
            steps = log.plans[-1].steps
            assert len(log.details()) == campaign.n_readings == len(steps)
            assert log.done() == frozenset(steps)
            if places:  # the tracker has to see the target where it did before
                assert np.allclose(log.plans[-1].about["reference_seen_m"], places[-1], atol=1e-3)
            places.append(campaign.readings().value[0, :3])


@pytest.mark.parametrize("set_back", [0.0, 7200.0])
def test_time_goes_on_in_the_next_campaign_though_the_clock_was_set(tmp_path, set_back):
    """By an hour between two sessions, and by `set_back` before the next campaign."""
    p = drawn_calibration(tmp_path / "run.hilcal", config=small_config(1), poses=4).procedure
    p.begin(p.plan().plan, p.config)
    now, clock, epochs = time.time(), p.clock, []

    def measure(campaign, epoch):
        epochs.append(epoch)
        log = RunLog(campaign)
        for k, step in enumerate(log.plan.steps):
            wall = now + set_back + 10.0 * k - 3600.0 * (k > 2)
            drawn = simulate_plan(case, log.plan, 1).readings[k : k + 1]
            log.record(drawn, step, {"epoch_wall_s": now, "wall_s": wall, "time_s": 200.0 * k})

    case = DrawnCalibration(p, "nothing").case()
    step = p.next()
    count = p.measure(step, measure)
    shutil.copy(p.run, p.files.validation)
    p.measure(replace(step, path=p.files.validation), lambda _, epoch: epochs.append(epoch))
    last = 200.0 * (count - 1)
    elapsed = (time.time() - epochs[1]) * clock
    pause = clock * max(3600.0 - set_back - 10.0 * (count - 1), 0.0)
    assert epochs[0] is None
    assert elapsed == pytest.approx(last + pause, abs=60.0 * clock)
    assert elapsed >= last


def test_it_is_of_as_many_poses_as_asked_for_under_every_load(done):
    d, _ = done
    with CampaignFile.open(d.procedure.run) as campaign:
        steps = [s for s in RunLog(campaign).plans[0].steps if s.pose != REFERENCE]
    assert len({s.pose for s in steps}) == d.procedure.settings.poses
    loads = {s.load for s in steps}
    assert loads == {"none", *(load.name for load in d.procedure.config.loads)}
    for load in ("none", "pull x"):  # which every pose of this plan bears
        assert [s.load for s in steps if not s.cycle].count(load) == d.procedure.settings.poses


@pytest.mark.long
def test_a_pose_that_cannot_be_measured_does_not_lock_it(tmp_path):
    d = drawn_calibration(tmp_path / "run.hilcal", validation=6)
    skipped, files = [], d.procedure.files
    while (step := d.procedure.next()).kind != "done":
        if step.moves and step.path not in [path for path, _ in skipped]:
            d.dies_after = step.missing // 2
            with pytest.raises(KilledError):
                d.do(step)
            d.dies_after = None
            with CampaignFile.open(step.path) as campaign:
                log = RunLog(campaign)
                missing = [s.pose for s in log.plan.without(log.done()).steps]
                pose = next(name for name in missing if name != REFERENCE)
                log.skip([pose])
            skipped.append((step.path, pose))
        else:
            improvement = d.do(step)
    assert [path for path, _ in skipped] == [files.run, files.validation, files.corrected]
    (_, validated), (_, corrected) = skipped[1:]
    assert improvement.everything.count == 4
    assert corrected in dict(improvement.left_out)
    assert validated not in corrected


def test_the_error_falls_as_far_as_predicted(done):
    _, improvement = done
    every = improvement.everything
    assert every.count == 6
    assert every.before.rms_m > 10 * every.after.rms_m
    assert every.removed > 0.9
    assert every.inside >= 4
    assert sum(part.count for part in improvement.by_load) == 6
    assert improvement.left_out == ()


@pytest.mark.long
def test_an_arm_that_changes_before_its_validation_refutes_the_prediction(tmp_path, capsys):
    """Otherwise "94 % are removed" would be said, although no point lies within its band."""
    d = drawn_calibration(
        tmp_path / "run.hilcal", poses=12, validation=6, readings="absolute",
        config=small_config(readings="absolute"),
    )  # fmt: skip
    while (step := d.procedure.next()).kind != "done":
        d.hidden = "nothing" if step.path == d.procedure.run else "encoder_offset"
        result = d.do(step)
        if step.kind == "validate":
            assert "times as far off as the fit states" in "".join(validation_lines(result))
    assert result.refuted
    assert REFUTED in list(improvement_report(result, None))
    limit = 0.9 * float(result.after_m.max())
    with Campaign.open(d.procedure.run) as run:
        words, passed = limit_words(content_of(run, ReportOptions(limit_m=limit)))
        q = ",".join(map(str, run.readings.states.q[0]))
    assert not passed
    assert "measured at corrected targets" in words
    points = tmp_path / "points.csv"
    points.write_text(f"pose,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad\na,{q}\n")
    warned = ok(capsys, "compensate", d.procedure.run, points).err
    every, arm = result.everything, tmp_path / "arm.json"
    words = f"{every.inside} of {every.count} points that"
    assert f"warning: {d.procedure.run}: {words}" in warned
    exported = ok(capsys, "export", d.procedure.run, "--calibration", arm)
    assert f"warning: {d.procedure.run}: {words}" in exported.err
    of_file = ok(capsys, "compensate", arm, points, "--json")
    assert f"warning: {arm}: {words}" in of_file.err
    assert f"hilcal compare {d.procedure.run} {d.procedure.files.validation}" in of_file.err
    assert of_file.document["refuted"]
    assert f"refuted_by: {every.inside, every.count}" in repr(hc.Calibration.load(arm))
    assert not refuted(6, 8)
    assert not refuted(0, 2)
    with CampaignFile.open(d.procedure.run) as damaged:
        ProcedureLog(damaged).append(IMPROVED, {"revision": 1})
    refusal(r"run\.hilcal.*error", hc.Calibration.load, d.procedure.run)


@pytest.mark.long
def test_an_arm_without_temperatures_in_its_validation_does_not_lock_it(tmp_path, monkeypatch):
    """The model needs them: their means count, and the bands say whether that is enough."""
    path, real = tmp_path / "run.hilcal", RunLog.record
    d = drawn_calibration(
        path, "thermal_joint_drift", poses=20, validation=6, readings="absolute",
        config=small_config(readings="absolute"),
    )  # fmt: skip

    def cold(log, reading, *given):
        if d.procedure.next().path != path:
            reading = replace(reading, states=replace(reading.states, joint_temperature=None))
        return real(log, reading, *given)

    monkeypatch.setattr(RunLog, "record", cold)
    while (step := d.procedure.next()).kind != "done":
        result = d.do(step)
        if step.kind == "refine":
            assert "thermal_joint_drift" in result.fit.model.names
    assert result.everything.count == 6


def test_validation_poses_lie_within_what_was_measured_and_are_new(done):
    files = done[0].procedure.files
    with CampaignFile.open(files.run) as run, CampaignFile.open(files.validation) as test:
        fitted, unseen = run.readings(), test.readings()
    q, new = fitted.states.q, unseen.states.q
    slack = 0.02 * np.ptp(q, axis=0)
    assert (new >= q.min(axis=0) - slack).all()
    assert (new <= q.max(axis=0) + slack).all()
    of_validation = np.array([unseen.pose_names[k] != REFERENCE for k in unseen.pose])
    apart = np.abs(new[of_validation][:, None] - q[None]).max(axis=2)
    assert apart.min() > 0.01
    assert not found_among(unseen, fitted).any()


def test_the_corrected_run_is_at_other_joint_values(done):
    files = done[0].procedure.files
    with CampaignFile.open(files.validation) as test, CampaignFile.open(files.corrected) as moved:
        first, last = test.readings(), moved.readings()
    at = {f"{first.pose_names[p]}": q for p, q in zip(first.pose, first.states.q, strict=True)}
    names = [last.pose_names[k] for k in last.pose]
    turned = [
        np.abs(q - at[name.split(" ")[0]]).max()
        for name, q in zip(names, last.states.q, strict=True)
        if name != REFERENCE
    ]
    assert min(turned) > 1e-5
    assert max(turned) < 0.02


def test_a_validation_campaign_is_frozen(done):
    d, _ = done
    files = d.procedure.files
    with CampaignFile.open(files.run) as run, CampaignFile.open(files.validation) as test:
        frozen = ProcedureLog(run).last(FROZEN)
        assert frozen["readings_sha256"] == test.data_hash()
        assert purpose_of(test) == "validation"
    with hc.Campaign.open(files.validation) as o:
        refusal(r"a validation campaign of run\.hilcal", o.fit_in_use)
        fitted = hc.fit(hc.baseline(o.cell, o.readings), o.readings)
        refusal("never fitted", o.append, fitted)
        assert o.latest() is None


def test_the_model_of_an_arm_is_not_tested_on_another(done):
    d, _ = done
    other = {**ARM, "facts": {"serial number": "20235500002"}}
    for path in (d.procedure.files.validation, d.procedure.files.corrected):
        with CampaignFile.open(path) as test:
            check_same_arm(RunLog(test), [ARM])
            refusal(r"20235500002, .* 20235500001;", check_same_arm, RunLog(test), [other])


def test_another_validation_campaign_is_refused(done):
    d, _ = done
    files = d.procedure.files
    kept = files.validation.read_bytes()
    try:
        with CampaignFile.open(files.validation) as test:
            readings = test.readings()
            release(test, "a test")
            test.append_readings(readings[:1])
        refusal("other readings than when it was frozen", d.procedure.compare)
        with hc.Campaign.open(files.validation) as o:
            assert o.fit_in_use()[0] is None  # released: it may be fitted, and the file says so
    finally:
        files.validation.write_bytes(kept)


def until_decided(d):
    """Do the steps before the validation; returns their kinds, and what the last one gave."""
    kinds, result = [], None
    while (step := d.procedure.next()).kind != "plan_validation":
        result = d.do(step)
        kinds.append(step.kind)
    return kinds, result


def with_goal(d, goal_m):
    settings = replace(d.procedure.settings, goal_m=goal_m)
    return replace(d, procedure=replace(d.procedure, settings=settings))


@pytest.mark.long
def test_a_goal_below_the_repeatability_is_not_measured_for_but_another_is(tmp_path):
    d = drawn_calibration(tmp_path / "run.hilcal", goal_m=5e-6)
    kinds, decision = until_decided(d)
    assert kinds == FIRST
    assert decision.reason == "floor"
    assert decision.error.floor_m > 5e-6
    d = with_goal(d, 1.0)
    with CampaignFile.open(d.procedure.run) as run:
        d.procedure.resume(run)
    assert d.procedure.next().kind == "decide"
    with CampaignFile.open(d.procedure.run) as another:
        another.measure_alone()
        refusal("another hilcal is measuring", d.do, d.procedure.next())
    assert d.do(d.procedure.next()).reason == "goal_met"
    assert d.procedure.next().kind == "plan_validation"


@pytest.mark.long
def test_a_calibration_without_a_stated_repeatability_goes_to_its_end(tmp_path):
    """The arm's scatter is then what the maker states, and no number of the decision is NaN."""
    config = small_config(1).model_copy(update={"repeatability": Repeatability()})
    d = drawn_calibration(
        tmp_path / "run.hilcal", config=config, poses=4, validation=4, goal_m=1e-3
    )
    assert isinstance(d.to_the_end(), Improvement)
    with CampaignFile.open(d.procedure.run) as campaign:
        decision = ProcedureLog(campaign).last(DECIDED)
    assert decision["reason"] == "goal_met"
    assert 0 < decision["floor_m"] < decision["predicted_m"] < 1e-3


@pytest.mark.long
def test_a_goal_within_reach_is_measured_for(tmp_path):
    d = drawn_calibration(tmp_path / "run.hilcal", poses=4)
    for _ in range(3):
        d.do(d.procedure.next())
    first = d.procedure.predicted()
    d = with_goal(d, 0.5 * (first.now_m + first.floor_m))
    decision = d.do(d.procedure.next())
    assert decision.reason == "goal"
    assert decision.then_m < first.now_m
    kinds, decision = until_decided(d)
    assert kinds[:3] == ["measure", "refine", "decide"]
    assert decision.error.now_m < first.now_m
    with CampaignFile.open(d.procedure.run) as run:
        log = RunLog(run)
        assert len(log.plans) > 1
        assert len(log.plan.steps) == run.n_readings


@pytest.mark.long
def test_the_python_of_the_guide_runs_as_it_stands(tmp_path, monkeypatch):
    (code,) = blocks(ROOT / "docs" / "how-to" / "calibrate.md")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "CELL.toml").write_text(to_toml(small_config(1)), encoding="utf-8")
    known = {}
    known["measure"] = lambda campaign, epoch: DrawnCalibration(known["p"], "nothing").measure(
        campaign, epoch
    )
    exec(code, known)
    every = known["p"].compare().everything
    assert every.count == 4
    assert every.before.rms_m > 5 * every.after.rms_m


@pytest.mark.long
def test_what_an_earlier_calibration_taught_is_the_prior(done, tmp_path):
    first = done[0].procedure
    known = carried_prior(load_posterior(first.run), "arm", {}, first.catalogue)
    errors = []
    for name, prior in (("alone", None), ("carried", known)):
        d = drawn_calibration(tmp_path / f"{name}.hilcal", config=small_config(1), poses=4)
        d = replace(d, procedure=replace(d.procedure, prior=prior))
        for _ in range(3):
            d.do(d.procedure.next())
        errors.append(d.procedure.predicted().now_m)
        with hc.Campaign.open(d.procedure.run) as o:
            assert (o.fit().model.prior is None) == (prior is None)
    assert errors[1] < errors[0]
    settings = replace(d.procedure.settings, prior=str(first.run))
    p = replace(d.procedure, settings=settings, prior=known)
    with CampaignFile.open(p.run) as run:
        p.resume(run)
    assert p.next().kind == "refine"  # given anew after a fit
    p.refine()
    assert p.next().kind == "decide"
