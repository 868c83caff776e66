"""What a program of any maker holds: its points, where their numbers stand, and what they count in.

A point is joint values, or a pose of a tool in a frame. Its numbers are replaced where they stand;
all other text stays, byte by byte. A point that did not move keeps its own text, too.

A pose becomes the pose at which the nominal arm, which is the one that the controller computes
with, has the corrected joint values:

    T_frame_tool = T_base_frame⁻¹ T_base_flange(q) T_flange_tool
"""

import re
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

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
DECIMAL = r"[-+]?(?:\d+\.?\d*|\.\d+)"
"""Pattern of a number without exponent."""
UNSTATED = -99
"""A flag of a configuration that is not stated."""
SAME_M, SAME_RAD = 2e-9, 2e-9
"""m, rad; a point that moved less keeps its text: above what the inverse leaves, see
`calibration.compensation.TOLERANCE`, and below what any controller resolves."""
GIMBAL = 1e-9
"""cos B below which A and C turn about one axis."""


@dataclass(frozen=True, slots=True)
class Span:
    """A piece of a text."""

    file: int
    begin: int
    end: int


@dataclass(frozen=True, slots=True, eq=False)
class ProgramPoint:
    """One point of a program, in the order of its first use."""

    line: int  # of its numbers, from 1
    name: str  # for people, with its line
    numbers: tuple[Span, ...] = ()  # where its numbers stand: joint values, or those of a pose
    values: Floats = field(default_factory=lambda: np.empty(0))  # (k,) these as written
    joints: bool = False  # whether they are joint values
    scale: Floats = field(default_factory=lambda: np.full(JOINTS, np.degrees(1.0)))
    """(6,) what the language counts joint values in, per rad."""
    frame: Floats = field(default_factory=lambda: np.eye(4))  # (4, 4) T_base_frame of a pose
    tool: Floats = field(default_factory=lambda: np.eye(4))  # (4, 4) T_flange_tool
    flags: tuple[int, ...] = ()  # the configuration as `Language.flags` has it
    config: tuple[Span, ...] = ()  # where what of it may change stands; empty where it cannot
    obeyed: bool = True
    """Whether the controller takes the configuration that is stated; it goes on from the point
    before otherwise."""
    made: str = ""
    """Text of the whole span `numbers[0]`, with places for the numbers and the changeable
    configuration, where the point is computed in the program (`Offs(p, …)`); else ""."""
    left: str = ""  # why it is left as it is; empty where it is understood
    blend_m: float = 0.0  # 0, since only URScript states it at the point

    def at_joints(
        self, numbers: Sequence[Span], values: Floats, tool: Floats | str
    ) -> "ProgramPoint":
        """Return the point of joint values: they hold with any tool, one that is not known, too."""
        held = np.eye(4) if isinstance(tool, str) else tool
        return replace(self, numbers=tuple(numbers), values=values, joints=True, tool=held)

    def at_pose(
        self,
        numbers: Sequence[Span],
        values: Floats,
        tool: Floats | str,
        frame: Floats | str,
        **more: Any,
    ) -> "ProgramPoint":
        """Return the point of a pose; it is left where tool or frame is a text, which says why."""
        if isinstance(tool, str) or isinstance(frame, str):
            return replace(self, left=tool if isinstance(tool, str) else str(frame))
        return replace(self, numbers=tuple(numbers), values=values, tool=tool, frame=frame, **more)


def _as_written(_: Ints, texts: Sequence[str]) -> list[str]:
    return list(texts)


@dataclass(frozen=True, slots=True)
class Language:
    """How a maker writes points."""

    name: str
    pose: Callable[[Floats], Floats]  # T (4, 4) of the numbers of a pose
    numbers: Callable[[Floats, Floats], Floats]
    """The numbers of T (4, 4), near to those that were there."""
    decimals: tuple[int, int, int]
    """Of a position in mm, of the orientation, of joint values; at least these."""
    axes: tuple[tuple[int, int, int], ...]
    """(6, 3) directions of the axes of the maker's arms with spherical wrist, all joint values
    zero, in axes of the controller's base."""
    flags: Callable[[Floats, Ints], Ints]
    """(K, F) configuration at joint values (K, 6), by the `languages.shape` (K, 2) there."""
    of_shape: tuple[bool, ...]
    """(F,) which of these the shape of the arm tells, and not the joint values alone."""
    moves: str  # its motions, for people
    written: Callable[[Ints, Sequence[str]], list[str]] = _as_written
    """What stands at `ProgramPoint.config`, from the flags and the texts that are there."""
    padded: bool = False  # whether numbers stand in columns
    count: int = JOINTS  # numbers of a pose
    frames: str = "F.toml"  # what --frames takes


@dataclass(frozen=True, slots=True, eq=False)
class Program:
    """A program."""

    language: Language
    suffixes: tuple[str, ...]
    texts: tuple[str, ...]  # of its files, as they are
    points: tuple[ProgramPoint, ...]  # in the order of their first use
    encoding: str = "utf-8"

    @property
    def understood(self) -> list[ProgramPoint]:
        """Points that are not left."""
        return [p for p in self.points if not p.left]

    def corrected(
        self, arm: Arm, found: Sequence[ProgramPoint], given: Floats, q: Floats, flags: Ints
    ) -> dict[str, bytes]:
        """Return the files, by suffix, with N other points.

        They had joint values `given` (N, 6), rad, and get q and the configuration `flags` (N, F).
        """
        edits: list[tuple[Span, str]] = []
        poses = evaluate(arm, q)
        for k, p in enumerate(found):
            flange = se3.matrix(poses.rotation[-1][k], poses.position[-1][k])
            edits += self._edits(p, flange, given[k], q[k], flags[k])
        out = {}
        for k, (suffix, text) in enumerate(zip(self.suffixes, self.texts, strict=True)):
            new = edited(text, [(s, words) for s, words in edits if s.file == k])
            out[suffix] = new.encode(self.encoding)
        return out

    def _edits(
        self, p: ProgramPoint, flange: Floats, given: Floats, q: Floats, flags: Ints
    ) -> list[tuple[Span, str]]:
        """Texts that change at one point."""
        language = self.language
        if np.abs(q - given).max() < SAME_RAD:
            return []
        if p.joints:
            degrees = np.allclose(p.scale, np.degrees(1.0))  # others are pulses, which are whole
            return self._numbers(p, q * p.scale, [language.decimals[2] * degrees] * JOINTS)
        goal = se3.inverse(p.frame) @ flange @ p.tool
        was = language.pose(p.values)
        turned = se3.rotation_vector(goal[:3, :3] @ was[:3, :3].T)
        moved = np.linalg.norm(goal[:3, 3] - was[:3, 3])
        if moved < SAME_M and np.linalg.norm(turned) < SAME_RAD:
            return []
        new = language.numbers(goal, p.values)
        decimals = [language.decimals[0]] * 3 + [language.decimals[1]] * (len(new) - 3)
        old = [self._text(s) for s in p.config]
        words = language.written(flags, old) if p.config or p.made else []
        if not words and np.any(flags != np.array(p.flags)):
            raise InputError(
                f"{p.name}: the correction takes a joint into another configuration, which is "
                "stated for several points at once; valid: joint values in its place"
            )
        if p.made:
            texts = [f"{v:.{d}f}" for v, d in zip(new, decimals, strict=True)]
            return [(p.numbers[0], p.made.format(*texts, *words))]
        changed = [(s, w) for s, w, o in zip(p.config, words, old, strict=True) if w != o]
        return self._numbers(p, new, decimals) + changed

    def _text(self, span: Span) -> str:
        return self.texts[span.file][span.begin : span.end]

    def _numbers(
        self, p: ProgramPoint, new: Floats, decimals: Sequence[int]
    ) -> list[tuple[Span, str]]:
        """Numbers in the place of those that were there, with as many decimals at least."""
        out = []
        for span, value, least in zip(p.numbers, new.tolist(), decimals, strict=True):
            old = self._text(span)
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
    """Return a text with other pieces in the place of some."""
    parts, at = [], 0
    for span, new in sorted(edits, key=lambda e: e[0].begin):
        parts += [text[at : span.begin], new]
        at = span.end
    return "".join([*parts, text[at:]])


def read_text(path: Path) -> tuple[str, str]:
    """Text of a file with its line ends as they are, and its encoding."""
    try:
        raw = limits.read_bytes(path, limits.SCRIPT)
    except OSError as error:
        raise InputError(f"{path}: cannot be read as a program: {error}") from None
    if b"\x00" in raw:
        raise InputError(f"{path}: a binary file; valid: a program as text")
    try:
        return raw.decode("utf-8"), "utf-8"
    except UnicodeDecodeError:
        return raw.decode("latin-1"), "latin-1"  # controllers write comments in the local set


def arguments_of(text: str) -> list[tuple[int, str]]:
    """Parts between commas that are in no bracket, with their places."""
    out, depth, begin = [], 0, 0
    for k, sign in enumerate(text):
        depth += (sign in "{[(") - (sign in "}])")
        if sign == "," and depth == 0:
            out.append((begin, text[begin:k]))
            begin = k + 1
    return [*out, (begin, text[begin:])]


def line_of(text: str, at: int) -> int:
    """Line of a place in a text, from 1."""
    return bisect_left(_ends(text), at) + 1


@lru_cache(maxsize=4)
def _ends(text: str) -> list[int]:
    """Where the lines of a text end."""
    return [m.start() for m in re.finditer("\n", text)]


class _FramesFile(Section):
    """`--frames F.toml`: the controller's tools and frames, as it shows them."""

    tools: dict[str, tuple[Number, ...]] = Field(default_factory=dict, description="numbers")
    bases: dict[str, tuple[Number, ...]] = Field(default_factory=dict, description="numbers")
    pulses_per_degree: tuple[Number, ...] | None = Field(None, description="a number per joint")
    turn_axes: tuple[int, ...] | None = Field(None, description="three numbers of axes")


@dataclass(frozen=True, slots=True, eq=False)
class ControllerFrames:
    """What the controller keeps apart from programs."""

    language: Language
    poses: Mapping[str, Mapping[str, Floats]]
    """(4, 4) T_flange_tool by number or name under "tools", T_base_frame under "bases"."""
    pulses: Floats | None = None  # (6,) pulses per rad; None where they are not given
    turn_axes: tuple[int, ...] | None = None
    """Axes that the three turn numbers of a Fanuc are of, `$SCR_GRP[1].$TURN_AXIS`."""
    tool: Floats | None = None  # (4, 4) of tools that have none here, from --tool; None without it

    def given(self, what: str, name: str) -> Floats | None:
        """Pose (4, 4) of one of the "tools" or "bases" in the file of --frames."""
        named = (pose for key, pose in self.poses[what].items() if key.upper() == name.upper())
        return next(named, None)

    def pose(self, what: str, name: str, words: str, none: str = "0") -> Floats | str:
        """Pose (4, 4) of a tool or base, or why it is not known; `words` is what it is called.

        `none` is the name of that which is no tool, or the base itself.
        """
        given = self.given(what, name)
        if given is not None or name.upper() == none:
            return np.eye(4) if given is None else given
        if what == "tools" and self.tool is not None:
            return self.tool
        other = " or --tool" if what == "tools" else ""
        return f"{words} is not in the program; give it by --frames ({self.language.frames}){other}"


def controller_frames(
    path: Path | None, language: Language, tool: Floats | None
) -> ControllerFrames:
    """Read `--frames F.toml`, where there is one; `tool` (4, 4) is of tools that no file has."""
    if path is None:
        return ControllerFrames(language, {"tools": {}, "bases": {}}, tool=tool)
    if path.suffix.lower() != ".toml":
        raise InputError(f"{path}: frames of {language.name} programs; valid: {language.frames}")
    found, count = load_section(path, _FramesFile), language.count
    groups = {"tools": found.tools, "bases": found.bases}
    for key, group in groups.items():
        for name, numbers in group.items():
            if len(numbers) != count:
                raise InputError(
                    f"{path.name}: {key}.{escaped(name)} has {len(numbers)} numbers; valid: "
                    f"{count}, as the controller shows them: mm and degrees"
                    + (", x y z q1 q2 q3 q4" if count > JOINTS else "")
                )
    pulses = found.pulses_per_degree
    if pulses is not None and (len(pulses) != JOINTS or not all(pulses)):
        raise InputError(f"{path.name}: pulses_per_degree; valid: {JOINTS} numbers other than 0")
    axes = found.turn_axes
    if axes is not None and (len(axes) != 3 or not set(axes) <= set(range(1, JOINTS + 1))):
        raise InputError(f"{path.name}: turn_axes; valid: three axes, such as [1, 4, 6]")
    return ControllerFrames(
        language,
        {
            key: {name: language.pose(np.array(numbers)) for name, numbers in group.items()}
            for key, group in groups.items()
        },
        None if pulses is None else np.degrees(1.0) * np.array(pulses),
        axes,
        tool,
    )


class ProgramReader:
    """What the readers of all makers do alike: they go through the text and take its points."""

    def __init__(self, path: Path, known: ControllerFrames):
        """Read the text; no point is taken yet."""
        self.path, self.known = path, known
        self.text, self.encoding = read_text(path)
        self.found: dict[str, ProgramPoint] = {}
        self.otherwise: dict[str, int] = {}
        """Points that statements use which are no motions to them, with the line."""

    def leave(self, line: int, why: str) -> None:
        """Take a motion that is left as it is."""
        self.found[f"line {line}"] = ProgramPoint(line, f"line {line}", left=why)

    def refused(self, line: int, what: str, valid: str) -> InputError:
        """Return the error of a statement that changes what points mean."""
        return InputError(f"{self.path.name}: line {line}: {what}; valid: {valid}")

    def take(self, key: str, new: ProgramPoint, line: int, obeyed: bool = False) -> None:
        """Take the point of a motion; one that is there already is left where its frames differ."""
        old = self.found.get(key)
        if old is None or (new.left and not old.left):
            self.found[key] = new
        elif not old.left:
            same = np.array_equal(old.tool, new.tool) and np.array_equal(old.frame, new.frame)
            left = "" if same else f"line {line} has it with another tool or base"
            self.found[key] = replace(old, left=left, obeyed=old.obeyed or obeyed)

    def program(self, texts: Sequence[str] = (), suffixes: Sequence[str] = ()) -> Program:
        """Return the program with all points that were taken."""
        for name, line in self.otherwise.items():
            if name in self.found and not self.found[name].left:
                left = f"line {line} uses or changes it otherwise"
                self.found[name] = replace(self.found[name], left=left)
        language = self.known.language
        if not self.found:
            raise InputError(f"{self.path.name}: no motions; valid: {language.moves}")
        return Program(
            language,
            tuple(suffixes) or (self.path.suffix,),
            tuple(texts) or (self.text,),
            tuple(self.found.values()),
            self.encoding,
        )


def of_euler(values: Floats) -> Floats:
    """T (4, 4) of x, y, z in mm and turns about z, then y, then x in degrees: Rz(A) Ry(B) Rx(C)."""
    if not np.isfinite(values).all():  # refused by its line
        return np.full((4, 4), np.nan)
    turn = se3.of_rpy(np.radians(values[5:2:-1]))
    return se3.matrix(turn, 1e-3 * np.asarray(values[:3], dtype=float))


def to_euler(t: Floats, near: Floats) -> Floats:
    """x, y, z in mm and A, B, C in degrees of T (4, 4): of all that are the same, the nearest."""
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
    """Inverse of `of_wpr`, near to what was there."""
    out = to_euler(t, np.concatenate([near[:3], near[5:2:-1]]))
    return np.concatenate([out[:3], out[5:2:-1]])
