"""`check_effect`: does an effect keep to the protocol? Tried on states of an example arm."""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from hilcal.cell import Cell
from hilcal.data.readings import States
from hilcal.effects.example import example_cell, example_situation, example_states
from hilcal.effects.failure import failure_of
from hilcal.effects.options import PRIOR_HELP
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
    source_of,
    total,
)
from hilcal.errors import HilcalError, InputError
from hilcal.robot.deviation import Deviation
from hilcal.robot.statics import slot_wrenches
from hilcal.types import Floats

NAME = re.compile(r"[a-z][a-z0-9_]*")
JOINTS = (6, 7)
"""Arms to try an effect on; it has to pass on one, since it may be made for that arm alone."""
NEEDS = (
    "time",
    "load_time",
    "air_temperature",
    "joint_temperature",
    "approach",
    "q_actual",
)
"""Columns of `States` that readings may lack."""
AGREES = 1e-3
"""Share of the largest value by which a derivative may differ from the difference quotient. A
guess: central differences of steps of `STEP` agree to about 1e-6 for all built-in effects."""
ROUNDING = 1e-9
"""Share of the largest value that rounding may change; a guess, far above 1e-16."""
STEP = 1e-4
"""Steps of difference quotients, in ordinary magnitudes."""
_FIELDS = Deviation.__slots__


def check_effect(kind: type[Effect]) -> None:
    """Check that an effect keeps to the protocol, as scikit-learn's `check_estimator` does.

    Tried on 30 states of a six-joint arm, or of one with seven: class attributes; shapes and
    finite values of what each method returns; that the deviation is linear in the parameters and
    each state stands for itself; `response`, `wrench_columns` and `compliance_columns` against
    difference quotients; that all columns of the readings that are used are named in `needs`.

    Args:
        kind: the class.

    Raises:
        InputError: what is wrong, in one line: the file, the class or effect, what would be valid.
    """
    where = source_of(kind)
    if wrong := _class_problem(kind):
        raise InputError(f"{where}: class {kind.__name__} {wrong}")
    problems = []
    for joints in JOINTS:
        try:
            wrong = _problem(kind, example_cell(joints))
        except HilcalError as error:
            problems.append(InputError(f"{where}: effect {kind.name}: {error}"))
        except Exception as error:
            raised = f"{where}: effect {kind.name}: {type(error).__name__}: {error}"
            problems.append(failure_of(error) or InputError(raised))
        else:
            if wrong is None:
                return
            problems.append(InputError(f"{where}: effect {kind.name}: {wrong}"))
    raise problems[0]


def _class_problem(kind: type[Effect]) -> str | None:
    """Return what is wrong with the attributes of a class."""
    if missing := sorted(getattr(kind, "__abstractmethods__", ())):
        return f"lacks {' and '.join(missing)}"
    if kind.deviation is not Effect.deviation:
        return "overrides deviation; give columns, in whose parameters the law is linear"
    name = "lower-case letters, digits and _, a letter first"
    rules: tuple[tuple[str, str, Callable[[Any], bool]], ...] = (
        ("name", name, lambda v: isinstance(v, str) and bool(NAME.fullmatch(v))),
        ("summary", "the law in one line", lambda v: _is_text(v) and "\n" not in v),
        ("elastic", "True, False", lambda v: isinstance(v, bool)),
        (
            "needs",
            f"a tuple of some of {', '.join(NEEDS)}",
            lambda v: isinstance(v, tuple) and _columns_of(v) <= set(NEEDS),
        ),
        (
            "option_help",
            "the meaning of each option by its name",
            lambda v: isinstance(v, dict) and all(map(_is_text, (*v, *v.values()))),
        ),
        ("role", ", ".join(get_args(Role)), lambda v: v in get_args(Role)),
    )
    for key, valid, good in rules:
        found = getattr(kind, key, None)
        if not good(found):
            return f"has {key} = {found!r}; valid: {valid}"
    if kind.role in FRAME_ROLES and not set(PRIOR_HELP) <= set(kind.option_help):
        return f"has the role {kind.role}; add {' and '.join(PRIOR_HELP)} to option_help"
    return None


def _is_text(value: object) -> bool:
    return isinstance(value, str) and bool(value.strip())


def _columns_of(needs: tuple[str, ...]) -> set[str]:
    """Return the columns that needs name, each alone or as one of several, "a or b"."""
    return {column for need in needs for column in str(need).split(" or ")}


def _problem(kind: type[Effect], cell: Cell) -> str | None:
    """Return the first thing that is wrong with an effect on an arm."""
    states = example_states(cell)
    effect, s = kind(cell, states), example_situation(cell, states)
    if wrong := _parameters(effect):
        return wrong
    scale = np.array([p.scale for p in effect.parameters])
    theta = scale * np.random.default_rng(1).uniform(0.5, 1.5, len(scale))
    return (
        _columns(effect, s)
        or _results(effect, theta, s)
        or _states(effect, theta, s)
        or _elastic(effect, theta, s)
        or _load(effect, theta, s, scale)
        or _compliance(effect, theta, s)
        or _needs(kind, cell, states)
        or _columns(effect.for_scoring(states), s)
    )


def _parameters(effect: Effect) -> str | None:
    found: object = effect.parameters
    if not isinstance(found, tuple) or not found:
        return f"parameters are {found!r}; expected a tuple of one Parameter or more"
    for p in found:
        if not isinstance(p, Parameter) or not (_is_text(p.name) and _is_text(p.unit)):
            return f"parameters hold {p!r}; expected Parameter(name, unit, scale, meaning)"
        if not isinstance(p.scale, int | float) or not 0 < p.scale < np.inf:
            return (
                f"parameters {p.name}: scale = {p.scale!r}; expected an ordinary magnitude, more "
                "than 0"
            )
    names = [p.name for p in found]
    twice = [name for name in names if names.count(name) > 1]
    return f"parameters hold {twice[0]!r} twice" if twice else None


def _columns(effect: Effect, s: Situation) -> str | None:
    """Return what is wrong with fields, indices, shapes and values of the columns."""
    found: object = effect.columns(s)
    if not isinstance(found, tuple) or not all(isinstance(c, Columns) for c in found):
        return f"columns returns {type(found).__name__}; expected a tuple of Columns"
    size, (count, n) = len(effect.parameters), s.angle.shape
    for c in found:
        if c.field not in get_args(Field):
            return f"columns has the field {c.field!r}; valid: {', '.join(get_args(Field))}"
        limits = {"parameter": (c.parameter, size)}
        if c.field in ("dq", "twist"):
            limits["element"] = (c.element, n + (c.field == "twist"))
        for key, (index, most) in limits.items():
            a = np.asarray(index)
            if a.ndim != 1 or a.dtype.kind not in "iu" or len(a) != np.size(c.parameter):
                return f"columns has {key} = {index!r}; expected an array (P,) of whole numbers"
            if a.size and (a.min() < 0 or a.max() >= most):
                return f"columns has {key} = {a.tolist()}; valid: 0 to {most - 1}"
        per = (len(c.parameter),) if c.field in ("dq", "scale") else (len(c.parameter), 6)
        if wrong := _array(f"columns has {c.field} values", c.values, (count, *per), (1, *per)):
            return wrong
    return None


def _results(effect: Effect, theta: Floats, s: Situation) -> str | None:
    """Return what is wrong with types, shapes and values of what the other methods return."""
    (count, n), size = s.angle.shape, len(theta)
    step, prior = np.zeros((count, 2, n + 1, 6)), effect.prior_std()
    change: object = effect.load_change(theta)
    response: object = effect.response(theta, s, step)
    if change is not None and not isinstance(change, LoadChange):
        return f"load_change returns {type(change).__name__}; expected a LoadChange or None"
    if not isinstance(response, Response):
        return f"response returns {type(response).__name__}; expected a Response"
    optional: tuple[tuple[str, Any, tuple[int, ...]], ...] = (
        ("response has dq", response.dq, (count, 2, n)),
        ("response has twist", response.twist, (count, 2, n + 1, 6)),
        ("wrench_change is", effect.wrench_change(theta, s), (count, 6)),
        ("wrench_columns is", effect.wrench_columns(theta, s), (count, size, n + 1, 6)),
        ("compliance is", effect.compliance(theta), (n,)),
        ("groups is", effect.groups(), (size,)),
        ("prior_std is", None if prior is None else prior > 0, (size,)),
    )
    for what, found, shape in optional:
        if found is not None and (wrong := _array(what, found, shape)):
            return wrong
    if type(effect)(s.cell, s.states, effect.options).parameters != effect.parameters:
        return "its options do not build it again; keep in self.options what setup chooses"
    return None


def _array(what: str, found: object, *shapes: tuple[int, ...]) -> str | None:
    """Return what is wrong with an array: its type, its shape, or values that are not finite."""
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiub":
        return f"{what} of type {type(found).__name__}; expected an array of numbers"
    if found.shape not in shapes:
        expected = " or ".join(str(shape) for shape in dict.fromkeys(shapes))
        return f"{what} of shape {found.shape}; expected {expected}"
    return None if np.isfinite(found).all() else f"{what} of which some are not finite"


def _states(effect: Effect, theta: Floats, s: Situation) -> str | None:
    """Return whether the deviation of a state depends on the other states."""
    few = slice(0, len(s.states) // 3)
    own = effect.deviation(theta, s)
    alone = effect.deviation(theta, example_situation(s.cell, s.states[few]))
    for key in _FIELDS:
        a, b = _field(alone, key), _field(own, key)[few]
        if not np.allclose(a, b, rtol=0.0, atol=ROUNDING * np.abs(a).max()):
            return (
                "columns of a state depend on the other states; take what is of all of them, as a "
                "reference, in setup(self, states)"
            )
    return None


def _elastic(effect: Effect, theta: Floats, s: Situation) -> str | None:
    """Compare `elastic` and `response` with how the deviation follows the wrenches."""
    rng = np.random.default_rng(2)
    step = STEP * rng.normal(size=s.wrench.shape) * [60, 60, 60, 20, 20, 20]
    up = effect.deviation(theta, replace(s, wrench=s.wrench + step))
    down = effect.deviation(theta, replace(s, wrench=s.wrench - step))
    moved = {key: (_field(up, key) - _field(down, key)) / 2 for key in _FIELDS}
    if not effect.elastic:
        if any(np.any(m) for m in moved.values()):
            return "columns follow the wrenches; set elastic = True and give response"
        return None
    response = effect.response(theta, s, step[:, None])
    for key, quotient in moved.items():
        given = getattr(response, key, None)
        found = np.zeros(1) if given is None else given[:, 0]
        if wrong := _differs("response", f"of columns by the wrenches: {key}", found, quotient):
            return wrong
    return None


def _load(effect: Effect, theta: Floats, s: Situation, scale: Floats) -> str | None:
    """Compare `wrench_columns` with how the effect changes the load."""
    step = STEP * scale * np.random.default_rng(3).normal(size=len(scale))
    up, down = (_transmitted(effect, t, s) for t in (theta + step, theta - step))
    found = effect.wrench_columns(theta, s)
    given = np.zeros(1) if found is None else np.einsum("npki,p->nki", found, step)
    what = "of the wrenches by the parameters: it"
    return _differs("wrench_columns", what, given, (up - down) / 2)


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


def _compliance(effect: Effect, theta: Floats, s: Situation) -> str | None:
    """Compare `compliance_columns` with how the deviation follows the joint compliances."""
    step = STEP * s.compliance * np.random.default_rng(4).normal(size=len(s.compliance))
    up, down = (
        effect.deviation(theta, replace(s, compliance=c))
        for c in (s.compliance + step, s.compliance - step)
    )
    columns = effect.compliance_columns(theta, s)
    found = total(columns, step, s)
    for key in _FIELDS:
        quotient = (_field(up, key) - _field(down, key)) / 2
        what = f"of columns by the compliance: {key}"
        if wrong := _differs("compliance_columns", what, _field(found, key), quotient):
            return wrong
    return None


def _needs(kind: type[Effect], cell: Cell, states: States) -> str | None:
    """Return whether an effect uses a column that it does not name."""
    for column in NEEDS:
        nothing: dict[str, Any] = {column: None}
        fewer = replace(states, **nothing)
        if column in _columns_of(kind.needs) or not kind.computable(fewer):
            continue
        try:
            kind(cell, fewer).columns(example_situation(cell, fewer))
        except Exception:
            return f'uses {column}; name it: needs = ("{column}",)'
    return None


def _differs(method: str, of_what: str, found: Floats, expected: Floats) -> str | None:
    """Return by how much a derivative differs from the difference quotient, where it does."""
    size = float(max(np.abs(found).max(), np.abs(expected).max()))
    off = float(np.abs(found - expected).max()) / size if size > 0 else 0.0
    if off <= AGREES:
        return None
    return (
        f"{method} is not the derivative {of_what} is off by {100 * off:.1f} % of the largest value"
    )


def _field(deviation: Deviation, key: str) -> Floats:
    found: Floats | None = getattr(deviation, key)
    return np.zeros(1) if found is None else found
