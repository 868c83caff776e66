"""Compound criteria: efficient where the model is complete, and where effects are missing.

Potential terms make a plan good at more than its model, and so less good at the model alone. A
compound criterion is the mean of both: of the logarithms of the two D-efficiencies, so that
neither optimum is needed, or of the two inefficiencies in the parameters' mean variance,

    φ = det(M)^(1/2P) · det(M_ss)^(1/2s)          1/φ = ½ q(M)/q* + ½ q(M_ss)/q_s*

with q(M) = tr(C M⁻¹), the first s of P parameters those of the model, and q* and q_s* the least
of both. Source: Atkinson, Donev and Tobias, *Optimum Experimental Designs, with SAS* (2007),
chapter 21.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.config import CellConfig
from hilcal.design.approximate_design import relax
from hilcal.design.candidate_set import CandidateSet
from hilcal.design.choice import LOOSE, SAMPLE, Objective, canonical, objective_of, only
from hilcal.design.criteria import Determinant, InverseVariance, MeanVariance
from hilcal.design.information import DesignProblem
from hilcal.design.prediction_poses import PredictionPoses
from hilcal.types import Floats, Ints


@dataclass(frozen=True, slots=True)
class CompoundDeterminant(Determinant):
    """φ(M) = det(M)^(1/2P) · det(M_ss)^(1/2s), a compound D-criterion.

    Attributes:
        size: s, of the model, whose parameters come first.
    """

    size: int
    name = "D"

    def blocks(self, size: int) -> tuple[tuple[float, Ints], ...]:
        """Return half of the weight each on all and on the model's parameters."""
        return (0.5 / size, np.arange(size)), (0.5 / self.size, np.arange(self.size))


@dataclass(frozen=True, slots=True, eq=False)
class CompoundVariance(InverseVariance):
    """φ(M) = 1 / (a tr(C M⁻¹) + b tr(C_ss M_ss⁻¹)).

    Attributes:
        c: (P, P) C, of all parameters.
        size: s, of the model, whose parameters come first.
        a: weight of the belief that all parameters are unknown, over 0.
        b: weight of the belief that the model is complete, over 0.
        name: name by which a configuration calls it.
    """

    c: Floats
    size: int
    a: float
    b: float
    name: str = "A"

    def parts(self, size: int) -> tuple[Floats, ...]:
        """Return a C and b C_ss."""
        return self.a * self.c, self.b * self.c[: self.size, : self.size]


def compound_objective(
    problem: DesignProblem,
    config: CellConfig,
    name: str,
    work: PredictionPoses | None,
    budget: float,
    rng: np.random.Generator,
) -> Objective:
    """Return a design problem with a criterion; D and A are compound with potential terms.

    Args:
        name: as for `objective_of`.
        work: the prediction poses, for "I".
        budget: readings, for which the two optima of A are found.
        rng: generator; they are found among some of the poses.

    Raises:
        CannotAnswerError: so many readings do not determine the model.
        InputError: from `objective_of`.
    """
    name = canonical(name)
    asked, size = objective_of(problem, config, name, work), problem.model_size
    if size == len(problem.terms) or name not in ("A", "D"):
        return asked
    if name == "D":
        return replace(asked, criterion=CompoundDeterminant(size))
    c = np.diag(np.where(np.arange(len(problem.terms)) < size, 1.0 / size, 0.0))
    whole, own = MeanVariance(c, name), MeanVariance(c[:size, :size], name)
    poses = np.array([pose for pose, _ in problem.what])
    some = only(asked, np.isin(poses, rng.permutation(len(problem.candidates))[:SAMPLE]))
    units = CandidateSet(some.units.rows[:, :, :size], some.units.cost)
    alone = Objective(own, units, asked.prior[:size, :size], asked.names[:size])
    a, b = (_best(q, budget) / 2.0 for q in (replace(some, criterion=whole), alone))
    return replace(asked, criterion=CompoundVariance(c, size, a, b, name))


def _best(asked: Objective, budget: float) -> float:
    """φ of the continuous optimum."""
    found = relax(
        asked.units, asked.criterion, budget, asked.prior, names=asked.names, tolerance=LOOSE
    )
    return float(found.value)
