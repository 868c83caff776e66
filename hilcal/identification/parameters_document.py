"""The parameters of a fit with their covariance as one JSON document, and back."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import __version__, limits
from hilcal.identification.fit import Fit
from hilcal.identification.fit_document import finite_or_null
from hilcal.store.codec import encode, pack, read_document, read_file, unpack
from hilcal.types import Bools, Floats

FORMAT, VERSION = "hilcal-parameters", 1
MOST_LISTED = 200
"""Parameters up to which the covariance is written as numbers, half a megabyte; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Parameters:
    """The parameters of a fit, as the document holds them."""

    names: tuple[str, ...]  # (P,) "effect.parameter"
    units: tuple[str, ...]  # (P,) SI
    value: Floats  # (P,) as fitted, the undetermined ones as they are in the model
    std: Floats  # (P,) standard uncertainties, infinite for undetermined ones
    identifiable: Bools  # (P,) whether the readings determine it
    covariance: Floats  # (P, P), NaN in rows and columns of undetermined ones
    about: Mapping[str, Any]  # the rest of the document


def covariance_of(fit: Fit) -> Floats:
    """(P, P) covariance of the parameters, NaN where the readings do not determine one.

    C_ij = u_i ρ_ij u_j with u the standard uncertainties as stated (`Uncertainty.std`: widened
    under a misfit, and by the uncertainty of prior variances), and ρ the correlation of the
    posterior under the stated noise.
    """
    solution, u = fit.solution, fit.uncertainty
    transform, space = solution.transform, solution.space
    formal = transform @ solution.equations.inverse(solution.beta) @ transform.T
    formal[space.index, space.index] += space.omitted_variance / solution.beta
    size = np.sqrt(np.maximum(np.diag(formal), 1e-300))
    std = np.where(np.isfinite(u.std) & u.identifiable, u.std, np.nan)
    covariance = std[:, None] * (formal / np.outer(size, size)) * std
    covariance = (covariance + covariance.T) / 2
    np.fill_diagonal(covariance, std**2)
    return np.asarray(covariance)


def to_json(fit: Fit, source: Mapping[str, object]) -> dict[str, object]:
    """Return the document, SI."""
    u, model = fit.uncertainty, fit.model
    every = [(e, p) for e in model.effects for p in e.parameters]
    used = np.flatnonzero(u.identifiable & np.isfinite(u.std))
    covariance = covariance_of(fit)[np.ix_(used, used)]
    rows = [
        {
            "name": f"{e.name}.{p.name}",
            "value": float(fit.theta[k]),
            "std": finite_or_null(u.std[k]) if u.identifiable[k] else None,
            "unit": p.unit,
            "identifiable": bool(u.identifiable[k]),
            "prior_std": finite_or_null(fit.solution.prior[k]),
        }
        for k, (e, p) in enumerate(every)
    ]
    return {
        "format": FORMAT,
        "version": VERSION,
        "hilcal": __version__,
        "source": dict(source),
        "robot": model.cell.arm.name,
        "readings": fit.mode,
        "scaling": fit.scaling,
        "variance_factor": fit.variance_factor,
        "effects": [
            {"name": e.name, "options": encode(dict(e.options)), "role": e.role}
            for e in model.effects
        ],
        "parameters": rows,
        "unidentifiable": list(u.null),
        "covariance_of": [str(rows[k]["name"]) for k in used],
        "covariance": _packed(covariance),
    }


def from_json(content: Mapping[str, Any]) -> Parameters:
    """Return what `to_json` wrote, every bit of it."""
    return read_document(content, "parameters", FORMAT, (VERSION,), _read)


def read(path: str | Path) -> Parameters:
    """Read the document from a file."""
    return read_file(Path(path), "parameters", from_json)


def _read(content: Mapping[str, Any]) -> Parameters:
    rows, stored = content["parameters"], content["covariance"]["lower_triangle"]
    limits.check_parameters(len(rows))
    names = tuple(row["name"] for row in rows)
    determined = [names.index(name) for name in content["covariance_of"]]
    block = np.zeros((len(determined), len(determined)))
    i, j = np.tril_indices(len(determined))
    values = unpack(stored) if isinstance(stored, str) else np.array(stored, dtype=float)
    block[i, j] = block[j, i] = values
    covariance = np.full((len(rows), len(rows)), np.nan)
    covariance[np.ix_(determined, determined)] = block
    return Parameters(
        names=names,
        units=tuple(row["unit"] for row in rows),
        value=np.array([row["value"] for row in rows], dtype=float),
        std=np.array([np.inf if row["std"] is None else row["std"] for row in rows], dtype=float),
        identifiable=np.array([row["identifiable"] for row in rows], dtype=np.bool_),
        covariance=covariance,
        about={k: v for k, v in content.items() if k not in ("parameters", "covariance")},
    )


def _packed(covariance: Floats) -> dict[str, object]:
    """Lower triangle, row by row: as numbers, or base64 of little-endian doubles where many."""
    values = covariance[np.tril_indices(len(covariance))]
    if len(covariance) <= MOST_LISTED:
        return {"encoding": "numbers", "lower_triangle": values.tolist()}
    return {"encoding": "base64 of little-endian doubles", "lower_triangle": pack(values)}
