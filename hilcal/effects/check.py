"""`check_effect`: does an effect keep to the protocol? Tried on states of an example arm."""

import re
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, get_args

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig, Robot
from hilcal.effects.options import PRIOR_HELP, typical_compliances
from hilcal.effects.protocol import (
    FRAME_ROLES,
    Columns,
    Effect,
    Field,
    LoadChange,
    Parameter,
    Response,
    Role,
    Situation,
    failure_of,
    source_of,
    total,
)
from hilcal.errors import HilcalError, InputError
from hilcal.names import escaped
from hilcal.readings.readings import ObserverName, States
from hilcal.robot import chain as chains
from hilcal.robot.chain import Deviation
from hilcal.robot.statics import Load, load_wrench_change, slot_wrenches
from hilcal.types import Floats

ROBOT = "ur10e"


def example_cell(joints: int | None = None, *, slides: bool = False) -> Cell:
    """Return the cell of an example arm with so many joints; with `slides` the first one slides."""
    cell = cell_from_config(CellConfig(robot=Robot(model=ROBOT)))
    arm = cell.arm
    rows = np.minimum(np.arange(arm.n if joints is None else joints), arm.n - 1)
    longer = replace(
        arm, links=arm.links[[*rows, arm.n]], masses=arm.masses[rows], coms=arm.coms[rows],
        q_min=arm.q_min[rows], q_max=arm.q_max[rows], torque_max=arm.torque_max[rows],
        prismatic=np.arange(len(rows)) == 0 if slides else None,
        joint_names=tuple(f"joint {k + 1}" for k in range(len(rows))),
    )  # fmt: skip
    names = [ObserverName("station", "S1"), ObserverName("station", "S2")]
    names += [ObserverName("point", "P"), ObserverName("gauge", "G")]
    longer_cell = replace(cell, arm=longer, load_point=np.array([0.02, -0.01, 0.1]))
    return longer_cell.observed_by(names)


def example_states(cell: Cell) -> States:
    """Return states drawn at random, the same ones every time, in arrays that cannot be changed."""
    rng, n, count = np.random.default_rng(0), cell.arm.n, 30
    q = rng.uniform(-1.5, 1.5, (count, n))
    wrench = rng.normal(size=(count, 6)) * [60, 60, 60, 8, 8, 8]
    wrench[::3] = 0.0
    time = np.cumsum(rng.uniform(20, 60, count))
    warm = 1.0 - np.exp(-time[:, None] / 600)
    states = States(
        q=q, wrench=wrench, time=time, load_time=rng.uniform(5, 300, count),
        air_temperature=21.0 + rng.normal(size=count),
        joint_temperature=22.0 + rng.uniform(5, 15, n) * warm,
        approach=rng.choice([-1.0, 1.0], (count, n)),
        q_actual=q + 1e-5 * rng.normal(size=q.shape), observer=np.arange(count) % 4,
    )  # fmt: skip
    for field in fields(states):
        if (array := getattr(states, field.name)) is not None:
            array.flags.writeable = False
    return states


def example_situation(cell: Cell, states: States) -> Situation:
    """Return the states on the rigid arm, with the wrenches by its weight and the loads."""
    angle = states.q if states.q_actual is None else states.q_actual
    chain = chains.evaluate(cell.arm, angle)
    load = Load(states.wrench, cell.load_point, cell.tool_mass, cell.tool_com, cell.gravity)
    wrench = slot_wrenches(cell.arm, chain, load)
    phases = cell.arm.phases(angle)
    for array in (wrench, phases):
        array.flags.writeable = False
    return Situation(cell, states, phases, chain, wrench, load, typical_compliances(cell))


NAME = re.compile(r"[a-z][a-z0-9_]*")
JOINTS = (6, 7)  # of arms to try an effect on; it has to pass on one
NEEDS = ("time", "load_time", "air_temperature", "joint_temperature", "approach", "q_actual")
AGREEMENT = 1e-3
"""A derivative lies between the difference quotients of both sides, also at a kink such as that of
max(τ, 0). Share of the largest value by which it may lie outside; a guess, far above rounding."""
ROUNDING = 1e-9  # Share of the largest value that rounding may change; a guess, far above 1e-16
STEP = 1e-4  # of difference quotients, in ordinary magnitudes; between rounding and curvature
_FIELDS = Deviation.__slots__


def check_effect(kind: type[Effect], cell: Cell | None = None) -> None:
    """Check that an effect keeps to the protocol, as scikit-learn's `check_estimator` does.

    >>> from hilcal.effects.backlash import Backlash
    >>> hc.check_effect(Backlash)

    Checked on 30 states are: class attributes; shapes and finite values of what each method
    returns; that no state depends on the others; `response`, `wrench_columns` and
    `compliance_columns` against difference quotients; that all columns of the readings that are
    used are named in `needs`. Unless a cell is given, it is tried on arms of six and seven joints.

    Raises:
        InputError: what is wrong, in one line: the file, the class or effect, what would be valid.
    """
    if not (isinstance(kind, type) and issubclass(kind, Effect)):
        raise InputError(f"{kind!r:.60} is no class of an effect; valid: a subclass of Effect")
    where = source_of(kind)
    try:
        _class(kind)
    except InputError as error:
        raise InputError(f"{where}: class {kind.__name__} {error}") from None
    problems = []
    slides = cell is None and not kind.applies(example_cell())
    for example in [example_cell(n, slides=slides) for n in JOINTS] if cell is None else [cell]:
        try:
            _try(kind, example)
        except HilcalError as error:
            problems.append(InputError(f"{where}: effect {kind.name}: {error}"))
        except (Exception, SystemExit) as error:
            raised = f"{where}: effect {kind.name}: {type(error).__name__}: {error}"
            problems.append(failure_of(error) or InputError(raised))
        else:
            return
    raise problems[0]


def _need(good: object, wrong: str) -> None:
    if not good:
        raise InputError(wrong)


def _is_text(value: object) -> bool:
    return isinstance(value, str) and bool(value.strip()) and escaped(value) == value


def _class(kind: type[Effect]) -> None:
    missing = sorted(getattr(kind, "__abstractmethods__", ()))
    _need(not missing, f"lacks {' and '.join(missing)}")
    inherited = kind.deviation is Effect.deviation
    _need(inherited, "overrides deviation; give columns, in whose parameters the law is linear")
    flag = "True, False", lambda v: isinstance(v, bool)
    positive = (
        "a number of ordinary magnitudes, more than 0",
        lambda v: isinstance(v, int | float) and not isinstance(v, bool) and v > 0,
    )
    rules: dict[str, tuple[str, Callable[[Any], bool]]] = {
        "name": (
            "lower-case letters, digits and _, a letter first",
            lambda v: isinstance(v, str) and bool(NAME.fullmatch(v)),
        ),
        "summary": ("the law in one line", _is_text),
        **dict.fromkeys(("elastic", "local_response", "of_setup"), flag),
        "needs": (
            f"a tuple of some of {', '.join(NEEDS)}",
            lambda v: isinstance(v, tuple) and _columns_of(v) <= set(NEEDS),
        ),
        "option_help": (
            "the meaning of each option by its name",
            lambda v: isinstance(v, dict) and all(map(_is_text, (*v, *v.values()))),
        ),
        "role": (", ".join(get_args(Role)), lambda v: v in get_args(Role)),
        **dict.fromkeys(("plausible", "drift", "spread"), positive),
    }
    for key, (valid, good) in rules.items():
        value = getattr(kind, key, None)
        _need(good(value), f"has {key} = {value!r}; valid: {valid}")
    has_priors = kind.role not in FRAME_ROLES or set(PRIOR_HELP) <= set(kind.option_help)
    _need(has_priors, f"has role = {kind.role!r}; add {' and '.join(PRIOR_HELP)} to option_help")


def _columns_of(needs: tuple[str, ...]) -> set[str]:
    return {column for need in needs for column in str(need).split(" or ")}


def _try(kind: type[Effect], cell: Cell) -> None:
    states = example_states(cell)
    effect, s = kind(cell, states), example_situation(cell, states)
    _parameters(effect)
    scale = np.array([p.scale for p in effect.parameters])
    theta = scale * np.random.default_rng(1).uniform(0.5, 1.5, len(scale))
    _columns(effect, s)
    _results(effect, theta, s)
    _states(effect, theta, s)
    _elastic(effect, theta, s)
    if effect.local_response:
        _local(effect, theta, s)
    _load(effect, theta, s, scale)
    _compliance(effect, theta, s)
    _needs(kind, cell, states)
    _columns(effect.for_scoring(states), s)


def _parameters(effect: Effect) -> None:
    parameters: Any = effect.parameters
    good = isinstance(parameters, tuple) and len(parameters) > 0
    _need(good, f"parameters are {parameters!r}; expected a tuple of one Parameter or more")
    for p in parameters:
        good = isinstance(p, Parameter) and _is_text(p.name) and _is_text(p.unit)
        _need(good, f"parameters hold {p!r}; expected Parameter(name, unit, scale, meaning)")
        good = isinstance(p.scale, int | float) and 0 < p.scale < np.inf
        expected = "expected an ordinary magnitude, more than 0"
        _need(good, f"parameters {p.name}: scale = {p.scale!r}; {expected}")
    names = [p.name for p in parameters]
    _need(len(set(names)) == len(names), f"parameters have a name twice: {', '.join(names)}")


def _columns(effect: Effect, s: Situation) -> None:
    columns: Any = effect.columns(s)
    good = isinstance(columns, tuple) and all(isinstance(c, Columns) for c in columns)
    _need(good, f"columns returns {type(columns).__name__}; expected a tuple of Columns")
    size, (count, n) = len(effect.parameters), s.angle.shape
    for c in columns:
        valid = get_args(Field)
        _need(c.field in valid, f"columns has the field {c.field!r}; valid: {', '.join(valid)}")
        limits = {"parameter": (c.parameter, size)}
        if c.field in ("dq", "twist"):
            limits["element"] = (c.element, n + (c.field == "twist"))
        for key, (index, most) in limits.items():
            a = np.asarray(index)
            good = a.ndim == 1 and a.dtype.kind in "iu" and len(a) == np.size(c.parameter)
            _need(good, f"columns has {key} = {index!r}; expected an array (P,) of whole numbers")
            good = bool(np.all((a >= 0) & (a < most)))
            _need(good, f"columns has {key} = {a.tolist()}; valid: 0 to {most - 1}")
        per = (len(c.parameter),) if c.field in ("dq", "scale") else (len(c.parameter), 6)
        _array(f"columns has {c.field} values", c.values, (count, *per), (1, *per))


def _results(effect: Effect, theta: Floats, s: Situation) -> None:
    (count, n), size = s.angle.shape, len(theta)
    step, prior = np.zeros((count, 2, n + 1, 6)), effect.prior_std()
    change: Any = effect.load_change(theta)
    response: Any = effect.response(theta, s, step)
    for method, value, expected in (
        ("load_change", change, LoadChange | None),
        ("response", response, Response),
    ):
        wrong = f"{method} returns {type(value).__name__}; expected {expected}"
        _need(isinstance(value, expected), wrong)
    for label, value, shape in (
        ("response has dq", response.dq, (count, 2, n)),
        ("response has twist", response.twist, (count, 2, n + 1, 6)),
        ("wrench_change is", effect.wrench_change(theta, s), (count, 6)),
        ("wrench_columns is", effect.wrench_columns(theta, s), (count, size, n + 1, 6)),
        ("load_columns is", effect.load_columns(theta, s), (count, size, 6)),
        ("compliance is", effect.compliance(theta), (n,)),
        ("groups is", effect.groups(), (size,)),
        ("prior_std is", None if prior is None else prior > 0, (size,)),
    ):
        if value is not None:
            _array(label, value, shape)
    same = type(effect)(s.cell, s.states, effect.options).parameters == effect.parameters
    _need(same, "its options do not build it again; keep in self.options what setup chooses")


def _array(label: str, value: Any, *shapes: tuple[int, ...]) -> None:
    good = isinstance(value, np.ndarray) and value.dtype.kind in "fiub"
    _need(good, f"{label} of type {type(value).__name__}; expected an array of numbers")
    expected = " or ".join(str(shape) for shape in dict.fromkeys(shapes))
    _need(value.shape in shapes, f"{label} of shape {value.shape}; expected {expected}")
    _need(np.isfinite(value).all(), f"{label} of which some are not finite")


def _states(effect: Effect, theta: Floats, s: Situation) -> None:
    """Check that the deviation of a state does not depend on the other states."""
    few = slice(0, len(s.states) // 3)
    full = effect.deviation(theta, s)
    alone = effect.deviation(theta, example_situation(s.cell, s.states[few]))
    for key in _FIELDS:
        a, b = _field(alone, key), _field(full, key)[few]
        _need(
            np.allclose(a, b, rtol=0.0, atol=ROUNDING * np.abs(a).max()),
            "columns of a state depend on the other states; take what is of all of them, as a "
            "reference, in setup(self, states)",
        )


def _elastic(effect: Effect, theta: Floats, s: Situation) -> None:
    rng = np.random.default_rng(2)
    step = STEP * rng.normal(size=s.wrench.shape) * [60, 60, 60, 20, 20, 20]
    up, down = (replace(s, wrench=w) for w in (s.wrench + step, s.wrench - step))
    response = effect.response(theta, s, step[:, None])
    for key, quotients in _quotients(effect, theta, up, s, down).items():
        still = effect.elastic or not any(map(np.any, quotients))
        _need(still, "columns follow the wrenches; set elastic = True and give response")
        part = getattr(response, key, None)
        derivative = np.zeros(1) if part is None else part[:, 0]
        _agree("response", f"of columns by the wrenches: {key}", derivative, *quotients)


def _local(effect: Effect, theta: Floats, s: Situation) -> None:
    """Check `local_response`: each slot deviates with its own wrench alone, (1, ...) works."""
    n = s.angle.shape[1]
    for slot in range(n + 1):
        step = np.zeros((1, 6, n + 1, 6))
        step[0, :, slot] = np.eye(6)
        response = effect.response(theta, s, step)
        repeated = effect.response(theta, s, np.repeat(step, len(s.angle), axis=0))
        for key in ("dq", "twist"):
            part, full = getattr(response, key), getattr(repeated, key)
            if part is None:
                continue
            good = part.ndim == full.ndim and np.allclose(part, full, rtol=1e-12, atol=0.0)
            _need(
                good, f"response to changes (1, P, n + 1, 6) has another {key}; expected the same"
            )
            elsewhere = np.arange(part.shape[2]) != slot
            wrong = f"response moves other slots than {slot} by its wrench"
            _need(not np.any(part[:, :, elsewhere]), f"{wrong}; set local_response = False")


def _compliance(effect: Effect, theta: Floats, s: Situation) -> None:
    step = STEP * s.compliance * np.random.default_rng(4).normal(size=len(s.compliance))
    up, down = (replace(s, compliance=c) for c in (s.compliance + step, s.compliance - step))
    change = total(effect.compliance_columns(theta, s), step, s)
    for key, quotients in _quotients(effect, theta, up, s, down).items():
        label = f"of columns by the compliance: {key}"
        _agree("compliance_columns", label, _field(change, key), *quotients)


def _load(effect: Effect, theta: Floats, s: Situation, scale: Floats) -> None:
    step = STEP * scale * np.random.default_rng(3).normal(size=len(scale))
    up, mid, down = (_transmitted(effect, t, s) for t in (theta + step, theta, theta - step))
    columns = effect.wrench_columns(theta, s)
    change = np.zeros(1) if columns is None else np.einsum("npki,p->nki", columns, step)
    _agree("wrench_columns", "of the wrenches by the parameters: it", change, up - mid, mid - down)
    if (by_load := effect.load_columns(theta, s)) is not None and columns is not None:
        by_slots = load_wrench_change(s.chain, s.load, by_load)
        phrase = "of the load's wrench by the parameters: it"
        _agree("load_columns", phrase, by_slots, columns, columns)


def _transmitted(effect: Effect, theta: Floats, s: Situation) -> Floats:
    """Slot wrenches (N, n + 1, 6) of the load as an effect changes it."""
    load, change, wrench = s.load, effect.load_change(theta), effect.wrench_change(theta, s)
    if change is not None and change.point is not None:
        load = replace(load, point=load.point + change.point)
    if change is not None:
        load = replace(load, first_moment=change.first_moment)
    if wrench is not None:
        load = replace(load, wrench=load.wrench + wrench)
    return slot_wrenches(s.cell.arm, s.chain, load)


def _needs(kind: type[Effect], cell: Cell, states: States) -> None:
    for column in (c for c in NEEDS if c not in _columns_of(kind.needs)):
        nothing: dict[str, Any] = {column: None}
        fewer = replace(states, **nothing)
        try:
            kind(cell, fewer).columns(example_situation(cell, fewer))
        except Exception:
            raise InputError(f'uses {column}; name it: needs = ("{column}",)') from None


def _quotients(
    effect: Effect, theta: Floats, up: Situation, mid: Situation, down: Situation
) -> dict[str, tuple[Floats, Floats]]:
    """Differences of the deviation to both sides of a situation, by field."""
    a, b, c = (effect.deviation(theta, s) for s in (up, mid, down))
    return {
        key: (_field(a, key) - _field(b, key), _field(b, key) - _field(c, key)) for key in _FIELDS
    }


def _field(deviation: Deviation, key: str) -> Floats:
    value: Floats | None = getattr(deviation, key)
    return np.zeros(1) if value is None else value


def _agree(method: str, phrase: str, derivative: Floats, above: Floats, below: Floats) -> None:
    outside = derivative - np.clip(derivative, np.minimum(above, below), np.maximum(above, below))
    size = float(max(np.abs(x).max() for x in (derivative, above, below)))
    off = float(np.abs(outside).max()) / size if size > 0 else 0.0
    wrong = f"{method} is not the derivative {phrase} is off by {100 * off:.1f} %"
    _need(off <= AGREEMENT, f"{wrong} of its largest value")
