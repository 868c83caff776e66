"""The statistics of a fit that a judgement needs, each computed once, on first use.

Alternatives. Refits take seconds to minutes on a large campaign, so an effect is eliminated, and
others enter by forward selection, by algebra (`regression.forward_selection`). An effect that was
added in place of one found later is often redundant: its F-test against the model without it, at
the same linearisation, is not significant, and its evidence as a random effect does not favour it
at 20 : 1. (An F-test of as many columns as there are degrees of freedom sees nothing.)

This evidence leaves the noise free. So others that leave a misfit by the stated noise, where the
model leaves none, are no alternatives, whatever their evidence: beside them something would be
missing.

Separability. Suppose suspect A with the estimated parameters β is the cause. It adds βᵀ S_A β to
the whitened sum of squares beside the fitted model, S_A the information on A. When suspect B is
fitted instead, the share

    u = βᵀ S_A|B β / βᵀ S_A β

remains, S_A|B the Schur complement of B: λ = βᵀ S_A|B β is the non-centrality of the test of A
beyond B, as in planning. k times as many readings like these give k λ, and separate A from B when
k λ reaches `SEPARATING_SQUARES`.

Sufficiency. An effect outside the catalogue resembles effects of the catalogue: a base that sways
with the air temperature looks like a drifting tracker. The best suspect then passes every test, and
is wrong. So all significant effects enter the model, one after the other, by algebra. If more than
noise is left, the linearisation may be too coarse: the best effect is added by a refit, and the
selection is repeated. The catalogue is insufficient if a residual remains after two refits, and
repeats or a generic regression show that it is not noise.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy

from hilcal.diagnosis.background_evidence import BackgroundEffect, background_evidence
from hilcal.diagnosis.confounding import Confounded, confounded
from hilcal.diagnosis.effect_ranking import (
    FALSE_ALARM,
    SAME_EVIDENCE,
    Suspect,
    candidates,
    catalogue_columns,
    kept_by_refit,
    rank_suspects,
    ranked,
)
from hilcal.diagnosis.misfit_breakdown import MisfitShare, misfit_breakdown
from hilcal.diagnosis.noise import (
    MISFIT_ALARM,
    PREDICTABLE,
    NoiseVerdict,
    PureError,
    judge_noise,
    prefers_instrument,
    pure_error,
)
from hilcal.diagnosis.pose_alone import PoseAlone, pose_alone
from hilcal.diagnosis.residual_regression import Dependence, Regressions, ResidualRegression
from hilcal.diagnosis.stepwise import trial
from hilcal.diagnosis.unknown_law import without_remainder
from hilcal.diagnosis.wrong_figures import WrongFigure, loads_reversed, wrong_figures
from hilcal.effects.protocol import Effect
from hilcal.identification.carried.drift import carried_effects, evidence_of_carried
from hilcal.identification.fit import Fit, fit_again, require_gc
from hilcal.identification.linearisation import (
    Linearisation,
    effect_columns,
    eliminate_effect,
    linearise,
    model_columns,
)
from hilcal.identification.noise.arm_scatter import estimate_arm_scatter, with_arm_scatter
from hilcal.readings.readings import ArmScatter
from hilcal.regression.evidence import FamilyScore
from hilcal.regression.forward_selection import (
    Addition,
    CandidateFamilies,
    families_beside,
    forward_selection,
)
from hilcal.regression.schur import schur_complement
from hilcal.types import Floats

MOST_REPLACEMENTS = 3  # effects that are tried together in place of one; a choice
PRICE_OF_EFFECT = 1.0
"""Evidence that each further effect costs: the data chose its strength, too; a guess."""
SEPARATING_SQUARES = 12.0
"""Sum of squares, in σ², by which the right one of two suspects must fit better to be identified in
nine cases of ten at odds of 20 : 1: the difference scatters by twice its square root."""
INSEPARABLE_SHARE = 1e-3
"""Share below which no number of readings like these separates two effects; a guess."""
LEAST_REMAINDER = 0.02
"""Share of the misfit that must remain for the first suspect to be in doubt; set by the study of
the diagnosis: effects outside the catalogue against hidden effects of the catalogue."""
MOST_REFITS = 2
MOST_BY_ALGEBRA = 6
REDUNDANCY_LEVEL = 0.01  # p-value above which an effect is redundant


def is_misfit(square: float, dof: float) -> bool:
    """Whether a sum of squares is larger than noise of variance 1 allows."""
    return float(scipy.stats.chi2.sf(square, dof)) < MISFIT_ALARM


def would_leave_noise(fit: Fit, share: float) -> bool:
    """Whether an effect that explains a share of the misfit would leave noise alone."""
    return not is_misfit(fit.chi2 - share * (fit.chi2 - fit.dof), fit.dof)


@dataclass(frozen=True, slots=True)
class Alternative:
    """Other effects that could replace an effect of the model."""

    effect: str
    effect_log_evidence: float  # against the model without the effect
    same_as: tuple[str, ...]  # single effects that the readings do not separate from the effect
    replacements: tuple[str, ...]  # effects that replace it together, in the order of adding
    log_evidence: float  # of the replacements together
    sufficient: bool = True  # whether the replacements leave no misfit that the model does not

    @property
    def better(self) -> bool:
        """Whether the readings prefer the replacements, beyond doubt."""
        return self.log_evidence > self.effect_log_evidence + SAME_EVIDENCE

    @property
    def as_good(self) -> bool:
        """Whether the replacements explain as much as the effect."""
        return self.sufficient and self.log_evidence > self.effect_log_evidence - SAME_EVIDENCE

    @property
    def inseparable(self) -> bool:
        """Whether the readings do not separate the effect from another, or from several."""
        return bool(self.same_as) or (self.as_good and len(self.replacements) > 1)


class StepwiseAlternatives:
    """Alternatives to the effects of a fitted model, from the catalogue."""

    def __init__(self, fit: Fit) -> None:
        """Compute the columns of the model and of all candidates."""
        self._fit, self._model = fit, model_columns(fit)
        self._x, self._columns, self._most = catalogue_columns(fit)
        self._gram, self._products = self._x.T @ self._x, self._model.white.T @ self._x
        estimated = fit.readings.arm_scatter is not None or not fit.readings.noise_stated
        self._may_misfit = estimated or is_misfit(fit.chi2, fit.dof)

    def of(self, effect: str) -> Alternative:
        """Return the effects that together replace one."""
        reduced = eliminate_effect(self._fit, self._model, effect)
        evidence = reduced.score().log_evidence
        information = reduced.information(self._x, self._gram, self._products)
        noise = reduced.rss, reduced.dof
        families = families_beside(
            information, reduced.residual, noise, self._x, self._columns, self._most
        )
        # A finer form of an effect of the model contains it, and is a suspect by itself.
        barred = {name for name in self._columns if "(" in name}
        same: tuple[str, ...] = ()
        names: list[str] = []
        total, sufficient = 0.0, True
        for step in forward_selection(families.without(barred), MOST_REPLACEMENTS):
            if not names and evidence > SAME_EVIDENCE:
                single = [(n, s.log_evidence) for n, s in step.scores.items()]
                same = tuple(
                    n
                    for n, e in single
                    if abs(e - evidence) < SAME_EVIDENCE < e
                    and self._suffices(step.before, step.scores[n])
                )
            if step.score.log_evidence <= SAME_EVIDENCE:
                break
            total += step.score.log_evidence - (PRICE_OF_EFFECT if names else 0.0)
            names.append(step.name)
            sufficient = self._suffices(step.before, step.score)
            if total > evidence + SAME_EVIDENCE:
                break
        return Alternative(effect, evidence, same, tuple(names), total, sufficient)

    def _suffices(self, before: CandidateFamilies, added: FamilyScore) -> bool:
        """Whether a family leaves no misfit: if it is there, ‖r‖²_t is χ² with ν dof."""
        return self._may_misfit or not is_misfit(before.rss - added.gain, before.dof)


@dataclass(frozen=True, slots=True)
class Separability:
    """How a rival differs from a suspect."""

    effect: str  # the rival
    unexplained_share: float  # u, of the suspect's sum of squares, by the rival
    readings_factor: float  # k, number of readings that separates them by that of the present

    @property
    def possible(self) -> bool:
        """Whether more readings like these would separate them."""
        return bool(np.isfinite(self.readings_factor))


def separability(
    p: Linearisation, lead: Suspect, effects: tuple[Effect, ...]
) -> tuple[Separability, ...]:
    """Return how each rival in `lead.same_as` differs from the leading suspect."""
    by_name = {e.name: e for e in effects}
    x, beta = effect_columns(p.fit, by_name[lead.effect]).white, lead.score.step
    of_lead = np.arange(x.shape[1])
    out = []
    for name in lead.same_as:
        s = p.information(np.hstack([x, effect_columns(p.fit, by_name[name]).white]))
        total = float(beta @ s[np.ix_(of_lead, of_lead)] @ beta)
        share = float(beta @ schur_complement(s, of_lead) @ beta) / max(total, 1e-300)
        squares = max(share * total, 1e-300)
        factor = np.inf if share < INSEPARABLE_SHARE else SEPARATING_SQUARES / squares
        out.append(Separability(name, share, factor))
    return tuple(out)


@dataclass(frozen=True, slots=True, eq=False)
class Insufficiency:
    """The part of a misfit that all significant effects of the catalogue together leave."""

    effects: tuple[str, ...]  # the best first
    refitted: int  # how many of them were added by a refit; the others were added by algebra
    share: float  # of the misfit that remains
    variance_factor: float  # of the remaining residual
    dependences: tuple[Dependence, ...]  # variables that predict the residual of the last refit
    noise: NoiseVerdict  # shows that the stated covariance is not to blame


def whole_catalogue(fit: Fit) -> tuple[tuple[str, ...], float, float]:
    """Add all significant effects by algebra; return their names, best first, ‖r‖² and dof."""
    families = catalogue_families(fit, *catalogue_columns(fit))
    steps = significant(families)
    last = steps[-1].after if steps else families
    return tuple(s.name for s in steps), last.rss, max(last.dof - last.spent, 1.0)


def catalogue_families(
    fit: Fit, x: Floats, columns: dict[str, slice], largest: dict[str, float]
) -> CandidateFamilies:
    """Return the effects of `catalogue_columns` beside a fit."""
    p = linearise(fit)
    return families_beside(p.information(x), p.residual, p.test_noise, x, columns, largest)


def significant(families: CandidateFamilies) -> list[Addition]:
    """Return the additions that are significant, each beside the previous ones.

    A family of as many columns as there are degrees of freedom may have the most evidence and fail
    the F-test: the others are then added without it.
    """
    level = FALSE_ALARM / max(len(families.columns), 1)

    def passes(score: FamilyScore) -> bool:
        return score.log_evidence > 0 and score.p_value < level

    return list(forward_selection(families, MOST_BY_ALGEBRA, passes))


class Evidence:
    """Statistics of a fit that a judgement combines, independent of the model's history."""

    def __init__(
        self,
        fit: Fit,
        refit: Callable[[Fit, str], Fit | None] = trial,  # returns a fit with one more effect
        say: Callable[[str], None] = lambda text: None,  # takes progress, one line each
        regressions: Regressions | None = None,  # cache
        background: tuple[BackgroundEffect, ...] | None = None,  # if tested already
    ) -> None:
        """Take a fit; raises InputError for one whose residual is not whitened."""
        require_gc(fit, "diagnosis")
        self.fit, self._refit, self._say = fit, refit, say
        self._regressions = regressions or Regressions()
        self._background = background
        self._alternatives: dict[str, Alternative] = {}
        self._kept: dict[str, float] = {}  # by a refit, see `Suspect.kept`

    @cached_property
    def linearisation(self) -> Linearisation:
        """The linearisation of the fit."""
        return linearise(self.fit)

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """Effects that are not in the model and can be computed."""
        return candidates(self.fit)

    @cached_property
    def _scored(self) -> tuple[Suspect, ...]:
        return rank_suspects(self.linearisation, self.effects)

    def suspects(self, rejected: Collection[str] = ()) -> tuple[Suspect, ...]:
        """Return `effects`, scored; best first, see `ranked`.

        Where the exact model at the promised step explains much less than the linear one, a refit
        decides; only of suspects that could be the first or inseparable from it, for time.
        """
        while True:
            kept = (replace(s, kept=self._kept.get(s.effect, s.kept)) for s in self._scored)
            order = ranked(kept, rejected)
            most = max((s.score.log_evidence for s in order if s.passes), default=-np.inf)
            doubtful = (
                s
                for s in order
                if s.promises and not s.keeps and s.effect not in self._kept
                if s.score.log_evidence > most - SAME_EVIDENCE
            )
            if (s := next(doubtful, None)) is None:
                return order
            after = self._refit(self.fit, s.effect)
            refitted = 0.0 if after is None else kept_by_refit(self.fit, after, s.score)
            self._kept[s.effect] = max(s.kept, refitted)

    @cached_property
    def wrong_figures(self) -> tuple[WrongFigure, ...]:
        """Figures of the cell that seem to be wrong; none of a saturated fit."""
        if self.fit.is_saturated:
            return ()
        stated = self.fit.readings.noise_stated
        if self.misfit or self.fit.outlier.any() or not stated or loads_reversed(self.fit):
            return wrong_figures(self.fit, self.suspects())
        return ()

    @cached_property
    def background(self) -> tuple[BackgroundEffect, ...]:
        """The effects of the model's background, each tested beside all others."""
        return background_evidence(self.fit) if self._background is None else self._background

    @cached_property
    def misfit_breakdown(self) -> tuple[MisfitShare, ...]:
        """Variables that the misfit follows, largest share first."""
        return misfit_breakdown(self.linearisation)

    @cached_property
    def pure_error(self) -> PureError | None:
        """The scatter of repeated readings; None without repeats."""
        return pure_error(self.fit)

    @cached_property
    def misfit(self) -> bool:
        """Whether χ² is larger than the stated noise allows."""
        return is_misfit(self.fit.chi2, self.fit.dof)

    @cached_property
    def regression(self) -> ResidualRegression:
        """The share of the misfit on poses left out that smooth laws predict.

        The misfit is that without a remainder, which is fitted to it.
        """
        return self._regressions.of(linearise(without_remainder(self.fit)))

    @cached_property
    def arm_scatter(self) -> ArmScatter | None:
        """The arm's scatter that would explain the misfit; None where the residual shows none."""
        return estimate_arm_scatter(self.fit)

    @cached_property
    def pose_alone(self) -> PoseAlone | None:
        """A misfit that is the same under every load of a pose."""
        level = FALSE_ALARM / max(len(self.effects), 1)
        return pose_alone(self.linearisation, self.effects, level)

    @cached_property
    def with_arm_scatter(self) -> "Evidence | None":
        """The evidence with the arm's estimated scatter in the covariance; None if not needed.

        The arm's scatter displaces all targets of one arrival together. Tests that treat these
        readings as independent would find causes in chance.
        """
        readings, model = self.fit.readings, self.fit.model
        in_covariance = readings.scatter_stated or readings.arm_scatter is not None
        if readings.states.target is None or in_covariance or not self.misfit:
            return None
        if self.arm_scatter is None or prefers_instrument(self.arm_scatter):
            return None
        scattered = with_arm_scatter(model.cell, readings, self.arm_scatter)
        fitted = fit_again(self.fit, readings=scattered)
        return Evidence(fitted, self._refit, self._say, self._regressions)

    @cached_property
    def redundant(self) -> tuple[str, ...]:
        """Effects of the model without which the readings are explained as well."""
        return (*contradicted_effects(self.fit), *backward_elimination(self.fit))

    @cached_property
    def insufficiency(self) -> Insufficiency | None:
        """The misfit that all effects of the catalogue together leave; None if it is noise."""
        current, names, misfit = self.fit, list[str](), self.fit.chi2 - self.fit.dof
        while True:
            effects, square, dof = whole_catalogue(current)
            if not is_misfit(square, dof) or square - dof < LEAST_REMAINDER * misfit:
                return None
            if not effects or len(names) == MOST_REFITS:
                break
            self._say(f"testing the whole catalogue: adding {effects[0]}")
            larger = self._refit(current, effects[0])
            if larger is None:
                break
            current = larger
            names.append(effects[0])
        regression = self._regressions.of(linearise(current))
        noise = judge_noise(current, pure_error(current), regression.share > PREDICTABLE)
        if noise.misjudged or not noise.contradicted:
            return None
        return Insufficiency(
            effects=(*names, *effects),
            refitted=len(names),
            share=(square - dof) / misfit,
            variance_factor=square / dof,
            dependences=regression.dependences,
            noise=noise,
        )

    def confounded(self, suspect: str | None) -> tuple[Confounded, ...]:
        """Return the effects of the model, and the suspect, whose variable is in doubt."""
        effect = next((e for e in self.effects if e.name == suspect), None)
        return confounded(self.fit, effect)

    def alternatives(self, effects: Collection[str]) -> tuple[Alternative, ...]:
        """Return the alternatives of effects of the model."""
        if any(name not in self._alternatives for name in effects):
            # Not cached: the columns of the catalogue are the largest arrays of a judgement.
            algebra = StepwiseAlternatives(self.fit)
            self._alternatives |= {name: algebra.of(name) for name in effects}
        return tuple(self._alternatives[name] for name in effects)


def backward_elimination(fit: Fit) -> dict[str, FamilyScore]:
    """Return the redundant effects, each scored against the model without it; weakest first.

    Effects with a carried prior are left to `contradicted_effects`, those of a background to
    `background_evidence`.
    """
    carried = fit.solution.space.carried(fit.model.size)
    random = fit.model.random if fit.model.background else ()
    judged = [
        e.name
        for e, columns in zip(fit.model.effects, fit.model.slices(), strict=True)
        if e.role == "effect" and e.name not in random and not carried[columns].any()
    ]
    if not judged:
        return {}
    x = model_columns(fit)
    scores = {n: eliminate_effect(fit, x, n).score() for n in judged}
    redundant = [
        n
        for n in judged
        if scores[n].p_value > REDUNDANCY_LEVEL and scores[n].log_evidence < SAME_EVIDENCE
    ]
    return {n: scores[n] for n in sorted(redundant, key=lambda n: -scores[n].p_value)}


def contradicted_effects(fit: Fit) -> tuple[str, ...]:
    """Return effects whose carried prior the new readings contradict at 20 : 1, strongest first."""
    names = carried_effects(fit.model) if fit.scaling == "gc" else ()
    evidence = evidence_of_carried(fit.model, fit.solution, fit.whitening, names) if names else {}
    against = [n for n in evidence if evidence[n] < -SAME_EVIDENCE]
    return tuple(sorted(against, key=lambda n: evidence[n]))
