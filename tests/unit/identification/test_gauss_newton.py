"""Gauss-Newton reaches the minimum in few steps, as scipy and LAPACK find it."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg as sl

from hilcal.identification.carried.carried_prior import scales_of
from hilcal.identification.fit import fit
from hilcal.identification.gauss_newton import (
    TALL,
    NewtonPoint,
    linear_problem,
    regularise,
)
from hilcal.identification.residual import residual
from hilcal.model.model import Model
from hilcal.readings.readings import States
from hilcal.readings.whitening import whitening
from tests.support.campaigns import cell_of
from tests.support.effect_cases import make
from tests.support.readings_cases import readings_at
from tests.support.rows import first

SIGMA = 2e-5
POSES, LOADS = 30, 6
STEPS = 8


def case(seed, names, soft=5.0):
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
    pose, load = np.divmod(np.arange(len(value)), LOADS)
    return model, readings_at(q, value, wrench=states.wrench, pose=pose, load=load, std=SIGMA)


def slope(found):
    """Difference quotient of ½ ‖r‖² by each z, where a unit of z moves all data by 1 σ."""
    w = whitening(found.readings, "absolute")
    steps = found.solution.equations.basis.transform

    def cost(theta):
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
def test_a_misfit_does_not_hinder(seed, more):
    model, readings = case(seed, ("joint_compliance", "encoder_offset", *more))
    found = fit(model, readings, "absolute")
    assert found.solution.converged
    assert found.solution.iterations <= STEPS
    assert found.variance_factor > 3
    np.testing.assert_allclose(slope(found), 0.0, atol=2e-3)


@pytest.mark.parametrize("seed", range(3))
def test_sideways_pulls_separate_the_first_joints_offset_from_the_registration(seed):
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


def nearly_dependent(condition, columns):
    """Rows (2 TALL, P) of that condition number, whose columns have units over eight decades."""
    rng = np.random.default_rng(5)
    q = np.linalg.qr(rng.standard_normal((2 * TALL, columns)))[0]
    turn = np.linalg.qr(rng.standard_normal((columns, columns)))[0]
    return np.asarray(q * np.geomspace(1e8, 1e8 / condition, columns) @ turn)


def solved(a, white, scale):
    """Step of Gauss-Newton from zero, all parameters without a prior."""
    columns = a.shape[1]
    start, prior = np.zeros(columns), np.full(columns, np.inf)
    point = NewtonPoint(start, start, float(white @ white), white.size)
    linear = linear_problem(point, prior, a, white, len(a), 1.0, whitened=True)
    assert len(linear.a) == columns + 1
    assert linear.rows is a
    by = regularise(linear, scale, prior, np.full(columns, -1), choose=False)
    return np.asarray(by.basis.transform @ linear.equations(by.basis).solve(by.beta))


@pytest.mark.parametrize("condition", [1e2, 1e5, 1e8])
def test_errors_are_those_of_lapacks_qr(condition):
    """At 1e8 the normal equations AᵀA have no correct digit."""
    rng = np.random.default_rng(6)
    columns = 8
    a, units = nearly_dependent(condition, columns), np.geomspace(1e-4, 1e4, columns)
    truth = rng.standard_normal(columns)
    noise = rng.standard_normal(len(a))
    exact = np.linalg.lstsq(a, noise, rcond=None)[0]
    white = a @ truth + 1e-6 * (noise - a @ exact)
    error = np.abs(units * solved(a * units, white, 1 / units) - truth).max()
    lapack = np.abs(sl.lstsq(a, white, lapack_driver="gelsy")[0] - truth).max()
    assert error < 10 * max(lapack, 1e-14 * condition)
    if condition == 1e8:
        squared = np.abs(np.linalg.solve(a.T @ a, a.T @ white) - truth).max()
        assert squared > 1e3 * error
