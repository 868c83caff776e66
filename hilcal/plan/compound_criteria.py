"""The compromise between two beliefs: that the model is complete, and that effects are missing.

Potential terms make a plan good at more than its model, and so less good at the model alone.
With q(M) = tr(C M⁻¹) the mean variance of what is asked when all parameters are unknown, q_s the
same when only the s parameters of the model are, and q*, q_s* the least of them,

    1/φ = ½ q(M)/q* + ½ q_s(M_ss)/q_s*

is the mean of both inefficiencies: a compound criterion; for volumes see `volumes`. Source:
Atkinson, Donev and Tobias, *Optimum Experimental Designs, with SAS* (2007), chapter 21.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.errors import InputError
from hilcal.plan.approximate_design import relax
from hilcal.plan.candidate_set import Units
from hilcal.plan.choice import LOOSE, SAMPLE, Question, only, question
from hilcal.plan.criteria import Linear
from hilcal.plan.criterion import Smooth, inverse
from hilcal.plan.information import Problem
from hilcal.plan.prediction_poses import WorkPoses
from hilcal.plan.volumes import Volumes
from hilcal.types import Floats

BOTH = ("A", "test")
"""Criteria of the model's parameters whose two optima have to be known; D's need not."""


@dataclass(frozen=True, slots=True, eq=False)
class Compromise:
    """φ(M) = 1 / (a / φ_open(M) + b / φ_own(M_ss)), with both φ = 1 / tr(C M⁻¹).

    Attributes:
        open: the criterion of all P parameters.
        own: the criterion of the model's s parameters, which come first.
        a: weight of the belief that all parameters are unknown, over 0.
        b: weight of the belief that the model is complete, over 0.
    """

    open: Linear
    own: Linear
    a: float
    b: float
    monotone = True
    kinked = False

    @property
    def name(self) -> str:
        """Name by which a configuration calls it."""
        return self.open.name

    def value(self, m: Floats) -> Floats:
        """Return φ of (..., P, P) matrices."""
        size = len(self.own.c)
        whole, own = self.open.value(m), self.own.value(m[..., :size, :size])
        below = self.a * own + self.b * whole
        return np.asarray(
            np.where(below > 0.0, whole * own / np.where(below > 0.0, below, 1.0), 0.0)
        )

    def gradient(self, m: Floats) -> Floats:
        """Return (P, P) φ² (a M⁻¹ C M⁻¹ + b M_ss⁻¹ C_ss M_ss⁻¹).

        Raises:
            InputError: M is singular.
        """
        found = self(m)
        if found is None:
            raise InputError("the information matrix is singular: the criterion has no gradient")
        return found.above

    def __call__(self, m: Floats) -> Smooth | None:
        """Return f = log φ."""
        size = len(self.own.c)
        whole, own = inverse(m), inverse(m[:size, :size])
        if whole is None or own is None:
            return None
        part = np.zeros_like(m)
        part[:size, :size] = own[0]
        beliefs = ((self.a, whole[0]), (self.b, part))
        q = sum(weight * float(np.sum(self.open.c * found)) for weight, found in beliefs)
        if not q > 0.0:
            return None
        parts = [(weight / q, found @ self.open.c @ found, found) for weight, found in beliefs]
        gradient = sum((share * inner for share, inner, _ in parts), np.zeros_like(m))
        products = tuple((-2.0 * share, inner, found) for share, inner, found in parts)
        return Smooth(-float(np.log(q)), gradient, products, ((1.0, gradient),), gradient / q)

    def surrogate(self, m: Floats, order: float) -> Callable[[Floats], Smooth | None]:
        """Return f = log φ, whatever the order."""
        return self

    def sure(self, m: Floats, names: Sequence[str] | None) -> None:
        """Refuse a singular M."""
        self.open.sure(m, names)


def robust_question(
    problem: Problem, name: str, work: WorkPoses | None, budget: float, rng: np.random.Generator
) -> Question:
    """Return what a criterion asks; D, A and test as a compromise where terms are potential.

    Args:
        problem: the design problem.
        name: as for `question`.
        work: the test poses, for "test".
        budget: readings, for which the two optima are found.
        rng: generator; they are found among some of the poses.

    Raises:
        CannotAnswerError: so many readings do not determine the model.
        InputError: from `question`.
    """
    asked, size = question(problem, name, work), problem.model_size
    if size == len(problem.terms):
        return asked
    if name == "D":
        return replace(asked, criterion=Volumes(size))
    if name not in BOTH:
        return asked
    c = np.diag(np.where(np.arange(len(problem.terms)) < size, 1.0 / size, 0.0))
    if isinstance(asked.criterion, Linear):
        c = asked.criterion.c
    whole, own = Linear(c, name), Linear(c[:size, :size], name)
    poses = np.array([pose for pose, _ in problem.what])
    some = only(asked, np.isin(poses, rng.permutation(len(problem.candidates))[:SAMPLE]))
    units = Units(some.units.rows[:, :, :size], some.units.cost)
    alone = Question(own, units, asked.prior[:size, :size], asked.names[:size])
    a, b = (_best(q, budget) / 2.0 for q in (replace(some, criterion=whole), alone))
    return replace(asked, criterion=Compromise(whole, own, a, b))


def _best(asked: Question, budget: float) -> float:
    """φ of the continuous optimum."""
    found = relax(
        asked.units, asked.criterion, budget, asked.prior, names=asked.names, tolerance=LOOSE
    )
    return float(found.value)
