"""Fits as revisions of a campaign file: storing and restoring."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import __version__
from hilcal.cell import Cell
from hilcal.diagnosis.diagnosis import History
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError
from hilcal.identification import fit_document
from hilcal.identification.carried.carried_prior import CarriedPrior
from hilcal.identification.fit import Fit, fit
from hilcal.identification.noise.arm_scatter import with_arm_scatter
from hilcal.identification.prediction.predictive import Predictive, predictive
from hilcal.model.model import Model
from hilcal.names import quoted
from hilcal.readings.readings import ArmScatter, Readings, SerialNoise
from hilcal.readings.whitening import MODES, SCALINGS, Mode, Scaling
from hilcal.store.codec import LARGEST, frames, numbers
from hilcal.store.revision import CARRIED, STORED_HASH, RevisionRecord, to_text
from hilcal.store.rows import content_hash
from hilcal.store.stored_texts import COMMAND
from hilcal.types import Floats

_WIDEST = 1e100
"""Largest standard deviation of a prior: its square times whitened rows does not overflow."""
SERIAL = "serial_noise"
"""Key in the parameters of a revision: serial correlation of its noise."""
RANDOM = "random"
"""Key in the parameters of a revision: its random effects; those that are not among the effects of
the revision are its background."""
SOURCES = "effects_from"
"""Key in the options of a revision: the files that define its effects."""


def to_record(
    fitted: Fit,
    diagnosis: Mapping[str, object] | None,
    added: str | None,
    data_hash: str,
    removed: str | None = None,
    parent: int | None = None,
) -> RevisionRecord:
    """Return the record of a fit: what restores it, and its reported results.

    Without an effect `added` or `removed` a new chain starts. `parent` is the number of the
    revision that it was made from, where that is not the previous one.
    """
    model, cell, readings = fitted.model, fitted.model.cell, fitted.readings
    options: dict[str, Any] = {
        "readings": fitted.mode,
        "scaling": fitted.scaling,
        "effects": {e.name: dict(e.options) for e in model.effects},
    }
    files = {name: model.catalogue.file_of(name) for name in model.names}
    if sources := {n: {"file": f.path, "sha256": f.sha256} for n, f in files.items() if f}:
        options[SOURCES] = sources
    std = {name: values.tolist() for name, values in model.random.items()}
    optional = {
        "targets": None if cell.targets is None else cell.targets.tolist(),
        "observers": [{"frame": o.frame.tolist(), "offset_m": o.offset} for o in cell.observers],
        "arm_scatter": readings.arm_scatter and readings.arm_scatter.to_json(),
        SERIAL: readings.serial and readings.serial.to_json(),
        CARRIED: model.prior and model.prior.to_json(),
        RANDOM: {"effects": list(model.names), "std": std} if std else None,
    }
    result: dict[str, object] = {"identify": fit_document.to_json(fitted)}
    if diagnosis is not None:
        result["diagnose"] = fit_document.with_nulls(diagnosis)
    return RevisionRecord(
        effects=model.named,
        added=added,
        removed=removed,
        parent=parent,
        options=options,
        data_hash=data_hash,
        program_version=__version__,
        parameters_json={
            "names": _names(model),
            "theta": fitted.theta.tolist(),
            "std": [fit_document.finite_or_null(s) for s in fitted.uncertainty.std],
            "prior": [fit_document.finite_or_null(s) for s in fitted.solution.prior],
            "registration": cell.registration.tolist(),
            "target": cell.target.tolist(),
            "outliers": np.flatnonzero(fitted.outlier).tolist(),
            **{key: value for key, value in optional.items() if value},
        },
        result_json=result,
    )


def _names(model: Model) -> list[str]:
    return [f"{e.name}.{p.name}" for e in model.effects for p in e.parameters]


def equal_but_for_origin(new: RevisionRecord, stored: RevisionRecord) -> bool:
    """Whether a stored revision equals a new one but for time, command and parent."""

    def plain(r: RevisionRecord) -> Any:
        result = {key: r.result_json.get(key) for key in new.result_json}
        options = {key: value for key, value in r.options.items() if key != COMMAND}
        alike = replace(r, options=options, result_json=result, created="", parent=None)
        return json.loads(to_text(alike))

    return bool(plain(new) == plain(stored))


def restore(
    record: RevisionRecord,
    cell: Cell,
    readings: Readings,
    catalogue: Catalogue | None = None,
    stored_hash: str | None = None,
) -> Fit:
    """Restore a fit: fit its model again, from the stored parameters as start.

    `stored_hash` is the hash of the readings as the file stores them, where there is a file.
    """
    if not _fitted_to(record, readings, stored_hash):
        raise InputError(
            f"revision {record.number} was fitted before readings were appended; "
            "run hilcal identify again"
        )
    model, theta = restore_model(record, cell, readings, catalogue)
    with damage_refused(record):
        prior, mode = _prior(record), mode_of(record)
        scaling: Scaling = SCALINGS[SCALINGS.index(record.options["scaling"])]
        readings = _as_fitted(record, model.cell, readings)
        outlier = np.isin(np.arange(len(readings)), record.parameters_json["outliers"])
    # Only the mixed model with re-estimated variances tells the gross errors beside a background.
    return fit(model, readings, mode, scaling, theta, prior, outlier if model.background else None)


def _fitted_to(record: RevisionRecord, readings: Readings, stored: str | None) -> bool:
    """Whether a revision was fitted to these readings.

    Records older than the key `STORED_HASH` only have the hash of computed covariances, whose last
    bits depend on the machine; on other machines the number of readings must suffice. Stored
    readings are never changed, only appended, and each has a checksum.
    """
    reported = record.result_json.get("identify")
    count = reported.get("n_readings") if isinstance(reported, Mapping) else None
    if count is not None and count != len(readings):
        return False
    if stored is not None and stored == record.options.get(STORED_HASH):
        return True
    matches = record.data_hash == content_hash(readings)
    return matches or (STORED_HASH not in record.options and count is not None)


@contextmanager
def damage_refused(record: RevisionRecord) -> Iterator[None]:
    """Raise an InputError where the block fails since the entries of a revision are damaged."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        text = " ".join(str(error).split())[:80]
        raise InputError(f"revision {record.number} is damaged ({text})") from error


def _prior(record: RevisionRecord) -> Floats:
    """Return the standard deviations (P,) of the priors of a stored fit; infinite without prior."""
    stored = record.parameters_json["prior"]
    prior = np.array([np.inf if s is None else float(s) for s in stored], dtype=float)
    possible = (prior >= 0.0) & ((prior <= _WIDEST) | np.isinf(prior))
    if len(prior) != len(record.parameters_json["theta"]) or not np.all(possible):
        raise ValueError("priors that are no standard deviations of its parameters")
    return prior


def restore_model(
    record: RevisionRecord, cell: Cell, readings: Readings, catalogue: Catalogue | None = None
) -> tuple[Model, Floats]:
    """Return model and parameters (P,) of a revision, in the cell as registered by its fit."""
    catalogue = catalogue or installed()
    stored: Mapping[str, Any] = record.parameters_json
    with damage_refused(record):
        cell = _registered(record, cell, readings)
        options, random_effects = record.options["effects"], stored.get(RANDOM)
        names = tuple(random_effects["effects"] if random_effects else record.effects)
        effects = tuple(catalogue.make(e, cell, readings.states, options.get(e)) for e in names)
        size = {e.name: len(e.magnitudes) for e in effects}
        std = random_effects["std"] if random_effects else {}
        random = {name: np.array(values, dtype=float) for name, values in std.items()}
        for name, values in random.items():
            if values.shape != (size.get(name),) or not np.all((values > 0) & (values < LARGEST)):
                raise ValueError(
                    "standard deviations of random effects that are not positive numbers"
                )
        background = frozenset(names) - frozenset(record.effects)
        if not background <= random.keys() or not set(record.effects) <= set(names):
            raise ValueError("a background that is not random")
        model = Model(cell, effects, catalogue, readings, carried_of(record), random, background)
        if _names(model) != stored["names"]:
            raise InputError(
                f"revision {record.number} was made by hilcal {record.program_version}, whose "
                "effects have other parameters; run hilcal identify again"
            )
        return model, numbers("theta", stored["theta"], (model.size,))


def _registered(record: RevisionRecord, cell: Cell, readings: Readings) -> Cell:
    """Return the cell with the frames of a fit; a damaged record may raise any exception."""
    stored: Mapping[str, Any] = record.parameters_json
    targets = frames("targets", stored.get("targets", [stored["target"]]), several=True)
    registration = frames("registration", stored["registration"])
    if len(targets) != len(cell.known_targets):
        raise InputError(
            f"revision {record.number} is of {len(targets)} targets, the cell has "
            f"{len(cell.known_targets)}; run hilcal identify again"
        )
    cell = replace(cell.with_targets(targets), registration=registration)
    cell = cell.observed_by(readings.observers)
    if not cell.observers:
        return cell
    observed = stored["observers"]
    places = frames("observers", [o["frame"] for o in observed], several=True)
    trios = zip(cell.observers, places, observed, strict=True)
    placed = (replace(o, frame=f, offset=float(s["offset_m"])) for o, f, s in trios)
    return replace(cell, observers=tuple(placed))


def carried_of(record: RevisionRecord) -> CarriedPrior | None:
    """Return the prior of another campaign in a revision's fit; None without one."""
    carried = record.parameters_json.get(CARRIED)
    return None if carried is None else CarriedPrior.from_json(carried)


def restore_predictive(
    record: RevisionRecord, model: Model, theta: Floats, readings: Readings
) -> Predictive:
    """Return the predictive distribution of a stored fit with parameters (P,)."""
    stored: Mapping[str, Any] = record.parameters_json
    with damage_refused(record):
        prior, mode = _prior(record), mode_of(record)
        readings = _as_fitted(record, model.cell, readings)
        used = np.delete(np.arange(len(readings)), np.array(stored["outliers"], dtype=int))
        sigma = float(record.result_json["identify"]["error"]["holdout"]["rms_sigma"])
    return predictive(model, theta, prior, readings[used], mode, sigma)


def _as_fitted(record: RevisionRecord, cell: Cell, readings: Readings) -> Readings:
    """Return the readings with the noise that the fit of a revision estimated."""
    scatter = record.parameters_json.get("arm_scatter")
    if scatter is not None:
        readings = with_arm_scatter(cell, readings, ArmScatter.from_json(scatter))
    serial = record.parameters_json.get(SERIAL)
    return readings if serial is None else readings.with_serial(SerialNoise.from_json(serial))


def has_background(record: RevisionRecord) -> bool:
    """Whether the model of a revision has a background of effects that are not named."""
    return not set(_predicting(record)) <= set(record.effects)


def _predicting(record: RevisionRecord) -> Sequence[str]:
    """Return the names of all effects of a revision, with those of its background."""
    names: Sequence[str] = record.parameters_json.get(RANDOM, {}).get("effects", record.effects)
    return names


def mode_of(record: RevisionRecord) -> Mode:
    """Return the kind of readings of a revision."""
    return MODES[MODES.index(record.options["readings"])]


def chain(
    records: tuple[RevisionRecord, ...], last: int | None = None
) -> tuple[RevisionRecord, ...]:
    """Return a revision (None: the latest) and its ancestors, oldest first."""
    by_number = {r.number: r for r in records}
    linked: list[RevisionRecord] = []
    number = max(by_number, default=None) if last is None else last
    while number in by_number:
        linked.append(by_number[number])
        number = by_number[number].made_from
    return tuple(reversed(linked))


def chain_in_cell(records: tuple[RevisionRecord, ...], last: int) -> tuple[RevisionRecord, ...]:
    """Return the revisions of a chain that were fitted in the cell of its last one."""
    linked = chain(records, last)
    return tuple(r for r in linked if r.cell == linked[-1].cell)


def history(records: tuple[RevisionRecord, ...]) -> History:
    """Return the history of the model of the last revision of a `chain`."""
    if not records:
        return History()
    last = records[-1]
    added = {r.added for r in records}
    stored: Mapping[str, Any] = last.result_json.get("diagnose", {})
    return History(
        added=tuple(name for name in last.effects if name in added),
        removed=tuple(r.removed for r in records if r.removed is not None),
        rejected=tuple(stored.get("rejected", ())),
    )


def check_sources(record: RevisionRecord, run: Path, catalogue: Catalogue) -> None:
    """Refuse a revision whose effects are missing or have changed since it was fitted."""
    stored = record.options.get(SOURCES, {})
    for name in _predicting(record):
        source, file = stored.get(name), catalogue.file_of(name)
        if name not in catalogue.names:
            hint, note = "FILE.py", ""
            if isinstance(source, dict) and {"file", "sha256"} <= set(source):
                hint = str(source["file"])
                note = (
                    f" (SHA-256 {str(source['sha256'])[:16]}…; it is a program, and is run: read "
                    "it first where somebody sent it)"
                )
            raise InputError(
                f"{run}: revision {record.number} has the effect {name}, which is not in the "
                f"catalogue{note}; give the file that defines it: --effects-from {quoted(hint)}"
            )
        if source and file and source["sha256"] != file.sha256:
            raise InputError(
                f"{run}: revision {record.number} was fitted with another {name}: {file.path} has "
                "changed since then; fit again: hilcal identify or refine"
            )
