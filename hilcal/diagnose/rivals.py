"""Whether other effects could take the place of one, at the linearisation of the fit.

A refit without an effect, and with others in its place, takes seconds to minutes on a large
campaign, and hardly ever comes near. So that it is done only where it could, the others are
first added to the model without the effect by algebra alone, the best one first: with S and g of
all families and ‖r‖² (see `score`), a family f whose parameters have the prior precision λ is
added by

    S ← S − S_f (S_ff + λ I)⁻¹ S_fᵀ,    g ← g − S_f (S_ff + λ I)⁻¹ g_f,    ‖r‖² ← ‖r‖² − gain
"""

from collections.abc import Collection

import numpy as np
import scipy.linalg as sl

from hilcal.diagnose.needless import own_score
from hilcal.diagnose.projection import Projection
from hilcal.diagnose.score import Score, score
from hilcal.diagnose.suspects import SAME_EVIDENCE, candidates, family
from hilcal.diagnose.without import leave_out_effect, whitened_columns
from hilcal.identify.fit import Fit
from hilcal.types import Floats

NEAR = 0.1
"""Share of an effect's evidence by which the linearisation may misjudge what is in its place."""


class Rivals:
    """The columns of a fitted model and of all effects outside of it."""

    def __init__(self, p: Projection) -> None:
        """Compute them."""
        self._fit: Fit = p.fit
        self._model = whitened_columns(p.fit)
        families = [family(p, e) for e in candidates(p)]
        self._outside = np.column_stack(
            [np.zeros((len(p.fit.white), 0))] + [f.white for f in families]
        )
        ends = np.cumsum([0] + [f.white.shape[1] for f in families])
        self._slices = {
            f.effect.name: slice(int(a), int(b))
            for f, a, b in zip(families, ends[:-1], ends[1:], strict=True)
        }
        self._gram = self._outside.T @ self._outside

    def near(self, effect: str, most: int, never: Collection[str] = ()) -> bool:
        """Whether others, at most so many together, come near an effect of the model.

        Args:
            effect: of the model.
            most: others that are added together.
            never: effects that are not to be added.
        """
        w = leave_out_effect(self._fit, self._model, effect)
        own = own_score(w).log_evidence
        enough = (1 - NEAR) * own - SAME_EVIDENCE
        across = w.rows.T @ self._outside
        s = self._gram - across.T @ sl.cho_solve(w.factor, across, check_finite=False)
        g, yy = self._outside.T @ w.rest, float(w.rest @ w.rest)
        left = {n: k for n, k in self._slices.items() if n not in never}
        total = 0.0
        for _ in range(most):
            scores = {n: score(s[k, k], g[k], yy, w.dof) for n, k in left.items()}
            best = max(scores, key=lambda n: scores[n].log_evidence, default=None)
            if best is None or scores[best].log_evidence <= 0:
                break
            total += scores[best].log_evidence
            if total >= enough:
                return True
            s, g, yy = _add(s, g, yy, w.dof, left.pop(best), scores[best])
        return total >= enough


def _add(
    s: Floats, g: Floats, yy: float, dof: float, mine: slice, found: Score
) -> tuple[Floats, Floats, float]:
    """Add a family by algebra; returns S, g and ‖r‖² of the model with it."""
    precision = yy / (dof * found.strength**2)
    inner = s[mine, mine] + precision * np.eye(mine.stop - mine.start)
    step = np.linalg.solve(inner, np.column_stack([s[mine], g[mine]]))
    out = s - s[:, mine] @ step[:, :-1]
    return out, g - s[:, mine] @ step[:, -1], yy - found.gain
