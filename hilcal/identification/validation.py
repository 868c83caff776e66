"""Prediction of readings that a model was never fitted to."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES, Effect
from hilcal.effects.target_offset import TargetOffset
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.registration import register
from hilcal.identification.residual import ErrorBlock, error_block, noise_floor, residual
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, Whitening, whitening
from hilcal.types import Floats

STEPS = 10
"""Most Gauss-Newton steps of a registration; a choice, no study set it."""
CONVERGED = 1e-6
"""Step of a registration that ends it, in σ per whitened element; a choice, no study set it."""


@dataclass(frozen=True, slots=True, eq=False)
class Validation:
    """Prediction errors of readings that a model was not fitted to.

    Attributes:
        readings: the other readings.
        whitening: their gc-scaling.
        raw: (D, m) residual.
        error: error block.
        variance_factor: whitened sum of squares by its rank; nothing was fitted but, where
            asked for, the registration.
        registered: whether the registration was estimated anew.
    """

    readings: Readings
    whitening: Whitening
    raw: Floats
    error: ErrorBlock
    variance_factor: float
    registered: bool

    @property
    def noise_floor(self) -> float:
        """Root mean square of the 3-D position error under the stated noise alone, m."""
        return noise_floor(self.whitening.covariance)


def validate(
    model: Model,
    theta: Floats,
    fitted: Readings,
    other: Readings,
    mode: Mode,
    *,
    registered: bool = False,
) -> Validation:
    """Predict other readings with a fitted model.

    Args:
        model: the model.
        theta: (P,) its parameters.
        fitted: the readings that it was fitted to.
        other: readings that took no part.
        mode: "deflection" or "absolute".
        registered: estimate `base_frame`, and nothing else, from the other readings first:
            the tracker was set up anew.

    Raises:
        InputError: an effect of the model needs a column that the other readings lack.
        CannotAnswerError: the registration does not converge.
    """
    other = other.seen_by(fitted.observers)
    if registered and other.states.observer is not None:
        raise InputError(
            "several observers: where they stand is told by the readings that were fitted; valid: "
            "readings by them, without a registration anew, or by one tracker"
        )
    for effect in model.effects:
        if effect.role not in FRAME_ROLES and not effect.computable(other.states):
            raise InputError(
                f"effect {effect.name} needs {', '.join(effect.needs)}, which the other readings "
                "do not have"
            )
    w = whitening(other, mode, "gc")
    if registered:
        model, theta = _register(model, theta, fitted, other, w)
    raw = residual(other, model.predict(other.states, theta), w)
    white = w.whiten(raw).reshape(-1)
    free = 6 if registered else 0
    return Validation(
        readings=other,
        whitening=w,
        raw=raw,
        error=error_block(raw, w),
        variance_factor=float(white @ white) / max(w.rank - free, 1),
        registered=registered,
    )


def _register(
    model: Model, theta: Floats, fitted: Readings, other: Readings, w: Whitening
) -> tuple[Model, Floats]:
    """Closed-form registration to the other readings, then Gauss-Newton on `base_frame`."""
    parts = [(e, theta[s]) for e, s in zip(model.effects, model.slices(), strict=True)]
    targets = model.cell.all_targets
    for e, offset in parts:
        if isinstance(e, TargetOffset):
            targets = e.displaced(offset)
    held = model.cell.with_targets(targets, known=(True,) * len(targets))
    unknown = replace(held, registration_known=False)
    cell = replace(model.cell, registration=register(unknown, other).cell.registration)
    kept = [(e, t) for e, t in parts if e.role != "registration"]
    effects: list[Effect] = [type(e)(cell, fitted.states, e.options) for e, _ in kept]
    frame = model.catalogue.with_role("registration")[0](cell, fitted.states)
    moved = replace(model, cell=cell, effects=(*effects, frame))
    values = np.concatenate([*(t for _, t in kept), np.zeros(6)])
    for _ in range(STEPS):
        prediction = moved.predict(other.states, values)
        target_row = w.whiten(residual(other, prediction, w)).reshape(-1)
        columns = w.whiten(w.raw(moved.jacobian_of((frame,), prediction, values, w.m)))
        step = np.linalg.lstsq(columns.reshape(-1, 6), target_row, rcond=1e-9)[0]
        values[-6:] += step
        if float(np.linalg.norm(columns.reshape(-1, 6) @ step)) < CONVERGED * len(target_row):
            return moved, values
    raise CannotAnswerError(
        "registration: does not settle on these readings; measure poses spread in space"
    )
