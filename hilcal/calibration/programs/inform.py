"""Yaskawa INFORM jobs (`.jbi`).

Positions stand in `//POS`, after lines that say what those below are: `///TOOL n`, `///USER n`,
`///POSTYPE` PULSE or ANGLE (joint values S, L, U, R, B, T), BASE, ROBOT or USER (X, Y, Z in mm;
Rx, Ry, Rz in degrees about fixed axes), and `///RCONF l,m,n,o,p,q`: no flip (R axis beyond ±90°),
lower arm (wrist centre behind the lower arm), wrist centre behind axis S, and R, T, S at 180° or
more. It is taken in MOVJ alone. Pulses per degree, tools and user frames are not in the file.

Source: Yaskawa, *NX100 and DX200 Instructions, Job Data Format* and *Manipulator Types*.
"""

import re
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
    of_wpr,
    read_text,
    to_wpr,
)
from hilcal.errors import InputError
from hilcal.types import Floats, Ints

_POINT = re.compile(r"^\s*(C|P|BC|BP|EC|EX)(\d+)\s*=\s*(.*?)\s*$", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)")
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
    written=lambda _, texts: list(texts),
)


def read_jbi(path: Path, frames_file: Path | None, tool: Floats | None) -> Program:
    """Read a job.

    Args:
        tool: (4, 4) T_flange_tool of tools that no file has; None without it.
    """
    text, encoding = read_text(path)
    known = controller_frames(frames_file, INFORM, tool)
    if "//POS" not in text or "//INST" not in text:
        raise InputError(f"{path.name}: no sections //POS and //INST; valid: a job as text")
    points: dict[str, ProgramPoint] = {}
    found: dict[str, ProgramPoint] = {}
    otherwise: dict[str, int] = {}
    said: dict[str, str] = {}
    carried, section, at = 0, "", 0
    for line, whole in enumerate(text.split("\n"), start=1):
        code = whole.rstrip("\r")
        if code.startswith("//") and not code.startswith("///"):
            section = code[2:].split()[0].upper() if code[2:].split() else ""
        elif section == "POS" and code.startswith("///"):
            word, _, rest = code[3:].strip().partition(" ")
            said[word.upper()] = rest.strip()
        elif section == "POS" and (m := _POINT.match(code)):
            if m[1].upper() in ("C", "P"):
                points[_key(m[1], m[2])] = _point(m, at, line, said, known)
            elif m[1].upper() in ("BC", "BP") and any(float(n) for n in _NUMBER.findall(m[3])):
                carried = carried or line
        elif section == "INST" and not code.strip().startswith("'"):
            _instruction(path.name, code, line, points, found, otherwise)
        at += len(whole) + 1
    if carried:
        raise InputError(
            f"{path.name}: line {carried}: a base axis moves the arm, and it is not known where "
            "to; valid: jobs of an arm that stands"
        )
    for key, line in otherwise.items():
        if key in found and not found[key].left:
            found[key] = replace(found[key], left=f"line {line} uses or changes it otherwise")
    if not found:
        raise InputError(f"{path.name}: no motions; valid: MOVJ, MOVL, MOVC, MOVS")
    return Program(INFORM, (path.suffix,), (text,), tuple(found.values()), encoding)


def _key(kind: str, number: str) -> str:
    return f"{kind.upper()}{int(number)}"


def _instruction(
    file: str,
    code: str,
    line: int,
    points: dict[str, ProgramPoint],
    found: dict[str, ProgramPoint],
    otherwise: dict[str, int],
) -> None:
    """Take note of an instruction."""
    if r := _REFUSED.match(code):
        raise InputError(
            f"{file}: line {line}: {r[1]} changes what points mean; valid: a job without it"
        )
    m = _MOTION.match(code)
    names = [_key(*n.groups()) for n in _NAME.finditer(code)]
    if m is None or m[1].upper() == "IMOV":
        otherwise.update({n: line for n in names if n not in otherwise})
        if m is not None:
            left = "IMOV is not corrected"
            found[f"line {line}"] = ProgramPoint(line, f"line {line}", left=left)
        return
    if len(names) != 1 or names[0] not in points:
        left = f"the point '{m[2][:20].strip()}' is not in this job"
        found[f"line {line}"] = ProgramPoint(line, f"line {line}", left=left)
        return
    (name,), obeyed = names, m[1].upper() == "MOVJ"
    old = found.get(name, replace(points[name], obeyed=False))
    found[name] = replace(old, obeyed=old.obeyed or obeyed)


def _point(
    m: re.Match[str], at: int, line: int, said: dict[str, str], known: ControllerFrames
) -> ProgramPoint:
    """Return a position; `at` is where its line begins."""
    bare = ProgramPoint(line, f"{m[1]}{m[2]} (line {line})")
    numbers = list(_NUMBER.finditer(m[3]))
    if len(numbers) != JOINTS or not re.fullmatch(r"[-+\d.,\s]+", m[3]):
        return replace(bare, left=f"not {JOINTS} numbers")
    start = at + m.start(3)
    spans = tuple(Span(0, start + n.start(), start + n.end()) for n in numbers)
    whole = replace(bare, numbers=spans, values=np.array([float(n[0]) for n in numbers]))
    kind, tool = said.get("POSTYPE", "").upper(), said.get("TOOL", "0").split(",")[0].strip()
    pose = frame_of(known, "tool", tool)
    if kind == "PULSE":
        if known.pulses is None:
            return replace(
                bare,
                left="in pulses; give pulses_per_degree = [S, L, U, R, B, T] by --frames F.toml",
            )
        held = np.eye(4) if isinstance(pose, str) else pose
        return replace(whole, joints=True, scale=known.pulses, tool=held)
    if kind == "ANGLE":
        return replace(whole, joints=True, tool=np.eye(4) if isinstance(pose, str) else pose)
    if kind not in ("BASE", "ROBOT", "USER"):
        return replace(bare, left=f"POSTYPE {kind} is not corrected")
    user = said.get("USER", "0") if kind == "USER" else "0"
    frame = frame_of(known, "frame", user) if user != "0" or kind != "USER" else "no ///USER"
    left = next((p for p in (pose, frame) if isinstance(p, str)), "")
    if left:
        return replace(bare, left=left)
    stated = [int(n) for n in re.findall(r"\d+", said.get("RCONF", ""))][:JOINTS]
    flags_ = tuple(stated) if len(stated) == JOINTS else (UNSTATED,) * JOINTS
    return replace(whole, tool=np.asarray(pose), frame=np.asarray(frame), flags=flags_)
