"""The whitened Jacobian of wide effects, by its factors.

All parameters of an effect that displaces joints, as the harmonics of a transmission error, move a
reading as their joint does: ∂y_d/∂θ_p = W_d (∂y_d/∂q_j(p)) (∂q_j/∂θ_p), with W_d the whitening of
reading d. Where no other reading shares its noise, that is a `Factored` matrix.
"""

from collections.abc import Callable

import numpy as np

from hilcal.effects.protocol import Columns, Effect, Situation
from hilcal.model.model import Model, Prediction
from hilcal.readings.whitening import Whitening
from hilcal.regression.factored import Factored, Tall
from hilcal.robot.batch import chunks
from hilcal.types import Floats, Ints

WIDE = 64
"""Columns of an effect from which on they are kept by their factors; a choice."""
PER_COLUMN = 2
"""Numbers that an effect computes for each parameter and state; for the size of a chunk."""


def whitened_columns(
    model: Model, prediction: Prediction, theta: Floats, w: Whitening, live: Ints
) -> Tall:
    """Whitened derivative (R, L) of the measurements by the live parameters.

    By its factors where that pays; else, and where readings share their noise, as an array.

    Args:
        model: robot and effects.
        prediction: of the readings at θ.
        theta: (P,) θ.
        w: the scaling.
        live: (L,) ascending list of parameters.
    """
    return _columns(model, prediction, theta, w, live, w.whiten_readings)


def measured_columns(
    model: Model, prediction: Prediction, theta: Floats, w: Whitening, live: Ints
) -> Tall:
    """Return `whitened_columns` (R, L) before they are whitened."""

    def rows(x: Floats) -> Floats:
        return w.raw(x).reshape(w.m * len(w), -1)

    return _columns(model, prediction, theta, w, live, rows)


def _columns(
    model: Model,
    prediction: Prediction,
    theta: Floats,
    w: Whitening,
    live: Ints,
    rows_of: Callable[[Floats], Floats],
) -> Tall:
    """Columns (R, L); `rows_of` returns rows (R, P) of values at the readings (N, m, P)."""
    effects = _wide(model, prediction[:1].situation, theta, live) if w.by_reading else []
    if not effects:
        return rows_of(model.jacobian(prediction, theta, w.m, live))
    wide = np.zeros(model.size, dtype=np.bool_)
    for _, mine in effects:
        wide[mine] = True
    at, along = np.flatnonzero(~wide[live]), np.flatnonzero(wide[live])
    coefficient = np.empty((len(w), len(along)))
    site: list[Ints] = []
    start = 0
    for effect, mine in effects:
        within = live[(live >= mine.start) & (live < mine.stop)] - mine.start
        stop = start + len(within)
        site.append(_write(coefficient[:, start:stop], effect, within, prediction))
        start = stop
    drives = np.empty((len(w), w.m, model.cell.arm.n))
    own = rows_of(model.jacobian(prediction, theta, w.m, live[at], drives))
    direction = rows_of(drives).reshape(drives.shape)
    return Factored(own, at, direction, coefficient, np.concatenate(site), along)


def _wide(model: Model, one: Situation, theta: Floats, live: Ints) -> list[tuple[Effect, slice]]:
    """Effects with many live parameters that each displace one joint alone, and their places."""
    found = []
    for effect, mine in zip(model.effects, model.slices(), strict=True):
        count = np.count_nonzero((live >= mine.start) & (live < mine.stop))
        if count < WIDE or effect.compliance(theta[mine]) is not None:
            continue
        loads = effect.wrench_columns(theta[mine], one) is not None
        if not loads and of_joints(effect.columns(one)) is not None:
            found.append((effect, mine))
    return found


def of_joints(columns: tuple[Columns, ...]) -> Columns | None:
    """The columns where each parameter displaces one joint; else None."""
    if len(columns) != 1 or columns[0].field != "dq":
        return None
    return columns[0] if len(np.unique(columns[0].parameter)) == len(columns[0].parameter) else None


def _write(out: Floats, effect: Effect, within: Ints, prediction: Prediction) -> Ints:
    """Write the displacements (N, C) by the parameters `within` an effect; returns their joints."""
    joint = np.zeros(0, dtype=np.int64)
    # Naming a thousand parameters takes long.
    for rows in chunks(len(out), PER_COLUMN * len(effect.magnitudes)):
        (c,) = effect.checked_columns(prediction[rows].situation)
        place = np.full(int(c.parameter.max()) + 1, -1)
        place[c.parameter] = np.arange(len(c.parameter))
        chosen = place[within]
        np.take(c.values, chosen, axis=1, out=out[rows])
        joint = c.element[chosen]
    return joint
