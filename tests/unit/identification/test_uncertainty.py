"""Standard uncertainties: they are the spread that repeated campaigns show."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import chi2

from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.identification.priors import prior_of
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode
from tests.support.campaigns import campaign, with_noise
from tests.support.effect_cases import make
from tests.support.rows import first

MODES = ("absolute", "deflection")


@dataclass(frozen=True, slots=True, eq=False)
class Sampling:
    """R campaigns that differ by noise alone; P parameters."""

    error: np.ndarray  # (R, P) estimate − truth
    std: np.ndarray  # (R, P) as stated; what was known before where nothing was learnt
    factor: np.ndarray  # (R,) variance factors
    inflated: np.ndarray  # (R,)
    covered: np.ndarray  # (R,) whether the variance factor's interval contains 1


def design(mode: Mode) -> tuple[Model, Readings, np.ndarray]:
    """Frames, where known with their prior, and compliances; readings of the truth."""
    c = campaign(plan_seed=0, registration_known=True, target_known=True)
    states = c.readings.states
    known = {"prior_m": 1e-4, "prior_rad": 2e-4} if mode == "deflection" else {}
    effects = (
        make("base_frame", c.cell, states, known),
        make("target_offset", c.cell, states, known),
        make("joint_compliance", c.cell, states),
    )
    truth = np.concatenate([np.zeros(9), c.world.physics.joint_compliance])
    return Model(c.cell, effects), c.readings, truth


def sample(mode: Mode, count: int, seed: int = 0) -> Sampling:
    """Fit `count` campaigns; what has a prior is drawn from it every time."""
    model, readings, truth = design(mode)
    prior = prior_of(model)[0]
    rng = np.random.default_rng(seed)
    out: list[tuple[np.ndarray, Fit]] = []
    for _ in range(count):
        drawn = rng.normal(size=len(truth))
        theta = np.where(np.isfinite(prior), prior * drawn, truth)
        clean = model.predict(readings.states, theta).observation.position
        noisy = with_noise(replace(readings, value=clean), rng)
        found = fit(model, noisy, mode)
        out.append((found.theta - theta, found))
    fits = [f for _, f in out]
    interval = np.array([f.variance_factor_interval for f in fits])
    return Sampling(
        error=np.array([e for e, _ in out]),
        std=np.array(
            [
                np.where(f.uncertainty.identifiable, f.uncertainty.std, f.uncertainty.formal)
                for f in fits
            ]
        ),
        factor=np.array([f.variance_factor for f in fits]),
        inflated=np.array([f.uncertainty.inflated for f in fits]),
        covered=(interval[:, 0] <= 1) & (interval[:, 1] >= 1),
    )


def check(s: Sampling) -> None:
    """Spread, bias and coverage, each within what so many campaigns can tell (4 σ of it)."""
    count, size = s.error.shape
    z = s.error / s.std
    ratio = s.error.std(axis=0, ddof=1) / np.median(s.std, axis=0)
    # Monte-Carlo error of a standard deviation; a campaign in a hundred has it inflated.
    np.testing.assert_allclose(ratio, 1, rtol=0, atol=4 / np.sqrt(2 * (count - 1)) + 0.01)
    np.testing.assert_allclose(z.mean(axis=0), 0, rtol=0, atol=4 / np.sqrt(count))
    total = (z**2).sum(axis=0)
    assert np.all((total > chi2.ppf(3e-5, count)) & (total < chi2.isf(3e-5, count)))
    covered = np.mean(np.abs(z) < 1.959964, axis=0)
    np.testing.assert_allclose(covered, 0.95, rtol=0, atol=4 * np.sqrt(0.95 * 0.05 / count) + 0.005)
    assert s.covered.mean() == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / count))
    assert s.inflated.mean() == pytest.approx(0.01, abs=4 * np.sqrt(0.01 * 0.99 / count))
    assert size == 15


@pytest.mark.long
@pytest.mark.parametrize("mode", MODES)
def test_stated_uncertainties_are_the_sampling_spread(mode):
    check(sample(mode, 60))


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
def test_stated_uncertainties_are_the_sampling_spread_in_many_campaigns(mode):
    check(sample(mode, 500, seed=1))


def test_uncertainties_fall_with_the_root_of_the_readings():
    model, readings, truth = design("absolute")
    twice = readings[np.tile(np.arange(len(readings)), 4)]
    clean = model.predict(twice.states, truth).observation.position
    rng = np.random.default_rng(0)
    many = fit(model, with_noise(replace(twice, value=clean), rng), "absolute")
    once = fit(model, with_noise(replace(readings, value=clean[: len(readings)]), rng), "absolute")
    np.testing.assert_allclose(many.uncertainty.formal, once.uncertainty.formal / 2, rtol=1e-3)


def test_a_prior_is_learnt_from_or_marked_as_unseen():
    """Deflections do not see where the base is: its shift stays what was known of it."""
    model, readings, truth = design("deflection")
    clean = model.predict(readings.states, truth).observation.position
    found = fit(model, replace(readings, value=clean), "deflection")
    shift = found.uncertainty
    np.testing.assert_allclose(shift.formal[:3], 1e-4, rtol=1e-6)
    assert not shift.identifiable[:3].any()
    assert np.isinf(shift.std[:3]).all()
    assert shift.identifiable[9:].all()


def halves(effect: str, mode: Mode, strength: float, seeds: range) -> tuple[np.ndarray, ...]:
    """Differences of compliances between two halves over their stated and formal uncertainty."""
    stated, formal, inflated = [], [], []
    for seed in seeds:
        c = campaign(effect, mode, seed, poses=40, plan_seed=0, strength=strength)
        for mine in (c.readings.pose < 20, c.readings.pose % 2 == 0):
            fits = []
            for rows in (mine, ~mine):
                r = c.readings[rows]
                fits.append(fit(baseline(c.cell, r, mode), r, mode))
            rows = fits[0].model.slices()[fits[0].model.names.index("joint_compliance")]
            apart = fits[0].theta[rows] - fits[1].theta[rows]
            stated.append(apart / np.hypot(*(f.uncertainty.std[rows] for f in fits)))
            formal.append(apart / np.hypot(*(f.uncertainty.formal[rows] for f in fits)))
            inflated += [f.uncertainty.inflated for f in fits]
    return np.array(stated), np.array(formal), np.array(inflated)


@pytest.mark.parametrize(
    ("effect", "mode"),
    first(
        1,
        [
            ("joint_tilt_compliance", "deflection"),
            ("transmission_error", "absolute"),
            ("joint_tilt_compliance", "absolute"),
        ],
    ),
)
def test_halves_agree_within_what_is_stated_where_a_large_effect_is_missing(effect, mode):
    stated, formal, inflated = halves(effect, mode, 6.0, range(3))
    assert inflated.all()
    # Formal uncertainties would be a lie.
    assert np.sqrt(np.mean(formal**2)) > 2.5
    # Stated ones: rms 1 where they are exact, with 36 differences that are partly dependent.
    assert np.sqrt(np.mean(stated**2)) < 1.4
    assert np.abs(stated).max() < 3.5
    # And not wildly too wide either.
    assert np.sqrt(np.mean(stated**2)) > 0.3


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["link_geometry", "transmission_error", "base_compliance"])
def test_halves_agree_within_what_is_stated_over_many_seeds(effect):
    stated, _, _ = halves(effect, "absolute", 6.0, range(10, 25))
    print(f"{effect}: rms z {np.sqrt(np.mean(stated**2)):.2f}, max {np.abs(stated).max():.2f}")
    assert 0.3 < np.sqrt(np.mean(stated**2)) < 1.3
    assert np.mean(np.abs(stated) > 1.96) < 0.1
