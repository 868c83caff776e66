"""From fits and diagnoses to the `Story` that charts and viewer draw."""

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal import numbers
from hilcal.cell import Cell
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.effect_ranking import Suspect, candidates
from hilcal.diagnosis.residual_regression import Dependence
from hilcal.discovery.drawn_law import drawn_laws
from hilcal.discovery.law import Coefficient
from hilcal.errors import InputError
from hilcal.identification.fit import Fit, all_left_out, mahalanobis2
from hilcal.identification.full_prediction import FullPrediction, full_prediction
from hilcal.identification.linearisation import linearise
from hilcal.model.model import Model
from hilcal.present.diagnosis import (
    diagnosis_report,
    moves,
    revision_cells,
    shown_suspects,
    suspects_table,
)
from hilcal.present.discovery import coefficient
from hilcal.present.document import Block
from hilcal.present.fit import errors, misses, model_name, parameters
from hilcal.present.story import Curve, Mode, Story, StoryRevision
from hilcal.present.verdict import message
from hilcal.store.revision import change
from hilcal.types import Floats, Ints

MOST_NUMBER = 10**9
UNDIAGNOSED = "not diagnosed"
LITTLE = 0.2
"""Share of the predictable misfit that the first suspect must explain for its own chart to be
shown, not those of the variables; a guess."""
LEAST_CARRIED = 0.02
"""Share of the misfit below which a variable is not shown; a guess."""
MOST_SUSPECTS, MOST_PARAMETERS = 3, 40


@dataclass(frozen=True, slots=True, eq=False)
class Chapter:
    """One revision.

    Attributes:
        number: of the revision.
        added: the effect that it added.
        fit: the fit.
        diagnosis: of it, or None where it was not diagnosed.
        removed: the effect that it took out.
    """

    number: int
    added: str | None
    fit: Fit
    diagnosis: Diagnosis | None
    removed: str | None = None


def build_story(chapters: Sequence[Chapter]) -> Story:
    """Build the story of successive revisions of one campaign, in base axes.

    All readings are shown, also those that were set aside as gross errors. The base is that of
    the last revision. An arrow starts where the rigid
    nominal arm would hold the target.

    Raises:
        InputError: no revision, or revisions of different readings.
    """
    if not chapters:
        raise InputError("no revision to show; run hilcal identify first")
    parts = [full_prediction(c.fit) for c in chapters]
    last = parts[-1]
    mode: Mode = chapters[-1].fit.mode
    for c, part in zip(chapters, parts, strict=True):
        if c.fit.mode != mode or not np.array_equal(part.whitening.reading, last.whitening.reading):
            raise InputError(
                f"revision {c.number} was fitted to other readings; nothing to compare"
            )
    readings, rows = last.readings, last.whitening.reading
    frames = chapters[-1].fit.frames
    axes = np.broadcast_to(frames.base[:3, :3].T, (len(rows), 3, 3))
    nominal = _nominal(chapters[-1].fit.model.cell.with_targets(frames.declared), last)
    if mode == "absolute":
        chain, predicted = frames.chain, last.prediction.observation.base_position
        measured = chain[:3, 3] + predicted @ chain[:3, :3].T + _turn(axes, last.raw[:, :3])
    else:
        measured = _turn(axes, last.whitening.raw(readings.value[:, :3]))
    covariance = axes @ last.whitening.covariance[:, :3, :3] @ np.swapaxes(axes, 1, 2)
    return Story(
        arm=chapters[-1].fit.model.cell.arm,
        mode=mode,
        q=readings.states.q[rows],
        pose=pose_numbers(readings.pose_names)[readings.pose[rows]],
        load_names=tuple(readings.load_names[k] for k in readings.load[rows]),
        anchor=nominal[rows],
        measured=measured,
        covariance=0.5 * (covariance + np.swapaxes(covariance, 1, 2)),
        noise_floor_m=last.noise_floor,
        revisions=tuple(
            _revision(c, part, axes, measured) for c, part in zip(chapters, parts, strict=True)
        ),
        target=None if readings.states.target is None else readings.target[rows],
        target_names=readings.target_names,
        pose_names=tuple(readings.pose_names[k] for k in readings.pose[rows]),
        time_s=None if readings.states.time is None else readings.states.time[rows],
    )


def of_left_out(revision: StoryRevision, fit: Fit) -> StoryRevision:
    """Return a revision with the errors of poses left out in place of those of its fit."""
    raw, w = all_left_out(fit)
    residual = raw[:, :3] @ fit.frames.base[:3, :3]
    return replace(
        revision,
        residual=residual,
        predicted=revision.predicted + revision.residual - residual,
        whitened_norm2=mahalanobis2(raw[:, :3], w.covariance[:, :3, :3]),
    )


def pose_numbers(names: Sequence[str]) -> Ints:
    """Number of each pose, by which the viewer orders them.

    It is that which its name ends in, 13 of "p13". A pose without, as the reference, has the
    smallest number from 0 that is free. Where two names end in the same number: 1, 2, ...
    """
    ends = [re.search(r"[0-9]+$", name) for name in names]
    given = [int(end.group()) for end in ends if end is not None]
    if not given or len(set(given)) < len(given) or max(given) >= MOST_NUMBER:
        return np.arange(1, len(names) + 1)
    free = (k for k in itertools.count() if k not in set(given))
    numbers = [next(free) if end is None else int(end.group()) for end in ends]
    return np.array(numbers, dtype=np.int64)


def _nominal(cell: Cell, e: FullPrediction) -> Floats:
    """Target positions (N, 3) of the rigid nominal arm, base axes."""
    prediction = Model(cell, ()).predict(e.readings.states, np.zeros(0))
    return prediction.observation.base_position


def _turn(axes: Floats, vectors: Floats) -> Floats:
    return np.asarray(np.einsum("dij,dj->di", axes, vectors))


def _revision(c: Chapter, e: FullPrediction, axes: Floats, measured: Floats) -> StoryRevision:
    residual, d = _turn(axes, e.raw[:, :3]), c.diagnosis
    changed = change(c.added, c.removed, c.fit.readings.arm_scatter is not None)
    verdict = UNDIAGNOSED if d is None else d.verdict
    return StoryRevision(
        revision=c.number,
        change=changed,
        verdict=verdict,
        message="run hilcal diagnose for a verdict" if d is None else message(d),
        residual=residual,
        predicted=measured - residual,
        whitened_norm2=mahalanobis2(e.raw[:, :3], e.whitening.covariance[:, :3, :3]),
        error_fit=c.fit.error.to_json(),
        error_holdout=c.fit.holdout.to_json(),
        cells=revision_cells(c.number, changed, c.fit, verdict),
        panels=_panels(c),
        follows=None if d is None else _follows(d),
        laws=laws(c.fit),
    )


def _panels(c: Chapter) -> dict[str, tuple[Block, ...]]:
    d = c.diagnosis
    verdict: list[Block] = [f"{UNDIAGNOSED.capitalize()}: run hilcal diagnose for a verdict."]
    details: list[Block] = [misses(c.fit)]
    if d is not None:
        verdict = [numbers.sentence(message(d), d.fit.model.catalogue.names)]
        if d.significant:
            verdict.append(suspects_table(d, MOST_SUSPECTS))
        details = list(diagnosis_report(d))
        if (drawn := _follows(d)) is not None:
            details.append(f"Drawn: {drawn.y_label} against {drawn.x_label}. {drawn.says}")
    return {
        "verdict": (*verdict, f"Model: {model_name(c.fit.model.named)}."),
        "details": (*details, errors(c.fit)),
        "parameters": tuple(parameters(c.fit, MOST_PARAMETERS)),
    }


def _follows(d: Diagnosis) -> Curve | None:
    known = 0.0 if d.lead is None else d.lead.holdout_share
    explained = d.insufficiency is None and known >= LITTLE * d.predictable_share
    carried = [v for v in d.dependences if v.share >= LEAST_CARRIED and v.determined]
    if carried and d.verdict != "adequate" and not explained:
        return curve(carried[0])
    suspects = [] if d.lead is None else shown_suspects(d)
    return regressor(d.fit, suspects[0]) if suspects else None


def laws(fit: Fit) -> tuple[Curve, ...]:
    """Return the curves of laws from files, in units for people; see `drawn_laws`."""
    out = []
    for law in drawn_laws(fit):
        told = [
            f"{p.name.partition('.')[2]} = "
            + coefficient(Coefficient(p.name, p.value or 0.0, p.std or 0.0, p.unit))
            for p in fit.parameters
            if p.name.startswith(f"{law.name}.") and p.value is not None
        ]
        acts, coefficients = ", ".join(law.acts_on), ", ".join(told)
        facts = (("law", law.formula), ("acts on", acts), ("coefficients", coefficients))
        for c in law.curves:
            x, y, error, _ = c.binned
            x_unit, x_factor = numbers.angle_or(c.quantity_unit)
            y_unit, factor = numbers.unit_for(c.unit, list(c.line[1]))
            out.append(
                Curve(
                    law.name,
                    f"{law.formula}: where it is right, the readings lie on it.",
                    x_factor * x,
                    factor * y,
                    c.quantity if x_unit in ("", "1") else f"{c.quantity} [{x_unit}]",
                    f"{c.of} of {c.site} [{y_unit}]",
                    factor * error,
                    line=np.vstack([x_factor * c.line[0], factor * c.line[1]]),
                    facts=facts,
                )
            )
    return tuple(out)


def curve(d: Dependence) -> Curve:
    """Return a dependence in units for people."""
    x_unit, x_factor = _unit_of(d)
    y_unit, y_factor = numbers.unit_for(d.y_unit, list(d.y))
    return Curve(
        d.variable,
        f"{numbers.percent(d.share)} of the misfit on poses left out follows {d.variable}.",
        x_factor * d.x,
        y_factor * d.y,
        f"{d.variable} [{x_unit}]" if x_unit else d.variable,
        f"error of {moves(d)} [{y_unit}]",
        y_factor * d.error,
        d.labels,
    )


def _unit_of(d: Dependence) -> tuple[str, float]:
    """Unit for people, and its factor, of the variable."""
    if d.unit == "rad":
        return "°", 180.0 / np.pi
    if d.unit == "s":
        span = float(np.ptp(d.x))
        return ("h", 1 / 3600) if span > 7200 else ("min", 1 / 60) if span > 120 else ("s", 1.0)
    return d.unit, 1.0


def regressor(fit: Fit, suspect: Suspect) -> Curve | None:
    """Residual against what the suspect would explain, both along the suspect's own direction.

    With X the suspect's columns, freed of what the fitted model can do, and s its estimated
    parameters, c = X s is what it would explain of each measurement (3-vectors, raw). Plotted
    are |c| and the residual along c, both with the sign of c along the direction in which
    the c spread most. Where the suspect is right the points lie on the line of slope 1.
    """
    p = linearise(fit)
    effect = next((e for e in candidates(p.fit) if e.name == suspect.effect), None)
    if effect is None or not len(suspect.score.step):
        return None
    w, s = fit.whitening, fit.solution
    scale = np.array([q.scale for q in effect.parameters])
    jacobian = fit.model.jacobian_of((effect,), s.prediction, s.theta, w.m)
    contribution = w.raw(jacobian @ (scale * suspect.score.step))
    if p.rows.shape[1]:
        z = p.projection.solve(p.rows.T @ w.whiten(contribution).reshape(-1))
        adapted = fit.model.predict(s.prediction.situation.states, s.theta - s.transform @ z)
        shift = adapted.observation.position - s.prediction.observation.position
        contribution[:, :3] += w.raw(shift)
    c = contribution[:, :3]
    size = np.linalg.norm(c, axis=1)
    seen = size > 1e-9 * max(float(size.max(initial=0.0)), 1e-15)
    if not seen.any():
        return None
    main = np.linalg.svd(c, full_matrices=False)[2][0]
    side = np.where(c @ main < 0, -1.0, 1.0)[seen]
    along = np.sum(fit.raw[seen, :3] * c[seen], axis=1) / size[seen]
    return Curve(
        suspect.effect,
        f"Where {suspect.effect} is right, the readings lie on the line of slope 1.",
        1e6 * side * size[seen],
        1e6 * side * along,
        f"what {suspect.effect} would explain [µm]",
        "residual along it [µm]",
    )
