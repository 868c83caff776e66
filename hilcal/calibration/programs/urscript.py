"""The waypoints of a URScript program, and the program with other joint values in their place.

A waypoint is the target of `movej`, `movel`, `movep` or `servoj`. It is understood if it is the
same in every run: joint values `[q1, …, q6]`, a pose `p[x, y, z, rx, ry, rz]`, a variable that is
assigned one of these once in the whole program, before the waypoint and in a block around it, or
`get_inverse_kin(pose, qnear=joints)`. A list of joint values, which all of these functions accept,
replaces its text; the rest of the program does not change, nor do other waypoints. The program is
refused if anything in it may change the meaning of a corrected waypoint: an unknown function, a
change of tool or payload on the way, a value that depends on the arm's position.

A pose is of the tool centre point that `set_tcp(p[…])` set before it. It has up to eight solutions.
`get_inverse_kin(pose, qnear=joints)` takes the solution nearest to `joints`, `movej` to a pose the
one nearest to the arm's position, which is the previous waypoint if this one always follows it. The
manual does not state the measure of the distance. A straight motion stays on the branch on which it
begins, whatever joint values state its target. A correction holds on one branch only.

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
from hilcal.calibration.programs.program import CORRECTED, Span, edited
from hilcal.calibration.programs.urscript_statements import Statement, statements
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.types import Bools, Floats

JOINTS = 6
STRAIGHT = ("movel", "movep")
MOVE_FUNCTIONS = {"movej": 4, "movel": 4, "movep": 3, "servoj": None}
"""Functions that move to a waypoint, with the index of the argument that is the blend radius."""
MAX_NAMED = 5  # most lines that an error names
_OTHER_MOVES = ("movec", "servoc", "speedj", "speedl")
"""Functions of other motions, which are not corrected."""
_STOPS = ("stopj", "stopl")
_TOOL = "set_tcp"
_MASSES = ("set_payload", "set_payload_mass", "set_target_payload")
_PAYLOAD = (*_MASSES, "set_payload_cog")
_GRAVITY = "set_gravity"
_SETUP = (_TOOL, *_PAYLOAD, _GRAVITY)
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
"""Functions that neither move the arm, nor use its position, nor change the meaning of a target."""
_WHERE = re.compile(r"get_(actual|target)_\w+|get_forward_kin|get_inverse_kin\w*", re.ASCII)
_VALID = (
    "valid: joint values, a pose p[…], or a variable that is assigned one of them once, before it; "
    "--leave keeps other waypoints as they are"
)
_NO_BRANCH = (
    "a pose without joint values, and no waypoint that always precedes it; "
    "get_inverse_kin(pose, qnear=joints) has them"
)

_ARITHMETIC: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
}
"""Without division: whether URScript divides integers to integers is not known."""

_LARGEST = 2.0**31  # integers of a controller overflow here

Value = float | tuple[str, tuple[float, ...]]  # a number, or a list ("") or pose ("p") of numbers


@dataclass(frozen=True, slots=True, eq=False)
class Waypoint:
    """One waypoint of a program, or another motion."""

    line: int  # of the program, from 1
    start: int  # offset of its target in the text
    end: int  # offset of the target's end
    q: Floats | None = None  # (6,) joint values, or those that select the branch of `pose`, rad
    pose: Floats | None = None  # (4, 4) T_base_tool; None where the joint values are the target
    tool: Floats | None = None  # (4, 4) T_flange_tool that was set; None if none
    payload_kg: float | None = None  # mass that was set; None if none
    gravity: Floats | None = None  # (3,) gravity that was set, base axes, m/s²; None if none
    blend_m: float = 0.0  # radius within which the arm passes without a stop, m
    not_corrected: str = ""  # why it is not corrected; empty if it is understood
    straight: bool = False  # whether the motion to it is a straight line
    follows_previous: bool = False  # whether the previous one of the text always precedes it


def waypoints(program: str) -> tuple[Waypoint, ...]:
    """Find the waypoints of a program, in the order of its text."""
    try:
        motions = _waypoints(_Program.of(statements(program)))
    except RecursionError:
        raise InputError("nested too deeply; valid: a URScript program") from None
    if not motions:
        raise InputError(
            f"no waypoints; valid: a URScript program with {', '.join(MOVE_FUNCTIONS)}"
        )
    return motions


def program_points(
    path: Path, leave: bool = False
) -> tuple[str, tuple[Waypoint, ...], Points, Floats | None]:
    """Return a program's text, its waypoints, the understood ones as points, and T_flange_tool."""
    try:
        # ends of lines stay as they are
        program = limits.read_bytes(path, limits.SCRIPT).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: cannot be read as a program: {error}") from None
    if CORRECTED in program:
        raise InputError(
            f"{path}: it is corrected already (line "
            f"{program[: program.index(CORRECTED)].count(chr(10)) + 1} says so), and a second "
            "correction would double the first; valid: the original program"
        )
    try:
        every = waypoints(program)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    understood = [w for w in every if not w.not_corrected]
    for w in every:
        if w.not_corrected and not (leave and understood):
            raise InputError(f"{path}: line {w.line}: {w.not_corrected}; {_VALID}")
    no_joints, no_pose = np.full(JOINTS, np.nan), np.full((4, 4), np.nan)
    q = np.stack([no_joints if w.q is None else w.q for w in understood])
    poses = np.stack([no_pose if w.pose is None else w.pose for w in understood])
    names = tuple(f"line {w.line}" for w in understood)
    return program, every, Points(names, q, poses), understood[0].tool


_DEFINITION = re.compile(r"^[ \t]*def\b", re.MULTILINE)


def with_joints(program: str, corrected: Sequence[Waypoint], q: Floats) -> str:
    """Return the program with joint values (N, 6) in place of its waypoints.

    The comment `CORRECTED` ends the line of the first function, or else of the first waypoint: a
    line outside of functions is a program of its own for the controller.
    """
    if not corrected:
        return program
    first = _DEFINITION.search(program)
    mark = re.compile(r"\r?$", re.MULTILINE).search(
        program, corrected[0].end if first is None else first.end()
    )
    pairs = zip(corrected, q, strict=True)
    edits = [(Span(0, w.start, w.end), urscript_list(row)) for w, row in pairs]
    if mark is not None:
        edits.append((Span(0, mark.start(), mark.start()), f"  # {CORRECTED}"))
    return edited(program, edits)


def urscript_list(values: Floats) -> str:
    """Return joint values in URScript, to 1 nrad."""
    return f"[{', '.join(f'{v:.9f}' for v in values)}]"


UNCHECKED = (
    "the motions to and between these points are not checked against limits, obstacles and the "
    "floor; set the payload first"
)


def movej_program(names: Sequence[str], q: Floats) -> str:
    """Return a program that moves to joint values (N, 6) one after the other.

    The controller runs it when it is sent to a script port (30001 to 30003). Nobody has checked
    its motions, which begin wherever the arm stands; its first line says so.
    """
    rows = zip(names, q, strict=True)
    lines = [f"  movej({urscript_list(row)})  # {escaped(name)}" for name, row in rows]
    return "\n".join([f"def compensated():  # {CORRECTED}; {UNCHECKED}", *lines, "end", ""])


@dataclass(frozen=True, slots=True, eq=False)
class _Program:
    statements: tuple[Statement, ...]  # in the order of the text
    functions: frozenset[str]  # names of functions that it defines
    bound: dict[str, list[tuple[int, ast.expr | None]]]
    """By name, the index of each statement that assigns a value, with that value; None for a
    parameter, an element or a function."""
    aliased: bool  # whether an assignment to an element may change another variable's list
    computed: dict[int, Value | None] = field(default_factory=dict)  # values by statement

    @classmethod
    def of(cls, program: tuple[Statement, ...]) -> "_Program":
        bound: dict[str, list[tuple[int, ast.expr | None]]] = {}
        functions, elements = set(), set()
        for k, s in enumerate(program):
            values: dict[str, ast.expr | None] = {}
            match s.node:
                case ast.FunctionDef(name=name):
                    functions.add(name)
                    values = dict.fromkeys([name, *(a.arg for a in s.node.args.args)])
                case ast.Assign(targets=[ast.Name(name)]):
                    values = {name: s.node.value}
                case ast.Assign(targets=[ast.Subscript(value=ast.Name(name))]):
                    values = {name: None}
                    elements.add(name)
            for name, value in values.items():
                reserved = ("p", *MOVE_FUNCTIONS, *_OTHER_MOVES, *_STOPS, *_SETUP)
                if name in reserved or _HARMLESS.fullmatch(name) or _WHERE.fullmatch(name):
                    raise InputError(
                        f"line {s.line}: '{name}' is a name of URScript's own; valid: another name"
                    )
                bound.setdefault(name, []).append((k, value))
        aliased = any(
            (value is None and not isinstance(program[k].node, ast.Assign))
            or (value is not None and not isinstance(value, ast.List) and not _is_pose(value))
            for name in elements
            for k, value in bound[name]
        )  # fmt: skip
        return cls(program, frozenset(functions), bound, aliased)

    def value(self, node: ast.expr, k: int) -> Value | None:
        """Value of an expression in statement k; None if it may differ between runs."""
        match node:
            case ast.Constant(value=bool()):
                return None
            case ast.Constant(value=int() | float() as number):
                return float(number) if abs(number) < _LARGEST else None
            case ast.Name(name):
                return self._variable(name, k)
            case ast.List(elts=parts) | ast.Subscript(slice=ast.Tuple(elts=parts)):
                values = [self.value(part, k) for part in parts]
                numbers = tuple(v for v in values if isinstance(v, float) and math.isfinite(v))
                return ("p" * _is_pose(node), numbers) if len(numbers) == len(parts) else None
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

    def _variable(self, name: str, k: int) -> Value | None:
        bound = self.bound.get(name, [])
        if len(bound) != 1 or self.aliased:
            return None
        ((assignment, node),) = bound
        if node is None or assignment >= k or not self.contains(assignment, k):
            return None
        if assignment not in self.computed:
            self.computed[assignment] = self.value(node, assignment)
        return self.computed[assignment]

    def contains(self, outer: int, k: int) -> bool:
        blocks = self.statements[outer].blocks
        return self.statements[k].blocks[: len(blocks)] == blocks

    def target(self, node: ast.expr, k: int) -> tuple[Floats | None, Floats | None] | None:
        """Joint values (6,) and pose (4, 4) of a waypoint, None where absent; None if computed."""
        match node:
            case ast.Call(func=ast.Name("get_inverse_kin"), args=[pose, *extra], keywords=named):
                near = [*extra, *(n.value for n in named if n.arg == "qnear")]
                if len(near) != len(extra) + len(named) or len(near) > 1:
                    return None
                stated = _pose(self.value(pose, k))
                branch = _six(self.value(near[0], k)) if near else None
                if stated is None or (near and branch is None):
                    return None
                return branch, stated
        value = self.value(node, k)
        q, goal = _six(value), _pose(value)
        return None if q is goal is None else (q, goal)

    def why_not(self, node: ast.expr, s: Statement) -> str:
        reason = f"the waypoint '{s.text_of(node)[:40]}' is computed while the program runs"
        if isinstance(node, ast.Name) and node.id in self.bound:
            bound = self.bound[node.id]  # a line with several, of parameters, is named once
            lines = list(dict.fromkeys(str(self.statements[k].line) for k, _ in bound[:MAX_NAMED]))
            more = f" and {len(bound) - MAX_NAMED} more" if len(bound) > MAX_NAMED else ""
            source = f"line{'s' * (len(lines) > 1)} {', '.join(lines)}{more}"
            reason += f" ('{node.id[:40]}' has its value from {source})"
        return reason


def _waypoints(p: _Program) -> tuple[Waypoint, ...]:
    out: list[Waypoint] = []
    last_blocks: tuple[int, ...] | None = None  # of the waypoint that the arm is at, if known
    at_start = True  # the arm has not moved yet
    setup: dict[str, tuple[int, list[Value | None]]] = {}
    moving = {*MOVE_FUNCTIONS, *_OTHER_MOVES}
    called = {name for s in p.statements for name in s.calls.values()}
    head = p.statements[0].node if p.statements else None
    wrapped = (  # the whole program is one function, which runs once
        isinstance(head, ast.FunctionDef)
        and head.name not in called
        and all(s.blocks for s in p.statements[1:])
    )
    moved_by = {*moving, *_STOPS, *p.functions}
    side_by_side = any(
        {"thread", "sec"} & set(s.kinds) and moved_by & set(s.calls.values()) for s in p.statements
    )
    idle = {  # blocks of nested functions that are never called
        s.block
        for s in p.statements
        if isinstance(s.node, ast.FunctionDef) and s.blocks and s.node.name not in called
    }
    for k, s in enumerate(p.statements):
        if idle.isdisjoint(s.blocks):
            _check_calls(p, s)
        name = "" if s.call is None else s.calls[s.call]
        if p.functions & set(s.calls.values()) or name in _STOPS:
            last_blocks, at_start = None, False
        if name in _SETUP:
            _set_up(p, k, setup, moved=bool(out))
        elif name in moving:
            waypoint = _waypoint(p, k, setup)
            repeated = "while" in s.kinds or s.kinds.count("def") > wrapped
            follows = last_blocks == s.blocks and not side_by_side
            branch_known = follows or (at_start and not repeated and not side_by_side)
            if waypoint.pose is not None and waypoint.q is None and not branch_known:
                waypoint = replace(waypoint, not_corrected=_NO_BRANCH)
            waypoint = replace(waypoint, straight=name in STRAIGHT, follows_previous=follows)
            # servoj ends after its time, wherever the arm is
            unknown, at_start = waypoint.not_corrected or name == "servoj", False
            last_blocks = None if unknown else s.blocks
            out.append(waypoint)
    return tuple(out)


def _waypoint(p: _Program, k: int, setup: Mapping[str, tuple[int, list[Value | None]]]) -> Waypoint:
    s = p.statements[k]
    assert s.call is not None  # noqa: S101 - see `_check_calls`
    name, named = s.calls[s.call], {n.arg: n.value for n in s.call.keywords}
    targets = [*s.call.args[:1], *(named[n] for n in ("q", "pose") if n in named)]
    if name in _OTHER_MOVES or len(targets) != 1:
        return Waypoint(s.line, 0, 0, not_corrected=f"{name} is not corrected")
    (target,) = targets
    out = Waypoint(s.line, *s.span(target))
    if (index := MOVE_FUNCTIONS[name]) is not None:
        radius = named.get("r", s.call.args[index] if len(s.call.args) > index else None)
        blend = 0.0 if radius is None else p.value(radius, k)
        if not isinstance(blend, float):
            return replace(out, not_corrected="its blend radius is computed while the program runs")
        out = replace(out, blend_m=blend)
    target_values = p.target(target, k)
    if target_values is None or (name == "servoj" and target_values[1] is not None):
        return replace(out, not_corrected=p.why_not(target, s))
    for setting, _ in setup.values():
        if not p.contains(setting, k):
            raise InputError(
                f"line {s.line}: the set_tcp or payload of line {p.statements[setting].line} need "
                "not come before it; valid: once before the first motion, not in if or while"
            )
    tool = setup[_TOOL][1][0] if _TOOL in setup else None
    masses = (setup[n][1][0] for n in _MASSES if n in setup and setup[n][1])
    payload = next((m for m in masses if isinstance(m, float)), None)
    gravity = None
    match setup[_GRAVITY][1] if _GRAVITY in setup else ():
        case [(_, (x, y, z))]:  # the acceleration away from the Earth
            gravity = -np.array([x, y, z])
    q, pose = target_values
    return replace(out, q=q, pose=pose, tool=_pose(tool), payload_kg=payload, gravity=gravity)


def _set_up(
    p: _Program, k: int, setup: dict[str, tuple[int, list[Value | None]]], *, moved: bool
) -> None:
    s = p.statements[k]
    assert s.call is not None  # noqa: S101 - see `_check_calls`
    name = s.calls[s.call]
    values = [p.value(a, k) for a in (*s.call.args, *(n.value for n in s.call.keywords))]
    if name == _TOOL:
        values = values[:1]
        if not values or _pose(values[0]) is None:
            raise InputError(f"line {s.line}: set_tcp without a pose of numbers; valid: p[x, y, …]")
    elif None in values:
        raise InputError(f"line {s.line}: {name} is computed while it runs; valid: numbers")
    if setup.setdefault(name, (k, values))[1] != values or (moved and name != _TOOL):
        quantity = "tool centre point" if name == _TOOL else name.removeprefix("set_")
        raise InputError(
            f"line {s.line}: another {quantity} than before; valid: one {name} before the first "
            "waypoint, and a program for each load"
        )
    if moved and setup[name][0] == k:
        raise InputError(f"line {s.line}: {name} after a motion; valid: before the first one")


def _check_calls(p: _Program, s: Statement) -> None:
    moves = s.call is not None and s.calls[s.call] in MOVE_FUNCTIONS
    targets = [*s.call.args[:1], *(n.value for n in s.call.keywords)] if moves and s.call else []
    for call, name in s.calls.items():
        if _WHERE.fullmatch(name):
            near = len(call.args) > 1 or any(n.arg == "qnear" for n in call.keywords)
            stated = name == "get_forward_kin" and call.args
            if not stated and (name != "get_inverse_kin" or not (near or call in targets)):
                raise InputError(
                    f"line {s.line}: {name} depends on where the arm stands, which corrections "
                    "change; valid: values that do not"
                )
        elif name in MOVE_FUNCTIONS or name in (*_OTHER_MOVES, *_STOPS, *_SETUP):
            if call is not s.call:
                raise InputError(f"line {s.line}: {name} within an expression; valid: on its own")
        elif name not in p.functions and not _HARMLESS.fullmatch(name):
            raise InputError(
                f"line {s.line}: it is not known what '{name[:40]}' does to a waypoint; valid: "
                "motions, set_tcp, payload, inputs, outputs, arithmetic and functions of its own"
            )


def _is_pose(node: ast.expr) -> bool:
    """Whether a node is p[…]; `_means_the_same` admits no other subscript of several parts."""
    return isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Tuple)


def _six(value: Value | None, kind: str = "") -> Floats | None:
    """(6,) numbers of a list, or of a pose if `kind` is "p"; None for any other value."""
    if isinstance(value, tuple) and value[0] == kind and len(value[1]) == JOINTS:
        return np.array(value[1])
    return None


def _pose(value: Value | None) -> Floats | None:
    """(4, 4) of a pose; None for any other value."""
    six = _six(value, "p")
    return None if six is None else se3.matrix(se3.rotation(six[3:]), six[:3])


STEPS = 40
"""Poses between two waypoints of a straight motion; a choice."""
LARGEST_STEP = 0.5
"""Turn of a joint between two of these poses above which the motion passes a singularity, rad; a
choice."""
SAME_SOLUTION = 1e-6
"""Largest difference of joint values of the same solution, rad: far above the residual of one, far
below the distance of two."""
BRANCH_MARGIN = 0.05
"""Margin by which any other solution must be farther for this one to count as the nearest, rad. A
controller has its own calibrated arm: of 1,024 motions of ur3e, ur5e and ur10e the branch is wrong
in 1 at 0.02 and in none from 0.05 on, if each joint of each solution is up to 10 mrad off; 17
remain uncertain at 0.05, 33 at 0.1, 62 at 0.2."""
NEAREST = "another branch of the arm is as near; valid: joint values in place of the pose"
NOT_STRAIGHT = (
    "a straight motion from the previous waypoint ends on another branch of the arm; use movej"
)
UNKNOWN = "the branch of the previous waypoint is not known"


def doubts(
    arm: Arm, tool: Floats, waypoints: Sequence[Waypoint], q: Floats, near: Floats | None
) -> list[str]:
    """Return why the branch of each of N waypoints is not certain; empty where it is.

    Joint values q (N, 6) put the tool (4, 4) on the nominal arm at the waypoints. The first
    waypoint is near to `near` (6,), rad, or to q if None.
    """
    if not waypoints:
        return []
    previous = np.concatenate([q[:1] if near is None else near[None], q[:-1]])
    stated = np.stack([previous[k] if w.q is None else w.q for k, w in enumerate(waypoints)])
    on_line = np.array(
        [k > 0 and w.straight and w.follows_previous for k, w in enumerate(waypoints)]
    )
    chosen = np.array([w.pose is not None for w in waypoints])
    chosen &= ~on_line | np.array([w.q is not None for w in waypoints])
    tied = chosen & ~_nearest(arm, tool, stated, q)
    bent = on_line & ~_straight(arm, tool, previous, q)
    out: list[str] = []
    for k, w in enumerate(waypoints):
        unknown = k > 0 and out[-1] and (on_line[k] or (w.q is None and w.pose is not None))
        out.append(UNKNOWN if unknown else NEAREST if tied[k] else NOT_STRAIGHT if bent[k] else "")
    return out


def _nearest(arm: Arm, tool: Floats, near: Floats, q: Floats) -> Bools:
    """(N,) whether no other solution of the poses at q (N, 6) is as near to `near` (N, 6)."""
    rotation, position, _ = nominal_pose(arm, tool, q)
    distance = _turn(q - near)
    out = np.ones(len(q), dtype=bool)
    for start in _flipped(q):
        solution = invert_nominal(arm, tool, start, rotation, position)
        different = solution.solved & (np.abs(_turn(solution.q - q)).max(axis=1) > SAME_SOLUTION)
        other_distance = _turn(solution.q - near)
        for order in (1, 2, np.inf):
            least = np.linalg.norm(distance, order, axis=1) + BRANCH_MARGIN
            farther = np.linalg.norm(other_distance, order, axis=1) > least
            out &= ~different | farther
    return out


def _flipped(q: Floats) -> list[Floats]:
    """Joint values (N, 6) from which Newton's method converges to the other solutions."""
    wrist = q + np.array([0, 0, 0, np.pi, 0, np.pi])
    wrist[:, 4] = -q[:, 4]
    out = [q, wrist]
    for base in (q, wrist):
        elbow = base.copy()
        elbow[:, 2] *= -1
        elbow[:, [1, 3]] += base[:, 2:3]
        out.append(elbow)
    for base in list(out):
        shoulder = base.copy()
        shoulder[:, 0] += np.pi
        shoulder[:, 1] = -np.pi - base[:, 1]
        shoulder[:, 2:4] *= -1
        out.append(shoulder)
    return [_turn(base) for base in out[1:]]


def _straight(arm: Arm, tool: Floats, begin: Floats, q: Floats) -> Bools:
    """(N,) whether the straight motion from joint values (N, 6) to the poses at q ends at q."""
    r0, p0, _ = nominal_pose(arm, tool, begin)
    r1, p1, _ = nominal_pose(arm, tool, q)
    turn = se3.rotation_vector(se3.product(r1, np.swapaxes(r0, 1, 2)))
    joints, out = begin, np.ones(len(q), dtype=bool)
    for share in np.arange(1, STEPS + 1) / STEPS:
        rotation = se3.product(se3.rotation(share * turn), r0)
        solution = invert_nominal(arm, tool, joints, rotation, p0 + share * (p1 - p0))
        out &= solution.solved & (np.abs(solution.q - joints).max(axis=1) < LARGEST_STEP)
        joints = solution.q
    return np.asarray(out & (np.abs(_turn(joints - q)).max(axis=1) < SAME_SOLUTION))


def _turn(angle: Floats) -> Floats:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
