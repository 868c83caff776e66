"""Noise that is correlated along the order: its law in the scaling, for every kind of readings."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from hilcal.readings import whitening as scaling_module
from hilcal.readings.covariance import symmetric_root
from hilcal.readings.readings import SerialNoise
from hilcal.readings.whitening import MODES, has_unloaded, whitening
from tests.unit.data.test_whitening import make_readings, random_readings, spd

NOISE = SerialNoise("order", 0.8, 0.05, 7.0, float(np.exp(-1 / 7)), 0.02, 30.0)


def covariance_of(readings):
    """(N·m, N·m) covariance of all readings, element by element from the law."""
    n, m, r = len(readings), readings.m, readings
    arrivals = r.arrivals
    full = np.zeros((n, m, n, m))
    stated = r.covariance if r.stated is None else r.stated
    if r.common is not None:
        stated = r.covariance - r.common @ np.swapaxes(r.common, 1, 2)
    root = symmetric_root(stated)
    for i in range(n):
        for j in range(n):
            if i == j:
                full[i, :, i] = r.covariance[i]
                continue
            rho = np.exp(-abs(r.along[i] - r.along[j]) / r.serial.length)
            full[i, :, j] = r.serial.share * rho * root[i] @ root[j].T
            if r.common is not None and arrivals[i] == arrivals[j]:
                full[i, :, j] += r.common[i] @ r.common[j].T
    return full.reshape(n * m, n * m)


def difference(readings, mode, loaded):
    """(D·m, N·m) measurements from readings, each from its own unloaded ones."""
    n = len(readings)
    d = np.zeros((len(loaded), n))
    for k, i in enumerate(loaded):
        d[k, i] = 1.0
        if mode == "deflection":
            same = (readings.pose == readings.pose[i]) & (readings.cycle == readings.cycle[i])
            same &= (readings.target == readings.target[i]) & readings.unloaded
            d[k, same] -= 1.0 / same.sum()
    return np.kron(d, np.eye(readings.m))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("kind", ["alone", "targets", "scatter"])
def test_whitened_noise_is_white(mode, m, kind):
    rng = np.random.default_rng([m, len(kind)])
    readings = random_readings(rng, m, decades=1.0)
    while not has_unloaded(readings).all() or readings.unloaded.all():
        readings = random_readings(rng, m, decades=1.0)
    if kind == "targets":
        # Each reading is of two targets, in one arrival.
        target = np.tile([0, 1], len(readings))
        readings = readings[np.repeat(np.arange(len(readings)), 2)]
        f = 0.3 * rng.standard_normal((len(readings), m, 2))
        readings = replace(
            readings,
            states=replace(readings.states, target=target),
            target_names=("a", "b"),
            common=f,
            covariance=readings.covariance + f @ np.swapaxes(f, 1, 2),
        )
    elif kind == "scatter":
        f = 0.3 * rng.standard_normal((len(readings), m, 2))
        readings = replace(
            readings,
            stated=readings.covariance,
            covariance=readings.covariance + f @ np.swapaxes(f, 1, 2),
        )
    serial = readings.with_serial(NOISE)
    w = whitening(serial, mode)
    d = difference(serial, mode, w.reading.tolist())
    v = d @ covariance_of(serial) @ d.T
    size = len(w) * m
    white = w.whiten(np.eye(size).reshape(len(w), m, size))
    np.testing.assert_allclose(white @ v @ white.T, np.eye(size), atol=1e-6)
    # The rows of a measurement are its own: poses can be left out by them.
    assert np.all(np.triu(white, 1) == 0)
    # The covariance of each by itself is as without correlation: what is stated holds.
    alone = d @ block_diag(*serial.covariance) @ d.T
    blocks = np.einsum("kikj->kij", alone.reshape(len(w), m, len(w), m))
    np.testing.assert_allclose(w.covariance, blocks, rtol=1e-9, atol=1e-12)


def test_units_do_not_matter():
    rng = np.random.default_rng(4)
    readings = random_readings(rng, 6).with_serial(NOISE)
    units = 10 ** rng.uniform(-6, 6, 6)
    other = replace(readings, covariance=units[:, None] * readings.covariance * units)
    y = rng.standard_normal((len(readings), 6))
    a, b = whitening(readings, "absolute"), whitening(other, "absolute")
    np.testing.assert_allclose(
        b.whiten((y * units)[b.reading]), a.whiten(y[a.reading]), rtol=1e-5, atol=1e-7
    )


def test_a_long_campaign_is_cut_into_runs(monkeypatch):
    monkeypatch.setattr(scaling_module, "RUN", 10)
    rng = np.random.default_rng(5)
    count = 47
    zero = np.zeros(count, dtype=np.int64)
    readings = make_readings(np.arange(count), zero, zero, np.zeros((count, 3)), spd(rng, count, 3))
    w = whitening(readings[::-1].with_serial(NOISE), "absolute")
    sizes = [b.loaded.size for b in w.buckets]
    assert sum(sizes) == count
    assert max(sizes) <= 10
    assert sorted(w.reading.tolist()) == list(range(count))
    for b in w.buckets:
        assert np.all(np.diff(b.loaded[0]) == 1)


def test_what_is_kept_is_read_again():
    for noise in (NOISE, replace(NOISE, proved=False, instead=("creep",), wider=(0.5, 2.0))):
        assert SerialNoise.from_json(noise.to_json()) == noise
