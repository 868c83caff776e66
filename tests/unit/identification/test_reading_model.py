"""Distances of single readings from the fit to the others, against least squares written out."""

import numpy as np
import pytest

from hilcal.identification.baseline import baseline
from hilcal.identification.data_snooping import Snooping, linearised
from hilcal.identification.fit import fit
from hilcal.identification.least_trimmed_squares import ReadingModel
from hilcal.readings.whitening import MODES, Mode, inverse_root, whitening
from tests.support.campaigns import campaign


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
    found = fit(baseline(c.cell, c.readings, mode), c.readings, mode)
    of = linearised(
        Snooping(found.model, c.readings, mode, found.solution, found.solution.y),
        found.solution.y,
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
