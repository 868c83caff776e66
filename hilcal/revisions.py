"""Fits as revisions of a campaign file: what is stored, and how the fit comes back."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from hilcal import __version__
from hilcal.cell import Cell
from hilcal.data.readings import Readings
from hilcal.data.records import content_hash
from hilcal.data.revision import RevisionRecord
from hilcal.data.whitening import MODES, SCALINGS, Mode, Scaling
from hilcal.diagnose import diagnosis_document
from hilcal.diagnose.verdict import Diagnosis
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError
from hilcal.identify import fit_document
from hilcal.identify.fit import Fit, fit
from hilcal.model import Model
from hilcal.types import Floats


def to_record(
    found: Fit,
    diagnosis: Diagnosis | None,
    added: str | None,
    data_hash: str,
    removed: str | None = None,
) -> RevisionRecord:
    """Store a fit: enough to find it again, and what was reported of it.

    Args:
        found: the fit.
        diagnosis: of it, where it was diagnosed.
        added: the effect that made it from the revision before; without any change a new chain
            starts.
        data_hash: `content_hash` of its readings.
        removed: the effect that was taken out of the revision before.
    """
    effects, cell = found.model.effects, found.model.cell
    result: dict[str, object] = {"identify": fit_document.to_json(found)}
    if diagnosis is not None:
        result["diagnose"] = fit_document.plain(diagnosis_document.to_json(diagnosis))
    return RevisionRecord(
        effects=found.model.names,
        added=added,
        removed=removed,
        options={
            "readings": found.mode,
            "scaling": found.scaling,
            "effects": {e.name: dict(e.options) for e in effects},
        },
        data_hash=data_hash,
        program_version=__version__,
        parameters_json={
            "names": [f"{e.name}.{p.name}" for e in effects for p in e.parameters],
            "theta": found.theta.tolist(),
            "std": [fit_document.finite(s) for s in found.uncertainty.std],
            "prior": [fit_document.finite(s) for s in found.solution.prior],
            "registration": cell.registration.tolist(),
            "target": cell.target.tolist(),
            "outliers": np.flatnonzero(found.outlier).tolist(),
        },
        result_json=result,
    )


def restore(
    record: RevisionRecord, cell: Cell, readings: Readings, catalogue: Catalogue | None = None
) -> Fit:
    """Find a stored fit again: the same model from the stored parameters, quickly.

    Raises:
        InputError: readings were appended since, or the record is of another model.
    """
    if record.data_hash != content_hash(readings):
        raise InputError(
            f"revision {record.number} was fitted before readings were appended; "
            "run hilcal identify again"
        )
    model, theta = restore_model(record, cell, readings, catalogue)
    prior = np.array(
        [np.inf if s is None else float(s) for s in record.parameters_json["prior"]], dtype=float
    )
    return fit(model, readings, mode_of(record), scaling_of(record), theta, prior)


def restore_model(
    record: RevisionRecord, cell: Cell, readings: Readings, catalogue: Catalogue | None = None
) -> tuple[Model, Floats]:
    """Model and parameters (P,) of a revision, in the cell as it was registered then.

    Args:
        record: the revision.
        cell: the cell of the campaign's configuration.
        readings: the readings that it was fitted to.
        catalogue: has its effects; the installed ones unless given.

    Raises:
        InputError: the parameters are not those of the model.
    """
    stored: Mapping[str, Any] = record.parameters_json
    cell = replace(
        cell, registration=np.array(stored["registration"]), target=np.array(stored["target"])
    )
    options, known = record.options["effects"], catalogue or installed()
    effects = (known.make(e, cell, readings.states, options.get(e)) for e in record.effects)
    model = Model(cell, tuple(effects), known, readings)
    names = [f"{e.name}.{p.name}" for e in model.effects for p in e.parameters]
    if names != stored["names"]:
        raise InputError(
            f"revision {record.number} was made by hilcal {record.program_version}, whose effects "
            "have other parameters; run hilcal identify again"
        )
    return model, np.array(stored["theta"], dtype=float)


def mode_of(record: RevisionRecord) -> Mode:
    """Kind of readings of a revision."""
    return MODES[MODES.index(record.options["readings"])]


def scaling_of(record: RevisionRecord) -> Scaling:
    """Scaling of a revision."""
    return SCALINGS[SCALINGS.index(record.options["scaling"])]


def chain(records: tuple[RevisionRecord, ...]) -> tuple[RevisionRecord, ...]:
    """Return the latest revision and those that it was made from, oldest first."""
    first = len(records) - 1
    while first > 0 and records[first].follows:
        first -= 1
    return records[max(first, 0) :]


def usual_mode(readings: Readings) -> Mode:
    """Deflections where every loaded reading has an unloaded one in its pose and cycle."""
    unloaded = readings.unloaded
    if unloaded.all():
        return "absolute"
    key = np.stack([readings.pose, readings.cycle], axis=1)
    _, group = np.unique(key, axis=0, return_inverse=True)
    group = group.reshape(-1)
    has = np.zeros(int(group.max()) + 1, dtype=bool)
    has[group[unloaded]] = True
    return "deflection" if has[group[~unloaded]].all() else "absolute"
