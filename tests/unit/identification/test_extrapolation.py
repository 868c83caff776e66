"""Readings outside of what was measured are announced, and their standard deviations hold."""

import numpy as np
import pytest

from hilcal.effects.catalogue import installed
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.identification.predictive import predictive
from hilcal.identification.validation import Extrapolation, Validation, extrapolation, validate
from tests.support.campaigns import campaign


def split(seed: int, joint: int | None) -> tuple[Fit, Validation, Extrapolation]:
    """A fit to half of the unloaded readings, by joint angle or at random, and the other half."""
    c = campaign(
        "transmission_error", "absolute", seed, plan_seed=5, poses=100, harmonics=8, strength=3.0
    )
    r = c.readings[c.readings.load == 0]
    first = np.random.default_rng(seed).permutation(len(r)) < len(r) // 2
    if joint is not None:
        first = r.states.q[:, joint] < np.median(r.states.q[:, joint])
    names = ("joint_compliance", "transmission_error")
    model = with_effects(c.cell, r[first], "absolute", names, {}, installed())
    found = fit(model, r[first], "absolute")
    other = validate(model, found.theta, found.readings, r[~first], "absolute")
    used = found.readings[~found.outlier]
    p = predictive(
        model, found.theta, found.solution.prior, used, "absolute", found.holdout.rms_sigma
    )
    return found, other, extrapolation(p, found.readings, other)


def rms(z: np.ndarray) -> float:
    return float(np.sqrt(np.mean(z**2)))


@pytest.mark.parametrize("joint", [0, 1])
def test_half_against_half_of_a_joint_is_outside_and_its_error_is_stated(joint: int) -> None:
    z = []
    for seed in range(2):
        found, other, x = split(seed, joint)
        assert x.outside.mean() > 0.9
        lead = x.variables[0]
        assert (lead.variable, lead.unit) == (f"joint {joint + 1} angle", "rad")
        q = other.readings.states.q[:, joint]
        either_way = np.minimum(q - lead.high, lead.low + 2 * np.pi - q)  # whole turns are the same
        assert lead.most == pytest.approx(either_way.max())
        assert x.outside_error is not None
        assert rms(x.stated_m[x.outside]) > 1.2 * found.holdout.rms_m
        z.append(rms(x.z))
    assert 0.5 < rms(np.array(z)) < 1.15


def test_of_two_random_halves_few_are_outside() -> None:
    z = []
    for seed in range(2):
        found, other, x = split(seed, None)
        assert x.outside.mean() < 0.1
        assert x.inside_error is not None
        assert x.inside_error.rms_m == pytest.approx(other.error.rms_m, rel=0.1)
        assert other.error.rms_sigma < 1.2 * found.holdout.rms_sigma
        z.append(rms(x.z))
    assert 0.6 < rms(np.array(z)) < 1.1
