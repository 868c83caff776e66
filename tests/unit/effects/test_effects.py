"""Derivatives of the slot wrenches by effects of the load, against differences of their law."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.effects.protocol import Effect
from hilcal.robot.statics import Load, slot_wrenches
from tests.support.arm_cases import slope
from tests.support.effect_cases import (
    CELLS,
    NAMES,
    VARIANTS,
    effect_class,
    make,
    options_of,
    random_theta,
    situation,
)

# --- derivatives ----------------------------------------------------------------------------


USUAL = tuple((name, options_of(name, 6)) for name in NAMES)


def some(cases, chosen):
    """The cases of some effects, as pytest takes them."""
    return [pytest.param(n, o, id=f"{n}{o or ''}") for n, o in cases if n in chosen]


CHANGERS = tuple(n for n in NAMES if effect_class(n).wrench_columns is not Effect.wrench_columns)


@pytest.mark.parametrize("arm", CELLS)
@pytest.mark.parametrize(("name", "options"), some(USUAL + VARIANTS, CHANGERS))
def test_wrench_columns_are_the_derivative_of_the_slot_wrenches(name, options, arm):
    """At a fixed configuration, together with another change of the load."""
    cell = CELLS[arm]
    s = situation(cell)
    effect = make(name, cell, s.states, options)
    theta = random_theta((effect,), np.random.default_rng(5))

    def load(theta):
        told, change = effect.load_change(theta), effect.wrench_change(theta, s)
        point = cell.load_point + np.array([0.02, -0.01, 0.03])
        point = point if told is None or told.point is None else point + told.point
        moments = None if told is None else told.first_moment
        wrench = s.states.wrench if change is None else s.states.wrench + change
        return Load(wrench, point, cell.tool_mass, cell.tool_com, cell.gravity, moments)

    derived = effect.wrench_columns(theta, replace(s, load=load(theta)))
    for p, parameter in enumerate(effect.parameters):

        def wrench(h, p=p, size=parameter.scale):
            moved = theta + h * size * np.eye(len(theta))[p]
            return slot_wrenches(cell.arm, s.chain, load(moved))

        numeric = slope(wrench, 0.1)
        size = np.abs(wrench(0.0)).max()
        # Rounding, and what the difference leaves out where a law bends, h⁴/30 of the fifth
        # derivative: of 1/(1 + g) that is 120 times the fifth power of a hundredth.
        np.testing.assert_allclose(
            derived[:, p] * parameter.scale, numeric, rtol=0, atol=1e-13 * size
        )


# --- a user's own ---------------------------------------------------------------------------
