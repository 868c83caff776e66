"""Minimum detectable strength of the effects that a plan's model does not have."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hilcal.config import CellConfig
from hilcal.design.candidates import reading_derivatives
from hilcal.design.planner import Planned
from hilcal.regression.schur import schur_complement
from hilcal.regression.spectrum import VISIBLE

DRAWS = 5
"""Random directions of an effect whose median is its minimum detectable strength. A choice."""
_SEED = 20240611


@dataclass(frozen=True, slots=True)
class DetectableEffect:
    """Minimum detectable strength of an effect outside of the model.

    Attributes:
        effect: its name.
        least_m: rms displacement of the target, m, whose whitened residual after fitting the
            model is one sigma; None where the model absorbs the effect.
    """

    effect: str
    least_m: float | None


def detectable_effects(planned: Planned, config: CellConfig) -> Iterator[DetectableEffect]:
    """Yield the minimum detectable strength of each effect outside of the model.

    Of some directions of the effect's parameters the median: rms of the displacement, over the
    plan's poses and loads, divided by the root of the non-centrality beyond the model.
    """
    of, size = planned.problem, planned.problem.model_size
    taken = np.flatnonzero(planned.counts)
    information = of.measured + of.units.information(planned.counts[taken], taken)
    model = of.prior[:size, :size] - of.measured[:size, :size]
    information[:size, :size] += model
    poses = sorted({of.what[k][0] for k in taken})
    chosen = type(of.candidates)(
        of.candidates.q[poses],
        of.candidates.loads,
        of.candidates.wrench,
        of.candidates.allowed[poses],
    )
    moves = [
        part.jacobian[:, 1:] - part.jacobian[:, :1] if of.mode == "deflection" else part.jacobian
        for part in reading_derivatives(of.nominal, config, chosen, of.families, of.scale)
    ]
    moved = np.concatenate([block[..., :3, :].reshape(-1, len(of.terms)) for block in moves])
    rng = np.random.default_rng(_SEED)
    for effect in of.families:
        where = of.of_effect(effect.name)
        left = schur_complement(information, where, np.arange(size))
        least = []
        for _ in range(DRAWS):
            beta = rng.standard_normal(len(where))
            apart = float(beta @ left @ beta)
            size_m = float(np.sqrt(3.0 * np.mean((moved[:, where] @ beta) ** 2)))
            least.append(size_m / np.sqrt(apart) if apart > VISIBLE * len(where) else np.inf)
        smallest = float(np.median(least))
        yield DetectableEffect(effect.name, smallest if np.isfinite(smallest) else None)
