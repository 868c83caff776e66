"""A small simulated cell for what lives in it, and the elastic arm by plain matrix products."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.injected_effects import world_without_effect
from hilcal.drivers.simulated.truth import Truth
from hilcal.drivers.simulated.world_server import WorldState
from hilcal.readings.readings import States
from tests.support.arm_cases import arm_of
from tests.support.example_cell import ur10e_arm


def turn(axis, angle):
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler(axis, angle).as_matrix()
    return out


def frames(arm, q, base=(0, 0, 0), tilt=None, beam=None):
    """Body frames, joint frames and flange of the elastic arm, by plain matrix products."""
    tilt = np.zeros((arm.n, 2)) if tilt is None else tilt
    place = turn("x", base[0]) @ turn("y", base[1]) @ turn("z", base[2]) @ arm.links[0]
    bodies, slots = [], []
    for j in range(arm.n):
        place = place @ turn("x", tilt[j, 0]) @ turn("y", tilt[j, 1])
        slots.append(place)
        place = place @ turn("z", q[j])
        bodies.append(place)
        if beam is not None and j + 1 in beam:
            place = place @ bent(arm.links[j + 1], beam[j + 1])
        else:
            place = place @ arm.links[j + 1]
    return bodies, slots, place


def bent(link, give):
    """A link whose tip is displaced: (y, z, turn x, y, z) in axes with x along the beam."""
    x = link[:3, 3] / np.linalg.norm(link[:3, 3])
    y = np.cross(np.eye(3)[int(np.argmin(np.abs(x)))], x)
    y /= np.linalg.norm(y)
    axes = np.eye(4)
    axes[:3, :3] = np.column_stack([x, y, np.cross(x, y)])
    tip = np.eye(4)
    tip[:3, 3] = link[:3, 3]
    shift = np.eye(4)
    shift[1:3, 3] = give[:2]
    rotate = turn("x", give[2]) @ turn("y", give[3]) @ turn("z", give[4])
    rest = np.eye(4)
    rest[:3, :3] = link[:3, :3]
    return tip @ axes @ shift @ rotate @ np.linalg.inv(axes) @ rest


def moment_beyond(cell, q, wrench, j):
    """The moment at joint j of weight and load beyond it, and its axis; undeflected arm."""
    bodies, slots, flange = frames(cell.arm, q)
    point = slots[j][:3, 3]
    total = wrench[3:].copy()
    where = flange[:3, :3] @ cell.load_point + flange[:3, 3]
    total += np.cross(where - point, wrench[:3])
    tool = flange[:3, :3] @ cell.tool_com + flange[:3, 3]
    total += np.cross(tool - point, cell.tool_mass * cell.gravity)
    for i in range(j, cell.arm.n):
        com = bodies[i][:3, :3] @ cell.arm.coms[i] + bodies[i][:3, 3]
        total += np.cross(com - point, cell.arm.masses[i] * cell.gravity)
    return total, slots[j][:3, 2], point, where


def remaining_effects(seed):
    """A bit of the effects that `every_effect` has not, all numbers odd."""
    rng, rigid = np.random.default_rng(seed), Truth.rigid(ur10e_arm())
    size = {
        "tool_compliance": 1e-5,
        "periodic_joint_compliance": 1e-6,
        "backlash": 5e-5,
        "creep": 3e-2,
        "thermal_growth": 2e-5,
        "thermal_joint_drift": 5e-6,
        "link_mass": 2e-1,
        "wrench_bias": 1.0,
        "wrench_gain": 2e-2,
        "sensor_misalignment": 2e-2,
        "tracker_scale": 5e-6,
    }
    return {n: s * rng.uniform(0.5, 1.0, getattr(rigid, n).shape) for n, s in size.items()}


Q = np.array([0.3, -1.1, 1.4, 0.5, -0.7, 0.2])
SIDE = np.array([1.0, -1.0, 1.0, 1.0, -1.0, -1.0])
CLOCK = 20.0


def config(**sections):
    """A UR10e with two loads; further sections as given."""
    content = {
        "robot": {"model": "ur10e"},
        "tool": {
            "target_m": [0.06, 0.02, 0.12],
            "load_point_m": [0.1, -0.03, 0.15],
            "mass_kg": 0.8,
            "com_m": [0.01, 0.02, 0.06],
        },
        "loads": [
            {"name": "5kg", "mass_kg": 5.0},
            {"name": "pull", "force_N": [80.0, 10.0, 0.0], "moment_Nm": [0.0, 6.0, -3.0]},
        ],
        "simulation": {"clock": CLOCK},
    }
    return CellConfig.model_validate({**content, **sections})


def world_of(made, seed=1, joint_std=1e-5, **hidden):
    """The world of a configuration with the given parts of its truth."""
    rng = np.random.default_rng(seed)
    world = world_without_effect(cell_from_config(made), rng, joint_std=joint_std)
    return replace(world, physics=replace(world.physics, **hidden))


class RunningWorld:
    """A living world in this process, with a controller that does what the test says."""

    def __init__(self, world, made, path, seed=5):
        self.world = world
        self.board = Blackboard.create(path / "world.bin", made.simulation.clock)
        self.living = WorldState(world, made, self.board, seed)
        self.arrivals = 0
        self.now_ns = 0

    def rest_at(self, q):
        """Let the arm arrive, and return the truth."""
        self.arrivals += 1
        fields = {"q": q, "side": SIDE, "arrivals": self.arrivals, "moving": 0.0, "alive": 1.0}
        self.board.write("arm", **fields)
        return self.truth_after()

    def truth_after(self, seconds=1.0):
        """Let the world look once, so many real seconds later, and return the truth."""
        self.now_ns += round(seconds * 1e9)
        self.living.step(self.now_ns)
        return self.board.read("truth")


def states(q, wrench, time):
    return States(
        q=np.asarray(q)[None],
        wrench=np.asarray(wrench, dtype=float)[None],
        time=np.array([time]),
        load_time=np.zeros(1),
        approach=SIDE[None],
    )


WEIGHT = np.array([0.0, 0.0, -5.0 * 9.80665, 0.0, 0.0, 0.0])
PULL = np.array([80.0, 10.0, 0.0, 0.0, 6.0, -3.0])


def every_effect(rng):
    """A bit of every effect, all numbers odd."""
    arm = arm_of("ur10e")
    rigid = Truth.rigid(arm, harmonics=3)
    size = {
        "joint_compliance": 1e-5,
        "joint_tilt_compliance": 4e-6,
        "base_compliance": 2e-6,
        "link_compliance": 8e-6,
        "hysteresis": 5e-5,
        "encoder_offset": 2e-4,
        "joint_coupling": 1e-4,
        "transmission_error": 1e-4,
        "link_geometry": 3e-4,
        "load_point": 5e-3,
        "target_offset": 5e-3,
        "base_frame": 1e-3,
        "tracker_drift": 1e-8,
    }
    return {n: s * rng.uniform(0.5, 1.0, getattr(rigid, n).shape) for n, s in size.items()}


def running_world(tmp_path, joint_std=1e-5, sections=None, **hidden):
    made = config(**(sections or {}))
    return RunningWorld(world_of(made, joint_std=joint_std, **hidden), made, tmp_path)


def same_bytes(a, b):
    return np.asarray(a).tobytes() == np.asarray(b).tobytes()
