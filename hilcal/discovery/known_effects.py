"""Comparison of a proposed law with effects of the catalogue as explanations of the misfit.

Effects are added by algebra, as the terms of a law are. If that prefers the law, both are also
refitted in the exact model: the deviation of a large effect, such as a load point that is 20 cm
off, from its linearisation looks like another law.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.diagnosis.effect_ranking import catalogue_columns
from hilcal.diagnosis.evidence import catalogue_families, significant
from hilcal.diagnosis.stepwise import add
from hilcal.discovery.law import Resemblance, form_of
from hilcal.discovery.problem import SearchProblem
from hilcal.discovery.refit import refine, refit_exactly, rss_with_law
from hilcal.discovery.search import LEAST_LOG_ODDS, SAME_CORRELATION, Selection
from hilcal.errors import HilcalError
from hilcal.identification.fit import Fit
from hilcal.regression.forward_selection import families_beside
from hilcal.regression.leave_out import FamilyFolds
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class KnownEffects:
    """The effects of the catalogue that a fit lacks."""

    names: tuple[str, ...]  # effects that explain the misfit together, in the order of adding
    odds: tuple[float, ...]  # that each adds: log evidence minus the log of the choice
    variance_factors: tuple[float, ...]  # of the linearisation, after each
    white: Floats  # (R, P) whitened columns of all effects that could be added
    columns: dict[str, slice]  # of each effect

    @property
    def total(self) -> float:
        """Logarithm of the odds of all added effects against none."""
        return float(sum(self.odds))


def known_effects(fit: Fit) -> KnownEffects:
    """Add effects of the catalogue to a fit by algebra, as long as they are significant."""
    x, columns, most = catalogue_columns(fit)
    steps = significant(catalogue_families(fit, x, columns, most))
    choice = float(np.log(max(len(columns), 1)))
    return KnownEffects(
        tuple(s.name for s in steps),
        tuple(s.score.log_evidence - choice for s in steps),
        tuple(s.after.rss / max(s.after.dof - s.after.spent, 1.0) for s in steps),
        x,
        columns,
    )


@dataclass(frozen=True, slots=True)
class Replacement:
    """Effects of the catalogue in place of a law."""

    names: tuple[str, ...] = ()  # effects that explain as well; none if the law is preferred
    unfitted: tuple[tuple[str, str], ...] = ()  # effects that could not be refitted, and why


def effects_replacing_law(
    fit: Fit, problem: SearchProblem, law: Selection, effects: KnownEffects
) -> Replacement:
    """Return the effects that explain the misfit as well as a law, at odds of 20 : 1; or none."""
    # a law whose exact refit fails is not preferred to effects whose exact refit succeeds
    if effects.total > law.total - LEAST_LOG_ODDS:
        return Replacement(effects.names)
    alike = resembling(problem, law, effects)
    if (
        alike
        and alike[0].cosine >= SAME_CORRELATION
        and not needed_beside_effect(problem, law, effects, alike[0].effect)
    ):
        return Replacement(effects.names or (alike[0].effect,))
    total, explained = _exact_effects(fit, effects)
    if (
        total > law.total - LEAST_LOG_ODDS
        and total > _exact_law(fit, problem, law) - LEAST_LOG_ODDS
    ):
        return explained
    return replace(explained, names=())


def _exact_effects(fit: Fit, effects: KnownEffects) -> tuple[float, Replacement]:
    """Return the best odds of the first effects in exact refits without more gross errors."""
    after, odds, best, explained = fit, 0.0, -np.inf, Replacement()
    for k, name in enumerate(effects.names):
        try:
            after = add(after, name)
        except HilcalError as error:
            return best, replace(explained, unfitted=((name, str(error)),))
        odds += effects.odds[k]
        if np.any(after.outlier & ~fit.outlier):
            continue
        total = odds + _beyond(fit, effects.variance_factors[k], after)
        if total > best:
            best, explained = total, Replacement(effects.names[: k + 1])
    return best, explained


def _exact_law(fit: Fit, problem: SearchProblem, law: Selection) -> float:
    """Return the odds of a law by its exact refit; −inf if it fails, as `discover` reports."""
    screen = problem.screen
    form = refine(screen, form_of(screen, law.terms))
    try:
        after, form, *_ = refit_exactly(screen, form, "law")
    except HilcalError:
        return -np.inf
    squares = rss_with_law(screen, form, fit.solution.prediction.situation)
    return law.total + _beyond(fit, squares / max(fit.dof - form.count, 1.0), after)


def _beyond(fit: Fit, factor: float, after: Fit) -> float:
    """Return the gain in log likelihood of a refit over its linearisation."""
    return 0.5 * fit.dof * float(np.log(factor / after.variance_factor))


def resembling(
    problem: SearchProblem, s: Selection, effects: KnownEffects
) -> tuple[Resemblance, ...]:
    """Return effects by how well they describe the motion of a law, the nearest first.

    An effect is fitted to the law without each fold of poses, and compared with it on that fold,
    since an effect of many parameters describes anything at few poses.
    """
    x, columns = effects.white, effects.columns
    linear = problem.screen.linear
    law = np.hstack([problem.columns(t) for t in s.terms])
    free = problem.model.project_out(law)
    y = (law @ np.linalg.lstsq(free, problem.residual, rcond=1e-8)[0])[:, None]
    by_model = linear.folds.left_out(y)
    total = float(np.sum(by_model.residual**2))
    out = []
    for effect, part in columns.items():
        residual = FamilyFolds(linear.folds, x[:, part]).left_out(by_model)
        share = 1.0 - float(np.sum(residual**2)) / max(total, 1e-300)
        out.append(Resemblance(effect, float(np.sqrt(max(share, 0.0)))))
    return tuple(sorted(out, key=lambda r: -r.cosine))


def needed_beside_effect(
    problem: SearchProblem, s: Selection, effects: KnownEffects, effect: str
) -> bool:
    """Whether odds of 20 : 1, corrected for the search, require a law beside a similar effect."""
    x, columns = effects.white, effects.columns
    law = np.hstack([problem.columns(t) for t in s.terms])
    both = np.hstack([x[:, columns[effect]], law])
    count = both.shape[1] - law.shape[1]
    places = {"effect": slice(0, count), "law": slice(count, both.shape[1])}
    families = families_beside(
        problem.model.information(both), problem.residual, problem.noise, both, places, {}
    )
    score = families.scores()["effect"]
    if not score.rank:
        return True
    law_score = families.with_family("effect", score).scores()["law"]
    return bool(law_score.log_evidence - sum(t.price for t in s.terms) > LEAST_LOG_ODDS)
