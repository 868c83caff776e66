"""Whether new readings still show the effects of a carried prior.

At the linearisation of a fit, A the whitened columns, the new readings y are normal under the prior
with an effect g, and under what is left of the prior when g is held at zero and the others keep
their marginal distribution:

    y ~ N(A m + F φ, β 1 + A C Aᵀ)

F the columns without a prior, φ flat, C with the drift that the fit has chosen. The difference of
the two restricted log likelihoods

    ℓ = −½ (log |V| + log |Fᵀ V⁻¹ F| + yᵀ P y)

is the log evidence of the new readings for g. What the earlier readings said for g counts by the
prior alone: without need the drift of g is zero, and readings that do not see g say nothing against
it. Directions of the prior without information have a standard deviation of one ordinary magnitude.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.linalg as sl

from hilcal.identification.coordinates import coordinates_of
from hilcal.identification.gauss_newton import Solution, whitened_jacobian
from hilcal.model.model import Model
from hilcal.readings.whitening import Whitening
from hilcal.types import Floats, Ints


def carried_effects(model: Model) -> tuple[str, ...]:
    """Effects of a model that are there because its carried prior has them."""
    if model.prior is None:
        return ()
    learnt = {e.name for e in model.prior.posterior.effects}
    return tuple(e.name for e in model.effects if e.name in learnt and e.role == "effect")


def evidence_of_carried(
    model: Model, solution: Solution, w: Whitening, effects: Sequence[str]
) -> dict[str, float]:
    """Return the log evidence of the readings for each effect, the others of the model beside it.

    Args:
        model: fitted, with a carried prior.
        solution: its fit.
        w: the gc-scaling of the fit.
        effects: of the model, that the prior has.
    """
    carried = solution.space.carried(model.size)
    others = np.setdiff1d(np.flatnonzero(solution.estimated), np.flatnonzero(carried))
    std = solution.prior[others]
    free = np.isinf(std)
    used = np.union1d(np.flatnonzero(carried), others)
    a = np.zeros((len(solution.white), model.size))
    a[:, used] = whitened_jacobian(model, solution.prediction, solution.theta, w, used)
    flat, own = a[:, others[free]], a[:, others[~free]] * std[~free]
    # With every parameter at zero; flat ones may stay where they are.
    y = solution.white + a[:, used] @ solution.theta[used]
    full = _prior(model, np.arange(model.size))
    columns = np.hstack([flat, own, a[:, full[0]] @ full[1]])
    if columns.shape[1] < len(y):
        span = sl.qr(columns, mode="economic", check_finite=False)[0]
        y, a, flat, own = span.T @ y, span.T @ a, span.T @ flat, span.T @ own

    def likelihood(known: tuple[Ints, Floats, Floats]) -> float:
        index, root, mean = known
        x = np.hstack([own, a[:, index] @ root])
        return _restricted(y - a[:, index] @ mean, flat, x, solution.beta)

    with_all = likelihood(full)
    found = {}
    for name in effects:
        place = model.names.index(name)
        mine = model.slices()[place]
        rest = replace(model, effects=tuple(e for e in model.effects if e.name != name))
        kept = np.delete(np.arange(model.size), mine)
        found[name] = with_all - likelihood(_prior(rest, kept))
    return found


def _prior(model: Model, place: Ints) -> tuple[Ints, Floats, Floats]:
    """Return indices (K,) by `place`, a root (K, K) of the covariance and the mean (K,)."""
    of = coordinates_of(model)
    return place[of.index], of.matrix, of.mean


def _restricted(y: Floats, flat: Floats, x: Floats, beta: float) -> float:
    """ℓ for V = β 1 + X Xᵀ."""
    v = x @ x.T
    v[np.diag_indices_from(v)] += beta
    low = np.linalg.cholesky(v)
    white = sl.solve_triangular(low, np.column_stack([flat, y]), lower=True, check_finite=False)
    f, r = white[:, :-1], white[:, -1]
    values, vectors = np.linalg.eigh(f.T @ f)
    seen = values > 1e-12 * values.max(initial=0.0)
    along = (f @ vectors[:, seen]).T @ r / np.sqrt(values[seen])
    log_det = 2 * float(np.log(np.diag(low)).sum()) + float(np.log(values[seen]).sum())
    return -0.5 * (log_det + float(r @ r) - float(along @ along))
