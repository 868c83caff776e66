"""Whether effects of the catalogue explain the misfit as well as a law that is proposed.

They are added by algebra, at the linearisation of the fit, as the terms of a law are. Where that
prefers the law, both are refitted in the exact model as well: an effect that is large, as a load
that acts 20 cm from where it is thought to, is not linear in its parameters, and what it does
beyond the linearisation looks like a law of its own.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.diagnosis.effect_ranking import FALSE_ALARM, catalogue_columns
from hilcal.diagnosis.stepwise import add
from hilcal.discovery.law import Resemblance, form_of
from hilcal.discovery.problem import SearchProblem
from hilcal.discovery.refit import exact, left_by, refine
from hilcal.discovery.search import LEAST, SAME, Selection
from hilcal.errors import HilcalError
from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import linearise
from hilcal.regression import forward_selection as selection
from hilcal.regression.forward_selection import families_beside
from hilcal.regression.leave_out import left_out_residuals
from hilcal.types import Floats

MOST_TOGETHER = 6  # Effects that are added at most; a choice


@dataclass(frozen=True, slots=True, eq=False)
class KnownEffects:
    """The effects of the catalogue beside a fit."""

    names: tuple[str, ...]  # of those that explain the misfit together, in the order of adding them
    odds: tuple[float, ...]  # that each adds: log evidence less the choice
    left: tuple[float, ...]  # variance factor that the linearisation leaves with each of them
    white: Floats  # (R, P) columns of all that could be added
    columns: dict[str, slice]  # which are whose

    @property
    def total(self) -> float:
        """Logarithm of the odds of all that are added against none."""
        return float(sum(self.odds))


def known_effects(fit: Fit) -> KnownEffects:
    """Add effects of the catalogue to a fit by algebra, as long as they are significant."""
    linear = linearise(fit)
    x, columns, most = catalogue_columns(fit)
    families = families_beside(linear.information(x), linear.residual, fit.dof, x, columns, most)
    tested = max(len(families.columns), 1)
    names: list[str] = []
    odds: list[float] = []
    left: list[float] = []
    for step in selection.forward_selection(families, MOST_TOGETHER):
        if step.score.log_evidence <= 0 or step.score.p_value * tested >= FALSE_ALARM:
            break
        names.append(step.name)
        odds.append(step.score.log_evidence - float(np.log(tested)))
        left.append(step.after.rss / max(fit.dof - step.after.spent, 1.0))
    return KnownEffects(tuple(names), tuple(odds), tuple(left), x, columns)


@dataclass(frozen=True, slots=True)
class Instead:
    """What the catalogue has in the place of a law."""

    names: tuple[str, ...] = ()  # that explain as well; none where the law is preferred
    unfitted: tuple[tuple[str, str], ...] = ()  # that could not be refitted, and why


def instead_of_law(
    fit: Fit, problem: SearchProblem, law: Selection, known: KnownEffects
) -> Instead:
    """Return the effects that explain the misfit as well as a law, at odds of 20 : 1; or none.

    A law that the exact model cannot be fitted with is not preferred to effects that it can.
    """
    if known.total > law.total - LEAST:
        return Instead(known.names)
    near = resembling(problem, law, known)
    if near and near[0].cosine >= SAME and not tells_more(problem, law, known, near[0].effect):
        return Instead(known.names or (near[0].effect,))
    total, found = _exact_effects(fit, known)
    if total > law.total - LEAST and total > _exact_law(fit, problem, law) - LEAST:
        return found
    return replace(found, names=())


def _exact_effects(fit: Fit, known: KnownEffects) -> tuple[float, Instead]:
    """Return the best odds of the first one, two, … effects by their exact refits, and which.

    A refit that sets further readings aside as gross errors does not explain these.
    """
    after, odds, best, found = fit, 0.0, -np.inf, Instead()
    for k, name in enumerate(known.names):
        try:
            after = add(after, name)
        except HilcalError as error:
            return best, replace(found, unfitted=((name, str(error)),))
        odds += known.odds[k]
        if np.any(after.outlier & ~fit.outlier):
            continue
        total = odds + _beyond(fit, known.left[k], after)
        if total > best:
            best, found = total, Instead(known.names[: k + 1])
    return best, found


def _exact_law(fit: Fit, problem: SearchProblem, law: Selection) -> float:
    """Return the odds of a law by its exact refit; -inf without one, as `discover` tells."""
    screen = problem.screen
    form = refine(screen, form_of(screen, law.terms))
    try:
        after, form, *_ = exact(screen, form, "law")
    except HilcalError:
        return -np.inf
    left = left_by(screen, form, fit.solution.prediction.situation)
    return law.total + _beyond(fit, left / max(fit.dof - form.count, 1.0), after)


def _beyond(fit: Fit, left: float, after: Fit) -> float:
    """Return the log likelihood that a refit gains over the variance factor of its algebra."""
    return 0.5 * fit.dof * float(np.log(left / after.variance_factor))


def resembling(
    problem: SearchProblem, s: Selection, known: KnownEffects
) -> tuple[Resemblance, ...]:
    """Effects that describe what a law does, the nearest first.

    An effect is fitted to the law without each fold of poses, and predicts it there: an effect of
    many parameters describes anything else in few poses.
    """
    x, columns = known.white, known.columns
    linear = problem.screen.linear
    law = np.hstack([problem.columns(t) for t in s.terms])
    free = problem.model.project_out(law)
    y = (law @ np.linalg.lstsq(free, problem.residual, rcond=1e-8)[0])[:, None]
    folds = linear.folds
    whole = float(np.sum(left_out_residuals(folds, linear.projection, y) ** 2))
    out = []
    for effect, part in columns.items():
        left = left_out_residuals(folds, linear.projection, y, x[:, part])
        share = 1.0 - float(np.sum(left**2)) / max(whole, 1e-300)
        out.append(Resemblance(effect, float(np.sqrt(max(share, 0.0)))))
    return tuple(sorted(out, key=lambda r: -r.cosine))


def tells_more(problem: SearchProblem, s: Selection, known: KnownEffects, effect: str) -> bool:
    """Whether odds of 20 : 1, corrected for the search, ask for a law beside an effect near it."""
    x, columns = known.white, known.columns
    law = np.hstack([problem.columns(t) for t in s.terms])
    both = np.hstack([x[:, columns[effect]], law])
    count = both.shape[1] - law.shape[1]
    places = {"effect": slice(0, count), "law": slice(count, both.shape[1])}
    families = families_beside(
        problem.model.information(both), problem.residual, problem.dof, both, places, {}
    )
    score = families.scores()["effect"]
    if not score.rank:
        return True
    beside = families.with_family("effect", score).scores()["law"]
    return bool(beside.log_evidence - sum(t.price for t in s.terms) > LEAST)
