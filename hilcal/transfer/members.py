"""One campaign of a fleet: its arm, its date, its fit, and its evidence on sizes of effects.

The sizes of effects of a type of arm, relative to other arms, follow from the log standard
deviations x_i of the families of campaign i (`hilcal.mixed.families`):

    x_i = mean + B b + d_i,    d_i ~ N(0, Λ⁻¹),    b ~ N(0, ARM² + EFFECT² 1)

mean and Λ are the prior for any arm, B maps each family to its effect, and b is common to the arms
of the type. The restricted likelihood of a campaign is approximated as quadratic about its estimate
x_i, with information I and slope Λ (x_i − mean) there. Marginalising d_i gives

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
from hilcal.effects.protocol import failure_of
from hilcal.errors import CannotAnswerError, HilcalError, InputError
from hilcal.identification.background import MOST_ROWS
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.carried.posterior import Posterior, Source
from hilcal.identification.fit import Fit, fit
from hilcal.identification.mixed_fit import mixed_fit
from hilcal.identification.prediction.predictive import belongs_to_arm
from hilcal.mixed.families import ARM_SPREAD, EFFECT_SPREAD
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
"""Half width of a 95 % interval, in standard deviations of b."""


@dataclass(frozen=True, slots=True, eq=False)
class SizeEvidence:
    """Evidence of a campaign on the sizes of E effects."""

    effects: tuple[str, ...]  # their names
    information: Floats  # (E, E) Bᵀ J B
    vector: Floats  # (E,) Bᵀ (j − J mean)


@dataclass(frozen=True, slots=True)
class TypeSize:
    """The size of an effect on arms of a type, divided by that on other arms."""

    effect: str  # name
    factor: float  # relative size
    low: float  # lower end of its 95 % interval
    high: float  # upper end

    @property
    def differs(self) -> bool:
        """Whether its 95 % interval excludes 1, the size on other arms."""
        return self.low > 1.0 or self.high < 1.0


def size_evidence(start: Model, fitted: Fit) -> SizeEvidence | None:
    """Return the evidence of a fit's readings; None if they do not determine its frames."""
    inliers = fitted.readings[~fitted.outlier].as_stated()
    poses = np.unique(inliers.pose)
    most = max(2, int(len(poses) * MOST_ROWS / (len(inliers) * inliers.m)))
    sample = poses[np.unique(np.linspace(0, len(poses) - 1, most).astype(np.int64))]
    try:
        variances = mixed_fit(start, inliers[np.isin(inliers.pose, sample)], fitted.mode).variances
    except CannotAnswerError:
        return None
    config = start.cell.config
    return evidence_of(variances, {} if config is None else config.ordinary)


def evidence_of(variances: Variances, ordinary: dict[str, float]) -> SizeEvidence:
    """Return the evidence of estimated variances."""
    problem, x = variances.equations.problem, variances.log_std
    mean, precision = problem.log_std_prior
    families = [f for f in problem.families.random if not f.known]
    effects = tuple(dict.fromkeys(f.effect for f in families))
    b = np.zeros((len(x), len(effects)))
    for k, f in enumerate(problem.families.random):
        if not f.known:
            b[k, effects.index(f.effect)] = 1.0
    slope = precision @ (x - mean)
    # curvature by the logarithm where the likelihood falls; see `mixed.variances`
    information = variances.equations.information + np.diag(np.maximum(-2.0 * slope, 0.0))
    shipped = mean - b @ np.log([ordinary.get(e, 1.0) for e in effects])
    gain = information @ np.linalg.inv(information + precision)
    j = information - gain @ information
    h = information @ x + slope
    return SizeEvidence(effects, b.T @ j @ b, b.T @ (h - gain @ h - j @ shipped))


def type_sizes(evidence: Sequence[SizeEvidence]) -> tuple[TypeSize, ...]:
    """Return sizes from the joint evidence of a type's arms, by names of effects."""
    effects = sorted({e for x in evidence for e in x.effects})
    if not effects:
        return ()
    count = len(effects)
    precision = np.linalg.inv(
        np.full((count, count), ARM_SPREAD**2) + EFFECT_SPREAD**2 * np.eye(count)
    )
    vector = np.zeros(count)
    for x in evidence:
        indices = np.array([effects.index(e) for e in x.effects])
        precision[np.ix_(indices, indices)] += x.information
        vector[indices] += x.vector
    covariance = np.linalg.inv(precision)
    b, std = covariance @ vector, np.sqrt(np.diag(covariance))
    ends = np.exp(b[:, None] + WIDTH * std[:, None] * np.array([0.0, -1.0, 1.0]))
    return tuple(TypeSize(e, *map(float, row)) for e, row in zip(effects, ends, strict=True))


LIST = "arms.csv"
"""File beside the campaigns that states the arm and the date of each."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A campaign file, with its row of `LIST`."""

    path: Path
    name: str  # its path within the directory
    arm: str = ""  # empty if not stated
    date: str = ""  # of the measurement, ISO 8601; empty if not stated


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """The fit of a campaign."""

    name: str  # its path within the directory
    arm: str
    arm_source: str  # source of `arm`: "list", "serial number", "folder" or "file"
    type: str  # name of the arm's type
    date: str  # of the measurement, ISO 8601
    posterior: Posterior  # of the arm's parameters
    added: tuple[str, ...]  # effects of the arm that the diagnosis added to the baseline
    verdict: str
    rms_m: float  # 3-D position error on poses left out
    sizes: SizeEvidence | None = None  # None if there is no evidence
    background: frozenset[str] = frozenset()  # effects of the model that are not named


@dataclass(frozen=True, slots=True)
class Failure:
    """A campaign that could not be used."""

    name: str  # its path within the directory
    reason: str  # why, in a line


def sizes_of_arms(members: Sequence[Member]) -> list[SizeEvidence]:
    """Return the evidence of each arm: that of its most informative campaign.

    All campaigns of an arm have the same d_i, and must not count as several arms.
    """
    best_of_arm: dict[str, SizeEvidence] = {}
    for m in members:
        if m.sizes is not None:
            pair = best_of_arm.get(m.arm, m.sizes), m.sizes
            best_of_arm[m.arm] = max(pair, key=lambda x: float(np.trace(x.information)))
    return list(best_of_arm.values())


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
    """Arm and date, by campaign."""
    if not path.exists():
        return {}
    out = {}
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
                out[row["campaign"]] = ((row["arm"] or "").strip(), date)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    return out


def prints_of(entry: Entry) -> Floats:
    """Return the prints of a campaign's readings; none if it cannot be read."""
    try:
        with CampaignFile.open(entry.path, read_only=True, check_revisions=False) as file:
            return prints(file.readings())
    except HilcalError:
        return np.zeros((0, 0))


def member_of(entry: Entry, effects: tuple[str, ...] = ()) -> Member | Failure:
    """Fit and diagnose a campaign, or restore its revision in use. Nothing is stored.

    `effects` are traits of the arm's type: the model is fitted with its own effects and these.
    """
    try:
        with Campaign.open(entry.path, read_only=True) as run:
            return _member(entry, run, effects)
    except HilcalError as error:
        return Failure(entry.name, str(error).removeprefix(f"{entry.path}: "))
    except Exception as error:  # a failure of one campaign must not affect the others
        of_effect = failure_of(error)
        return Failure(entry.name, str(of_effect or f"unexpected {type(error).__name__}: {error}"))


def _member(entry: Entry, run: Campaign, effects: tuple[str, ...]) -> Member:
    refuse_fitting(run.file)
    record, mode = run.in_use(), run.mode()
    start = baseline(run.cell, run.readings, mode, run.catalogue)
    if record is None:
        path = refine(start, run.readings, mode)
        fitted, verdict = path.fit, str(path.verdict)
    else:
        fitted = run.restore(record)
        judged = record.result_json.get("diagnose")
        verdict = str(judged["verdict"]) if judged else diagnose(fitted).verdict
    if effects:
        names = dict.fromkeys((*(e.name for e in fitted.model.effects), *effects))
        options = {e.name: e.options for e in fitted.model.effects}
        model = with_effects(run.cell, fitted.readings, mode, names, options, run.catalogue)
        fitted = fit(model, fitted.readings, mode)
    about, folder = overview(run.file), Path(entry.name).parent
    serials = (i.serial_number or "" for i in about.instruments if i.device == "arm")
    named = {
        "list": entry.arm,
        "serial number": next(filter(None, serials), ""),
        "folder": "" if folder == Path() else str(folder),
        "file": Path(entry.name).stem,
    }
    source, arm = next((how, name) for how, name in named.items() if name)
    posterior = Posterior.of(fitted, Source(entry.name, 0, about.created))
    return Member(
        name=entry.name,
        arm=arm,
        arm_source=source,
        type=run.cell.arm.name,
        date=entry.date or about.created,
        posterior=replace(posterior, scatter=None),
        added=tuple(
            e.name
            for e in fitted.model.effects
            if belongs_to_arm(e) and e.name in fitted.model.named and e.name not in start.names
        ),
        verdict=verdict,
        rms_m=fitted.holdout.rms_m,
        sizes=size_evidence(start, fitted),
        background=frozenset(fitted.model.background),
    )
