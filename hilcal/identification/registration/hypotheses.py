"""Possible errors of a description of an arm and its readings, in words and as changes of it."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np

from hilcal.cell import Cell
from hilcal.config.sections import Conventions
from hilcal.robot import se3
from hilcal.robot.arm import Arm, possible_couplings, with_controller_conventions, with_conventions
from hilcal.robot.catalogue import load_arm, other_arms
from hilcal.types import Bools, Floats

SHIFTS = (1, -1, 2, -2)  # rows by which joints and positions are tried against each other
MIRROR = np.array([1.0, -1.0, 1.0])
LARGEST = 4 * np.pi  # rad; no joint is commanded further


@dataclass(frozen=True, slots=True, eq=False)
class Description:
    """Arm and readings as they are described."""

    arm: Arm
    q: Floats  # (N, n) joint values, rad
    value: Floats  # (N, 3) positions, m
    turn: Floats | None  # (N, 3) rotation vectors of the attitudes, rad
    base_unknown: bool
    target_unknown: bool
    shift: int = 0  # by how many rows the joint values come after their positions
    conventions: Conventions | None = None  # how the controller counts any arm's joints

    @property
    def paired(self) -> Bools:
        """(N,) rows that have joint values and a position under the shift."""
        k = np.arange(len(self.q)) + self.shift
        return (k >= 0) & (k < len(self.q))


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One possible error of the description."""

    kind: str  # key of `KINDS`
    joint: int = 0  # number from 1, where it is about one; negative: about all others
    sign: int = 1  # −1 where the joint turns the other way
    offset: float = 0.0  # of its zero, rad: the chain turns by sign q + offset
    follows: int = 0  # number of the joint that it follows, from 1; with `factor`
    factor: float = 0.0  # of the coupling
    arm: str = ""  # another arm of the catalogue
    shift: int = 0  # as of `Description`
    order: tuple[int, ...] = ()  # column, from 1, that holds the values of each joint

    @property
    def is_zero(self) -> bool:
        """Whether it is only the zero of a joint, off by other than quarter turns."""
        quarters = self.offset / (np.pi / 2)
        return self.kind == "joint" and self.sign > 0 and abs(quarters - round(quarters)) > 0.02

    @property
    def cost(self) -> int:
        """Number of changes: another zero together with the other sign counts two."""
        return 1 + (self.kind == "joint" and self.sign < 0 and self.offset != 0.0)

    @property
    def subject(self) -> tuple[str, int, int]:
        """The subject; two hypotheses on one subject are not combined."""
        return self.kind, self.joint, self.follows

    def applied(self, d: Description) -> Description:
        """Return arm and readings under this hypothesis."""
        return KINDS[self.kind].applied(d, self)

    @property
    def words(self) -> str:
        """What is wrong, in a phrase."""
        phrase = KINDS[self.kind].words
        return phrase if isinstance(phrase, str) else phrase(self)


Applied = Callable[[Description, Hypothesis], Description]
Combination = tuple[Hypothesis, ...]  # tried together


@dataclass(frozen=True, slots=True)
class HypothesisKind:
    """A row of the table."""

    applied: Applied  # arm and readings under a hypothesis
    words: str | Callable[[Hypothesis], str]  # what is wrong, in a phrase
    correction: str | None = None  # line of CELL.toml; '': `robot_keys` says it; None: in the table


def _recounted(d: Description, h: Hypothesis) -> Description:
    n, j = d.arm.n, h.joint - 1
    sign, offset, coupling = np.ones(n), np.zeros(n), np.zeros((n, n))
    sign[j], offset[j] = h.sign, h.offset
    if h.follows:
        coupling[j, h.follows - 1] = h.factor
    return replace(d, arm=with_conventions(d.arm, sign, offset, coupling))


def _another_arm(d: Description, h: Hypothesis) -> Description:
    arm = load_arm(h.arm)
    return replace(
        d, arm=arm if d.conventions is None else with_controller_conventions(arm, d.conventions)
    )


def _mapped(name: str, change: Callable[[Any], Any]) -> Applied:
    """Return a change of one attribute of the description, unless that is None."""

    def applied(d: Description, _: Hypothesis) -> Description:
        value = getattr(d, name)
        return d if value is None else replace(d, **{name: change(value)})

    return applied


def _angles_by(turning: Callable[[Floats], Floats], sliding: float = 1.0) -> Applied:
    """Return a change of the joint values: a function of those that turn, a factor of slides."""

    def applied(d: Description, h: Hypothesis) -> Description:
        changed = np.where(d.arm.slides, sliding * d.q, turning(d.q))
        one = np.arange(1, d.arm.n + 1) == abs(h.joint)
        return replace(d, q=np.where(one == (h.joint > 0), changed, d.q) if h.joint else changed)

    return applied


def _units_words(of_all: str) -> Callable[[Hypothesis], str]:
    """Return the phrase on a unit of "the joint values", of one joint or of all others."""

    def words(h: Hypothesis) -> str:
        of_one = of_all.replace("the joint values", f"joint {abs(h.joint)}'s values")
        if h.joint >= 0:
            return of_one if h.joint else of_all
        return of_one.replace("'s values", "'s values alone are as described: the others")

    return words


def other_convention(arm: Arm) -> Arm | None:
    """Return the arm with classic DH rows read as modified ones, or the other way; None for others.

    Links of both are L_k = Tz(d_k) X_k Rz(o_k), with X_0 = 1 of classic rows and X_n = 1 of
    modified ones, and the same X_k = Tx(a) Rx(alpha) one link further on.
    """
    r, p = arm.links[:, :3, :3], arm.links[:, :3, 3]
    if np.abs(r[:, 0, 2]).max() > 1e-9 or np.abs(p[:, 1]).max() > 1e-9:
        return None
    alpha, offset = np.arctan2(-r[:, 1, 2], r[:, 2, 2]), np.arctan2(-r[:, 0, 1], r[:, 0, 0])
    x = np.array([se3.screw(0, *pair) for pair in zip(alpha, p[:, 0], strict=True)])
    ends = [np.allclose(x[k], np.eye(4), rtol=0.0, atol=1e-9) for k in (0, -1)]
    if not any(ends):
        return None
    x = np.roll(x, -1 if ends[0] else 1, axis=0)
    parts = zip(p[:, 2], x, offset, strict=True)
    links = [se3.screw(2, 0.0, d) @ turn @ se3.screw(2, o) for d, turn, o in parts]
    return replace(arm, links=np.array(links))


def _of_other_convention(d: Description, _: Hypothesis) -> Description:
    return replace(d, arm=other_convention(d.arm) or d.arm)


def _mirrored(d: Description, _: Hypothesis) -> Description:
    # D exp(w) D = exp(−D w) for a reflection D
    turn = None if d.turn is None else -d.turn * MIRROR
    return replace(d, value=d.value * MIRROR, turn=turn)


def _inverse(d: Description, _: Hypothesis) -> Description:
    if d.turn is None:
        return d
    back = np.asarray(-np.einsum("nji,nj->ni", se3.rotation(d.turn), d.value))
    return replace(d, value=back, turn=-d.turn)


def _joint_words(h: Hypothesis) -> str:
    degrees = np.degrees(h.offset)
    if h.sign > 0:
        return f"joint {h.joint}'s zero is {degrees:.4g}° elsewhere in these data"
    turned = f"joint {h.joint} turns the other way in these data"
    return turned if not h.offset else f"{turned} and counts from {degrees:.4g}°"


def _coupling_words(h: Hypothesis) -> str:
    way = "with" if h.factor > 0 else "against"
    return f"joint {h.joint} turns {way} joint {h.follows} (a coupling of {h.factor:+g})"


def _shift_words(h: Hypothesis) -> str:
    rows = "row" if abs(h.shift) == 1 else "rows"
    way = "before" if h.shift > 0 else "after"
    return f"each position stands {abs(h.shift)} {rows} {way} the joint values it belongs to"


def _columns_words(h: Hypothesis) -> str:
    moved = [(j, k) for j, k in enumerate(h.order, 1) if j != k]
    if len(moved) == 2:
        return f"the columns of joints {moved[0][0]} and {moved[1][0]} are exchanged"
    listed = ", ".join(f"joint {j}'s values are in the column of joint {k}" for j, k in moved)
    return f"the columns of the joints are in another order: {listed}"


KINDS: dict[str, HypothesisKind] = {
    "arm": HypothesisKind(_another_arm, lambda h: f"the arm is another one, {h.arm}", ""),
    "joint": HypothesisKind(_recounted, _joint_words, ""),
    "coupling": HypothesisKind(_recounted, _coupling_words, ""),
    "convention": HypothesisKind(
        _of_other_convention,
        'the DH rows are of the other convention; in the arm\'s file: convention = "modified", or '
        '"standard" where it is that',
        "",
    ),
    "base_unknown": HypothesisKind(
        lambda d, _: replace(d, base_unknown=True),
        "the base stands elsewhere than [tracker] says",
        "leave out [tracker] base_xyz_m and base_rotvec_rad",
    ),
    "target_unknown": HypothesisKind(
        lambda d, _: replace(d, target_unknown=True),
        "the target sits elsewhere than [tool] says",
        "leave out [tool] target_m",
    ),
    "millimetres": HypothesisKind(
        _mapped("value", lambda p: 1e-3 * p), "the positions are millimetres, not metres"
    ),
    "metres": HypothesisKind(
        _mapped("value", lambda p: 1e3 * p),
        "the positions are metres, and were taken for millimetres",
    ),
    "inches": HypothesisKind(
        _mapped("value", lambda p: 25.4 * p),
        "the positions are inches, and were taken for millimetres",
    ),
    "joint_degrees": HypothesisKind(
        _angles_by(np.radians), _units_words("the joint values are degrees, not radians")
    ),
    "joint_radians": HypothesisKind(
        _angles_by(np.degrees),
        _units_words("the joint values are radians, and were taken for degrees"),
    ),
    "travel_millimetres": HypothesisKind(
        _angles_by(np.positive, 1e-3),
        "the travels of the joints that slide are millimetres, not metres",
    ),
    "turn_degrees": HypothesisKind(
        _mapped("turn", np.radians), "the attitudes are degrees, not radians"
    ),
    "turn_radians": HypothesisKind(
        _mapped("turn", np.degrees), "the attitudes are radians, and were taken for degrees"
    ),
    "mirrored": HypothesisKind(
        _mirrored,
        "the axes of the readings are left-handed: one coordinate has the other sign, or two are "
        "exchanged",
    ),
    "mirrored_positions": HypothesisKind(
        _mapped("value", lambda p: p * MIRROR), "one coordinate of the positions has the other sign"
    ),
    "inverse": HypothesisKind(
        _inverse, "the poses are the inverse ones, of the tracker in the target's axes"
    ),
    "attitudes": HypothesisKind(
        lambda d, _: replace(d, turn=None),
        "the positions fit by themselves, but not the attitudes, which are in another convention "
        "than stated (hilcal import TABLE --preview proposes one)",
    ),
    "inverse_attitude": HypothesisKind(
        _mapped("turn", np.negative), "the attitudes are the inverse ones"
    ),
    "shift": HypothesisKind(
        lambda d, h: replace(d, q=np.roll(d.q, -h.shift, axis=0), shift=d.shift + h.shift),
        _shift_words,
    ),
    "columns": HypothesisKind(
        lambda d, h: replace(d, q=d.q[:, np.array(h.order) - 1]), _columns_words
    ),
}
"""What may be wrong with the description of arm and readings, by name."""


OF_ATTITUDES = ("mirrored_positions", "turn_degrees", "turn_radians", "inverse", "inverse_attitude")


def hypotheses(d: Description) -> Iterator[Hypothesis]:
    """Yield the single hypotheses."""
    n, slides = d.arm.n, d.arm.slides
    frames = {"base_unknown": d.base_unknown, "target_unknown": d.target_unknown}
    yield from (Hypothesis(kind) for kind, unknown in frames.items() if not unknown)
    for j in range(1, n + 1):
        for sign in (-1, 1):
            for quarter in (0, 2, 1, -1):
                if (sign < 0 or quarter) and not (quarter and slides[j - 1]):
                    yield Hypothesis("joint", j, sign, quarter * np.pi / 2)
    for joint, follows in possible_couplings(n):
        for factor in (1.0, -1.0) if slides[joint - 1] == slides[follows - 1] else ():
            yield Hypothesis("coupling", joint, follows=follows, factor=factor)
    simple = ["millimetres", "metres", "inches", "joint_degrees", "joint_radians", "mirrored"]
    simple += ["travel_millimetres"] * bool(slides.any())
    simple += ["convention"] * (other_convention(d.arm) is not None)
    yield from _units_of_one(d)
    yield from map(Hypothesis, simple if d.turn is None else [*simple, *OF_ATTITUDES])
    yield from (Hypothesis("arm", arm=arm.name) for arm in other_arms(d.arm))
    yield from shifts(len(d.q))
    # Columns: two exchanged, all rotated, or reversed.
    straight = tuple(range(1, n + 1))
    swaps = ({i: j, j: i} for i, j in combinations(straight, 2))
    orders = [tuple(swap.get(k, k) for k in straight) for swap in swaps]
    orders += [(*straight[k:], *straight[:k]) for k in range(1, n)]
    orders.append(straight[::-1])
    yield from (Hypothesis("columns", order=order) for order in dict.fromkeys(orders))


def _units_of_one(d: Description) -> Iterator[Hypothesis]:
    """Yield other units of the values of one joint, or of all others, that its values allow."""
    far = np.where(d.arm.slides, 0.0, np.abs(d.q).max(axis=0))
    for j, size in enumerate(far, start=1):
        if size > LARGEST:
            yield Hypothesis("joint_degrees", j)
        if 0.0 < np.degrees(size) <= LARGEST:
            yield Hypothesis("joint_radians", j)
        others = np.delete(far, j - 1).max(initial=0.0)
        if 0.0 < np.degrees(others) <= LARGEST < np.degrees(size):
            yield Hypothesis("joint_radians", -j)


def shifts(count: int) -> Iterator[Hypothesis]:
    """Yield the shifts of rows that leave at least half of so many readings to judge by."""
    yield from (Hypothesis("shift", shift=k) for k in SHIFTS if 2 * abs(k) <= count)


def pairs(n: int) -> Iterator[Combination]:
    """Yield pairs that hide each other: two signs, and the zeros of two neighbours."""
    for i, j in combinations(range(1, n + 1), 2):
        yield Hypothesis("joint", i, -1), Hypothesis("joint", j, -1)
    for j, a, b in product(range(1, n), (1, -1, 2), (1, -1, 2)):
        first = Hypothesis("joint", j, 1, a * np.pi / 2)
        yield first, Hypothesis("joint", j + 1, 1, b * np.pi / 2)


def correction(combination: Combination, cell: Cell) -> str:
    """Return what to write into CELL.toml, or to change in the table; begins with '; '."""
    lines = [f'[robot] model = "{h.arm}"' for h in combination if h.arm][:1]
    lines += [f"[robot] {key} = {value}" for key, value in robot_keys(combination, cell).items()]
    where = [KINDS[h.kind].correction for h in combination]
    if cell.config is not None and cell.config.tracker.frame == "base":
        stated = KINDS["base_unknown"].correction
        where = ['[tracker] frame = "tracker"' if line == stated else line for line in where]
    lines += [line for line in where if line]
    advice = f"; in CELL.toml: {', '.join(lines)}" if lines else ""
    return f"{advice}; correct it in the table" if None in where else advice


def robot_keys(combination: Combination, cell: Cell) -> dict[str, str]:
    """Return the keys of [robot] that describe the joints under some hypotheses, as TOML."""
    n, robot = cell.arm.n, None if cell.config is None else cell.config.robot
    sign = np.array((robot and robot.joint_sign) or (1,) * n)
    zero = np.array((robot and robot.joint_offset_deg) or (0.0,) * n)
    coupled = [
        c.model_dump(exclude_defaults=True) | {"factor": c.factor}
        for c in (robot.joint_coupling if robot else ())
    ]
    for h in combination:
        j = h.joint - 1
        if h.offset:
            zero[j] += sign[j] * np.degrees(h.offset)
        if h.sign < 0:
            sign[j] *= -1
        if h.follows:
            factor = float(sign[j] * h.factor)
            coupled.append({"joint": h.joint, "follows": h.follows, "factor": factor})
    entries = [", ".join(f"{k} = {json.dumps(v)}" for k, v in c.items()) for c in coupled]
    values = (
        (any(h.sign < 0 for h in combination), json.dumps([int(s) for s in sign])),
        (any(h.offset for h in combination), json.dumps([round(float(z), 4) + 0.0 for z in zero])),
        (
            any(h.follows for h in combination),
            f"[{', '.join(f'{{ {entry} }}' for entry in entries)}]",
        ),
    )
    by_key = zip(Conventions.model_fields, values, strict=True)
    return {key: value for key, (changed, value) in by_key if changed}
