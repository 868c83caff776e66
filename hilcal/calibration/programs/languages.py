"""A program by the end of its name: read, its branches found, what is not understood refused.

A pose has up to eight solutions, and each again whole turns of its joints on. Programs state which
by flags: turns or quadrants of joints, which follow from the joint values, and the shape of the
arm: wrist in front of axis 1 or behind, elbow, sign of a wrist joint. The shape means something for
arms of the maker's form alone: axes as `Language.axes` with all joint values zero, the last three
of which meet. Elsewhere, and where nothing is stated or the controller does not look at it (on
straight lines), the solution is the nearest to the point before.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from hilcal.calibration.points import Points, solutions
from hilcal.calibration.programs.fanuc import read_ls
from hilcal.calibration.programs.inform import read_jbi
from hilcal.calibration.programs.krl import read_krl
from hilcal.calibration.programs.program import JOINTS, UNSTATED, Language, Program, ProgramPoint
from hilcal.calibration.programs.rapid import read_rapid
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.robot.arm import Arm
from hilcal.robot.chain import evaluate
from hilcal.types import Bools, Floats, Ints

LARGEST = 1e7
"""Of a number of a point: mm, degrees or pulses; a choice."""
READERS: Mapping[str, Callable[[Path, Path | None, Floats | None], Program]] = {
    ".src": read_krl,
    ".mod": read_rapid,
    ".modx": read_rapid,
    ".prg": read_rapid,
    ".sys": read_rapid,
    ".ls": read_ls,
    ".jbi": read_jbi,
}
"""By the end of a file's name in lower case."""


@dataclass(frozen=True, slots=True, eq=False)
class UnderstoodProgram:
    """A program with N points that are understood."""

    program: Program  # the program; what is not understood of it is left
    arm: Arm
    q: Floats  # (N, 6) joint values at which it is at them, rad
    tool: Floats  # (4, 4) T_flange_tool that errors are stated for
    said: tuple[str, ...]  # what is to be said of their branches

    @property
    def points(self) -> Points:
        """Points of `compensate`."""
        return Points(tuple(p.name for p in self.program.understood), self.q)

    def without(self, refused: list[str]) -> "UnderstoodProgram":
        """Return the program without points that are refused; "" for those that are not."""
        why = iter(refused)
        points = tuple(p if p.left else replace(p, left=next(why)) for p in self.program.points)
        kept = [k for k, words in enumerate(refused) if not words]
        return replace(self, program=replace(self.program, points=points), q=self.q[kept])

    def corrected(self, q: Floats) -> dict[str, bytes]:
        """Return the files by suffix, with joint values (N, 6) in place of `q`."""
        points, language = self.program.understood, self.program.language
        none = (UNSTATED,) * len(language.of_shape)
        stated = np.array([p.flags or none for p in points])
        made = np.array([bool(p.made) for p in points])
        stated[made] = flags_of(self.arm, language, self.q[made])
        flags = kept_flags(self.arm, language, self.q, q, stated)
        return self.program.corrected(self.arm, points, self.q, q, flags)


def understood(
    path: Path,
    arm: Arm,
    *,
    frames: Path | None = None,
    tool: Floats | None = None,
    near: Floats | None = None,
    leave: bool = False,
) -> UnderstoodProgram:
    """Read a program.

    `tool` (4, 4) T_flange_tool is that of tools that neither it nor `frames` has; `near` (6,) are
    joint values that the first pose is near to, rad.
    """
    try:
        program = READERS[path.suffix.lower()](path, frames, tool)
    except InputError as error:
        raise InputError(escaped(str(error))) from None
    points = []
    for p in program.points:
        every = np.concatenate([p.values, p.frame.ravel(), p.tool.ravel()])
        usable = (np.abs(every) < LARGEST).all()
        left = p.left if usable else "numbers that are none, in it, its tool or its base"
        points.append(replace(p, left=left))
    program = replace(program, points=tuple(points))
    _refuse(path, program.points, leave)
    q, doubts, said = resolve(program, arm, near)
    longest, more = longest_tool(program.understood)
    found = UnderstoodProgram(program, arm, q, longest, said + more).without(doubts)
    _refuse(path, found.program.points, leave)
    return found


def _refuse(path: Path, points: tuple[ProgramPoint, ...], leave: bool) -> None:
    """Refuse points that are left; raises as `understood` does."""
    left = [p for p in points if p.left]
    if left and not (leave and len(left) < len(points)):
        p = left[0]
        where = p.name if "line" in p.name else f"{p.name}, line {p.line}"
        rest = f"; and {len(left) - 1} more" if len(left) > 1 else ""
        said = escaped(f"{where}: {p.left}{rest}")
        raise InputError(f"{path}: {said}; --leave keeps such points as they are")


ALONG = 0.02
"""By how much the direction of an axis may differ from that of the maker's arms; a choice, more
than any calibrated arm is off."""
MEET = 1e-3
"""m; distance at which axes meet; a choice."""
BORDER = 1e-4
"""rad; joint values as near to where a flag changes have both; a choice, above what numbers of four
decimals leave open."""
AS_NEAR = 0.05
"""rad, see `calibration.urscript.AS_NEAR`."""


def unlike(arm: Arm, language: Language) -> str:
    """Say why an arm is not of the maker's form; empty where it is."""
    chain = evaluate(arm, np.zeros((1, JOINTS)))
    axes = chain.rotation[:JOINTS, 0, :, 2]
    wrong = np.linalg.norm(axes - np.array(language.axes), axis=1) > ALONG
    if wrong.any():
        k = int(np.argmax(wrong))
        is_, should = (
            "[" + ", ".join(f"{v:.2g}" for v in np.round(row, 3) + 0.0) + "]"
            for row in (axes[k], np.array(language.axes[k], dtype=float))
        )
        return f"axis {k + 1} with all joint values zero is {is_}, not {should}"
    p = chain.position[:JOINTS, 0]
    normals = {k: np.cross(axes[k], axes[4]) for k in (3, 5)}
    gaps = [abs((p[k] - p[4]) @ n) / np.linalg.norm(n) for k, n in normals.items()]
    missed = max(gaps)
    return f"axes 4 to 6 miss each other by {1e3 * missed:.3g} mm" if missed > MEET else ""


def shape(arm: Arm, q: Floats) -> Ints:
    """(K, 2) 1 where the wrist centre is behind axis 1; 1 where it is behind the lower arm.

    Both as seen in the plane of the arm, which turns with axis 1 and whose forward direction has
    axis 2 to its left: `behind` at values q of all joints.
    """
    chain = evaluate(arm, q)
    z, p = chain.rotation[:JOINTS, :, :, 2], chain.position[:JOINTS]
    up = np.broadcast_to([0.0, 0.0, 1.0], z[1].shape)
    forward = np.cross(z[1], up)
    # the point of axis 5 that is nearest to axis 4: n x b . (p4 - p5) by the lines' formula
    n = np.cross(z[3], z[4])
    along = np.einsum("ki,ki->k", np.cross(p[3] - p[4], z[3]), n) / np.einsum("ki,ki->k", n, n)
    centre = p[4] + along[:, None] * z[4]
    behind = np.einsum("ki,ki->k", centre - p[0], forward) < 0
    bend = np.einsum("ki,ki->k", np.cross(p[2] - p[1], centre - p[2]), z[1])
    return np.stack([behind, bend < 0], axis=1).astype(np.int64)


def flags_of(arm: Arm, language: Language, q: Floats) -> Ints:
    """(K, F) configuration of the language at joint values (K, 6)."""
    return language.flags(q, shape(arm, q))


def resolve(
    program: Program, arm: Arm, near: Floats | None
) -> tuple[Floats, list[str], tuple[str, ...]]:
    """Return joint values (N, 6) at which the nominal arm is at the points, doubts, and remarks.

    A doubt says why the values of a point are not certain, "" where they are. `near` (6,) are joint
    values that the first pose is near to, rad; None where none are given.
    """
    language = program.language
    if arm.n != JOINTS or arm.mimic is not None:
        raise InputError(f"{arm.name}: {arm.n} joints; a {language.name} program is for {JOINTS}")
    foreign = unlike(arm, language)
    known = np.array([not (foreign and of) for of in language.of_shape])
    found: list[Floats] = []
    doubts: list[str] = []
    ignored = unfit = 0
    for p in program.understood:
        before = found[-1] if found and not doubts[-1] else None if found else near
        if p.joints:
            found.append(p.values / p.scale)
            doubts.append("")
            continue
        stated = np.array(p.flags or (UNSTATED,) * len(known))
        asked = (stated != UNSTATED) & known
        ignored += bool(np.any((stated != UNSTATED) & ~known))
        if not p.obeyed and before is not None:
            asked[:] = False
        q, why = _one(arm, language, p, before, stated, asked)
        unfit += bool(
            not why
            and not asked.any()
            and not _fits(arm, language, q[None], stated, (stated != UNSTATED) & known)[0]
        )
        found.append(q)
        doubts.append(why)
    said = []
    if ignored:
        said.append(
            f"{ignored} points state a shape of the arm that is read for {language.name} arms of "
            f"the usual form alone, and of {arm.name} {foreign}; their branch is the one that the "
            "other flags and the point before say"
        )
    if unfit:
        said.append(
            f"{unfit} points on straight lines state another configuration than that which the "
            "point before leads to; the controller does not look at it, and it stays as written"
        )
    return np.array(found).reshape(-1, JOINTS), doubts, tuple(said)


def _one(
    arm: Arm, language: Language, p: ProgramPoint, before: Floats | None, stated: Ints, asked: Bools
) -> tuple[Floats, str]:
    """Joint values of a pose, and why they are not certain; raises as `resolve` does."""
    goal = p.frame @ language.pose(p.values)
    nothing = np.full(JOINTS, np.nan)
    if before is None and not asked.any():
        return nothing, (
            "no configuration is stated, and no point before it is known; give --near with the "
            "joint values that the first pose is near to"
        )
    if before is not None:
        q = solutions(arm, p.tool, before[None], goal)
        good = len(q) and np.abs(q[0] - before).max() < np.pi / 2
        if good and _fits(arm, language, q, stated, asked)[0]:
            close = np.abs(q[0] - before).max() < 0.5
            if close or asked.all():
                return q[0], ""
    every = solutions(arm, p.tool, None, goal)
    if not len(every):
        raise InputError(f"{p.name}: the nominal arm does not reach it from anywhere")
    turned = np.concatenate([_turned(arm, q) for q in every])
    fit = turned[_fits(arm, language, turned, stated, asked)]
    if not len(fit):
        return nothing, (
            f"no solution of {arm.name} has the configuration that is stated: the description "
            "counts joints otherwise than the controller, or it is another arm"
        )
    from_ = np.zeros(JOINTS) if before is None else before
    far = np.abs(fit - from_).max(axis=1)
    order = np.argsort(far, kind="stable")
    best = fit[order[0]]
    poses = np.abs(np.sin((fit - best) / 2)).max(axis=1) > 1e-6  # other than by whole turns
    others = far[poses].min(initial=np.inf)
    certain = not poses.any() if before is None else others > far[order[0]] + AS_NEAR
    if not certain:
        return best, "several branches of the arm are possible; joint values in its place say which"
    return best, ""


def kept_flags(arm: Arm, language: Language, given: Floats, q: Floats, stated: Ints) -> Ints:
    """(N, F) configuration to be stated after a correction: others where those were left alone.

    `given` and `q` are joint values (N, 6) before and after, rad; `stated` (N, F) is as it was.
    """
    left = _agree(arm, language, given, stated) & ~_agree(arm, language, q, stated)
    if unlike(arm, language):
        left &= ~np.array(language.of_shape)
    return np.where(left & (stated != UNSTATED), flags_of(arm, language, q), stated)


def _agree(arm: Arm, language: Language, q: Floats, stated: Ints) -> Bools:
    """(K, F) which flags joint values (K, 6) have, those of a border on both of its sides."""
    formed = shape(arm, q)
    near = (language.flags(q + d, formed) for d in (0.0, -BORDER, BORDER))
    return np.asarray(np.any([have == stated for have in near], axis=0))


def _fits(arm: Arm, language: Language, q: Floats, stated: Ints, asked: Bools) -> Bools:
    """(K,) whether joint values (K, 6) have the flags that are asked for."""
    return np.asarray(_agree(arm, language, q, stated)[:, asked].all(axis=1))


def _turned(arm: Arm, q: Floats) -> Floats:
    """(K, 6) joint values whole turns on that are within the limits."""
    every = [
        [v + 2 * np.pi * k for k in range(-3, 4) if low <= v + 2 * np.pi * k <= high]
        for v, low, high in zip(q, arm.q_min, arm.q_max, strict=True)
    ]
    return np.array(list(product(*every))).reshape(-1, JOINTS)


def longest_tool(points: Sequence[ProgramPoint]) -> tuple[Floats, tuple[str, ...]]:
    """(4, 4) T_flange_tool of the points, of several the longest, and what is to be said."""
    poses = [p for p in points if not p.joints] or list(points)
    first = max(poses, key=lambda p: float(np.linalg.norm(p.tool[:3, 3])))
    if all(np.allclose(p.tool, first.tool, atol=1e-9) for p in poses):
        return first.tool, ()
    return first.tool, (f"several tools; errors are stated for the longest, that of {first.name}",)
