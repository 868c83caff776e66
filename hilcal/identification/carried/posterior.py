"""The posterior of an arm's own parameters after a campaign.

Of a fit with the whitened Jacobian A (R, P) of all its parameters, those of dropped families
included,

    M = (AᵀA/σ² + Λ)/κ

is the information: Λ the precision of the effects' own priors, σ² the noise factor, κ ≥ 1 by how
much errors at poses left out exceed what the parameters explain. The strengths of shrunk families
are those of `predictive.family_prior`. Parameters of the setup (frames, tool, instruments;
`Effect.of_setup`) are marginalised out, by the Schur complement of M. What the readings did not
determine has no information: not a large variance, and not a zero one.

Two campaigns of one arm are compared in the same gauge (`parameter_differences`). Their likelihoods
of the parameters that both have, all others marginalised out, have the information I_A and I_B;
that on d = θ_B − θ_A is the parallel sum (Anderson and Duffin, J. Math. Anal. Appl. 26 (1969) 576)

    P = I_A (I_A + I_B)⁻ I_B

singular along every direction that one of the campaigns did not determine: what a frame absorbs, or
a joint that did not turn. So each parameter, and each effect as a whole, is compared with all
others free within f = `FARTHEST` of their ordinary magnitudes: in these,
S = ((P + 1/f²)⁻¹_mm)⁻¹ − 1/f² is the information on its difference. What is known less well than
to one magnitude is not compared.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from hilcal import __version__, limits
from hilcal.readings.readings import ArmScatter, Range
from hilcal.readings.whitening import Mode
from hilcal.regression.normal_equations import INFORMATION, NULL_SHARE
from hilcal.regression.schur import schur_complement
from hilcal.regression.variance_components import FARTHEST
from hilcal.shown import Brief
from hilcal.store.codec import decode, encode, pack, read_document, read_file, unpack
from hilcal.types import Floats, Ints

if TYPE_CHECKING:
    from hilcal.identification.fit import Fit


FORMAT, VERSION = "hilcal-posterior", 1
LEAST_INFORMATION = INFORMATION**2 / 2
"""Least information on a determined direction, in ordinary magnitudes."""
MOST_LISTED = 60  # parameters from which an effect is compared only as a whole; a choice


@dataclass(frozen=True, slots=True)
class Source:
    """Where a posterior is from."""

    campaign: str = ""  # name of the file; empty where it is from none
    revision: int = 0  # 0 for a fit that is not stored
    created: str = ""  # when that was fitted, ISO 8601, UTC
    readings_sha256: str = ""  # `content_hash` of the readings
    n_readings: int = 0  # how many were fitted


@dataclass(frozen=True, slots=True)
class PosteriorEffect:
    """An effect of the arm, by name and options."""

    name: str
    options: Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Posterior(Brief):
    """A normal distribution of K parameters of an arm, in information form.

    >>> with hc.Campaign.open(RUN) as run:
    ...     fit = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
    >>> posterior = hc.Posterior.of(fit)
    >>> posterior.names[1], bool(posterior.std[1] < 0.1 * posterior.mean[1])
    ('joint_compliance.j2', True)

    Attributes:
        arm: name of the arm.
        links: (n + 1, 4, 4) its nominal link transforms, which the parameters refer to.
        mode: kind of readings that were fitted.
        effects: the effects, in the order of the parameters.
        names: (K,) "effect.parameter".
        units: (K,).
        scale: (K,) ordinary magnitudes, SI.
        mean: (K,) SI; of no meaning along directions without information.
        information: (K, K) inverse covariance, singular where nothing was determined, 1/SI².
        own_precision: (K,) the part of its diagonal that is not from the readings but from the
            effects' own priors, as the strengths of families.
        scatter: the arm's scatter, where it was estimated.
        ranges: ranges of the readings.
        prints: (M, n + 4) what identifies the readings; see `same_readings.prints`.
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
        """Return the posterior of the arm's parameters after a fit, with a hash of its readings.

        Raises:
            InputError: a fit of another scaling than gc.
            CannotAnswerError: a model without any effect of the arm.
        """
        from hilcal.identification.prediction.predictive import posterior_of

        return posterior_of(fit, source)

    def to_json(self) -> dict[str, object]:
        """Return the posterior as JSON, SI; large arrays as base64 of doubles, none rounded."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "hilcal": __version__,
            "arm": self.arm,
            "readings": self.mode,
            "parameters": list(self.names),
            "information": pack(self.information[np.tril_indices(len(self.mean))]),
            "arm_scatter": encode(self.scatter),
            "prints": {"columns": self.prints.shape[1], "values": pack(self.prints)},
            **{
                k: encode(getattr(self, k))
                for k in ("links", "source", "effects", "units", "ranges")
            },
            **{k: encode(getattr(self, k)) for k in ("scale", "mean", "own_precision")},
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Posterior":
        """Return what `to_json` wrote; an InputError for another, newer or damaged document."""
        return read_document(content, "prior", FORMAT, (VERSION,), _read)

    def index(self, effect: str) -> Ints:
        """Indices of the parameters of an effect; none where it is not among them."""
        return np.flatnonzero([name.split(".", 1)[0] == effect for name in self.names])

    def marginal(self, parameters: Ints) -> Floats:
        """Information (I, I), 1/SI², the others marginalised out; see `information_on`."""
        scaled = self.information * (self.scale[:, None] * self.scale)
        scale = self.scale[parameters]
        return determined(information_on(scaled, parameters)) / (scale[:, None] * scale)

    @property
    def std(self) -> Floats:
        """(K,) standard deviations, SI; infinite where a direction without information enters."""
        values, vectors = spectrum(self.information * (self.scale[:, None] * self.scale))
        informed = values > 0
        std = np.sqrt(np.sum(vectors[:, informed] ** 2 / values[informed], axis=1))
        moved = np.linalg.norm(vectors[:, ~informed], axis=1)
        return np.where(moved <= NULL_SHARE * std, std * self.scale, np.inf)


def read_posterior(path: Path) -> Posterior:
    """Read a posterior from a JSON file."""
    return read_file(path, "prior", Posterior.from_json)


def _read(content: Mapping[str, Any]) -> Posterior:
    count, columns = len(content["parameters"]), int(content["prints"]["columns"])
    limits.check_parameters(count)
    lower = np.zeros((count, count))
    lower[np.tril_indices(count)] = unpack(content["information"])
    named = {
        "mode": content["readings"],
        "names": content["parameters"],
        "information": lower + np.tril(lower, -1).T,
        "scatter": content["arm_scatter"],
        "prints": unpack(content["prints"]["values"]).reshape(-1, columns),
    }
    p: Posterior = decode(Posterior, {**content, **named})
    if len(p.units) != count or len(set(p.names)) != count or columns < 5:
        raise ValueError("its arrays do not fit its parameters")
    shapes = {a.shape for a in (p.mean, p.scale, p.own_precision)}
    if shapes != {(count,)} or p.links.shape != (columns - 3, 4, 4):
        raise ValueError("its arrays do not fit its arm and parameters")
    numbers = (p.information, p.links, p.prints, p.mean, p.scale, p.own_precision)
    if not all(np.isfinite(a).all() for a in numbers):
        raise ValueError("numbers that are not finite")
    if np.any(p.scale <= 0) or np.any(p.own_precision < 0):
        raise ValueError("a magnitude that is not positive, or a negative precision")
    return p


def spectrum(information: Floats, least: float = LEAST_INFORMATION) -> tuple[Floats, Floats]:
    """Eigenvalues (K,), zero where hardly anything is determined, and vectors of information."""
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    values[values < least] = 0.0
    return values, vectors


def information_on(information: Floats, parameters: Ints) -> Floats:
    """Information (I, I) on some parameters, the others marginalised out, in ordinary magnitudes.

    It is the Schur complement of the information (K, K), to which a prior of `FARTHEST` ordinary
    magnitudes on the others is added: with a flat prior, a parameter that moves along a gauge
    direction of the others, however little, would have no information at all.
    """
    others = np.ones(len(information))
    others[parameters] = 0.0
    return schur_complement(information + np.diag(others) / FARTHEST**2, parameters)


def determined(information: Floats) -> Floats:
    """Information (K, K), in ordinary magnitudes, without directions that are hardly determined.

    A fit holds those below `INFORMATION`² where they are: their values were not estimated.
    """
    values, vectors = spectrum(information, INFORMATION**2)
    root = vectors * np.sqrt(values)
    out = root @ root.T
    return np.asarray((out + out.T) / 2)


@dataclass(frozen=True, slots=True)
class ParameterDifference:
    """One parameter in both fits, SI."""

    name: str  # effect and parameter
    unit: str
    before: float  # of the earlier fit
    after: float  # of the later fit
    difference: float
    std: float | None  # None where frames absorb it or a campaign does not determine it

    @property
    def z(self) -> float | None:
        """Difference over its standard deviation."""
        return None if self.std is None else self.difference / self.std


@dataclass(frozen=True, slots=True)
class EffectDifference:
    """All parameters of an effect in both fits."""

    effect: str
    chi2: float  # dᵀ S d along the directions that can be compared
    rank: int  # degrees of freedom
    p_value: float


@dataclass(frozen=True, slots=True)
class Differences:
    """Two fits of one arm."""

    rows: tuple[ParameterDifference, ...]  # of effects with fewer than `MOST_LISTED`
    effects: tuple[EffectDifference, ...]  # each effect that both have
    not_in_both: tuple[str, ...]  # effects that only one of them has, or with other parameters

    def to_dict(self) -> dict[str, object]:
        """Return them as JSON, SI."""
        return {
            "rows": [{**asdict(r), "z": r.z} for r in self.rows],
            "effects": [asdict(e) for e in self.effects],
            "not_in_both": list(self.not_in_both),
        }


def parameter_differences(earlier: Posterior, later: Posterior) -> Differences:
    """Compare the parameters that two fits have in common."""
    common = [n for n in earlier.names if n in set(later.names)]
    i, j = (np.array([p.names.index(n) for n in common], dtype=np.int64) for p in (earlier, later))
    owner = [n.split(".", 1)[0] for n in common]
    every = dict.fromkeys(n.split(".", 1)[0] for n in (*earlier.names, *later.names))
    sizes = {e: {len(earlier.index(e)), len(later.index(e))} for e in every}
    not_in_both = tuple(e for e, size in sizes.items() if size != {owner.count(e)})
    if not common:
        return Differences((), (), not_in_both)
    scale = earlier.scale[i]
    first, mean_earlier = _likelihood(earlier, i, scale)
    second, mean_later = _likelihood(later, j, scale)
    values, vectors = spectrum(first + second)
    half = vectors[:, values > 0] / np.sqrt(values[values > 0])
    parallel = (first @ half) @ (half.T @ second)
    regularised = (parallel + parallel.T) / 2 + np.eye(len(common)) / FARTHEST**2
    covariance = np.asarray(np.linalg.inv(regularised), dtype=float)
    information = 1.0 / np.diag(covariance) - 1.0 / FARTHEST**2
    d, names = np.asarray(mean_later - mean_earlier, dtype=float), np.array(owner)
    effects = [_effect(e, covariance, d, np.flatnonzero(names == e)) for e in dict.fromkeys(owner)]
    rows = tuple(
        ParameterDifference(
            name=name,
            unit=earlier.units[i[k]],
            before=float(earlier.mean[i[k]]),
            after=float(later.mean[j[k]]),
            difference=float(scale[k] * d[k]),
            std=float(scale[k] / np.sqrt(information[k])) if information[k] > 1.0 else None,
        )
        for k, name in enumerate(common)
        if owner.count(owner[k]) < MOST_LISTED
    )
    return Differences(rows, tuple(effects), not_in_both)


def _likelihood(p: Posterior, chosen: Ints, scale: Floats) -> tuple[Floats, Floats]:
    """Information (K, K) and mean (K,) by the readings alone, in ordinary magnitudes."""
    information = p.information * (p.scale[:, None] * p.scale)
    values, vectors = spectrum(information - np.diag(p.own_precision * p.scale**2))
    e, values = vectors[:, values > 0], values[values > 0]
    data, mean = (e * values) @ e.T, (e / values) @ (e.T @ (information @ (p.mean / p.scale)))
    ratio = p.scale[chosen] / scale
    return information_on(data, chosen) / (ratio[:, None] * ratio), mean[chosen] * ratio


def _effect(effect: str, covariance: Floats, d: Floats, rows: Ints) -> EffectDifference:
    """Test the parameters (I,) of an effect jointly, the others unknown.

    d (K,) are the differences of all parameters, with their covariance (K, K) by both campaigns and
    the prior.
    """
    information = np.linalg.inv(covariance[np.ix_(rows, rows)]) - np.eye(len(rows)) / FARTHEST**2
    values, vectors = np.linalg.eigh((information + information.T) / 2)
    compared = values > 1.0
    total = float(np.sum(values[compared] * (vectors[:, compared].T @ d[rows]) ** 2))
    rank = int(compared.sum())
    return EffectDifference(
        effect, total, rank, float(scipy.stats.chi2.sf(total, rank)) if rank else 1.0
    )
