"""Gross errors are found, set aside and listed; good readings and laws are left alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom, poisson

from hilcal.config import CellConfig, load_config
from hilcal.diagnosis.verdict import diagnose
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.data_snooping import (
    CHANCE,
    Snooping,
    along_one_site,
    linearised,
    site_columns,
)
from hilcal.identification.fit import Fit, fit
from hilcal.identification.fit_document import notes, outliers
from hilcal.identification.least_trimmed_squares import FALSE_ALARMS, ReadingModel, bulk, limit
from hilcal.identification.misdescription import examine
from hilcal.identification.registration import register
from hilcal.model.model import Model
from hilcal.present.verdict import message
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import MODES, Mode, inverse_root, whitening
from hilcal.refinement import refine
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Floats
from studies.gross_errors import Spoilt, count, spoil
from studies.study_cases import study_case
from tests.support.campaigns import Campaign, campaign, noiseless, plan, with_noise
from tests.support.fit_cases import based
from tests.support.reflector_cases import reflectors
from tests.support.rows import first


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
    clean = based(c.cell, c.readings, "deflection")
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
        found = based(c.cell, c.readings, "absolute")
        assert not found.outlier.any()


# --- as campaigns spoil their readings ------------------------------------------------------


def test_an_effect_of_the_unloaded_readings_is_no_heap_of_gross_errors():
    """A bias of the force sensor looks like bad unloaded readings, pose after pose."""
    for robot, seed in (("ur3e", 11), ("ur10e", 12)):
        config = load_config(configs_dir() / "cells" / "demo_ur10e.toml")
        c = study_case(config, robot, "deflection", ("wrench_bias",), 3.0, seed)
        found = based(c.cell, c.readings, "deflection")
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
              outliers(based(c.cell, read, mode))}  # fmt: skip
    reasons = [listed[r.pose_names[r.pose[k]], r.load_names[r.load[k]]] for k in (far, stale, bare)]
    assert len(listed) == 3
    assert reasons[0].endswith("σ off in z")
    assert "equal to the reading before" in reasons[1]
    assert "was the load hung" in reasons[2]


def test_a_bad_unloaded_reading_is_listed_once_with_what_it_took_along():
    c = campaign(plan_seed=0, poses=30, registration_known=True)
    read = spoilt(c.readings, [45], 5e-3)
    found = based(c.cell, read, "deflection")
    (listed,) = outliers(found)
    assert listed["load"] == "none"
    assert "its 4 deflections set aside with it" in listed["reason"]
    assert listed["sigma"] > 50


@pytest.fixture(scope="module")
def config() -> CellConfig:
    return load_config(configs_dir() / "cells" / "demo_ur10e.toml")


def fitted_to_twelve(readings: Readings, mode: Mode, **given: object) -> Fit:
    c = campaign(mode=mode, plan_seed=0, poses=12, **given)
    return based(c.cell, readings, mode)


def shifted(readings: Readings, rows: slice, shift: Floats) -> Readings:
    value = readings.value.copy()
    value[rows, :3] += shift
    return replace(readings, value=value)


@pytest.mark.parametrize("m", first(1, [3, 6]))
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("share", "size"), [(0.2, 5e-3), (0.4, 5e-3), (0.4, 1e-3), (0.3, 5e-2)])
def test_all_of_many_gross_errors_are_found(share: float, size: float, mode: Mode, m: int) -> None:
    c = campaign(mode=mode, plan_seed=0, poses=12, m=m)
    readings, wrong = spoil(c.readings, share, size, np.random.default_rng(0))
    found = based(c.cell, readings, mode)
    # The same as without them; deflections go with their unloaded reading.
    out = np.isin(np.arange(len(readings)), wrong)
    if mode == "deflection":
        r = c.readings
        out |= np.isin(r.pose, r.pose[out & r.unloaded])
        out |= ~np.isin(r.pose, r.pose[~out & ~r.unloaded])
    right = based(c.cell, c.readings[~out], mode)
    out[np.flatnonzero(~out)[right.outlier]] = True
    np.testing.assert_array_equal(found.outlier, out)
    if m == 3:  # the target's axes, which attitudes show, are those of the registration
        assert found.variance_factor == pytest.approx(right.variance_factor, rel=0.1)


@pytest.mark.parametrize(
    ("seed", "share"), first(1, [(13, 0.4), (22, 0.4), (24, 0.4), (33, 0.4), (5, 0.2)])
)
def test_refine_finds_them_beside_an_effect_and_in_few_poses(
    config: CellConfig, seed: int, share: float
) -> None:
    """24 to 180 readings, nothing or an unmodelled effect of 10 to 20 σ."""
    found = count(config, Spoilt(share, 5e-3, seed))
    assert found.found == found.wrong
    assert found.false <= 0.01 * found.readings
    assert found.outcome != "refused"


@pytest.mark.long
@pytest.mark.parametrize("mode", MODES)
def test_more_than_can_be_told_is_said(mode: Mode) -> None:
    c = campaign(mode=mode, plan_seed=0, poses=12)
    readings, _ = spoil(c.readings, 0.6, 5e-3, np.random.default_rng(0))
    found = refine(baseline(c.cell, readings, mode), readings, mode)
    assert found.verdict == "unknown_effect"
    assert "more than 45 % of the readings disagree" in message(found.diagnosis)
    assert not found.fit.outlier.any()


@pytest.mark.parametrize("of_tool", [False, True])
def test_a_block_off_alike_is_said_and_not_set_aside(of_tool: bool) -> None:
    """From one reading to another the shift is the same in the sensor's, or the target's axes."""
    c = campaign(plan_seed=0, poses=12)
    rows, shift = slice(12, 30), np.array([5e-3, 0.0, 0.0])
    if of_tool:
        model = baseline(c.cell, c.readings, "absolute")
        axes = model.predict(c.readings.states, np.zeros(model.size)).observation.rotation
        shift = axes[rows] @ shift
    readings = shifted(c.readings, rows, shift)
    found = based(c.cell, readings, "absolute")
    assert not found.outlier.any()
    assert found.disagreement is not None
    np.testing.assert_array_equal(found.disagreement.rows, np.arange(12, 30))
    assert any("are off by the same shift" in note for note in notes(found))


def test_a_block_is_not_taken_for_random_errors_among_such() -> None:
    c = campaign(plan_seed=0, poses=12)
    readings, wrong = spoil(c.readings, 0.1, 5e-3, np.random.default_rng(1))
    readings = shifted(readings, slice(20, 32), np.array([0.0, 0.0, -8e-3]))
    found = based(c.cell, readings, "absolute")
    outside = wrong[(wrong < 20) | (wrong >= 32)]
    assert found.outlier[outside].all()
    assert found.disagreement is not None
    assert found.outlier[20:32].sum() <= np.isin(np.arange(20, 32), wrong).sum()


def test_an_unloaded_reading_that_several_deflections_share() -> None:
    c = campaign(mode="deflection", plan_seed=0, poses=12)
    rows = np.flatnonzero(c.readings.unloaded)[::4]
    value = c.readings.value.copy()
    value[rows] += 5e-3 * np.random.default_rng(0).normal(size=(len(rows), 3))
    readings = replace(c.readings, value=value)
    found = based(c.cell, readings, "deflection")
    expected = np.isin(readings.pose, readings.pose[rows])
    np.testing.assert_array_equal(found.outlier, expected)


@pytest.mark.parametrize("mode", MODES)
def test_readings_of_several_targets(mode: Mode) -> None:
    c = reflectors(poses=10)
    readings, wrong = spoil(c.readings, 0.3, 5e-3, np.random.default_rng(0))
    found = based(c.cell, readings, mode)
    assert found.outlier[wrong].all()


def test_a_registration_does_not_follow_errors_of_centimetres() -> None:
    c = campaign(plan_seed=0, poses=12)
    readings, wrong = spoil(c.readings, 0.4, 5e-2, np.random.default_rng(0))
    found = register(c.cell, readings)
    np.testing.assert_array_equal(np.flatnonzero(found.far), np.sort(wrong))
    assert found.rms < 1.1 * register(c.cell, c.readings).rms + 1e-4
    finding = examine(found, readings)
    assert finding is not None
    assert not finding.refused


@pytest.mark.long
def test_a_block_off_by_centimetres_is_refused() -> None:
    c = campaign(plan_seed=0, poses=12)
    readings = shifted(c.readings, slice(12, 30), np.array([0.05, 0.0, 0.0]))
    with pytest.raises(InputError, match=r"rows do not fit|Nothing that was tried"):
        baseline(c.cell, readings, "absolute")


def test_equal_readings_give_equal_fits() -> None:
    c = campaign(plan_seed=0, poses=12)
    readings, _ = spoil(c.readings, 0.3, 5e-3, np.random.default_rng(0))
    first, second = (fitted_to_twelve(readings, "absolute") for _ in range(2))
    np.testing.assert_array_equal(first.theta, second.theta)


APART = np.arange(400)


def directions(rng: np.random.Generator, *shape: int) -> Floats:
    x = rng.normal(size=shape)
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def drawn(rng: np.random.Generator, count: int, size: float) -> tuple[Floats, Floats]:
    """Shifts of a size in random directions, and those of ten sites."""
    return size * directions(rng, count, 3), directions(rng, count, 3, 10)


def test_random_errors_are_along_no_site() -> None:
    rng = np.random.default_rng(0)
    tried = 400
    wrong = sum(
        bool(along_one_site(*drawn(rng, count, size), APART[:count]).any())
        for count in (1, 5, 40, 80)
        for size in np.geomspace(6, 600, tried // 4)
    )
    assert binom.sf(wrong - 1, tried, CHANCE) > 1e-3


@pytest.mark.parametrize(("count", "size"), [(5, 15.0), (12, 7.0), (3, 100.0)])
def test_a_law_is_told_from_random_errors_beside_it(count: int, size: float) -> None:
    rng = np.random.default_rng(1)
    shift, columns = drawn(rng, count + 6, size)
    law = np.arange(count)
    shift[law] = size * columns[law, :, 3] * rng.uniform(1, 2, (count, 1))
    shift += rng.normal(size=shift.shape)
    found = along_one_site(shift, columns, APART[: len(shift)])
    assert found[law].mean() >= 0.75
    assert found[count:].sum() <= 1


@pytest.mark.parametrize("sizes", [[100.0] * 6, [100, 50, -100, 60, 30, -80]])
def test_one_pose_is_no_law(sizes: list[float]) -> None:
    """One wrong reference there, or errors along an axis of the sensor that is a site's as well."""
    rng = np.random.default_rng(2)
    columns = np.repeat(directions(rng, 1, 3, 10), 6, axis=0)
    shift = np.array(sizes)[:, None] * columns[:, :, 3] + rng.normal(size=(6, 3))
    assert along_one_site(shift, columns, np.arange(6)).all()
    assert not along_one_site(shift, columns, np.zeros(6, dtype=int)).any()


def one_sided(model: Model, readings: Readings, size: float, joint: int) -> Readings:
    """Return readings of an arm with one joint that yields to torques of one sign alone."""
    theta = np.zeros(model.size)
    p = model.predict(readings.states, theta)
    turn = site_columns(model, theta, p, readings)[:, :, 3 * joint + 2]
    torque = p.situation.torque[:, joint]
    moved = turn * np.maximum(torque - np.median(torque), 0.0)[:, None]
    moved *= size / np.sqrt(np.mean(moved**2))
    return replace(readings, value=readings.value + moved)


@pytest.mark.parametrize("joint", [1, 2, 3])
def test_a_law_of_one_joint_is_not_set_aside(joint: int) -> None:
    c = campaign(mode="deflection", plan_seed=0, poses=12)
    model = baseline(c.cell, c.readings, "deflection")
    found = fit(model, one_sided(model, c.readings, 1e-3, joint), "deflection")
    assert not found.outlier.any()


def test_gross_errors_beside_such_a_law_are_found() -> None:
    c = campaign(mode="deflection", plan_seed=0, poses=12)
    model = baseline(c.cell, c.readings, "deflection")
    readings, wrong = spoil(
        one_sided(model, c.readings, 60e-6, 1), 0.2, 5e-3, np.random.default_rng(0)
    )
    found = fit(model, readings, "deflection")
    assert found.outlier[wrong].mean() >= 0.95
    r = readings
    lost = np.isin(r.pose, r.pose[wrong[r.unloaded[wrong]]])  # with their unloaded reading
    assert not found.outlier[~lost & ~np.isin(np.arange(len(r)), wrong)].any()


def random_model(mode: Mode, rng: np.random.Generator) -> ReadingModel:
    """30 readings; as deflections in groups of an unloaded and four or five loaded ones."""
    n, m, k = 30, 3, 4
    covariance = rng.normal(size=(n, m, m))
    covariance = covariance @ covariance.swapaxes(1, 2) + 0.1 * np.eye(m)
    root = inverse_root(covariance)
    members = np.arange(n).reshape(5, 6)
    members[2, 5] = -1
    return ReadingModel(
        residual=(root @ rng.normal(size=(n, m, 1)))[:, :, 0],
        columns=root @ rng.normal(size=(n, m, k)),
        precision=np.array([0.0, 0.0, 0.0, 2.0]),
        pull=np.array([0.0, 0.0, 0.0, 0.7]),
        root=root,
        members=members if mode == "deflection" else np.zeros((0, 0), dtype=np.int64),
    )


@pytest.mark.parametrize("mode", MODES)
def test_distances_are_those_of_least_squares_without_the_reading(mode: Mode) -> None:
    rng = np.random.default_rng(1)
    of = random_model(mode, rng)
    used = of.tested & (rng.random(len(of)) < 0.7)
    found = of.distances(used)
    groups = len(of.members)
    offsets = np.zeros((len(of), 3, 3 * groups))
    for k in np.flatnonzero(of.group >= 0):
        offsets[k, :, 3 * of.group[k] : 3 * of.group[k] + 3] = of.root[k]
    b = np.concatenate([of.columns, offsets], axis=2)
    prior = np.append(of.precision, np.zeros(3 * groups))
    pull = np.append(of.pull, np.zeros(3 * groups))
    for k in np.flatnonzero(of.tested):
        rest = used.copy()
        rest[k] = False
        rows = b[rest].reshape(-1, b.shape[2])
        c = np.linalg.inv(rows.T @ rows + np.diag(prior))
        delta = c @ (rows.T @ of.residual[rest].reshape(-1) - pull)
        off = of.residual[k] - b[k] @ delta
        exact = off @ np.linalg.solve(np.eye(3) + b[k] @ c @ b[k].T, off)
        assert found[k] == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("mode", MODES)
def test_a_step_of_the_linear_model_is_that_of_the_fit(mode: Mode, m: int) -> None:
    """At the minimum of a fit the step is zero, deflections through their offset as well."""
    c = campaign("none", mode, poses=12, m=m)
    found = based(c.cell, c.readings, mode)
    of = linearised(
        Snooping(found.model, c.readings, mode, found.solution, found.solution.y), found.solution.y
    ).linear
    delta, covariance = of.fitted(of.tested)
    assert np.abs(delta / np.sqrt(np.diagonal(covariance))).max() < 1e-2
    left = of.residuals(of.tested)
    assert np.sum(left**2) == pytest.approx(found.chi2, rel=1e-3)
    assert len(whitening(c.readings, mode)) == np.count_nonzero(of.tested) - len(of.members)


@pytest.mark.parametrize("mode", MODES)
def test_the_centre_of_a_group_is_among_readings_that_agree(mode: Mode) -> None:
    of = random_model(mode, np.random.default_rng(2))
    wrong = np.array([0, 3, 5, 6, 7, 20])
    residual = of.residual.copy()
    residual[wrong] += 1e4 * np.random.default_rng(3).normal(size=(len(wrong), 3))
    spoilt = ReadingModel(residual, of.columns, of.precision, of.pull, of.root, of.members)
    d2, centre = spoilt.near(np.zeros(4))
    assert not centre[wrong].any()
    assert np.count_nonzero(centre) == len(of.members)
    assert d2[wrong].min() > 100 * np.median(d2)
