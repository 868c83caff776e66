"""Which effects of the catalogue could be missing, best first.

A suspect passes all tests if the F-test rejects its absence at a level for the whole catalogue, its
evidence is positive, it explains a share of the misfit on poses left out, the error there falls by
more than it scatters from pose to pose, plausible parameters explain as much as any, and the exact
model keeps the promise of the linearisation.

Plausible sizes. The standard deviation of the parameters is limited by the effect itself.
Deflections show errors of geometry and encoders in the second order only, their unloaded readings
in the first. With the frames estimated, an effect should hardly displace these by more than the
model misses there,

    t g ≤ `MOST_UNLOADED_MOTION` s,    s² = mean |P y|²,    g² = mean Σ_p |P x_p|²

y the residual of the unloaded readings, x_p their displacement by an ordinary magnitude of
parameter p, P the projection off the frames. Elastic effects are exempt: a controller may
compensate the effect of gravity. If more than a share `MOST_EVIDENCE_LOST` of the evidence needs
larger sizes, the effect is implausible, and the size that it needs is stated.

Promise. Columns hold for small parameters, so the exact model is evaluated at the step that the
score promises, with the model's own parameters adapted; if that loses much, a refit decides. The
promise, and the part of it that is kept, are reductions of ‖r‖² − dof.

Unloaded arms. Absolute readings without a load show a compliance only by the arm's own weight, a
smooth function of the joint angles, as a wrong geometry is. There a suspect that acts through loads
must explain the readings beside all effects that are constant in the arm's axes: with evidence at
20 : 1, and on poses left out.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from typing import Any

import numpy as np

from hilcal.diagnosis.minimum_detectable_effect import LEAST_SHARE as LEAST_SHARE
from hilcal.diagnosis.minimum_detectable_effect import (
    SimulatedCampaigns,
    Strength,
    least_of_family,
    least_strength,
)
from hilcal.effects.protocol import Effect, JointResidual
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import (
    EffectColumns,
    HeldOut,
    Linearisation,
    by_pose,
    columns_in_parts,
    columns_of_each,
    effect_columns,
    linearise,
)
from hilcal.identification.residual import residual
from hilcal.model.observe import motion
from hilcal.regression.evidence import FamilyScore, Spectrum, score_family, spectrum
from hilcal.regression.leave_out import FamilyFolds, improves
from hilcal.regression.schur import eliminate
from hilcal.shown import Brief
from hilcal.types import Floats

MOST_UNLOADED_MOTION = 2.0
"""Most displacement of unloaded readings by an effect, in units of the model's error there: other
errors may hide as much again. A choice."""
ROUNDING = 1e-9
LEAST_KEPT = 0.5  # share of a promise that must be kept; true effects of 3 σ keep 0.9; a choice
SAME_EVIDENCE = 3.0  # suspects whose evidence differs by less, e³ = 20 : 1, are inseparable
FALSE_ALARM = 0.001
"""Probability of naming an effect where none is missing, over the whole catalogue."""
MOST_EVIDENCE_LOST = 0.2
"""Share of its evidence that an effect may lose at plausible sizes. A choice: a prior that is too
narrow by half costs a few units however strong the evidence is."""
STANDARD_ERRORS = 3.1
"""Standard errors, from pose to pose, by which an effect of the load must lower the error on poses
left out beside geometry: p = 0.001, since a dozen of them are tested."""


@dataclass(frozen=True, slots=True, eq=False)
class Suspect(Brief):
    """An effect that is not in the model; functions stand for statistics computed on first use."""

    effect: str  # canonical name
    score: FamilyScore  # the joint test of the whole family
    share: float  # of the misfit that the effect explains
    left_out: Callable[[], HeldOut]  # part of the error on poses left out that it explains
    explains: bool  # whether it passes the tests of the fitted readings and of `holdout_share`
    detection: Callable[[], Strength]  # the smallest strength that these readings would reveal
    # for an implausible effect: (unit, rms of the parameters that it needs, plausible rms), SI
    needs: tuple[tuple[str, float, float], ...] = ()
    kept: float = 1.0  # share of the promise that the exact model keeps; 1 if another test fails
    refuted: bool = False  # predicts no better beside geometry on unloaded arms, or after a refit
    most: float = np.inf  # largest plausible strength, in ordinary magnitudes
    same_as: tuple[str, ...] = ()  # suspects that these readings do not separate from it
    coarse: str = ""  # coarser form of the effect in the model; empty for none

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the suspect with its statistics computed, for other processes."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        values |= {name: partial(_known, values[name]()) for name in ("left_out", "detection")}
        return Suspect, tuple(values.values())

    def __repr__(self) -> str:
        """Return the suspect in a line."""
        share = f"{100 * self.share:.0f} % of the misfit"
        return f"Suspect({self.effect}, p = {self.p_value:.2g}, {share})"

    @property
    def p_value(self) -> float:
        """The p-value of the joint test."""
        return self.score.p_value

    @property
    def holdout_share(self) -> float:
        """Share of the misfit on poses left out that the effect explains."""
        return self.left_out().share

    @property
    def sure(self) -> bool:
        """Whether the error on poses left out falls by more than it scatters from pose to pose."""
        return not self.refuted and self.left_out().significant

    @property
    def least(self) -> Strength:
        """The smallest strength of the effect that these readings would reveal."""
        return self.detection()

    @property
    def shown(self) -> bool:
        """Whether these readings would reveal the effect at a plausible size."""
        return self.least.visible and self.least.ordinary <= self.most

    @property
    def promises(self) -> bool:
        """Whether the suspect passes all tests of the linearised model."""
        return self.explains and self.sure and self.plausible

    @property
    def passes(self) -> bool:
        """Whether the suspect passes all tests."""
        return self.promises and self.keeps

    @property
    def plausible(self) -> bool:
        """Whether parameters of plausible size explain as much as any."""
        return not self.needs

    @property
    def keeps(self) -> bool:
        """Whether the exact model keeps the promise of the linearisation."""
        return self.kept >= LEAST_KEPT

    def to_dict(self) -> dict[str, object]:
        """Return the suspect as JSON, SI."""
        needs = [{"unit": unit, "rms": rms, "plausible_rms": m} for unit, rms, m in self.needs]
        return {
            "effect": self.effect,
            "finer_than": self.coarse or None,
            "p_value": self.p_value,
            "share": self.share,
            "holdout_share": self.holdout_share,
            "delta_bic": self.score.delta_bic,
            "log_evidence": self.score.log_evidence,
            "significant": self.passes,
            "same_as": list(self.same_as),
            "least": self.least.to_dict(),
            "shown": self.shown,
            "plausible": self.plausible,
            "needs": needs,
            "kept_share": self.kept,
        }


def _known(value: Any) -> Any:
    return value


def candidates(fit: Fit) -> tuple[Effect, ...]:
    """Effects that can be computed and are not in the model, or refine an effect of the model.

    Raises:
        InputError: `[plausible]` or `[ordinary]` of the cell names an unknown effect.
    """
    states, model = fit.readings[~fit.outlier].states, fit.model
    config = model.cell.config
    for section in ("plausible", "ordinary") if config else ():
        for name in getattr(config, section):
            if name not in model.catalogue.names:
                valid = ", ".join(model.catalogue.names)
                raise InputError(f"[{section}] {name}: no such effect; valid: {valid}")
    new = (
        model.catalogue.make(kind.name, model.cell, states, m=fit.whitening.m)
        for kind in model.catalogue.effects
        if kind.name not in model.names and kind.computable(states) and kind.applies(model.cell)
    )
    random = model.random if model.background else ()
    present = [e for e in model.effects if e.name not in random]
    finer = [e.refined(states) for e in present]
    if (of_joints := joint_residual(fit)) is not None:
        finer += [e.refined_by(states, of_joints, FALSE_ALARM) for e in present]
    return (*(e.for_scoring(states) for e in new), *(e for e in finer if e is not None))


def joint_residual(fit: Fit) -> JointResidual | None:
    """Return the residual for `Effect.refined_by`; None for deflections, where waves cancel."""
    if fit.mode == "deflection":
        return None
    s, w = fit.solution.prediction, fit.whitening
    moves = motion(fit.model.cell, s.observation, s.situation.chain, s.deviation, w.m)
    moved, count = w.whiten_readings(moves.drives), len(w.reading)
    return JointResidual(
        angle=s.situation.angle[w.reading],
        moved=moved.reshape(count, w.m, -1),
        white=fit.white.reshape(count, w.m),
        dof=fit.dof,
    )


def catalogue_columns(fit: Fit) -> tuple[Floats, dict[str, slice], dict[str, float]]:
    """Return columns (R, P) of all `candidates`, and slice and plausible strength of each."""
    families = list(columns_of_each(fit, candidates(fit)))
    ends = np.cumsum([0] + [len(f.scale) for f in families]).tolist()
    columns = np.hstack([np.zeros((len(fit.white), 0)), *(f.white for f in families)])
    names = [f.effect.name for f in families]
    bare = unloaded_readings(fit)
    return (
        columns,
        dict(zip(names, map(slice, ends[:-1], ends[1:]), strict=True)),
        {name: largest_plausible(f, bare) for name, f in zip(names, families, strict=True)},
    )


@dataclass(frozen=True, slots=True, eq=False)
class UnloadedReadings:
    """The unloaded readings of a campaign of deflections."""

    frames: Floats  # (K, F) orthonormal displacements by the frames
    rms_m: float  # s, rms of their residual beside the frames, m


def unloaded_readings(fit: Fit) -> UnloadedReadings | None:
    """Return the unloaded readings; None for absolute readings, which show all errors."""
    if fit.mode == "absolute":
        return None
    readings, model = fit.readings[~fit.outlier], fit.model
    rows, kinds = readings.unloaded, model.catalogue.with_role("registration", "target")
    frames = columns_of_each(fit, [kind(model.cell, readings.states) for kind in kinds])
    columns = np.concatenate([frame.unloaded_motion for frame in frames], axis=2)
    u, s, _ = np.linalg.svd(columns.reshape(3 * int(rows.sum()), -1), full_matrices=False)
    u = u[:, s > ROUNDING * s.max(initial=0.0)]
    error = readings.value[:, :3] - fit.solution.prediction.observation.position
    y = error[rows].reshape(-1)
    missed = y - u @ (u.T @ y)
    return UnloadedReadings(u, float(np.sqrt(missed @ missed / max(len(y) - u.shape[1], 1))))


def largest_plausible(family: EffectColumns, unloaded: UnloadedReadings | None) -> float:
    """Return the largest plausible strength of an effect, in ordinary magnitudes."""
    largest = family.effect.most()
    if unloaded is None or family.effect.elastic:
        return largest
    x = family.unloaded_motion.reshape(-1, len(family.scale))
    free = (x - unloaded.frames @ (unloaded.frames.T @ x)).ravel()
    moved = float(np.sqrt(free @ free / len(x)))
    limited = moved > ROUNDING * unloaded.rms_m
    return min(largest, MOST_UNLOADED_MOTION * unloaded.rms_m / moved) if limited else largest


def rank_suspects(
    p: Linearisation,
    effects: Sequence[Effect],  # that are not in the model
) -> tuple[Suspect, ...]:
    """Score all effects, without refits; best first, see `ranked`."""
    noise = cache(partial(SimulatedCampaigns.noise, p))
    suspects = [_suspect(p, s, len(effects), noise) for s in _scored(p, effects)]
    tested = max(sum(s.score.rank > 0 for s in suspects), 1)
    no_load = p.fit.mode == "absolute" and not p.fit.solution.prediction.situation.load.wrench.any()
    geometry = cache(partial(geometry_columns, p, effects))
    out: list[Suspect] = []
    for effect, s in zip(effects, suspects, strict=True):
        explains = s.score.p_value * tested < FALSE_ALARM and s.score.log_evidence > 0
        s = replace(s, explains=explains and s.holdout_share >= LEAST_SHARE)
        if s.promises:
            family = effect_columns(p.fit, effect)
            if no_load and acts_through_load(effect):
                s = replace(s, refuted=not beyond_geometry(p, family, geometry()))
            if s.promises:
                s = replace(s, kept=kept_by_step(p, family, s.score))
        out.append(s)
    return ranked(out)


def added_suspect(before: Fit, after: Fit) -> Suspect:
    """Return the last effect of a refit as a suspect of the gc-scaled fit before it."""
    p, effect = linearise(before), after.model.effects[-1]
    if effect.name in before.model.names:  # a finer form of it
        effect = copy(effect)
        effect.name, effect.coarse = f"{effect.name}, finer", effect.name
    (s,) = rank_suspects(p, [effect])
    return replace(s, kept=kept_by_refit(before, after, s.score))


def ranked(suspects: Iterable[Suspect], rejected: Collection[str] = ()) -> tuple[Suspect, ...]:
    """Order suspects as in `Diagnosis.suspects`, and name those that are inseparable."""
    # The addition of the `rejected` effects did not lower the error on poses left out.
    order = [replace(s, refuted=True) if s.effect in rejected else s for s in suspects]
    order.sort(key=lambda s: (-s.passes, -s.explains, -s.score.log_evidence, s.score.p_value))
    evident = [s for s in order if s.score.log_evidence > SAME_EVIDENCE]
    rivals = [s for s in evident if s.plausible and s.keeps and s.effect not in rejected]

    def same_as(s: Suspect) -> tuple[str, ...]:
        evidence = s.score.log_evidence
        near = (r for r in rivals if abs(r.score.log_evidence - evidence) < SAME_EVIDENCE)
        return tuple(r.effect for r in near if r is not s)

    return tuple(replace(s, same_as=same_as(s) if s in evident else ()) for s in order)


@dataclass(frozen=True, slots=True, eq=False)
class _Scored:
    family: EffectColumns
    information: Floats  # (P, P) S
    spectrum: Spectrum  # of S
    gradient: Floats  # (P,) g
    largest: float  # largest plausible strength
    score: FamilyScore
    held_out: HeldOut | None = None  # None where the fitted readings rule the effect out


def _scored(p: Linearisation, effects: Sequence[Effect]) -> Iterator[_Scored]:
    """Score effects, in parts that are whitened together."""
    bare = unloaded_readings(p.fit)
    for families in columns_in_parts(p.fit, effects):
        scored = []
        for family, (s, g) in zip(families, p.families(families), strict=True):
            eigen, largest = spectrum(s), largest_plausible(family, bare)
            scored.append(_Scored(family, s, eigen, g, largest, p.score_of(eigen, g, largest)))
        significant = [
            c for c in scored if c.score.p_value < FALSE_ALARM and c.score.log_evidence > 0
        ]
        held_out = iter(_left_out(p, [(c.family.white, c.score) for c in significant]))
        yield from (replace(c, held_out=next(held_out)) if c in significant else c for c in scored)


def _suspect(
    p: Linearisation, scored: _Scored, count: int, simulated_noise: Callable[[], SimulatedCampaigns]
) -> Suspect:
    """Describe one of `count` effects that are tested together, without keeping its columns."""
    eigen, result, effect = scored.spectrum, scored.score, scored.family.effect
    s, largest, held_out = scored.information, scored.largest, scored.held_out

    @cache
    def left_out() -> HeldOut:
        return held_out or _left_out(p, [(effect_columns(p.fit, effect).white, result)])[0]

    @cache
    def least() -> Strength:
        x = effect_columns(p.fit, effect)
        units = tuple(q.unit for q in effect.parameters)
        noise, level = max(p.fit.variance_factor, 1.0), FALSE_ALARM / count
        start = least_strength(s, x.motion, x.scale, units, p.fit.dof, noise, level, eigen.rank)
        return least_of_family(p, x, eigen, start, level, largest, simulated_noise)

    return Suspect(
        effect.name, result, p.share(result.gain), left_out, explains=False, detection=least,
        needs=_implausible(p, scored), most=largest, coarse=effect.coarse,
    )  # fmt: skip


def _left_out(p: Linearisation, families: Sequence[tuple[Floats, FamilyScore]]) -> list[HeldOut]:
    """Reductions of the error on poses left out by families of whitened columns (R, P)."""
    products = p.products(x for x, _ in families)
    scores = [score for _, score in families]
    return p.held_out(list(zip(products, scores, strict=True))) if families else []


def _implausible(p: Linearisation, scored: _Scored) -> tuple[tuple[str, float, float], ...]:
    """Sizes that an implausible effect needs, and plausible ones, by unit; see `Suspect.needs`."""
    scale, bounded = scored.family.scale, scored.score
    if not bounded.bounded:
        return ()
    free = p.score_of(scored.spectrum, scored.gradient)
    if free.log_evidence - bounded.log_evidence <= max(
        SAME_EVIDENCE, MOST_EVIDENCE_LOST * free.log_evidence
    ):
        return ()
    units = np.array([q.unit for q in scored.family.effect.parameters])

    def rms(x: Floats, unit: str) -> float:
        return float(np.sqrt(np.mean(x[units == unit] ** 2)))

    return tuple(
        (unit, rms(scale * free.step, unit), scored.largest * rms(scale, unit))
        for unit in dict.fromkeys(units.tolist())
    )


def kept_by_refit(before: Fit, after: Fit, score: FamilyScore) -> float:
    """Return the share of the promise that a refit kept; 1 without one, or with other outliers."""
    promised = score.gain - score.effective
    if promised <= 0 or np.any(before.outlier != after.outlier):
        return 1.0
    return ((before.chi2 - before.dof) - (after.chi2 - after.dof)) / promised


def kept_by_step(p: Linearisation, family: EffectColumns, score: FamilyScore) -> float:
    """Return the share of an effect's promise that the exact model keeps at the promised step."""
    fit, s = p.fit, p.fit.solution
    aim = s.white - family.white @ score.step
    z = p.projection.solve(p.rows.T @ aim - p.projection.ridge * s.coordinates())
    model = replace(fit.model, effects=(*fit.model.effects, family.effect))
    theta = np.concatenate([s.theta + s.transform @ z, family.scale * score.step])
    try:
        prediction = model.predict(s.prediction.situation.states, theta)
    except CannotAnswerError:
        return 0.0
    w, readings = fit.whitening, fit.readings[~fit.outlier]
    linear = float(np.sum((aim - p.rows @ z) ** 2))
    exact = float(np.sum(w.whiten(residual(readings, prediction, w)) ** 2))
    return (fit.chi2 - exact) / max(fit.chi2 - linear, 1e-300)


def acts_through_load(effect: Effect) -> bool:
    """Whether an effect acts through loads or weights."""
    return effect.elastic or effect.load_change(np.zeros(len(effect.parameters))) is not None


def geometry_columns(p: Linearisation, effects: Sequence[Effect]) -> Floats:
    """Whitened columns (R, Q) of the effects that are constant in the arm's axes."""
    situation = p.fit.solution.prediction.situation

    def constant(effect: Effect) -> bool:
        columns = effect.columns(situation)
        fields = all(c.field in ("dq", "twist") and len(c.values) == 1 for c in columns)
        return bool(columns) and fields and not effect.elastic

    families = columns_of_each(p.fit, [e for e in effects if constant(e)])
    return np.hstack([np.zeros((len(p.residual), 0)), *(f.white for f in families)])


def beyond_geometry(p: Linearisation, family: EffectColumns, geometry: Floats) -> bool:
    """Whether a family explains the readings beside geometry (R, Q), beyond doubt."""
    q, fit = geometry.shape[1], p.fit
    if not q:
        return True
    x = np.hstack([geometry, family.white])
    s, g = p.information(x), x.T @ p.residual
    first = score_family(s[:q, :q], g[:q], p.rss, fit.dof)
    if first.rank == 0:
        return True
    s, g, rss = eliminate(s, g, p.rss, slice(0, q), first.ridge)
    largest = family.effect.most()
    second = score_family(s[q:, q:], g[q:], rss, fit.dof, first.effective, largest)
    if second.rank == 0 or second.log_evidence <= SAME_EVIDENCE:
        return False
    # One ridge for both: columns in units of their strength.
    both = np.hstack([geometry / np.sqrt(first.ridge), family.white / np.sqrt(second.ridge)])
    without, with_family = (
        by_pose(fit, FamilyFolds(p.folds, x).left_out(p.left_out_residual, 1.0))
        for x in (both[:, :q], both)
    )
    return improves(without, with_family, STANDARD_ERRORS)


def added_variable(fit: Fit, suspect: Suspect) -> tuple[Floats, Floats] | None:
    """Return the points (K,) of the added-variable plot of a suspect: abscissa and ordinate, m.

    c = X s is the suspect's contribution to each measurement (3-vectors, raw), X its columns beside
    the model and s its parameters. The abscissa is |c|, the ordinate the residual along c, both
    with the sign of c along the principal direction of all c. If the suspect is right, the points
    lie on the line of slope 1. None where it explains nothing, or cannot be added.

    Source: Cook and Weisberg, *Residuals and Influence in Regression*, 1982.
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
    moved = size > 1e-9 * max(float(size.max(initial=0.0)), 1e-15)
    if not moved.any():
        return None
    main = np.linalg.svd(c, full_matrices=False)[2][0]
    side = np.where(c @ main < 0, -1.0, 1.0)[moved]
    along = np.sum(fit.raw[moved, :3] * c[moved], axis=1) / size[moved]
    return side * size[moved], side * along
