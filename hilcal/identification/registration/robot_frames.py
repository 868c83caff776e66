"""The robot's base and flange, defined once for all results of a campaign.

With the constant effects of a fit the arm is a chain of transforms A_k, nominally L_k,

    T_sensor_target = T_sensor_chain A_0 Rz(q_1) A_1 … Rz(q_n) A_n τ

No reading distinguishes a base that stands elsewhere from a first link that is longer or turned, or
from another zero of joint 1. So the base is

- *stated* where the cell states it (a pose of the base in the tracker's frame, or positions in base
  axes). A change of it that the fit finds is then the arm's.
- else *mechanical*: A_0 = L_0, and A_1 has no turn about, and no shift along, the axis of joint 1
  beyond those of L_1. Unlike the base that lets the nominal arm fit the readings best, it depends
  neither on the measured poses nor on the sag of the arm there.

The flange likewise: where the place of no target is stated, A_n = L_n, and A_{n−1} has no turn
about and no shift along the axis of joint n beyond those of L_{n−1}; the targets are placed on it
accordingly. What axes parallel to the first or the last one leave undetermined stays as fitted.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.model.model import Model
from hilcal.readings.readings import FULL_TURN, States
from hilcal.robot import se3
from hilcal.shown import Brief
from hilcal.types import Bools, Floats

TRIALS = 8  # random states at which deviations are tested for being constant; a choice
CONSTANT_TOLERANCE = 1e-15
"""Largest difference of a constant deviation between states, m and rad: rounding."""
WHOLE_TURN_TOLERANCE = 1e-5
"""Largest change of a prediction by a whole turn, m, and of a rotation's elements; a choice, which
a tracker hardly measures: couplings of joints in a background are smaller."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotFrames(Brief):
    """Base, flange and targets of a fitted model."""

    base: Floats  # (4, 4) T_sensor_base
    base_stated: bool  # whether the cell states it; mechanical otherwise
    chain: Floats  # (4, 4) T_base_chain, the fitted chain as moved by the effect of its frame
    registered: Floats  # (4, 4) T_base_registered, the registration where the fit began
    flange: Floats  # (4, 4) T_chainflange_flange
    targets: Floats  # (T, 4, 4) T_flange_target as fitted
    declared: Floats  # (T, 4, 4) the same as stated where all of them are, else as fitted
    links: Floats  # (n + 1, 4, 4) the arm with its constant effects, from base to flange
    constant_effects: tuple[str, ...]  # effects that are constant, and so in `links`
    other_effects: tuple[str, ...]  # effects that are not

    @property
    def base_is(self) -> str:
        """How the base is known: "stated" or "mechanical"."""
        return "stated" if self.base_stated else "mechanical"


def robot_frames(model: Model, theta: Floats) -> RobotFrames:
    """Return base, flange and targets of a model with parameters (P,)."""
    cell, nominal = model.cell, model.cell.arm.links
    moved, targets = _fitted(model, theta)
    stated = all(cell.known_targets)
    links, within, beyond = _constant(model, theta)
    if cell.registration_known:
        base = cell.registration
        links[0] = moved @ links[0]
    else:
        first, links[1] = _split(links[1], nominal[1])
        base = cell.registration @ moved @ links[0] @ first @ se3.inverse(nominal[0])
        links[0] = nominal[0]
    if stated:  # a fitted offset is then the flange's
        flange = targets[0] @ se3.inverse(cell.all_targets[0])
        links[-1] = links[-1] @ flange
    elif any(cell.known_targets):
        flange = np.eye(4)
    else:
        flange, links[-2] = nominal_flange(links, nominal)
        targets = se3.product(se3.inverse(flange)[None], targets)
        links[-1] = nominal[-1]
    registered = se3.inverse(base) @ cell.registration
    return RobotFrames(
        base=base,
        base_stated=cell.registration_known,
        registered=registered,
        chain=registered @ moved,
        flange=flange,
        targets=targets,
        declared=cell.all_targets if stated else targets,
        links=links,
        constant_effects=within,
        other_effects=beyond,
    )


def nominal_flange(links: Floats, nominal: Floats) -> tuple[Floats, Floats]:
    """Return T_chainflange_flange (4, 4) of the nominal flange, and the link before joint n then.

    Both `links` (n + 1, 4, 4), those of a fit and the nominal ones, end at their own flange.
    """
    last, remainder = _split(se3.inverse(links[-2]), se3.inverse(nominal[-2]))
    return se3.inverse(links[-1]) @ last @ nominal[-1], se3.inverse(remainder)


def whole_turns(model: Model, theta: Floats) -> Bools:
    """Return for each of the n joints whether a whole turn leaves predictions unchanged.

    Kinematics and periodic laws repeat; a law in the angle itself, such as a coupling, does not.
    """
    states, n = random_states(model.cell), model.cell.arm.n
    reference = model.predict(states, theta).observation
    out = np.zeros(n, dtype=np.bool_)
    for j in np.flatnonzero(~model.cell.arm.slides).tolist():
        q = states.q + FULL_TURN * np.eye(n)[j]
        turned = model.predict(replace(states, q=q), theta).observation
        moved = np.abs(turned.position - reference.position).max()
        out[j] = (
            max(moved, np.abs(turned.rotation - reference.rotation).max()) <= WHOLE_TURN_TOLERANCE
        )
    return out


def state_with_every_column(cell: Cell) -> States:
    """Return one state that has every column, for effects that are built without readings."""
    scalar, joints = np.zeros(1), np.zeros((1, cell.arm.n))
    return States(
        q=joints,
        wrench=np.zeros((1, 6)),
        time=scalar,
        load_time=scalar,
        air_temperature=scalar,
        joint_temperature=joints,
        approach=joints + 1,
    )


def _fitted(model: Model, theta: Floats) -> tuple[Floats, Floats]:
    """Return the fitted base in its registration (4, 4), and all targets (T, 4, 4)."""
    cell, targets = model.cell, model.cell.all_targets.copy()
    states = state_with_every_column(cell)[np.zeros(len(targets), dtype=np.int64)]
    if cell.targets is not None:
        states = replace(states, target=np.arange(len(targets)))
    situation, base = model.predict(states, 0 * theta).situation, np.zeros(6)
    for e, rows in zip(model.effects, model.slices(), strict=True):
        if e.role not in FRAME_ROLES:
            continue
        d = e.deviation(theta[rows], situation)
        if e.role == "registration" and d.base is not None:
            base = base + d.base[0]
        if e.role == "target" and d.target is not None:
            targets[:, :3, 3] += d.target[:, :3]
            targets[:, :3, :3] = se3.rotation(d.target[:, 3:]) @ targets[:, :3, :3]
    return se3.matrix(*se3.exp(base)), targets


def _constant(model: Model, theta: Floats) -> tuple[Floats, tuple[str, ...], tuple[str, ...]]:
    """Return the links (n + 1, 4, 4) with the constant effects, their names, and the other names.

        A_k = L_k exp(ξ_k) M(dq_{k+1}),      A_n = L_n exp(ξ_n)

    An effect is constant whose deviation is the same in random states under random loads.
    """
    arm = model.cell.arm
    dq, twist = np.zeros(arm.n), np.zeros((arm.n + 1, 6))
    within, beyond = [], []
    situation = model.predict(random_states(model.cell), 0 * theta).situation
    for e, rows in zip(model.effects, model.slices(), strict=True):
        if e.role in FRAME_ROLES:
            continue
        d = e.deviation(theta[rows], situation)
        frames = (d.base, d.station, d.target, d.scale, d.observer)
        moves_frames = any(f is not None for f in frames)
        parts = [part for part in (d.dq, d.twist) if part is not None]
        constant = not e.elastic and all(
            np.abs(x - x[:1]).max() <= CONSTANT_TOLERANCE for x in parts
        )
        if not constant or moves_frames or d.dq is d.twist:
            beyond.append(e.name)
            continue
        within.append(e.name)
        dq = dq if d.dq is None else dq + d.dq[0]
        twist = twist if d.twist is None else twist + d.twist[0]
    moved = arm.driven(dq)
    turns, shifts = np.zeros((2, arm.n + 1, 3))
    turns[: arm.n, 2], shifts[: arm.n, 2] = moved * ~arm.slides, moved * arm.slides
    links = arm.links @ se3.matrix(*se3.exp(twist)) @ se3.matrix(se3.rotation(turns), shifts)
    return links, tuple(within), tuple(beyond)


def random_states(cell: Cell) -> States:
    """Return random states under random loads, with every column."""
    n, rng = cell.arm.n, np.random.default_rng(20250308)
    return States(
        q=rng.uniform(-2, 2, (TRIALS, n)),
        wrench=rng.uniform(-30, 30, (TRIALS, 6)),
        time=rng.uniform(0, 1e4, TRIALS),
        load_time=rng.uniform(0, 1e3, TRIALS),
        air_temperature=rng.uniform(15, 30, TRIALS),
        joint_temperature=rng.uniform(15, 50, (TRIALS, n)),
        approach=np.sign(rng.standard_normal((TRIALS, n))),
    )


def _split(link: Floats, nominal: Floats) -> tuple[Floats, Floats]:
    """Split a link into Rz Tz and a remainder with the turn and the shift of the nominal link."""
    m = link @ se3.inverse(nominal)
    turn = np.arctan2(m[1, 0] - m[0, 1], m[0, 0] + m[1, 1])
    along = np.array([0.0, 0.0, link[2, 3] - nominal[2, 3]])
    first = se3.matrix(se3.rotation(np.array([0.0, 0.0, turn])), along)
    return first, se3.inverse(first) @ link
