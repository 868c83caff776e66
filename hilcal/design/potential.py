"""Potential terms: effects that the model lacks, and a plan should still be able to find.

Their parameters get a prior N(0, τ²), with τ so that the family's RMS strength over the
candidates is one σ of a reading: as much as could be there without being known. A plan is then
judged on all parameters together, so that it keeps power against what is missing. Source:
DuMouchel and Jones, *A simple Bayesian modification of D-optimal designs to reduce dependence
on an assumed model*, Technometrics 36 (1994) 37-47.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hilcal.config import CellConfig
from hilcal.design.candidates import (
    Candidates,
    absolute_rows,
    deflection_rows,
    reading_derivatives,
    sizes,
)
from hilcal.design.nominal_model import NominalModel, build, potential_names, random_columns
from hilcal.effects.protocol import Effect
from hilcal.types import Floats

MOST_PARAMETERS = 200
SAMPLE = 300
"""Candidate poses by which strengths are judged. A choice."""
MOST_ORDINARY = 5.0
"""A family that reaches one σ only with more than so many ordinary magnitudes is left out.
A choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Potential:
    """Families with τ in ordinary magnitudes, and what was left out, one line each."""

    effects: tuple[Effect, ...]
    tau: tuple[float, ...]
    notes: tuple[str, ...]

    @property
    def scale(self) -> Floats:
        """(F,) what τ is for each parameter, SI."""
        parts = [
            tau * np.array([p.scale for p in e.parameters])
            for e, tau in zip(self.effects, self.tau, strict=True)
        ]
        return np.concatenate([np.zeros(0), *parts])


def potential(nominal: NominalModel, config: CellConfig, of: Candidates) -> Potential:
    """Choose the families of `[planning] against` and how strong they could be.

    Raises:
        InputError: an unknown effect (lists the valid ones).
    """
    names = potential_names(config, nominal.model)
    known = nominal.model.catalogue
    families = tuple(build(known, name, nominal.cell, nominal.m) for name in names)
    strength = _strengths(nominal, config, of, families)
    chosen: list[tuple[Effect, float]] = []
    notes = [*random_columns(families)]
    room = MOST_PARAMETERS - len(nominal.live)
    order = sorted(range(len(families)), key=lambda k: len(families[k].parameters))
    for k in order:
        family, rms = families[k], strength[k]
        if rms * MOST_ORDINARY < 1.0:
            notes.append(
                f"{family.name}: not planned for; with {MOST_ORDINARY:g} times its ordinary "
                f"magnitude it would change these readings by {MOST_ORDINARY * rms:.2g} σ"
            )
        elif len(family.parameters) > room:
            notes.append(
                f"{family.name}: not planned for; its {len(family.parameters)} parameters would "
                f"make more than {MOST_PARAMETERS}"
            )
        else:
            room -= len(family.parameters)
            chosen.append((family, 1.0 / rms))
    chosen.sort(key=lambda pair: names.index(pair[0].name))
    return Potential(tuple(e for e, _ in chosen), tuple(t for _, t in chosen), tuple(notes))


def _strengths(
    nominal: NominalModel, config: CellConfig, of: Candidates, families: tuple[Effect, ...]
) -> list[float]:
    """RMS of each family's whitened readings (single deflections) at ordinary magnitudes."""
    if not families:
        return []
    sample = of[slice(None, None, -(-len(of) // SAMPLE))]
    ordinary = np.array(
        [p.scale for e in (*nominal.model.effects, *families) for p in e.parameters]
    )
    live = np.concatenate([nominal.live, nominal.model.size + np.arange(sizes(families))])
    squares, count = np.zeros(len(live)), 0
    for part in reading_derivatives(nominal, config, sample, families, ordinary[live]):
        allowed = sample.allowed[part.rows]
        if config.planning.readings == "absolute":
            rows = [absolute_rows(part)[allowed]]
        else:
            rows = [
                deflection_rows(part, np.flatnonzero(allowed[:, 0] & allowed[:, k]), (k,))
                for k in range(1, len(of.loads))
            ]
        for r in rows:
            squares += np.sum(r**2, axis=(0, 1))
            count += r.shape[0] * r.shape[1]
    ends = len(nominal.live) + np.cumsum([0, *(len(e.parameters) for e in families)])
    sums = [float(squares[a:b].sum()) for a, b in pairwise(ends)]
    return [float(np.sqrt(s / max(count, 1))) for s in sums]
