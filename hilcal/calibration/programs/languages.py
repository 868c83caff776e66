"""Reading of programs in the language of the file's suffix, and the branches of their poses.

A pose has up to eight solutions, each of which repeats at whole turns of its joints. Programs
select one by flags: turns or quadrants of joints, which follow from the joint values, and the shape
of the arm: wrist in front of axis 1 or behind, elbow, sign of a wrist joint. The shape is defined
only for arms of the maker's form: axes as `Language.axes` at zero joint values, the last three of
which intersect. For other arms, where nothing is stated, and where the controller ignores the flags
(on straight lines), the solution is the one nearest to the previous point.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from hilcal.calibration.points import Points, solutions
from hilcal.calibration.programs.fanuc_inform import read_jbi, read_ls
from hilcal.calibration.programs.krl import read_krl
from hilcal.calibration.programs.program import JOINTS, UNSTATED, Language, Program, ProgramPoint
from hilcal.calibration.programs.rapid import read_rapid
from hilcal.calibration.programs.urscript import BRANCH_MARGIN
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.robot.arm import Arm
from hilcal.robot.chain import evaluate
from hilcal.types import Bools, Floats, Ints

LARGEST_NUMBER = 1e7  # largest number of a point: mm, degrees or pulses; a choice
READERS: Mapping[str, Callable[[Path, Path | None, Floats | None], Program]] = {
    ".src": read_krl,
    ".mod": read_rapid,
    ".modx": read_rapid,
    ".prg": read_rapid,
    ".sys": read_rapid,
    ".ls": read_ls,
    ".jbi": read_jbi,
}
"""By suffix in lower case."""


@dataclass(frozen=True, slots=True, eq=False)
class ResolvedProgram:
    """A program with N understood points."""

    program: Program
    arm: Arm
    q: Floats  # (N, 6) joint values at the points, rad
    tool: Floats  # (4, 4) T_flange_tool that errors are stated for
    remarks: tuple[str, ...]  # remarks on the branches, for people

    @property
    def points(self) -> Points:
        """Points of `compensate`."""
        return Points(tuple(p.name for p in self.program.correctable_points), self.q)

    def without(self, refused: list[str]) -> "ResolvedProgram":
        """Return the program without refused points; `refused` has "" for the others."""
        reasons = iter(refused)
        points = tuple(
            p if p.not_corrected else p.refused(next(reasons)) for p in self.program.points
        )
        retained = [k for k, reason in enumerate(refused) if not reason]
        return replace(self, program=replace(self.program, points=points), q=self.q[retained])

    def corrected(self, q: Floats) -> dict[str, bytes]:
        """Return the files by suffix, with joint values (N, 6) in place of `q`."""
        points, language = self.program.correctable_points, self.program.language
        unstated = (UNSTATED,) * len(language.shape_flags)
        stated = np.array([p.flags or unstated for p in points])
        computed = np.array([bool(p.template) for p in points])
        stated[computed] = flags_of(self.arm, language, self.q[computed])
        agreed, agrees = (_agree(self.arm, language, x, stated) for x in (self.q, q))
        changed = agreed & ~agrees & (stated != UNSTATED)
        if form_mismatch(self.arm, language):
            changed &= ~np.array(language.shape_flags)
        flags = np.where(changed, flags_of(self.arm, language, q), stated)
        return self.program.corrected(self.arm, points, self.q, q, flags)


def read_program(
    path: Path,
    arm: Arm,
    *,
    frames: Path | None = None,
    tool: Floats | None = None,
    near: Floats | None = None,
    leave: bool = False,
) -> ResolvedProgram:
    """Read a program; the first pose is near to joint values `near` (6,), rad.

    `tool` (4, 4) T_flange_tool replaces tools that neither the program nor `frames` has.
    """
    try:
        program = READERS[path.suffix.lower()](path, frames, tool)
    except InputError as error:
        raise InputError(escaped(str(error))) from None
    points = []
    for p in program.points:
        numbers = np.concatenate([p.values, p.frame.ravel(), p.tool.ravel()])
        usable = (np.abs(numbers) < LARGEST_NUMBER).all()
        wrong = "a number of it, its tool or its base is not finite or too large"
        points.append(p if usable else p.refused(wrong))
    program = replace(program, points=tuple(points))
    _refuse(path, program.points, leave)
    q, doubts, remarks = resolve(program, arm, near)
    poses = [p for p in program.correctable_points if not p.joints] or program.correctable_points
    longest = max(poses, key=lambda p: float(np.linalg.norm(p.tool[:3, 3])))
    if any(not np.allclose(p.tool, longest.tool, atol=1e-9) for p in poses):
        remarks += (f"several tools; errors are stated for the longest, that of {longest.name}",)
    result = ResolvedProgram(program, arm, q, longest.tool, remarks).without(doubts)
    _refuse(path, result.program.points, leave)
    return result


def _refuse(path: Path, points: tuple[ProgramPoint, ...], leave: bool) -> None:
    left = [p for p in points if p.not_corrected]
    if left and not (leave and len(left) < len(points)):
        p = left[0]
        where = p.name if "line" in p.name else f"{p.name}, line {p.line}"
        further = f"; and {len(left) - 1} more" if len(left) > 1 else ""
        reason = escaped(f"{where}: {p.not_corrected}{further}")
        raise InputError(f"{path}: {reason}; --leave keeps such points as they are")


AXIS_TOLERANCE = 0.02  # of an axis direction; a choice, above that of any calibrated arm
INTERSECTION_M = 1e-3  # m; largest distance of intersecting axes; a choice
FLAG_BORDER = 1e-4
"""rad; nearer to the border of a flag, both of its values agree; a choice, above rounding."""


def form_mismatch(arm: Arm, language: Language) -> str:
    """Return why an arm is not of the maker's form; empty if it is."""
    chain = evaluate(arm, np.zeros((1, JOINTS)))
    axes = chain.rotation[:JOINTS, 0, :, 2]
    wrong = np.linalg.norm(axes - np.array(language.axes), axis=1) > AXIS_TOLERANCE
    if wrong.any():
        k = int(np.argmax(wrong))
        actual, expected = (
            f"[{', '.join(f'{v:.2g}' for v in np.round(row, 3) + 0.0)}]"
            for row in (axes[k], np.array(language.axes[k], dtype=float))
        )
        return f"axis {k + 1} with all joint values zero is {actual}, not {expected}"
    p = chain.position[:JOINTS, 0]
    normals = {k: np.cross(axes[k], axes[4]) for k in (3, 5)}
    gap = max(abs((p[k] - p[4]) @ n) / np.linalg.norm(n) for k, n in normals.items())
    return f"axes 4 to 6 miss each other by {1e3 * gap:.3g} mm" if gap > INTERSECTION_M else ""


def shape(arm: Arm, q: Floats) -> Ints:
    """(K, 2) 1 where the wrist centre is behind axis 1, and 1 where it is behind the lower arm.

    In the plane of the arm, which turns with axis 1; axis 2 points to the left of its forward
    direction.
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
    """Return joint values (N, 6) that take the nominal arm to the points, doubts, and remarks.

    A doubt is why the values of a point are not certain, "" if they are.
    """
    language = program.language
    if arm.n != JOINTS or arm.mimic is not None:
        raise InputError(f"{arm.name}: {arm.n} joints; a {language.name} program is for {JOINTS}")
    foreign = form_mismatch(arm, language)
    readable = np.array([not (foreign and by_shape) for by_shape in language.shape_flags])
    joints: list[Floats] = []
    doubts: list[str] = []
    ignored = unfit = 0
    for p in program.correctable_points:
        previous = joints[-1] if joints and not doubts[-1] else None if joints else near
        if p.joints:
            joints.append(p.values / p.scale)
            doubts.append("")
            continue
        stated = np.array(p.flags or (UNSTATED,) * len(readable))
        required = (stated != UNSTATED) & readable
        ignored += bool(np.any((stated != UNSTATED) & ~readable))
        if not p.flags_obeyed and previous is not None:
            required[:] = False
        q, doubt = _solve(arm, language, p, previous, stated, required)
        all_stated = (stated != UNSTATED) & readable
        fits = doubt or required.any() or _fits(arm, language, q[None], stated, all_stated)[0]
        unfit += not fits
        joints.append(q)
        doubts.append(doubt)
    remarks = []
    if ignored:
        remarks.append(
            f"{ignored} points state a shape of the arm, which is defined only for {language.name} "
            f"arms of the usual form, and of {arm.name} {foreign}; their branch follows from the "
            "other flags and the previous point"
        )
    if unfit:
        remarks.append(
            f"{unfit} points on straight lines state another configuration than the one that "
            "follows from the previous point; the controller ignores it, and it stays as written"
        )
    return np.array(joints).reshape(-1, JOINTS), doubts, tuple(remarks)


def _solve(
    arm: Arm,
    language: Language,
    p: ProgramPoint,
    previous: Floats | None,
    stated: Ints,
    required: Bools,
) -> tuple[Floats, str]:
    goal = p.frame @ language.pose(p.values)
    unknown = np.full(JOINTS, np.nan)
    if previous is None and not required.any():
        return unknown, (
            "no configuration is stated, and no previous point is known; give --near with joint "
            "values near the first pose"
        )
    if previous is not None:
        q = solutions(arm, p.tool, previous[None], goal)
        near = np.pi / 2 if required.all() else 0.5
        fits = len(q) > 0 and _fits(arm, language, q, stated, required)[0]
        if fits and np.abs(q[0] - previous).max() < near:
            return q[0], ""
    all_solutions = solutions(arm, p.tool, None, goal)
    if not len(all_solutions):
        return unknown, "the nominal arm does not reach it from anywhere"
    turned = np.concatenate([_turned(arm, q) for q in all_solutions])
    fitting = turned[_fits(arm, language, turned, stated, required)]
    if not len(fitting):
        return unknown, (
            f"no solution of {arm.name} has the configuration that is stated: the description "
            "counts joints differently from the controller, or is of another arm"
        )
    reference = np.zeros(JOINTS) if previous is None else previous
    distance = np.abs(fitting - reference).max(axis=1)
    order = np.argsort(distance, kind="stable")
    best = fitting[order[0]]
    poses = np.abs(np.sin((fitting - best) / 2)).max(axis=1) > 1e-6  # other than by whole turns
    nearest_other = distance[poses].min(initial=np.inf)
    certain = (
        not poses.any() if previous is None else nearest_other > distance[order[0]] + BRANCH_MARGIN
    )
    if not certain:
        return best, "several branches of the arm are possible; valid: joint values in its place"
    return best, ""


def _agree(arm: Arm, language: Language, q: Floats, stated: Ints) -> Bools:
    """(K, F) whether joint values (K, 6) agree with each flag; at a border, with either value."""
    shapes = shape(arm, q)
    near = (language.flags(q + d, shapes) for d in (0.0, -FLAG_BORDER, FLAG_BORDER))
    return np.asarray(np.any([values == stated for values in near], axis=0))


def _fits(arm: Arm, language: Language, q: Floats, stated: Ints, required: Bools) -> Bools:
    """(K,) whether joint values (K, 6) agree with the required flags."""
    return np.asarray(_agree(arm, language, q, stated)[:, required].all(axis=1))


def _turned(arm: Arm, q: Floats) -> Floats:
    """(K, 6) joint values that differ by whole turns and are within the limits."""
    choices = [
        [v + 2 * np.pi * k for k in range(-3, 4) if low <= v + 2 * np.pi * k <= high]
        for v, low, high in zip(q, arm.q_min, arm.q_max, strict=True)
    ]
    return np.array(list(product(*choices))).reshape(-1, JOINTS)
