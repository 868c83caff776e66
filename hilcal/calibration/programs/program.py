"""Programs of any maker: their points, the places of the numbers in the text, and their units.

A point is joint values, or a pose of a tool in a frame. Its numbers are replaced in place; all
other text stays, byte by byte, as does the text of a point that did not move.

A corrected pose is the pose of the nominal arm, with which the controller computes, at the
corrected joint values:

    T_frame_tool = T_base_frame⁻¹ T_base_flange(q) T_flange_tool
"""

import re
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from pydantic import Field

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.chain import evaluate
from hilcal.toml import Number, Section, load_section
from hilcal.types import Floats, Ints

JOINTS = 6
DECIMAL = r"[-+]?(?:\d+\.?\d*|\.\d+)"  # pattern of a number without exponent
UNSTATED = -99  # a flag of a configuration that is not stated
SAME_M, SAME_RAD = 2e-9, 2e-9
"""m, rad; a point that moved less keeps its text: above the residual of the inverse, see
`calibration.compensation.TOLERANCE`, and below the resolution of any controller."""
CORRECTED = "corrected by hilcal"
"""Comment of a program with corrected points; such a program is not corrected again."""
GIMBAL = 1e-9  # cos B below which A and C turn about one axis
MOVES = "external axis {} moves, whose effect on the tool is not known"
"""Why a point with an external axis is not corrected."""


@dataclass(frozen=True, slots=True)
class Span:
    """A piece of a text."""

    file: int
    start: int
    end: int


@dataclass(frozen=True, slots=True, eq=False)
class ProgramPoint:
    """One point of a program, in the order of its first use."""

    line: int  # of its numbers, from 1
    name: str  # for people, with its line
    numbers: tuple[Span, ...] = ()  # places of its k numbers: joint values or a pose
    values: Floats = field(default_factory=lambda: np.empty(0))  # (k,) numbers as written
    joints: bool = False  # whether they are joint values
    scale: Floats = field(default_factory=lambda: np.full(JOINTS, np.degrees(1.0)))
    """(6,) units of joint values in the language, per rad."""
    frame: Floats = field(default_factory=lambda: np.eye(4))  # (4, 4) T_base_frame of a pose
    tool: Floats = field(default_factory=lambda: np.eye(4))  # (4, 4) T_flange_tool
    flags: tuple[int, ...] = ()  # the configuration, see `Language.flags`
    config: tuple[Span, ...] = ()  # places of its changeable part; empty if it cannot change
    flags_obeyed: bool = True
    """Whether the controller obeys the configuration, or stays on the branch of the last point."""
    template: str = ""
    """Of a point that the program computes (`Offs(p, …)`), the text for `numbers[0]`, with fields
    for the numbers and the changeable configuration; else ""."""
    not_corrected: str = ""  # why it is not corrected; empty if it is understood
    blend_m: float = 0.0  # 0, since only URScript states it at the point

    def refused(self, reason: str) -> "ProgramPoint":
        """Return the point with the reason why it is not corrected."""
        return replace(self, not_corrected=reason)

    def at_joints(
        self, numbers: Sequence[Span], values: Floats, tool: Floats | str
    ) -> "ProgramPoint":
        """Return the point with joint values, which hold with any tool, even an unknown one."""
        known_tool = np.eye(4) if isinstance(tool, str) else tool
        return replace(self, numbers=tuple(numbers), values=values, joints=True, tool=known_tool)

    def at_pose(
        self, numbers: Sequence[Span], values: Floats, tool: Floats | str, frame: Floats | str
    ) -> "ProgramPoint":
        """Return the point with a pose; it is not corrected if tool or frame is a reason (text)."""
        if isinstance(tool, str) or isinstance(frame, str):
            return self.refused(tool if isinstance(tool, str) else str(frame))
        return replace(self, numbers=tuple(numbers), values=values, tool=tool, frame=frame)


@dataclass(frozen=True, slots=True)
class Language:
    """Notation of points in a maker's programs."""

    name: str
    pose: Callable[[Floats], Floats]  # T (4, 4) of the numbers of a pose
    numbers: Callable[[Floats, Floats], Floats]
    """The numbers of T (4, 4) that are nearest to the old ones."""
    decimals: tuple[int, int, int]
    """Least number of decimals of a position in mm, of the orientation, of joint values."""
    axes: tuple[tuple[int, int, int], ...]
    """(6, 3) joint axes of the maker's arms with spherical wrist at zero, base axes."""
    flags: Callable[[Floats, Ints], Ints]
    """(K, F) configuration at joint values (K, 6), with `languages.shape` (K, 2) there."""
    shape_flags: tuple[bool, ...]  # (F,) which flags depend on the shape of the arm, too
    motions: str  # its motions, for people
    marked: Callable[[str], str]
    """The text of a program with the comment `CORRECTED`."""
    config_texts: Callable[[Ints, Sequence[str]], list[str]] = lambda _, texts: list(texts)
    """New texts at `ProgramPoint.config`, from the flags and the old texts."""
    padded: bool = False  # whether numbers are aligned in columns
    pose_numbers: int = JOINTS  # numbers of a pose
    frames: str = "F.toml"  # files that --frames accepts


@dataclass(frozen=True, slots=True, eq=False)
class Program:
    """A program."""

    language: Language
    suffixes: tuple[str, ...]
    texts: tuple[str, ...]  # of its files, unchanged
    points: tuple[ProgramPoint, ...]  # in the order of their first use
    encoding: str = "utf-8"
    payloads: tuple[tuple[int, float], ...] = ()
    """Masses at the flange that it states, kg: tool and load together; each with its line."""

    @property
    def correctable_points(self) -> list[ProgramPoint]:
        """Points that can be corrected."""
        return [p for p in self.points if not p.not_corrected]

    def corrected(
        self, arm: Arm, points: Sequence[ProgramPoint], old_q: Floats, q: Floats, flags: Ints
    ) -> dict[str, bytes]:
        """Return the files by suffix, with N corrected points.

        `old_q`, `q` (N, 6) are joint values before and after, rad; `flags` (N, F) the new flags.
        """
        chain = evaluate(arm, q)
        flanges = se3.matrix(chain.rotation[-1], chain.position[-1])
        rows = zip(points, flanges, old_q, q, flags, strict=True)
        edits = [edit for row in rows for edit in self._edits(*row)]
        new = [
            edited(text, [e for e in edits if e[0].file == k]) for k, text in enumerate(self.texts)
        ]
        if edits:
            new[0] = self.language.marked(new[0])
        return {s: text.encode(self.encoding) for s, text in zip(self.suffixes, new, strict=True)}

    def _edits(
        self, p: ProgramPoint, flange: Floats, old_q: Floats, q: Floats, flags: Ints
    ) -> list[tuple[Span, str]]:
        language = self.language
        if np.abs(q - old_q).max() < SAME_RAD:
            return []
        if p.joints:
            degrees = np.allclose(p.scale, np.degrees(1.0))  # else pulses, which are integers
            return self._numbers(p, q * p.scale, [language.decimals[2] * degrees] * JOINTS)
        goal = se3.inverse(p.frame) @ flange @ p.tool
        was = language.pose(p.values)
        turned = se3.rotation_vector(goal[:3, :3] @ was[:3, :3].T)
        moved = np.linalg.norm(goal[:3, 3] - was[:3, 3])
        if moved < SAME_M and np.linalg.norm(turned) < SAME_RAD:
            return []
        new = language.numbers(goal, p.values)
        decimals = [language.decimals[0]] * 3 + [language.decimals[1]] * (len(new) - 3)
        old = [self.texts[s.file][s.start : s.end] for s in p.config]
        config = language.config_texts(flags, old) if p.config or p.template else []
        if not config and np.any(flags != np.array(p.flags)):
            raise InputError(
                f"{p.name}: the correction takes a joint into another configuration, which is "
                "stated for several points at once; valid: joint values in its place"
            )
        if p.template:
            texts = [f"{v:.{d}f}" for v, d in zip(new, decimals, strict=True)]
            return [(p.numbers[0], p.template.format(*texts, *config))]
        changed = [(s, w) for s, w, o in zip(p.config, config, old, strict=True) if w != o]
        return self._numbers(p, new, decimals) + changed

    def _numbers(
        self, p: ProgramPoint, new: Floats, decimals: Sequence[int]
    ) -> list[tuple[Span, str]]:
        """Edits that replace the numbers, with at least as many decimals as the old ones."""
        out = []
        for span, value, least in zip(p.numbers, new.tolist(), decimals, strict=True):
            old = self.texts[span.file][span.start : span.end]
            digits = old.lower().partition("e")[0].partition(".")[2]
            text = f"{value:.{max(least, len(digits.strip())) if least else 0}f}"
            if text.strip("-0.") == "":
                text = text.lstrip("-")
            if self.language.padded:
                text = text.rjust(len(old))
                text = text if text.startswith(" ") or not old.startswith(" ") else f" {text}"
            out.append((span, text))
        return out


def edited(text: str, edits: Sequence[tuple[Span, str]]) -> str:
    """Return a text with some spans replaced."""
    parts, end = [], 0
    for span, new in sorted(edits, key=lambda e: e[0].start):
        parts += [text[end : span.start], new]
        end = span.end
    return "".join([*parts, text[end:]])


def read_text(path: Path) -> tuple[str, str]:
    """Text of a file with unchanged line ends, and its encoding."""
    raw = limits.read_bytes(path, limits.SCRIPT)
    if b"\x00" in raw:
        raise InputError(f"{path}: a binary file; valid: a program as text")
    try:
        return raw.decode("utf-8"), "utf-8"
    except UnicodeDecodeError:
        return raw.decode("latin-1"), "latin-1"  # controllers write comments in the local set


def arguments_of(text: str) -> list[tuple[int, str]]:
    """Parts between commas outside of brackets, with their offsets."""
    out, depth, begin = [], 0, 0
    for k, sign in enumerate(text):
        depth += (sign in "{[(") - (sign in "}])")
        if sign == "," and depth == 0:
            out.append((begin, text[begin:k]))
            begin = k + 1
    return [*out, (begin, text[begin:])]


def numbers_in(text: str, pattern: re.Pattern[str], offset: int) -> tuple[Floats, list[Span]]:
    """Numbers of a text at an offset of the file, with their places."""
    matches = list(pattern.finditer(text))
    values = np.array([float(m[0]) for m in matches])
    return values, [Span(0, offset + m.start(), offset + m.end()) for m in matches]


def line_of(text: str, offset: int) -> int:
    """Line of an offset in a text, from 1."""
    return bisect_left(_ends(text), offset) + 1


@lru_cache(maxsize=4)
def _ends(text: str) -> list[int]:
    return [m.start() for m in re.finditer("\n", text)]


class _FramesFile(Section):
    """`--frames F.toml`: the controller's tools and frames, in the controller's notation."""

    tools: dict[str, tuple[Number, ...]] = Field(default_factory=dict, description="numbers")
    bases: dict[str, tuple[Number, ...]] = Field(default_factory=dict, description="numbers")
    pulses_per_degree: tuple[Number, ...] | None = Field(None, description="a number per joint")
    turn_axes: tuple[int, ...] | None = Field(None, description="three numbers of axes")


@dataclass(frozen=True, slots=True, eq=False)
class ControllerFrames:
    """What the controller stores outside of programs."""

    language: Language
    poses: Mapping[str, Mapping[str, Floats]]
    """(4, 4) T_flange_tool by number or name under "tools", T_base_frame under "bases"."""
    pulses: Floats | None = None  # (6,) pulses per rad; None if not stated
    turn_axes: tuple[int, ...] | None = None
    """Axes of the three turn numbers of a Fanuc, `$SCR_GRP[1].$TURN_AXIS`."""
    tool: Floats | None = None  # (4, 4) from --tool, of tools that `poses` lacks

    def stated(self, group: str, name: str) -> Floats | None:
        """Pose (4, 4) of one of the "tools" or "bases" in the file of --frames."""
        named = (pose for key, pose in self.poses[group].items() if key.upper() == name.upper())
        return next(named, None)

    def pose(self, group: str, name: str, label: str, identity: str = "0") -> Floats | str:
        """Pose (4, 4) of a tool or base, or why it is unknown; `label` names it for people.

        `identity` is the name of the flange as tool, or of the robot's base as frame.
        """
        stated = self.stated(group, name)
        if stated is not None or name.upper() == identity:
            return np.eye(4) if stated is None else stated
        if group == "tools" and self.tool is not None:
            return self.tool
        hint = " or --tool" if group == "tools" else ""
        return f"{label} is not in the program; give it by --frames ({self.language.frames}){hint}"


def controller_frames(
    path: Path | None, language: Language, tool: Floats | None
) -> ControllerFrames:
    """Read `--frames F.toml` if there is one; `tool` (4, 4) is that of tools that no file has."""
    if path is None:
        return ControllerFrames(language, {"tools": {}, "bases": {}}, tool=tool)
    if path.suffix.lower() != ".toml":
        raise InputError(f"{path}: frames of {language.name} programs; valid: {language.frames}")
    section, count = load_section(path, _FramesFile), language.pose_numbers
    poses: dict[str, dict[str, Floats]] = {"tools": {}, "bases": {}}
    for key, group in (("tools", section.tools), ("bases", section.bases)):
        for name, numbers in group.items():
            if len(numbers) != count:
                raise InputError(
                    f"{path.name}: {key}.{escaped(name)} has {len(numbers)} numbers; valid: "
                    f"{count}, as the controller shows them: mm and degrees"
                    + (", x y z q1 q2 q3 q4" if count > JOINTS else "")
                )
            poses[key][name] = language.pose(np.array(numbers))
    pulses = section.pulses_per_degree
    if pulses is not None and (len(pulses) != JOINTS or not all(pulses)):
        raise InputError(f"{path.name}: pulses_per_degree; valid: {JOINTS} numbers other than 0")
    axes = section.turn_axes
    if axes is not None and (len(axes) != 3 or not set(axes) <= set(range(1, JOINTS + 1))):
        raise InputError(f"{path.name}: turn_axes; valid: three axes, such as [1, 4, 6]")
    per_rad = None if pulses is None else np.degrees(1.0) * np.array(pulses)
    return ControllerFrames(language, poses, per_rad, axes, tool)


class ProgramReader:
    """Base of the readers of all makers, which collect the points of a program's text."""

    def __init__(
        self, path: Path, language: Language, frames_file: Path | None, tool: Floats | None
    ):
        self.path, self.controller = path, controller_frames(frames_file, language, tool)
        self.text, self.encoding = read_text(path)
        if CORRECTED in self.text:
            raise self.error(
                line_of(self.text, self.text.index(CORRECTED)),
                "it is corrected already, and a second correction would double the first",
                "the original program",
            )
        self.points: dict[str, ProgramPoint] = {}
        self.other_uses: dict[str, int] = {}
        """Points that statements other than motions use, with the line."""
        self.payloads: dict[int, float] = {}  # `Program.payloads`

    def mark_not_corrected(self, line: int, why: str) -> None:
        """Record a motion that is not corrected."""
        self.points[f"line {line}"] = ProgramPoint(line, f"line {line}", not_corrected=why)

    def error(self, line: int, reason: str, valid: str) -> InputError:
        """Return the error of a statement that changes the meaning of points."""
        return InputError(f"{self.path.name}: line {line}: {reason}; valid: {valid}")

    def record(self, key: str, new: ProgramPoint, line: int, flags_obeyed: bool = False) -> None:
        """Record the point of a motion; a known point with other frames is not corrected."""
        old = self.points.get(key)
        if old is None or (new.not_corrected and not old.not_corrected):
            self.points[key] = new
        elif not old.not_corrected:
            same = np.array_equal(old.tool, new.tool) and np.array_equal(old.frame, new.frame)
            reason = "" if same else f"line {line} has it with another tool or base"
            self.points[key] = replace(
                old, not_corrected=reason, flags_obeyed=old.flags_obeyed or flags_obeyed
            )

    def program(self, texts: Sequence[str] = (), suffixes: Sequence[str] = ()) -> Program:
        """Return the program with all recorded points."""
        said = {p.line for p in self.points.values() if p.name == f"line {p.line}"}
        for name, line in self.other_uses.items():
            point = self.points.get(name)
            if point is None and line not in said:
                why = f"it uses the point '{name[:40]}' otherwise than as the end of a known motion"
                self.mark_not_corrected(line, why)
            elif point is not None and not point.not_corrected:
                self.points[name] = point.refused(f"line {line} uses or changes it otherwise")
        language, points = self.controller.language, tuple(self.points.values())
        if not points:
            raise InputError(f"{self.path.name}: no motions; valid: {language.motions}")
        suffixes, texts = tuple(suffixes) or (self.path.suffix,), tuple(texts) or (self.text,)
        payloads = tuple(self.payloads.items())
        return Program(language, suffixes, texts, points, self.encoding, payloads)


def of_euler(values: Floats) -> Floats:
    """T (4, 4) of x, y, z in mm and turns about z, then y, then x in degrees: Rz(A) Ry(B) Rx(C)."""
    if not np.isfinite(values).all():  # the caller refuses it by its line
        return np.full((4, 4), np.nan)
    turn = se3.of_rpy(np.radians(values[5:2:-1]))
    return se3.matrix(turn, 1e-3 * np.asarray(values[:3], dtype=float))


def to_euler(t: Floats, near: Floats) -> Floats:
    """x, y, z in mm and A, B, C in degrees of T (4, 4); of equivalent angles the nearest ones."""
    r = t[:3, :3]
    a = np.radians(near[3])
    if np.hypot(r[0, 0], r[1, 0]) > GIMBAL:
        a = np.arctan2(r[1, 0], r[0, 0])
    ca, sa = np.cos(a), np.sin(a)
    b = np.arctan2(-r[2, 0], ca * r[0, 0] + sa * r[1, 0])
    c = np.arctan2(sa * r[0, 2] - ca * r[1, 2], ca * r[1, 1] - sa * r[0, 1])
    both = np.degrees([[a, b, c], [a + np.pi, np.pi - b, c + np.pi]])
    both += 360.0 * np.rint((near[3:6] - both) / 360.0)
    angles = both[int(np.argmin(np.abs(both - near[3:6]).sum(axis=1)))]
    return np.concatenate([1e3 * t[:3, 3], angles])


def of_wpr(values: Floats) -> Floats:
    """T (4, 4) of x, y, z in mm and W, P, R in degrees: Rz(R) Ry(P) Rx(W)."""
    return of_euler(np.concatenate([values[:3], values[5:2:-1]]))


def to_wpr(t: Floats, near: Floats) -> Floats:
    """Inverse of `of_wpr`; of equivalent angles the nearest to `near`."""
    out = to_euler(t, np.concatenate([near[:3], near[5:2:-1]]))
    return np.concatenate([out[:3], out[5:2:-1]])
