"""One campaign of a fleet: whose arm it is of, when it was measured, what it taught.

How large the effects of a type of arm are, beside those of other arms: with x_i the log standard
deviations of the families of campaign i (`hilcal.mixed.families`),


    x_i = mean + B b + d_i,    d_i ~ N(0, Λ⁻¹),    b ~ N(0, ARM² + EFFECT² 1)

mean and Λ are those that hold for any arm, B tells the effect of each family, and b is what the
arms of the type have in common. The restricted likelihood of a campaign is taken as quadratic about
its estimate, with information I and, there, slope Λ (x_i − mean). Without d_i it says

    J = I − I (I + Λ)⁻¹ I,    j = h − I (I + Λ)⁻¹ h,    h = I x_i + Λ (x_i − mean)

    b = (Σ_i Bᵀ J B + (ARM² + EFFECT² 1)⁻¹)⁻¹ Σ_i Bᵀ (j − J mean)

The factors exp b belong into the section [ordinary] of the cell of another arm of the type.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilcal import limits
from hilcal.campaign.campaign import Campaign
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.from_file import failure_of
from hilcal.errors import CannotAnswerError, HilcalError, InputError
from hilcal.identification.background import MOST_ROWS
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.identification.mixed_fit import mixed_fit
from hilcal.identification.posterior import Posterior, Source
from hilcal.identification.predictive import of_arm
from hilcal.mixed.families import ARM, EFFECT
from hilcal.mixed.variances import Variances
from hilcal.model.model import Model
from hilcal.names import check_names
from hilcal.readings.same_readings import prints
from hilcal.refinement import refine
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.overview import overview
from hilcal.store.procedure_log import refuse_fitting
from hilcal.store.revision import seconds_of
from hilcal.types import Floats

WIDTH = 1.96
"""Standard deviations of b that a 95 % interval reaches on either side."""


@dataclass(frozen=True, slots=True, eq=False)
class SizeEvidence:
    """What a campaign tells of the sizes of E effects."""

    effects: tuple[str, ...]  # their names
    information: Floats  # (E, E) Bᵀ J B
    vector: Floats  # (E,) Bᵀ (j − J mean)


@dataclass(frozen=True, slots=True)
class TypeSize:
    """The size of an effect on arms of a type, divided by that on other arms."""

    effect: str  # its name
    factor: float  # the size
    low: float  # lower end of its 95 % interval
    high: float  # upper end

    @property
    def differs(self) -> bool:
        """Whether its 95 % interval excludes 1, the size on other arms."""
        return self.low > 1.0 or self.high < 1.0


def size_evidence(start: Model, found: Fit) -> SizeEvidence | None:
    """Return what the readings of a fit tell; None where they do not determine its frames."""
    kept = found.readings[~found.outlier].as_stated()
    poses = np.unique(kept.pose)
    most = max(2, int(len(poses) * MOST_ROWS / (len(kept) * kept.m)))
    some = poses[np.unique(np.linspace(0, len(poses) - 1, most).astype(np.int64))]
    try:
        variances = mixed_fit(start, kept[np.isin(kept.pose, some)], found.mode).variances
    except CannotAnswerError:
        return None
    config = start.cell.config
    return evidence_of(variances, {} if config is None else config.ordinary)


def evidence_of(of: Variances, ordinary: dict[str, float]) -> SizeEvidence:
    """Return what estimated variances tell."""
    problem, x = of.equations.problem, of.log_std
    mean, precision = problem.log_std_prior
    families = [f for f in problem.families.random if not f.known]
    effects = tuple(dict.fromkeys(f.effect for f in families))
    b = np.zeros((len(x), len(effects)))
    for k, f in enumerate(problem.families.random):
        if not f.known:
            b[k, effects.index(f.effect)] = 1.0
    slope = precision @ (x - mean)
    # What logarithms add to the curvature of a falling likelihood; see `mixed.variances`.
    information = of.equations.information + np.diag(np.maximum(-2.0 * slope, 0.0))
    shipped = mean - b @ np.log([ordinary.get(e, 1.0) for e in effects])
    gain = information @ np.linalg.inv(information + precision)
    j = information - gain @ information
    h = information @ x + slope
    return SizeEvidence(effects, b.T @ j @ b, b.T @ (h - gain @ h - j @ shipped))


def type_sizes(of: Sequence[SizeEvidence]) -> tuple[TypeSize, ...]:
    """Return the sizes that the campaigns of a type tell together, by the effects' names."""
    effects = sorted({e for x in of for e in x.effects})
    if not effects:
        return ()
    count = len(effects)
    precision = np.linalg.inv(np.full((count, count), ARM**2) + EFFECT**2 * np.eye(count))
    vector = np.zeros(count)
    for x in of:
        at = np.array([effects.index(e) for e in x.effects])
        precision[np.ix_(at, at)] += x.information
        vector[at] += x.vector
    covariance = np.linalg.inv(precision)
    b, std = covariance @ vector, np.sqrt(np.diag(covariance))
    ends = np.exp(b[:, None] + WIDTH * std[:, None] * np.array([0.0, -1.0, 1.0]))
    return tuple(TypeSize(e, *map(float, row)) for e, row in zip(effects, ends, strict=True))


LIST = "arms.csv"
"""File beside the campaigns that says which arm each is of, and when it was measured."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A campaign file, and what the list beside it says."""

    path: Path
    name: str  # its path within the directory
    arm: str = ""  # which arm; empty where that is not stated
    date: str = ""  # when it was measured, ISO 8601; empty where that is not stated


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """What a campaign taught."""

    name: str  # its path within the directory
    arm: str
    known: str  # how that is known: "list", "serial number", "folder" or "file"
    type: str  # name of the arm's type
    date: str  # when it was measured, ISO 8601
    posterior: Posterior  # of the arm's parameters
    added: tuple[str, ...]  # effects of the arm that the diagnosis added to the baseline
    verdict: str
    rms_m: float  # 3-D position error on poses left out
    sizes: SizeEvidence | None = None  # what it tells of the sizes of effects; None where nothing


@dataclass(frozen=True, slots=True)
class Failure:
    """A campaign that could not be used."""

    name: str  # its path within the directory
    reason: str  # why, in a line


def entries(directory: Path) -> tuple[Entry, ...]:
    """Return the campaigns in a directory and below it, by name."""
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


def member_of(entry: Entry, effects: tuple[str, ...] = ()) -> Member | Failure:
    """Fit and diagnose a campaign; its revision in use, where it has one. Nothing is stored.

    Args:
        effects: that most arms of its type have: it is fitted with them and those it has itself.
    """
    try:
        with Campaign.open(entry.path, read_only=True) as run:
            return _member(entry, run, effects)
    except HilcalError as error:
        return Failure(entry.name, str(error).removeprefix(f"{entry.path}: "))
    except Exception as error:  # one campaign must not end the others'
        known = failure_of(error)
        return Failure(entry.name, str(known or f"unexpected {type(error).__name__}: {error}"))


def _member(entry: Entry, run: Campaign, effects: tuple[str, ...]) -> Member:
    refuse_fitting(run.file)
    record, mode = run.in_use(), run.mode()
    start = baseline(run.cell, run.readings, mode, run.catalogue)
    if record is None:
        path = refine(start, run.readings, mode)
        found, verdict = path.fit, str(path.verdict)
    else:
        found = run.restore(record)
        judged = record.result_json.get("diagnose")
        verdict = str(judged["verdict"]) if judged else diagnose(found).verdict
    if effects:
        names = dict.fromkeys((*(e.name for e in found.model.effects), *effects))
        options = {e.name: e.options for e in found.model.effects}
        model = with_effects(run.cell, found.readings, mode, names, options, run.catalogue)
        found = fit(model, found.readings, mode)
    of, folder = overview(run.file), Path(entry.name).parent
    serials = (i.serial_number or "" for i in of.instruments if i.device == "arm")
    named = {
        "list": entry.arm,
        "serial number": next(filter(None, serials), ""),
        "folder": "" if folder == Path() else str(folder),
        "file": Path(entry.name).stem,
    }
    known, arm = next((how, name) for how, name in named.items() if name)
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
