"""Whether other effects could take the place of one, at the linearisation of the fit.

A refit without an effect, and with others in its place, takes seconds to minutes on a large
campaign, and hardly ever comes near. So the others are added to the model without the effect by
algebra alone, the best one first: with S and g of all families and ‖r‖² (see `score`), a family f
whose parameters have the prior precision λ is added by

    S ← S − S_f (S_ff + λ I)⁻¹ S_fᵀ,    g ← g − S_f (S_ff + λ I)⁻¹ g_f,    ‖r‖² ← ‖r‖² − gain
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl

from hilcal.diagnose.backward_elimination import own_score
from hilcal.diagnose.effect_ranking import SAME_EVIDENCE, candidates, family
from hilcal.diagnose.score import Score, score
from hilcal.diagnose.without import leave_out_effect, whitened_columns
from hilcal.identify.fit import Fit
from hilcal.types import Floats

MOST_TOGETHER = 3
"""Effects that are tried together in place of one."""
PRICE = 1.0
"""Evidence that each further effect costs: its strength was chosen by the data, too."""


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


def outside(fit: Fit) -> tuple[Floats, dict[str, slice]]:
    """Return the columns (R, P) of all effects that are not in the model, and whose they are."""
    families = [family(fit, e) for e in candidates(fit)]
    ends = np.cumsum([0] + [f.white.shape[1] for f in families])
    columns = np.hstack([np.zeros((len(fit.white), 0)), *(f.white for f in families)])
    return columns, {
        f.effect.name: slice(int(a), int(b))
        for f, a, b in zip(families, ends[:-1], ends[1:], strict=True)
    }


class Rivals:
    """The columns of a fitted model and of all effects outside of it."""

    def __init__(self, fit: Fit) -> None:
        """Compute them."""
        self._fit = fit
        self._model = whitened_columns(fit)
        self._outside, self._slices = outside(fit)
        self._gram = self._outside.T @ self._outside

    def of(self, effect: str, never: Collection[str] = ()) -> Alternative:
        """Look for other effects that explain together what one of the model does.

        The evidence of a chain of additions is the sum of theirs, ln p(r | all) − ln p(r | none),
        so that one large family and several small effects compare.

        Args:
            effect: of the model.
            never: effects that are not to be added.
        """
        w = leave_out_effect(self._fit, self._model, effect)
        own = own_score(w).log_evidence
        across = w.rows.T @ self._outside
        s = self._gram - across.T @ sl.cho_solve(w.factor, across, check_finite=False)
        g, yy = self._outside.T @ w.rest, float(w.rest @ w.rest)
        left = {n: k for n, k in self._slices.items() if n not in never}
        same: tuple[str, ...] = ()
        others: list[str] = []
        total = 0.0
        while left and len(others) < MOST_TOGETHER:
            scores = {n: score(s[k, k], g[k], yy, w.dof) for n, k in left.items()}
            best = max(scores, key=lambda n: scores[n].log_evidence)
            if not others:
                same = tuple(n for n, found in scores.items() if _same(found.log_evidence, own))
            if scores[best].log_evidence <= SAME_EVIDENCE:
                break
            total += scores[best].log_evidence - (PRICE if others else 0.0)
            others.append(best)
            if total > own + SAME_EVIDENCE:
                break
            s, g, yy = with_family(s, g, yy, w.dof, left.pop(best), scores[best])
        return Alternative(effect, own, same, tuple(others), total)


def _same(one: float, other: float) -> bool:
    return min(one, other) > SAME_EVIDENCE and abs(one - other) < SAME_EVIDENCE


def with_family(
    s: Floats, g: Floats, yy: float, dof: float, mine: slice, found: Score
) -> tuple[Floats, Floats, float]:
    """Add a family by algebra; returns S, g and ‖r‖² of the model with it.

    Args:
        s: (P, P) S of all families.
        g: (P,) of them.
        yy: ‖r‖².
        dof: degrees of freedom of r.
        mine: the family's columns.
        found: its score.
    """
    precision = yy / (dof * found.strength**2)
    inner = s[mine, mine] + precision * np.eye(mine.stop - mine.start)
    step = np.linalg.solve(inner, np.column_stack([s[mine], g[mine]]))
    out = s - s[:, mine] @ step[:, :-1]
    return out, g - s[:, mine] @ step[:, -1], yy - found.gain
