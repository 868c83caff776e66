"""FANUC TP programs as text (`.ls`).

`/POS` has the positions with their user frame UF and tool UT: `X, Y, Z` in mm and `W, P, R` in
degrees about the fixed axes x, y, z, with `CONFIG`, or `J1` to `J6` in degrees. CONFIG has N for a
wrist that is not flipped (J5 negative), else F; U for an arm that is up (wrist centre in front of
the lower arm), else D; T for a wrist centre in front of axis 1, else B; and three turn numbers,
whose axes `$SCR_GRP[1].$TURN_AXIS` states. The poses of frames and tools are not in the file.

Source: FANUC, *R-30iB HandlingTool Operator's Manual*, chapters on position data and motion
instructions.
"""

import re
from collections.abc import Iterator
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
    line_of,
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
_MOTION = re.compile(r"^\s*\d*\s*:?\s*([JLCAS])\s+(?=P(R)?\s*\[)(.*)", re.DOTALL)
_P = re.compile(r"(?<![A-Z])P\s*\[\s*(?:(\d+)|([^\]]*))")
_OPTION = re.compile(
    r"\b(Offset|Tool_Offset|VOFFSET|INC|Skip|COORD|ATool_?Offset|BOffset|TPT)\b", re.IGNORECASE
)
_REFUSED = re.compile(
    r"\b(UFRAME|UTOOL)\s*\[[^\]]*\]\s*=(?!=)|\$MNUFRAME\w*\s*\[|\$MNUTOOL\w*\s*\["
)
XYZWPR, J = ("X", "Y", "Z", "W", "P", "R"), tuple(f"J{k}" for k in range(1, 7))


def flags(q: Floats, shape: Ints) -> Ints:
    """(K, 9) flipped wrist, arm down, wrist behind, turn numbers, at joint values (K, 6)."""
    turns = np.rint(q / (2 * np.pi)).astype(np.int64)
    return np.column_stack([q[:, 4] > 0, shape[:, 1], shape[:, 0], turns])


LS = Language(
    name="FANUC",
    pose=of_wpr,
    numbers=to_wpr,
    decimals=(3, 3, 3),
    axes=((0, 0, 1), (0, 1, 0), (0, -1, 0), (-1, 0, 0), (0, -1, 0), (-1, 0, 0)),
    flags=flags,
    of_shape=(True, True, True, *(False,) * JOINTS),
    moves="J, L, C or A with P[…]",
    padded=True,
)


def read_ls(path: Path, frames_file: Path | None, tool: Floats | None) -> Program:
    """Read a program."""
    reader = _FanucReader(path, controller_frames(frames_file, LS, tool))
    begin = re.search(r"^/POS\b", reader.text, re.M)
    if begin is None or not re.search(r"^/MN\b", reader.text, re.M):
        raise InputError(f"{path.name}: no sections /MN and /POS; valid: a TP program as text")
    return reader.read(begin.start())


class _FanucReader(ProgramReader):
    def read(self, offset: int) -> Program:
        """Read the program; its positions begin at an offset."""
        positions = {m[1]: (m, offset + m.start(2)) for m in _POSITION.finditer(self.text[offset:])}
        for line, code in self._instructions(self.text[:offset]):
            m = _MOTION.match(code)
            names = [(p[1], p[2]) for p in _P.finditer(code)]
            variable = any(index for _, index in names)
            if m is None or _OPTION.search(code) or variable:
                for name in positions if variable else [n for n, _ in names]:
                    self.otherwise.setdefault(name, line)
            if m is None:
                continue
            if m[2] or not names:
                self.leave(line, "a position register")
                continue
            for name, index in names:
                if name is None:
                    self.leave(line, f"the point P[{index[:20]}] is chosen while the program runs")
                elif name not in positions:
                    left = f"P[{name}] is not in /POS"
                    self.points.setdefault(name, ProgramPoint(line, f"P[{name}]", left=left))
                elif name not in self.points:
                    position, place = positions[name]
                    at_line = line_of(self.text, place)
                    point = ProgramPoint(at_line, f"P[{name}] (line {at_line})")
                    self.points[name] = self._point(point, position[2], place)
        return self.program()

    def _instructions(self, text: str) -> Iterator[tuple[int, str]]:
        """Yield line and text of each instruction, without comments."""
        start = re.search(r"^/MN\b[^\n]*\n", text, re.M)
        begin = start.end() if start else len(text)
        for m in re.finditer(r"[^;]*;", text[begin:]):
            body = m[0].lstrip("\r\n")
            line = line_of(text, begin + m.end() - len(body))
            if re.match(r"\s*\d*\s*:\s*(!|//|--eg)", body):
                continue
            if r := _REFUSED.search(body):
                reason = f"'{r[0]}' changes a frame while the program runs"
                raise self.refused(line, reason, "a program without it")
            yield line, re.sub(r"^\s*\d*\s*:\s*", "", body)

    def _point(self, bare: ProgramPoint, text: str, offset: int) -> ProgramPoint:
        """Return a position of `/POS`; its text begins at `offset`."""
        group = _GROUP.search(text)
        if group is None:
            return replace(bare, left="no group GP1")
        body, begin = group[1], offset + group.start(1)
        fields = {m[1]: m for m in _FIELD.finditer(body)}
        if moving := [k for k, m in fields.items() if k.startswith("E") and float(m[2]) != 0]:
            return replace(bare, left=f"{moving[0]} moves, and it is not known what that carries")
        keys = J if all(k in fields for k in J) else XYZWPR
        frame, tool, config = (x.search(body) for x in (_FRAME, _TOOL, _CONFIG))
        complete = all(k in fields for k in keys)
        if keys is XYZWPR and not (complete and config and frame and tool):
            return replace(bare, left="not a position of numbers with UF, UT and CONFIG")
        numbers = [Span(0, begin + fields[k].start(2), begin + fields[k].end(2)) for k in keys]
        values = np.array([float(fields[k][2]) for k in keys])
        tool_pose = self.controller.pose(
            "tools", tool[1] if tool else "0", f"tool {tool and tool[1]}"
        )
        if config is None or frame is None or keys is J:
            return bare.at_joints(numbers, values, tool_pose)
        stated = self._flags(config)
        if isinstance(stated, str):
            return replace(bare, left=stated)
        base = self.controller.pose("bases", frame[1], f"frame {frame[1]}")
        return replace(bare, flags=stated).at_pose(numbers, values, tool_pose, base)

    def _flags(self, config: re.Match[str]) -> tuple[int, ...] | str:
        """Flags of a CONFIG, or why they are unknown."""
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
