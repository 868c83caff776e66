"""FANUC TP programs as text (`.ls`) and Yaskawa INFORM jobs (`.jbi`): positions in a section.

FANUC: `/POS` has the positions with their user frame UF and tool UT: `X, Y, Z` in mm and `W, P, R`
in degrees about the fixed axes x, y, z, with `CONFIG`, or `J1` to `J6` in degrees. CONFIG has N for
a wrist that is not flipped (J5 negative), else F; U for an arm that is up (wrist centre in front of
the lower arm), else D; T for a wrist centre in front of axis 1, else B; and three turn numbers,
whose axes `$SCR_GRP[1].$TURN_AXIS` states. The poses of frames and tools are not in the file.

INFORM: `//POS` has the positions, after lines that hold for all below them: `///TOOL n`, `///USER
n`, `///POSTYPE` PULSE or ANGLE (joint values S, L, U, R, B, T), BASE, ROBOT or USER (X, Y, Z in mm;
Rx, Ry, Rz in degrees about fixed axes), and `///RCONF l,m,n,o,p,q`: no flip (R axis beyond ±90°),
lower arm (wrist centre behind the lower arm), wrist centre behind axis S, and R, T, S at 180° or
more. Only MOVJ obeys RCONF. Pulses per degree, tools and user frames are not in the file.

Sources: FANUC, *R-30iB HandlingTool Operator's Manual*, chapters on position data and motion
instructions; Yaskawa, *NX100 and DX200 Instructions, Job Data Format* and *Manipulator Types*.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from hilcal.calibration.programs.program import (
    CORRECTED,
    DECIMAL,
    JOINTS,
    MOVES,
    UNSTATED,
    Language,
    Program,
    ProgramPoint,
    ProgramReader,
    Span,
    line_of,
    numbers_in,
    of_wpr,
    to_wpr,
)
from hilcal.errors import InputError
from hilcal.types import Floats, Ints

_POSITION = re.compile(r'P\s*\[\s*(\d+)\s*(?::\s*"[^"]*"\s*)?\]\s*\{(.*?)\}\s*;', re.DOTALL)
_GROUP = re.compile(r"GP1\s*:(.*?)(?=GP\d\s*:|\Z)", re.DOTALL)
_FIELD = re.compile(rf"\b([XYZWPR]|[JE]\d)\s*=([ \t]*{DECIMAL})\s*(mm|deg)")
_FRAME, _TOOL = (re.compile(rf"\b{word}\s*:\s*(\w+)") for word in ("UF", "UT"))
_CONFIG = re.compile(r"CONFIG\s*:\s*'([A-Z ]*)((?:,\s*-?\d+\s*)*)'")
_MOTION = re.compile(r"^\s*\d*\s*:?\s*([JLCAS])\s+(?=P(R|AL_\w+)?\s*\[)(.*)", re.DOTALL)
_P = re.compile(r"(?<![A-Z])P\s*\[\s*(?:(\d+)|([^\]]*))")
_OPTION = re.compile(
    r"\b(Offset|Tool_Offset|VOFFSET|INC|Skip|COORD|ATool_?Offset|BOffset|TPT|RTCP)\b", re.IGNORECASE
)
_REFUSED = re.compile(
    r"\b(UFRAME|UTOOL)\s*\[[^;=]*\]\s*=(?!=)|\$[^;=]*(FRAME|TOOL)[^;=]*=(?!=)"
    r"|\bTouch\s+Offset\s+PR\b"
)
_NUMBERED = re.compile(r"^[ \t]*(\d+)[ \t]*:", re.MULTILINE)
_TRACKING = re.compile(r"\bLINE_TRACK_SCHEDULE_NUMBER\s*:\s*[1-9]\d*")
"""Marks a program whose points move with a conveyor."""
XYZWPR, J = ("X", "Y", "Z", "W", "P", "R"), tuple(f"J{k}" for k in range(1, 7))


def config_flags(q: Floats, shape: Ints) -> Ints:
    """(K, 9) flipped wrist, arm down, wrist behind, turn numbers, at joint values (K, 6)."""
    turns = np.rint(q / (2 * np.pi)).astype(np.int64)
    return np.column_stack([q[:, 4] > 0, shape[:, 1], shape[:, 0], turns])


AXES = ((0, 0, 1), (0, 1, 0), (0, -1, 0), (-1, 0, 0), (0, -1, 0), (-1, 0, 0))
"""Of both makers' joints."""


def _with_remark(text: str) -> str:
    """Return a TP program whose last instruction is the remark `CORRECTED`."""
    main, mark, positions = text.partition("/POS")
    number = 1 + max((int(m[1]) for m in _NUMBERED.finditer(main)), default=0)
    end = "\r\n" if main.endswith("\r\n") else "\n"
    return f"{main}{number:4d}:  !{CORRECTED} ;{end}{mark}{positions}"


LS = Language(
    name="FANUC",
    pose=of_wpr,
    numbers=to_wpr,
    decimals=(3, 3, 3),
    axes=AXES,
    flags=config_flags,
    shape_flags=(True, True, True, *(False,) * JOINTS),
    motions="J, L, C or A with P[…]",
    marked=_with_remark,
    padded=True,
)


def read_ls(path: Path, frames_file: Path | None, tool: Floats | None) -> Program:
    """Read a program."""
    reader = _FanucReader(path, LS, frames_file, tool)
    begin = re.search(r"^/POS\b", reader.text, re.M)
    if begin is None or not re.search(r"^/MN\b", reader.text, re.M):
        raise InputError(f"{path.name}: no sections /MN and /POS; valid: a TP program as text")
    if m := _TRACKING.search(reader.text[: begin.start()]):
        line = line_of(reader.text, m.start())
        raise reader.error(
            line, f"'{m[0]}' moves its points with a conveyor", "a program without it"
        )
    return reader.read(begin.start())


class _FanucReader(ProgramReader):
    def read(self, offset: int) -> Program:
        positions = {m[1]: (m, offset + m.start(2)) for m in _POSITION.finditer(self.text[offset:])}
        for line, code in self._instructions(self.text[:offset]):
            m = _MOTION.match(code)
            names = [(p[1], p[2]) for p in _P.finditer(code)]
            variable = any(index for _, index in names)
            if m is None or _OPTION.search(code) or variable:
                for name in positions if variable else [n for n, _ in names]:
                    self.other_uses.setdefault(name, line)
            if m is None:
                continue
            if m[2] or not names:
                self.mark_not_corrected(
                    line, "a position register" if m[2] == "R" else "a position of a pallet"
                )
                continue
            for name, index in names:
                if name is None:
                    self.mark_not_corrected(
                        line, f"the point P[{index[:20]}] is chosen while the program runs"
                    )
                elif name not in positions:
                    missing = ProgramPoint(line, f"P[{name}]").refused(f"P[{name}] is not in /POS")
                    self.points.setdefault(name, missing)
                elif name not in self.points:
                    position, place = positions[name]
                    at_line = line_of(self.text, place)
                    point = ProgramPoint(at_line, f"P[{name}] (line {at_line})")
                    self.points[name] = self._point(point, position[2], place)
        return self.program()

    def _instructions(self, text: str) -> Iterator[tuple[int, str]]:
        start = re.search(r"^/MN\b[^\n]*\n", text, re.M)
        begin = start.end() if start else len(text)
        for m in re.finditer(r"[^;]*;", text[begin:]):
            body = m[0].lstrip("\r\n")
            line = line_of(text, begin + m.end() - len(body))
            if re.match(r"\s*\d*\s*:\s*(!|//|--eg)", body):
                continue
            if r := _REFUSED.search(body):
                reason = f"'{r[0]}' changes what points mean"
                raise self.error(line, reason, "a program without it")
            yield line, re.sub(r"^\s*\d*\s*:\s*", "", body)

    def _point(self, bare: ProgramPoint, text: str, offset: int) -> ProgramPoint:
        """Return a position of `/POS`; its text begins at `offset`."""
        group = _GROUP.search(text)
        if group is None:
            return bare.refused("no group GP1")
        body, begin = group[1], offset + group.start(1)
        fields = {m[1]: m for m in _FIELD.finditer(body)}
        if moving := [k for k, m in fields.items() if k.startswith("E") and float(m[2]) != 0]:
            return bare.refused(MOVES.format(moving[0]))
        keys = J if all(k in fields for k in J) else XYZWPR
        frame, tool, config = (x.search(body) for x in (_FRAME, _TOOL, _CONFIG))
        complete = all(k in fields for k in keys)
        if keys is XYZWPR and not (complete and config and frame and tool):
            return bare.refused("not a position of numbers with UF, UT and CONFIG")
        numbers = [Span(0, begin + fields[k].start(2), begin + fields[k].end(2)) for k in keys]
        values = np.array([float(fields[k][2]) for k in keys])
        tool_pose = self.controller.pose(
            "tools", tool[1] if tool else "0", f"tool {tool and tool[1]}"
        )
        if config is None or frame is None or keys is J:
            return bare.at_joints(numbers, values, tool_pose)
        stated = self._flags(config)
        if isinstance(stated, str):
            return bare.refused(stated)
        base = self.controller.pose("bases", frame[1], f"frame {frame[1]}")
        return replace(bare, flags=stated).at_pose(numbers, values, tool_pose, base)

    def _flags(self, config: re.Match[str]) -> tuple[int, ...] | str:
        letters, turns = config[1].split(), [int(t) for t in re.findall(r"-?\d+", config[2])]
        out = [
            next((k for k, sign in enumerate(pair) if sign in letters), UNSTATED)
            for pair in (("N", "F"), ("U", "D"), ("T", "B"))
        ]
        axes = self.controller.turn_axes
        if axes is None and any(turns):
            return (
                "a turn number other than 0; give turn_axes = [1, 4, 6], or what "
                "$SCR_GRP[1].$TURN_AXIS says, by --frames F.toml"
            )
        by_axis = dict.fromkeys((1, 4, 5, 6), 0)
        if axes is not None:
            by_axis = dict(zip(axes, turns, strict=False))
        return (*out, *(by_axis.get(axis, UNSTATED) for axis in range(1, JOINTS + 1)))


_POINT = re.compile(r"^\s*(C|P|BC|BP|EC|EX)(\d+)\s*=\s*(.*?)\s*$", re.IGNORECASE)
_NUMBER = re.compile(DECIMAL)
_MOV = re.compile(r"^\s*(MOV[JLCS]|IMOV)\s+(.*)$", re.IGNORECASE)
_NAME = re.compile(r"\b([CP])(\d+)\b", re.IGNORECASE)
_NOP = re.compile(r"^NOP[ \t]*(\r?\n)", re.MULTILINE)
_CHANGES = re.compile(r"^\s*(SFTON|MFRAME|CNVSET|SYSTART|REFP|SETTOOL)\b", re.IGNORECASE)


def rconf(q: Floats, shape: Ints) -> Ints:
    """(K, 6) the numbers of RCONF at joint values (K, 6)."""
    no_flip = np.cos(q[:, 3]) < 0
    far = np.abs(q[:, [3, 5, 0]]) > np.pi
    return np.column_stack([no_flip, shape[:, 1], shape[:, 0], far]).astype(np.int64)


INFORM = Language(
    name="INFORM",
    pose=of_wpr,
    numbers=to_wpr,
    decimals=(3, 4, 4),
    axes=AXES,
    flags=rconf,
    shape_flags=(False, True, True, False, False, False),
    motions="MOVJ, MOVL, MOVC, MOVS",
    marked=lambda text: _NOP.sub(rf"\g<0>'{CORRECTED}\g<1>", text, count=1),
)


def read_jbi(path: Path, frames_file: Path | None, tool: Floats | None) -> Program:
    """Read a job."""
    reader = _InformReader(path, INFORM, frames_file, tool)
    if "//POS" not in reader.text or "//INST" not in reader.text:
        raise InputError(f"{path.name}: no sections //POS and //INST; valid: a job as text")
    return reader.read()


def _key(kind: str, number: str) -> str:
    return f"{kind.upper()}{int(number)}"


class _InformReader(ProgramReader):
    def read(self) -> Program:
        self.positions: dict[str, ProgramPoint] = {}
        head: dict[str, str] = {}
        base_line, section, offset = 0, "", 0
        for line, full_line in enumerate(self.text.split("\n"), start=1):
            code = full_line.rstrip("\r")
            if code.startswith("//") and not code.startswith("///"):
                section = "".join(code[2:].split()[:1]).upper()
            elif section == "POS" and code.startswith("///"):
                word, _, value = code[3:].strip().partition(" ")
                head[word.upper()] = value.strip()
            elif section == "POS" and (m := _POINT.match(code)):
                if m[1].upper() in ("C", "P"):
                    self.positions[_key(m[1], m[2])] = self._point(m, offset, line, head)
                elif m[1].upper() in ("BC", "BP") and any(map(float, _NUMBER.findall(m[3]))):
                    base_line = base_line or line
            elif section == "INST" and not code.strip().startswith("'"):
                self._instruction(code, line)
            offset += len(full_line) + 1
        if base_line:
            reason = "a base axis moves the arm to an unknown place"
            raise self.error(base_line, reason, "jobs of an arm with a fixed base")
        return self.program()

    def _instruction(self, code: str, line: int) -> None:
        if r := _CHANGES.match(code):
            raise self.error(line, f"{r[1]} changes what points mean", "a job without it")
        m = _MOV.match(code)
        names = [_key(*n.groups()) for n in _NAME.finditer(code)]
        if m is None or m[1].upper() == "IMOV":
            for name in names:
                self.other_uses.setdefault(name, line)
            if m is not None:
                self.mark_not_corrected(line, "IMOV is not corrected")
        elif len(names) != 1 or names[0] not in self.positions:
            self.mark_not_corrected(line, f"the point '{m[2][:20].strip()}' is not in this job")
        else:
            old = self.points.get(names[0], replace(self.positions[names[0]], flags_obeyed=False))
            obeyed = old.flags_obeyed or m[1].upper() == "MOVJ"
            self.points[names[0]] = replace(old, flags_obeyed=obeyed)

    def _point(
        self, m: re.Match[str], offset: int, line: int, head: dict[str, str]
    ) -> ProgramPoint:
        """Return a position; its line begins at `offset`."""
        bare = ProgramPoint(line, f"{m[1]}{m[2]} (line {line})")
        values, spans = numbers_in(m[3], _NUMBER, offset + m.start(3))
        if len(values) != JOINTS or not re.fullmatch(r"[-+\d.,\s]+", m[3]):
            return bare.refused(f"not {JOINTS} numbers")
        kind, number = head.get("POSTYPE", "").upper(), head.get("TOOL", "0").split(",")[0].strip()
        tool = self.controller.pose("tools", number, f"tool {number}")
        if kind == "ANGLE":
            return bare.at_joints(spans, values, tool)
        if kind == "PULSE":
            if self.controller.pulses is None:
                reason = "in pulses; give pulses_per_degree = [S, L, U, R, B, T] by --frames F.toml"
                return bare.refused(reason)
            return replace(bare.at_joints(spans, values, tool), scale=self.controller.pulses)
        if kind not in ("BASE", "ROBOT", "USER"):
            return bare.refused(f"POSTYPE {kind} is not corrected")
        user = head.get("USER", "0") if kind == "USER" else "0"
        frame = self.controller.pose("bases", user, f"frame {user}")
        if kind == "USER" and user == "0":
            frame = "no ///USER"
        stated = [int(n) for n in re.findall(r"\d+", head.get("RCONF", ""))][:JOINTS]
        flags = tuple(stated) if len(stated) == JOINTS else (UNSTATED,) * JOINTS
        return replace(bare, flags=flags).at_pose(spans, values, tool, frame)
