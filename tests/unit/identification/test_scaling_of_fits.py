"""Units, task-variable scaling and parameter scaling of fits."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.cell import Cell
from hilcal.effects.joint_compliance import JointCompliance
from hilcal.effects.protocol import Effect
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.model.model import Model
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import SCALINGS
from tests.support.campaigns import campaign
from tests.support.fit_cases import MODES

# --- units and scaling ----------------------------------------------------------------------


def in_other_lengths(cell: Cell, readings: Readings, k: float) -> tuple[Cell, Readings]:
    """The same cell and readings where lengths are in 1/k m; forces stay in N."""

    def moved(poses):
        out = poses.copy()
        out[..., :3, 3] *= k
        return out

    arm = cell.arm
    other = replace(
        cell,
        arm=replace(arm, links=moved(arm.links), coms=k * arm.coms, torque_max=k * arm.torque_max),
        target=moved(cell.target),
        load_point=k * cell.load_point,
        tool_com=k * cell.tool_com,
        registration=moved(cell.registration),
    )
    unit = np.repeat([k, 1.0], 3)[: readings.m]
    states = readings.states
    wrench = states.wrench * np.repeat([1.0, k], 3)
    return other, replace(
        readings,
        states=replace(states, wrench=wrench),
        value=readings.value * unit,
        covariance=readings.covariance * unit[:, None] * unit,
    )


POWER = {"m": 1, "m/s": 1, "rad": 0, "rad/s": 0, "rad/(N·m)": -1, "rad/(N·m)³": -3}


def effect_in_other_lengths(effect: Effect, cell: Cell, k: float) -> Effect:
    """The same effect of the other cell, its ordinary magnitudes in the other unit."""
    mine = effect.parameters

    class Other(type(effect)):
        @property
        def parameters(self):
            return tuple(replace(p, scale=p.scale * k ** POWER[p.unit]) for p in mine)

    options = dict(effect.options)
    if "prior_m" in options:
        options["prior_m"] *= k
    none = States(q=np.zeros((1, 6)), wrench=np.zeros((1, 6)))
    states = replace(none, time=np.zeros(1), approach=np.ones((1, 6)))
    return Other(cell, states, options)


@pytest.mark.parametrize("k", [1e3, 1 / 0.0254])
@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("mode", MODES)
def test_units_do_not_matter(mode, m, k):
    c = campaign("base_compliance", mode, plan_seed=0, target_known=False, m=m)
    cell, readings = in_other_lengths(c.cell, c.readings, k)
    names = ("joint_compliance", "joint_stiffening", "transmission_error")
    model = with_effects(c.cell, c.readings, mode, names)
    registered, _ = in_other_lengths(model.cell, readings, k)
    effects = tuple(effect_in_other_lengths(e, registered, k) for e in model.effects)
    unit = np.array([k ** POWER[p.unit] for e in model.effects for p in e.parameters])
    a = fit(model, c.readings, mode)
    b = fit(Model(registered, effects), readings, mode)
    assert cell.arm.reach == pytest.approx(k * c.cell.arm.reach)
    assert np.abs((b.theta / unit - a.theta) / unit_of_noise(a)).max() < 1e-5
    seen = a.uncertainty.identifiable
    np.testing.assert_array_equal(b.uncertainty.identifiable, seen)
    np.testing.assert_allclose((b.uncertainty.std / unit)[seen], a.uncertainty.std[seen], rtol=1e-5)
    assert b.rank == a.rank
    assert b.chi2 == pytest.approx(a.chi2, rel=1e-6)
    assert b.dof == pytest.approx(a.dof, rel=1e-6)
    assert b.holdout.rms_sigma == pytest.approx(a.holdout.rms_sigma, rel=1e-5)
    assert b.holdout.rms_m == pytest.approx(k * a.holdout.rms_m, rel=1e-5)


def unit_of_noise(found: Fit) -> np.ndarray:
    """Formal standard uncertainties; ordinary magnitudes where there are none."""
    scale = np.array([p.scale for e in found.model.effects for p in e.parameters])
    formal = found.uncertainty.formal
    return np.where(formal > 0, formal, scale)


def test_without_scaling_the_unit_of_length_decides_where_rotations_are_read():
    """What `none` is kept for: to show that it is wrong."""
    c = campaign(plan_seed=0, registration_known=True, m=6)
    cell, readings = in_other_lengths(c.cell, c.readings, 1e3)
    off = {}
    for scaling in SCALINGS:
        a = fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute", scaling)
        b = fit(baseline(cell, readings, "absolute"), readings, "absolute", scaling)
        off[scaling] = float(np.abs((1e3 * b.theta - a.theta) / a.uncertainty.std).max())
    assert off["gc"] < 1e-3
    assert off["gu"] < 1e-3
    assert off["none"] > 0.1


def test_scalings_agree_where_they_must_and_differ_where_errors_correlate():
    c = campaign(plan_seed=0, registration_known=True)
    n = len(c.readings)
    model = baseline(c.cell, c.readings, "absolute")
    spread = np.random.default_rng(0).uniform(1e-5, 5e-5, (n, 3))

    def all_three(covariance):
        given = replace(c.readings, covariance=covariance)
        return {s: fit(model, given, "absolute", s).theta for s in SCALINGS}

    equal = all_three(np.tile(4e-10 * np.eye(3), (n, 1, 1)))
    for other in ("none", "gu"):
        np.testing.assert_allclose(equal[other], equal["gc"], rtol=1e-8)
    diagonal = all_three(spread[:, :, None] ** 2 * np.eye(3))
    np.testing.assert_allclose(diagonal["gu"], diagonal["gc"], rtol=1e-8)
    assert np.all(diagonal["none"] != diagonal["gc"])
    correlated = all_three(c.readings.covariance)
    assert np.all(np.abs(correlated["gu"] / correlated["gc"] - 1) > 1e-6)


class Rescaled(JointCompliance):
    """The same effect with other ordinary magnitudes."""

    @property
    def parameters(self):
        factors = [30.0, 0.1, 3.0, 0.3, 10.0, 2.0]
        return tuple(
            replace(p, scale=f * p.scale) for p, f in zip(super().parameters, factors, strict=True)
        )


@pytest.mark.parametrize("mode", MODES)
def test_parameter_scaling_conditions_the_problem_but_not_the_answer(mode):
    c = campaign(plan_seed=0, registration_known=True)
    plain = fit(baseline(c.cell, c.readings, mode), c.readings, mode)
    model = Model(c.cell, (Rescaled(c.cell, c.readings.states),))
    scaled = fit(model, c.readings, mode)
    np.testing.assert_allclose(
        scaled.theta, plain.theta, rtol=0, atol=1e-4 * plain.uncertainty.std.min()
    )
    np.testing.assert_allclose(scaled.uncertainty.std, plain.uncertainty.std, rtol=1e-6)


def test_scaling_parameters_of_different_units_lowers_the_condition():
    c = campaign(plan_seed=0, target_known=False)
    found = fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute")
    basis = found.solution.equations.basis
    assert basis.condition_scaled < 0.1 * basis.condition_unscaled
    # Both are properties of the data, not of the magnitudes that someone thought ordinary.
    other = Model(found.model.cell, (found.model.effects[0], found.model.effects[1]))
    other = other + Rescaled(found.model.cell, c.readings.states)
    again = fit(other, c.readings, "absolute").solution.equations.basis
    assert again.condition_scaled == pytest.approx(basis.condition_scaled, rel=1e-3)
    assert again.condition_unscaled == pytest.approx(basis.condition_unscaled, rel=1e-3)
