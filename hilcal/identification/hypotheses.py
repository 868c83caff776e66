"""What may be wrong in the description of arm and readings: a table of hypotheses that are tried.

Each kind maps arm and readings to what they are under it, and says what is wrong and where it is
mended. Several are applied one after another.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from hilcal.cell import Cell
from hilcal.config.sections import Conventions
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import load_arm, other_arms
from hilcal.robot.conventions import as_counted, may_follow, with_conventions
from hilcal.types import Bools, Floats

SHIFTS = (1, -1, 2, -2)
"""Rows by which joints and positions are tried against each other."""
TRIED = (
    "signs, zeros, couplings and columns of the joints, units, shifted rows, mirrored axes, "
    "inverse poses, other arms, alone and in combination"
)
MIRROR = np.array([1.0, -1.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Described:
    """Arm and readings as they are described.

    Attributes:
        arm: the arm.
        q: (N, n) joint values, rad.
        value: (N, 3) positions, m.
        turn: (N, 3) rotation vectors of the attitudes, rad, or None.
        base_unknown: whether the base is estimated.
        target_unknown: whether the targets are.
        shift: by how many rows the joint values come after the positions that they belong to.
        conventions: how the controller counts the joints of any arm; None as drawn.
    """

    arm: Arm
    q: Floats
    value: Floats
    turn: Floats | None
    base_unknown: bool
    target_unknown: bool
    shift: int = 0
    conventions: Conventions | None = None

    @property
    def paired(self) -> Bools:
        """(N,) rows that have joint values and a position under the shift."""
        k = np.arange(len(self.q)) + self.shift
        return (k >= 0) & (k < len(self.q))


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One thing that may be otherwise than described.

    Attributes:
        kind: key of `KINDS`.
        joint: number of the joint from 1, where it is about one.
        sign: −1 where the joint turns the other way.
        offset: what its zero is off by, rad: the chain turns by sign q + offset.
        follows: number of the joint that it follows, from 1; with `factor`.
        factor: of the coupling.
        arm: another arm of the catalogue.
        shift: by how many rows the joint values come after their positions.
        order: column, from 1, that holds the values of each joint.
    """

    kind: str
    joint: int = 0
    sign: int = 1
    offset: float = 0.0
    follows: int = 0
    factor: float = 0.0
    arm: str = ""
    shift: int = 0
    order: tuple[int, ...] = ()

    @property
    def is_zero(self) -> bool:
        """Whether it is the zero of a joint alone, by other than quarter turns."""
        quarters = self.offset / (np.pi / 2)
        return self.kind == "joint" and self.sign > 0 and abs(quarters - round(quarters)) > 0.02

    @property
    def cost(self) -> int:
        """How much it changes: a joint that counts from elsewhere and the other way counts two."""
        return 1 + (self.kind == "joint" and self.sign < 0 and self.offset != 0.0)

    @property
    def subject(self) -> tuple[str, int, int]:
        """What it is about; two hypotheses about one thing are not combined."""
        return self.kind, self.joint, self.follows

    @property
    def order_of_trial(self) -> tuple[object, ...]:
        """Hypotheses about the arm come first, then those about joints, then couplings."""
        rank = {"arm": 0, "joint": 1, "coupling": 2}.get(self.kind, 3)
        return (rank, *self.subject, self.sign, self.offset)

    def applied(self, d: Described) -> Described:
        """Return arm and readings under this hypothesis."""
        return KINDS[self.kind].applied(d, self)

    @property
    def words(self) -> str:
        """What is wrong, in a phrase."""
        words = KINDS[self.kind].words
        return words if isinstance(words, str) else words(self)


@dataclass(frozen=True, slots=True)
class Kind:
    """A row of the table.

    Attributes:
        applied: returns arm and readings under a hypothesis.
        words: what is wrong, in a phrase.
        mended: what to write into CELL.toml; None where the table is to be corrected, '' where
            `keys` says it.
    """

    applied: Callable[[Described, Hypothesis], Described]
    words: str | Callable[[Hypothesis], str]
    mended: str | None = None


def _recounted(d: Described, h: Hypothesis) -> Described:
    n, j = d.arm.n, h.joint - 1
    sign, offset, coupling = np.ones(n), np.zeros(n), np.zeros((n, n))
    sign[j], offset[j] = h.sign, h.offset
    if h.follows:
        coupling[j, h.follows - 1] = h.factor
    return replace(d, arm=with_conventions(d.arm, sign, offset, coupling))


def _another(d: Described, h: Hypothesis) -> Described:
    arm = load_arm(h.arm)
    return replace(d, arm=arm if d.conventions is None else as_counted(arm, d.conventions))


def _mapped(name: str, by: Callable[[Any], Any]) -> Callable[[Described, Hypothesis], Described]:
    """Return what maps one attribute of the description, where there is one."""

    def applied(d: Described, _: Hypothesis) -> Described:
        given = getattr(d, name)
        return d if given is None else replace(d, **{name: by(given)})

    return applied


def _mirrored(d: Described, _: Hypothesis) -> Described:
    # D exp(w) D = exp(−D w) for a reflection D
    turn = None if d.turn is None else -d.turn * MIRROR
    return replace(d, value=d.value * MIRROR, turn=turn)


def _inverse(d: Described, _: Hypothesis) -> Described:
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
    each = ", ".join(f"joint {j}'s values are in the column of joint {k}" for j, k in moved)
    return f"the columns of the joints are in another order: {each}"


KINDS: dict[str, Kind] = {
    "arm": Kind(
        _another,
        lambda h: f"the arm is another one, {h.arm}",
        "",
    ),
    "joint": Kind(_recounted, _joint_words, ""),
    "coupling": Kind(_recounted, _coupling_words, ""),
    "base_unknown": Kind(
        _mapped("base_unknown", lambda _: True),
        "the base stands elsewhere than [tracker] says",
        "leave out [tracker] base_xyz_m and base_rotvec_rad",
    ),
    "target_unknown": Kind(
        _mapped("target_unknown", lambda _: True),
        "the target sits elsewhere than [tool] says",
        "leave out [tool] target_m",
    ),
    "millimetres": Kind(
        _mapped("value", lambda p: 1e-3 * p), "the positions are millimetres, not metres"
    ),
    "metres": Kind(
        _mapped("value", lambda p: 1e3 * p),
        "the positions are metres, and were taken for millimetres",
    ),
    "joint_degrees": Kind(
        lambda d, _: replace(d, q=np.where(d.arm.slides, d.q, np.radians(d.q))),
        "the joint values are degrees, not radians",
    ),
    "joint_radians": Kind(
        lambda d, _: replace(d, q=np.where(d.arm.slides, d.q, np.degrees(d.q))),
        "the joint values are radians, and were taken for degrees",
    ),
    "travel_millimetres": Kind(
        lambda d, _: replace(d, q=np.where(d.arm.slides, 1e-3 * d.q, d.q)),
        "the travels of the joints that slide are millimetres, not metres",
    ),
    "turn_degrees": Kind(_mapped("turn", np.radians), "the attitudes are degrees, not radians"),
    "turn_radians": Kind(
        _mapped("turn", np.degrees), "the attitudes are radians, and were taken for degrees"
    ),
    "mirrored": Kind(
        _mirrored, "the axes of the readings are left-handed: one coordinate has the other sign"
    ),
    "mirrored_positions": Kind(
        _mapped("value", lambda p: p * MIRROR), "one coordinate of the positions has the other sign"
    ),
    "inverse": Kind(
        _inverse, "the poses are the inverse ones, of the tracker in the target's axes"
    ),
    "inverse_attitude": Kind(_mapped("turn", np.negative), "the attitudes are the inverse ones"),
    "shift": Kind(
        lambda d, h: replace(d, q=np.roll(d.q, -h.shift, axis=0), shift=d.shift + h.shift),
        _shift_words,
    ),
    "columns": Kind(
        lambda d, h: replace(d, q=d.q[:, np.array(h.order) - 1]),
        _columns_words,
    ),
}
"""All kinds of hypotheses."""
OF_ATTITUDES = ("mirrored_positions", "turn_degrees", "turn_radians", "inverse", "inverse_attitude")


def hypotheses(d: Described) -> Iterator[Hypothesis]:
    """Yield what is tried by itself."""
    n, slides = d.arm.n, d.arm.slides
    if not d.base_unknown:
        yield Hypothesis("base_unknown")
    if not d.target_unknown:
        yield Hypothesis("target_unknown")
    for j in range(1, n + 1):
        for sign in (-1, 1):
            for quarter in (0, 2, 1, -1):
                if (sign < 0 or quarter) and not (quarter and d.arm.slides[j - 1]):
                    yield Hypothesis("joint", j, sign, quarter * np.pi / 2)
    for joint, follows in may_follow(n):
        for factor in (1.0, -1.0) if slides[joint - 1] == slides[follows - 1] else ():
            yield Hypothesis("coupling", joint, follows=follows, factor=factor)
    simple = ["millimetres", "metres", "joint_degrees", "joint_radians", "mirrored"]
    simple += ["travel_millimetres"] * bool(slides.any())
    yield from map(Hypothesis, simple if d.turn is None else [*simple, *OF_ATTITUDES])
    for arm in other_arms(d.arm):
        yield Hypothesis("arm", arm=arm.name)
    yield from (Hypothesis("shift", shift=k) for k in SHIFTS)
    yield from (Hypothesis("columns", order=order) for order in column_orders(n))


def column_orders(n: int) -> Iterator[tuple[int, ...]]:
    """Yield orders of the joints' columns other than their own: two exchanged, or all in a turn."""
    own = list(range(1, n + 1))
    orders = []
    for i, j in combinations(range(n), 2):
        order = own.copy()
        order[i], order[j] = order[j], order[i]
        orders.append(tuple(order))
    orders += [(*own[k:], *own[:k]) for k in range(1, n)]
    yield from dict.fromkeys((*orders, tuple(own[::-1])))


def pairs(n: int) -> Iterator[tuple[Hypothesis, ...]]:
    """Yield pairs that hide behind each other: two signs, and the zeros of two neighbours."""
    for i, j in combinations(range(1, n + 1), 2):
        yield Hypothesis("joint", i, -1), Hypothesis("joint", j, -1)
    for j in range(1, n):
        for a in (1, -1, 2):
            for b in (1, -1, 2):
                zeros = (a * np.pi / 2, b * np.pi / 2)
                yield Hypothesis("joint", j, 1, zeros[0]), Hypothesis("joint", j + 1, 1, zeros[1])


def mended(chosen: Iterable[Hypothesis], cell: Cell) -> str:
    """Return what to write into CELL.toml, or to change in the table; begins with '; '."""
    chosen = tuple(chosen)
    lines = [f'[robot] model = "{h.arm}"' for h in chosen if h.arm][:1]
    lines += [f"[robot] {key} = {value}" for key, value in keys(chosen, cell).items()]
    where = [KINDS[h.kind].mended for h in chosen]
    lines += [line for line in where if line]
    said = f"; in CELL.toml: {', '.join(lines)}" if lines else ""
    return f"{said}; correct it in the table" if None in where else said


def keys(chosen: Iterable[Hypothesis], cell: Cell) -> dict[str, str]:
    """Return the keys of [robot] that describe the joints under some hypotheses, as TOML."""
    n, robot = cell.arm.n, None if cell.config is None else cell.config.robot
    sign = np.array((robot and robot.joint_sign) or (1,) * n)
    zero = np.array((robot and robot.joint_offset_deg) or (0.0,) * n)
    coupled = [
        c.model_dump(exclude_defaults=True) | {"factor": c.factor}
        for c in (robot.joint_coupling if robot else ())
    ]
    signs, zeros, couplings = Conventions.model_fields
    changed = set()
    for h in chosen:
        j = h.joint - 1
        if h.offset:
            zero[j] += sign[j] * np.degrees(h.offset)
            changed.add(zeros)
        if h.sign < 0:
            sign[j] *= -1
            changed.add(signs)
        if h.follows:
            factor = float(sign[j] * h.factor)
            coupled.append({"joint": h.joint, "follows": h.follows, "factor": factor})
            changed.add(couplings)
    entries = [", ".join(f"{k} = {json.dumps(v)}" for k, v in c.items()) for c in coupled]
    out = {
        signs: json.dumps([int(s) for s in sign]),
        zeros: json.dumps([round(float(z), 4) + 0.0 for z in zero]),
        couplings: f"[{', '.join(f'{{ {entry} }}' for entry in entries)}]",
    }
    return {key: value for key, value in out.items() if key in changed}
