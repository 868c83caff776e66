"""Plans for predictions with all effects: condensed, the problem is that of all parameters."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.design import choice as condensing
from hilcal.design.approximate_design import relax
from hilcal.design.choice import EFFORT, balanced, mixed_design, objective_of, other_effects
from hilcal.design.criteria import MeanVariance
from hilcal.design.information import (
    absolute_rows,
    deflection_rows,
    information_of,
    problem,
    reading_derivatives,
)
from hilcal.design.nominal_model import model_after, nominal_model
from hilcal.design.optimum import best_design
from hilcal.design.planner import PlanRequest, plan_readings
from hilcal.design.predicted import position_derivative, prediction_poses
from hilcal.errors import InputError
from tests.support.campaigns import campaign, cell_of
from tests.support.fit_cases import fitted_model
from tests.support.plan_cases import changed, config_of, poses_of
from tests.support.rows import first

AGAINST = ("joint_tilt_compliance", "link_geometry", "transmission_error")
STD_RAD = 2e-5


def config(mode):
    cell_config = config_of(
        mode, against=AGAINST, work_load="none" if mode == "absolute" else "10kg"
    )
    return changed(cell_config, repeatability={"joint_std_rad": STD_RAD})


def scene(mode, *, fitted):
    known = config(mode)
    if fitted:
        c = campaign(mode=mode, poses=8, seed=3, registration_known=True)
        nominal = model_after(fitted_model(c.cell, c.readings, mode), known)
    else:
        nominal = nominal_model(cell_of(registration_known=True).with_config(known))
    of = problem(nominal, known, poses_of(6))
    return of, prediction_poses(of.nominal, known, poses_of(5, 9))


def mean_variance_of_all(of, work, mode, counts):
    """tr(C M⁻¹) by all parameters as they are."""
    known, nominal = config(mode), of.nominal
    more, std = other_effects(nominal, known)
    live = nominal.prior_std[nominal.live]
    scale = np.concatenate([np.where(np.isinf(live), of.scale[: len(live)], live), std])
    prior = np.concatenate([~np.isinf(live), np.ones(len(std), dtype=bool)]).astype(float)
    m = information_of(nominal, more, scale) + np.diag(prior)
    (part,) = reading_derivatives(nominal, known, of.candidates, more, scale)
    for (pose, loads), count in zip(of.contents, counts, strict=True):
        index = tuple(of.candidates.loads.index(name) for name in loads)
        if mode == "absolute":
            rows = absolute_rows(part)[pose, index[0]]
        else:
            rows = deflection_rows(part, np.array([pose]), index)[0]
        m += count * rows.T @ rows
    v = position_derivative(nominal, work, more, scale).reshape(-1, len(scale))
    return float(np.trace(v @ np.linalg.solve(m, v.T))) / len(work.q)


@pytest.mark.parametrize("fitted", first(1, [True, False]))
@pytest.mark.parametrize("mode", first(1, ["deflection", "absolute"]))
def test_with_all_directions_the_mean_variance_is_that_of_all_parameters(monkeypatch, mode, fitted):
    monkeypatch.setattr(condensing, "DIRECTIONS", 10_000)
    monkeypatch.setattr(condensing, "LEAST", 0.0)
    of, work = scene(mode, fitted=fitted)
    asked = mixed_design(of, config(mode), work)
    # what no unit moves is as uncertain by every plan, and left out
    # (more than 1e7 of each lose digits to rounding)
    many = np.full(len(of.units), 1e7)
    least = mean_variance_of_all(of, work, mode, many) - variance_of(asked, many)
    for seed in range(3):
        counts = np.random.default_rng(seed).integers(1, 3, len(of.units)).astype(float)
        every = mean_variance_of_all(of, work, mode, counts) - least
        assert variance_of(asked, counts) == pytest.approx(every, rel=1e-5)


def variance_of(asked, counts):
    m = asked.prior + asked.units.information(counts)
    return float(np.trace(asked.criterion.c @ np.linalg.inv(m)))


def test_directions_that_are_left_out_are_noise_and_nothing_is_learnt_of_them(monkeypatch):
    """Of one unit: what is predicted of the kept directions is as uncertain as by all of them."""
    monkeypatch.setattr(condensing, "DIRECTIONS", 10_000)
    monkeypatch.setattr(condensing, "LEAST", 0.0)
    of, work = scene("absolute", fitted=True)
    whole = mixed_design(of, config("absolute"), work)
    monkeypatch.setattr(condensing, "DIRECTIONS", 12)
    few = mixed_design(of, config("absolute"), work)
    flat = len(few.prior) - 12
    kept = np.r_[np.arange(flat), np.arange(len(whole.prior) - 12, len(whole.prior))]
    for k in range(0, len(of.units), 7):
        counts = np.zeros(len(of.units))
        counts[k] = 1.0
        of_all = np.linalg.inv(whole.prior + whole.units.information(counts))
        of_few = np.linalg.inv(few.prior + few.units.information(counts))
        assert of_few == pytest.approx(of_all[np.ix_(kept, kept)], rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("mode", first(1, ["absolute", "deflection"]))
def test_what_is_predicted_counts_the_directions_that_are_left_out(monkeypatch, mode):
    """Before further readings all of it is known; later nothing is learnt of these directions."""
    of, work = scene(mode, fitted=True)
    monkeypatch.setattr(condensing, "DIRECTIONS", 12)
    few = mixed_design(of, config(mode), work)
    monkeypatch.setattr(condensing, "DIRECTIONS", 10_000)
    monkeypatch.setattr(condensing, "LEAST", 0.0)
    whole = mixed_design(of, config(mode), work)
    assert few.criterion.rest > 0
    for d in (few, balanced(few)):
        assert d.criterion.std(d.prior) == pytest.approx(whole.criterion.std(whole.prior), rel=1e-6)
    counts = np.ones(len(of.units))
    stds = [d.criterion.std(d.prior + d.units.information(counts)) for d in (whole, few)]
    assert stds[0] <= stds[1] < whole.criterion.std(whole.prior)


@pytest.mark.long
def test_a_plan_after_a_fit_of_another_arm_is_refused():
    c = campaign(mode="absolute", poses=8, seed=3, registration_known=True)
    fitted = fitted_model(c.cell, c.readings, "absolute")
    other = changed(config("absolute"), robot={"model": "ur5e"})
    with pytest.raises(InputError, match="of the arm ur10e, whose nominal links differ"):
        plan_readings(cell_from_config(other), PlanRequest(4), np.random.default_rng(0), fitted)


def test_what_is_known_very_well_does_not_hide_what_a_reading_tells():
    """After many readings: the same mean variance in balanced coordinates, and a plan is found."""
    of, work = scene("absolute", fitted=True)
    plain = mixed_design(of, config("absolute"), work)
    size = np.logspace(-6, 6, len(plain.prior))  # coordinates that rounding would decide in
    uneven = replace(
        plain,
        units=replace(plain.units, rows=plain.units.rows * size),
        prior=plain.prior * np.outer(size, size),
        criterion=MeanVariance(plain.criterion.c * np.outer(size, size)),
    )
    counts = np.ones(len(of.units))
    variances = [variance_of(d, counts) for d in (plain, balanced(uneven))]
    assert variances[1] == pytest.approx(variances[0], rel=1e-6)
    relaxed = [relax(balanced(d), 20.0).value for d in (plain, uneven)]
    assert relaxed[1] == pytest.approx(relaxed[0], rel=1e-4)


@pytest.mark.long
def test_a_plan_for_predictions_is_better_than_random_poses_and_certified():
    known = config("absolute").model_copy(update={"loads": []})
    nominal = nominal_model(cell_of(registration_known=False).with_config(known))
    nominal = replace(nominal, live=nominal.live[:-6])  # no load tells the compliance
    of = problem(nominal, known, poses_of(80))
    asked = objective_of(of, known, "I", prediction_poses(of.nominal, known, poses_of(30, 9)))
    design = best_design(asked, 20.0, np.random.default_rng(0), effort=EFFORT)
    # the bound splits precise readings over all poses, which no plan can
    assert 0.1 < design.efficiency <= 1.0
    rng, others = np.random.default_rng(5), []
    for _ in range(20):
        some = rng.permutation(len(of.units))[:20]
        m = asked.prior + asked.units.information(np.ones(20), some)
        others.append(float(asked.criterion.value(m)))
    assert design.value > 1.2 * max(others)
