"""The posterior of one campaign as prior of another.

    θ_B = θ_A + d,    θ_A ~ N(m, (1 + δ_0²) Λ⁻¹),    d_g ~ N(0, δ_g² S_g²)

m and Λ of `Posterior`, δ_0 a doubt of the prior as a whole: that it states too small errors, as
where its model was good enough for its own poses, but not for these. d is the drift of the arm
since then, with one strength δ per group: the parameters of an effect that belong to one joint or
one link. S are the ordinary magnitudes of the parameters, of a shrunk family their strengths. δ_g
is at least `least`, and beyond that what the new readings ask for (`drift`). A model that
lacks an effect of the posterior leaves it out of the prior by marginalising it out.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np

from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError
from hilcal.identification.posterior import Posterior
from hilcal.readings.readings import Readings
from hilcal.readings.same_readings import among
from hilcal.robot.arm import Arm
from hilcal.types import Floats, Ints

Relation = Literal["arm", "type"]
RELATIONS: tuple[Relation, ...] = get_args(Relation)
_JOINT = re.compile(r"j([1-9][0-9]*)$")
SAME_M = 1e-6
"""Difference of two nominal link lengths up to which they are the same; rounding of a table."""


@dataclass(frozen=True, slots=True)
class DriftGroup:
    """Parameters that drift together.

    Attributes:
        effect: their effect.
        part: "j3", "link2", or empty for the whole effect.
    """

    effect: str
    part: str

    @property
    def joint(self) -> int | None:
        """Number of the joint, from 1; None where they are not of one."""
        found = _JOINT.match(self.part)
        return int(found.group(1)) if found else None

    @property
    def name(self) -> str:
        """As people read it."""
        return f"{self.effect}.{self.part}" if self.part else self.effect


@dataclass(frozen=True, eq=False)
class CarriedPrior:
    """A posterior as prior, and the drift that it is given.

    Attributes:
        posterior: what the other campaign taught.
        relation: "arm": it was of the same arm; "type": of another one of the same type.
        least: least drift of each effect by name, in units of S.
        expected: drift that it may well have had, likewise.
        drift: (1 + G,) δ_0, and δ of each of `groups`, as a fit has chosen them; None before.
    """

    posterior: Posterior
    relation: Relation = "arm"
    least: Mapping[str, float] = field(default_factory=dict)
    expected: Mapping[str, float] = field(default_factory=dict)
    drift: Floats | None = None

    @cached_property
    def groups(self) -> tuple[DriftGroup, ...]:
        """The groups, in the order in which they occur."""
        return tuple(dict.fromkeys(map(group_of, self.posterior.names)))

    @cached_property
    def group(self) -> Ints:
        """(K,) group of each parameter of the posterior."""
        place = {g: i for i, g in enumerate(self.groups)}
        return np.array([place[group_of(name)] for name in self.posterior.names])

    @cached_property
    def unit(self) -> Floats:
        """(K,) S, what a drift of 1 is: the ordinary magnitude, or the strength in a family."""
        own = self.posterior.own_precision
        strength = 1.0 / np.sqrt(np.where(own > 0, own, 1.0))
        return np.where(own > 0, strength, self.posterior.scale)

    def index_in(self, names: tuple[str, ...]) -> tuple[Ints, Ints]:
        """Return the parameters of a model that it is of, and their places in the posterior.

        Args:
            names: of the model's parameters, "effect.parameter".
        """
        place = {name: k for k, name in enumerate(self.posterior.names)}
        index = np.array([k for k, name in enumerate(names) if name in place], dtype=np.int64)
        return index, np.array([place[names[k]] for k in index.tolist()], dtype=np.int64)

    def with_drift(self, drift: Floats | None) -> "CarriedPrior":
        """Return the prior with other drifts (1 + G,)."""
        return replace(self, drift=drift)

    def to_json(self) -> dict[str, object]:
        """Return it as JSON, the whole posterior included."""
        return {
            "posterior": self.posterior.to_json(),
            "relation": self.relation,
            "least": dict(self.least),
            "expected": dict(self.expected),
            "drift": None if self.drift is None else self.drift.tolist(),
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "CarriedPrior":
        """Return what `to_json` wrote."""
        drift = content["drift"]
        return cls(
            Posterior.from_json(content["posterior"]),
            RELATIONS[RELATIONS.index(content["relation"])],
            dict(content["least"]),
            dict(content["expected"]),
            None if drift is None else np.array(drift, dtype=float),
        )


def group_of(name: str) -> DriftGroup:
    """Return the group of a parameter "effect.part" or "effect.part.kind"."""
    effect, _, own = name.partition(".")
    part = own.split(".", 1)[0]
    return DriftGroup(effect, part if "." in own or _JOINT.match(part) else "")


def carried_prior(
    posterior: Posterior,
    relation: str = "arm",
    stated: Mapping[str, float] | None = None,
    catalogue: Catalogue | None = None,
) -> CarriedPrior:
    """Return a posterior as prior, with the drift that its effects declare.

    Args:
        posterior: what another campaign taught.
        relation: "arm" or "type"; of another arm of the type the parameters differ by as much as
            effects say with `spread`, and the same arm may have drifted by `drift`.
        stated: drift of effects by name, in units of S, where it is known better.
        catalogue: has its effects; the installed ones unless given.

    Raises:
        InputError: another relation, an effect that is not at hand, or a drift that cannot be.
    """
    of, known, given = _called(posterior), catalogue or installed(), dict(stated or {})
    if relation not in RELATIONS:
        raise InputError(f"prior of {relation!r}; valid: {', '.join(RELATIONS)}")
    names = [e.name for e in posterior.effects]
    missing = [name for name in names if name not in known.names]
    if missing:
        raise InputError(
            f"{of} has the effect {missing[0]}, which is not in the catalogue; give the file that "
            "defines it: --effects-from FILE.py"
        )
    for name, value in given.items():
        if name not in names:
            raise InputError(f"drift of {name}: not in {of}; valid: {', '.join(names)}")
        if not np.isfinite(value) or value < 0:
            raise InputError(f"drift of {name}: {value:g}; valid: a number, 0 or more")
    same = relation == "arm"
    least = {n: 0.0 if same else known[n].spread for n in names}
    expected = {n: known[n].drift if same else known[n].spread for n in names}
    return CarriedPrior(
        posterior,
        RELATIONS[RELATIONS.index(relation)],
        least | given,
        expected | {n: max(v, expected[n]) for n, v in given.items()},
    )


def check_prior(prior: CarriedPrior, arm: Arm, readings: Readings) -> None:
    """Refuse a prior that is not one of these readings.

    Raises:
        InputError: of an arm with other joints or other links, or learnt from readings that are to
            be fitted.
    """
    check_arm(prior, arm)
    both = int(among(readings, prior.posterior.prints).sum())
    if both:
        raise InputError(
            f"{_called(prior.posterior)} was learnt from {both} of the {len(readings)} readings "
            "that are to be fitted; they would count twice; valid: a prior of other readings"
        )


def check_arm(prior: CarriedPrior, arm: Arm) -> None:
    """Refuse a prior of another arm.

    Raises:
        InputError: of an arm with other joints or other links.
    """
    p = prior.posterior
    of = _called(p)
    if p.links.shape != arm.links.shape:
        raise InputError(
            f"{of} is of the arm {p.arm} with {len(p.links) - 1} joints, this one, {arm.name}, has "
            f"{arm.n}; valid: a campaign of the same arm"
        )
    if np.abs(p.links - arm.links).max() > SAME_M:
        raise InputError(
            f"{of} is of the arm {p.arm}, whose nominal links are others than those of {arm.name}; "
            "valid: a campaign of the same arm, described alike"
        )


def _called(p: Posterior) -> str:
    """Name a posterior."""
    return f"the prior{f' of {p.source.campaign}' if p.source.campaign else ''}"
