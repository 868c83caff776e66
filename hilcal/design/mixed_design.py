"""I-optimality under the mixed model: the mean variance of predictions with all effects.

    y = A b + Z u + e,    (b, u) known before by M = [F G; Gᵀ H],    e ~ N(0, 1)

A, Z are whitened rows of a unit; b are the parameters without a prior, u those with one: of the
model, and of every other effect of the catalogue, each family of the size that arms have
(`Effect.log_std_prior`) or that the readings so far tell. Completing the square,

    A' = A − Z H⁻¹ Gᵀ,    v = H^½ (u + H⁻¹ Gᵀ b) ~ N(0, 1),    b known before by F − G H⁻¹ Gᵀ

are independent. Of v the directions Q that move the units most are kept; the others act as noise,
in each unit by itself:

    rows [A', Z H^−½ Q] whitened by 1 + T Tᵀ,    T = Z H^−½ (1 − Q Qᵀ)

The criterion is 1 / tr(C M⁻¹), C the mean of VᵀV with V the derivative of the predicted positions
by the same coordinates. Source: Chaloner and Verdinelli, *Bayesian experimental design: a review*,
Statistical Science 10 (1995) 273-304.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from hilcal.config import CellConfig
from hilcal.design.criterion import CandidateSet, inverse_factor
from hilcal.design.information import (
    DesignProblem,
    information_of,
    reading_derivatives,
    unit_rows,
)
from hilcal.design.nominal_model import NominalModel, build, expected_std, potential_names
from hilcal.design.predicted import PredictionPoses, position_derivative
from hilcal.effects.protocol import Effect
from hilcal.identification.mixed_fit import HARMONICS, SCATTER_RAD
from hilcal.types import Bools, Floats, Ints

DIRECTIONS = 150  # most of Q; a choice: of a real UR10 (920) the others move 0.5 σ (rms)
SAMPLE = 300  # Candidate poses by which they are found. A choice.
LEAST = 1e-3  # directions that move the units by less, in their noise (rms), are left out


@dataclass(frozen=True, slots=True, eq=False)
class MixedDesign:
    """A design problem in the coordinates (b, Qᵀ v)."""

    units: CandidateSet  # the units of the problem
    prior: Floats  # (P, P) what is known before
    c: Floats  # (P, P) C, m²
    names: tuple[str, ...]  # of b, then of Qᵀ v by number; by number alone of `balanced`


def mixed_design(of: DesignProblem, config: CellConfig, work: PredictionPoses) -> MixedDesign:
    """Return the design problem of predictions with all effects."""
    nominal, config = of.nominal, _with_scatter(of.nominal, config)
    more, std = other_effects(nominal, config)
    prior_std = nominal.prior_std[nominal.live]
    flat = np.concatenate([np.isinf(prior_std), np.zeros(len(std), dtype=bool)])
    own = np.where(np.isinf(prior_std), of.scale[: len(prior_std)], prior_std)
    scale = np.concatenate([own, std])
    known = information_of(nominal, more, scale) + np.diag(~flat)

    def whole_rows(step: int = 1) -> Iterator[tuple[Ints, Floats]]:
        """Rows of the units of every `step`-th pose, with the columns of all effects."""
        some = of.candidates[slice(None, None, step)]
        parts = reading_derivatives(nominal, config, some, more, scale)
        return unit_rows(parts, of.candidates.loads, of.what, of.mode, step)

    sample = whole_rows(max(1, len(of.candidates) // SAMPLE))
    coordinates = _coordinates(known, flat, sample)
    count = int(flat.sum()) + coordinates.random.shape[1]
    rows = np.zeros((*of.units.rows.shape[:2], count))
    for place, some in whole_rows():
        rows[place, : some.shape[1]] = coordinates.whitened(some)
    v = coordinates.columns(position_derivative(nominal, work, more, scale)).reshape(-1, count)
    prior = np.eye(count)
    prior[: coordinates.flat.shape[1], : coordinates.flat.shape[1]] = coordinates.prior
    names = [t.name for t, free in zip(of.terms, flat, strict=False) if free]
    names += [f"direction {k}" for k in range(1, coordinates.random.shape[1] + 1)]
    c = v.T @ v / len(work.q)
    return MixedDesign(CandidateSet(rows, of.units.cost), prior, c, tuple(names))


def balanced(of: MixedDesign) -> MixedDesign:
    """Return the problem in coordinates in which all units together tell as much of each.

    tr(C M⁻¹) is the same in any; after a fit some directions are known 10⁶ times as well as others,
    and rounding would decide. Where they determine nothing of one it stays as it is, by its name.
    """
    units = of.units
    every = of.prior + units.information(np.full(len(units), 1.0 / len(units)))
    size = np.sqrt(np.diag(every))
    if not np.all(size > 0):
        return of
    found = inverse_factor(every / np.outer(size, size))
    if found is None:
        return of
    turn = np.linalg.cholesky(found[0] @ found[0].T) / size[:, None]
    rows = units.rows @ turn
    names = tuple(f"direction {k}" for k in range(1, len(size) + 1))
    prior, c = (0.5 * (m + m.T) for m in (turn.T @ m @ turn for m in (of.prior, of.c)))
    return MixedDesign(CandidateSet(rows, units.cost), prior, c, names)


def other_effects(nominal: NominalModel, config: CellConfig) -> tuple[tuple[Effect, ...], Floats]:
    """Return the effects beside the model, and the standard deviations of their parameters, SI.

    Those of `[planning] against`; none where a fit has a background, which holds them already.
    """
    model, known = nominal.model, nominal.model.catalogue
    names = () if model.background else potential_names(config, model)
    finest = {
        name: {"harmonics": HARMONICS} for name in names if "harmonics" in known[name].option_help
    }
    more = tuple(
        build(known, name, nominal.cell, nominal.m, finest.get(name, {})) for name in names
    )
    return more, expected_std(model, more)


def _with_scatter(nominal: NominalModel, config: CellConfig) -> CellConfig:
    """Return the configuration with the arm's repeatability: stated, estimated or ordinary."""
    stated = config.repeatability.per_joint(nominal.cell.arm.n)
    if np.any(stated):
        return config
    std: tuple[float, ...] = (SCATTER_RAD,)
    found = None if nominal.fit is None else nominal.fit.readings.arm_scatter
    if found is not None and found.kind != "isotropic":
        std = found.std
    each = std if len(std) > 1 else std[0]
    repeatability = config.repeatability.model_copy(update={"joint_std_rad": each})
    return config.model_copy(update={"repeatability": repeatability})


@dataclass(frozen=True, slots=True, eq=False)
class _Coordinates:
    """The change of coordinates."""

    flat: Floats  # (P, b) columns of A' by those of all parameters
    random: Floats  # (P, r) columns Z H^−½ Q
    root: Floats  # (P, u) columns Z H^−½
    prior: Floats  # (b, b) F − G H⁻¹ Gᵀ

    def columns(self, rows: Floats) -> Floats:
        return np.concatenate([rows @ self.flat, rows @ self.random], axis=-1)

    def whitened(self, rows: Floats) -> Floats:
        """(k, R, b + r) of units (k, R, P), with the other directions as noise."""
        whole, kept = rows @ self.root, rows @ self.random
        noise = whole @ np.swapaxes(whole, 1, 2) - kept @ np.swapaxes(kept, 1, 2)
        noise += np.eye(rows.shape[1])
        low = np.linalg.cholesky(noise)
        return np.asarray(np.linalg.solve(low, np.concatenate([rows @ self.flat, kept], axis=-1)))


def _coordinates(known: Floats, flat: Bools, sample: Iterable[tuple[Ints, Floats]]) -> _Coordinates:
    """Complete the square, and find the directions that move the units most."""
    size, free = len(known), np.flatnonzero(flat)
    held = np.flatnonzero(~flat)
    g = known[np.ix_(free, held)]
    factor = cho_factor(known[np.ix_(held, held)], lower=True)
    lifted = cho_solve(factor, g.T)
    columns = np.zeros((size, len(free)))
    columns[free, np.arange(len(free))] = 1.0
    columns[held] = -lifted
    root = np.zeros((size, len(held)))
    root[held] = solve_triangular(factor[0], np.eye(len(held)), lower=True).T
    gram, elements = np.zeros((len(held), len(held))), 0
    for _, rows in sample:
        moved = rows @ root
        gram += np.einsum("kri,krj->ij", moved, moved, optimize=True)
        elements += moved.shape[0] * moved.shape[1]
    values, vectors = np.linalg.eigh(gram / max(elements, 1))
    kept = np.flatnonzero(values > LEAST**2)[-DIRECTIONS:]
    prior = known[np.ix_(free, free)] - g @ lifted
    return _Coordinates(columns, root @ vectors[:, kept], root, (prior + prior.T) / 2)
