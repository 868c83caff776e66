"""Random campaigns: well-spread poses, loads on them, and readings."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.drivers.simulated.rehearsal import (
    CampaignStates,
    Rehearsal,
    measurement_noise,
    simulate,
    simulation_case,
)
from hilcal.drivers.simulated.truth import Truth
from hilcal.drivers.simulated.world import SimulatedNoise, World
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Bools, Floats, Ints
from studies.temperatures import air, joints

POSES = 30
UNLOADED = "none"
_READING = 20.0  # s from one reading to the next
_LOADING = 30.0  # s, change of the load
_MOVING = 15.0  # s, motion to the next pose
_SETTLING = (5.0, 300.0)  # s, time under load at a reading
_MARGIN = 0.9  # share of the joint range and of the torque limits that is used
_CANDIDATES = 12  # drawn poses per chosen pose
_ROUNDS = 60


def rehearsal_states(
    cell: Cell,
    n_poses: int,
    wrenches: Sequence[tuple[str, Floats]],
    rng: np.random.Generator,
    *,
    approach: bool = True,
    cycles: int = 1,
    temperatures: bool = True,
) -> tuple[States, Ints, Ints, Ints]:
    """Plan a campaign without any device: each pose unloaded, then under each load.

    Poses are feasible (joint and torque limits with a margin, the target and every joint
    above the floor, away from the base's column, not stretched out) and spread over the
    joint space. A joint's approach side is the direction of its last motion: that of the
    move to the pose or, for about half of the joints after a change of the load, that of
    the change of torque. The time under load is log-uniform from 5 s to 300 s.

    Args:
        cell: the cell.
        n_poses: number of poses.
        wrenches: (name, wrench (6,)) of each load at the load point, base axes, N and N·m.
        rng: generator.
        approach: whether the states have approach sides.
        cycles: number of times that all poses are measured.
        temperatures: whether the states have temperatures of air and joints; these have a separate
            generator, so that everything else is the same without them.

    Returns:
        The N = cycles * n_poses * (1 + loads) states with time, load time, approach and
        temperatures, and the (N,) indices of pose, load (0 is unloaded) and cycle.

    Raises:
        InputError: a wrong number or wrench, or no feasible poses.
    """
    pulls = _pulls(wrenches)
    if n_poses < 1 or cycles < 1:
        raise InputError(f"{n_poses} poses in {cycles} cycles; valid: at least one of each")
    poses = spread_poses(cell, n_poses, pulls, rng)
    loads = len(pulls)
    pose = np.tile(np.repeat(np.arange(n_poses), loads), cycles)
    load = np.tile(np.arange(loads), n_poses * cycles)
    cycle = np.repeat(np.arange(cycles), n_poses * loads)
    changes = np.diff(load, prepend=0) != 0
    moves = load == 0
    torque = np.stack([_rigid(cell, poses, pull)[1] for pull in pulls], axis=1)
    sides = _sides(poses[pose], torque[pose, load], moves, rng)
    shortest, longest = _SETTLING
    hung = shortest * (longest / shortest) ** rng.random(len(pose))
    duration = _READING + _LOADING * changes + _MOVING * moves
    time = np.cumsum(np.maximum(duration, (hung + _LOADING) * changes))
    changed = np.maximum.accumulate(np.where(changes, time - hung, time[0] - hung[0]))
    states = States(
        q=poses[pose],
        wrench=pulls[load],
        time=time,
        load_time=time - changed,
        approach=sides if approach else None,
    )
    if temperatures:
        (apart,) = rng.spawn(1)
        states = replace(
            states,
            air_temperature=air(time, apart),
            joint_temperature=joints(time, cell.arm.n, apart),
        )
    return states, pose, load, cycle


def spread_poses(cell: Cell, count: int, pulls: Floats, rng: np.random.Generator) -> Floats:
    """Return (count, n) feasible joint angles, each far from the others, rad.

    Args:
        cell: the cell.
        count: number of poses.
        pulls: (L, 6) wrenches that every pose must bear.
        rng: generator.

    Raises:
        InputError: too few feasible poses within the limits.
    """
    low = _MARGIN * np.maximum(cell.arm.q_min, -np.pi)
    high = _MARGIN * np.minimum(cell.arm.q_max, np.pi)
    feasible = np.empty((0, cell.arm.n))
    for _ in range(_ROUNDS):
        if len(feasible) >= _CANDIDATES * count:
            break
        drawn = rng.uniform(low, high, (max(4 * count, 60), cell.arm.n))
        feasible = np.vstack([feasible, drawn[_feasible(cell, drawn, pulls)]])
    if len(feasible) < count:
        raise InputError(
            f"poses: only {len(feasible)} of {count} feasible poses in the joint limits under "
            "these loads; valid: fewer poses, lighter loads or wider limits"
        )
    # The next pose is always the candidate farthest from all chosen ones.
    points = np.hstack([np.cos(feasible), np.sin(feasible)])
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.asarray(feasible[chosen])


def _feasible(cell: Cell, q: Floats, pulls: Floats) -> Bools:
    """Return (N,) which joint angles an arm on a table could take."""
    arm = cell.arm
    place = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    origins = []
    for k in range(arm.n + 1):
        place = place @ arm.links[k]
        origins.append(place[:, :3, 3])
        if k < arm.n:
            place = place @ _about_z(q[:, k])
    target = (place @ cell.target)[:, :3, 3]
    load = (place[:, :3, :3] @ cell.load_point) + place[:, :3, 3]
    outer = [*origins[arm.n // 2 :], target, load]
    reach = arm.reach
    good = (target[:, 2] > 0.1) & (load[:, 2] > 0.1)
    for point in outer:
        column = np.hypot(point[:, 0], point[:, 1])
        good &= (point[:, 2] > 0.05 * reach) & (column > 0.12 * reach)
    good &= np.linalg.norm(target - origins[0], axis=1) > 0.25 * reach
    shoulder = origins[min(1, arm.n)]
    good &= np.linalg.norm(origins[arm.n] - shoulder, axis=1) < 0.85 * reach
    limit = np.asarray(arm.torque_max, dtype=float)
    rows = np.flatnonzero(good)
    every = np.tile(q[rows], (len(pulls), 1)), np.repeat(pulls, len(rows), axis=0)
    torque = np.abs(_rigid(cell, *every)[1]).reshape(len(pulls), len(rows), arm.n)
    good[rows] = np.all(torque <= _MARGIN * limit, axis=(0, 2))
    return good


def _rigid(cell: Cell, q: Floats, pull: Floats) -> tuple[Floats, Floats]:
    """Return flange poses (N, 4, 4) and drive torques (N, n) of the rigid arm, N·m.

    `pull`: (6,) or (N, 6) wrench.
    """
    origin, none = np.eye(4), np.zeros(cell.arm.n)
    rigid = World(cell, Truth.rigid(cell.arm), origin, origin, SimulatedNoise(), none)
    rest = rigid.equilibrium(States(q=q, wrench=np.broadcast_to(pull, (len(q), 6))))
    return rest.flange, rest.torque[:, rigid.drives]


def _sides(q: Floats, torque: Floats, moves: Bools, rng: np.random.Generator) -> Floats:
    """Return the (N, n) approach sides, -1 or +1, of a sequence of readings."""
    out = np.empty_like(q)
    last_q = np.zeros(q.shape[1])
    side = rng.choice([-1.0, 1.0], q.shape[1])
    slips = rng.random(q.shape) < 0.5
    for i in range(len(q)):
        if moves[i]:
            moved = q[i] - last_q
            side = np.where(moved != 0.0, np.sign(moved), side)
        else:
            change = torque[i] - torque[i - 1]
            side = np.where(slips[i] & (np.abs(change) > 1e-6), np.sign(change), side)
        out[i], last_q = side, q[i]
    return out


def _pulls(wrenches: Sequence[tuple[str, Floats]]) -> Floats:
    """Return the (1 + L, 6) wrenches, the unloaded one first."""
    rows = [np.zeros(6)]
    for name, wrench in wrenches:
        value = np.asarray(wrench, dtype=float)
        if value.shape != (6,) or not np.all(np.isfinite(value)):
            raise InputError(f"load {name!r}: wrench {value.tolist()}; valid: six finite numbers")
        if name == UNLOADED:
            raise InputError(f"load {name!r} is the unloaded state; valid: another name")
        rows.append(value)
    return np.array(rows)


def _about_z(angle: Floats) -> Floats:
    """Return (N, 4, 4) rotations about z."""
    out = np.zeros((len(angle), 4, 4))
    cos, sin = np.cos(angle), np.sin(angle)
    out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1] = cos, -sin, sin, cos
    out[:, 2, 2] = out[:, 3, 3] = 1.0
    return out


def rehearse(config: CellConfig, choice: str, seed: int, n_poses: int = POSES) -> Rehearsal:
    """Measure a campaign in a simulated cell: each pose unloaded, then under each load.

    The program gets a known registration only where the error is in it. Effects that deflections
    show are measured in deflections, others in absolute positions. "random" and "nothing" are
    measured in absolute positions, so that the mode gives no hint.

    Args:
        config: the cell; its loads are all used.
        choice: an effect of `choices()`, "random" or "nothing".
        seed: of everything random.
        n_poses: number of poses.

    Raises:
        InputError: an unknown choice; lists the valid ones. No loads in the configuration.
    """
    if not config.loads:
        raise InputError("the cell has no [[loads]]; such a campaign needs at least one")
    rng = np.random.default_rng(seed)
    visits: list[CampaignStates] = []

    def visit(cell: Cell) -> CampaignStates:
        pulls = [(load.name, load.wrench(cell.gravity)) for load in config.loads]
        visits.append(CampaignStates(*rehearsal_states(cell, n_poses, pulls, rng)))
        return visits[0]

    s = simulation_case(config, choice, rng, visit, measurement_noise(config))
    names = ("none", *(load.name for load in config.loads))
    v = visits[0]
    readings = simulate(s.world, v.states, v.pose, v.load, v.cycle, names, rng)
    return Rehearsal(s.cell, s.mode, s.world, s.hidden, s.strength_sigma, readings)
