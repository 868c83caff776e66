"""Moving the arm from pose to pose, with checks of every limit and of the load."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellLoad
from hilcal.errors import DeviceError
from hilcal.measuring.connect import Setup
from hilcal.measuring.devices import ArmSample, LoadChangedError
from hilcal.measuring.feasibility import Feasibility, Margins
from hilcal.measuring.force import ForceMeter, TaredWrench, body_text, judged_part
from hilcal.measuring.progress import ArmPosition
from hilcal.measuring.route import Stop, duration, route_problems
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats

PAYLOAD_KG, PAYLOAD_M = 0.01, 1e-3
"""Differences of the payload in the controller from the one that was set, beyond which it was set
by others; choices: controllers round."""
NORMAL = "normal"  # safety state of an arm without problems
WHERE_LEFT = "where it was left"  # the arm, in a message
HOW_ON = "drive it by hand to a free place in the middle of its workspace"
SLACK_M = 0.005  # allowed sag beyond the edge of the workspace, m
SLACK = Margins(
    joint=-0.01, workspace=-SLACK_M, clearance=0.0, self_collision=0.0, torque_share=1.02
)
"""Margins in motion, smaller than those of a dry run: an arm sags and lags, and a motion is checked
at samples. Nothing may touch."""


def payload(cell: Cell, load: CellLoad | None) -> tuple[float, Floats]:
    """Return mass, kg, and centre of mass (3,), flange axes, m, of the tool with a weight."""
    hung = 0.0 if load is None else load.mass_kg
    mass = cell.tool_mass + hung
    if mass == 0.0:
        return 0.0, np.zeros(3)
    return mass, (cell.tool_mass * cell.tool_com + hung * cell.load_point) / mass


class Guard:
    """The limits of a cell, checked against samples of its devices."""

    def __init__(self, cell: Cell) -> None:
        self.cell, self.config = cell, cell.configured()
        self._limits = Feasibility(cell, SLACK)

    def check(
        self, sample: ArmSample, wrench: Floats | None = None, hanging: str = UNLOADED
    ) -> str | None:
        """Return the violated limit in one line, or None; `wrench` is the sensor's wrench (6,)."""
        if (unfit := self.state(sample)) is not None:
            return unfit
        speed, limit = np.abs(sample.qd), self.config.limits.joint_speed_rad_s
        k = int(np.argmax(speed))
        if speed[k] > limit:
            name = self.cell.arm.joint_names[k]
            return f"arm: {name} moves at {speed[k]:.3g} rad/s; joint_speed_rad_s is {limit:g}"
        violation = next(self._limits.findings(sample.q[None], hanging), None)
        return self._pull(wrench) if violation is None else f"{violation.line('arm')}; {HOW_ON}"

    def state(self, sample: ArmSample) -> str | None:
        """Return why a sample is not one of this arm, ready to move, in one line; or None."""
        if sample.safety != NORMAL:
            return f"arm: its safety state is {sample.safety}; put that right on the pendant"
        n = self.cell.arm.n
        if sample.q.shape != (n,) or sample.qd.shape != (n,):
            return f"arm: it reports {len(sample.q)} joints; {self.cell.arm.name} has {n}"
        if not (np.isfinite(sample.q).all() and np.isfinite(sample.qd).all()):
            return "arm: it reports joint angles that are not numbers"
        return None

    def _pull(self, wrench: Floats | None) -> str | None:
        sensor = self.config.force_sensor
        if wrench is None or sensor is None:
            return None
        for part, unit, key, limit in (
            (wrench[:3], "N", "max_force_N", sensor.max_force_N),
            (wrench[3:], "N·m", "max_moment_Nm", sensor.max_moment_Nm),
        ):
            size = float(np.linalg.norm(part))
            if not size <= limit:  # negated, to refuse NaN
                return (
                    f"force sensor: {size:.4g} {unit}; {key} is {limit:g}. Look what the arm or "
                    "its load touches"
                )
        return None


# choices without a study; tests/unit/measuring/test_run_watched.py shows what they detect
TOLERANCE_FACTOR = 2.0
"""Tolerance of a hanging load, over the tolerance when it is hung: a sensor's zero drifts."""
SWING_SHARE = 0.3  # lateral force of a load that swings in motion, as a share of its weight: 17°
PULL_SHARE = 0.5
"""Tolerance of a pull, as a share: its rope turns with the arm, its weight is on a pulley."""
UNKNOWN_KG = 1.0
"""Tolerance of a tool that is not weighed yet, kg, or half of its mass in [tool] if larger."""
HOLD_S = 0.2  # least duration of a difference in motion and between readings, real s
HOLD_SAMPLES = 3  # the same, in samples


class LoadWatch:
    """Compares the measured force with tool and load, at every sample and reading.

    d = |R (f - f_tool) - f_load| with f the measured force and f_tool the tool's, in sensor axes,
    and R the sensor's orientation; for a load that is a moment alone see `judged_part`. The limit
    is `TOLERANCE_FACTOR` times the [operator] tolerance for hanging a load; it is larger for a pull
    (`PULL_SHARE`), and in motion for swinging (`SWING_SHARE`) and acceleration. A tool that is not
    weighed yet may differ from [tool] by `UNKNOWN_KG`. The tare removes that difference at its
    pose, so the limit grows with the rotation of the sensor against gravity since then.
    """

    def __init__(self, meter: ForceMeter, cell: Cell) -> None:
        """Compare nothing until `expect`."""
        self._meter, self._cell, self._config = meter, cell, cell.configured()
        self._load: CellLoad | None = None
        self._hung = np.zeros(6)  # wrench of the load at the load point, base axes
        self.watching, self.differed = False, 0
        self._since: tuple[int, int] | None = None

    def expect(self, load: CellLoad | None) -> None:
        """Start to compare with a load; None: without a load."""
        self._load, self.watching, self._since = load, True, None
        self._hung = np.zeros(6) if load is None else load.wrench(self._cell.gravity)

    def check_frame(self, sample: ArmSample, wrench: Floats, *, moving: bool) -> None:
        """Compare a frame of the sensor: a tared wrench (6,), sensor axes, N and N·m."""
        if not self.watching:
            return
        tared = TaredWrench(wrench, np.zeros((6, 6)), sample.q)
        difference, limit = self._compared(tared, moving=moving)
        if difference <= limit:
            self._since = None
            return
        self.differed += 1
        first, count = self._since or (sample.host_ns, 0)
        self._since = first, count + 1
        if count + 1 >= HOLD_SAMPLES and sample.host_ns - first >= HOLD_S * 1e9:
            raise LoadChangedError(self._message(tared))

    def difference(self, tared: TaredWrench) -> str:
        """Return why a mean wrench is not that of the expected load, in one line; else ""."""
        if not self.watching:
            return ""
        difference, limit = self._compared(tared, moving=False)
        noise = 3.0 * float(np.sqrt(np.linalg.eigvalsh(tared.covariance[:3, :3]).max()))
        return self._message(tared) if difference - noise > limit else ""

    def _compared(self, tared: TaredWrench, *, moving: bool) -> tuple[float, float]:
        """Return the deviation of the force (or moment) from the expected load, and its limit, N.

        A swinging weight pulls sideways; in motion, its vertical force is compared separately.
        """
        load, operator, cell = self._load, self._config.operator, self._cell
        difference = self._meter.load_wrench(tared) - self._hung
        part, _, lever = judged_part(self._hung)
        size, deviation = (float(np.linalg.norm(w[part])) / lever for w in (self._hung, difference))
        pulled = load is not None and any((*load.force_N, *load.moment_Nm))
        share = max(TOLERANCE_FACTOR * operator.tolerance_share, PULL_SHARE if pulled else 0.0)
        limit = max(TOLERANCE_FACTOR * operator.tolerance_N, share * size)
        mass = cell.tool_mass + (0.0 if load is None else load.mass_kg)
        if not self._meter.identified:
            unweighed = max(UNKNOWN_KG, 0.5 * cell.tool_mass)
            limit += unweighed * self._meter.gravity_change(tared.q)
        if moving:
            motion = self._config.motion
            brief = motion.speed_rad_s < HOLD_S * motion.acceleration_rad_s2
            ramp = 0.0 if brief else motion.acceleration_rad_s2  # brief: shorter than HOLD_S
            limit += mass * cell.arm.reach * (ramp + motion.speed_rad_s**2)
            down = abs(float(difference[:3] @ cell.gravity)) / float(np.linalg.norm(cell.gravity))
            lifted = limit + SWING_SHARE**2 / 2 * size
            limit += SWING_SHARE * size
            if load is not None and not pulled and down / lifted > deviation / limit:
                return down, lifted
        return deviation, limit

    def _message(self, tared: TaredWrench) -> str:
        part, unit, _ = judged_part(self._hung)
        measured, hung = (
            np.linalg.norm(w[part]) for w in (self._meter.load_wrench(tared), self._hung)
        )
        name = "nothing" if self._load is None else self._load.name
        suffix = "" if self._meter.identified else " Or is [tool] mass_kg or com_m wrong?"
        return (
            f"the force sensor measures {measured:.1f} {unit} where {name} should hang ({hung:.1f} "
            f"{unit}): has a load fallen off, or does somebody touch the tool?{suffix}"
        )


POLL_S = 0.02  # between two samples of the devices while the arm moves, real s
GRACE_S = 15.0  # allowed excess of a motion over three times its usual time, real s
MIN_SPEED_SHARE = 0.02  # share of the speed slider below which the time limit does not grow
STILL_RAD = 1e-4  # largest variation of the joints of an arm at rest, rad (some encoder steps)
MOVED_RAD = 0.005
"""Largest distance of a joint from its last goal, rad, beyond which it was moved; brakes and sag
move it by less. A choice: 7 mm at the end of an arm of 1.3 m."""
OFF_PATH_RAD = 0.05
"""Largest distance of a joint from the straight line of its motion, rad; an arm follows its command
to about 0.01. A choice."""
FOLLOW_S = 0.05
"""Largest lag of a joint behind its command, s. A choice."""
FROZEN_S = 0.6
"""Time after which joint angles or a clock that should change are frozen, real s."""
FROZEN_RAD = 1e-5  # change of the joint angles below which they stand still, rad


class Mover:
    """Commands the arm; knows its last goal and the approach side of each joint.

    Every motion is checked from the actual position of the arm. Nothing here stops the arm: any
    problem is raised at once, and the run stops the arm before anything else. `goal` (n,) is the
    last or current goal; None while unknown.
    """

    def __init__(self, setup: Setup, meter: ForceMeter | None) -> None:
        """Use an open arm; the watcher gets its position during motions, and must not block."""
        cell, config = setup.cell, setup.cell.configured()
        self.goal: Floats | None = None
        self.hanging: tuple[str, ...] = (UNLOADED,)
        self.side = np.zeros(cell.arm.n)
        self.watch = None if meter is None else LoadWatch(meter, cell)
        self._arm, self._meter, self.guard = setup.rig.arm, meter, Guard(cell)
        self._limits = Feasibility(cell)
        self._motion, self._clock, self._watcher = config.motion, setup.clock, setup.watcher
        self._stop_requested = setup.stop_requested
        self._in_motion = False
        self._payload: tuple[float, Floats] | None = None  # in the controller; None before control
        self._last_tick: tuple[float, int] = (-1.0, 0)

    def take_control(self) -> None:
        """Take control of the arm, with the payload of the tool alone."""
        self._payload = payload(self.guard.cell, None)
        self._arm.take_control(*self._payload)

    def set_payload(self, load: CellLoad | None) -> None:
        """Set the payload of the tool with a load in the controller."""
        self._payload = payload(self.guard.cell, load)
        self._arm.set_payload(*self._payload)

    def payload_left(self) -> str | None:
        """Return which payload the controller keeps, where a weight may hang; else None."""
        loads = map(self._limits.shapes.load, self.hanging)
        if self._payload is None or not any(load is not None and load.mass_kg for load in loads):
            return None
        return (
            f"the controller is set to a payload of {body_text(*self._payload)}: before anybody "
            "guides the arm by hand, set there what then hangs, or the arm rises or sinks by itself"
        )

    def checked_sample(self) -> ArmSample:
        """Return a sample of the arm, after checks of the arm and of the force sensor.

        KeyboardInterrupt: a stop was requested, also where a driver has suppressed its interrupt.
        """
        if self._stop_requested():
            raise KeyboardInterrupt
        sample = self._arm.sample()
        meter = self._meter
        measured = None if meter is None else meter.sensor.latest().wrench - meter.zero
        checked = (self.guard.check(sample, measured, load) for load in self.hanging)
        reason = next(filter(None, checked), None) or self._frozen_clock(sample)
        if reason is not None:
            if sample.safety != NORMAL:
                self._arm.moving()  # a driver that can raises the cause and the remedy
            raise DeviceError(reason)
        if not self._in_motion and (moved := self.moved_by_others(sample)) is not None:
            raise DeviceError(f"arm: {moved}")
        if (loaded := self._loaded_by_others(sample)) is not None:
            raise DeviceError(f"arm: {loaded}")
        if self.watch is not None and measured is not None:
            self.watch.check_frame(sample, measured, moving=self._in_motion)
        return sample

    def moved_by_others(self, sample: ArmSample) -> str | None:
        """Return who seems to have moved the arm from its goal, and how far; None if nobody."""
        if self.goal is None:
            return None
        for q, subject in (
            (sample.q_target, "another program, or somebody at the pendant, has commanded"),
            (sample.q, "somebody has moved"),
        ):
            name, distance = self._worst(q - self.goal)
            if not distance <= MOVED_RAD:
                return f"{subject} it since it came here: {name} by {distance:.3g} rad"
        return None

    def _loaded_by_others(self, sample: ArmSample) -> str | None:
        """Return which payload others have set in the controller; None if nobody, or unknown."""
        if self._payload is None or np.isnan(sample.payload):
            return None
        mass, com = self._payload
        reported = com if sample.payload_com is None else sample.payload_com
        far = np.linalg.norm(reported - com) > PAYLOAD_M
        if abs(sample.payload - mass) <= PAYLOAD_KG and not (mass > 0.0 and far):
            return None
        return (
            f"another program, or somebody at the pendant, has set its payload to "
            f"{body_text(sample.payload, reported)}; it was {body_text(mass, com)}, tool "
            "and load by the cell. It decides how the controller corrects the arm's deflection "
            "and when it stops: let nothing else set it"
        )

    def wait(self, seconds: float) -> None:
        """Wait `seconds`, cell s, with a check every half a real second."""
        end = self._clock.now() + seconds
        while (remaining := end - self._clock.now()) > 0:
            self._clock.sleep(min(remaining, 0.5 * self._clock.scale))
            self.checked_sample()

    def is_at(self, q: Floats) -> bool:
        """Whether the last motion went to exactly these joint angles (n,)."""
        return self.goal is not None and np.array_equal(q, self.goal)

    def agreed_start(
        self,
        goal: Floats,
        name: str,
        expected: Floats,
        ask: Callable[[str], None],
        place: str = WHERE_LEFT,
    ) -> Floats:
        """Return the position (n,) of the arm, once its path to a goal is free and people agree.

        If it is not at the `expected` position, a `place` in words, people are asked first, and the
        path is checked again.
        """
        while True:
            q = self.sample_with_free_path(goal, name).q
            joint, distance = self._worst(q - expected)
            if distance <= MOVED_RAD:
                return q
            ask(
                f"the arm does not stand {place}: {joint} is {distance:.3g} rad off. Its "
                f"way from there to {name} has been checked. It goes there next"
            )
            expected = q

    def sample_with_free_path(self, goal: Floats, name: str) -> ArmSample:
        """Return a sample of the arm; DeviceError unless it is ready and its path is free."""
        sample = self._arm.sample()
        if (unfit := self.guard.state(sample)) is not None:
            raise DeviceError(unfit)
        self.check_path(sample.q, goal, name)
        return sample

    def put_back(self, ask: Callable[[str], None]) -> None:
        """Move an arm back that was moved during a question; see `agreed_start`.

        Less than `MOVED_RAD` is no question, but no place for a reading either.
        """
        goal, name, sample = self.goal, WHERE_LEFT, self._arm.sample()
        if goal is None:
            return
        if np.abs([sample.q - goal, sample.q_target - goal]).max() <= self._motion.arrival_rad:
            return
        self.goal = self.agreed_start(goal, name, goal, ask)
        self.move(goal, name)

    def check_path(self, start: Floats, goal: Floats, name: str) -> None:
        """Check the straight line in joint space between two states (n,), rad."""
        for load in self.hanging:
            stops = Stop("where the arm stands", start, load), Stop(name, goal, load)
            problems = route_problems(self._limits, stops)
            if problems:
                raise DeviceError(
                    f"arm: it cannot go to {name} from where it stands: {problems[0]}; {HOW_ON}"
                )

    def move(self, q: Floats, name: str) -> None:
        """Move straight to `q` (n,), rad; the path is checked from the arm's actual position."""
        start = self.checked_sample().q
        if self.goal is not None and np.abs(start - self.goal).max() <= self._motion.arrival_rad:
            start = self.goal
        self.check_path(start, q, name)
        self.goal = None  # unknown until it arrives
        self._in_motion = True
        try:
            self._go(start, q, name)
        finally:
            self._in_motion = False
        self.goal = q
        way = q - start  # of joints at rest it is noise
        self.side = np.where(np.abs(way) <= STILL_RAD, self.side, np.sign(way))

    def _go(self, start: Floats, q: Floats, name: str) -> None:
        motion = self._motion
        self._arm.start_move(q, motion.speed_rad_s, motion.acceleration_rad_s2)
        usual = duration(start, q, motion.speed_rad_s, motion.acceleration_rad_s2)
        start_time, slowest = self._clock.now(), 1.0
        last: ArmSample | None = None
        while self._arm.moving():
            sample = self.checked_sample()
            last = self._check_progress(start, q, sample, last, name)
            self._watcher.notify(ArmPosition(tuple(sample.q.tolist())))
            slowest = min(slowest, max(sample.speed_scaling, MIN_SPEED_SHARE))
            allowed = 3.0 * usual / slowest + GRACE_S * self._clock.scale
            if self._clock.now() - start_time > allowed:
                raise DeviceError(
                    f"arm: the motion to {name} is not finished after {allowed:.0f} s; "
                    f"{usual:.0f} s are usual"
                )
            self._clock.sleep(POLL_S * self._clock.scale)
        arrived = self.checked_sample().q
        self._watcher.notify(ArmPosition(tuple(arrived.tolist())))
        joint, distance = self._worst(arrived - q)
        if not distance <= motion.arrival_rad:
            raise DeviceError(
                f"arm: {joint} stands {distance:.3g} rad off {name}; arrival_rad is "
                f"{motion.arrival_rad:g}"
            )

    def _worst(self, deviation: Floats) -> tuple[str, float]:
        """Return name and size of the largest deviation of a joint, rad."""
        k = int(np.argmax(np.abs(deviation)))
        return self.guard.cell.arm.joint_names[k], float(np.abs(deviation[k]))

    def _check_progress(
        self, start: Floats, goal: Floats, sample: ArmSample, last: ArmSample | None, name: str
    ) -> ArmSample:
        """Check that a motion follows its line; return the last sample with progress."""
        way = goal - start
        share = np.clip((sample.q - start) @ way / max(float(way @ way), 1e-30), 0.0, 1.0)
        joint, deviation = self._worst(sample.q - start - share * way)
        if not deviation <= OFF_PATH_RAD:
            raise DeviceError(
                f"arm: {joint} has left the straight way to {name} by {deviation:.3g} rad; does "
                "another program command the arm, or does somebody push it?"
            )
        joint, lag = self._worst(sample.q_target - sample.q)
        if not lag <= OFF_PATH_RAD + FOLLOW_S * self._motion.speed_rad_s:
            raise DeviceError(
                f"arm: {joint} is commanded {lag:.3g} rad away from its position, on the way to "
                f"{name}: its angle is old, or something holds the joint"
            )
        if last is None or np.abs(sample.q - last.q).max() > FROZEN_RAD:
            return sample
        near = np.abs(sample.q - goal).max() <= MOVED_RAD
        if near or sample.speed_scaling < MIN_SPEED_SHARE:
            return replace(last, host_ns=sample.host_ns)
        if sample.host_ns - last.host_ns > FROZEN_S * 1e9:
            raise DeviceError(
                f"arm: its joint angles have stood still for {FROZEN_S:g} s on the way to {name}: "
                "they are old, or something holds it"
            )
        return last

    def _frozen_clock(self, sample: ArmSample) -> str | None:
        """Return a message if the controller's clock stands still; else None."""
        stamp, since = self._last_tick
        if sample.timestamp != stamp:
            self._last_tick = sample.timestamp, sample.host_ns
        elif sample.host_ns - since > FROZEN_S * 1e9:
            return f"arm: its clock has stood still for {FROZEN_S:g} s; its data are old"
        return None

    def why_not_at_rest(self, sample: ArmSample) -> str | None:
        """Return why the arm does not stand at its goal, by a sample, in one line; or None."""
        joint, distance = self._worst(sample.q - (sample.q if self.goal is None else self.goal))
        if not distance <= (limit := self._motion.arrival_rad):
            return f"{joint} stands {distance:.3g} rad off its goal (arrival_rad is {limit:g})"
        joint, speed = self._worst(sample.qd)
        if not speed <= self._motion.speed_rad_s / 50:
            return f"{joint} still moves at {speed:.3g} rad/s"
        return None

    def check_still(self, before: ArmSample, after: ArmSample) -> str | None:
        """Return why a reading between two samples is void, in one line; or None."""
        if self.goal is not None:
            joint, deviation = self._worst(after.q_target - self.goal)
            if deviation > self._motion.arrival_rad:
                return f"arm: somebody else commanded {joint} by {deviation:.3g} rad"
        joint, moved = self._worst(after.q - before.q)
        if not moved <= STILL_RAD:
            return f"arm: {joint} moved by {moved:.3g} rad during the reading"
        return None
