r"""ABB RAPID: a module (`.mod`, `.modx`, `.sys`, `.prg`).

Points are `robtarget` ([x, y, z] in mm, unit quaternion [q1, q2, q3, q4], configuration [cf1, cf4,
cf6, cfx], external axes) and `jointtarget` (degrees), declared with a value, or written into a
motion, or `Offs` and `RelTool` of one with numbers, which become the point that they make. cf1,
cf4, cf6 are the quadrants of axes 1, 4, 6, from 0 for 0° to 90° on; cfx has bits for axis 5
negative, the wrist centre behind the lower arm, and behind axis 1.

A robtarget counts from the object frame of the motion's `\WObj`, a tool is the motion's last
argument; both are `tooldata` and `wobjdata` of this module or of `--frames`.

Source: ABB, *Technical reference manual: RAPID Instructions, Functions and Data types*, robtarget,
confdata, tooldata, wobjdata, MoveL, Offs, RelTool; *RAPID Overview*.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilcal.calibration.programs.program import (
    JOINTS,
    UNSTATED,
    ControllerFrames,
    Language,
    Program,
    ProgramPoint,
    Span,
    arguments_of,
    controller_frames,
    line_of,
    of_euler,
    read_text,
    used_again,
)
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.types import Floats, Ints

POSE = 7
"""Numbers of a pose."""
LEAST = 4
"""Arguments that a motion has: point, speed, zone, tool."""
UNUSED = 8e8
"""A number from which on an external axis is none: 9E9."""
_STATEMENT = re.compile(r"[^;]*;")
_BLANK = re.compile(r'"[^"]*"|!.*')
_DATA = re.compile(
    r"^\s*(?:LOCAL\s+|TASK\s+)?(?:CONST|PERS|VAR)\s+(robtarget|jointtarget|tooldata|wobjdata)"
    r"\s+(\w+)\s*(\{[^}]*\})?\s*(?::=\s*(.*?))?\s*;$",
    re.IGNORECASE | re.DOTALL,
)
_MOTION = re.compile(r"\b(Move(?:AbsJ|J|L|C)|Trigg[JLC])\s+(?!:=)", re.IGNORECASE)
_OTHER_MOTION = re.compile(
    r"\b(Move\w+|Trigg(?:J|L|C|AbsJ)\w+|Search[LC]\w*|Arc[LC]\w*|Paint[LC]\w*|Spot[LJM]\w*"
    r"|Disp[LC]\w*|IndAMove|IndCMove|IndRMove|StorePath|StartMove\w*)\b(?!\s*:=)",
    re.IGNORECASE,
)
_MOVES_NOTHING = ("MOVEEXTJ", "STOREPATH", "STARTMOVE", "STARTMOVERETRY")
_REFUSED = re.compile(
    r"\b(PDispOn|PDispSet|EOffsOn|EOffsSet|CorrCon|CorrWrite|ActUnit|DropWObj|WaitWObj"
    r"|SoftAct|PathOffs\w*)\b",
    re.IGNORECASE,
)
_CONF = re.compile(r"\b(ConfJ|ConfL)\s*\\\s*(On|Off)\b", re.IGNORECASE)
_ASSIGNED = re.compile(r"\b([A-Za-z]\w*)(?:\.\w+|\{[^}]*\})*\s*:=")
_NO_ASSIGNMENT = re.compile(r"(\b(CONST|PERS|VAR)\s[^;]*|\\\s*)$", re.IGNORECASE)
_MADE = re.compile(r"^(Offs|RelTool)\s*\((.*)\)$", re.IGNORECASE | re.DOTALL)
_NAME = re.compile(r"[A-Za-z]\w*")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


def of_quaternion(values: Floats) -> Floats:
    """T (4, 4) of x, y, z in mm and a unit quaternion, its real part first."""
    q = np.asarray(values[3:7], dtype=float)
    with np.errstate(all="ignore"):  # what is not finite is refused by its line
        q = q / np.linalg.norm(q)
    return se3.matrix(se3.of_quaternion(q), 1e-3 * np.asarray(values[:3], dtype=float))


def to_quaternion(t: Floats, near: Floats) -> Floats:
    """Inverse of `of_quaternion`, of the sign that was there."""
    q = se3.quaternion(t[:3, :3])
    return np.concatenate([1e3 * t[:3, 3], q if q @ near[3:7] >= 0 else -q])


def flags(q: Floats, shape: Ints) -> Ints:
    """(K, 4) cf1, cf4, cf6, cfx at joint values (K, 6)."""
    quadrants = np.floor(q[:, [0, 3, 5]] / (np.pi / 2)).astype(np.int64)
    cfx = (q[:, 4] < 0) + 2 * shape[:, 1] + 4 * shape[:, 0]
    return np.column_stack([quadrants, cfx])


RAPID = Language(
    name="RAPID",
    pose=of_quaternion,
    numbers=to_quaternion,
    decimals=(6, 9, 7),
    axes=((0, 0, 1), (0, 1, 0), (0, 1, 0), (1, 0, 0), (0, 1, 0), (1, 0, 0)),
    flags=flags,
    of_shape=(False, False, False, True),
    written=lambda new, texts: [str(v) for v in new[:3]],
)


@dataclass(frozen=True, slots=True)
class _Number:
    """A number and where it stands."""

    value: float
    begin: int
    end: int


def read_rapid(path: Path, frames_file: Path | None, tool: Floats | None) -> Program:
    """Read a module.

    Args:
        tool: (4, 4) T_flange_tool of tools that no file has; None without it.
    """
    text, encoding = read_text(path)
    module = frames_file is not None and frames_file.suffix.lower() != ".toml"
    known = controller_frames(None if module else frames_file, RAPID, tool, POSE)
    more = read_text(frames_file)[0] if frames_file is not None and module else ""
    reader = _RapidReader(path.name, text, more, known)
    return Program(RAPID, (path.suffix,), (text,), reader.points(), encoding)


def _statements(text: str) -> Iterator[tuple[int, str]]:
    """Yield place and code of each statement: comments and texts blanked, of the same length."""
    code = _BLANK.sub(lambda m: " " * len(m[0]), text)
    for m in _STATEMENT.finditer(code):
        yield m.start(), m[0]


def _numbers(text: str, at: int) -> list[_Number]:
    """All numbers of an aggregate; `at` is its place in the file."""
    return [_Number(float(m[0]), at + m.start(), at + m.end()) for m in _NUMBER.finditer(text)]


def _form(text: str) -> str:
    """An aggregate with its numbers as 0, to compare its form."""
    return re.sub(r"\s", "", _NUMBER.sub("0", text))


_ROBTARGET = "[[0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,0,0,0]]"
_JOINTTARGET = "[[0,0,0,0,0,0],[0,0,0,0,0,0]]"


class _RapidReader:
    """Goes through the statements of a module in the order of its text."""

    def __init__(self, name: str, text: str, more: str, known: ControllerFrames):
        self.name, self.text, self.known = name, text, known
        self.statements = list(_statements(text))
        self.data: dict[str, list[tuple[str, str, int]]] = {}
        self.frames: dict[str, list[tuple[str, str, int]]] = {}
        for at, code in self.statements:
            self._collect(at, code, self.data)
        for at, code in _statements(more):
            self._collect(at, code, self.frames)
        self.assigned = dict(self._assignments())
        self.found: dict[str, ProgramPoint] = {}

    def _collect(self, at: int, code: str, into: dict[str, list[tuple[str, str, int]]]) -> None:
        """Take the last declaration of a statement: before it a header without `;` may stand."""
        for m in re.finditer(r"\b(?:LOCAL\s+|TASK\s+)?(?:CONST|PERS|VAR)\s", code, re.I):
            if d := _DATA.match(code[m.start() :]):
                value = d[4] if d[4] is not None and d[3] is None else ""
                place = at + m.start() + (d.start(4) if d[4] is not None else 0)
                into.setdefault(d[2].upper(), []).append((d[1].lower(), value, place))
                return

    def _assignments(self) -> Iterator[tuple[str, int]]:
        """Yield names that get another value, wholly or in part, with the line."""
        for at, code in self.statements:
            for m in _ASSIGNED.finditer(code):
                if not _NO_ASSIGNMENT.search(code[: m.start()]):
                    yield m[1].upper(), line_of(self.text, at + m.start())

    def points(self) -> tuple[ProgramPoint, ...]:
        """All points; raises as `read_rapid` does."""
        used, obeyed = self._used_otherwise(), True
        for at, code in self.statements:
            if m := _REFUSED.search(code):
                raise InputError(
                    f"{self.name}: line {line_of(self.text, at + m.start())}: {m[1]} changes what "
                    "points mean; valid: a program without it"
                )
            if m := _CONF.search(code):
                obeyed = m[2].upper() == "ON"
            elif m := _MOTION.search(code):
                self._motion(at, code, m, obeyed, used)
            elif (m := _OTHER_MOTION.search(code)) and m[1].upper() not in _MOVES_NOTHING:
                line = line_of(self.text, at + m.start())
                left = f"{m[1]} is not corrected"
                self.found[f"line {line}"] = ProgramPoint(line, f"line {line}", left=left)
        if not self.found:
            raise InputError(f"{self.name}: no motions; valid: MoveJ, MoveL, MoveC, MoveAbsJ")
        return tuple(self.found.values())

    def _arguments(self, code: str, m: re.Match[str]) -> tuple[list[tuple[int, str]], str]:
        """Positional arguments of a motion with their places in the code, and its options."""
        parts, options, positional = arguments_of(code[m.end() : code.rindex(";")]), "", []
        for begin, part in parts:
            outer = re.sub(r"\([^()]*\)", lambda m: "(" + "." * (len(m[0]) - 2) + ")", part)
            cut = outer.find("\\") if "\\" in outer else len(part)
            plain, options = part[:cut], options + part[cut:]
            if plain.strip():
                lead = len(plain) - len(plain.lstrip())
                positional.append((m.end() + begin + lead, plain.strip()))
        return positional, options

    def _motion(
        self, at: int, code: str, m: re.Match[str], obeyed: bool, used: Mapping[str, int]
    ) -> None:
        """Take the targets of a motion."""
        word, line = m[1].upper(), line_of(self.text, at + m.start())
        given, options = self._arguments(code, m)
        if len(given) < LEAST:
            left = f"{m[1]} without its arguments"
            self.found[f"line {line}"] = ProgramPoint(line, f"line {line}", left=left)
            return
        targets = given[: 2 if word.endswith("C") else 1]
        tool = self._frame("tooldata", given[-1][1], line)
        named = re.search(r"\\\s*WObj\s*:=\s*(\w+)", options, re.I)
        frame = self._frame("wobjdata", named[1] if named else "wobj0", line)
        for place, text in targets:
            self._target(line, at + place, text, word == "MOVEABSJ", tool, frame, obeyed, used)

    def _frame(self, kind: str, name: str, line: int) -> Floats | str:
        """Pose of a tool or of an object frame, or why it is not known."""
        what, plain = ("tool", "TOOL0") if kind == "tooldata" else ("work object", "WOBJ0")
        key = name.upper()
        table = self.known.tools if kind == "tooldata" else self.known.bases
        for given, pose in table.items():
            if given.upper() == key:
                return pose
        values = self.data.get(key) or self.frames.get(key) or []
        if key == plain and not values:
            return np.eye(4)
        if len(values) != 1 or values[0][0] != kind:
            if kind == "tooldata" and self.known.tool is not None and not values:
                return self.known.tool
            other = " or --tool" if kind == "tooldata" else ""
            return (
                f"the {what} '{name[:40]}' is not in the module; give it by --frames (a module "
                f"with its {kind}, or TOML){other}"
            )
        if key in self.assigned:
            return f"line {self.assigned[key]} changes the {what} '{name[:40]}'"
        text = values[0][1]
        numbers = np.array([n.value for n in _numbers(text, 0)])
        start = re.sub(r"\s", "", text).upper()
        if kind == "tooldata":
            if not start.startswith("[TRUE,[[") or len(numbers) < POSE:
                return f"the tool '{name[:40]}' is not one on the flange with numbers"
            return of_quaternion(numbers[:POSE])
        if not start.startswith("[FALSE,TRUE,") or len(numbers) != 2 * POSE:
            return f"the work object '{name[:40]}' is not fixed, or not of numbers"
        return of_quaternion(numbers[:POSE]) @ of_quaternion(numbers[POSE:])

    def _target(
        self,
        line: int,
        at: int,
        text: str,
        joints: bool,
        tool: Floats | str,
        frame: Floats | str,
        obeyed: bool,
        used: Mapping[str, int],
    ) -> None:
        """Take one target."""
        left = next((x for x in (tool, frame) if isinstance(x, str) and not joints), "")
        made = _MADE.match(text)
        if text.startswith("["):
            new = self._value(text, at, f"line {line}", joints)
            key = f"line {line}, {at}"
        elif made and not joints:
            new, key = self._made(text, made, at, line), f"line {line}, {at}"
        else:
            key, new = text.upper(), ProgramPoint(line, f"line {line}")
            values = self.data.get(key, [])
            if not _NAME.fullmatch(text):
                left = left or f"the point '{text[:40]}' is computed while the program runs"
            elif len(values) != 1 or not values[0][1]:
                what = "has several values" if values else "is not in this module"
                left = left or f"the point '{text[:40]}' {what}"
            elif key in used:
                left = left or f"line {used[key]} uses or changes '{text[:40]}' otherwise"
            else:
                kind, value, place = values[0]
                name = f"{text} (line {line_of(self.text, place)})"
                new = self._value(value, place, name, kind == "jointtarget")
        if left and not new.left:
            new = replace(new, left=left)
        if not new.left and not joints:
            assert isinstance(tool, np.ndarray)  # noqa: S101 - see `left`
            assert isinstance(frame, np.ndarray)  # noqa: S101 - see `left`
            new = replace(new, tool=tool, frame=frame, obeyed=obeyed)
            if made:
                new = self._moved(new, made)
        self.found[key] = used_again(self.found.get(key), new, line, "frame")

    def _value(self, text: str, at: int, name: str, joints: bool) -> ProgramPoint:
        """Return a point of an aggregate."""
        numbers, bare = _numbers(text, at), ProgramPoint(line_of(self.text, at), name)
        if _form(text) != (_JOINTTARGET if joints else _ROBTARGET):
            kind = "jointtarget" if joints else "robtarget"
            return replace(bare, left=f"it is no {kind} of numbers")
        if any(n.value < UNUSED and n.value != 0 for n in numbers[-JOINTS:]):
            return replace(bare, left="an external axis moves, and it is not known what it carries")
        count = JOINTS if joints else POSE
        spans = [Span(0, n.begin, n.end) for n in numbers]
        values = np.array([n.value for n in numbers[:count]])
        if not joints and not np.isclose(np.linalg.norm(values[3:]), 1.0, atol=1e-3):
            return replace(bare, left="its quaternion is not of length 1")
        return replace(
            bare,
            numbers=tuple(spans[:count]),
            values=values,
            joints=joints,
            flags=() if joints else tuple(int(n.value) for n in numbers[count : count + 4]),
            config=() if joints else tuple(spans[count : count + 3]),
        )

    def _made(self, text: str, made: re.Match[str], at: int, line: int) -> ProgramPoint:
        """Return the point that `Offs` or `RelTool` moves, to be written in its place."""
        bare = ProgramPoint(line, f"line {line}")
        base, *moves = [part.strip() for _, part in arguments_of(re.sub(r"\\", ",\\\\", made[2]))]
        values = self.data.get(base.upper(), [])
        turn = rf"\\\s*R[xyz]\s*:=\s*{_NUMBER.pattern}" if made[1].upper() == "RELTOOL" else "-"
        shift = [m for m in moves if _NUMBER.fullmatch(m)]
        plain = len(shift) == 3 and all(
            re.fullmatch(turn, m, re.I) for m in moves if m and m not in shift
        )
        if len(values) != 1 or not values[0][1] or not plain or base.upper() in self.assigned:
            return replace(bare, left=f"the point '{text[:40]}' is computed while the program runs")
        point = self._value(values[0][1], values[0][2], f"line {line}", False)
        if point.left:
            return replace(bare, left=point.left)
        value = values[0][1]
        spans = [
            (s.begin - values[0][2], s.end - values[0][2]) for s in (*point.numbers, *point.config)
        ]
        pieces, last = [], 0
        for begin, end in spans:
            pieces += [value[last:begin], "{}"]
            last = end
        written = re.sub(r"\s", "", "".join([*pieces, value[last:]]))
        return replace(
            point,
            line=line,
            name=f"line {line}",
            numbers=(Span(0, at, at + len(text)),),
            config=(),
            flags=(UNSTATED,) * 3 + point.flags[3:],  # quadrants follow from where it moves to
            made=written,
        )

    def _moved(self, p: ProgramPoint, made: re.Match[str]) -> ProgramPoint:
        """Return the point where `Offs` or `RelTool` has it."""
        moves = [part.strip() for _, part in arguments_of(re.sub(r"\\", ",\\\\", made[2]))][1:]
        shift = np.array([float(m) for m in moves if m and not m.startswith("\\")])
        turns = {
            m[1:].strip()[:2].lower(): float(m.partition(":=")[2])
            for m in moves
            if m.startswith("\\")
        }
        t = of_quaternion(p.values)
        if made[1].lower() == "offs":
            t[:3, 3] += 1e-3 * shift
        else:
            for k, key in enumerate(("rx", "ry", "rz")):  # about x, then the new y, then the new z
                one = np.zeros(6)
                one[:3] = shift if k == 0 else 0.0
                one[5 - k] = turns.get(key, 0.0)
                t = t @ of_euler(one)
        return replace(p, values=to_quaternion(t, p.values))

    def _used_otherwise(self) -> dict[str, int]:
        """Names of points that statements use which are no motions to them, with their lines."""
        out: dict[str, int] = {}
        points = {k for k, v in self.data.items() if v[0][0] in ("robtarget", "jointtarget")}
        for at, code in self.statements:
            skipped: list[tuple[int, int]] = []
            if m := _MOTION.search(code):
                for place, text in self._arguments(code, m)[0][
                    : 2 if m[1].upper().endswith("C") else 1
                ]:
                    if _NAME.fullmatch(text) or self._plainly_made(text):
                        skipped.append((place, place + len(text)))
            for d in re.finditer(r"\b(?:robtarget|jointtarget)\s+(\w+)", code, re.I):
                skipped.append(d.span(1))
            for n in _NAME.finditer(code):
                inside = any(a <= n.start() < b for a, b in skipped)
                if n[0].upper() in points and not inside:
                    out.setdefault(n[0].upper(), line_of(self.text, at + n.start()))
        return out

    def _plainly_made(self, text: str) -> bool:
        """Whether it is Offs or RelTool of a point and numbers, which become a point by itself."""
        made = _MADE.match(text)
        return made is not None and not self._made(text, made, 0, 1).left
