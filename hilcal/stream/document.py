"""The JSON of a fit to a stream: the keys of `identify`, as far as they have a meaning."""

from hilcal.identification.fit_document import finite
from hilcal.stream.fit import StreamFit


def to_json(fit: StreamFit) -> dict[str, object]:
    """Keys of the contract, and what a stream has beside them.

    `error.holdout`: each tenth of the stream, predicted without it.
    """
    low, high = fit.variance_factor_interval
    return {
        "model": list(fit.model.names),
        "readings": "absolute",
        "scaling": "gc",
        "n_readings": fit.readings,
        "dof": fit.dof,
        "rank": fit.rank,
        "converged": fit.converged,
        "passes": fit.passes,
        "condition": {"unscaled": finite(fit.condition[0]), "scaled": finite(fit.condition[1])},
        "parameters": fit.parameters.to_dicts(),
        "unidentifiable": list(fit.null),
        "inflated": fit.inflated,
        "variance_factor": fit.variance_factor,
        "variance_factor_interval": [low, high],
        "error": {"fit": fit.error.to_json(), "holdout": fit.holdout.to_json()},
        "noise_floor_m": fit.noise_floor,
        "n_outliers": fit.outliers,
        "outliers": [{"row": row, "sigma": sigma} for row, sigma in fit.named],
    }
