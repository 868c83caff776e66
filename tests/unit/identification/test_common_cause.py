"""A law of one site is a misfit, and none of its readings a gross error."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from hilcal.identification.baseline import baseline
from hilcal.identification.data_snooping import CHANCE, along_one_site, site_columns
from hilcal.identification.fit import fit
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.types import Floats
from studies.gross_errors import spoil
from tests.support.campaigns import campaign

APART = np.arange(400)


def directions(rng: np.random.Generator, *shape: int) -> Floats:
    x = rng.normal(size=shape)
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def drawn(rng: np.random.Generator, count: int, size: float) -> tuple[Floats, Floats]:
    """Shifts of a size in random directions, and those of ten sites."""
    return size * directions(rng, count, 3), directions(rng, count, 3, 10)


def test_random_errors_are_along_no_site() -> None:
    rng = np.random.default_rng(0)
    tried = 400
    wrong = sum(
        bool(along_one_site(*drawn(rng, count, size), APART[:count]).any())
        for count in (1, 5, 40, 80)
        for size in np.geomspace(6, 600, tried // 4)
    )
    assert binom.sf(wrong - 1, tried, CHANCE) > 1e-3


@pytest.mark.parametrize(("count", "size"), [(5, 15.0), (12, 7.0), (3, 100.0)])
def test_a_law_is_told_from_random_errors_beside_it(count: int, size: float) -> None:
    rng = np.random.default_rng(1)
    shift, columns = drawn(rng, count + 6, size)
    law = np.arange(count)
    shift[law] = size * columns[law, :, 3] * rng.uniform(1, 2, (count, 1))
    shift += rng.normal(size=shift.shape)
    found = along_one_site(shift, columns, APART[: len(shift)])
    assert found[law].mean() >= 0.75
    assert found[count:].sum() <= 1


@pytest.mark.parametrize("sizes", [[100.0] * 6, [100, 50, -100, 60, 30, -80]])
def test_one_pose_is_no_law(sizes: list[float]) -> None:
    """One wrong reference there, or errors along an axis of the sensor that is a site's as well."""
    rng = np.random.default_rng(2)
    columns = np.repeat(directions(rng, 1, 3, 10), 6, axis=0)
    shift = np.array(sizes)[:, None] * columns[:, :, 3] + rng.normal(size=(6, 3))
    assert along_one_site(shift, columns, np.arange(6)).all()
    assert not along_one_site(shift, columns, np.zeros(6, dtype=int)).any()


def one_sided(model: Model, readings: Readings, size: float, joint: int) -> Readings:
    """Return readings of an arm with one joint that yields to torques of one sign alone."""
    theta = np.zeros(model.size)
    p = model.predict(readings.states, theta)
    turn = site_columns(model, theta, p, readings)[:, :, 3 * joint + 2]
    torque = p.situation.torque[:, joint]
    moved = turn * np.maximum(torque - np.median(torque), 0.0)[:, None]
    moved *= size / np.sqrt(np.mean(moved**2))
    return replace(readings, value=readings.value + moved)


@pytest.mark.parametrize("joint", [1, 2, 3])
def test_a_law_of_one_joint_is_not_set_aside(joint: int) -> None:
    c = campaign(mode="deflection", plan_seed=0, poses=12)
    model = baseline(c.cell, c.readings, "deflection")
    found = fit(model, one_sided(model, c.readings, 1e-3, joint), "deflection")
    assert not found.outlier.any()


def test_gross_errors_beside_such_a_law_are_found() -> None:
    c = campaign(mode="deflection", plan_seed=0, poses=12)
    model = baseline(c.cell, c.readings, "deflection")
    readings, wrong = spoil(
        one_sided(model, c.readings, 60e-6, 1), 0.2, 5e-3, np.random.default_rng(0)
    )
    found = fit(model, readings, "deflection")
    assert found.outlier[wrong].mean() >= 0.95
    r = readings
    lost = np.isin(r.pose, r.pose[wrong[r.unloaded[wrong]]])  # with their unloaded reading
    assert not found.outlier[~lost & ~np.isin(np.arange(len(r)), wrong)].any()
