"""What lies outside of a range, of angles also by whole turns."""

import numpy as np
import pytest

from hilcal.readings.ranges import Range

MEASURED = Range("joint 1 angle", "rad", np.radians(-176.0), np.radians(168.0))


@pytest.mark.parametrize(("degrees", "plain", "turning"), [
    (0.0, -168.0, -168.0),
    (184.8, 16.8, -0.8),  # -175.2 a turn before
    (-190.0, 14.0, 2.0),  # 170
    (172.0, 4.0, 4.0),
    (181.0, 13.0, 3.0),  # three degrees before -176
    (360.0, 192.0, -168.0),
    (-720.0, 544.0, -168.0)])  # fmt: skip
def test_whole_turns(degrees, plain, turning):
    value = np.radians([degrees])
    np.testing.assert_allclose(np.degrees(MEASURED.over(value)), plain, atol=1e-9)
    over = np.degrees(MEASURED.over(value, turning=True))
    if turning > 0:
        np.testing.assert_allclose(over, turning, atol=1e-9)
    else:
        assert over[0] <= 0.0


def test_a_range_of_more_than_a_turn_has_every_angle():
    wide = Range("joint 6 angle", "rad", -4.0, 4.0)
    angles = np.linspace(-20, 20, 500)
    assert not wide.beyond(angles, turning=True).any()
    assert wide.beyond(angles).any()
