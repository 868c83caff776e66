"""One campaign of a fleet: whose arm it is of, when it was measured, what it taught."""

import csv
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilcal import limits
from hilcal.campaign.campaign import Campaign
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.failure import failure_of
from hilcal.errors import HilcalError, InputError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.identification.posterior import Posterior, Source
from hilcal.identification.predictive import of_arm
from hilcal.model.model import Model
from hilcal.names import check_names
from hilcal.readings.same_readings import prints
from hilcal.refinement import refine
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.overview import overview
from hilcal.store.purpose import refuse_fitting
from hilcal.store.revision import seconds_of
from hilcal.transfer.type_sizes import SizeEvidence, size_evidence
from hilcal.types import Floats

LIST = "arms.csv"
"""File beside the campaigns that says which arm each is of, and when it was measured."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A campaign file, and what the list beside it says.

    Attributes:
        name: its path within the directory.
        arm: which arm; empty where that is not stated.
        date: when it was measured, ISO 8601; empty where that is not stated.
    """

    path: Path
    name: str
    arm: str = ""
    date: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """What a campaign taught.

    Attributes:
        name: its path within the directory.
        known: how that is known: "list", "serial number", "folder" or "file".
        type: name of the arm's type.
        date: when it was measured, ISO 8601.
        posterior: of the arm's parameters.
        added: effects of the arm that the diagnosis added to the baseline.
        rms_m: 3-D position error on poses left out.
        sizes: what it tells of the sizes of effects; None where nothing.
    """

    name: str
    arm: str
    known: str
    type: str
    date: str
    posterior: Posterior
    added: tuple[str, ...]
    verdict: str
    rms_m: float
    sizes: SizeEvidence | None = None


@dataclass(frozen=True, slots=True)
class Failure:
    """A campaign that could not be used.

    Attributes:
        name: its path within the directory.
        reason: why, in a line.
    """

    name: str
    reason: str


def entries(directory: Path) -> tuple[Entry, ...]:
    """Return the campaigns in a directory and below it, by name.

    Raises:
        InputError: no directory, no campaigns, or a list that cannot be read.
    """
    if not directory.is_dir():
        raise InputError(f"{directory}: no directory; valid: one with campaign files, *.hilcal")
    paths = sorted(directory.rglob("*.hilcal"))
    if not paths:
        raise InputError(f"{directory}: no campaign files (*.hilcal) in it or below it")
    listed = _listed(directory / LIST)
    names = {str(path.relative_to(directory)): path for path in paths}
    for name in listed:
        if name not in names:
            raise InputError(f"{directory / LIST}: {name}: no such campaign below {directory}")
    return tuple(Entry(p, name, *listed.get(name, ("", ""))) for name, p in names.items())


@limits.bounded
def _listed(path: Path) -> Mapping[str, tuple[str, str]]:
    """Arm and date by campaign."""
    if not path.exists():
        return {}
    found = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            lines = limits.Lines(str(path), stream)
            rows = csv.DictReader(lines, strict=True)
            if not {"campaign", "arm"} <= set(rows.fieldnames or ()):
                raise InputError(f"{path}: valid: columns campaign, arm and, where known, date")
            lines.row(len(rows.fieldnames or ()))
            for k, row in enumerate(rows, start=2):
                lines.row(len(row))
                check_names(dict(row), f"{path}: row {k}")
                date = (row.get("date") or "").strip()
                if date:
                    seconds_of(date, f"{path}: row {k}, column 'date'")
                found[row["campaign"]] = ((row["arm"] or "").strip(), date)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    return found


def prints_of(entry: Entry) -> Floats:
    """Return what the readings of a campaign are known by; none where it cannot be read."""
    try:
        with CampaignFile.open(entry.path, read_only=True, check_revisions=False) as file:
            return prints(file.readings())
    except HilcalError:
        return np.zeros((0, 0))


def member_of(entry: Entry) -> Member | Failure:
    """Fit and diagnose a campaign; its revision in use, where it has one. Nothing is stored."""
    return _guarded(entry, None)


def member_with(entry: Entry, effects: tuple[str, ...]) -> Member | Failure:
    """Fit a campaign with the effects that most arms of its type have, and those it has itself."""
    return _guarded(entry, effects)


def _guarded(entry: Entry, effects: tuple[str, ...] | None) -> Member | Failure:
    try:
        with Campaign.open(entry.path, read_only=True) as run:
            return _member(entry, run, effects)
    except HilcalError as error:
        return Failure(entry.name, str(error).removeprefix(f"{entry.path}: "))
    except Exception as error:  # one campaign must not end the others'
        told = failure_of(error)
        return Failure(entry.name, str(told or f"unexpected {type(error).__name__}: {error}"))


def _member(entry: Entry, run: Campaign, effects: tuple[str, ...] | None) -> Member:
    refuse_fitting(run.file)
    record, mode = run.in_use(), run.mode()
    start = baseline(run.cell, run.readings, mode, run.catalogue)
    verdict = ""
    if record is not None:
        found = run.restore(record)
        judged = record.result_json.get("diagnose")
        verdict = str(judged["verdict"]) if judged else diagnose(found).verdict
    else:
        path = refine(start, run.readings, mode)
        found, verdict = path.fit, path.verdict
    if effects is not None:
        names = dict.fromkeys((*(e.name for e in found.model.effects), *effects))
        options = {e.name: e.options for e in found.model.effects}
        model = with_effects(run.cell, found.readings, mode, names, options, run.catalogue)
        found = fit(model, found.readings, mode)
    return _of_fit(entry, run, found, start, verdict)


def _of_fit(entry: Entry, run: Campaign, found: Fit, start: Model, verdict: str) -> Member:
    of = overview(run.file)
    serial = next(
        (i.serial_number for i in of.instruments if i.device == "arm" and i.serial_number), None
    )
    arm, known = entry.arm, "list"
    if not arm and serial:
        arm, known = serial, "serial number"
    if not arm:
        folder = Path(entry.name).parent
        named = str(folder) != "."
        arm, known = (str(folder), "folder") if named else (Path(entry.name).stem, "file")
    posterior = Posterior.of(found, Source(entry.name, 0, of.created))
    return Member(
        name=entry.name,
        arm=arm,
        known=known,
        type=run.cell.arm.name,
        date=entry.date or of.created,
        posterior=replace(posterior, scatter=None),
        added=tuple(e.name for e in found.model.effects if of_arm(e) and e.name not in start.names),
        verdict=verdict,
        rms_m=found.holdout.rms_m,
        sizes=size_evidence(start, found),
    )
