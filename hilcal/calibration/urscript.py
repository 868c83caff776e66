"""The waypoints of a URScript program, and the program with other joint values in their place.

Waypoints are the first arguments of `movej`, `movel`, `movep` and `servoj`: joint values
`[q1, …, q6]`, a pose `p[x, y, z, rx, ry, rz]`, a variable that one of these is assigned to once, or
`get_inverse_kin(pose, qnear=joints)`. Each becomes a list of joint values, which all of these
functions take. A pose is of the tool centre point that `set_tcp(p[…])` set last before it.
Source: Universal Robots, *The URScript Programming Language*, e-Series, software 5.11, chapter 2.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilcal import limits
from hilcal.calibration.points import Points
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.types import Floats

MOVES = ("movej", "movel", "movep", "servoj")
JOINTS = 6
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_LIST = re.compile(rf"(p?)\[\s*({_NUMBER}(?:\s*,\s*{_NUMBER}){{5}})\s*\]")
_NAME = re.compile(r"[A-Za-z_]\w*")
_ASSIGNED = re.compile(rf"^\s*(?:global\s+|local\s+)?([A-Za-z_]\w*)\s*=\s*({_LIST.pattern})\s*$")
_CALL = re.compile(rf"\b({'|'.join(MOVES)}|set_tcp)\s*\(")
_INVERSE = re.compile(r"get_inverse_kin\s*\(")


@dataclass(frozen=True, slots=True, eq=False)
class Waypoint:
    """One waypoint of a program.

    Attributes:
        line: of the program, from 1.
        begin: where its argument begins in the text.
        end: where it ends.
        q: (6,) joint values, or those that its branch is near to, rad; None where neither is given.
        pose: (4, 4) T_base_tool; None where the joint values are the target.
        tool: (4, 4) T_flange_tool that was set; None where none was.
    """

    line: int
    begin: int
    end: int
    q: Floats | None
    pose: Floats | None
    tool: Floats | None


def waypoints(program: str) -> tuple[Waypoint, ...]:
    """Find the waypoints of a program, in the order of its text.

    Raises:
        InputError: there are none, or one that is computed while the program runs.
    """
    text = _without_comments(program)
    values = _assigned(text)
    found: list[Waypoint] = []
    tool: Floats | None = None
    for call in _CALL.finditer(text):
        first, end = _argument(text, call.end())
        line = text.count("\n", 0, call.start()) + 1
        if call[1] == "set_tcp":
            _, pose = _target(first, values, line)
            if pose is None:
                raise InputError(f"line {line}: set_tcp without a pose p[x, y, z, rx, ry, rz]")
            tool = pose
            continue
        q, pose = _target(first, values, line)
        found.append(Waypoint(line, call.end(), end, q, pose, tool))
    if not found:
        raise InputError(f"no waypoints; valid: a URScript program with {', '.join(MOVES)}")
    return tuple(found)


def program_points(path: Path) -> tuple[str, tuple[Waypoint, ...], Points, Floats | None]:
    """Read a program: its text, its waypoints, these as points, and T_flange_tool if it is set.

    Raises:
        InputError: see `waypoints`; or more than one tool centre point.
    """
    try:
        program = limits.read_text(path, limits.PROGRAM)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a program: {error}") from None
    try:
        found = waypoints(program)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    first = found[0].tool
    for w in found:
        both = first is not None and w.tool is not None and np.array_equal(first, w.tool)
        if not both and not (first is None and w.tool is None):
            raise InputError(
                f"{path}: line {w.line}: another tool centre point than before; valid: one "
                "set_tcp before the first waypoint"
            )
    none, nowhere = np.full(JOINTS, np.nan), np.full((4, 4), np.nan)
    q = np.stack([none if w.q is None else w.q for w in found])
    wanted = np.stack([nowhere if w.pose is None else w.pose for w in found])
    names = tuple(f"line {w.line}" for w in found)
    return program, found, Points(names, q, wanted), first


def with_joints(program: str, found: Sequence[Waypoint], q: Floats) -> str:
    """Return the program with joint values (N, 6) in the place of its waypoints."""
    parts, at = [], 0
    for waypoint, values in zip(found, q, strict=True):
        parts += [program[at : waypoint.begin], urscript_list(values)]
        at = waypoint.end
    return "".join([*parts, program[at:]])


def urscript_list(values: Floats) -> str:
    """Return joint values as URScript writes them; 1 nrad is kept."""
    return f"[{', '.join(f'{v:.9f}' for v in values)}]"


def movej_program(names: Sequence[str], q: Floats) -> str:
    """Return a program that moves to joint values (N, 6), one after the other.

    The controller runs it as it is when it comes in on its script ports (30001 to 30003).
    """
    lines = [f"  movej({urscript_list(row)})  # {name}" for name, row in zip(names, q, strict=True)]
    return "\n".join(["def compensated():", *lines, "end", ""])


def _without_comments(program: str) -> str:
    """Return the program with blanks where comments and strings are, so that places are kept."""
    blank = re.compile(r'#[^\n]*|"[^"\n]*"')
    return blank.sub(lambda found: " " * len(found[0]), program)


def _assigned(text: str) -> dict[str, str]:
    """Lists by the names of the variables that they alone are assigned to."""
    found: dict[str, str] = {}
    for line in text.splitlines():
        match = _ASSIGNED.match(line)
        if match:
            found[match[1]] = match[2]
    for name in list(found):
        if len(re.findall(rf"(?m)^\s*(?:global\s+|local\s+)?{name}\s*=[^=]", text)) > 1:
            del found[name]
    return found


def _argument(text: str, begin: int) -> tuple[str, int]:
    """Return the first argument of a call, and where it ends."""
    depth, k = 0, begin
    while k < len(text) and not (depth == 0 and text[k] in ",)"):
        depth += (text[k] in "([") - (text[k] in ")]")
        k += 1
    return text[begin:k].strip(), k


def _target(
    argument: str, values: dict[str, str], line: int
) -> tuple[Floats | None, Floats | None]:
    """Joint values (6,) and pose (4, 4) of an argument, each None where it has none.

    Raises:
        InputError: it is computed while the program runs.
    """
    written = values.get(argument, argument)
    inverse = _INVERSE.match(written)
    if inverse:
        pose, at = _argument(written, inverse.end())
        near = _argument(written, at + 1)[0] if written[at : at + 1] == "," else ""
        near = re.sub(r"^qnear\s*=\s*", "", near)
        branch = _target(near, values, line)[0] if near else None
        return branch, _target(pose, values, line)[1]
    numbers = _LIST.fullmatch(written)
    if numbers is None:
        raise InputError(
            f"line {line}: the waypoint {argument[:40]!r} is computed while the program runs; "
            "valid: joint values, a pose p[…], or a variable that is assigned one of them once"
        )
    six = np.array([float(v) for v in numbers[2].split(",")])
    if not numbers[1]:
        return six, None
    return None, se3.matrix(se3.rotation(six[3:]), six[:3])
