"""What the sensor reads, against matrix products."""

import numpy as np
import pytest

from hilcal.model.observe import observe
from hilcal.robot.chain import Deviation, evaluate
from tests.support.arm_cases import arm_of, cell_of, displacement, slots_of, twisted

COUNT = 5
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
SENSOR = ("base", "station", "target")
DEVIATIONS = [NONE, *ONES, FULL]


@pytest.mark.parametrize("d", DEVIATIONS)
def test_reading_is_the_product_of_its_displacements(d):
    d = d + Deviation(dq=FULL.dq)
    o = observe(CELL, evaluate(CELL.arm, Q, d), d)
    given = {k: np.zeros((COUNT, 6)) if getattr(d, k) is None else getattr(d, k) for k in SENSOR}
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
