"""Probabilities of structures, the Pareto list, and the average: against what is known exactly."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Amplitude, Factor, variables
from hilcal.discovery.discovery import Discovery, discover
from hilcal.discovery.law import Form, LawPart
from hilcal.discovery.search import Structure, averaged, pareto, posterior
from hilcal.discovery.sites import sites
from hilcal.errors import CannotAnswerError
from hilcal.identification.residual import residual
from hilcal.readings.whitening import whitening
from hilcal.regression.evidence import STRENGTHS, score_family
from hilcal.robot import se3
from tests.support.fit_cases import fitted_model
from tests.unit.discovery.test_discover import LAW, campaign, discovery


def test_probabilities_sum_to_one_with_that_of_no_law():
    """Two members of one structure, one of another, no law: weights 3 + 1, 4 and 1 of 9."""
    probability = posterior({"a": [np.log(3.0), 0.0], "b": [np.log(4.0)]})
    assert probability["a"] == pytest.approx(4 / 9, rel=1e-12)
    assert probability["b"] == pytest.approx(4 / 9, rel=1e-12)
    assert posterior({"a": [2000.0], "b": [1990.0]})["b"] == pytest.approx(np.exp(-10), rel=1e-3)


def columns(rng):
    """Five causes of which no two are told apart for sure: correlation 0.9."""
    common = rng.standard_normal((30, 1))
    x = 0.9**0.5 * common + 0.1**0.5 * rng.standard_normal((30, 5))
    return np.asarray(x)


def probabilities(x, y):
    rss = float(y @ y)
    odds = {}
    for k in range(x.shape[1]):
        score = score_family(x[:, [k]].T @ x[:, [k]], x[:, [k]].T @ y, rss, len(y))
        odds[k] = [score.marginal - np.log(x.shape[1])]
    chance = posterior(odds)
    return np.array([chance[k] for k in range(x.shape[1])])


def test_probabilities_are_frequencies_where_laws_are_drawn_from_the_priors():
    """400 draws of none or one of five causes, its size log-uniform over the prior's range.

    What is said sums to the number of right ones to within its binomial error, in each third.
    """
    rng = np.random.default_rng(8)
    said, right = [], []
    for _ in range(400):
        x, y = columns(rng), rng.standard_normal(30)
        k = int(rng.integers(-5, 5))  # none in half of the cases, as `posterior` has it
        if k >= 0:
            y = y + x[:, k] * rng.standard_normal() * rng.choice(STRENGTHS)
        said += probabilities(x, y).tolist()
        right += [j == k for j in range(5)]
    p, hit = np.array(said), np.array(right)
    for low, high in ((0.0, 0.1), (0.1, 0.5), (0.5, 1.0)):
        within = (p > low) & (p <= high)
        spread = np.sqrt(np.sum(p[within] * (1 - p[within])))
        assert within.sum() > 50
        assert abs(hit[within].sum() - p[within].sum()) < 3 * spread


def test_probabilities_are_those_of_bayes_rule_by_integration():
    """Known noise and size τ: p(y | k) = N(y; 0, 1 + τ² x xᵀ), integrated over the same τ."""
    rng = np.random.default_rng(3)
    x = np.vstack([columns(rng) for _ in range(20)])  # 600 rows: the noise is known well
    y = rng.standard_normal(len(x)) + 0.3 * x[:, 2]
    square, along = np.sum(x**2, axis=0), x.T @ y
    t2 = STRENGTHS[:, None] ** 2
    log = -0.5 * np.log1p(t2 * square) + 0.5 * t2 * along**2 / (1 + t2 * square)
    weight = np.exp(log).mean(axis=0) / 5
    exact = weight / (1 + weight.sum())
    assert probabilities(x, y) == pytest.approx(exact, abs=0.03)
    assert np.argmax(exact) == 2


def listed(*rows):
    empty = np.zeros(0)
    return [
        Structure(k, SimpleNamespace(complexity=size), 0.1, share, empty, empty, empty)
        for k, (size, share) in enumerate(rows)
    ]


def test_the_pareto_list_has_what_no_other_one_beats():
    of = listed((3, 0.9), (2, 0.5), (4, 0.9), (2, 0.4), (6, 0.95), (7, 0.2))
    assert [(x.form.complexity, x.holdout_share) for x in pareto(of)] == [
        (2, 0.5), (3, 0.9), (6, 0.95)
    ]  # fmt: skip
    for x in of:
        beaten = any(
            o.form.complexity <= x.form.complexity and o.holdout_share >= x.holdout_share
            for o in of if o is not x
        )  # fmt: skip
        assert beaten == (x not in pareto(of))


@pytest.mark.long
def test_the_average_of_one_law_is_its_fit_and_more_laws_spread_it():
    d = discovery()
    readings = d.fit.readings
    w = whitening(readings, d.fit.mode)
    before, after = (
        residual(readings, f.model.predict(readings.states, f.theta), w) for f in (d.fit, d.after)
    )
    one = next(x for x in d.structures if x.law)
    mean, std = averaged(d.fit, [one], readings)
    size = np.sqrt(np.mean((before - after) ** 2))
    assert np.sqrt(np.mean((mean - (before - after)) ** 2)) < 0.05 * size
    other = replace(one, step=-one.step)
    flat, wide = averaged(d.fit, [replace(one, probability=0.5), replace(other, probability=0.5)],
                          readings)  # fmt: skip
    assert np.abs(flat).max() < 1e-12
    assert wide == pytest.approx(np.hypot(std, mean), rel=1e-9)
    assert np.all(std > 0)
    again, _ = d.average(readings)
    assert np.sqrt(np.mean((again - mean) ** 2)) < 0.1 * size


def test_nothing_is_averaged_without_a_law():
    with pytest.raises(CannotAnswerError, match="no law was found"):
        Discovery(campaign(LAW), "no_law").average(campaign(LAW).readings)


def products(s, count):
    """Sites and products, of which the model explains neither these nor their factors alone."""
    words = s.grammar
    visible = s.square > 0
    out = []
    rng = np.random.default_rng(3)
    for f in rng.permutation(np.flatnonzero((words.without_factor >= 0).all(axis=0))).tolist():
        one, two = words.without_factor[:, f].tolist()
        places = np.flatnonzero(visible[:, f] & visible[:, one] & visible[:, two])
        if len(places):
            out.append((int(rng.choice(places)), f))
        if len(out) == count:
            return out
    raise AssertionError("too few products")


SHARE = 0.3
"""Share of what the sensor reads along +z that is not there; it reads the other way rightly."""


@pytest.fixture(autouse=True, scope="module")
def short_products():
    """All products, other than in the other files of this folder: the law is one of the longer."""


@cache
def misread():
    """The same arm with nothing hidden, read by a force sensor that is wrong on one side."""
    of = campaign()
    assert not of.outlier.any()
    states = of.readings.states
    turn = of.solution.prediction.situation.chain.rotation[-1]
    along = se3.apply(np.swapaxes(turn, 1, 2), states.wrench[:, :3])
    more = np.zeros_like(along)
    more[:, 2] = SHARE / (1 - SHARE) * np.maximum(along[:, 2], 0.0)
    wrench = states.wrench.copy()
    wrench[:, :3] += se3.apply(turn, more)
    readings = replace(of.readings, states=replace(states, wrench=wrench))
    return fitted_model(of.model.cell, readings, of.mode)


@cache
def sensor_law():
    return discover(misread())


@pytest.mark.long
def test_a_one_sided_force_sensor_is_found_with_its_size():
    d = sensor_law()
    law = d.laws[0]
    assert law.acts_on == ("force sensor, force along z",)
    assert law.variables == ("force sensor force z",)
    (a,) = law.parameters
    assert a.unit == "1"
    assert abs(a.value - SHARE) < 4 * a.std < 0.5 * SHARE
    assert d.after.chi2 < 0.5 * misread().chi2


@pytest.mark.parametrize(
    ("quantities", "unit"),
    [(("S_z",), "1"), (("S_z", "S_z"), "1/N"), (("S_x", "t"), "1/s"), (("t",), "N/s")],
)
def test_units_of_the_sensors_own_quantities_cancel(quantities, unit):
    known = variables(misread().solution.prediction.situation)
    named = {v.symbol.removeprefix("f").partition(" ")[0].strip("("): v for v in known}
    factors = tuple(Factor(named[q], shapes.LINEAR) for q in quantities)
    site = next(s for s in sites(6) if s.symbol == "sensor_fz")
    assert Form((LawPart(site, Amplitude(factors), 0),)).unit(0) == unit
