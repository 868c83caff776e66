"""FANUC TP programs as text (`.ls`).

Positions stand in `/POS`, with their user frame UF and tool UT: `X, Y, Z` in mm and `W, P, R` in
degrees about the fixed axes x, y, z, with `CONFIG`, or `J1` to `J6` in degrees. CONFIG has N for a
wrist that is not flipped (J5 negative) or F, U for an arm that is up (wrist centre in front of the
lower arm) or D, T for a wrist centre in front of axis 1 or B, and three turn numbers: of which
axes, `$SCR_GRP[1].$TURN_AXIS` says. Frames and tools themselves are not in the file.

Source: FANUC, *R-30iB HandlingTool Operator's Manual*, chapters on position data and motion
instructions.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
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
    controller_frames,
    frame_of,
    line_of,
    of_wpr,
    read_text,
    to_wpr,
)
from hilcal.errors import InputError
from hilcal.types import Floats, Ints

_NUMBER = r"[ \t]*[-+]?(?:\d+\.?\d*|\.\d+)"
_POSITION = re.compile(r'P\s*\[\s*(\d+)\s*(?::\s*"[^"]*"\s*)?\]\s*\{(.*?)\}\s*;', re.DOTALL)
_GROUP = re.compile(r"GP1\s*:(.*?)(?=GP\d\s*:|\Z)", re.DOTALL)
_FIELD = re.compile(rf"\b([XYZWPR]|[JE]\d)\s*=({_NUMBER})\s*(mm|deg)")
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
    written=lambda _, texts: list(texts),
    padded=True,
)


def read_ls(path: Path, frames_file: Path | None, tool: Floats | None) -> Program:
    """Read a program.

    Args:
        tool: (4, 4) T_flange_tool of tools that no file has; None without it.
    """
    text, encoding = read_text(path)
    known = controller_frames(frames_file, LS, tool)
    if not re.search(r"^/MN\b", text, re.M) or not re.search(r"^/POS\b", text, re.M):
        raise InputError(f"{path.name}: no sections /MN and /POS; valid: a TP program as text")
    begin = re.search(r"^/POS\b", text, re.M)
    at = begin.start() if begin else 0
    positions = {m[1]: (m, at + m.start(2)) for m in _POSITION.finditer(text[at:])}
    found: dict[str, ProgramPoint] = {}
    otherwise: dict[str, int] = {}
    for line, code in _instructions(text[:at], path.name):
        m = _MOTION.match(code)
        names = [(p[1], p[2]) for p in _P.finditer(code)]
        if m is None or _OPTION.search(code) or any(other for _, other in names):
            every = list(positions) if any(other for _, other in names) else [n for n, _ in names]
            otherwise.update({name: line for name in every if name not in otherwise})
        if m is None:
            continue
        if m[2] or not names:
            found[f"line {line}"] = ProgramPoint(line, f"line {line}", left="a position register")
            continue
        for name, other in names:
            if name is None:
                left = f"the point P[{other[:20]}] is chosen while the program runs"
                found[f"line {line}"] = ProgramPoint(line, f"line {line}", left=left)
            elif name not in positions:
                left = f"P[{name}] is not in /POS"
                found.setdefault(name, ProgramPoint(line, f"P[{name}]", left=left))
            elif name not in found:
                position, place = positions[name]
                at_line = line_of(text, place)
                point = ProgramPoint(at_line, f"P[{name}] (line {at_line})")
                found[name] = _point(point, position[2], place, known)
    for name, line in otherwise.items():
        if name in found and not found[name].left:
            left = f"line {line} uses P[{name}] otherwise than as the target of a plain motion"
            found[name] = replace(found[name], left=left)
    if not found:
        raise InputError(f"{path.name}: no motions; valid: J, L, C or A with P[…]")
    return Program(LS, (path.suffix,), (text,), tuple(found.values()), encoding)


def _instructions(text: str, name: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each instruction, without comments."""
    start = re.search(r"^/MN\b[^\n]*\n", text, re.M)
    at = start.end() if start else len(text)
    for m in re.finditer(r"[^;]*;", text[at:]):
        body = m[0].lstrip("\r\n")
        line = line_of(text, at + m.end() - len(body))
        if re.match(r"\s*\d*\s*:\s*(!|//|--eg)", body):
            continue
        if r := _REFUSED.search(body):
            raise InputError(
                f"{name}: line {line}: '{r[0]}' changes a frame while the program runs; valid: "
                "a program without it"
            )
        yield line, re.sub(r"^\s*\d*\s*:\s*", "", body)


def _point(bare: ProgramPoint, text: str, place: int, known: ControllerFrames) -> ProgramPoint:
    """Return a position of `/POS`; `place` is where its text begins."""
    group = _GROUP.search(text)
    if group is None:
        return replace(bare, left="no group GP1")
    body, at = group[1], place + group.start(1)
    fields = {
        m[1]: (float(m[2]), Span(0, at + m.start(2), at + m.end(2))) for m in _FIELD.finditer(body)
    }
    moved = [k for k, (v, _) in fields.items() if k.startswith("E") and v != 0]
    if moved:
        return replace(bare, left=f"{moved[0]} moves, and it is not known what that carries")
    frame, tool = _FRAME.search(body), _TOOL.search(body)
    if all(k in fields for k in J):
        tool_pose = frame_of(known, "tool", tool[1] if tool else "0")
        return replace(
            bare,
            numbers=tuple(fields[k][1] for k in J),
            values=np.array([fields[k][0] for k in J]),
            joints=True,
            tool=np.eye(4) if isinstance(tool_pose, str) else tool_pose,
        )
    config = _CONFIG.search(body)
    if not all(k in fields for k in XYZWPR) or config is None or frame is None or tool is None:
        return replace(bare, left="not a position of numbers with UF, UT and CONFIG")
    poses = [frame_of(known, "frame", frame[1]), frame_of(known, "tool", tool[1])]
    left = next((p for p in poses if isinstance(p, str)), "")
    stated = _flags(config, known)
    if isinstance(stated, str) or left:
        return replace(bare, left=left or str(stated))
    return replace(
        bare,
        numbers=tuple(fields[k][1] for k in XYZWPR),
        values=np.array([fields[k][0] for k in XYZWPR]),
        frame=np.asarray(poses[0]),
        tool=np.asarray(poses[1]),
        flags=stated,
    )


def _flags(config: re.Match[str], known: ControllerFrames) -> tuple[int, ...] | str:
    """Flags of a CONFIG, or why they are not known."""
    letters, turns = config[1].split(), [int(t) for t in re.findall(r"-?\d+", config[2])]
    pairs = (("N", "F"), ("U", "D"), ("T", "B"))
    out = [next((k for k, sign in enumerate(pair) if sign in letters), UNSTATED) for pair in pairs]
    by_axis = [UNSTATED] * JOINTS
    if known.turn_axes is not None:
        for axis, turn in zip(known.turn_axes, turns, strict=False):
            by_axis[axis - 1] = turn
    elif any(turns):
        return (
            "a turn number other than 0; give turn_axes = [1, 4, 6], or what $SCR_GRP[1].$TURN_AXIS"
            " says, by --frames F.toml"
        )
    else:
        for axis in (1, 4, 5, 6):
            by_axis[axis - 1] = 0
    return (*out, *by_axis)
