"""Gross errors: set aside, listed, without effect; and good readings are left alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import poisson

from hilcal.config import load_config
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.fit_document import outliers
from hilcal.identification.least_trimmed_squares import FALSE_ALARMS, bulk, limit
from hilcal.readings.readings import Readings
from hilcal.robot.catalogue import configs_dir
from studies.study_cases import study_case
from tests.support.campaigns import Campaign, campaign, noiseless, plan, with_noise
from tests.support.rows import first

MODES = ("absolute", "deflection")


def any_gross(distance2, m):
    return bool((distance2 > limit(m, len(distance2), bulk(distance2, m))).any())


def spoilt(readings, rows, size):
    value = readings.value.copy()
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(len(rows), readings.m))
    value[rows] += size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return replace(readings, value=value)


@pytest.mark.parametrize("size", [3e-4, 2e-3, 0.5])
@pytest.mark.parametrize("mode", MODES)
def test_three_gross_errors_are_set_aside_and_listed(mode, size):
    c = campaign(plan_seed=0, poses=30, registration_known=True)
    rows = np.array([7, 68, 134])
    assert not c.readings.unloaded[rows].any()
    found = fit(baseline(c.cell, c.readings, mode), spoilt(c.readings, rows, size), mode)
    np.testing.assert_array_equal(np.flatnonzero(found.outlier), rows)
    kept = np.delete(np.arange(150), rows)
    clean = fit(baseline(c.cell, c.readings, mode), c.readings[kept], mode)
    assert np.abs((found.theta - clean.theta) / clean.uncertainty.formal).max() < 1e-4
    assert found.chi2 == pytest.approx(clean.chi2, rel=1e-6)
    assert found.dof == clean.dof
    listed = outliers(found)
    names = {(o["pose"], o["load"]) for o in listed}
    r = c.readings
    assert names == {(r.pose_names[r.pose[k]], r.load_names[r.load[k]]) for k in rows}
    assert min(o["sigma"] for o in listed) > 5
    # No error of the fit counts them; those by which fits are compared do.
    assert found.error.rms_m == pytest.approx(clean.error.rms_m, rel=1e-4)
    assert found.holdout_of_all.max_m > 0.9 * size > 0.9 * found.holdout.max_m


def test_a_gross_error_of_an_unloaded_reading_does_not_spoil_deflections():
    c = campaign(plan_seed=0, poses=30, registration_known=True)
    row = 45
    assert c.readings.unloaded[row]
    pose = c.readings.pose[row]
    found = fit(baseline(c.cell, c.readings, "deflection"), spoilt(c.readings, [row], 5e-3),
                "deflection")  # fmt: skip
    clean = fit(baseline(c.cell, c.readings, "deflection"), c.readings, "deflection")
    assert set(c.readings.pose[found.outlier]) == {pose}
    # Four of 120 deflections less.
    assert np.abs((found.theta - clean.theta) / clean.uncertainty.formal).max() < 1.5


@pytest.mark.parametrize("m", [3, 6])
def test_good_readings_are_called_gross_once_in_a_thousand_campaigns(m):
    rng = np.random.default_rng(m)
    campaigns, count = 5000, 150
    alarms = sum(any_gross(rng.chisquare(m, count), m) for _ in range(campaigns))
    expected = FALSE_ALARMS * campaigns
    assert poisson.ppf(1e-4, expected) <= alarms <= poisson.isf(1e-4, expected)


def test_a_misfit_twice_as_wide_as_the_noise_is_not_gross():
    rng = np.random.default_rng(0)
    alarms = sum(any_gross(4 * rng.chisquare(3, 150), 3) for _ in range(2000))
    assert alarms <= poisson.isf(1e-4, FALSE_ALARMS * 2000)


def false_alarms(count: int) -> int:
    c = campaign(plan_seed=0, registration_known=True)
    model = baseline(c.cell, c.readings, "absolute")
    clean = noiseless(c.world, plan())
    rng = np.random.default_rng(1)
    alarms = 0
    for _ in range(count):
        found = fit(model, with_noise(clean, rng), "absolute", start=np.zeros(model.size))
        alarms += int(found.outlier.any())
    return alarms


@pytest.mark.long
def test_clean_campaigns_keep_all_their_readings():
    count = 50
    assert false_alarms(count) <= poisson.isf(1e-3, FALSE_ALARMS * count)


@pytest.mark.slow
def test_two_hundred_clean_campaigns_keep_all_their_readings():
    count = 200
    assert false_alarms(count) <= poisson.isf(1e-3, FALSE_ALARMS * count)


def test_a_true_effect_is_not_mistaken_for_gross_errors():
    for seed, effect in enumerate(("transmission_error", "link_geometry", "hysteresis")):
        c = campaign(effect, seed=seed, plan_seed=0, poses=20, strength=8.0)
        found = fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute")
        assert not found.outlier.any()


# --- as campaigns spoil their readings ------------------------------------------------------


def test_an_effect_of_the_unloaded_readings_is_no_heap_of_gross_errors():
    """A bias of the force sensor looks like bad unloaded readings, pose after pose."""
    for robot, seed in (("ur3e", 11), ("ur10e", 12)):
        config = load_config(configs_dir() / "cells" / "demo_ur10e.toml")
        c = study_case(config, robot, "deflection", ("wrench_bias",), 3.0, seed)
        found = fit(baseline(c.cell, c.readings, "deflection"), c.readings, "deflection")
        assert not found.outlier.any()


def test_the_limit_moves_away_gradually_as_the_bulk_grows_beyond_chance():
    far = [limit(3, 150, scale) for scale in (1.0, 1.2, 1.31, 1.4, 1.5, 2.0)]
    assert far == sorted(far)
    assert far[1] == pytest.approx(1.2 * far[0])
    assert far[2] < 2.1 * far[0]
    assert far[4] == pytest.approx(1.5 * 2.5**2 * far[0])
    assert far[5] == pytest.approx(2.0 * 2.5**2 * far[0])


def gross(
    readings: Readings, rng: np.random.Generator, share: float = 0.05
) -> tuple[Readings, dict]:
    """Far off by 10 to 1000 σ, the load not hung, or the reading before once more."""
    r, value, what = readings, readings.value.copy(), {}
    for row in np.sort(rng.choice(np.arange(1, len(r)), int(share * len(r)), replace=False)):
        kind = rng.choice(["far", "far" if r.unloaded[row] else "not hung", "stale"])
        if kind == "far":
            direction = rng.normal(size=3)
            std = np.sqrt(np.trace(r.covariance[row, :3, :3]) / 3)
            size = std * 10 ** rng.uniform(1, 3)
            value[row, :3] += size * direction / np.linalg.norm(direction)
        elif kind == "not hung":
            same = (r.pose == r.pose[row]) & (r.cycle == r.cycle[row]) & r.unloaded
            error = np.linalg.cholesky(r.covariance[row]) @ rng.normal(size=r.m)
            value[row] = r.value[np.flatnonzero(same)[0]] + error
        else:
            value[row] = r.value[row - 1]
        what[int(row)] = str(kind)
    return replace(r, value=value), what


def judged(c: Campaign, readings: Readings) -> tuple:
    d = diagnose(fit(baseline(c.cell, readings, c.mode), readings, c.mode))
    return d.verdict, d.significant[:1]


def without(readings: Readings, rows: list[int], mode: str) -> Readings:
    """The readings without some; deflections go with their unloaded reading."""
    lost = np.isin(np.arange(len(readings)), rows)
    if mode == "deflection":
        lost |= np.isin(readings.pose, readings.pose[lost & readings.unloaded])
    return readings[~lost]


def check_verdict(effect: str, mode: str, seed: int) -> None:
    c = campaign(effect, mode, seed, poses=30)
    spoilt_readings, what = gross(c.readings, np.random.default_rng(1000 + seed))
    verdict = judged(c, spoilt_readings)
    if verdict != judged(c, c.readings):
        # Near a limit, what remains may say less, or more, than all: not because of the errors.
        assert verdict == judged(c, without(c.readings, list(what), mode)), what


SPOILT = [(e, m) for m in MODES for e in ("none", "joint_tilt_compliance", "base_compliance")]
SPOILT += [(e, "absolute") for e in ("hysteresis", "encoder_offset", "link_geometry")]
FAST = (
    *(("base_compliance", "absolute"), ("hysteresis", "absolute"), ("link_geometry", "absolute")),
    *(("none", "deflection"), ("joint_tilt_compliance", "deflection")),
)
"""One of each kind every time; all of them over many seeds in the slow suite."""


@pytest.mark.parametrize(("effect", "mode"), first(2, FAST))
def test_a_twentieth_of_gross_errors_changes_no_verdict(effect, mode):
    check_verdict(effect, mode, 0)


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "mode"), SPOILT)
def test_gross_errors_change_no_verdict_over_many_seeds(effect, mode):
    for seed in range(15):
        check_verdict(effect, mode, seed)


@pytest.mark.parametrize("mode", MODES)
def test_gross_errors_say_what_they_look_like(mode):
    c = campaign(plan_seed=0, poses=30, registration_known=True)
    r, value = c.readings, c.readings.value.copy()
    far, stale, bare = 7, 21, 33
    assert not r.unloaded[[far, stale, bare]].any()
    value[far, 2] += 2e-3
    value[stale] = value[stale - 1]
    value[bare] = value[30] + 1e-6
    assert r.unloaded[30]
    assert r.pose[30] == r.pose[bare]
    read = replace(r, value=value)
    listed = {(o["pose"], o["load"]): o["reason"] for o in
              outliers(fit(baseline(c.cell, read, mode), read, mode))}  # fmt: skip
    reasons = [listed[r.pose_names[r.pose[k]], r.load_names[r.load[k]]] for k in (far, stale, bare)]
    assert len(listed) == 3
    assert reasons[0].endswith("σ off in z")
    assert "equal to the reading before" in reasons[1]
    assert "was the load hung" in reasons[2]


def test_a_bad_unloaded_reading_is_listed_once_with_what_it_took_along():
    c = campaign(plan_seed=0, poses=30, registration_known=True)
    read = spoilt(c.readings, [45], 5e-3)
    found = fit(baseline(c.cell, read, "deflection"), read, "deflection")
    (listed,) = outliers(found)
    assert listed["load"] == "none"
    assert "its 4 deflections set aside with it" in listed["reason"]
    assert listed["sigma"] > 50
