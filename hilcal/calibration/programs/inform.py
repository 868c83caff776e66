"""Yaskawa INFORM jobs (`.jbi`).

`//POS` has the positions, after lines that hold for all below them: `///TOOL n`, `///USER n`,
`///POSTYPE` PULSE or ANGLE (joint values S, L, U, R, B, T), BASE, ROBOT or USER (X, Y, Z in mm;
Rx, Ry, Rz in degrees about fixed axes), and `///RCONF l,m,n,o,p,q`: no flip (R axis beyond ±90°),
lower arm (wrist centre behind the lower arm), wrist centre behind axis S, and R, T, S at 180° or
more. Only MOVJ obeys RCONF. Pulses per degree, tools and user frames are not in the file.

Source: Yaskawa, *NX100 and DX200 Instructions, Job Data Format* and *Manipulator Types*.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from hilcal.calibration.programs.program import (
    DECIMAL,
    JOINTS,
    UNSTATED,
    Language,
    Program,
    ProgramPoint,
    ProgramReader,
    Span,
    controller_frames,
    of_wpr,
    to_wpr,
)
from hilcal.errors import InputError
from hilcal.types import Floats, Ints

_POINT = re.compile(r"^\s*(C|P|BC|BP|EC|EX)(\d+)\s*=\s*(.*?)\s*$", re.IGNORECASE)
_NUMBER = re.compile(DECIMAL)
_MOTION = re.compile(r"^\s*(MOV[JLCS]|IMOV)\s+(.*)$", re.IGNORECASE)
_NAME = re.compile(r"\b([CP])(\d+)\b", re.IGNORECASE)
_REFUSED = re.compile(r"^\s*(SFTON|MFRAME|CNVSET|SYSTART|REFP|SETTOOL)\b", re.IGNORECASE)


def flags(q: Floats, shape: Ints) -> Ints:
    """(K, 6) the numbers of RCONF at joint values (K, 6)."""
    no_flip = np.cos(q[:, 3]) < 0
    far = np.abs(q[:, [3, 5, 0]]) > np.pi
    return np.column_stack([no_flip, shape[:, 1], shape[:, 0], far]).astype(np.int64)


INFORM = Language(
    name="INFORM",
    pose=of_wpr,
    numbers=to_wpr,
    decimals=(3, 4, 4),
    axes=((0, 0, 1), (0, 1, 0), (0, -1, 0), (-1, 0, 0), (0, -1, 0), (-1, 0, 0)),
    flags=flags,
    of_shape=(False, True, True, False, False, False),
    moves="MOVJ, MOVL, MOVC, MOVS",
)


def read_jbi(path: Path, frames_file: Path | None, tool: Floats | None) -> Program:
    """Read a job."""
    reader = _InformReader(path, controller_frames(frames_file, INFORM, tool))
    if "//POS" not in reader.text or "//INST" not in reader.text:
        raise InputError(f"{path.name}: no sections //POS and //INST; valid: a job as text")
    return reader.read()


def _key(kind: str, number: str) -> str:
    return f"{kind.upper()}{int(number)}"


class _InformReader(ProgramReader):
    def read(self) -> Program:
        """Read the job line by line."""
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
            reason = "a base axis moves the arm, and it is not known where to"
            raise self.refused(base_line, reason, "jobs of an arm that stands")
        return self.program()

    def _instruction(self, code: str, line: int) -> None:
        """Process an instruction."""
        if r := _REFUSED.match(code):
            raise self.refused(line, f"{r[1]} changes what points mean", "a job without it")
        m = _MOTION.match(code)
        names = [_key(*n.groups()) for n in _NAME.finditer(code)]
        if m is None or m[1].upper() == "IMOV":
            for name in names:
                self.otherwise.setdefault(name, line)
            if m is not None:
                self.leave(line, "IMOV is not corrected")
        elif len(names) != 1 or names[0] not in self.positions:
            self.leave(line, f"the point '{m[2][:20].strip()}' is not in this job")
        else:
            old = self.points.get(names[0], replace(self.positions[names[0]], obeyed=False))
            obeyed = old.obeyed or m[1].upper() == "MOVJ"
            self.points[names[0]] = replace(old, obeyed=obeyed)

    def _point(
        self, m: re.Match[str], offset: int, line: int, head: dict[str, str]
    ) -> ProgramPoint:
        """Return a position; its line begins at `offset`."""
        bare = ProgramPoint(line, f"{m[1]}{m[2]} (line {line})")
        numbers = list(_NUMBER.finditer(m[3]))
        if len(numbers) != JOINTS or not re.fullmatch(r"[-+\d.,\s]+", m[3]):
            return replace(bare, left=f"not {JOINTS} numbers")
        start = offset + m.start(3)
        spans = [Span(0, start + n.start(), start + n.end()) for n in numbers]
        values = np.array([float(n[0]) for n in numbers])
        kind, number = head.get("POSTYPE", "").upper(), head.get("TOOL", "0").split(",")[0].strip()
        tool = self.controller.pose("tools", number, f"tool {number}")
        if kind == "ANGLE":
            return bare.at_joints(spans, values, tool)
        if kind == "PULSE":
            if self.controller.pulses is None:
                left = "in pulses; give pulses_per_degree = [S, L, U, R, B, T] by --frames F.toml"
                return replace(bare, left=left)
            return replace(bare.at_joints(spans, values, tool), scale=self.controller.pulses)
        if kind not in ("BASE", "ROBOT", "USER"):
            return replace(bare, left=f"POSTYPE {kind} is not corrected")
        user = head.get("USER", "0") if kind == "USER" else "0"
        frame = self.controller.pose("bases", user, f"frame {user}")
        if kind == "USER" and user == "0":
            frame = "no ///USER"
        stated = [int(n) for n in re.findall(r"\d+", head.get("RCONF", ""))][:JOINTS]
        flags_ = tuple(stated) if len(stated) == JOINTS else (UNSTATED,) * JOINTS
        return replace(bare, flags=flags_).at_pose(spans, values, tool, frame)
