"""What residuals have beyond the stated noise is found in its size, and only where it is."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.identification.predictive import Excess, excess
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import whitening
from hilcal.types import Floats

COUNT, M = 400, 6
NOISE = np.array([5e-6, 20e-6, 20e-6, 9e-5, 9e-5, 9e-5])


def readings(rng: np.random.Generator) -> Readings:
    axes = np.linalg.qr(rng.normal(size=(COUNT, 3, 3)))[0]
    turn = np.zeros((COUNT, M, M))
    turn[:, :3, :3], turn[:, 3:, 3:] = axes, np.eye(3)
    covariance = turn * NOISE**2 @ np.swapaxes(turn, 1, 2)
    each = np.arange(COUNT)
    return Readings(
        states=States(q=rng.normal(size=(COUNT, 6)), wrench=np.zeros((COUNT, 6))),
        pose=each,
        load=np.zeros(COUNT, dtype=int),
        cycle=np.zeros(COUNT, dtype=int),
        value=np.zeros((COUNT, M)),
        covariance=covariance,
        load_names=("none",),
        pose_names=tuple(f"p{k}" for k in each),
    )


def drawn(extra_m: float, factor: float, parameters: int = 0) -> tuple[Excess, Readings]:
    """Draw residuals, with some directions fitted away, and return what is found of them."""
    rng = np.random.default_rng(3)
    r = readings(rng)
    w = whitening(r, "absolute", "gc")
    true = Excess(extra_m**2, factor)
    raw = np.einsum(
        "dij,dj->di",
        np.linalg.cholesky(true.widened(r.covariance)),
        rng.normal(size=(COUNT, M)),
    )
    wide = whitening(true.of_readings(r, "absolute"), "absolute", "gc")
    jacobian = rng.normal(size=(COUNT, M, parameters)) * NOISE[:, None]
    rows = wide.whiten(jacobian) if parameters else np.zeros((COUNT * M, 1))
    root: Floats = np.zeros((1, 1))
    if parameters:
        root = np.linalg.cholesky(np.linalg.inv(rows.T @ rows))
        step = np.linalg.lstsq(rows, wide.whiten(raw).reshape(-1), rcond=None)[0]
        raw = raw - jacobian @ step
    return excess(raw, w, wide, rows, root), r


def test_stated_noise_has_no_excess() -> None:
    assert drawn(0.0, 1.0)[0].none


@pytest.mark.parametrize("parameters", [0, 300])
def test_both_are_found_in_their_size_beside_fitted_parameters(parameters: int) -> None:
    found, _ = drawn(30e-6, 2.0, parameters)
    # 1200 elements: good to 1/sqrt(600).
    assert np.sqrt(found.position) == pytest.approx(30e-6, rel=0.08)
    assert found.attitude == pytest.approx(2.0, rel=0.15)


def test_one_does_not_make_the_other() -> None:
    found, _ = drawn(30e-6, 1.0)
    assert found.position > 0
    assert found.attitude == 1.0
    found, _ = drawn(0.0, 3.0)
    assert found.position == 0.0
    assert found.attitude > 2.5


def test_a_deflection_has_it_once() -> None:
    _, r = drawn(0.0, 1.0)
    more = Excess(1e-10, 4.0)
    wide = more.of_readings(r, "deflection")
    np.testing.assert_allclose(
        np.trace(wide.covariance[:, :3, :3] - r.covariance[:, :3, :3], axis1=1, axis2=2), 1.5e-10
    )
    np.testing.assert_allclose(wide.covariance[:, 3:, 3:], 4 * r.covariance[:, 3:, 3:])
    assert replace(more, position=1.01e-10).near(more)
    assert not Excess().near(more)
