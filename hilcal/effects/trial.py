"""A trial of an effect in example states: do the parts of the law fit together?"""

from dataclasses import replace
from typing import Any

import numpy as np

from hilcal.cell import Cell
from hilcal.data.readings import States
from hilcal.effects.example import example_cell, example_situation, example_states
from hilcal.effects.protocol import Effect, Situation
from hilcal.errors import InputError
from hilcal.robot.deviation import Deviation
from hilcal.robot.statics import slot_wrenches
from hilcal.types import Floats

COLUMNS = (
    "time",
    "load_time",
    "air_temperature",
    "joint_temperature",
    "approach",
    "q_actual",
)
"""Columns of `States` that readings may lack."""
AGREES = 1e-3
"""Part of the largest value by which a derivative may differ from the difference quotient."""
STEP = 1e-4
_FIELDS = Deviation.__slots__


def columns_of(needs: tuple[str, ...]) -> set[str]:
    """Return the columns that needs name, each alone or as one of several, "a or b"."""
    return {column for need in needs for column in need.split(" or ")}


def try_out(kind: type[Effect], joints: int, where: str) -> None:
    """Compute an effect on an arm of so many joints.

    Raises:
        InputError: something fails, or does not fit together; begins with `where`.
    """
    cell = example_cell(joints)
    states = example_states(cell)
    if not kind.computable(states):
        return
    effect = kind(cell, states)
    s = example_situation(cell, states)
    scale = np.array([p.scale for p in effect.parameters])
    theta = scale * np.random.default_rng(1).uniform(0.5, 1.5, len(scale))
    effect.groups(), effect.prior_std(), effect.compliance(theta)
    effect.for_scoring(states).columns(s)
    wrong = (
        _parts_problem(effect, theta, s, states)
        or _elastic_problem(effect, theta, s)
        or _load_problem(effect, theta, s)
        or _needs_problem(kind, cell, states)
    )
    if wrong:
        raise InputError(f"{where}: {wrong}")


def _parts_problem(effect: Effect, theta: Floats, s: Situation, states: States) -> str | None:
    """Say whether a deviation is other than columns times theta, state by state."""
    own, expected = effect.deviation(theta, s), Effect.deviation(effect, theta, s)
    if not all(_same(_field(own, key), _field(expected, key)) for key in _FIELDS):
        return (
            "deviation is not columns times parameters; leave it out, or make the law linear in "
            "them"
        )
    few = slice(0, len(states) // 3)
    alone = effect.deviation(theta, example_situation(s.cell, states[few]))
    if not all(_same(_field(alone, key), _field(own, key)[few]) for key in _FIELDS):
        return (
            "columns of a state depend on the other states; take what is of all of them, as a "
            "reference, in setup(self, states)"
        )
    return None


def _elastic_problem(effect: Effect, theta: Floats, s: Situation) -> str | None:
    """Say whether `elastic` and `response` fit to how the columns follow the wrenches."""
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
        off = _off(np.zeros(1) if given is None else given[:, 0], quotient)
        if off > AGREES:
            return (
                f"response is not the derivative of columns by the wrenches: {key} is off by "
                f"{100 * off:.1f} % of its largest value"
            )
    return None


def _load_problem(effect: Effect, theta: Floats, s: Situation) -> str | None:
    """Say whether `wrench_columns` fits to how the effect changes the load."""
    scale = np.array([p.scale for p in effect.parameters])
    step = STEP * scale * np.random.default_rng(3).normal(size=len(scale))
    up, down = (_transmitted(effect, t, s) for t in (theta + step, theta - step))
    found = effect.wrench_columns(theta, s)
    given = np.zeros(1) if found is None else np.einsum("npki,p->nki", found, step)
    off = _off(given, (up - down) / 2)
    if off > AGREES:
        return (
            "wrench_columns is not the derivative of the wrenches by the parameters: off by "
            f"{100 * off:.1f} % of its largest value"
        )
    return None


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


def _needs_problem(kind: type[Effect], cell: Cell, states: States) -> str | None:
    """Say whether an effect uses a column that it does not name."""
    for column in COLUMNS:
        nothing: dict[str, Any] = {column: None}
        fewer = replace(states, **nothing)
        if column in columns_of(kind.needs) or not kind.computable(fewer):
            continue
        try:
            kind(cell, fewer).columns(example_situation(cell, fewer))
        except InputError:
            return f'uses {column}; name it: needs = ("{column}",)'
    return None


def _field(deviation: Deviation, key: str) -> Floats:
    found: Floats | None = getattr(deviation, key)
    return np.zeros(1) if found is None else found


def _same(a: Floats, b: Floats) -> bool:
    """Whether two arrays agree but for rounding."""
    size = float(max(np.abs(a).max(), np.abs(b).max()))
    return bool(np.all(np.abs(a - b) <= 1e-9 * size))


def _off(found: Floats, expected: Floats) -> float:
    """Largest difference, as a part of the largest value."""
    size = float(max(np.abs(found).max(), np.abs(expected).max()))
    return float(np.abs(found - expected).max()) / size if size > 0 else 0.0
