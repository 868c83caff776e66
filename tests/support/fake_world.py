"""A small world in memory: arm, load and time; every call to a device can be made to fail.

Time stands still but for what the devices and the waiting take, so that everything is the same
on every run.
"""

from dataclasses import dataclass, field

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.types import Floats

REGISTRATION = se3.matrix(se3.rotation(np.array([0.02, -0.03, 2.1])), np.array([2.4, -1.6, -0.5]))
SAG = 2e-5  # m/N, how far the target gives way along the force


class Killed(BaseException):
    """The process is killed: nothing that it does from now on reaches anybody."""


@dataclass
class World:
    """Arm, load and time, and the calls that reached any device."""

    config: CellConfig
    cell: Cell
    q: Floats
    time: float = 100.0
    start: Floats = field(default_factory=lambda: np.zeros(6))
    goal: Floats = field(default_factory=lambda: np.zeros(6))
    begun: float = 0.0
    lasts: float = 0.0
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
    lost: int = 0  # the next so many measurements see no target
    not_found: int = 0  # the next so many searches find none
    wrong: list[str] = field(default_factory=list)  # loads that are hung instead, in order
    at_start: list[tuple[Floats, str]] = field(default_factory=list)  # load at each motion
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(5))

    def call(self, name: str) -> None:
        """Count a call; fail where that is wanted."""
        if self.killed:
            raise Killed
        self.calls.append(name)
        k = len(self.calls)
        last = self.kill_after is not None and self.kill_after[0] == name
        if last and self.calls.count(name) == self.kill_after[1]:  # type: ignore[index]
            self.kill_at = k
        if self.kill_at == k:
            self.killed = True
            raise Killed
        if k in self.fail:
            raise self.fail[k]

    def again(self) -> None:
        """Start the program anew: the arm has stopped where it was, the load still hangs."""
        self.joints()
        self.is_moving = self.control = self.killed = False
        self.kill_at = self.kill_after = None
        self.fail = {}
        self.calls.clear()

    def joints(self) -> Floats:
        """Where the joints are now, rad."""
        if self.is_moving:
            share = min(1.0, (self.time - self.begun) / self.lasts)
            self.q = self.start + share * (self.goal - self.start)
            self.is_moving = share < 1.0
        return self.q

    def pull(self) -> Floats:
        """(6,) wrench of the load at the load point, base axes."""
        for load in self.config.loads:
            if load.name == self.load:
                return load.wrench(self.cell.gravity)
        return np.zeros(6)

    def position(self) -> Floats:
        """(3,) target in sensor axes."""
        chain = chains.evaluate(self.cell.arm, self.joints()[None])
        at = chain.point(self.cell.target[:3, 3])[0] + SAG * self.pull()[:3] + self.shift
        return REGISTRATION[:3, :3] @ at + REGISTRATION[:3, 3] + self.creep * self.time

    def wrench(self) -> Floats:
        """(6,) what the sensor reads, sensor axes (those of the flange)."""
        rotation = chains.evaluate(self.cell.arm, self.joints()[None]).rotation[-1][0]
        force = rotation.T @ (self.tool_mass * self.cell.gravity)
        out = np.concatenate([force, np.cross(self.cell.tool_com, force)])
        pull = self.pull()
        f, m = rotation.T @ pull[:3], rotation.T @ pull[3:]
        out += np.concatenate([f, m + np.cross(self.cell.load_point, f)])
        return out + self.offset + self.extra
