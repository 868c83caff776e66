"""Repeats tell noise from model: by how much, in which direction, and when they cannot."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from hilcal.diagnosis.noise import judge_noise, pure_error
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.model.observe import motion
from tests.support.campaigns import campaign, noiseless, plan, with_noise
from tests.support.rows import first

MODES = ("absolute", "deflection")


class Repeated:
    """A campaign measured twice or more, of which some readings are missing."""

    def __init__(self, mode, poses, cycles=2, m=3, missing=0.15, effect="none"):
        c = campaign(effect, mode, plan_seed=0, poses=poses, cycles=cycles, m=m,
                     registration_known=True)  # fmt: skip
        clean = noiseless(c.world, plan(poses, 0, cycles), m)
        kept = np.random.default_rng(5).random(len(clean)) >= missing
        self.clean = clean[kept | clean.unloaded]
        self.mode = mode
        self.model = baseline(c.cell, self.clean, mode)

    def fit(self, readings):
        return fit(self.model, readings, self.mode)

    def motion(self):
        p = self.model.predict(self.clean.states, np.zeros(self.model.size))
        cell, chain = self.model.cell, p.situation.chain
        return motion(cell, p.observation, chain, p.deviation, self.clean.m).dq


def found(r, readings):
    return pure_error(r.fit(readings))


def null_p_values(mode, m, seeds):
    r, rng = Repeated(mode, 6, m=m), np.random.default_rng(1)
    pure, lack = [], []
    for _ in range(seeds):
        e = found(r, with_noise(r.clean, rng))
        pure.append(chi2.sf(e.factor * e.dof, e.dof))
        lack.append(e.lack_of_fit_p)
    return pure, lack


@pytest.mark.long
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("m", "seeds"), [(3, 40), *(pytest.param(m, 300, marks=pytest.mark.slow) for m in (3, 6))]
)
def test_the_factor_is_chi_square_and_so_is_what_is_left(mode, m, seeds):
    for p in null_p_values(mode, m, seeds):
        assert kstest(p, "uniform").pvalue > 1e-3 / 8


@pytest.mark.parametrize("mode", MODES)
def test_estimated_covariances_do_not_bias_the_factor(mode):
    """Ten samples each, and a prior worth twenty."""
    r, rng, m = Repeated(mode, 8, m=6), np.random.default_rng(2), 6
    root, factors = np.linalg.cholesky(r.clean.covariance), []
    for _ in range(12):
        z = rng.standard_normal((len(r.clean), 9, m))
        estimate = (20 * np.eye(m) + np.swapaxes(z, 1, 2) @ z) / 29
        covariance = root @ estimate @ np.swapaxes(root, 1, 2)
        e = found(r, replace(with_noise(r.clean, rng), covariance=covariance))
        factors.append(e.factor)
    # 4 σ of the mean; uncorrected, the factor would be 1.07.
    assert np.mean(factors) == pytest.approx(1, abs=4 * np.sqrt(2 / e.dof / len(factors)))


def test_drift_and_friction_between_repeats_are_not_noise():
    for effect in ("hysteresis", "tracker_drift"):
        r = Repeated("absolute", 10, effect=effect)
        e = found(r, with_noise(r.clean, np.random.default_rng(3)))
        assert e.lack_of_fit_p < 1e-6
        assert e.factor == pytest.approx(1, abs=4 * np.sqrt(2 / e.dof))


def spoilt(r, what, rng):
    read = with_noise(r.clean, rng)
    value, v = read.value.copy(), r.clean.covariance[:, :3, :3]
    draw = rng.standard_normal(len(value))[:, None]
    if what == "along the beam":
        u = r.clean.value[:, :3] / np.linalg.norm(r.clean.value[:, :3], axis=1)[:, None]
        value[:, :3] += 3 * u * np.sqrt(np.einsum("ki,kij,kj->k", u, v, u))[:, None] * draw
    elif what.startswith("joint"):
        value += r.motion()[:, :, int(what[-1]) - 1] * 4e-5 * draw
    else:
        name = "none" if what == "unloaded" else what
        mine = np.array(r.clean.load_names)[r.clean.load] == name
        value[mine] += 2 * (read.value - r.clean.value)[mine]
    return replace(read, value=value)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "what", first(3, ["along the beam", "joint 3", "10kg", "joint 1", "unloaded"])
)
def test_the_direction_that_scatters_is_named(mode, what):
    r = Repeated(mode, 20, missing=0.0)
    e = found(r, spoilt(r, what, np.random.default_rng(0)))
    assert e.where.name == what
    assert e.where.p_value < 1e-3
    assert e.where.interval[0] > 1.5
    if what == "along the beam":
        assert e.where.interval[0] < 10 < e.where.interval[1]


@pytest.mark.parametrize("mode", MODES)
def test_a_common_factor_has_no_direction(mode):
    r = Repeated(mode, 10)
    for seed in range(3):
        e = found(r, with_noise(r.clean, np.random.default_rng(seed), 2.0))
        assert e.where is None
        assert e.interval[0] < 4.5
        assert e.interval[1] > 3.5


def test_repeats_that_scatter_less_blame_the_model():
    r = Repeated("absolute", 10, effect="encoder_offset")
    f = r.fit(with_noise(r.clean, np.random.default_rng(0), 2.0))
    verdict = judge_noise(f, pure_error(f), False)
    assert verdict.contradicted
    assert not verdict.misjudged
    assert verdict.reason == "lack_of_fit"
