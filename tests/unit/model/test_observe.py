"""What the sensor reads, against matrix products, and its motions against differences."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.effects.protocol import Columns
from hilcal.model.observe import Motion, Observation, motion, observe
from hilcal.model.reading_columns import ReadingColumns
from hilcal.robot.chain import evaluate
from hilcal.robot.deviation import Deviation
from hilcal.robot.statics import Load
from hilcal.types import Floats
from tests.support.arm_cases import arm_of, cell_of, displacement, slope, slots_of, twisted

COUNT = 5
NO_LOAD = Load(np.zeros((COUNT, 6)), np.zeros(3), 0.0, np.zeros(3), np.zeros(3))
CELL = cell_of(arm_of("ur10e"))
RNG = np.random.default_rng(8)
Q = RNG.uniform(-np.pi, np.pi, (COUNT, 6))
FULL = Deviation(
    dq=0.05 * RNG.normal(size=(COUNT, 6)),
    twist=0.05 * RNG.normal(size=(COUNT, 7, 6)),
    base=0.3 * RNG.normal(size=(COUNT, 6)),
    station=0.3 * RNG.normal(size=(COUNT, 6)),
    target=0.3 * RNG.normal(size=(COUNT, 6)),
    scale=0.01 * RNG.normal(size=COUNT),
)
NONE = Deviation()
ONES = [Deviation(**{name: getattr(FULL, name)}) for name in ("base", "station", "target", "scale")]
DEVIATIONS = [NONE, *ONES, FULL]
SHAPES = {
    "dq": (COUNT, 6),
    "twist": (COUNT, 7, 6),
    "base": (COUNT, 6),
    "station": (COUNT, 6),
    "target": (COUNT, 6),
    "scale": (COUNT,),
}


def read(d: Deviation) -> Observation:
    return observe(CELL, evaluate(CELL.arm, Q, d), d)


def motion_of(d: Deviation, m: int = 6) -> Motion:
    chain = evaluate(CELL.arm, Q, d)
    return motion(CELL, observe(CELL, chain, d), chain, d, m)


def along(d: Deviation, field: str, change: Floats, m: int = 6) -> Floats:
    """Motion (N, m) of the reading per change along one field, by differences."""
    r0 = read(d).rotation

    def moved(t: float) -> Floats:
        o = read(d + Deviation(**{field: t * change}))
        turn = o.rotation @ np.swapaxes(r0, 1, 2)
        spin = [turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]]
        return np.column_stack([o.position, *spin])[:, :m]

    return slope(moved, 1e-3)


def assert_close_relative(found: Floats, expected: Floats) -> None:
    """Within 1e-7 of the largest motion."""
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= 1e-7 * np.abs(expected).max()


@pytest.mark.parametrize("d", DEVIATIONS)
def test_reading_is_the_product_of_its_displacements(d: Deviation) -> None:
    d = d + Deviation(dq=FULL.dq)
    o = read(d)
    given = {k: np.zeros((COUNT, 6)) if getattr(d, k) is None else getattr(d, k) for k in SHAPES}
    assert d.dq is not None
    for i in range(COUNT):
        target = np.eye(4)
        target[:3, 3] = CELL.target[:3, 3] + given["target"][i, :3]
        turn = displacement([0, 0, 0, *given["target"][i, 3:]])[:3, :3]
        target[:3, :3] = turn @ CELL.target[:3, :3]
        arm = CELL.arm if d.twist is None else twisted(CELL.arm, d.twist[i])
        flange = slots_of(arm, Q[i] + d.dq[i])[-1]
        outer = displacement(given["station"][i]) @ CELL.registration
        outer = outer @ displacement(given["base"][i])
        pose = outer @ flange @ target
        factor = 1.0 if d.scale is None else 1 + d.scale[i]
        np.testing.assert_allclose(o.position[i], factor * pose[:3, 3], rtol=0, atol=1e-12)
        np.testing.assert_allclose(o.rotation[i], pose[:3, :3], rtol=0, atol=1e-12)
        at = (flange @ target)[:3, 3]
        np.testing.assert_allclose(o.base_position[i], at, rtol=0, atol=1e-12)
        np.testing.assert_allclose(o.axes[i], outer[:3, :3], rtol=0, atol=1e-12)


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("d", DEVIATIONS)
@pytest.mark.parametrize("field", ["base", "station", "target"])
def test_motion_by_the_sensor_side_is_a_slope(field: str, d: Deviation, m: int) -> None:
    found = getattr(motion_of(d, m), f"by_{field}")()
    if field == "target" and d.target is None:
        d = replace(d, target=np.zeros((COUNT, 6)))
    for axis in range(6):
        change = np.zeros((COUNT, 6))
        change[:, axis] = 1.0
        expected = along(d, field, change, m)
        scale = np.abs(found).max()
        assert np.abs(found[:, :, axis] - expected).max() <= 1e-7 * scale


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("d", DEVIATIONS)
def test_motion_by_the_arm_is_a_slope(d: Deviation, m: int) -> None:
    moves = motion_of(d, m)
    for joint in range(6):
        change = np.zeros(SHAPES["dq"])
        change[:, joint] = 1.0
        assert_close_relative(moves.dq[:, :, joint], along(d, "dq", change, m))
    for slot in range(7):
        by_slot = moves.by_slot(slot)
        for axis in range(6):
            change = np.zeros(SHAPES["twist"])
            change[:, slot, axis] = 1.0
            found, expected = by_slot[:, :, axis], along(d, "twist", change, m)
            assert np.abs(found - expected).max() <= 1e-7 * np.abs(by_slot).max()


@pytest.mark.parametrize("d", DEVIATIONS)
@pytest.mark.parametrize("field", SHAPES)
@pytest.mark.parametrize("constant", [False, True])
def test_motion_by_columns_is_a_slope(field: str, d: Deviation, constant: bool) -> None:
    rng = np.random.default_rng(9)
    size = 4
    count = 1 if constant else COUNT
    per_element = field in ("dq", "twist")
    element = np.array([0, 5, 2, 5]) if per_element else np.zeros(size, dtype=np.int64)
    tail = () if field in ("dq", "scale") else (6,)
    values = rng.normal(size=(count, size, *tail))
    block = Columns(field, np.arange(size), element, values)  # type: ignore[arg-type]
    found = np.empty((COUNT, 6, size))
    columns = ReadingColumns(motion_of(d), [], NO_LOAD)
    columns.add(block, np.arange(size))
    columns.write(found)
    for p in range(size):
        change = np.zeros(SHAPES[field])
        if per_element:
            change[:, element[p]] = values[:, p]
        else:
            change[...] = values[:, p]
        assert_close_relative(found[:, :, p], along(d, field, change))
