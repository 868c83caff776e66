"""Several targets per pose: prediction, derivative, registration."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.diagnosis.misfit_breakdown import misfit_breakdown
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import fit
from hilcal.identification.full_prediction import gross_errors
from hilcal.identification.linearisation import linearise
from hilcal.identification.registration import register
from hilcal.readings.whitening import MODES, Mode
from hilcal.robot.se3 import rotation_vector
from tests.support.reflector_cases import OFFSETS, reflectors

KNOWN = [(True, True, True), (False, True, False), (False, False, False)]


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("known", KNOWN)
def test_base_and_targets_are_registered_together(known: tuple[bool, ...], m: int) -> None:
    c = reflectors(known=known, joint_std=0.0, m=m)
    cell = register(c.cell, c.readings).cell
    assert c.world.offsets is not None
    true = OFFSETS + c.world.offsets
    off = cell.all_targets[:, :3, 3] - true
    # The nominal arm is rigid: its loads move the targets by up to 1 mm.
    assert np.abs(off).max() < 5e-4
    assert np.all(off[list(known)] == 0.0)
    turn = cell.registration[:3, :3] @ c.world.registration[:3, :3].T
    assert np.linalg.norm(rotation_vector(turn)) < 1e-3


@pytest.mark.parametrize("m", [3, 6])
def test_derivatives_agree_with_differences(m: int) -> None:
    c = reflectors(known=(False, True, False), m=m, poses=4)
    names = ("joint_compliance", "encoder_offset")
    model = with_effects(c.cell, c.readings, "absolute", names)
    assert [p.name for p in model.effects[1].parameters][::m] == ["R1.x", "R3.x"]
    rng = np.random.default_rng(1)
    scale = np.array([p.scale for e in model.effects for p in e.parameters])
    theta = 0.3 * scale * rng.standard_normal(model.size)
    states = c.readings.states
    exact = model.jacobian(model.predict(states, theta), theta, 3)
    for k in range(model.size):
        step = np.zeros(model.size)
        step[k] = 1e-2 * scale[k]
        ahead, back = (model.predict(states, theta + s).observation for s in (step, -step))
        quotient = (ahead.position - back.position) / (2 * step[k])
        np.testing.assert_allclose(exact[:, :, k], quotient, atol=2e-6 * np.abs(quotient).max())


def test_one_offset_moves_one_target() -> None:
    c = reflectors(known=(False, True, False), poses=4)
    model = with_effects(c.cell, c.readings, "absolute", ())
    theta = np.zeros(model.size)
    before = model.predict(c.readings.states, theta).observation.position
    theta[-3:] = 1e-3  # target_offset.R3
    moved = model.predict(c.readings.states, theta).observation.position - before
    distance = np.linalg.norm(moved, axis=1)
    np.testing.assert_allclose(distance, np.where(c.readings.target == 2, np.sqrt(3) * 1e-3, 0.0))


@pytest.mark.parametrize(("mode", "known"), [(MODES[0], KNOWN[0]), (MODES[1], KNOWN[-1])])
def test_swapped_names_and_a_displaced_reading_are_named(
    mode: Mode, known: tuple[bool, ...]
) -> None:
    c = reflectors("base_compliance", known=known, seed=1, joint_std=1e-5, poses=14, strength=4.0)
    r = c.readings
    first, second, third = np.flatnonzero((r.pose == 4) & (r.load == 2))
    lone = np.flatnonzero((r.pose == 7) & (r.load == 1))[2]
    number, value = r.target.copy(), r.value.copy()
    number[[first, second]] = number[[second, first]]
    value[lone] += [1e-3, 0.0, 0.0]
    wrong = replace(r, states=replace(r.states, target=number), value=value)
    named = {g.row: g.reason for g in gross_errors(fit(baseline(c.cell, wrong, mode), wrong, mode))}
    assert set(named) == {first, second, lone}
    assert named[first] == "target R2: lies where R1 is: were they swapped?"
    assert named[second] == "target R1: lies where R2 is: were they swapped?"
    assert named[lone].startswith("target R3: ")
    assert third not in named


def test_the_misfit_of_a_displaced_reflector_follows_the_target() -> None:
    c = reflectors(seed=2, joint_std=1e-5)
    moved = c.cell.all_targets.copy()
    moved[1, :3, 3] += [2e-4, -1e-4, 1e-4]
    cell = c.cell.with_targets(moved)
    found = fit(baseline(cell, c.readings, "absolute"), c.readings, "absolute")
    shares = misfit_breakdown(linearise(found))
    assert shares[0].variable == "target"
    assert shares[0].share > 0.9
    model = with_effects(cell, c.readings, "absolute", ["joint_compliance", "target_offset"])
    offset = model.slices()[model.names.index("target_offset")]
    theta = fit(model, c.readings, "absolute").theta[offset].reshape(3, 3)
    # A common displacement of all targets is hardly told from one of the base; a single one is.
    np.testing.assert_allclose(
        theta[1] - theta[[0, 2]].mean(axis=0), [-2e-4, 1e-4, -1e-4], atol=1.5e-5
    )
