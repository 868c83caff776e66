"""Effects of a fitted model that the readings do not ask for.

An effect that was added early, in place of another that was found later, is often needless in
the end. It is judged like a suspect of the model without it, at the same linearisation: with A
the whitened Jacobian of the other effects, H = AᵀA + β diag(1/σ²) and y the residual that the
effect is part of,

    r₀ = y − A H⁻¹ Aᵀ y

is scored by the effect's columns. Needless is an effect that passes no test.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl

from hilcal.diagnose.score import Score, score
from hilcal.identify.fit import Fit
from hilcal.identify.gauss_newton import scales_of
from hilcal.identify.linear import find_basis
from hilcal.types import Bools, Floats

KEPT = ("base_frame", "target_offset", "joint_compliance")
"""Effects that every model starts with: they are there whether they are seen or not."""
CHANCE = 0.01
"""An effect with a smaller p-value is kept."""


@dataclass(frozen=True, slots=True, eq=False)
class Needless:
    """An effect that can be removed.

    Attributes:
        effect: canonical name.
        score: of its columns, against the model without it.
    """

    effect: str
    score: Score


def needless(fit: Fit) -> tuple[Needless, ...]:
    """Return the effects of a fit that its readings do not ask for, the least asked for first."""
    judged = [(k, e.name) for k, e in enumerate(fit.model.effects) if e.name not in KEPT]
    if not judged:
        return ()
    scale = scales_of(fit.model)
    s, w = fit.solution, fit.whitening
    jacobian = fit.model.jacobian(s.prediction, s.theta, w.m) * scale
    x = w.whiten(w.raw(jacobian)).reshape(-1, len(scale))
    found = []
    for k, name in judged:
        mine = np.zeros(len(scale), dtype=np.bool_)
        mine[fit.model.slices()[k]] = True
        result = _score(fit, x, scale, mine)
        if result.p_value > CHANCE:
            found.append(Needless(name, result))
    return tuple(sorted(found, key=lambda n: -n.score.p_value))


def _score(fit: Fit, x: Floats, scale: Floats, mine: Bools) -> Score:
    """Score the columns (R, P) that are `mine` against the model of all others."""
    theta = fit.theta / scale
    prior = fit.solution.prior / scale
    others = ~mine & (prior > 0)
    y = fit.white + x[:, mine] @ theta[mine]
    basis = find_basis(x[:, others], np.ones(int(others.sum())), prior[others])
    a = x[:, others] @ basis.transform
    ridge = fit.solution.beta * basis.prior_precision
    factor = sl.cho_factor(a.T @ a + np.diag(ridge), check_finite=False)
    # Priors pull to zero, not to where the fit stands: their part of y is in it, too.
    held = a @ _coordinates(basis.transform, theta[others], ridge)
    own = y + held
    rest = own - a @ sl.cho_solve(factor, a.T @ own, check_finite=False)
    columns = x[:, mine]
    freed = columns - a @ sl.cho_solve(factor, a.T @ columns, check_finite=False)
    spent = float(np.trace(sl.cho_solve(factor, a.T @ a, check_finite=False)))
    dof = fit.whitening.rank - spent
    return score(columns.T @ freed, columns.T @ rest, float(rest @ rest), dof)


def _coordinates(transform: Floats, theta: Floats, ridge: Floats) -> Floats:
    """Coordinates (K,) of the parameters that have a prior; zero for the others."""
    z = np.linalg.lstsq(transform, theta, rcond=None)[0]
    return np.where(ridge > 0, z, 0.0)
