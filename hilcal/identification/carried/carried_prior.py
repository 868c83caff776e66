"""The posterior of one campaign as prior of another.

    θ_B = θ_A + d,    θ_A ~ N(m, (1 + δ_0²) Λ⁻¹),    d_g ~ N(0, δ_g² S_g²)

m and Λ of `Posterior`, δ_0 widens the prior as a whole, as a model that was adequate at the earlier
poses may not be at these. d is the drift of the arm since then, with one strength δ per group: the
parameters of an effect that belong to one joint or one link. S are the ordinary magnitudes of the
parameters, or their strengths in a shrunk family. δ_g is at least `least`; the new readings may
require more (`drift`). Effects of the posterior that a model lacks are marginalised out.

Fits have coordinates y in which the prior is independent (`Coordinates`):

    θ = m + U y

y of unit variance, or flat along directions without information; y = θ for parameters without a
carried prior. With Λ the prior information in ordinary magnitudes and E its eigenvectors with
eigenvalues λ > 0, N the others, D the variances of the drift,

    U = [E L, N],    L Lᵀ = (1 + δ_0²) diag(1/λ) + Eᵀ D E

so that the prior has the information ((1 + δ_0²) Λ⁻¹ + D)⁻¹ where Λ has some, and none elsewhere.
Also the priors and ordinary magnitudes that the effects of a model declare.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Literal, get_args

import numpy as np
import scipy.linalg as sl

from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError
from hilcal.identification.carried.posterior import Posterior, information_on, spectrum
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.same_readings import found_among_prints
from hilcal.robot.arm import Arm
from hilcal.store.codec import decode, encode
from hilcal.types import Bools, Floats, Ints

Relation = Literal["arm", "type"]
RELATIONS: tuple[Relation, ...] = get_args(Relation)
_JOINT = re.compile(r"j([1-9][0-9]*)$")
START_STD = 0.3  # first prior std of a shrunk family, in ordinary magnitudes; a choice
SAME_M = 1e-6  # difference of two nominal link lengths that are the same: rounding of a table


@dataclass(frozen=True, slots=True)
class DriftGroup:
    """Parameters that drift together: a part ("j3", "link2", or all) of an effect."""

    effect: str
    part: str

    @property
    def joint(self) -> int | None:
        """Number of the joint, from 1; None where the parameters do not belong to one."""
        match = _JOINT.match(self.part)
        return int(match.group(1)) if match else None

    @property
    def name(self) -> str:
        """Name in reports."""
        return f"{self.effect}.{self.part}" if self.part else self.effect


@dataclass(frozen=True, eq=False)
class CarriedPrior:
    """A posterior as prior, with its drift."""

    posterior: Posterior
    relation: Relation = "arm"  # of the same arm, or of another one of the same type
    least: Mapping[str, float] = field(default_factory=dict)  # drift of each effect, in units of S
    expected: Mapping[str, float] = field(default_factory=dict)  # the drift to be expected
    drift: Floats | None = None  # (1 + G,) δ_0, and δ of each of `groups`, as a fit has chosen them
    by_readings: bool = False  # whether the readings say that it is of another arm, see `drift`

    @cached_property
    def groups(self) -> tuple[DriftGroup, ...]:
        """The groups, in the order in which they occur."""
        return tuple(dict.fromkeys(map(group_of, self.posterior.names)))

    @cached_property
    def group(self) -> Ints:
        """(K,) group of each parameter of the posterior."""
        return np.array([self.groups.index(group_of(name)) for name in self.posterior.names])

    @cached_property
    def unit(self) -> Floats:
        """(K,) S, the unit of drift: the ordinary magnitude, or the strength in a family."""
        precision = self.posterior.own_precision
        strength = 1.0 / np.sqrt(np.where(precision > 0, precision, 1.0))
        return np.where(precision > 0, strength, self.posterior.scale)

    @cached_property
    def least_drift(self) -> Floats:
        """(1 + G,) no doubt, and the least drift of each group."""
        return np.array([0.0, *(self.least.get(g.effect, 0.0) for g in self.groups)])

    def index_in(self, names: tuple[str, ...]) -> tuple[Ints, Ints]:
        """Parameters (K,) of a model, by their names, and their places in the posterior."""
        place = {name: k for k, name in enumerate(self.posterior.names)}
        index = [k for k, name in enumerate(names) if name in place]
        both = np.array([index, [place[names[k]] for k in index]], dtype=np.int64)
        return both[0], both[1]

    def with_drift(self, drift: Floats | None) -> "CarriedPrior":
        """Return the prior with other drifts (1 + G,)."""
        return replace(self, drift=drift)

    def of_another_arm(self, catalogue: Catalogue) -> "CarriedPrior":
        """Return the prior as that of another arm of the type; stated drifts stay."""
        stated = {name: value for name, value in self.least.items() if value > 0}
        other = carried_prior(self.posterior, "type", stated, catalogue)
        return replace(other, by_readings=True)

    def to_json(self) -> dict[str, object]:
        """Return the prior as JSON, the posterior included."""
        rest = ("relation", "least", "expected", "drift", "by_readings")
        return {
            "posterior": self.posterior.to_json(),
            **{k: encode(getattr(self, k)) for k in rest},
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "CarriedPrior":
        """Return what `to_json` wrote."""
        return cls(
            Posterior.from_json(content["posterior"]),
            decode(Relation, content["relation"]),
            dict(content["least"]),
            dict(content["expected"]),
            decode(Floats | None, content["drift"]),
            bool(content.get("by_readings", False)),  # files before 1.1 have none
        )


def group_of(name: str) -> DriftGroup:
    """Return the group of a parameter "effect.part" or "effect.part.kind"."""
    effect, _, parameter = name.partition(".")
    part = parameter.split(".", 1)[0]
    return DriftGroup(effect, part if "." in parameter or _JOINT.match(part) else "")


def carried_prior(
    posterior: Posterior,
    relation: str = "arm",
    stated: Mapping[str, float] | None = None,
    catalogue: Catalogue | None = None,
) -> CarriedPrior:
    """Return a posterior as prior, with the drift that its effects declare.

    Another arm of the type differs by as much as effects say with `spread`; the same arm may have
    drifted by `drift`. Drifts of effects may be stated, in units of S, where they are known better.

    Raises:
        InputError: an unknown relation, an effect that is not in the catalogue, an invalid drift.
    """
    label, effects, drifts = _label(posterior), catalogue or installed(), dict(stated or {})
    if relation not in RELATIONS:
        raise InputError(f"prior of {relation!r}; valid: {', '.join(RELATIONS)}")
    names = [e.name for e in posterior.effects]
    missing = [name for name in names if name not in effects.names]
    if missing:
        raise InputError(
            f"{label} has the effect {missing[0]}, which is not in the catalogue; give the file "
            "that defines it: --effects-from FILE.py"
        )
    for name, value in drifts.items():
        if name not in names:
            raise InputError(f"drift of {name}: not in {label}; valid: {', '.join(names)}")
        if not np.isfinite(value) or value < 0:
            raise InputError(f"drift of {name}: {value:g}; valid: a number, 0 or more")
    same = relation == "arm"
    least = {n: 0.0 if same else effects[n].spread for n in names}
    expected = {n: effects[n].drift if same else effects[n].spread for n in names}
    return CarriedPrior(
        posterior,
        RELATIONS[RELATIONS.index(relation)],
        least | drifts,
        expected | {n: max(v, expected[n]) for n, v in drifts.items()},
    )


def check_prior(prior: CarriedPrior, arm: Arm, readings: Readings) -> None:
    """Refuse a prior of another arm, or one estimated from readings that are to be fitted."""
    check_arm(prior, arm)
    repeated = int(found_among_prints(readings, prior.posterior.prints).sum())
    if repeated:
        raise InputError(
            f"{_label(prior.posterior)} is of a fit to {repeated} of the {len(readings)} "
            "readings that are to be fitted; they would count twice; valid: a prior of other "
            "readings"
        )


def check_arm(prior: CarriedPrior, arm: Arm) -> None:
    """Refuse a prior of an arm with other joints or other links."""
    p = prior.posterior
    check_same_links(_label(p), p.arm, p.links, arm)


def check_same_links(what: str, name: str, links: Floats, arm: Arm) -> None:
    """Refuse `what` if its arm `name` has other joints or other links (n + 1, 4, 4) than an arm."""
    if links.shape != arm.links.shape:
        raise InputError(
            f"{what} is of the arm {name} with {len(links) - 1} joints, this one, {arm.name}, "
            f"has {arm.n}; valid: a campaign of the same arm"
        )
    if np.abs(links - arm.links).max() > SAME_M:
        raise InputError(
            f"{what} is of the arm {name}, whose nominal links differ from those of {arm.name}; "
            "valid: a campaign of the same arm, described alike"
        )


def _label(p: Posterior) -> str:
    return f"the prior{f' of {p.source.campaign}' if p.source.campaign else ''}"


@dataclass(frozen=True, slots=True, eq=False)
class Coordinates:
    """θ = m + U y of the K parameters at `index`, θ = y of all others."""

    index: Ints  # (K,) parameters of the model with a carried prior, and their places in y
    mean: Floats  # (K,) m, SI
    matrix: Floats  # (K, K) U, SI
    inverse: Floats  # (K, K) y = inverse (θ − m)
    std: Floats  # (K,) standard deviations of y: 1, infinite for flat ones, 0 for those left out
    omitted_variance: Floats  # (K,) variance of θ by the coordinates that were left out, SI

    def _replaced(self, x: Floats, values: Floats | float | bool) -> Floats:
        """Return x (P, ...) with values of the parameters that have a carried prior."""
        out = x.copy()
        out[self.index] = values
        return out

    def theta(self, y: Floats) -> Floats:
        """(P,) parameters."""
        return self._replaced(y, self.mean + self.matrix @ y[self.index])

    def of_theta(self, theta: Floats) -> Floats:
        """(P,) y."""
        return self._replaced(theta, self.inverse @ (theta[self.index] - self.mean))

    def transform(self, t: Floats) -> Floats:
        """(P, Q) change of θ by changes of y (P, Q)."""
        return self._replaced(t, self.matrix @ t[self.index])

    def columns(self, a: Floats) -> Floats:
        """(R, P) derivatives by y of derivatives by θ (R, P)."""
        if not len(self.index):
            return a
        out = a.copy()
        out[:, self.index] = a[:, self.index] @ self.matrix
        return out

    def prior(self, std: Floats) -> Floats:
        """Prior standard deviations (P,) of y; `std` where there is no carried one."""
        return self._replaced(std, self.std)

    def scales(self, scale: Floats) -> Floats:
        """(P,) ordinary magnitudes of y, of those of θ."""
        return self._replaced(scale, 1.0)

    def carried(self, size: int) -> Bools:
        """(P,) which parameters have a carried prior."""
        return np.isin(np.arange(size), self.index)

    def restricted(self, a: Floats) -> "Coordinates":
        """Return the coordinates reduced to those that derivatives A (R, P) by θ depend on.

        The rest stays at the prior's mean. Unchanged where there are as many rows as coordinates.
        """
        held = np.flatnonzero(self.std == 1.0)
        if len(a) >= len(held):
            return self
        u = self.matrix[:, held]
        turn = sl.qr((a[:, self.index] @ u).T, mode="economic", check_finite=False)[0]
        matrix, inverse, std = self.matrix.copy(), self.inverse.copy(), self.std.copy()
        matrix[:, held], inverse[held], std[held] = 0.0, 0.0, 0.0
        used = held[: turn.shape[1]]
        matrix[:, used], inverse[used], std[used] = u @ turn, turn.T @ self.inverse[held], 1.0
        variance = np.sum(u**2, axis=1) - np.sum(matrix[:, used] ** 2, axis=1)
        rest = np.maximum(variance, 0.0)
        return replace(self, matrix=matrix, inverse=inverse, std=std, omitted_variance=rest)


def coordinates_of(model: Model) -> Coordinates:
    """Return the coordinates of a model's parameters; y = θ where it has no carried prior."""
    if model.prior is None:
        none, square = np.zeros(0), np.zeros((0, 0))
        return Coordinates(none.astype(np.int64), none, square, square, none, none)
    return _coordinates(model.prior, names_of(model))


@lru_cache(maxsize=3)
def _coordinates(prior: CarriedPrior, names: tuple[str, ...]) -> Coordinates:
    p = prior.posterior
    index, place = prior.index_in(names)
    values, vectors = _spectrum(p, tuple(place.tolist()))
    scale, informed = p.scale[place], values > 0
    e, values = vectors[:, informed], values[informed]
    root, back = e / np.sqrt(values), np.sqrt(values)[:, None] * e.T
    if prior.drift is not None and prior.drift.any():
        drift = prior.drift[1:][prior.group[place]]
        inner = (e.T * (drift * prior.unit[place] / scale) ** 2) @ e
        inner[np.diag_indices_from(inner)] += (1.0 + prior.drift[0] ** 2) / values
        low = np.linalg.cholesky(inner)
        root = e @ low
        back = sl.solve_triangular(low, e.T, lower=True, check_finite=False)
    matrix = np.hstack([root, vectors[:, ~informed]])
    inverse = np.vstack([back, vectors[:, ~informed].T])
    std = np.concatenate([np.ones(root.shape[1]), np.full(int((~informed).sum()), np.inf)])
    mean, none = p.mean[place], np.zeros(len(index))
    return Coordinates(index, mean, scale[:, None] * matrix, inverse / scale, std, none)


@lru_cache(maxsize=3)
def _spectrum(p: Posterior, place: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Eigenvalues and eigenvectors of the information on some parameters, in ordinary magnitudes.

    Those without information are zero. Without any information the axes are the parameters.
    """
    scaled = p.information * (p.scale[:, None] * p.scale)
    values, vectors = spectrum(information_on(scaled, np.array(place, dtype=np.int64)))
    return values, vectors if values.any() else np.eye(len(values))


def prior_of(model: Model) -> tuple[Floats, Ints]:
    """Starting prior (P,) of a model, and the shrinkage group (P,) of each parameter or −1.

    Random effects have the standard deviations stated in the model. Parameters with a carried prior
    are flat here, see `Coordinates`.
    """
    prior, groups, used = [np.zeros(0)], [np.zeros(0, dtype=np.int64)], 0
    for e in model.effects:
        size = len(e.magnitudes)
        group, fixed = e.groups(), e.prior_std()
        if e.name in model.random:
            group, fixed = None, model.random[e.name]
        if group is not None:
            prior.append(START_STD * e.magnitudes)
            groups.append(group + used)
            used += int(group.max()) + 1
        else:
            prior.append(np.full(size, np.inf) if fixed is None else fixed)
            groups.append(np.full(size, -1))
    std, number = np.concatenate(prior), np.concatenate(groups)
    if model.prior is not None:
        carried = model.prior.index_in(names_of(model))[0]
        std[carried], number[carried] = np.inf, -1
    return std, number


def names_of(model: Model) -> tuple[str, ...]:
    """Names of the parameters, "effect.parameter"."""
    return tuple(f"{e.name}.{p.name}" for e in model.effects for p in e.parameters)


def scales_of(model: Model) -> Floats:
    """(P,) ordinary magnitudes of the parameters."""
    return np.concatenate([np.zeros(0), *(e.magnitudes for e in model.effects)])
