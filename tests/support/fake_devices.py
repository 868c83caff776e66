"""Devices in memory that share one small world."""

from dataclasses import dataclass, field

import numpy as np

from hilcal.config import CellLoad
from hilcal.measuring.devices import (
    ArmSample,
    Clock,
    Losses,
    Report,
    TargetLostError,
    TrackerSample,
    WrenchSample,
)
from hilcal.types import Floats
from tests.support.fake_world import World

STD = 1e-5  # m, of one measurement
TORQUE = np.array([3.0, -40.0, 20.0, 5.0, 1.0, -0.5])  # N·m, of every pose


@dataclass
class FakeArm:
    """An arm that moves in straight lines."""

    world: World

    def report(self) -> Report:
        return Report("arm", "fake")

    def sample(self) -> ArmSample:
        w = self.world
        w.call("arm.sample")
        q = w.joints()
        speed = (w.goal - w.start) / w.lasts / w.hurried if w.is_moving else np.zeros(6)
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

    def take_control(self, mass: float, com: Floats) -> None:
        self.world.call("arm.take_control")
        self.world.control, self.world.payload = True, (mass, com)

    def set_payload(self, mass: float, com: Floats) -> None:
        self.world.call("arm.set_payload")
        assert self.world.control
        assert not self.world.is_moving
        self.world.payload = (mass, com)

    def start_move(self, q: Floats, speed: float, acceleration: float) -> None:
        w = self.world
        w.call("arm.start_move")
        assert w.control, "a motion without control"
        w.start, w.goal, w.begun = w.joints().copy(), q.copy(), w.time
        way = float(np.abs(w.goal - w.start).max())
        w.hurried = w.hurry
        w.lasts = max(way / speed / w.hurry, 1e-6)
        w.is_moving = True
        w.at_start.append((q.copy(), w.load))

    def moving(self) -> bool:
        self.world.call("arm.moving")
        self.world.joints()
        return self.world.is_moving

    def stop(self) -> None:
        self.world.call("arm.stop")
        self.world.joints()
        self.world.is_moving = False

    def close(self) -> None:
        self.world.is_moving = self.world.control = False


@dataclass
class FakeTracker:
    """A tracker with white noise."""

    world: World

    def report(self) -> Report:
        return Report("tracker", "fake")

    def measure(self) -> TrackerSample:
        w = self.world
        w.call("tracker.measure")
        w.time += 0.1
        if w.lost > 0:
            w.lost -= 1
            raise TargetLostError("tracker: the beam is broken")
        assert not w.is_moving, "measured in motion"
        value = w.position() + STD * w.rng.standard_normal(3)
        return TrackerSample(int(w.time * 1e9), value, STD**2 * np.eye(3))

    def find_target(self) -> None:
        w = self.world
        w.call("tracker.find_target")
        w.time += 1.0
        if w.not_found > 0:
            w.not_found -= 1
            raise TargetLostError("tracker: no target found")

    def close(self) -> None:
        return


@dataclass
class FakeForce:
    """A force sensor of 100 Hz."""

    world: World

    def report(self) -> Report:
        return Report("force sensor", "fake")

    def latest(self) -> WrenchSample:
        self.world.call("force.latest")
        return self._sample(1)

    def average(self, seconds: float) -> WrenchSample:
        self.world.call("force.average")
        self.world.time += seconds
        return self._sample(int(100 * seconds))

    def _sample(self, frames: int) -> WrenchSample:
        covariance = np.diag([0.01] * 3 + [1e-4] * 3) if frames > 1 else np.zeros((6, 6))
        return WrenchSample(int(self.world.time * 1e9), self.world.wrench(), covariance, frames)

    def losses(self) -> Losses:
        return Losses(1000, 0, 0, 0)

    def close(self) -> None:
        return


@dataclass
class FakeOperator:
    """Hangs what it is asked for, or what `World.wrong` says."""

    world: World
    asked: list[tuple[str, str]] = field(default_factory=list)

    def report(self) -> Report:
        return Report("operator", "fake")

    def hang(self, load: CellLoad | None, why: str) -> None:
        w = self.world
        w.call("operator.hang")
        assert not w.is_moving, "a person asked to work at a moving arm"
        name = "none" if load is None else load.name
        self.asked.append((name, why))
        w.time += 20.0
        w.load = w.wrong.pop(0) if w.wrong else name

    def confirm(self, question: str) -> None:
        self.world.call("operator.confirm")
        assert not self.world.is_moving, "a person asked to look at a moving arm"
        self.asked.append(("confirm", question))

    def close(self) -> None:
        return


@dataclass(frozen=True)
class FakeClock(Clock):
    """The world's time."""

    world: World | None = None

    def now(self) -> float:
        assert self.world is not None
        return self.world.time

    def sleep(self, seconds: float) -> None:
        assert self.world is not None
        self.world.time += max(0.0, seconds)
