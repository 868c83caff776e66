"""Moving the arm from pose to pose while every limit is checked."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hilcal.config import CellConfig
from hilcal.errors import DeviceError
from hilcal.measuring.devices import ArmDevice, ArmSample, Clock
from hilcal.measuring.dry_run import on_route
from hilcal.measuring.feasibility import Feasibility
from hilcal.measuring.force import ForceMeter
from hilcal.measuring.guard import HOW_ON, NORMAL, Guard, LoadWatch
from hilcal.measuring.route import Stop, duration
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats

POLL_S = 0.02
"""Between two looks at the devices while the arm moves, real seconds."""
GRACE_S = 15.0
"""What a motion may take longer than three times its time, real seconds."""
SLOWEST = 0.02
"""The speed slider is not waited for below this share."""
STILL_RAD = 1e-4
"""Joints of an arm at rest vary by less, rad (some steps of an encoder)."""
MOVED_RAD = 0.005
"""A joint that stands farther from where hilcal left it has been moved, rad; brakes and sagging
move it by less. A choice, no study set it: 7 mm at the end of an arm of 1.3 m."""
OFF_WAY_RAD = 0.05
"""A joint so far from the straight line of its motion has left it, rad; an arm follows its command
to about 0.01. A choice."""
FOLLOW_S = 0.05
"""So long after its command a joint is where it was commanded to, at most, s. A choice."""
FROZEN_S = 0.6
"""Joint angles or a clock that stand still for so long where they have to change, real seconds."""
FROZEN_RAD = 1e-5
"""Joint angles that change by less stand still, rad."""


class Mover:
    """Commands the arm, and keeps where it left it and from which side each joint arrived.

    Every motion is checked from where the arm stands when it starts. Nothing here stops the arm:
    whatever is wrong is raised at once, and the run stops the arm before it does anything else.

    Attributes:
        goal: (n,) joint angles where the arm has been left, or goes; None while that is unknown.
        side: (n,) from which each joint arrived, -1 or +1; 0 before its first motion.
        watch: compares what the force sensor feels with what should hang; None without a sensor.
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
        self.hanging: tuple[str, ...] = (UNLOADED,)
        self.side = np.zeros(guard.cell.arm.n)
        self.watch = None if meter is None else LoadWatch(meter, guard.cell, config)
        self._arm, self._meter, self._guard = arm, meter, guard
        self._limits = Feasibility(guard.cell, config)
        self._motion, self._clock, self._passed = config.motion, clock, passed
        self._under_way = False
        self._ticked: tuple[float, int] = (-1.0, 0)

    def look(self) -> ArmSample:
        """Return a sample of the arm after it and the force sensor have been checked.

        Raises:
            LoadChangedError: the force sensor does not feel what should hang.
            DeviceError: a limit is exceeded, the arm is not where it was left, or a device failed;
                the arm has to be stopped.
        """
        sample = self._arm.sample()
        felt = None if self._meter is None else self._meter.felt()
        checked = (self._guard.check(sample, felt, load) for load in self.hanging)
        reason = next(filter(None, checked), None) or self._clock_stands(sample)
        if reason is not None:
            if sample.safety != NORMAL:
                self._arm.moving()  # in motion the driver raises the cause and what to do
            raise DeviceError(reason)
        if not self._under_way:
            moved = self.moved(sample)
            if moved is not None:
                raise DeviceError(f"arm: {moved}")
        if self.watch is not None and felt is not None:
            self.watch.look(sample, felt, moving=self._under_way)
        return sample

    def moved(self, sample: ArmSample) -> str | None:
        """Return who seems to have moved the arm since it was left, and how far; None if nobody."""
        if self.goal is None:
            return None
        for where, who in (
            (sample.q_target, "another program, or somebody at the pendant, has commanded"),
            (sample.q, "somebody has moved"),
        ):
            off = np.abs(where - self.goal)
            k = int(np.argmax(off))
            if not off[k] <= MOVED_RAD:
                name = self._guard.cell.arm.joint_names[k]
                return f"{who} it since it came here: {name} by {off[k]:.3g} rad"
        return None

    def wait(self, seconds: float) -> None:
        """Wait for so many cell seconds, with a look every half a real second."""
        end = self._clock.now() + seconds
        while (left := end - self._clock.now()) > 0:
            self._clock.sleep(min(left, 0.5 * self._clock.scale))
            self.look()

    def is_at(self, q: Floats) -> bool:
        """Whether the last motion went to just these joint angles (n,)."""
        return self.goal is not None and np.array_equal(q, self.goal)

    def agreed(self, goal: Floats, name: str, left: Floats, ask: Callable[[str], None]) -> Floats:
        """Return where the arm stands (n,), once its way to a goal is free and people have agreed.

        Where it does not stand where it was `left` (n,), rad, that is asked first, and checked anew
        after; `ask` raises DeviceError where that is refused.

        Raises:
            DeviceError: the way is not free, or the person gave up.
        """
        while True:
            sample = self._arm.sample()
            unfit = self._guard.state(sample)
            if unfit is not None:
                raise DeviceError(unfit)
            q = sample.q
            self.check_way(q, goal, name)
            off = np.abs(q - left)
            k = int(np.argmax(off))
            if off[k] <= MOVED_RAD:
                return q
            joint = self._guard.cell.arm.joint_names[k]
            ask(
                f"the arm does not stand where it was left: {joint} is {off[k]:.3g} rad off. Its "
                f"way from there to {name} has been checked. It goes there next"
            )
            left = q

    def put_back(self, ask: Callable[[str], None]) -> None:
        """Have an arm that was moved during a question go back; see `agreed`."""
        if self.goal is None or self.moved(self._arm.sample()) is None:
            return
        goal, name = self.goal, "where it was left"
        self.goal = self.agreed(goal, name, goal, ask)
        self.move(goal, name)

    def left_here(self) -> None:
        """Take note of where the arm stands after it was stopped on its way."""
        if self.goal is None:
            self.goal = self._arm.sample().q

    def check_way(self, start: Floats, goal: Floats, name: str) -> None:
        """Check the straight line in joint space between two states (n,), rad.

        Raises:
            DeviceError: it is not free.
        """
        for load in self.hanging:
            stops = Stop("where the arm stands", start, load), Stop(name, goal, load)
            problems = on_route(self._limits, stops)
            if problems:
                raise DeviceError(
                    f"arm: it cannot go to {name} from where it stands: {problems[0]}; {HOW_ON}"
                )

    def move(self, q: Floats, name: str) -> None:
        """Move to `q` (n,), rad, straight in joint space.

        The way is checked from where the arm stands.

        Raises:
            LoadChangedError: the load is not what should hang any more.
            DeviceError: the way is not free, the arm failed, a limit was exceeded, or it did not
                arrive.
        """
        sample = self.look()
        start = sample.q
        if self.goal is not None and np.abs(start - self.goal).max() <= self._motion.arrival_rad:
            start = self.goal
        self.check_way(start, q, name)
        self.goal = None  # wherever it ends, if it does not arrive
        self._under_way = True
        try:
            self._go(start, q, name)
        finally:
            self._under_way = False
        self.goal = q
        moved = np.sign(q - start)
        self.side = np.where(moved == 0.0, self.side, moved)

    def _go(self, start: Floats, q: Floats, name: str) -> None:
        motion = self._motion
        self._arm.start_move(q, motion.speed_rad_s, motion.acceleration_rad_s2)
        usual = duration(start, q, motion.speed_rad_s, motion.acceleration_rad_s2)
        begun, slowest = self._clock.now(), 1.0
        last: ArmSample | None = None
        while self._arm.moving():
            sample = self.look()
            last = self._check_progress(start, q, sample, last, name)
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

    def _check_progress(
        self, start: Floats, goal: Floats, sample: ArmSample, last: ArmSample | None, name: str
    ) -> ArmSample:
        """Check that a motion keeps its straight line and goes on.

        `last` is the first sample with the joint angles of before; returned is that of now.
        """
        way = goal - start
        share = np.clip((sample.q - start) @ way / max(float(way @ way), 1e-30), 0.0, 1.0)
        off = np.abs(sample.q - start - share * way)
        k = int(np.argmax(off))
        joint = self._guard.cell.arm.joint_names[k]
        if not off[k] <= OFF_WAY_RAD:
            raise DeviceError(
                f"arm: {joint} has left the straight way to {name} by {off[k]:.3g} rad; does "
                "another program command the arm, or does somebody push it?"
            )
        behind = np.abs(sample.q_target - sample.q)
        k = int(np.argmax(behind))
        joint = self._guard.cell.arm.joint_names[k]
        if not behind[k] <= OFF_WAY_RAD + FOLLOW_S * self._motion.speed_rad_s:
            raise DeviceError(
                f"arm: {joint} is told to be {behind[k]:.3g} rad from where it is, on the way to "
                f"{name}: its angle is old, or something holds the joint"
            )
        if last is None or np.abs(sample.q - last.q).max() > FROZEN_RAD:
            return sample
        near = np.abs(sample.q - goal).max() <= MOVED_RAD
        if near or sample.speed_scaling < SLOWEST:
            return replace(last, host_ns=sample.host_ns)
        if sample.host_ns - last.host_ns > FROZEN_S * 1e9:
            raise DeviceError(
                f"arm: its joint angles have stood still for {FROZEN_S:g} s on the way to {name}: "
                "they are old, or something holds it"
            )
        return last

    def _clock_stands(self, sample: ArmSample) -> str | None:
        """Return that the controller's clock stands still, or None."""
        stamp, since = self._ticked
        if sample.timestamp != stamp:
            self._ticked = sample.timestamp, sample.host_ns
        elif sample.host_ns - since > FROZEN_S * 1e9:
            return f"arm: its clock has stood still for {FROZEN_S:g} s; its data are old"
        return None

    def at_rest(self, sample: ArmSample) -> bool:
        """Whether the arm stands where it has been commanded to, by a sample."""
        goal = sample.q if self.goal is None else self.goal
        there = np.abs(sample.q - goal).max() <= self._motion.arrival_rad
        return bool(there and np.abs(sample.qd).max() <= self._motion.speed_rad_s / 50)

    @property
    def differed(self) -> int:
        """How many looks so far have felt something else than what should hang."""
        return 0 if self.watch is None else self.watch.differed

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
