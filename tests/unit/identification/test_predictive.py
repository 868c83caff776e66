"""What is stated of poses left out is the mean square of their errors."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.effects.catalogue import installed
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import fit
from hilcal.identification.predictive import (
    Excess,
    Predictive,
    _left_out,
    parameter_factor,
    position_factor,
    predictive,
)
from tests.support.campaigns import campaign

NOISE, FOLDS, EACH = 1.7, 10, 12


@pytest.mark.parametrize("size", [60, 300])
def test_left_out_folds_are_as_far_off_as_dense_algebra_has_it(size: int) -> None:
    """Few readings of wide priors: single folds tell almost all of some directions."""
    rng = np.random.default_rng(size)
    count = FOLDS * EACH
    a = rng.normal(size=(count, size)) * 10.0 ** rng.uniform(-1, 2, size)
    fold = rng.permutation(np.arange(count) % FOLDS)
    other, points = rng.normal(size=(2 * FOLDS, size)), np.repeat(np.arange(FOLDS), 2)
    rows = other_rows = 0.0
    for f in range(FOLDS):
        rest = a[fold != f]
        c = np.linalg.inv(np.eye(size) + rest.T @ rest / NOISE)
        rows += np.trace(a[fold == f] @ c @ a[fold == f].T)
        other_rows += np.trace(other[points == f] @ c @ other[points == f].T)
    values, vectors = np.linalg.eigh(a.T @ a)
    root = vectors * np.sqrt(NOISE / (np.maximum(values, 0.0) + NOISE))
    found = _left_out(a, fold, ((a, fold), (other, points)), root, NOISE)
    assert found == pytest.approx([rows / count, other_rows / len(other)], rel=1e-3)


def test_the_stated_mean_square_is_what_was_found_and_never_less_than_the_fit_has() -> None:
    c = campaign("none", "absolute", plan_seed=0)
    model = with_effects(c.cell, c.readings, "absolute", (), {}, installed())
    none = np.zeros(0)
    p = Predictive(
        model, none, none[:, None], none, Excess(), 1.0, 1.0, 1.0, none, 1.0, 3.0, 25e-10, 75e-10
    )  # fmt: skip
    for sigma, metres in ((2.0, 1e-4), (4.0, 2e-4)):
        by_v, by_position = parameter_factor(p, sigma), position_factor(p, metres)
        assert p.scatter + by_v * p.left_out == pytest.approx(sigma**2)
        assert p.scatter_m2 + by_position * p.left_out_m2 == pytest.approx(metres**2)
    assert parameter_factor(p, 1.5) == position_factor(p, 9e-5) == 1.0


@pytest.mark.parametrize("seed", [1, 3])
def test_scatter_beyond_the_stated_noise_is_told_from_what_many_parameters_take(seed: int) -> None:
    """120 coordinates, 144 parameters of a family and others: half of the residual is fitted away.

    Taken by the stated noise alone, the parameters seem to have taken nearly all of it. Of 30 µm
    31 to 54 µm are found with seeds 0 to 3, of which these are the nearest and the farthest: what
    shrinkage leaves of the family counts as scatter, too.
    """
    scatter = 30e-6
    c = campaign("transmission_error", "absolute", seed=seed, poses=40, m=3)
    r = c.readings[np.unique(c.readings.pose, return_index=True)[1]]
    more = scatter * np.random.default_rng(seed).standard_normal(r.value.shape)
    r = replace(r, value=r.value + more)
    names = ("joint_compliance", "transmission_error")
    options = {"transmission_error": {"harmonics": 12}}
    found = fit(with_effects(c.cell, r, "absolute", names, options), r, "absolute")
    p = predictive(
        found.model,
        found.theta,
        found.solution.prior,
        found.readings[~found.outlier],
        "absolute",
        found.holdout.rms_sigma,
    )
    assert p.excess.attitude == 1.0
    assert scatter / 2 < np.sqrt(p.excess.position) < scatter * 2
    assert p.noise < 1.2
