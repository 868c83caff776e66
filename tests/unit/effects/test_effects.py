"""Every effect's derivatives, against differences of its law; and an effect of a user's own."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.effects.protocol import Effect
from hilcal.robot.statics import Load, slot_wrenches
from tests.support.arm_cases import slope
from tests.support.effect_cases import (
    CELLS,
    ELASTIC,
    FIELDS,
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


@pytest.mark.parametrize("arm", CELLS)
@pytest.mark.parametrize(("name", "options"), some(USUAL + VARIANTS, NAMES))
def test_columns_are_the_derivative_of_the_deviation(name, options, arm):
    cell = CELLS[arm]
    s = situation(cell)
    effect = make(name, cell, s.states, options)
    theta = random_theta((effect,), np.random.default_rng(0))
    derived = {field: 0.0 for field in FIELDS}
    size = len(effect.parameters)
    count, n = s.angle.shape
    for c in effect.columns(s):
        values = np.broadcast_to(c.values, (count, *c.values.shape[1:]))
        for k, (parameter, element) in enumerate(zip(c.parameter, c.element, strict=True)):
            if c.field in ("dq", "twist"):
                shape = (count, n) if c.field == "dq" else (count, n + 1, 6)
                block = np.zeros((size, *shape))
                block[parameter, :, element] += values[:, k]
            else:
                block = np.zeros((size, *values[:, k].shape))
                block[parameter] += values[:, k]
            derived[c.field] = derived[c.field] + block
    for p in range(size):
        scale = effect.parameters[p].scale

        def moved(h, p=p, scale=scale):
            return effect.deviation(theta + h * scale * np.eye(size)[p], s)

        for field in FIELDS:
            if getattr(moved(0.0), field) is None:
                assert np.ndim(derived[field]) == 0, field
                continue
            numeric = slope(lambda h, f=field, g=moved: getattr(g(h), f), 1.0)
            # The deviation is linear, so only rounding of it is left.
            size_of_it = np.abs(getattr(moved(0.0), field)).max() + np.abs(numeric).max()
            np.testing.assert_allclose(
                derived[field][p] * scale, numeric, rtol=0, atol=1e-14 * size_of_it + 1e-30
            )


@pytest.mark.parametrize("arm", CELLS)
@pytest.mark.parametrize(("name", "options"), some(USUAL + VARIANTS, ELASTIC))
def test_response_is_the_derivative_by_the_slot_wrenches(name, options, arm):
    cell = CELLS[arm]
    s = situation(cell)
    effect = make(name, cell, s.states, options)
    rng = np.random.default_rng(3)
    theta = random_theta((effect,), rng)
    change = rng.normal(size=(len(s.states), 4, *s.wrench.shape[1:]))
    response = effect.response(theta, s, change)
    for p in range(4):

        def moved(h, p=p):
            return effect.deviation(theta, replace(s, wrench=s.wrench + h * change[:, p]))

        for field in ("dq", "twist"):
            derived = getattr(response, field)
            if getattr(moved(0.0), field) is None:
                assert derived is None
                continue
            # Laws are polynomials of degree 3, so a difference of fourth order is exact; all but
            # that of the backlash, which bends within its crossing of half a newton metre.
            step = 1e-3 if name == "backlash" else 1.0
            numeric = slope(lambda h, f=field, g=moved: getattr(g(h), f), step)
            size = np.abs(getattr(moved(0.0), field)).max()
            np.testing.assert_allclose(derived[:, p], numeric, rtol=0, atol=1e-13 * size / step)
            assert np.abs(derived[:, p]).max() > 1e-9 * size


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
