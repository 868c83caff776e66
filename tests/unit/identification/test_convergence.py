"""Gauss-Newton reaches the true minimum in few steps, also with soft joints and a misfit."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.identification.fit import Fit, fit
from hilcal.identification.gauss_newton import Acceleration
from hilcal.identification.priors import scales_of
from hilcal.identification.residual import residual
from hilcal.model.model import Model
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import whitening
from tests.support.campaigns import cell_of
from tests.support.effect_cases import make
from tests.support.rows import first

SIGMA = 2e-5
POSES, LOADS = 30, 6
STEPS = 8


def case(seed: int, names: tuple[str, ...], soft: float = 5.0) -> tuple[Model, Readings]:
    """Absolute readings of a soft UR10e, off by 2 σ in a way of its own at each pose."""
    rng = np.random.default_rng(seed)
    cell = cell_of(registration_known=True)
    q = np.repeat(rng.uniform(-2.5, 2.5, (POSES, 6)), LOADS, axis=0)
    wrench = rng.normal(size=(LOADS, 6)) * [60, 60, 60, 5, 5, 5]
    wrench[0] = 0.0
    states = States(q=q, wrench=np.tile(wrench, (POSES, 1)))
    model = Model(cell, tuple(make(name, cell, states) for name in names))
    theta = scales_of(model) * rng.normal(size=model.size)
    for e, at in zip(model.effects, model.slices(), strict=True):
        if e.elastic:
            theta[at] = soft * np.abs(theta[at])
    value = model.predict(states, theta).observation.position
    value = value + 2 * SIGMA * np.repeat(rng.normal(size=(POSES, 3)), LOADS, axis=0)
    value = value + SIGMA * rng.normal(size=value.shape)
    count = len(value)
    return model, Readings(
        states=states,
        pose=np.repeat(np.arange(POSES), LOADS),
        load=np.tile(np.arange(LOADS), POSES),
        cycle=np.zeros(count, dtype=np.int64),
        value=value,
        covariance=np.tile(SIGMA**2 * np.eye(3), (count, 1, 1)),
        load_names=("none", *(f"pull {k}" for k in range(1, LOADS))),
        pose_names=tuple(str(k) for k in range(POSES)),
    )


def slope(found: Fit) -> np.ndarray:
    """Difference quotient of ½ ‖r‖² by each z, where a unit of z moves all data by 1 σ."""
    w = whitening(found.readings, "absolute")
    steps = found.solution.equations.basis.transform

    def cost(theta: np.ndarray) -> float:
        p = found.model.predict(found.readings.states, theta)
        return 0.5 * float(np.sum(w.whiten(residual(found.readings, p, w)) ** 2))

    h = 0.05
    return np.array(
        [(cost(found.theta + h * z) - cost(found.theta - h * z)) / (2 * h) for z in steps.T]
    )


@pytest.mark.parametrize("seed", first(1, range(3)))
@pytest.mark.parametrize(
    "more", [(), ("joint_tilt_compliance",), ("link_compliance", "target_offset")]
)
def test_a_misfit_does_not_hinder(seed: int, more: tuple[str, ...]) -> None:
    model, readings = case(seed, ("joint_compliance", "encoder_offset", *more))
    found = fit(model, readings, "absolute")
    assert found.solution.converged
    assert found.solution.iterations <= STEPS
    assert found.variance_factor > 3
    np.testing.assert_allclose(slope(found), 0.0, atol=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_sideways_pulls_separate_the_first_joints_offset_from_the_registration(seed: int) -> None:
    """Turned with the arm or not, a sideways pull deflects otherwise: both are determined.

    Under weights alone, along the axis of the first joint, they are one gauge freedom.
    """
    model, readings = case(seed, ("base_frame", "joint_compliance", "encoder_offset"))
    found = fit(model, readings, "absolute")
    names = [f"{e.name}.{p.name}" for e in model.effects for p in e.parameters]
    pair = [names.index("base_frame.rz"), names.index("encoder_offset.j1")]
    assert found.solution.converged
    assert found.solution.iterations <= STEPS
    assert found.uncertainty.identifiable[pair].all()
    wrench = readings.states.wrench * [0, 0, 1, 0, 0, 0]
    states = replace(readings.states, wrench=wrench)
    shift = (
        model.predict(states, found.theta).observation.position
        - model.predict(readings.states, found.theta).observation.position
    )
    down = fit(model, replace(readings, states=states, value=readings.value + shift), "absolute")
    assert not down.uncertainty.identifiable[pair].any()


def test_steps_that_shrink_by_constant_factors_lead_to_their_limit() -> None:
    """Anderson's combination of steps x → x* + D (x − x*), D diagonal with two factors."""
    rng = np.random.default_rng(0)
    limit, factor = rng.normal(size=8), np.where(np.arange(8) < 4, -0.55, 0.6)
    path, x = Acceleration(), np.zeros(8)
    for _ in range(4):
        aim = limit + factor * (x - limit)
        shortcut = path.accelerated(aim, aim - x)
        x = aim if shortcut is None else shortcut
    np.testing.assert_allclose(x, limit, rtol=0, atol=1e-10)
