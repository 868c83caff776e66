"""Whether other effects could replace one of the model, at the linearisation of the fit.

A refit without an effect, and with others in its place, takes seconds to minutes on a large
campaign, and hardly ever explains as much. So the effect is eliminated, and the others enter by
forward selection, by algebra alone (see `regression.forward_selection`).
"""

from collections.abc import Collection
from dataclasses import dataclass

from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE, catalogue_columns
from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import eliminate_effect, model_columns
from hilcal.regression.evidence import FamilyScore
from hilcal.regression.forward_selection import families_beside, forward_selection

MOST_TOGETHER = 3
"""Effects that are tried together in place of one; a choice."""
PRICE = 1.0
"""Evidence that each further effect costs: its strength was chosen by the data, too; a guess."""


@dataclass(frozen=True, slots=True)
class Alternative:
    """Other effects in place of one.

    Attributes:
        effect: the one.
        own: its log evidence against the model without it.
        same_as: single effects that the readings do not separate from it.
        others: effects that explain together what it does, in the order of adding them.
        log_evidence: of all of them together.
    """

    effect: str
    own: float
    same_as: tuple[str, ...]
    others: tuple[str, ...]
    log_evidence: float

    @property
    def better(self) -> bool:
        """Whether the readings prefer the others, beyond doubt."""
        return self.log_evidence > self.own + SAME_EVIDENCE

    @property
    def as_good(self) -> bool:
        """Whether the others explain as much as the one."""
        return self.log_evidence > self.own - SAME_EVIDENCE

    @property
    def inseparable(self) -> bool:
        """Whether the readings do not separate the one from another, or several together."""
        return bool(self.same_as) or (self.as_good and len(self.others) > 1)


class StepwiseAlternatives:
    """Alternatives to the effects of a fitted model, from the catalogue."""

    def __init__(self, fit: Fit) -> None:
        """Compute the columns of the model and of all effects that are not in it."""
        self._fit, self._model = fit, model_columns(fit)
        self._x, self._columns, self._most = catalogue_columns(fit)
        self._gram, self._products = self._x.T @ self._x, self._model.white.T @ self._x
        self.eliminated: dict[str, FamilyScore] = {}
        """Score of each effect that `of` was asked for, against the model without it."""

    def of(self, effect: str, excluded: Collection[str] = ()) -> Alternative:
        """Return the other effects that explain together what one of the model does.

        Args:
            effect: of the model.
            excluded: effects that are not to be added.
        """
        reduced = eliminate_effect(self._fit, self._model, effect)
        self.eliminated[effect] = reduced.score()
        own = self.eliminated[effect].log_evidence
        families = families_beside(
            reduced.information(self._x, self._gram, self._products),
            reduced.residual,
            reduced.dof,
            self._x,
            self._columns,
            self._most,
        )
        # What an effect does, a finer form of it does as well: no alternative.
        barred = {*excluded, *(name for name in self._columns if name.startswith(f"{effect}("))}
        same: tuple[str, ...] = ()
        others: list[str] = []
        total = 0.0
        for step in forward_selection(families.without(barred), MOST_TOGETHER):
            if not others:
                same = tuple(n for n, s in step.scores.items() if _same(s.log_evidence, own))
            if step.score.log_evidence <= SAME_EVIDENCE:
                break
            total += step.score.log_evidence - (PRICE if others else 0.0)
            others.append(step.name)
            if total > own + SAME_EVIDENCE:
                break
        return Alternative(effect, own, same, tuple(others), total)


def _same(one: float, other: float) -> bool:
    return min(one, other) > SAME_EVIDENCE and abs(one - other) < SAME_EVIDENCE
