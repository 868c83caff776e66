"""What the readings say of a fit, each part computed when it is first needed, and once.

One step of backward elimination: effects without which the readings are explained as well.

An effect that was added early, in place of another that was found later, is often redundant in
the end. It is scored like a suspect of the model without it, at the same linearisation; it is
redundant where its F-test is not significant.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

from scipy.stats import chi2

from hilcal.diagnosis.arm_repeatability import instrument_instead
from hilcal.diagnosis.background_evidence import (
    TOGETHER,
    BackgroundEffect,
    background_evidence,
    p_value_of_others,
)
from hilcal.diagnosis.catalogue_sufficiency import Insufficiency, insufficiency
from hilcal.diagnosis.effect_ranking import (
    FALSE_ALARM,
    LEAST_SHARE,
    SAME_EVIDENCE,
    Suspect,
    candidates,
    rank_suspects,
)
from hilcal.diagnosis.misfit_breakdown import MisfitShare, misfit_breakdown
from hilcal.diagnosis.noise import PureError, pure_error
from hilcal.diagnosis.noise_verdict import MISFIT_ALARM
from hilcal.diagnosis.pose_alone import PoseAlone, pose_alone
from hilcal.diagnosis.residual_regression import Regressions, ResidualRegression
from hilcal.diagnosis.stepwise import add
from hilcal.diagnosis.stepwise_alternatives import Alternative, StepwiseAlternatives
from hilcal.diagnosis.wrong_figures import WrongFigure, wrong_figures
from hilcal.effects.protocol import Effect
from hilcal.errors import InputError
from hilcal.identification.arm_scatter import estimate_arm_scatter, with_arm_scatter
from hilcal.identification.drift import carried_effects, evidence_of_carried
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import (
    Linearisation,
    eliminate_effect,
    linearise,
    model_columns,
)
from hilcal.readings.arm_scatter import ArmScatter
from hilcal.regression.evidence import FamilyScore

CHANCE = 0.01
"""An effect with a smaller p-value is kept."""


class Evidence:
    """Statistics of a fit that a judgement combines; they do not depend on the model's history."""

    def __init__(
        self,
        fit: Fit,
        refit: Callable[[Fit, str], Fit] = add,
        say: Callable[[str], None] = lambda text: None,
        regressions: Regressions | None = None,
        background: tuple[BackgroundEffect, ...] | None = None,
    ) -> None:
        """Take a fit.

        Args:
            fit: the fit.
            refit: returns a fit with one more effect.
            say: takes progress, one line each.
            regressions: of residuals, those that were made.
            background: the effects of the model's background, where they were tested.

        Raises:
            InputError: for a fit whose residual is not whitened.
        """
        if fit.scaling != "gc":
            raise InputError(f"diagnosis needs scaling gc, this fit has {fit.scaling}")
        self.fit, self._refit, self._say = fit, refit, say
        self._regressions = Regressions() if regressions is None else regressions
        self._background = background
        self._known: dict[tuple[str, frozenset[str]], Alternative] = {}
        self._eliminated: dict[str, FamilyScore] = {}

    @cached_property
    def linearisation(self) -> Linearisation:
        """The fitted model's part of the regression."""
        return linearise(self.fit)

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """Effects that are not in the model and can be computed."""
        return candidates(self.fit)

    @cached_property
    def suspects(self) -> tuple[Suspect, ...]:
        """All of them scored."""
        return rank_suspects(self.linearisation, self.effects, refit=self._refit)

    @cached_property
    def wrong_figures(self) -> tuple[WrongFigure, ...]:
        """Figures of the cell that seem to be entered wrongly."""
        if self.misfit or self.fit.outlier.any() or not self.fit.readings.noise_stated:
            return wrong_figures(self.fit, self.suspects)
        return ()

    @cached_property
    def background(self) -> tuple[BackgroundEffect, ...]:
        """The effects of the model's background, each tested beside all others."""
        return background_evidence(self.fit) if self._background is None else self._background

    @cached_property
    def background_proved(self) -> bool:
        """Whether the readings prove the effects of the background together."""
        return bool(self.background) and p_value_of_others(self.fit) <= TOGETHER

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
        return float(chi2.sf(self.fit.chi2, self.fit.dof)) < MISFIT_ALARM

    @cached_property
    def regression(self) -> ResidualRegression:
        """What smooth laws, or trees, predict of the misfit on poses left out."""
        return self._regressions.of(self.linearisation)

    @cached_property
    def arm_scatter(self) -> ArmScatter | None:
        """The arm's scatter, if it is what is left; None where the residual shows none."""
        return estimate_arm_scatter(self.fit)

    @cached_property
    def pose_alone(self) -> PoseAlone | None:
        """A misfit that is the same under every load of a pose."""
        level = FALSE_ALARM / max(len(self.effects), 1)
        return pose_alone(self.linearisation, self.effects, level, LEAST_SHARE)

    @cached_property
    def by_arrivals(self) -> "Evidence | None":
        """The evidence with the arm's estimated scatter in the covariance; None where it is this.

        Several targets that are read in one arrival are displaced together by the arm's scatter.
        Where nothing states that scatter, tests that take their readings for independent count
        one arrival as several, and find causes in chance.
        """
        readings = self.fit.readings
        known = readings.scatter_stated or readings.arm_scatter is not None
        if readings.states.target is None or known or not self.misfit or self.arm_scatter is None:
            return None
        if instrument_instead(self.arm_scatter):
            return None
        model, mode, start = self.fit.model, self.fit.mode, self.fit.theta
        scattered = with_arm_scatter(model.cell, readings, self.arm_scatter)
        found = fit(model, scattered, mode, start=start)
        return Evidence(found, self._refit, self._say, self._regressions)

    @cached_property
    def redundant(self) -> tuple[str, ...]:
        """Effects of the model without which the readings are explained as well."""
        found = backward_elimination(self.fit, self._eliminated)
        needless = tuple(n.effect for n in found)
        return (*spoken_against(self.fit), *needless)

    @cached_property
    def insufficiency(self) -> Insufficiency | None:
        """What all effects of the catalogue together leave, where it is not noise."""
        return insufficiency(self.fit, self._refit, self._say, self._regressions)

    def tree_share(self, beyond: float) -> float:
        """Return the share of the misfit that trees predict, where that is more than another."""
        return self._regressions.tree_share(self.linearisation, beyond)

    def alternatives(
        self, effects: Collection[str], excluded: Collection[str]
    ) -> tuple[Alternative, ...]:
        """Return what could replace effects of the model.

        Args:
            effects: of the model.
            excluded: effects that are not to be used.
        """
        keys = [(name, frozenset(excluded)) for name in effects]
        if any(key not in self._known for key in keys):
            # Not kept: the columns of the whole catalogue are the largest arrays of a judgement.
            algebra = StepwiseAlternatives(self.fit)
            self._known |= {key: algebra.of(key[0], excluded) for key in keys}
            self._eliminated |= algebra.eliminated
        return tuple(self._known[key] for key in keys)


@dataclass(frozen=True, slots=True, eq=False)
class Redundant:
    """An effect that can be removed.

    Attributes:
        effect: canonical name.
        score: of its columns, against the model without it.
    """

    effect: str
    score: FamilyScore


def backward_elimination(
    fit: Fit, known: Mapping[str, FamilyScore] = MappingProxyType({})
) -> tuple[Redundant, ...]:
    """Return the redundant effects of a fit, the least significant first.

    Those with a carried prior are judged by `spoken_against`: other readings speak for them; random
    ones beside a background by `background_evidence`.

    Args:
        fit: the fit.
        known: scores of its effects against the model without them, as far as they were made.
    """
    carried = fit.solution.space.carried(fit.model.size)
    beside = fit.model.random if fit.model.background else ()
    judged = [
        e.name
        for e, mine in zip(fit.model.effects, fit.model.slices(), strict=True)
        if e.role == "effect" and e.name not in beside and not carried[mine].any()
    ]
    if not judged:
        return ()
    scores = {name: known[name] for name in judged if name in known}
    if len(scores) < len(judged):
        x = model_columns(fit)
        scores = {n: scores.get(n) or eliminate_effect(fit, x, n).score() for n in judged}
    found = [Redundant(n, scores[n]) for n in judged if scores[n].p_value > CHANCE]
    return tuple(sorted(found, key=lambda n: -n.score.p_value))


def spoken_against(fit: Fit) -> tuple[str, ...]:
    """Return effects of a carried prior that the new readings speak against, the most so first.

    As after a repair: at odds of 20 : 1 they are likelier without the effect than with what the
    earlier readings said of it.
    """
    names = carried_effects(fit.model) if fit.scaling == "gc" else ()
    if not names:
        return ()
    of = evidence_of_carried(fit.model, fit.solution, fit.whitening, names)
    return tuple(n for n in sorted(of, key=lambda n: of[n]) if of[n] < -SAME_EVIDENCE)
