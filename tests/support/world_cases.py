"""The elastic arm by plain matrix products, for the tests of the simulated world."""

import numpy as np
from scipy.spatial.transform import Rotation

from hilcal.drivers.simulated.truth import Truth
from tests.support.example_cell import ur10e_arm


def rz(angle):
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
    return out


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
        place = place @ rz(q[j])
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


def further(seed):
    """A bit of the effects that `living_cell.everything` has not, all numbers odd."""
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
