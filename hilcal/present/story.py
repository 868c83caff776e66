"""The values that charts and viewer draw: readings and revisions of a model, in base axes."""

import itertools
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy

from hilcal import numbers
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.effect_ranking import Suspect, added_variable
from hilcal.diagnosis.residual_regression import Dependence
from hilcal.discovery.curve import drawn_laws
from hilcal.discovery.law import Coefficient
from hilcal.errors import InputError
from hilcal.identification.fit import (
    Fit,
    all_left_out,
    in_base_axes,
    mahalanobis2,
    sensor_axes,
)
from hilcal.identification.prediction.full_prediction import FullPrediction, full_prediction
from hilcal.identification.residual import ErrorBlock
from hilcal.model.model import Model
from hilcal.numbers import digits, length
from hilcal.present import diagnosis
from hilcal.present.document import Block, note, table
from hilcal.present.fit import (
    error_words,
    errors,
    holdout_sentence,
    model_name,
    parameters,
    prior_lines,
)
from hilcal.present.verdict import erring_quantity, message
from hilcal.refinement import PRIOR, Refinement, RefinementStep
from hilcal.robot.arm import Arm
from hilcal.robot.scene import body_poses
from hilcal.store.revision import change
from hilcal.types import Bools, Floats, Ints

Mode = Literal["deflection", "absolute"]
LEVEL_NAMES = ("inside the noise", "doubtful", "outside the noise")
LIMITS = (0.99, 0.9999)  # quantiles of χ² above which a reading is doubtful, and outside
MAX_NUMBER = 10**9
UNDIAGNOSED = "not diagnosed"
REVISION_HEADS = (
    *("rev.", "model", "poses\nfitted", "\nσ", "poses\nleft out", "\nσ"),
    *("variance\nfactor", "verdict"),
)
"""Heads of a table of revisions."""
MIN_CARRIED_SHARE = 0.02  # share of the misfit below which a variable is not shown; a guess
MOST_SUSPECTS, MOST_PARAMETERS = 3, 40


def levels(norm2: Floats, elements: Ints | int = 3) -> Ints:
    """Return the index (N,) into `LEVEL_NAMES` of squared Mahalanobis distances (N,)."""
    limits = (scipy.stats.chi2.ppf(q, elements) for q in LIMITS)
    return np.asarray(np.sum([norm2 >= limit for limit in limits], axis=0), dtype=np.int64)


def worst_and_even(badness: Floats, count: int) -> Ints:
    """Return at most `count` ascending indices: the worst fifth, and evenly chosen others."""
    if len(badness) <= count:
        return np.arange(len(badness))
    worst = np.argsort(-badness, kind="stable")[: max(1, count // 5)]
    others = np.setdiff1d(np.arange(len(badness)), worst)
    even = others[np.linspace(0, len(others) - 1, count - len(worst)).round().astype(np.int64)]
    return np.sort(np.concatenate([worst, np.unique(even)]))


@dataclass(frozen=True, slots=True, eq=False)
class DependenceCurve:
    """A quantity over a variable that it may depend on; its labels state the units."""

    title: str  # name of the variable, the suspect or the law
    description: str
    x: Floats  # (K,) the variable, of single readings or at centres of bins
    y: Floats  # (K,) residual, or its mean in the bin
    x_label: str  # the variable with its unit
    y_label: str  # the quantity with its unit
    error: Floats | None = None  # (K,) standard uncertainty of the means; None: single readings
    names: tuple[str, ...] = ()  # (K,) of the bins if x only counts them; else empty
    line: Floats | None = None  # (2, L) the variable, and the law
    facts: tuple[tuple[str, str], ...] = ()  # properties of a law: name and text


@dataclass(frozen=True, slots=True, eq=False)
class StoryRevision:
    """One fitted model revision of N readings."""

    revision: int  # its number, ascending along the story
    change: str  # e.g. "+ hysteresis"; empty for the first
    verdict: str  # a verdict of `diagnose`, or `UNDIAGNOSED`
    residual: Floats  # (N, 3) measured - predicted, base axes, m
    predicted: Floats  # (N, 3) position, or deflection vector in deflection mode, m
    whitened_norm2: Floats  # (N,) squared Mahalanobis distances
    error: ErrorBlock  # of the fitted readings
    holdout: ErrorBlock  # of whole poses left out
    cells: tuple[str, ...] = ()  # row of a table of revisions
    panels: Mapping[str, tuple[Block, ...]] = field(default_factory=dict)
    """Blocks of the panels "verdict", "details" and "parameters"."""
    dependence: DependenceCurve | None = None  # the residual over its strongest cause
    laws: tuple[DependenceCurve, ...] = ()  # curves of laws that the catalogue lacks
    elements: Ints | int = 3  # (N,) degrees of freedom of each reading: 1 of a distance or height

    @property
    def size_m(self) -> Floats:
        """(N,) lengths of the residuals, m."""
        return np.asarray(np.linalg.norm(self.residual, axis=1))

    @property
    def sigma(self) -> Floats:
        """(N,) Mahalanobis distances, σ."""
        return np.sqrt(self.whitened_norm2)

    @property
    def level(self) -> Ints:
        """(N,) index of each reading into `LEVEL_NAMES`."""
        return levels(self.whitened_norm2, self.elements)

    @property
    def name(self) -> str:
        """The change of the revision, or its model if it is the first."""
        return self.change or (self.cells[1] if self.cells else "first model")


@dataclass(frozen=True, eq=False)
class Story:
    """N readings and the revisions of the model fitted to them; SI, base axes."""

    arm: Arm
    mode: Mode
    q: Floats  # (N, n) joint angles, rad
    pose: Ints  # (N,) number of the commanded pose
    load_names: tuple[str, ...]  # (N,)
    anchor: Floats  # (N, 3) nominal position of the target, start of the arrows, m
    measured: Floats  # (N, 3) deflection vector, or position in absolute mode, m
    covariance: Floats  # (N, 3, 3) of the residual, m²
    noise_floor_m: float  # rms 3-D error that noise alone would leave
    revisions: tuple[StoryRevision, ...]
    target: Ints | None = None  # (N,) index of the target into `target_names`
    target_names: tuple[str, ...] = ()
    pose_names: tuple[str, ...] = ()  # (N,); empty if the numbers are the names
    time_s: Floats | None = None  # (N,); None: unknown
    along: Floats | None = None  # (N, 3) direction of a distance or height, else 0; None: no such
    growing: bool = False  # whether further revisions may follow
    set_aside: Bools | None = None  # (N,) gross errors, or deflections from them; None: none

    @cached_property
    def fitted(self) -> Ints:
        """(K,) the readings that were not set aside."""
        return np.arange(len(self)) if self.set_aside is None else np.flatnonzero(~self.set_aside)

    @cached_property
    def poses(self) -> Ints:
        """(P,) ascending numbers of the poses."""
        return np.unique(self.pose)

    @cached_property
    def first(self) -> Ints:
        """(P,) index of the first reading of each pose."""
        return np.unique(self.pose, return_index=True)[1]

    @cached_property
    def row(self) -> Ints:
        """(N,) index into `poses` of each reading."""
        return np.searchsorted(self.poses, self.pose)

    @cached_property
    def bodies(self) -> Floats:
        """(P, n + 2, 4, 4) poses of the arm's bodies."""
        return body_poses(self.arm, self.q[self.first])

    @cached_property
    def targets(self) -> Floats:
        """(T, 3) positions of the measured targets, flange axes, m."""
        flange = self.bodies[self.row, -1]
        offset = np.einsum("nij,ni->nj", flange[:, :3, :3], self.anchor - flange[:, :3, 3])
        number = np.zeros(len(self), dtype=np.int64) if self.target is None else self.target
        return np.array([np.median(offset[number == k], axis=0) for k in np.unique(number)])

    def deviation(self, value: Floats) -> Floats:
        """Return deflections (N, 3), or the deviations of positions from the nominal arm's.

        Of a distance or height, the part along its direction.
        """
        out = value if self.mode == "deflection" else value - self.anchor
        if self.along is None:
            return out
        part = np.sum(out * self.along, axis=1, keepdims=True) * self.along
        return np.where(self.along.any(axis=1, keepdims=True), part, out)

    def last_of_poses(self, badness: Floats) -> Ints:
        """Return the reading (P,) of each pose with the largest badness (N,)."""
        order = np.lexsort((badness, self.row))
        return np.asarray(order[np.flatnonzero(np.diff(self.row[order], append=-1))])

    def pose_name(self, i: int) -> str:
        """Return the name of reading i's pose."""
        return self.pose_names[i] if self.pose_names else str(self.pose[i])

    def __len__(self) -> int:
        return len(self.pose)


@dataclass(frozen=True, slots=True, eq=False)
class Chapter:
    """One revision: its number, the added or removed effect, the fit, and its diagnosis, if any."""

    number: int
    added: str | None
    fit: Fit
    diagnosis: Diagnosis | None
    removed: str | None = None
    stored_verdict: str = ""  # of a revision without a diagnosis

    @property
    def verdict(self) -> str:
        """The verdict; empty if the revision was not diagnosed."""
        return self.stored_verdict if self.diagnosis is None else self.diagnosis.verdict

    @property
    def change(self) -> str:
        """The change of the model, e.g. "+ hysteresis"; empty for a first model."""
        scatter, named = self.fit.readings.arm_scatter is not None, self.fit.model.named
        return change(self.added, self.removed, scatter, named)

    @property
    def cells(self) -> tuple[str, ...]:
        """The row of the revision in a table with `REVISION_HEADS`."""
        fit, verdict = self.fit, self.verdict or UNDIAGNOSED
        sizes = [(length(e.rms_m), f"{e.rms_sigma:.2f}") for e in (fit.error, fit.holdout)]
        model, factor = self.change or model_name(fit.model.named), digits(fit.variance_factor)
        return str(self.number), model, *sizes[0], *sizes[1], factor, verdict.replace("_", " ")


def chapters_of(numbers: Iterable[int], steps: Iterable[RefinementStep]) -> list[Chapter]:
    """Return the steps of a refinement as chapters with the numbers of their revisions."""
    pairs = zip(numbers, steps, strict=True)
    return [Chapter(n, s.added, s.fit, s.diagnosis, s.removed) for n, s in pairs]


def prior_report(refinement: Refinement) -> list[str]:
    """Return the report on the prior of a refinement, also where its last steps leave it out."""
    steps = refinement.steps
    first = next((k for k, step in enumerate(steps) if step.removed == PRIOR), None)
    if first is None:
        return prior_lines(refinement.fit)
    before, after = (length(f.holdout.rms_m) for f in (steps[first - 1].fit, refinement.fit))
    return [
        *prior_lines(steps[first - 1].fit),
        f"  The prior was left out: without it poses left out are off by {after} rms, with it by "
        f"{before}.",
    ]


def errors_by_revision(chapters: Sequence[Chapter]) -> Iterator[Block]:
    """Yield the table of the errors and verdicts of revisions, and its explanation."""
    last = chapters[-1].fit
    floor = length(full_prediction(last).noise_floor)
    out = table(*REVISION_HEADS, rows=(c.cells for c in chapters), left=(0, 1, 7))
    out.add("", "noise alone", floor, "1.00", floor, "1.00", "1", "", tone="note")
    yield out
    yield note(
        f"Errors: rms of the {error_words(last.readings)}, and of all elements in σ, one standard "
        "deviation of the noise.\n"
    )


def build_story(chapters: Sequence[Chapter]) -> Story:
    """Build the story of successive revisions of one campaign, in axes of the last one's base.

    The story includes readings that were set aside as gross errors. Raises InputError without a
    revision, and for revisions of different readings.
    """
    if not chapters:
        raise InputError("no revision to show; run hilcal identify first")
    parts = [full_prediction(c.fit) for c in chapters]
    last, fit = parts[-1], chapters[-1].fit
    for c, p in zip(chapters, parts, strict=True):
        same = np.array_equal(p.whitening.reading, last.whitening.reading)
        if c.fit.mode != fit.mode or not same:
            why = "was fitted to other readings; nothing to compare"
            raise InputError(f"revision {c.number} {why}")
    readings, rows, states = last.readings, last.whitening.reading, last.readings.states
    frames, to_base = fit.frames, sensor_axes(fit, last.prediction.observation)[rows]
    scalar = readings.scalar[rows]
    rigid = Model(fit.model.cell.with_targets(frames.declared), ()).predict(states, np.zeros(0))
    if fit.mode == "absolute":
        chain, predicted = frames.chain, last.prediction.observation.base_position
        at = chain[:3, 3] + predicted[rows] @ chain[:3, :3].T
        measured = at + in_base_axes(last.raw[:, :3], to_base)
    else:
        measured = in_base_axes(last.whitening.raw(readings.value[:, :3]), to_base)
    covariance = np.swapaxes(to_base, 1, 2) @ last.whitening.covariance[:, :3, :3] @ to_base
    pairs = zip(chapters, parts, strict=True)
    return Story(
        arm=fit.model.cell.arm,
        mode=fit.mode,
        q=states.q[rows],
        pose=pose_numbers(readings.pose_names)[readings.pose[rows]],
        load_names=tuple(readings.load_names[k] for k in readings.load[rows]),
        anchor=rigid.observation.base_position[rows],
        measured=measured,
        covariance=0.5 * (covariance + np.swapaxes(covariance, 1, 2)),
        noise_floor_m=last.noise_floor,
        revisions=tuple(
            _revision(c, p, in_base_axes(p.raw[:, :3], to_base), measured) for c, p in pairs
        ),
        target=None if states.target is None else readings.target[rows],
        target_names=readings.target_names,
        pose_names=tuple(readings.pose_names[k] for k in readings.pose[rows]),
        time_s=None if states.time is None else states.time[rows],
        along=np.where(scalar[:, None], to_base[:, 0], 0.0) if scalar.any() else None,
        set_aside=~np.isin(rows, np.flatnonzero(~fit.outlier)[fit.whitening.reading]),
    )


def of_left_out(revision: StoryRevision, fit: Fit) -> StoryRevision:
    """Return a revision with the residuals of each pose when left out instead of fitted."""
    raw, w = all_left_out(fit)
    axes = sensor_axes(fit, full_prediction(fit).prediction.observation)
    residual = in_base_axes(raw[:, :3], axes[w.reading])
    predicted = revision.predicted + revision.residual - residual
    norm2 = mahalanobis2(raw[:, :3], w.covariance[:, :3, :3])
    return replace(revision, residual=residual, predicted=predicted, whitened_norm2=norm2)


def round_factor(limit: float, steps: Sequence[float]) -> float:
    """Return the largest of `steps` (1 to 10) times a power of ten ≤ `limit`; 1 without one."""
    if not (math.isfinite(limit) and limit > 0):
        return 1.0
    power = 10.0 ** math.floor(math.log10(limit))
    return float(max(f for f in steps if f * power <= limit * (1 + 1e-9)) * power)


def pose_numbers(names: Sequence[str]) -> Ints:
    """Return a number for each pose, by which the viewer orders them.

    The number ends the name, 13 in "p13". A name without one, such as the reference, gets the
    smallest free number from 0. If two names end in the same number, the poses count from 1.
    """
    ends = [re.search(r"[0-9]+$", name) for name in names]
    stated = [int(end.group()) for end in ends if end is not None]
    if not stated or len(set(stated)) < len(stated) or max(stated) >= MAX_NUMBER:
        return np.arange(1, len(names) + 1)
    free = (k for k in itertools.count() if k not in set(stated))
    numbers = [next(free) if end is None else int(end.group()) for end in ends]
    return np.array(numbers, dtype=np.int64)


def _revision(c: Chapter, e: FullPrediction, residual: Floats, measured: Floats) -> StoryRevision:
    d, drawn = c.diagnosis, None
    verdict: list[Block] = [f"{UNDIAGNOSED.capitalize()}: run hilcal diagnose for a verdict."]
    details: list[Block] = [holdout_sentence(c.fit)]
    if d is not None:
        drawn = strongest_dependence(d)
        verdict = [
            message(d),
            *([diagnosis.suspects_table(d, MOST_SUSPECTS)] if d.significant else []),
        ]
        details = list(diagnosis.diagnosis_report(d))
        if drawn is not None:
            details.append(f"Drawn: {drawn.y_label} against {drawn.x_label}. {drawn.description}")
    return StoryRevision(
        revision=c.number,
        change=c.change,
        verdict=c.verdict or UNDIAGNOSED,
        residual=residual,
        predicted=measured - residual,
        whitened_norm2=mahalanobis2(e.raw[:, :3], e.whitening.covariance[:, :3, :3]),
        error=c.fit.error,
        holdout=c.fit.holdout,
        cells=c.cells,
        panels={
            "verdict": (*verdict, f"Model: {model_name(c.fit.model.named)}."),
            "details": (*details, errors(c.fit)),
            "parameters": tuple(parameters(c.fit, MOST_PARAMETERS)),
        },
        dependence=drawn,
        laws=laws(c.fit),
        elements=np.where(e.readings.scalar[e.whitening.reading], 1, 3),
    )


def strongest_dependence(d: Diagnosis) -> DependenceCurve | None:
    """Return the residual over the first suspect, or over the strongest variable."""
    explained = d.lead is not None and d.insufficiency is None
    carried = [v for v in d.dependences if v.share >= MIN_CARRIED_SHARE and v.determined]
    if carried and d.verdict != "adequate" and not explained:
        return curve(carried[0])
    suspects = [] if d.lead is None else diagnosis.shown_suspects(d)
    return regressor(d.fit, suspects[0]) if suspects else None


def laws(fit: Fit) -> tuple[DependenceCurve, ...]:
    """Return the curves of laws from files, in display units; see `drawn_laws`."""
    out = []
    for law in drawn_laws(fit):
        values = ", ".join(
            f"{p.name.partition('.')[2]} = "
            + diagnosis.coefficient(Coefficient(p.name, p.value, p.std or 0.0, p.unit))
            for p in fit.parameters
            if p.name.startswith(f"{law.name}.") and p.value is not None
        )
        acts = ", ".join(law.acts_on)
        facts = (("law", law.formula), ("acts on", acts), ("coefficients", values))
        says = f"{law.formula}: where it is right, the readings lie on it."
        for c in law.curves:
            x, y, error, _ = c.binned
            x_unit, x_factor = numbers.variable_unit(c.quantity_unit)
            y_unit, factor = numbers.unit_for(c.unit, list(c.line[1]))
            over = c.quantity if x_unit in ("", "1") else f"{c.quantity} [{x_unit}]"
            moved, line = f"{c.of} of {c.site} [{y_unit}]", c.line * [[x_factor], [factor]]
            drawn = (x_factor * x, factor * y, over, moved, factor * error)
            out.append(DependenceCurve(law.name, says, *drawn, line=line, facts=facts))
    return tuple(out)


def curve(d: Dependence) -> DependenceCurve:
    """Return a dependence in display units."""
    over, x_factor = diagnosis.variable_head(d)
    y_unit, y_factor = numbers.unit_for(d.y_unit, list(d.y))
    says = f"{numbers.percent(d.share)} of the misfit on poses left out follows {d.variable}."
    error, x, y = (
        f"error of {erring_quantity(d)} [{y_unit}]",
        x_factor * d.x,
        y_factor * d.y,
    )
    return DependenceCurve(d.variable, says, x, y, over, error, y_factor * d.error, d.labels)


def regressor(fit: Fit, suspect: Suspect) -> DependenceCurve | None:
    """Return the added-variable curve of a suspect; None where `added_variable` is."""
    if (added := added_variable(fit, suspect)) is None:
        return None
    says = f"Where {suspect.effect} is right, the readings lie on the line of slope 1."
    x, y = (1e6 * v for v in added)
    label = f"what {suspect.effect} would explain [µm]"
    return DependenceCurve(suspect.effect, says, x, y, label, "residual along it [µm]")
