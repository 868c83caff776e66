"""What a campaign taught of an arm: the posterior of the arm's own parameters.

Of a fit with the whitened Jacobian A (R, P) of all its parameters, those of dropped families
included,

    M = (AᵀA/σ² + Λ)/κ

is the information: Λ the precision of the effects' own priors, σ² the noise factor, κ ≥ 1 by how
much poses left out were farther off than the parameters explain. The strengths of shrunk families
are those of `predictive.family_prior`: a harmonic that the readings did not need is not known to be
zero where nobody measured. Parameters of the setup (frames, tool, instruments; `Effect.of_setup`),
which another campaign does not have, are marginalised out, by the Schur complement of M.

What the readings did not determine has no information: not a large variance, and not a zero one.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hilcal.readings.arm_scatter import ArmScatter
from hilcal.readings.ranges import Range
from hilcal.readings.whitening import Mode
from hilcal.regression.normal_equations import INFORMATION, NULL_SHARE
from hilcal.regression.schur import schur_complement
from hilcal.shown import Brief
from hilcal.types import Floats, Ints

if TYPE_CHECKING:
    from hilcal.identification.fit import Fit


@dataclass(frozen=True, slots=True)
class Source:
    """Where a posterior is from.

    Attributes:
        campaign: name of the file; empty where it is from none.
        revision: its revision; 0 for a fit that is not stored.
        created: when that was fitted, ISO 8601, UTC.
        readings_sha256: `content_hash` of the readings.
        n_readings: how many were fitted.
    """

    campaign: str = ""
    revision: int = 0
    created: str = ""
    readings_sha256: str = ""
    n_readings: int = 0


@dataclass(frozen=True, slots=True)
class PosteriorEffect:
    """An effect of the arm, by name and options."""

    name: str
    options: Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Posterior(Brief):
    """A normal distribution of K parameters of an arm, in information form.

    >>> with hc.Campaign.open(RUN) as run:
    ...     found = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
    >>> posterior = hc.Posterior.of(found)
    >>> posterior.names[1], bool(posterior.std[1] < 0.1 * posterior.mean[1])
    ('joint_compliance.j2', True)

    Attributes:
        arm: name of the arm.
        links: (n + 1, 4, 4) its nominal link transforms, which the parameters refer to.
        mode: kind of readings that it was learnt from.
        effects: the effects, in the order of the parameters.
        names: (K,) "effect.parameter".
        units: (K,).
        scale: (K,) ordinary magnitudes, SI.
        mean: (K,) SI; of no meaning along directions without information.
        information: (K, K) inverse covariance, singular where nothing was determined, 1/SI².
        own_precision: (K,) the part of its diagonal that is not from the readings but from the
            effects' own priors, as the strengths of families.
        scatter: the arm's scatter, where it was estimated.
        ranges: in what ranges the readings were taken.
        prints: (M, n + 4) what the readings are known by again; see `same_readings.prints`.
        source: where it is from.
    """

    arm: str
    links: Floats
    mode: Mode
    effects: tuple[PosteriorEffect, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    scale: Floats
    mean: Floats
    information: Floats
    own_precision: Floats
    scatter: ArmScatter | None
    ranges: tuple[Range, ...]
    prints: Floats
    source: Source

    @classmethod
    def of(cls, fit: "Fit", source: Source | None = None) -> "Posterior":
        """Return what a fit taught of its arm.

        Args:
            fit: gc-scaled.
            source: where it is from; the hash and the number of its readings are filled in.

        Raises:
            InputError: a fit of another scaling than gc.
            CannotAnswerError: a model without any effect of the arm.
        """
        from hilcal.identification.posterior_of_fit import posterior_of

        return posterior_of(fit, source)

    def to_json(self) -> dict[str, object]:
        """Return it as JSON, SI, exactly; see `posterior_document`."""
        from hilcal.identification.posterior_document import to_json

        return to_json(self)

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Posterior":
        """Return what `to_json` wrote.

        Raises:
            InputError: another kind of document, or a newer version.
        """
        from hilcal.identification.posterior_document import from_json

        return from_json(content)

    def index(self, effect: str) -> Ints:
        """Indices of the parameters of an effect; none where it is not among them."""
        of = [name.split(".", 1)[0] == effect for name in self.names]
        return np.flatnonzero(of)

    def marginal(self, parameters: Ints) -> Floats:
        """Information (I, I) on some parameters, the others not known: the Schur complement."""
        scaled = self.information * (self.scale[:, None] * self.scale)
        some = schur_complement(scaled, parameters)
        mine = self.scale[parameters]
        return determined(some) / (mine[:, None] * mine)

    @property
    def std(self) -> Floats:
        """(K,) standard deviations, SI; infinite where a direction without information enters."""
        values, vectors = np.linalg.eigh(self.information * (self.scale[:, None] * self.scale))
        seen = values > INFORMATION**2 / 2
        std = np.sqrt(np.sum(vectors[:, seen] ** 2 / values[seen], axis=1))
        moved = np.linalg.norm(vectors[:, ~seen], axis=1)
        return np.where(moved <= NULL_SHARE * std, std * self.scale, np.inf)


def determined(information: Floats) -> Floats:
    """Information (K, K), in ordinary magnitudes, without directions that are hardly determined.

    A fit holds those where they are whose information is below `INFORMATION`², see
    `regression.normal_equations`: where they stand was not learnt.
    """
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    values[values < INFORMATION**2] = 0.0
    root = vectors * np.sqrt(values)
    found = root @ root.T
    return np.asarray((found + found.T) / 2)
