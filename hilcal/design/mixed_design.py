"""I-optimality under the mixed model: the mean variance of predictions with all effects.

    y = A b + Z u + e,    (b, u) with prior information M = [F G; Gᵀ H],    e ~ N(0, 1)

A, Z are the whitened rows of a unit. b are the parameters without a prior; u are those with a
prior, of the model and of every other effect of the catalogue. The size of a family is the one
usual for arms (`Effect.log_std_prior`) or the estimate of the readings so far. Complete the square:

    A' = A − Z H⁻¹ Gᵀ,    v = H^½ (u + H⁻¹ Gᵀ b) ~ N(0, 1),    b with information F − G H⁻¹ Gᵀ

b and v are independent. The directions Q of v that move the units most are retained; the others act
as noise, independent between units:

    rows [A', Z H^−½ Q] whitened by 1 + T Tᵀ,    T = Z H^−½ (1 − Q Qᵀ)

The criterion is 1 / tr(C M⁻¹), C the mean of VᵀV, V the derivative of predicted positions by the
same coordinates. Source: Chaloner and Verdinelli, *Bayesian experimental design: a review*,
Statistical Science 10 (1995) 273-304.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from hilcal.config import CellConfig
from hilcal.design.criteria import MeanVariance
from hilcal.design.criterion import CandidateSet, Objective, inverse_factor
from hilcal.design.information import DesignProblem, information_of, reading_derivatives, unit_rows
from hilcal.design.nominal_model import NominalModel, build_effect, expected_std, potential_names
from hilcal.design.predicted import PredictionPoses, position_derivative
from hilcal.effects.protocol import Effect
from hilcal.identification.mixed_fit import HARMONICS, SCATTER_RAD
from hilcal.types import Bools, Floats, Ints

DIRECTIONS = 150  # in Q at most; a choice: of a real UR10 (920) the others move 0.5 σ (rms)
SAMPLE = 300  # candidate poses that determine Q; a choice
LEAST = 1e-3  # least motion of the units by a direction of Q, RMS, over the noise


def mixed_design(problem: DesignProblem, config: CellConfig, work: PredictionPoses) -> Objective:
    """Return the objective of predictions with all effects, in the coordinates (b, Qᵀ v)."""
    nominal = problem.nominal
    if not np.any(config.repeatability.per_joint(nominal.cell.arm.n)):  # not stated
        config = _with_scatter(nominal, config)
    effects, std = other_effects(nominal, config)
    prior_std = nominal.prior_std[nominal.live]
    flat = np.concatenate([np.isinf(prior_std), np.zeros(len(std), dtype=bool)])
    model_scale = np.where(np.isinf(prior_std), problem.scale[: len(prior_std)], prior_std)
    scale = np.concatenate([model_scale, std])
    information = information_of(nominal, effects, scale) + np.diag(~flat)

    def all_rows(step: int = 1) -> Iterator[tuple[Ints, Floats]]:
        """Yield rows of the units of every `step`-th pose, with the columns of all effects."""
        poses = problem.candidates[slice(None, None, step)]
        parts = reading_derivatives(nominal, config, poses, effects, scale)
        return unit_rows(parts, problem.candidates.loads, problem.contents, problem.mode, step)

    sample = all_rows(max(1, len(problem.candidates) // SAMPLE))
    coordinates = _coordinates(information, flat, sample)
    count = int(flat.sum()) + coordinates.random.shape[1]
    rows = np.zeros((*problem.units.rows.shape[:2], count))
    for members, part in all_rows():
        rows[members, : part.shape[1]] = coordinates.whitened(part)
    v = coordinates.columns(position_derivative(nominal, work, effects, scale)).reshape(-1, count)
    prior = np.eye(count)
    prior[: coordinates.flat.shape[1], : coordinates.flat.shape[1]] = coordinates.prior
    names = [t.name for t, free in zip(problem.terms, flat, strict=False) if free]
    names += [f"direction {k}" for k in range(1, coordinates.random.shape[1] + 1)]
    c = v.T @ v / len(work.q)
    units = CandidateSet(rows, problem.units.cost)
    return Objective(units, MeanVariance(c), prior, tuple(names))


def balanced(design: Objective) -> Objective:
    """Return an objective in coordinates in which the information of all units is the identity.

    tr(C M⁻¹) does not depend on coordinates. After a fit, some directions are known 10⁶ times as
    well as others, and rounding would decide. An objective that leaves a coordinate undetermined is
    returned unchanged, with its names.
    """
    units, criterion = design.units, design.criterion
    assert isinstance(criterion, MeanVariance)  # noqa: S101  (of `mixed_design`)
    total = design.information(np.full(len(units), 1.0 / len(units)))
    size = np.sqrt(np.diag(total))
    if not np.all(size > 0):
        return design
    inverted = inverse_factor(total / np.outer(size, size))
    if inverted is None:
        return design
    turn = np.linalg.cholesky(inverted[0] @ inverted[0].T) / size[:, None]
    turned = CandidateSet(units.rows @ turn, units.cost)
    names = tuple(f"direction {k}" for k in range(1, len(size) + 1))
    prior, c = (turn.T @ m @ turn for m in (design.prior, criterion.c))
    return Objective(turned, MeanVariance(0.5 * (c + c.T)), 0.5 * (prior + prior.T), names)


def other_effects(nominal: NominalModel, config: CellConfig) -> tuple[tuple[Effect, ...], Floats]:
    """Return the effects of `[planning] against`, and standard deviations of their parameters, SI.

    No effects if the fit has a background, which includes them.
    """
    model, catalogue = nominal.model, nominal.model.catalogue
    names = () if model.background else potential_names(config, model)
    periodic = [name for name in names if "harmonics" in catalogue[name].option_help]
    finest = {name: {"harmonics": HARMONICS} for name in periodic}
    cell, m = nominal.cell, nominal.m
    effects = tuple(build_effect(catalogue, name, cell, m, finest.get(name, {})) for name in names)
    return effects, expected_std(model, effects)


def _with_scatter(nominal: NominalModel, config: CellConfig) -> CellConfig:
    """Return the configuration with the arm's repeatability: estimated or ordinary."""
    std: tuple[float, ...] = (SCATTER_RAD,)
    scatter = None if nominal.fit is None else nominal.fit.readings.arm_scatter
    if scatter is not None and scatter.kind != "isotropic":
        std = scatter.std
    per_joint = std if len(std) > 1 else std[0]
    return config.with_keys("repeatability", joint_std_rad=per_joint)


@dataclass(frozen=True, slots=True, eq=False)
class _Coordinates:
    """The change of coordinates."""

    flat: Floats  # (P, b) columns of A' in terms of all columns
    random: Floats  # (P, r) columns Z H^−½ Q
    root: Floats  # (P, u) columns Z H^−½
    prior: Floats  # (b, b) F − G H⁻¹ Gᵀ

    def columns(self, rows: Floats) -> Floats:
        return np.concatenate([rows @ self.flat, rows @ self.random], axis=-1)

    def whitened(self, rows: Floats) -> Floats:
        """Return (k, R, b + r) of units (k, R, P), with the directions outside of Q as noise."""
        full, retained = rows @ self.root, rows @ self.random
        noise = full @ np.swapaxes(full, 1, 2) - retained @ np.swapaxes(retained, 1, 2)
        noise += np.eye(rows.shape[1])
        both = np.concatenate([rows @ self.flat, retained], axis=-1)
        return np.asarray(np.linalg.solve(np.linalg.cholesky(noise), both))


def _coordinates(
    information: Floats, flat: Bools, sample: Iterable[tuple[Ints, Floats]]
) -> _Coordinates:
    """Complete the square, and find the directions Q that move the units most."""
    size, free = len(information), np.flatnonzero(flat)
    random = np.flatnonzero(~flat)
    g = information[np.ix_(free, random)]
    factor = cho_factor(information[np.ix_(random, random)], lower=True)
    lifted = cho_solve(factor, g.T)
    columns = np.zeros((size, len(free)))
    columns[free, np.arange(len(free))] = 1.0
    columns[random] = -lifted
    root = np.zeros((size, len(random)))
    root[random] = solve_triangular(factor[0], np.eye(len(random)), lower=True).T
    gram, elements = np.zeros((len(random), len(random))), 0
    for _, rows in sample:
        moved = rows @ root
        gram += np.einsum("kri,krj->ij", moved, moved, optimize=True)
        elements += moved.shape[0] * moved.shape[1]
    values, vectors = np.linalg.eigh(gram / max(elements, 1))
    retained = np.flatnonzero(values > LEAST**2)[-DIRECTIONS:]
    prior = information[np.ix_(free, free)] - g @ lifted
    return _Coordinates(columns, root @ vectors[:, retained], root, (prior + prior.T) / 2)
