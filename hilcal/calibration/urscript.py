"""The waypoints of a URScript program, and the program with other joint values in their place.

A waypoint is the target of `movej`, `movel`, `movep` or `servoj`. It is understood where it is the
same whatever way the program takes: joint values `[q1, …, q6]`, a pose `p[x, y, z, rx, ry, rz]`, a
variable that has one assignment in the whole program, of one of these, before the waypoint and in a
block around it, or `get_inverse_kin(pose, qnear=joints)`. Its text becomes a list of joint values,
which all of these functions take; nothing else of the program is changed. Every other waypoint is
left. What could make a corrected waypoint another one (an unknown function, a tool or payload that
changes on the way, a value that depends on where the arm stands) refuses the program.

A pose is of the tool centre point that `set_tcp(p[…])` set before it. The controller takes the
solution near to where the arm stands; that is the waypoint before where this one always follows it.

A pose has up to eight solutions. `get_inverse_kin(pose, qnear=joints)` and `movej` to a pose take
the one nearest to given joint values, or to where the arm stands; the manual does not say by which
measure. A straight motion stays on the branch that it begins on, whatever joint values its target
is stated by. A correction is right on one branch only.

Source: Universal Robots, *The URScript Programming Language*, e-Series, software 5.11.
"""

import ast
import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hilcal import limits
from hilcal.calibration.compensation import invert_nominal, nominal_pose
from hilcal.calibration.points import Points
from hilcal.calibration.urscript_statements import Statement, statements
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.types import Bools, Floats

JOINTS = 6
STRAIGHT = ("movel", "movep")
MOVES = {"movej": 4, "movel": 4, "movep": 3, "servoj": None}
"""Functions that move to a waypoint, and which of their arguments is the blend radius."""
NAMED = 5
"""Lines that an error names."""
_OTHER_MOVES = ("movec", "servoc", "speedj", "speedl")
"""Functions that move otherwise; they are left as they are."""
_STOPS = ("stopj", "stopl")
_TOOL = "set_tcp"
_PAYLOAD = ("set_payload", "set_payload_mass", "set_payload_cog", "set_target_payload")
_SETUP = (_TOOL, *_PAYLOAD, "set_gravity")
_HARMLESS = re.compile(
    r"a?(cos|sin|tan)|atan2|ceil|floor|d2r|r2d|log|pow|sqrt|norm|random|length|get_list_length"
    r"|(integer|binary_list)_to_(binary_list|integer)|rotvec2rpy|rpy2rotvec|inv|size|transpose"
    r"|normalize|pose_(add|sub|dist|inv|trans)|point_dist|interpolate_pose|wrench_trans"
    r"|to_(num|str)|str_(at|cat|empty|find|len|sub)|sleep|sync|textmsg|popup|time|powerdown"
    r"|(get|set)_(standard_|configurable_|tool_)?(digital|analog)_(in|out)|set_tool_voltage"
    r"|set_(standard_|configurable_|tool_)?(digital|analog)_(in|out)put_?(action|domain|mode|range)"
    r"|set_(runstate|input_actions)_\w+|set_tool_(communication|output_mode)"
    r"|set_safety_mode_transition_hardness"
    r"|(read|write)_(input|output)_(boolean|integer|float)_register|read_port_(bit|register)"
    r"|write_port_(bit|register)|modbus_\w+"
    r"|socket_(open|close|get_var|set_var|(read|send)_\w+)|request_\w+_from_primary_client"
    r"|is_steady|get_steptime|get_tcp_force|force|get_joint_temp|get_controller_temp"
    r"|get_tool_(temp|current)",
    re.ASCII,
)
"""Functions that neither move the arm, nor tell where it stands, nor change what a target means."""
_WHERE = re.compile(r"get_(actual|target)_\w+|get_forward_kin|get_inverse_kin\w*", re.ASCII)
_VALID = (
    "valid: joint values, a pose p[…], or a variable that is assigned one of them once, before it; "
    "--leave keeps other waypoints as they are"
)
_NO_BRANCH = (
    "a pose without joint values that no waypoint always comes right before; "
    "get_inverse_kin(pose, qnear=joints) has them"
)

_ARITHMETIC: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
}
"""Without division, of which it is not known whether whole numbers stay whole."""

_LARGEST = 2.0**31
"""Whole numbers of a controller end here, what is beyond is not the sum that it should be."""

Value = float | tuple[str, tuple[float, ...]]
"""A number, or a list ("") or pose ("p") of numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class Waypoint:
    """One waypoint of a program, or another motion."""

    line: int  # of the program, from 1
    begin: int  # where its target begins in the text
    end: int  # where it ends
    q: Floats | None = None
    """(6,) joint values, or those that its branch is near to, rad; None where neither is given."""
    pose: Floats | None = None  # (4, 4) T_base_tool; None where the joint values are the target
    tool: Floats | None = None  # (4, 4) T_flange_tool that was set; None where none was
    blend_m: float = 0.0  # radius within which the arm passes it without a stop, m
    left: str = ""  # why it is left as it is; empty where it is understood
    straight: bool = False  # whether the tool moves to it on a straight line
    follows: bool = False  # whether the waypoint before it in the text always comes right before it


def waypoints(program: str) -> tuple[Waypoint, ...]:
    """Find the waypoints of a program, in the order of its text."""
    try:
        found = _waypoints(_Program.of(statements(program)))
    except RecursionError:
        raise InputError("nested too deeply; valid: a URScript program") from None
    if not found:
        raise InputError(f"no waypoints; valid: a URScript program with {', '.join(MOVES)}")
    return found


def program_points(
    path: Path, leave: bool = False
) -> tuple[str, tuple[Waypoint, ...], Points, Floats | None]:
    """Read a program: its text, its waypoints, the understood ones as points, and T_flange_tool."""
    try:
        # ends of lines stay as they are
        program = limits.read_bytes(path, limits.SCRIPT).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a program: {error}") from None
    try:
        every = waypoints(program)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    found = [w for w in every if not w.left]
    for w in every:
        if w.left and not (leave and found):
            raise InputError(f"{path}: line {w.line}: {w.left}; {_VALID}")
    none, nowhere = np.full(JOINTS, np.nan), np.full((4, 4), np.nan)
    q = np.stack([none if w.q is None else w.q for w in found])
    wanted = np.stack([nowhere if w.pose is None else w.pose for w in found])
    names = tuple(f"line {w.line}" for w in found)
    return program, every, Points(names, q, wanted), found[0].tool


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
    rows = zip(names, q, strict=True)
    lines = [f"  movej({urscript_list(row)})  # {escaped(name)}" for name, row in rows]
    return "\n".join(["def compensated():", *lines, "end", ""])


@dataclass(frozen=True, slots=True, eq=False)
class _Program:
    """Statements, and what their names stand for."""

    statements: tuple[Statement, ...]  # in the order of the text
    functions: frozenset[str]  # names that it defines
    bound: dict[str, list[tuple[int, ast.expr | None]]]
    """By name, the number of each statement that gives it a value, with that value; None for a
    parameter, an element or a function."""
    aliased: bool  # whether an element is assigned of what may be another variable's list
    known: dict[int, Value | None] = field(default_factory=dict)  # values that were computed

    @classmethod
    def of(cls, found: tuple[Statement, ...]) -> "_Program":
        """Collect names."""
        bound: dict[str, list[tuple[int, ast.expr | None]]] = {}
        functions, elements = set(), set()
        for k, s in enumerate(found):
            given: dict[str, ast.expr | None] = {}
            match s.node:
                case ast.FunctionDef(name=name):
                    functions.add(name)
                    given = dict.fromkeys([name, *(a.arg for a in s.node.args.args)])
                case ast.Assign(targets=[ast.Name(name)]):
                    given = {name: s.node.value}
                case ast.Assign(targets=[ast.Subscript(value=ast.Name(name))]):
                    given = {name: None}
                    elements.add(name)
            for name, value in given.items():
                words = ("p", *MOVES, *_OTHER_MOVES, *_STOPS, *_SETUP)
                if name in words or _HARMLESS.fullmatch(name) or _WHERE.fullmatch(name):
                    raise InputError(
                        f"line {s.line}: '{name}' is a name of URScript's own; valid: another name"
                    )
                bound.setdefault(name, []).append((k, value))
        aliased = any(
            (value is None and not isinstance(found[k].node, ast.Assign))
            or (value is not None and not isinstance(value, ast.List) and not _is_pose(value))
            for name in elements
            for k, value in bound[name]
        )  # fmt: skip
        return cls(found, frozenset(functions), bound, aliased)

    def value(self, node: ast.expr, k: int) -> Value | None:
        """Value of an expression in statement k, if it has the same one in every run."""
        match node:
            case ast.Constant(value=bool()):
                return None
            case ast.Constant(value=int() | float() as number):
                return float(number) if abs(number) < _LARGEST else None
            case ast.Name(name):
                return self._variable(name, k)
            case ast.List(elts=parts):
                return self._vector("", parts, k)
            case ast.Subscript(slice=ast.Tuple(elts=parts)) if _is_pose(node):
                return self._vector("p", parts, k)
            case ast.UnaryOp(op=ast.USub() | ast.UAdd() as sign, operand=inner):
                x = self.value(inner, k)
                if isinstance(x, float):
                    return -x if isinstance(sign, ast.USub) else x
            case ast.BinOp(left=a, op=op, right=b) if type(op) in _ARITHMETIC:
                x, y = self.value(a, k), self.value(b, k)
                if isinstance(x, float) and isinstance(y, float):
                    z = _ARITHMETIC[type(op)](x, y)
                    return z if abs(z) < _LARGEST else None
            case ast.Call(func=ast.Name("d2r"), args=[inner], keywords=[]):
                x = self.value(inner, k)
                return math.radians(x) if isinstance(x, float) else None
        return None

    def _vector(self, kind: str, parts: Sequence[ast.expr], k: int) -> Value | None:
        values = [self.value(part, k) for part in parts]
        numbers = tuple(v for v in values if isinstance(v, float) and math.isfinite(v))
        return (kind, numbers) if len(numbers) == len(parts) else None

    def _variable(self, name: str, k: int) -> Value | None:
        bound = self.bound.get(name, [])
        if len(bound) != 1 or self.aliased:
            return None
        ((at, node),) = bound
        if node is None or at >= k or not self.around(at, k):
            return None
        if at not in self.known:
            self.known[at] = self.value(node, at)
        return self.known[at]

    def around(self, at: int, k: int) -> bool:
        """Whether statement `at` stands in a block that is around statement k, or the same."""
        blocks = self.statements[at].blocks
        return self.statements[k].blocks[: len(blocks)] == blocks

    def target(self, node: ast.expr, k: int) -> tuple[Floats | None, Floats | None] | None:
        """Joint values (6,) and pose (4, 4) of a waypoint, each None where it has none."""
        match node:
            case ast.Call(func=ast.Name("get_inverse_kin"), args=[pose, *more], keywords=named):
                near = [*more, *(n.value for n in named if n.arg == "qnear")]
                if len(near) != len(more) + len(named) or len(near) > 1:
                    return None
                wanted = _pose(self.value(pose, k))
                branch = _six(self.value(near[0], k)) if near else None
                if wanted is None or (near and branch is None):
                    return None
                return branch, wanted
        value = self.value(node, k)
        q, goal = _six(value), _pose(value)
        return None if q is None and goal is None else (q, goal)

    def why_not(self, node: ast.expr, s: Statement) -> str:
        """Say why a target is not understood."""
        what = f"the waypoint '{s.written(node)[:40]}' is computed while the program runs"
        if isinstance(node, ast.Name) and node.id in self.bound:
            given = self.bound[node.id]  # of those in one line, a parameter's, the line comes once
            lines = list(dict.fromkeys(str(self.statements[k].line) for k, _ in given[:NAMED]))
            more = f" and {len(given) - NAMED} more" if len(given) > NAMED else ""
            many = f"line{'s' * (len(lines) > 1)} {', '.join(lines)}{more}"
            what += f" ('{node.id[:40]}' has its value from {many})"
        return what


def _waypoints(p: _Program) -> tuple[Waypoint, ...]:
    """Go through the statements: motions in the order of the text."""
    out: list[Waypoint] = []
    stands: tuple[int, ...] | None = None  # blocks of the waypoint at which the arm stands
    begins = True  # it stands where the program found it
    setup: dict[str, tuple[int, list[Value | None]]] = {}
    moving = {*MOVES, *_OTHER_MOVES}
    called = {name for s in p.statements for name in s.called.values()}
    head = p.statements[0].node if p.statements else None
    wrapped = (  # the whole program is one function, which runs once
        isinstance(head, ast.FunctionDef)
        and head.name not in called
        and all(s.blocks for s in p.statements[1:])
    )
    moved_by = {*moving, *_STOPS, *p.functions}
    side_by_side = any(
        {"thread", "sec"} & set(s.kinds) and moved_by & set(s.called.values()) for s in p.statements
    )
    idle = {  # blocks of functions within another that nothing calls
        s.number
        for s in p.statements
        if isinstance(s.node, ast.FunctionDef) and s.blocks and s.node.name not in called
    }
    for k, s in enumerate(p.statements):
        if idle.isdisjoint(s.blocks):
            _check_calls(p, s)
        name = "" if s.call is None else s.called[s.call]
        if p.functions & set(s.called.values()) or name in _STOPS:
            stands, begins = None, False
        if name in _SETUP:
            _set_up(p, k, setup, moved=bool(out))
        elif name in moving:
            found = _waypoint(p, k, setup)
            again = "while" in s.kinds or s.kinds.count("def") > wrapped
            follows = stands == s.blocks and not side_by_side
            known = follows or (begins and not again and not side_by_side)
            if found.pose is not None and found.q is None and not known:
                found = replace(found, left=_NO_BRANCH)
            found = replace(found, straight=name in STRAIGHT, follows=follows)
            # servoj ends after its time, wherever the arm is then
            stands, begins = None if found.left or name == "servoj" else s.blocks, False
            out.append(found)
    return tuple(out)


def _waypoint(p: _Program, k: int, setup: Mapping[str, tuple[int, list[Value | None]]]) -> Waypoint:
    """Return the waypoint of a motion."""
    s = p.statements[k]
    assert s.call is not None  # noqa: S101 - see `_check_calls`
    name, named = s.called[s.call], {n.arg: n.value for n in s.call.keywords}
    targets = [*s.call.args[:1], *(named[n] for n in ("q", "pose") if n in named)]
    if name in _OTHER_MOVES or len(targets) != 1:
        return Waypoint(s.line, 0, 0, left=f"{name} is not corrected")
    (target,) = targets
    out = Waypoint(s.line, *s.place(target))
    if (at := MOVES[name]) is not None:
        radius = named.get("r", s.call.args[at] if len(s.call.args) > at else None)
        blend = 0.0 if radius is None else p.value(radius, k)
        if not isinstance(blend, float):
            return replace(out, left="its blend radius is computed while the program runs")
        out = replace(out, blend_m=blend)
    found = p.target(target, k)
    if found is None or (name == "servoj" and found[1] is not None):
        return replace(out, left=p.why_not(target, s))
    for at, _ in setup.values():
        if not p.around(at, k):
            raise InputError(
                f"line {s.line}: the set_tcp or payload of line {p.statements[at].line} need not "
                "come before it; valid: once before the first motion, not in if or while"
            )
    tool = setup[_TOOL][1][0] if _TOOL in setup else None
    return replace(out, q=found[0], pose=found[1], tool=_pose(tool))


def _set_up(
    p: _Program, k: int, setup: dict[str, tuple[int, list[Value | None]]], *, moved: bool
) -> None:
    """Take note of a tool centre point, a payload or gravity."""
    s = p.statements[k]
    assert s.call is not None  # noqa: S101 - see `_check_calls`
    name = s.called[s.call]
    values = [p.value(a, k) for a in (*s.call.args, *(n.value for n in s.call.keywords))]
    if name == _TOOL:
        values = values[:1]
        if not values or _pose(values[0]) is None:
            raise InputError(f"line {s.line}: set_tcp without a pose of numbers; valid: p[x, y, …]")
    elif None in values:
        raise InputError(f"line {s.line}: {name} is computed while it runs; valid: numbers")
    if setup.setdefault(name, (k, values))[1] != values or (moved and name != _TOOL):
        what = "tool centre point" if name == _TOOL else name.removeprefix("set_")
        raise InputError(
            f"line {s.line}: another {what} than before; valid: one {name} before the first "
            "waypoint, and a program for each load"
        )
    if moved and setup[name][0] == k:
        raise InputError(f"line {s.line}: {name} after a motion; valid: before the first one")


def _check_calls(p: _Program, s: Statement) -> None:
    """Refuse functions that are not known, and motions within expressions."""
    moves = s.call is not None and s.called[s.call] in MOVES
    targets = [*s.call.args[:1], *(n.value for n in s.call.keywords)] if moves and s.call else []
    for call, name in s.called.items():
        if _WHERE.fullmatch(name):
            near = len(call.args) > 1 or any(n.arg == "qnear" for n in call.keywords)
            stated = name == "get_forward_kin" and call.args
            if not stated and (name != "get_inverse_kin" or not (near or call in targets)):
                raise InputError(
                    f"line {s.line}: {name} depends on where the arm stands, which corrections "
                    "change; valid: values that do not"
                )
        elif name in MOVES or name in (*_OTHER_MOVES, *_STOPS, *_SETUP):
            if call is not s.call:
                raise InputError(f"line {s.line}: {name} within an expression; valid: on its own")
        elif name not in p.functions and not _HARMLESS.fullmatch(name):
            raise InputError(
                f"line {s.line}: it is not known what '{name[:40]}' does to a waypoint; valid: "
                "motions, set_tcp, payload, inputs, outputs, arithmetic and functions of its own"
            )


def _is_pose(node: ast.expr) -> bool:
    """Whether it is p[…]; `_known` has no other subscript of several parts."""
    return isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Tuple)


def _six(value: Value | None, kind: str = "") -> Floats | None:
    """(6,) numbers of a list, or of a pose where `kind` is "p"; None of any other value."""
    if isinstance(value, tuple) and value[0] == kind and len(value[1]) == JOINTS:
        return np.array(value[1])
    return None


def _pose(value: Value | None) -> Floats | None:
    """(4, 4) of a pose; None of any other value."""
    six = _six(value, "p")
    return None if six is None else se3.matrix(se3.rotation(six[3:]), six[:3])


STEPS = 40
"""Poses between two waypoints of a straight motion; a choice."""
LARGEST_STEP = 0.5
"""Turn of a joint from one of these to the next beyond which the motion passes a singularity, rad;
a choice."""
SAME = 1e-6
"""Joint values that are the same solution, rad: far above the residual of one, far below what is
between two."""
AS_NEAR = 0.05
"""What another solution must be farther for this one to be the nearest by any measure, rad. A
controller has its own calibrated arm: of 1,024 motions of ur3e, ur5e and ur10e the branch is wrong
in 1 at 0.02 and in none from 0.05 on, where each joint of each solution may be 10 mrad elsewhere;
17 are left uncertain at 0.05, 33 at 0.1, 62 at 0.2."""
NEAREST = "another branch of the arm is as near; joint values in place of the pose say which"
NOT_STRAIGHT = (
    "a straight motion from the waypoint before ends on another branch of the arm; use movej"
)
UNKNOWN = "the branch of the waypoint before it is not known"


def doubts(
    arm: Arm, tool: Floats, waypoints: Sequence[Waypoint], q: Floats, near: Floats | None
) -> list[str]:
    """Say why the branch of each of N waypoints is not certain; empty where it is.

    At joint values q (N, 6) the nominal arm has the tool (4, 4) there; `near` (6,) are those that
    the first one is near to, rad, None where none are given.
    """
    if not waypoints:
        return []
    before = np.concatenate([q[:1] if near is None else near[None], q[:-1]])
    stated = np.stack([before[k] if w.q is None else w.q for k, w in enumerate(waypoints)])
    led = np.array([k > 0 and w.straight and w.follows for k, w in enumerate(waypoints)])
    chosen = np.array([w.pose is not None for w in waypoints])
    chosen &= ~led | np.array([w.q is not None for w in waypoints])
    other = chosen & ~_nearest(arm, tool, stated, q)
    bent = led & ~_straight(arm, tool, before, q)
    out: list[str] = []
    for k, w in enumerate(waypoints):
        unknown = k > 0 and out[-1] and (led[k] or (w.q is None and w.pose is not None))
        out.append(UNKNOWN if unknown else NEAREST if other[k] else NOT_STRAIGHT if bent[k] else "")
    return out


def _nearest(arm: Arm, tool: Floats, near: Floats, q: Floats) -> Bools:
    """(N,) whether no other solution of the poses at q (N, 6) is as near to joint values (N, 6)."""
    rotation, position, _ = nominal_pose(arm, tool, q)
    mine = _turn(q - near)
    out = np.ones(len(q), dtype=bool)
    for start in _flipped(q):
        found = invert_nominal(arm, tool, start, rotation, position)
        other = found.solved & (np.abs(_turn(found.q - q)).max(axis=1) > SAME)
        theirs = _turn(found.q - near)
        for order in (1, 2, np.inf):
            least = np.linalg.norm(mine, order, axis=1) + AS_NEAR
            farther = np.linalg.norm(theirs, order, axis=1) > least
            out &= ~other | farther
    return out


def _flipped(q: Floats) -> list[Floats]:
    """Joint values (N, 6) from which Newton's method finds the other solutions."""
    wrist = q + np.array([0, 0, 0, np.pi, 0, np.pi])
    wrist[:, 4] = -q[:, 4]
    out = [q, wrist]
    for one in (q, wrist):
        elbow = one.copy()
        elbow[:, 2] *= -1
        elbow[:, [1, 3]] += one[:, 2:3]
        out.append(elbow)
    for one in list(out):
        shoulder = one.copy()
        shoulder[:, 0] += np.pi
        shoulder[:, 1] = -np.pi - one[:, 1]
        shoulder[:, 2:4] *= -1
        out.append(shoulder)
    return [_turn(one) for one in out[1:]]


def _straight(arm: Arm, tool: Floats, begin: Floats, q: Floats) -> Bools:
    """(N,) whether the straight motion from joint values (N, 6) to the poses at q ends at q."""
    r0, p0, _ = nominal_pose(arm, tool, begin)
    r1, p1, _ = nominal_pose(arm, tool, q)
    turn = se3.rotation_vector(se3.product(r1, np.swapaxes(r0, 1, 2)))
    at, out = begin, np.ones(len(q), dtype=bool)
    for share in np.arange(1, STEPS + 1) / STEPS:
        rotation = se3.product(se3.rotation(share * turn), r0)
        found = invert_nominal(arm, tool, at, rotation, p0 + share * (p1 - p0))
        out &= found.solved & (np.abs(found.q - at).max(axis=1) < LARGEST_STEP)
        at = found.q
    return np.asarray(out & (np.abs(_turn(at - q)).max(axis=1) < SAME))


def _turn(angle: Floats) -> Floats:
    """Angles from -π to π."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
