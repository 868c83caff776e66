"""Variances by restricted maximum likelihood, under priors on log standard deviations.

    maximise  ℓ(x) − ½ (x − mean)ᵀ Λ (x − mean),    x = (log s, η), Λ of `mixed.families`

by Newton's method with the average information, and what logarithms add to the curvature of a
falling likelihood: without that the steps for families that are not there are several times too
long. A family that is small where the iteration passes has hardly a slope, and would stay small
whatever the readings say of it: where Newton's method has converged, the exact likelihood of each
family's size, given the others, is searched, and the iteration goes on from the best one. The
average information and the prior's are the inverse covariance of log s and η (Laplace).
Source: Patterson and Thompson, *Recovery of inter-block information when block
sizes are unequal*, Biometrika 58 (1971) 545.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.errors import CannotAnswerError
from hilcal.mixed.equations import Equations, equations
from hilcal.mixed.problem import MixedProblem
from hilcal.types import Floats

STEPS = 100
"""Most Newton steps; a choice, 10 to 20 are usual."""
LARGEST_STEP = 2.0
"""Of log s or η at a time: a factor of 7; a choice."""
CONVERGED = 1e-4
"""Gain of the log posterior that ends the iteration; a choice: they are then within 1 % of their
standard error."""
JUMPS = 8
"""Most times that Newton's method is begun anew at another size of one family; a choice."""
WORTH = 0.01
"""Gain of the log posterior for which it is; a choice."""
SIZES = np.linspace(-7.0, 7.0, 57)
"""log s that are searched: a factor of 1000 either way in steps of a quarter; a choice."""
DAMPINGS = 12
"""Most increases of the damping in one step, tenfold each; a choice."""


@dataclass(frozen=True, eq=False)
class Variances:
    """Standard deviations of all families and of the noise.

    Attributes:
        equations: at the estimate.
        covariance: (F + N, F + N) of log s and η.
        log_posterior: ℓ and the prior's, without constants.
    """

    equations: Equations
    covariance: Floats
    log_posterior: float

    @property
    def log_std(self) -> Floats:
        """(F + N,) estimate of log s and η."""
        return self.equations.log_std

    def std(self, name: str) -> float:
        """Return the standard deviation of a family or of a component of the noise."""
        return float(np.exp(self.log_std[self.equations.problem.names.index(name)]))


def estimate_variances(
    problem: MixedProblem, start: Floats | None = None, *, search: bool = False
) -> Variances:
    """Estimate all variances.

    Args:
        start: (F + N,) where the iteration starts; the priors' means unless given.
        search: whether other sizes of each family are searched. A size far from that at which the
            problem was linearised is only one to linearise at anew.

    Raises:
        CannotAnswerError: the likelihood cannot be computed at the start.
    """
    mean, _ = problem.log_std_prior
    try:
        here = equations(problem, mean if start is None else start)
    except np.linalg.LinAlgError as error:
        raise CannotAnswerError("the mixed model's equations have no solution") from error
    here, best = _newton(here)
    for _ in range(JUMPS if search else 0):
        try:
            there, value = _newton(equations(problem, _other_size(here)))
        except np.linalg.LinAlgError:
            break
        if value < best + WORTH:
            break
        here, best = there, value
    _, precision = problem.log_std_prior
    covariance = np.asarray(np.linalg.inv(here.information + precision))
    return Variances(here, covariance, best)


def _newton(here: Equations) -> tuple[Equations, float]:
    """Return the equations at the nearest maximum, and the log posterior there."""
    mean, precision = here.problem.log_std_prior
    best, damping = log_posterior(here), 0.0
    for _ in range(STEPS):
        slope = here.slope - precision @ (here.log_std - mean)
        # d²ℓ/dx² = 2 dℓ/dx + 4 λ² d²ℓ/dλ², λ = exp 2x: the average information is the second term.
        bend = np.maximum(-2.0 * here.slope, 0.0)
        curvature = here.information + precision + np.diag(bend)
        gain = 0.0
        for _ in range(DAMPINGS):
            damped = curvature + damping * np.diag(np.diagonal(curvature))
            step = np.linalg.solve(damped, slope)
            step *= min(1.0, LARGEST_STEP / float(np.abs(step).max(initial=1e-12)))
            try:
                there = equations(here.problem, here.log_std + step)
                gain = log_posterior(there) - best
            except np.linalg.LinAlgError:
                gain = -np.inf
            if gain >= 0.0:
                break
            damping = max(10.0 * damping, 1e-2)
        if gain < 0.0:
            break
        here, best, damping = there, best + gain, 0.1 * damping if damping > 1e-3 else 0.0
        if gain < CONVERGED:
            break
    return here, best


def _other_size(e: Equations) -> Floats:
    """Log s and η (F + N,) with one of them at the size that gains most, given the others."""
    mean, precision = e.problem.log_std_prior
    off = precision @ (e.log_std - mean)
    out, most = e.log_std, 0.0
    for f, family in enumerate(e.problem.families.random):
        if family.known:
            continue
        step = SIZES - e.log_std[f]
        gain = e.profile(f, SIZES) - step * off[f] - 0.5 * precision[f, f] * step**2
        k = int(np.argmax(gain))
        if gain[k] > most:
            out, most = e.log_std.copy(), float(gain[k])
            out[f] = SIZES[k]
    return out


def log_posterior(e: Equations) -> float:
    """ℓ and the prior's, without constants."""
    mean, precision = e.problem.log_std_prior
    off = e.log_std - mean
    return e.log_likelihood - 0.5 * float(off @ precision @ off)
