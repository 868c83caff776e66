"""A bench in memory: cell, plans and everything that a run needs."""

from typing import Any

import numpy as np

from hilcal.cell import cell_from_config
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
from hilcal.store.plan import Plan, Step
from tests.support.fake_devices import FakeArm, FakeClock, FakeForce, FakeOperator, FakeTracker
from tests.support.fake_store import MemoryStore, Notes
from tests.support.fake_world import World


def configuration(**changes: Any) -> CellConfig:
    """A UR10e with a force sensor, two weights and a pull."""
    sections: dict[str, Any] = {
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


def plan_of(*steps: tuple[str, str, int], poses: dict[str, Any] | None = None) -> Plan:
    """A plan with steps over `POSES`."""
    poses = POSES if poses is None else poses
    return Plan(tuple(poses), np.array(list(poses.values())), tuple(Step(*step) for step in steps))


def usual_plan() -> Plan:
    """Four poses unloaded and under each load, with returns to the reference pose."""
    names = ("p1", "p2", "p3", "p4")
    steps = [("reference", "none", 0), *((p, "none", 0) for p in names)]
    for cycle, load in enumerate(("3kg", "pull"), start=1):
        steps += [(p, load, 0) for p in names]
        steps += [("reference", "none", cycle)]
    return plan_of(*steps)


class Bench:
    """Everything that a run needs, in memory."""

    def __init__(self, **changes: Any) -> None:
        self.config = configuration(**changes)
        self.cell = cell_from_config(self.config)
        start = np.array([0.1, -1.3, 1.6, -1.4, -1.4, 0.1])
        self.world = World(self.config, self.cell, start)
        self.store = MemoryStore(self.world)
        self.notes = Notes()
        self.operator = FakeOperator(self.world)
        force = None if self.config.force_sensor is None else FakeForce(self.world)
        self.rig = Rig(FakeArm(self.world), FakeTracker(self.world), force, self.operator)
        self.clock = FakeClock(world=self.world)
