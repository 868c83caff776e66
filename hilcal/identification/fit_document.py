"""The JSON of a fit."""

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from hilcal.identification.background import background_of
from hilcal.identification.baseline import loads_note
from hilcal.identification.fit import Fit
from hilcal.identification.prediction.full_prediction import (
    disagreement_words,
    full_prediction,
    gross_errors,
    nominal_error,
)
from hilcal.identification.registration.registration import register


def to_json(fit: Fit) -> dict[str, object]:
    """Return the keys of the contract, and more of a fit that scripts may need.

    `value` and `std` are null where the data do not determine a parameter, conditions where
    there is nothing to condition.
    """
    basis, scatter = fit.solution.equations.basis, fit.readings.arm_scatter
    serial = fit.readings.serial
    return {
        "model": list(fit.model.named),
        "readings": fit.mode,
        "scaling": fit.scaling,
        "n_readings": len(fit.readings),
        "n_measurements": len(fit.raw),
        "dof": fit.dof,
        "rank": fit.rank,
        "converged": fit.solution.converged,
        "iterations": fit.solution.iterations,
        "condition": {
            "unscaled": finite_or_null(basis.condition_unscaled),
            "scaled": finite_or_null(basis.condition_scaled),
        },
        "parameters": fit.parameters.to_dicts(),
        "background": background_of(fit).to_json(),
        "unidentifiable": list(fit.uncertainty.null),
        "inflated": fit.uncertainty.inflated,
        "variance_factor": fit.variance_factor,
        "variance_factor_interval": list(fit.variance_factor_interval),
        "error": {
            "before": nominal_error(fit).to_json(),
            "fit": fit.error.to_json(),
            "holdout": fit.holdout.to_json(),
        },
        "noise_floor_m": full_prediction(fit).noise_floor,
        "outliers": outliers(fit),
        "arm_scatter": scatter and scatter.to_json(),
        "serial_noise": serial and serial.to_json(),
        "registration": fit.frames.base.tolist(),
        "frames": frames_to_json(fit),
        "notes": list(notes(fit)),
        **prior_to_json(fit),
    }


def frames_to_json(fit: Fit) -> dict[str, object]:
    """Frames as fitted; residual and undetermined directions of the nominal arm's registration."""
    frames, registered = fit.frames, register(fit.model.cell, fit.readings)
    return {**registered.to_json(frames.base, frames.targets), "base_is": frames.base_is}


def prior_to_json(fit: Fit) -> dict[str, object]:
    """Key `prior`: its source, and how far each part of it and the readings disagree.

    `drift` is a standard deviation in ordinary magnitudes, in shrunk families in their strengths.
    """
    prior, numbers = fit.model.prior, ("moved_sigma", "p_value", "drift")
    if prior is None:
        return {}
    conflicts = [
        {**asdict(c.group), "joint": c.group.joint, **{k: getattr(c, k) for k in numbers}}
        for c in fit.conflicts
    ]
    source = asdict(prior.posterior.source)
    return {"prior": {"source": source, "relation": prior.relation, "effects": conflicts}}


def outliers(fit: Fit) -> list[dict[str, object]]:
    """Readings that were set aside, with their Mahalanobis distance and likely cause."""
    return [{k: v for k, v in asdict(g).items() if k != "row"} for g in gross_errors(fit)]


def notes(fit: Fit) -> tuple[str, ...]:
    """What a reader of the numbers has to know, one sentence per note."""
    out = []
    if not fit.solution.converged:
        out.append(
            f"not converged after {fit.solution.iterations} steps: do not trust the parameters"
        )
    if fit.uncertainty.inflated:
        out.append(
            "the residuals are larger than the noise, so the errors are not independent: the "
            "standard uncertainties were widened to what leaving out groups of poses shows"
        )
    registered = [e.name for e in fit.model.effects if e.role == "registration"]
    if fit.mode == "deflection" and registered:
        out.append(
            f"deflections do not see where the base is, only how it is turned: {registered[0]} "
            "is determined by the closed-form registration and by how deflections turn"
        )
    if fit.disagreement is not None:
        out.append(disagreement_words(fit))
    loads = loads_note(fit)
    if loads is not None:
        out.append(loads)
    return tuple(out)


def finite_or_null(value: float) -> float | None:
    """Return a JSON number, null where there is none."""
    return float(value) if np.isfinite(value) else None


def with_nulls(content: object) -> object:
    """Return JSON content in which every number that is not finite is null."""
    if isinstance(content, float | np.floating):
        return finite_or_null(float(content))
    if isinstance(content, Mapping):
        return {str(k): with_nulls(v) for k, v in content.items()}
    if isinstance(content, list | tuple):
        return [with_nulls(v) for v in content]
    return content
