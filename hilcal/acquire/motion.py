"""Moving the arm from pose to pose while every limit is checked."""

from collections.abc import Callable

import numpy as np

from hilcal.acquire.clock import Clock
from hilcal.acquire.devices import ArmDevice, ArmSample
from hilcal.acquire.force import ForceMeter
from hilcal.acquire.guard import NORMAL, Guard
from hilcal.acquire.route import duration
from hilcal.config import CellConfig
from hilcal.errors import DeviceError
from hilcal.types import Floats

POLL_S = 0.02
"""Between two looks at the devices while the arm moves, real seconds."""
GRACE_S = 15.0
"""What a motion may take longer than three times its time, real seconds."""
SLOWEST = 0.02
"""The speed slider is not waited for below this share."""
STILL_RAD = 1e-4
"""Joints of an arm at rest vary by less, rad (some steps of an encoder)."""


class Mover:
    """Commands the arm, and keeps from which side each joint arrived.

    Nothing here stops the arm: whatever is wrong is raised at once, and the run stops the arm
    before it does anything else.
    """

    def __init__(
        self,
        arm: ArmDevice,
        meter: ForceMeter | None,
        guard: Guard,
        config: CellConfig,
        clock: Clock,
        passed: Callable[[Floats], None] = lambda q: None,
    ) -> None:
        """Use an open arm; `passed` is told where it is (n,) while it moves, and must not wait."""
        self.goal: Floats | None = None
        self.side = np.zeros(guard.cell.arm.n)
        self._arm, self._meter, self._guard = arm, meter, guard
        self._motion, self._clock, self._passed = config.motion, clock, passed

    def look(self) -> ArmSample:
        """Return a sample of the arm after it and the force sensor have been checked.

        Raises:
            DeviceError: a limit is exceeded, or a device failed; the arm has to be stopped.
        """
        sample = self._arm.sample()
        felt = None if self._meter is None else self._meter.felt()
        reason = self._guard.check(sample, felt)
        if reason is not None:
            if sample.safety != NORMAL:
                self._arm.moving()  # in motion the driver raises the cause and what to do
            raise DeviceError(reason)
        return sample

    def wait(self, seconds: float) -> None:
        """Wait for so many cell seconds, with a look every half a real second."""
        end = self._clock.now() + seconds
        while (left := end - self._clock.now()) > 0:
            self._clock.sleep(min(left, 0.5 * self._clock.scale))
            self.look()

    def is_at(self, q: Floats) -> bool:
        """Whether the last motion went to just these joint angles (n,)."""
        return self.goal is not None and np.array_equal(q, self.goal)

    def move(self, q: Floats, name: str) -> None:
        """Move to joint angles (n,) in a straight line in joint space.

        Raises:
            DeviceError: the arm failed, a limit was exceeded, or it did not arrive.
        """
        sample = self.look()
        start = sample.q if self.goal is None else self.goal
        moved = np.sign(q - start)
        motion = self._motion
        self._arm.start_move(q, motion.speed_rad_s, motion.acceleration_rad_s2)
        self.goal = q
        usual = duration(start, q, motion.speed_rad_s, motion.acceleration_rad_s2)
        begun, slowest = self._clock.now(), 1.0
        while self._arm.moving():
            sample = self.look()
            self._passed(sample.q)
            slowest = min(slowest, max(sample.speed_scaling, SLOWEST))
            allowed = 3.0 * usual / slowest + GRACE_S * self._clock.scale
            if self._clock.now() - begun > allowed:
                raise DeviceError(
                    f"arm: the motion to {name} is not finished after {allowed:.0f} s; "
                    f"{usual:.0f} s are usual"
                )
            self._clock.sleep(POLL_S * self._clock.scale)
        arrived = self.look().q
        self._passed(arrived)
        off = np.abs(arrived - q)
        if not off.max() <= motion.arrival_rad:
            k = int(np.argmax(off))
            raise DeviceError(
                f"arm: {self._guard.cell.arm.joint_names[k]} stands {off[k]:.3g} rad off {name}; "
                f"arrival_rad is {motion.arrival_rad:g}"
            )
        self.side = np.where(moved == 0.0, self.side, moved)

    def at_rest(self, sample: ArmSample) -> bool:
        """Whether the arm stands where it has been commanded to, by a sample."""
        goal = sample.q if self.goal is None else self.goal
        there = np.abs(sample.q - goal).max() <= self._motion.arrival_rad
        return bool(there and np.abs(sample.qd).max() <= self._motion.speed_rad_s / 50)

    def check_still(self, before: ArmSample, after: ArmSample) -> str | None:
        """Return in one line why a reading between two samples is void, or None."""
        if self.goal is not None:
            off = float(np.abs(after.q_target - self.goal).max())
            if off > self._motion.arrival_rad:
                return f"arm: somebody else commanded it by {off:.3g} rad during the reading"
        moved = float(np.abs(after.q - before.q).max())
        if not moved <= STILL_RAD:
            return f"arm: it moved by {moved:.3g} rad during the reading"
        return None
