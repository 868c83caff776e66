"""Targets that are read in one arrival share the arm's scatter: covariances and statistics."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import fit
from hilcal.identification.full_covariance import with_common_scatter, with_joint_scatter
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, whitening
from hilcal.types import Floats
from tests.support.reflector_cases import reflectors

MODES: tuple[Mode, ...] = ("absolute", "deflection")
STD = 1e-4
"""The arm's scatter, rad: several times the noise of the tracker."""


def dense(readings: Readings) -> Floats:
    """(N·m, N·m) covariance of all readings, entry by entry."""
    n, m = len(readings), readings.m
    out = np.zeros((n, m, n, m))
    assert readings.common is not None
    arrival = readings.arrivals
    for i in range(n):
        for j in range(n):
            if i == j:
                out[i, :, i] = readings.covariance[i]
            elif arrival[i] == arrival[j]:
                out[i, :, j] = readings.common[i] @ readings.common[j].T
    return out.reshape(n * m, n * m)


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("mode", MODES)
def test_whitening_is_the_root_of_the_full_covariance(mode: Mode, m: int) -> None:
    whole = reflectors(joint_std=STD, m=m, poses=3, cycles=2).readings
    rng = np.random.default_rng(0)
    # One reflector is lost now and then; shuffled rows.
    rows = rng.permutation(len(whole))[: len(whole) - 9]
    keep = np.concatenate([rows, np.flatnonzero(whole.unloaded & (whole.target < 2))])
    readings = whole[np.unique(keep)][rng.permutation(len(np.unique(keep)))]
    w = whitening(readings, mode)
    unit = np.eye(len(readings) * m).reshape(len(readings), m, -1)
    d = w.raw(unit).reshape(len(w) * m, -1)
    g = w.whiten(w.raw(unit)).reshape(len(w) * m, -1)
    np.testing.assert_allclose(g @ dense(readings) @ g.T, np.eye(len(g)), atol=1e-8)
    own = (d @ dense(readings) @ d.T).reshape(len(w), m, len(w), m)
    each = np.arange(len(w))
    np.testing.assert_allclose(own[each, :, each], w.covariance, rtol=1e-8, atol=1e-16)
    if mode == "deflection":
        # Each loaded reading minus the mean of its own target's unloaded ones, and no other.
        used = np.abs(w.raw(np.eye(len(readings))[:, None, :].repeat(m, 1))).sum(axis=1) > 0
        for k in range(len(w)):
            mine = np.flatnonzero(used[k])
            for key in (readings.pose, readings.cycle, readings.target):
                assert len(np.unique(key[mine])) == 1


@pytest.mark.parametrize("mode", MODES)
def test_p_values_and_standard_errors(mode: Mode) -> None:
    """With the scatter in common χ² is χ² and errors are as stated; taken apart they are not."""
    p_values, z, apart = [], [], []
    for seed in range(12):
        c = reflectors(seed=seed, poses=8, joint_std=STD, known=(False, False, True))
        true = c.world.physics.joint_compliance
        for readings, found in (
            (c.readings, z),
            (replace(c.readings, common=None), apart),
        ):
            f = fit(baseline(c.cell, readings, mode), readings, mode)
            found.append((f.theta[-6:] - true) / f.uncertainty.formal[-6:])
            if found is z:
                p_values.append(chi2.sf(f.chi2, f.dof))
    assert kstest(p_values, "uniform").pvalue > 0.01
    # 72 standardised errors: rms within 1 ± 0.25 (3 σ); about √3 where rows count as arrivals.
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1.0, abs=0.25)
    assert np.sqrt(np.mean(np.square(apart))) > 1.3


def test_repeatability_is_common_to_an_arrival() -> None:
    c = reflectors(joint_std=STD, poses=6)
    bare = replace(c.readings, covariance=c.readings.covariance * 0.0, common=None)
    made = with_joint_scatter(c.cell, bare, np.full(6, STD))
    assert made.common is not None
    assert c.readings.common is not None
    # The world's own mechanics give the same factors but for the arm's elasticity.
    np.testing.assert_allclose(made.common, c.readings.common, atol=0.02 * STD)
    np.testing.assert_allclose(
        made.covariance, made.common @ np.swapaxes(made.common, 1, 2), atol=1e-18
    )


def test_stated_covariances_that_include_the_scatter() -> None:
    c = reflectors(joint_std=STD, poses=6)
    assert c.readings.common is not None
    stated = replace(c.readings, common=None)
    made = with_common_scatter(c.cell, stated, np.full(6, STD)).common
    np.testing.assert_allclose(made, c.readings.common, atol=0.02 * STD)
    # A scatter beyond what is stated is shortened: what is left of each reading stays a covariance.
    more = with_common_scatter(c.cell, stated, np.full(6, 10 * STD))
    assert more.common is not None
    left = more.covariance - more.common @ np.swapaxes(more.common, 1, 2)
    assert np.linalg.eigvalsh(left).min() > -1e-9 * np.abs(more.covariance).max()
    one = replace(stated, states=replace(stated.states, target=None))
    assert with_common_scatter(c.cell, one, np.full(6, STD)).common is None


def test_a_hidden_reflector_is_a_missing_reading() -> None:
    c = reflectors("base_compliance", strength=5.0, joint_std=1e-5, known=(False, False, True))
    r = c.readings
    lost = (r.target == 1) & (r.pose % 4 == 0) | (r.target == 2) & (r.pose == 3) & r.unloaded
    kept = r[~lost]
    model = with_effects(c.cell, kept, "deflection", ["joint_compliance", "base_compliance"])
    f = fit(model, kept, "deflection")
    off = f.theta[-3:] - c.world.physics.base_compliance
    assert np.abs(off / f.uncertainty.std[-3:]).max() < 4.0
    assert chi2.sf(f.chi2, f.dof) > 1e-3
    orphans = int(np.count_nonzero((r.target == 2) & (r.pose == 3) & ~r.unloaded))
    assert len(f.whitening) == np.count_nonzero(~kept.unloaded) - orphans
