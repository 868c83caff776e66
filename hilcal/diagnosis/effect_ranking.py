"""Which effects of the catalogue could be missing, best first.

A suspect passes all tests where the F-test over the whole catalogue rejects that it is absent,
its evidence is positive, it explains a share of the misfit on poses left out, the error there
falls by more than it scatters from pose to pose, its parameters need not be larger than is
plausible, and the exact model keeps what the linearisation promised (see `promise`).

All is scored at plausible sizes: the standard deviation of the parameters is at most what
`plausible_size.most` states. Where more than a share `LOST` of its evidence needs larger ones, the
effect is implausible, and the size that it would need is stated.

Whether gravity tells of an effect of the load where no load was hung.

Absolute readings of an unloaded arm show a compliance by the torque of the arm's own mass alone.
That is a smooth function of the joint angles, and so is what a wrong geometry does: with few poses
either explains the other. So a suspect that acts through loads must explain the readings beside
geometry: its evidence beside all effects that are constant in the arm's axes (link geometry, zero
offsets) is positive at 20 : 1, and the error on poses left out falls beyond what they make it fall,
by more than it scatters from pose to pose.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from hilcal.diagnosis.family_detection import large, least_of_family
from hilcal.diagnosis.minimum_detectable_effect import Strength, least_strength
from hilcal.diagnosis.plausible_size import Unloaded, frame_effects, most, unloaded_readings
from hilcal.diagnosis.promise import LEAST_KEPT, kept, kept_by_refit
from hilcal.diagnosis.stepwise import add
from hilcal.effects.protocol import Effect, Situation
from hilcal.errors import InputError
from hilcal.identification.effect_columns import (
    EffectColumns,
    columns_in_parts,
    columns_of_each,
    effect_columns,
)
from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import HeldOut, Linearisation, by_pose, linearise
from hilcal.regression.evidence import FamilyScore, score_family
from hilcal.regression.leave_out import left_out_residual
from hilcal.regression.paired_test import improves
from hilcal.regression.schur import eliminate
from hilcal.regression.spectrum import Spectrum, spectrum
from hilcal.shown import Brief
from hilcal.types import Floats

SAME_EVIDENCE = 3.0
"""Two suspects whose evidence differs by less than e³ = 20 : 1 count as inseparable."""
FALSE_ALARM = 0.001
"""Chance of naming any effect where none is missing, over the whole catalogue."""
MOST_KEPT = 1_000_000
"""Numbers of an effect's columns up to which they are kept until the smallest strength that would
be revealed is asked for, 8 MB; larger ones are computed again then. A choice."""
LEAST_SHARE = 0.01
"""An effect that explains less of the misfit on poses left out is not worth adding; a guess."""


LOST = 0.2
"""Share of its evidence that an effect may lose at plausible sizes. A choice: a prior that is too
narrow by half costs a few units however strong the evidence is."""
SURE = 3.1
"""Standard errors, from pose to pose, by which the error on poses left out must fall: a chance of
one in a thousand, since a dozen effects of the load try."""


@dataclass(frozen=True, eq=False)
class Detection:
    """The smallest strength that would be revealed, which takes most of the time of a ranking.

    No verdict depends on it; so it is computed when it is first asked for.
    """

    _compute: Callable[[], Strength]

    @cached_property
    def least(self) -> Strength:
        """The smallest strength that these readings would reveal."""
        return self._compute()


@dataclass(frozen=True, eq=False)
class LeftOut:
    """The reduction of the error on poses left out.

    No verdict depends on that of an effect that fails the test of the fitted readings: it is
    computed when it is first asked for.
    """

    _compute: Callable[[], HeldOut]

    @cached_property
    def found(self) -> HeldOut:
        """The reduction."""
        return self._compute()


@dataclass(frozen=True, slots=True, eq=False)
class Suspect(Brief):
    """An effect that is not in the model, and what it would explain.

    Attributes:
        effect: canonical name.
        score: the joint test of the whole family.
        share: share of the misfit it explains.
        left_out: what it explains on poses left out.
        explains: whether it passes the tests of the fitted readings and of its share.
        detection: the smallest strength of it that these readings would reveal, computed when it
            is first asked for.
        needs: where it is implausible, its size: (unit, rms of the parameters that it would need,
            rms that is plausible), SI.
        kept: share of what the linearisation promised that the exact model keeps; 1 where that
            was not looked at, since the suspect fails other tests.
        refuted: whether the error on poses left out does not fall by it after all: beside geometry,
            where no load was hung (see `gravity`), or as a refit has shown.
        most: largest plausible strength, in ordinary magnitudes; see `plausible_size`.
        same_as: other suspects that these readings do not separate from it.
        coarse: name of the effect of the model that it is finer than; empty for one that the model
            does not have.
    """

    effect: str
    score: FamilyScore
    share: float
    left_out: LeftOut
    explains: bool
    detection: Detection
    needs: tuple[tuple[str, float, float], ...] = ()
    kept: float = 1.0
    refuted: bool = False
    most: float = np.inf
    same_as: tuple[str, ...] = ()
    coarse: str = ""

    def __repr__(self) -> str:
        """Return the suspect in a line."""
        share = f"{100 * self.share:.0f} % of the misfit"
        return f"Suspect({self.effect}, p = {self.score.p_value:.2g}, {share})"

    @property
    def holdout_share(self) -> float:
        """Share of the misfit that it explains on poses left out."""
        return self.left_out.found.share

    @property
    def sure(self) -> bool:
        """Whether the error on poses left out falls by more than it scatters from pose to pose."""
        return not self.refuted and self.left_out.found.sure

    @property
    def least(self) -> Strength:
        """The smallest strength of it that these readings would reveal."""
        return self.detection.least

    @property
    def shown(self) -> bool:
        """Whether these readings would reveal it at a plausible size."""
        return self.least.visible and self.least.ordinary <= self.most

    @property
    def passes(self) -> bool:
        """Whether it passes all tests."""
        return self.explains and self.sure and self.plausible and self.keeps

    @property
    def plausible(self) -> bool:
        """Whether parameters of plausible size explain as much as any."""
        return not self.needs

    @property
    def keeps(self) -> bool:
        """Whether the exact model keeps what the linearisation promised."""
        return self.kept >= LEAST_KEPT


def candidates(fit: Fit) -> tuple[Effect, ...]:
    """Effects that are not in the model, or are finer than one of it, and can be computed.

    Raises:
        InputError: `[plausible]` or `[ordinary]` of the cell names an effect that the catalogue
            does not hold.
    """
    states = fit.readings[~fit.outlier].states
    model, out = fit.model, []
    config = model.cell.config
    for section in ("plausible", "ordinary") if config else ():
        for name in getattr(config, section):
            if name not in model.catalogue.names:
                valid = ", ".join(model.catalogue.names)
                raise InputError(f"[{section}] {name}: no such effect; valid: {valid}")
    for kind in model.catalogue.effects:
        possible = kind.computable(states) and kind.applies(model.cell)
        if kind.name not in model.names and possible:
            effect = model.catalogue.make(kind.name, model.cell, states, m=fit.whitening.m)
            out.append(effect.for_scoring(states))
    beside = model.random if model.background else ()
    finer = (e.refined(states) for e in model.effects if e.name not in beside)
    return (*out, *(e for e in finer if e is not None))


def catalogue_columns(fit: Fit) -> tuple[Floats, dict[str, slice], dict[str, float]]:
    """Return the columns (R, P) of all `candidates`, which are whose, and how large each may be."""
    families = list(columns_of_each(fit, candidates(fit)))
    ends = np.cumsum([0] + [len(f.scale) for f in families])
    columns = np.hstack([np.zeros((len(fit.white), 0)), *(f.white for f in families)])
    of = {
        f.effect.name: slice(int(a), int(b))
        for f, a, b in zip(families, ends[:-1], ends[1:], strict=True)
    }
    bare = unloaded_readings(fit)
    return columns, of, {f.effect.name: most(f, bare) for f in families}


def rank_suspects(
    p: Linearisation,
    effects: Sequence[Effect],
    level: float = FALSE_ALARM,
    refit: Callable[[Fit, str], Fit] = add,
) -> tuple[Suspect, ...]:
    """Score all effects; best first, see `ranked`.

    Args:
        p: linearisation of the fit.
        effects: that are not in the model.
        level: of the test over all of them together.
        refit: returns a fit with one more effect.
    """
    small: dict[str, EffectColumns] = {}
    found = []
    for part in _scored(p, effects, level):
        for scored in part:
            of = scored.of
            if of.numbers <= MOST_KEPT:
                small[of.effect.name] = of
            found.append(_suspect(p, scored, level, len(effects)))
    tested = max(sum(s.score.rank > 0 for s in found), 1)
    out: list[Suspect] = []
    geometry: Floats | None = None
    for k, s in enumerate(found):
        explains = s.score.p_value * tested < level and s.score.log_evidence > 0
        s = replace(s, explains=explains and s.holdout_share >= LEAST_SHARE)
        if s.passes:
            own = small.get(s.effect) or effect_columns(p.fit, effects[k])
            if unloaded(p) and through_load(effects[k]):
                if geometry is None:
                    geometry = geometry_columns(p, effects)
                s = replace(s, refuted=not beyond_geometry(p, own, geometry, SAME_EVIDENCE))
            if s.passes:
                s = replace(s, kept=kept(p, own, s.score, refit))
        out.append(s)
    return ranked(out)


def addition(before: Fit, after: Fit) -> Suspect:
    """Return what was to be expected of the last effect of a model, and what the refit kept of it.

    Args:
        before: a gc-scaled fit.
        after: the fit with one more effect.
    """
    p, effect = linearise(before), after.model.effects[-1]
    if effect.name in before.model.names:  # a finer form took its place
        effect = copy(effect)
        effect.name, effect.coarse = f"{effect.name}, finer", effect.name
    (s,) = rank_suspects(p, [effect], refit=lambda fit, name: after)
    return replace(s, kept=kept_by_refit(before, after, s.score))


def ranked(suspects: Iterable[Suspect], rejected: Collection[str] = ()) -> tuple[Suspect, ...]:
    """Order suspects, and name those that are inseparable.

    First come those that pass all tests, then those that explain the misfit but do not surely
    lower the error on poses left out, then the others; by evidence in each of these groups.

    Args:
        suspects: in any order.
        rejected: names of those whose addition did not lower the error on poses left out.
    """
    found = [replace(s, refuted=True) if s.effect in rejected else s for s in suspects]
    found.sort(key=lambda s: (-s.passes, -s.explains, -s.score.log_evidence, s.score.p_value))
    evident = [s for s in found if s.score.log_evidence > SAME_EVIDENCE]
    others = [s for s in evident if s.plausible and s.keeps and s.effect not in rejected]

    def same_as(s: Suspect) -> tuple[str, ...]:
        if s.score.log_evidence <= SAME_EVIDENCE:
            return ()
        own = s.score.log_evidence
        near = (o for o in others if abs(o.score.log_evidence - own) < SAME_EVIDENCE)
        return tuple(o.effect for o in near if o is not s)

    return tuple(replace(s, same_as=same_as(s)) for s in found)


@dataclass(frozen=True, slots=True, eq=False)
class _Scored:
    """An effect that was scored, and what it was scored by.

    Attributes:
        of: its columns.
        information: (P, P) S.
        spectrum: of S.
        gradient: (P,) g.
        largest: largest plausible strength.
        score: its score.
        held: reduction of the error on poses left out; None where the fitted readings rule the
            effect out.
    """

    of: EffectColumns
    information: Floats
    spectrum: Spectrum
    gradient: Floats
    largest: float
    score: FamilyScore
    held: HeldOut | None = None


def _scored(
    p: Linearisation, effects: Sequence[Effect], level: float
) -> Iterator[tuple[_Scored, ...]]:
    """Score effects, those together that were whitened together."""
    frames = frame_effects(p.fit)
    of_frames: list[EffectColumns] = []
    bare: Unloaded | None = None
    for part in columns_in_parts(p.fit, (*frames, *effects)):
        rest = len(frames) - len(of_frames)
        of_frames += part[:rest]
        if len(of_frames) == len(frames) and bare is None:
            bare = unloaded_readings(p.fit, of_frames)
        scored = []
        for of, (s, g) in zip(part[rest:], p.families(part[rest:]), strict=True):
            of_s, largest = spectrum(s), most(of, bare)
            scored.append(_Scored(of, s, of_s, g, largest, p.score_of(of_s, g, largest)))
        able = [c for c in scored if c.score.p_value < level and c.score.log_evidence > 0]
        held = iter(_left_out(p, [(c.of.white, c.score) for c in able]))
        yield tuple(replace(c, held=next(held)) if c in able else c for c in scored)


def _suspect(p: Linearisation, scored: _Scored, level: float, count: int) -> Suspect:
    """Describe one of `count` effects that are tested together."""
    of, of_s, result = scored.of, scored.spectrum, scored.score
    s, largest, effect, known = scored.information, scored.largest, of.effect, scored.held
    columns: Callable[[], EffectColumns] = lambda: of  # noqa: E731 - of the small ones alone
    if of.numbers > MOST_KEPT:
        columns = partial(effect_columns, p.fit, effect)
    left_out = LeftOut(lambda: _left_out(p, [(columns().white, result)])[0])
    if known is not None:
        left_out = LeftOut(lambda: known)

    def least() -> Strength:
        own = columns()
        found = least_strength(
            s,
            own.motion,
            own.scale,
            tuple(q.unit for q in effect.parameters),
            p.fit.dof,
            max(p.fit.variance_factor, 1.0),
            level / count,
            of_s.rank,
        )
        if large(of_s, p.fit.dof):
            return least_of_family(p, own, of_s, found, level / count, LEAST_SHARE, largest)
        return found

    return Suspect(
        effect=effect.name,
        coarse=effect.coarse,
        score=result,
        share=p.share(result.gain),
        left_out=left_out,
        explains=False,
        needs=_implausible(p, scored),
        detection=Detection(least),
        most=largest,
    )


def _left_out(p: Linearisation, families: Sequence[tuple[Floats, FamilyScore]]) -> list[HeldOut]:
    """Reductions of the error on poses left out by families of whitened columns (R, P)."""
    products = p.products(x for x, _ in families)
    scores = [score for _, score in families]
    return p.held_out(list(zip(products, scores, strict=True))) if families else []


def _implausible(p: Linearisation, scored: _Scored) -> tuple[tuple[str, float, float], ...]:
    """Size that an effect needs where plausible ones explain less, and plausible sizes, by unit."""
    of, at_most = scored.of, scored.score
    if not at_most.bounded:
        return ()
    free = p.score_of(scored.spectrum, scored.gradient)
    lost = free.log_evidence - at_most.log_evidence
    if lost <= max(SAME_EVIDENCE, LOST * free.log_evidence):
        return ()
    units = np.array([q.unit for q in of.effect.parameters])
    needed = of.scale * free.step
    return tuple(
        (unit, _rms(needed[units == unit]), scored.largest * _rms(of.scale[units == unit]))
        for unit in dict.fromkeys(units.tolist())
    )


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))


def unloaded(p: Linearisation) -> bool:
    """Whether no load acts in any of the fitted readings."""
    return p.fit.mode == "absolute" and not np.any(p.fit.solution.prediction.situation.load.wrench)


def through_load(effect: Effect) -> bool:
    """Whether an effect acts through what loads or weights do."""
    return effect.elastic or effect.load_change(np.zeros(len(effect.parameters))) is not None


def geometry_columns(p: Linearisation, effects: Sequence[Effect]) -> Floats:
    """Whitened columns (R, Q) of the effects that are constant in the arm's axes."""
    s = p.fit.solution.prediction.situation
    constant = [e for e in effects if _constant(e, s)]
    families = [of.white for of in columns_of_each(p.fit, constant)]
    return np.hstack([np.zeros((len(p.residual), 0)), *families])


def _constant(effect: Effect, s: Situation) -> bool:
    columns = effect.columns(s)
    fields = all(c.field in ("dq", "twist") and len(c.values) == 1 for c in columns)
    return bool(columns) and fields and not effect.elastic


def beyond_geometry(p: Linearisation, of: EffectColumns, geometry: Floats, evidence: float) -> bool:
    """Whether a family explains the readings beside geometry, too.

    Args:
        p: linearisation of the fit.
        of: the family.
        geometry: (R, Q) columns of `geometry_columns`.
        evidence: log evidence that it must have.
    """
    if not geometry.shape[1]:
        return True
    q, fit = geometry.shape[1], p.fit
    x = np.hstack([geometry, of.white])
    s, g = p.information(x), x.T @ p.residual
    first = score_family(s[:q, :q], g[:q], p.rss, fit.dof)
    if first.rank == 0:
        return True
    rest, gradient, rss = eliminate(s, g, p.rss, slice(0, q), first.ridge)
    found = score_family(
        rest[q:, q:], gradient[q:], rss, fit.dof, first.effective, of.effect.most()
    )
    if found.rank == 0 or found.log_evidence <= evidence:
        return False
    # One ridge for both: columns in units of their strength.
    both = np.hstack([geometry / np.sqrt(first.ridge), of.white / np.sqrt(found.ridge)])
    left = [
        by_pose(fit, left_out_residual(p.folds, p.projection, fit.white, columns, 1.0))
        for columns in (both[:, :q], both)
    ]
    return improves(left[0], left[1], SURE)
