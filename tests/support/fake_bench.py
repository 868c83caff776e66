"""A bench in memory: devices that share one small world, cell, plans, and a store."""

import json
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import (
    Acquire,
    CellConfig,
    CellLoad,
    ForceSensor,
    Limits,
    Motion,
    Repeatability,
    Robot,
    Tool,
    Tracker,
)
from hilcal.measuring.connect import Rig
from hilcal.measuring.devices import (
    ArmSample,
    Clock,
    Losses,
    Report,
    TargetLostError,
    TrackerSample,
    WrenchSample,
)
from hilcal.measuring.progress import Remark
from hilcal.measuring.run import run
from hilcal.readings.readings import Readings
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.store.plan import Plan, Step
from hilcal.store.stored_schema import DETAIL, check, check_event
from hilcal.types import Floats

REGISTRATION = se3.matrix(se3.rotation(np.array([0.02, -0.03, 2.1])), np.array([2.4, -1.6, -0.5]))
SAG = 2e-5  # m/N, how far the target gives way along the force


class Killed(BaseException):
    """The process is killed: nothing that it does from now on reaches anybody."""


@dataclass
class FakeWorld:
    """Arm, load and time, and the calls that reached any device."""

    config: CellConfig
    cell: Cell
    q: Floats
    time: float = 100.0
    start: Floats = field(default_factory=lambda: np.zeros(6))
    goal: Floats = field(default_factory=lambda: np.zeros(6))
    motion_start: float = 0.0
    motion_duration: float = 0.0
    is_moving: bool = False
    load: str = "none"
    payload: tuple[float, Floats] | None = None
    control: bool = False
    offset: Floats = field(default_factory=lambda: np.array([3.0, -2.0, 5.0, 0.1, 0.2, -0.1]))
    tool_mass: float = 0.8
    calls: list[str] = field(default_factory=list)
    fail: dict[int, BaseException] = field(default_factory=dict)
    kill_at: int | None = None
    kill_after: tuple[str, int] | None = None  # a call, and how many of it
    killed: bool = False
    safety: str = "normal"
    extra: Floats = field(default_factory=lambda: np.zeros(6))  # further force, sensor axes
    extra_speed: float = 0.0
    shift: Floats = field(default_factory=lambda: np.zeros(3))  # of the target
    creep: float = 0.0  # m/s, of the target while at rest
    hurry: float = 20.0  # how much faster than commanded the arm moves, from the next motion on
    hurried: float = 1.0  # the same of the motion under way
    jitter: float = 0.0  # rad, of the joints from sample to sample at rest
    torques: float = 0  # the next so many samples at rest tell the torques of the joints
    unseen_measurements: int = 0  # the next so many measurements see no target
    not_found: int = 0  # the next so many searches find none
    wrong_loads: list[str] = field(default_factory=list)  # loads that are hung instead, in order
    at_start: list[tuple[Floats, str]] = field(default_factory=list)  # load at each motion
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(5))

    def call(self, name):
        """Count a call; fail where that is wanted."""
        if self.killed:
            raise Killed
        self.calls.append(name)
        k = len(self.calls)
        last = self.kill_after is not None and self.kill_after[0] == name
        if last and self.calls.count(name) == self.kill_after[1]:
            self.kill_at = k
        if self.kill_at == k:
            self.killed = True
            raise Killed
        if k in self.fail:
            raise self.fail[k]

    def restart(self):
        """Start the program anew: the arm has stopped where it was, the load still hangs."""
        self.joints()
        self.is_moving = self.control = self.killed = False
        self.kill_at = self.kill_after = None
        self.fail = {}
        self.calls.clear()

    def joints(self):
        if self.is_moving:
            share = min(1.0, (self.time - self.motion_start) / self.motion_duration)
            self.q = self.start + share * (self.goal - self.start)
            self.is_moving = share < 1.0
        return self.q

    def pull(self):
        """(6,) wrench of the load at the load point, base axes."""
        for load in self.config.loads:
            if load.name == self.load:
                return load.wrench(self.cell.gravity)
        return np.zeros(6)

    def position(self):
        """(3,) target in sensor axes."""
        chain = chains.evaluate(self.cell.arm, self.joints()[None])
        at = chain.point(self.cell.target[:3, 3])[0] + SAG * self.pull()[:3] + self.shift
        return REGISTRATION[:3, :3] @ at + REGISTRATION[:3, 3] + self.creep * self.time

    def wrench(self):
        """(6,) what the sensor reads, sensor axes (those of the flange)."""
        rotation = chains.evaluate(self.cell.arm, self.joints()[None]).rotation[-1][0]
        force = rotation.T @ (self.tool_mass * self.cell.gravity)
        out = np.concatenate([force, np.cross(self.cell.tool_com, force)])
        pull = self.pull()
        f, m = rotation.T @ pull[:3], rotation.T @ pull[3:]
        out += np.concatenate([f, m + np.cross(self.cell.load_point, f)])
        return out + self.offset + self.extra


class MemoryStore:
    """Keeps what it is given, as JSON where a file would; may be full."""

    def __init__(self, world):
        self.world = world
        self.refuses = {}  # by the number of rows that are there
        self.rows = []
        self.events = []

    def record(self, reading, step, detail):
        self.world.call("store.record")
        if len(self.rows) in self.refuses:
            raise self.refuses[len(self.rows)]
        assert len(reading) == 1
        assert not self.world.is_moving, "stored in motion"
        text = json.dumps(detail, allow_nan=False)
        check(DETAIL, json.loads(text))
        self.rows.append((step, reading, text))
        self.world.call("store.recorded")

    def event(self, kind, content):
        self.world.call("store.event")
        check_event(json.loads(json.dumps({"kind": kind, "utc": "now", **content})))
        self.events.append((kind, content))

    def done(self):
        return frozenset(step for step, _, _ in self.rows)

    def details(self):
        return [json.loads(text) for _, _, text in self.rows]

    def readings(self):
        if not self.rows:
            return None
        rows = [reading for _, reading, _ in self.rows]
        poses = tuple(dict.fromkeys(r.pose_names[0] for r in rows))
        loads = tuple(dict.fromkeys(r.load_names[0] for r in rows))
        return replace(
            Readings.joined(rows),
            pose=np.array([poses.index(r.pose_names[0]) for r in rows]),
            load=np.array([loads.index(r.load_names[0]) for r in rows]),
            load_names=loads,
            pose_names=poses,
        )

    def kinds(self):
        return [kind for kind, _ in self.events]

    def last(self, kind):
        return next((content for k, content in reversed(self.events) if k == kind), None)


@dataclass
class EventLog:
    """A watcher that remembers."""

    events: list[object] = field(default_factory=list)

    def notify(self, event):
        self.events.append(event)

    def of_kind(self, kind):
        return [event for event in self.events if isinstance(event, kind)]


STD = 1e-5  # m, of one measurement
TORQUE = np.array([3.0, -40.0, 20.0, 5.0, 1.0, -0.5])  # N·m, of every pose


@dataclass
class FakeDevice:
    """What all devices answer alike."""

    world: FakeWorld
    name: ClassVar[str]

    def report(self):
        return Report(self.name, "fake")

    def close(self):
        return


@dataclass
class FakeArm(FakeDevice):
    name = "arm"

    def sample(self):
        w = self.world
        w.call("arm.sample")
        q = w.joints()
        speed = (w.goal - w.start) / w.motion_duration / w.hurried if w.is_moving else np.zeros(6)
        if not w.is_moving:
            q = q + w.jitter * w.rng.standard_normal(6)
        w.torques -= not w.is_moving
        return ArmSample(
            host_ns=int(w.time * 1e9),
            timestamp=w.time,
            q=q.copy(),
            q_target=q.copy(),
            qd=speed + w.extra_speed,
            target_moment=np.zeros(6),
            current=np.zeros(6),
            target_current=np.zeros(6),
            joint_temperature=np.full(6, 30.0),
            tcp_pose=np.zeros(6),
            tcp_force=np.zeros(6),
            ft_raw_wrench=None,
            payload=0.0 if w.payload is None else w.payload[0],
            payload_com=None if w.payload is None else w.payload[1],
            speed_scaling=1.0,
            safety=w.safety,
            torque=TORQUE + 0.1 * w.rng.standard_normal(6) if w.torques >= 0 else None,
        )

    def take_control(self, mass, com):
        self.world.call("arm.take_control")
        self.world.control, self.world.payload = True, (mass, com)

    def set_payload(self, mass, com):
        self.world.call("arm.set_payload")
        assert self.world.control
        assert not self.world.is_moving
        self.world.payload = (mass, com)

    def start_move(self, q, speed, acceleration):
        w = self.world
        w.call("arm.start_move")
        assert w.control, "a motion without control"
        w.start, w.goal, w.motion_start = w.joints().copy(), q.copy(), w.time
        way = float(np.abs(w.goal - w.start).max())
        w.hurried = w.hurry
        w.motion_duration = max(way / speed / w.hurry, 1e-6)
        w.is_moving = True
        w.at_start.append((q.copy(), w.load))

    def moving(self):
        self.world.call("arm.moving")
        self.world.joints()
        return self.world.is_moving

    def stop(self):
        self.world.call("arm.stop")
        self.world.joints()
        self.world.is_moving = False

    def close(self):
        self.world.is_moving = self.world.control = False


@dataclass
class FakeTracker(FakeDevice):
    """A tracker with white noise."""

    name = "tracker"

    def measure(self):
        w = self.world
        w.call("tracker.measure")
        w.time += 0.1
        if w.unseen_measurements > 0:
            w.unseen_measurements -= 1
            raise TargetLostError("tracker: the beam is broken")
        assert not w.is_moving, "measured in motion"
        value = w.position() + STD * w.rng.standard_normal(3)
        return TrackerSample(int(w.time * 1e9), value, STD**2 * np.eye(3))

    def find_target(self):
        w = self.world
        w.call("tracker.find_target")
        w.time += 1.0
        if w.not_found > 0:
            w.not_found -= 1
            raise TargetLostError("tracker: no target found")


@dataclass
class FakeForce(FakeDevice):
    """A force sensor of 100 Hz."""

    name = "force sensor"

    def latest(self):
        self.world.call("force.latest")
        return self._sample(1)

    def average(self, seconds):
        self.world.call("force.average")
        self.world.time += seconds
        return self._sample(int(100 * seconds))

    def _sample(self, frames):
        covariance = np.diag([0.01] * 3 + [1e-4] * 3) if frames > 1 else np.zeros((6, 6))
        return WrenchSample(int(self.world.time * 1e9), self.world.wrench(), covariance, frames)

    def losses(self):
        return Losses(1000, 0, 0, 0)


@dataclass
class FakeOperator(FakeDevice):
    """Hangs what it is asked for, or what `FakeWorld.wrong_loads` says."""

    name = "operator"
    requests: list[tuple[str, str]] = field(default_factory=list)

    def hang(self, load, why):
        w = self.world
        w.call("operator.hang")
        assert not w.is_moving, "a person asked to work at a moving arm"
        name = "none" if load is None else load.name
        self.requests.append((name, why))
        w.time += 20.0
        w.load = w.wrong_loads.pop(0) if w.wrong_loads else name

    def confirm(self, question):
        self.world.call("operator.confirm")
        assert not self.world.is_moving, "a person asked to look at a moving arm"
        self.requests.append(("confirm", question))


@dataclass(frozen=True)
class FakeClock(Clock):
    """The world's time."""

    world: FakeWorld | None = None

    def now(self):
        return self.world.time

    def sleep(self, seconds):
        self.world.time += max(0.0, seconds)


def configuration(**changes):
    """A UR10e with a force sensor, two weights and a pull."""
    sections = {
        "robot": Robot(model="ur10e"),
        "tool": Tool(
            target_m=(0.06, 0.02, 0.12),
            load_point_m=(0.05, 0.0, 0.15),
            mass_kg=0.8,
            com_m=(0.01, 0.0, 0.06),
        ),
        "tracker": Tracker(frame="tracker"),
        "repeatability": Repeatability(joint_std_rad=1e-5),
        "loads": (
            CellLoad(name="3kg", mass_kg=3.0, hang_m=0.1),
            CellLoad(name="6kg", mass_kg=6.0, hang_m=0.1),
            CellLoad(name="pull", force_N=(40.0, 0.0, 0.0)),
        ),
        "force_sensor": ForceSensor(driver="fake", port="nowhere"),
        "motion": Motion(speed_rad_s=0.5, acceleration_rad_s2=5.0),
        "acquire": Acquire(samples=3, settle_s=0.2, force_window_s=0.3),
        "limits": Limits(workspace_min_m=(-1.2, -1.2, 0.05), workspace_max_m=(1.2, 1.2, 1.5)),
    }
    return CellConfig(**(sections | changes))


POSES = {
    "reference": (0.0, -1.2, 1.5, -1.5, -1.5, 0.0),
    "p1": (0.5, -1.0, 1.4, -1.2, -1.2, 0.3),
    "p2": (-0.6, -1.4, 1.7, -1.7, -1.9, -0.8),
    "p3": (0.9, -0.9, 1.2, -0.8, -1.6, 1.0),
    "p4": (-0.2, -1.5, 1.9, -2.2, -0.9, 2.0),
}


def plan_of(*steps, poses=None):
    poses = POSES if poses is None else poses
    return Plan(tuple(poses), np.array(list(poses.values())), tuple(Step(*step) for step in steps))


def usual_plan(names=("p1", "p2", "p3", "p4")):
    """Four poses unloaded and under each load, with returns to the reference pose."""
    steps = [("reference", "none", 0), *((p, "none", 0) for p in names)]
    for cycle, load in enumerate(("3kg", "pull"), start=1):
        steps += [(p, load, 0) for p in names]
        steps += [("reference", "none", cycle)]
    return plan_of(*steps)


FEW_POSES = usual_plan(("p1", "p3"))
"""The same with two poses, for what does not depend on how many there are."""


class Bench:
    """Everything that a run needs, in memory."""

    def __init__(self, **changes):
        self.cell = cell_from_config(configuration(**changes))
        start = np.array([0.1, -1.3, 1.6, -1.4, -1.4, 0.1])
        self.world = FakeWorld(self.config, self.cell, start)
        self.store = MemoryStore(self.world)
        self.notes = EventLog()
        self.operator = FakeOperator(self.world)
        force = None if self.config.force_sensor is None else FakeForce(self.world)
        self.rig = Rig(FakeArm(self.world), FakeTracker(self.world), force, self.operator)
        self.clock = FakeClock(world=self.world)

    @property
    def config(self):
        """The configuration of the cell."""
        return self.cell.configured()

    @config.setter
    def config(self, config):
        self.cell = self.cell.with_config(config)

    @property
    def requested_loads(self):
        """Names of the loads that were asked for, in order."""
        return [name for name, _ in self.operator.requests]

    def remarks(self, words=""):
        return [note.text for note in self.notes.of_kind(Remark) if words in note.text]

    def measure(self, plan=None, **more):
        """Run a plan (that of few poses if None) to its end; returns all readings."""
        plan = plan or FEW_POSES
        run(self.rig, self.cell, plan, self.store, self.clock, self.notes, **more)
        readings = self.store.readings()
        return readings

    def interrupt(self, stored, plan=None, **more):
        """Kill a run when so many readings are stored, and start the program anew."""
        self.world.kill_after = ("store.recorded", stored)
        try:
            self.measure(plan, **more)
        except Killed:
            self.world.restart()
        else:
            raise AssertionError("the run came to its end")


def call_before(device, call, action):
    """Have something done before each call of a device, with what the call is given."""
    real = getattr(device, call)

    def first(*given):
        action(*given)
        return real(*given)

    setattr(device, call, first)


def change_result(device, call, by):
    """Have something else returned by each call of a device, made of what it returns."""
    real = getattr(device, call)
    setattr(device, call, lambda *given: by(real(*given)))


def rows(readings, load):
    return readings.load == readings.load_names.index(load)
