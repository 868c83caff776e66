r"""ABB RAPID: a module (`.mod`, `.modx`, `.sys`, `.prg`).

Points are `robtarget` ([x, y, z] in mm, unit quaternion [q1, q2, q3, q4], configuration [cf1, cf4,
cf6, cfx], external axes) and `jointtarget` (degrees), declared with a value, or written into a
motion, or `Offs` and `RelTool` of one with numbers, which the resulting point replaces. cf1, cf4,
cf6 are the quadrants of axes 1, 4, 6, 0 for 0° to 90°; cfx has bits for a negative axis 5, a wrist
centre behind the lower arm, and one behind axis 1.

A robtarget is relative to the object frame of the motion's `\WObj`; its tool is the motion's last
argument. This module or `--frames` has their `wobjdata` and `tooldata`.

The mass at the flange is that of `\TLoad`, else that of the `tooldata` and of the last `GripLoad`
of the routine; a negative one is not stated.

Source: ABB, *Technical reference manual: RAPID Instructions, Functions and Data types*, robtarget,
confdata, tooldata, wobjdata, MoveL, Offs, RelTool; *RAPID Overview*.
"""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hilcal.calibration.programs.program import (
    CORRECTED,
    DECIMAL,
    JOINTS,
    UNSTATED,
    Language,
    Program,
    ProgramPoint,
    ProgramReader,
    Span,
    arguments_of,
    edited,
    line_of,
    numbers_in,
    of_euler,
    read_text,
)
from hilcal.robot import se3
from hilcal.types import Floats, Ints

POSE = 7  # numbers of a pose
LEAST = 4  # least number of arguments of a motion: point, speed, zone, tool
UNUSED = 8e8  # numbers of external axes above this mean no axis: 9E9
_HEAD = re.compile(
    r"^[ \t\ufeff]*(MODULE|(LOCAL[ \t]+)?PROC)\b[^\r\n]*", re.IGNORECASE | re.MULTILINE
)
_PARAMETERS = re.compile(r"\b(?:PROC|FUNC\s+\w+)\s+\w+\s*\(([^)]*)\)", re.IGNORECASE)
_STATEMENT = re.compile(r"[^;]*;")
_BLANK = re.compile(r'"[^"]*"|!.*')
_DATA = re.compile(
    r"^\s*(?:LOCAL\s+|TASK\s+)?(?:CONST|PERS|VAR)\s+(robtarget|jointtarget|tooldata|wobjdata|loaddata)"
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
_GRIP = re.compile(r"\bGripLoad\s+(\w+)", re.IGNORECASE)
_TLOAD = re.compile(r"\\\s*TLoad\s*:=\s*(\w+)", re.IGNORECASE)
_ASSIGNED = re.compile(r"\b([A-Za-z]\w*)(?:\.\w+|\{[^}]*\})*\s*:=")
_NO_ASSIGNMENT = re.compile(r"(\b(CONST|PERS|VAR)\s[^;]*|\\\s*)$", re.IGNORECASE)
_MADE = re.compile(r"^(Offs|RelTool)\s*\((.*)\)$", re.IGNORECASE | re.DOTALL)
_NAME = re.compile(r"[A-Za-z]\w*")
_NUMBER = re.compile(rf"{DECIMAL}(?:[eE][-+]?\d+)?")
_COMPUTED = "the point '{}' is computed while the program runs"


def of_quaternion(values: Floats) -> Floats:
    """T (4, 4) of x, y, z in mm and a unit quaternion, its real part first."""
    q = np.asarray(values[3:7], dtype=float)
    with np.errstate(all="ignore"):  # the caller refuses values that are not finite
        q = q / np.linalg.norm(q)
    return se3.matrix(se3.of_quaternion(q), 1e-3 * np.asarray(values[:3], dtype=float))


def to_quaternion(t: Floats, near: Floats) -> Floats:
    """Inverse of `of_quaternion`, with the sign of the old quaternion."""
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
    shape_flags=(False, False, False, True),
    motions="MoveJ, MoveL, MoveC, MoveAbsJ",
    marked=lambda text: _HEAD.sub(rf"\g<0>  ! {CORRECTED}", text, count=1),
    config_texts=lambda new, texts: [str(v) for v in new[:3]],
    pose_numbers=POSE,
    frames="a module with its tooldata and wobjdata, or TOML",
)


def read_rapid(path: Path, frames_file: Path | None, tool: Floats | None) -> Program:
    """Read a module."""
    module = frames_file is not None and frames_file.suffix.lower() != ".toml"
    reader = _RapidReader(path, RAPID, None if module else frames_file, tool)
    frames_text = read_text(frames_file)[0] if frames_file is not None and module else ""
    return reader.read(frames_text)


def _statements(text: str) -> list[tuple[int, str]]:
    """Offset and code of each statement, with comments and texts replaced by blanks."""
    code = _BLANK.sub(lambda m: " " * len(m[0]), text)
    return [(m.start(), m[0]) for m in _STATEMENT.finditer(code)]


def _form(text: str) -> str:
    return re.sub(r"\s", "", _NUMBER.sub("0", text))


_ROBTARGET = "[[0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,0,0,0]]"
_JOINTTARGET = "[[0,0,0,0,0,0],[0,0,0,0,0,0]]"
_FRAMES = {"tooldata": "tool", "wobjdata": "work object"}
_Data = dict[str, list[tuple[str, str, int]]]
"""Declarations by name: type, text and offset of the value."""


class _RapidReader(ProgramReader):
    def read(self, frames_text: str) -> Program:
        """Read the module; `frames_text` is the text of one with tools and work objects."""
        self.statements = _statements(self.text)
        self.data = self._collected(self.statements)
        self.frames = self._collected(_statements(frames_text))
        self.assigned = {
            m[1].upper(): line_of(self.text, offset + m.start())
            for offset, code in self.statements
            for m in _ASSIGNED.finditer(code)
            if not _NO_ASSIGNMENT.search(code[: m.start()])
        }
        self.other_uses, obeyed = self._used_otherwise(), True
        grips = any(_GRIP.search(code) for _, code in self.statements)
        self.gripped: float | None = None if grips else 0.0  # kg
        for offset, code in self.statements:
            if re.search(r"\bPROC\s", code, re.I):
                self.gripped = None if grips else 0.0
            if m := _GRIP.search(code):
                self.gripped = self._mass("loaddata", m[1])
            if m := _REFUSED.search(code):
                line = line_of(self.text, offset + m.start())
                raise self.error(line, f"{m[1]} changes what points mean", "a program without it")
            if m := _CONF.search(code):
                obeyed = m[2].upper() == "ON"
            elif m := _MOTION.search(code):
                self._motion(offset, code, m, obeyed)
            elif (m := _OTHER_MOTION.search(code)) and m[1].upper() not in _MOVES_NOTHING:
                self.mark_not_corrected(
                    line_of(self.text, offset + m.start()), f"{m[1]} is not corrected"
                )
        return self.program()

    def _collected(self, statements: Sequence[tuple[int, str]]) -> _Data:
        """Declarations by name; a header without `;` may precede that of a statement."""
        out: _Data = {}
        for offset, code in statements:
            for m in re.finditer(r"\b(?:LOCAL\s+|TASK\s+)?(?:CONST|PERS|VAR)\s", code, re.I):
                if d := _DATA.match(code[m.start() :]):
                    value = d[4] if d[4] is not None and d[3] is None else ""
                    place = offset + m.start() + (d.start(4) if d[4] is not None else 0)
                    out.setdefault(d[2].upper(), []).append((d[1].lower(), value, place))
                    break
            for m in _PARAMETERS.finditer(code):  # hide what the module has of the same name
                for d in re.finditer(r"\b(\w+)\s+(\w+)\s*(?=[,|\\{]|$)", m[1]):
                    out.setdefault(d[2].upper(), []).append((d[1].lower(), "", offset + m.start()))
        return out

    def _targets(self, code: str, m: re.Match[str]) -> tuple[list[tuple[int, str]], str, str]:
        """Targets of a motion with their offsets in the code, its tool, its options."""
        options, arguments = "", []
        for begin, part in arguments_of(code[m.end() : code.rindex(";")]):
            outer = re.sub(r"\([^()]*\)", lambda m: "(" + "." * (len(m[0]) - 2) + ")", part)
            cut = outer.find("\\") if "\\" in outer else len(part)
            plain, options = part[:cut], options + part[cut:]
            if plain.strip():
                lead = len(plain) - len(plain.lstrip())
                arguments.append((m.end() + begin + lead, plain.strip()))
        count = 2 if m[1].upper().endswith("C") else 1
        return arguments[:count], arguments[-1][1] if len(arguments) >= LEAST else "", options

    def _motion(self, offset: int, code: str, m: re.Match[str], obeyed: bool) -> None:
        line = line_of(self.text, offset + m.start())
        targets, tool, options = self._targets(code, m)
        if not tool:
            self.mark_not_corrected(line, f"{m[1]} without its arguments")
            return
        work_object = re.search(r"\\\s*WObj\s*:=\s*(\w+)", options, re.I)
        tool_pose = self._frame("tooldata", tool)
        frame = self._frame("wobjdata", work_object[1] if work_object else "wobj0")
        total = _TLOAD.search(options)
        if total and total[1].upper() != "LOAD0":
            mass = self._mass("loaddata", total[1])
        else:
            parts = self._mass("tooldata", tool), self.gripped
            mass = None if None in parts else sum(filter(None, parts))
        if mass is not None:
            self.payloads[line] = mass
        joints = m[1].upper() == "MOVEABSJ"
        for place, text in targets:
            key, p = self._target(line, offset + place, text, joints)
            if not p.not_corrected and not joints:
                p = replace(p, flags_obeyed=obeyed).at_pose(p.numbers, p.values, tool_pose, frame)
            self.record(key, p, line)

    def _frame(self, kind: str, name: str) -> Floats | str:
        key, is_tool = name.upper(), kind == "tooldata"
        group, label = "tools" if is_tool else "bases", f"the {_FRAMES[kind]} '{name[:40]}'"
        values = self.data.get(key) or self.frames.get(key) or []
        if not values or self.controller.stated(group, name) is not None:
            return self.controller.pose(group, name, label, "TOOL0" if is_tool else "WOBJ0")
        if len(values) != 1 or values[0][0] != kind:
            return f"{label} is not one {kind} of the program"
        if key in self.assigned:
            return f"line {self.assigned[key]} changes {label}"
        numbers = numbers_in(values[0][1], _NUMBER, 0)[0]
        start = re.sub(r"\s", "", values[0][1]).upper()
        if is_tool:
            if not start.startswith("[TRUE,[[") or len(numbers) < POSE:
                return f"{label} is not one on the flange with numbers"
            return of_quaternion(numbers[:POSE])
        if not start.startswith("[FALSE,TRUE,") or len(numbers) != 2 * POSE:
            return f"{label} is not fixed, or not of numbers"
        return of_quaternion(numbers[:POSE]) @ of_quaternion(numbers[POSE:])

    def _mass(self, kind: str, name: str) -> float | None:
        """Return the mass of a tool without load or of a load, kg; None if it is not stated."""
        if name.upper() == "LOAD0":
            return 0.0
        values = self.data.get(name.upper()) or self.frames.get(name.upper()) or []
        if len(values) != 1 or values[0][0] != kind or name.upper() in self.assigned:
            return None
        numbers = numbers_in(values[0][1], _NUMBER, 0)[0][POSE if kind == "tooldata" else 0 :]
        return float(numbers[0]) if len(numbers) and numbers[0] >= 0.0 else None

    def _target(self, line: int, offset: int, text: str, joints: bool) -> tuple[str, ProgramPoint]:
        """Return key and point of one target, without tool and reference frame."""
        call, key, label = _MADE.match(text), f"line {line}, {offset}", f"line {line}"
        if text.startswith("["):
            new = self._value(text, offset, label, joints)
        elif call and not joints:
            new = self._computed(text, call, offset, line)
        else:
            key, new = text.upper(), ProgramPoint(line, label)
            values = self.data.get(key, [])
            if not _NAME.fullmatch(text):
                new = new.refused(_COMPUTED.format(text[:40]))
            elif len(values) != 1 or not values[0][1]:
                reason = "has several values" if values else "is not in this module"
                new = new.refused(f"the point '{text[:40]}' {reason}")
            else:
                kind, value, place = values[0]
                name = f"{text} (line {line_of(self.text, place)})"
                new = self._value(value, place, name, kind == "jointtarget")
        return key, new

    def _value(self, text: str, offset: int, name: str, joints: bool) -> ProgramPoint:
        """Return the point of an aggregate at an offset of the file."""
        values, spans = numbers_in(text, _NUMBER, offset)
        bare = ProgramPoint(line_of(self.text, offset), name)
        if _form(text) != (_JOINTTARGET if joints else _ROBTARGET):
            kind = "jointtarget" if joints else "robtarget"
            return bare.refused(f"it is no {kind} of numbers")
        external = values[-JOINTS:]
        if np.any((external < UNUSED) & (external != 0)):
            return bare.refused("an external axis moves, whose effect on the tool is not known")
        if joints:
            return bare.at_joints(spans[:JOINTS], values[:JOINTS], np.eye(4))
        if not np.isclose(np.linalg.norm(values[3:POSE]), 1.0, atol=1e-3):
            return bare.refused("its quaternion is not of length 1")
        return replace(
            bare,
            numbers=tuple(spans[:POSE]),
            values=values[:POSE],
            flags=tuple(int(v) for v in values[POSE : POSE + 4]),
            config=tuple(spans[POSE : POSE + 3]),
        )

    def _computed(self, text: str, match: re.Match[str], offset: int, line: int) -> ProgramPoint:
        """Return the point that `Offs` or `RelTool` computes, to replace the call."""
        bare = ProgramPoint(line, f"line {line}")
        base, *moves = [part.strip() for _, part in arguments_of(re.sub(r"\\", ",\\\\", match[2]))]
        values, relative = self.data.get(base.upper(), []), match[1].upper() == "RELTOOL"
        turn = rf"\\\s*R[xyz]\s*:=\s*{_NUMBER.pattern}" if relative else "-"
        shift = [m for m in moves if _NUMBER.fullmatch(m)]
        turns = [m for m in moves if m and m not in shift]
        plain = len(shift) == 3 and all(re.fullmatch(turn, m, re.I) for m in turns)
        if len(values) != 1 or not values[0][1] or not plain or base.upper() in self.assigned:
            return bare.refused(_COMPUTED.format(text[:40]))
        _, value, begin = values[0]
        point = self._value(value, begin, bare.name, False)
        if point.not_corrected:
            return bare.refused(point.not_corrected)
        places = [Span(0, s.start - begin, s.end - begin) for s in (*point.numbers, *point.config)]
        t, displacement = of_quaternion(point.values), np.array([float(m) for m in shift])
        if relative:
            angle = {m[1:].strip()[:2].lower(): float(m.partition(":=")[2]) for m in turns}
            t = t @ of_euler(np.array([*displacement, 0.0, 0.0, 0.0]))
            for k, key in enumerate(("rx", "ry", "rz")):  # about x, then the new y, then the new z
                t = t @ of_euler(angle.get(key, 0.0) * np.eye(6)[5 - k])
        else:
            t[:3, 3] += 1e-3 * displacement
        return replace(
            point,
            line=line,
            name=bare.name,
            numbers=(Span(0, offset, offset + len(text)),),
            values=to_quaternion(t, point.values),
            config=(),
            flags=(UNSTATED,) * 3 + point.flags[3:],  # quadrants follow from the new joint values
            template=re.sub(r"\s", "", edited(value, [(place, "{}") for place in places])),
        )

    def _used_otherwise(self) -> dict[str, int]:
        out: dict[str, int] = {}
        kinds = ("robtarget", "jointtarget")
        points = {k for k, v in self.data.items() if any(x[0] in kinds and x[1] for x in v)}
        for offset, code in self.statements:
            skipped = [
                d.span(1) for d in re.finditer(r"\b(?:robtarget|jointtarget)\s+(\w+)", code, re.I)
            ]
            if m := _MOTION.search(code):
                for place, text in self._targets(code, m)[0]:
                    call = _MADE.match(text)  # of a point and numbers: replaced by a point
                    if _NAME.fullmatch(text) or (
                        call and not self._computed(text, call, 0, 1).not_corrected
                    ):
                        skipped.append((place, place + len(text)))
            for n in _NAME.finditer(code):
                inside = any(a <= n.start() < b for a, b in skipped)
                if n[0].upper() in points and not inside:
                    out.setdefault(n[0].upper(), line_of(self.text, offset + n.start()))
        return out
