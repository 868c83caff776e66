"""Parameters that no reading of a cell determines: they are named, and the plan goes on without.

Under dead weights alone, for one, nothing makes a torque about a vertical first joint, and no plan
determines its compliance. What the other readings tell of the other parameters is planned all the
same.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from hilcal.design.candidate_set import CandidateSet
from hilcal.design.information import DesignProblem
from hilcal.effects.per_joint import PerJoint
from hilcal.errors import CannotAnswerError
from hilcal.regression.normal_equations import INFORMATION
from hilcal.regression.schur import DETERMINED
from hilcal.types import Bools, Floats, Ints

SHARE = 0.1
"""Parameters with a larger share of a singular direction than this are confounded. A choice."""


@dataclass(frozen=True, slots=True)
class UndeterminedParameter:
    """A parameter that is left out of a plan."""

    name: str  # as identification prints it, e.g. "joint_compliance.j1".
    unit: str  # SI
    value: float  # at which it is assumed, SI
    # other parameters that the readings do not separate it from; none where no reading changes with
    # it at all
    confounded: tuple[str, ...] = ()
    joint: str = ""  # "joint 1" or "joints 1-2" where it is the compliance of these; else empty

    @property
    def remark(self) -> str:
        """What is not determined, why, and what would determine it, in a sentence or two."""
        if self.confounded:
            return (
                f"{self.name}: not determined; no reading in this cell separates it from "
                f"{', '.join(self.confounded)}. The plan goes on without it"
            )
        if self.joint and self.unit == "m/N":
            return (
                f"{self.name}: not determined; no load of this cell makes a force along the travel "
                f"of {self.joint}. The plan goes on without it: {self.joint} needs a pull along "
                "it, [[loads]] with force_N, e.g. [80.0, 0.0, 0.0]"
            )
        if self.joint:
            needs = "need" if self.joint.startswith("joints") else "needs"
            return (
                f"{self.name}: not determined; no load of this cell makes a torque about "
                f"{self.joint}. The plan goes on without it: {self.joint} {needs} a side pull, "
                "[[loads]] with force_N across the axis, e.g. [80.0, 0.0, 0.0]"
            )
        return (
            f"{self.name}: not determined; no reading in this cell changes with it. The plan goes "
            "on without it"
        )


def without_undetermined(
    of: DesignProblem,
) -> tuple[DesignProblem, tuple[UndeterminedParameter, ...]]:
    """Return the problem of those parameters that the candidates determine, and the others.

    A parameter without a prior is left out where all candidates together change by less than
    `regression.normal_equations.INFORMATION` with an ordinary magnitude of it; of those that are
    confounded with each other as many as it takes.
    """
    size = of.model_size
    every = of.prior + of.units.information(np.ones(len(of.units)))
    flat = np.isinf(of.nominal.prior_std[of.nominal.live])
    lost = dict(_lost(every[:size, :size], flat))
    if not lost:
        return of, ()
    found = tuple(_named(of, k, others) for k, others in lost.items())
    if len(lost) == int(flat.sum()):
        raise CannotAnswerError("; ".join(dict.fromkeys(f.remark for f in found[:1])))
    kept = np.setdiff1d(np.arange(len(of.terms)), list(lost))
    own, carried = kept[kept < size], of.nominal.carried
    nominal = replace(
        of.nominal,
        live=of.nominal.live[own],
        carried=None if carried is None else carried[np.ix_(own, own)],
    )
    rows = np.ascontiguousarray(of.units.rows[:, :, kept])
    reduced = replace(
        of,
        nominal=nominal,
        units=CandidateSet(rows, of.units.cost),
        terms=tuple(of.terms[k] for k in kept),
        prior=of.prior[np.ix_(kept, kept)],
        measured=of.measured[np.ix_(kept, kept)],
    )
    return reduced, found


def _lost(m: Floats, flat: Bools) -> Iterator[tuple[int, Ints]]:
    """Yield parameters that M (P, P) does not determine, and those that each is confounded with."""
    keep = np.arange(len(m))
    blind = np.flatnonzero(flat & (np.diag(m) < INFORMATION**2))
    for k in blind:
        yield int(k), np.zeros(0, dtype=np.int64)
    keep = np.setdiff1d(keep, blind)
    while flat[keep].any():
        root = np.sqrt(np.diag(m)[keep])
        values, vectors = np.linalg.eigh(m[np.ix_(keep, keep)] / np.outer(root, root))
        share = np.abs(vectors[:, 0]) * flat[keep]
        if values[0] > DETERMINED or not share.any():
            return
        worst = int(np.argmax(share))
        others = np.flatnonzero(share > SHARE * share.max())
        yield int(keep[worst]), keep[others[others != worst]]
        keep = np.delete(keep, worst)


def _named(of: DesignProblem, k: int, others: Ints) -> UndeterminedParameter:
    term = of.terms[k]
    confounded = tuple(of.terms[int(j)].name for j in others)
    joint = ""
    for e in of.nominal.model.effects:
        if isinstance(e, PerJoint) and e.role == "baseline" and e.name == term.effect:
            names = [f"{e.name}.{p.name}" for p in e.parameters]
            joint = e.shared.words[names.index(term.name)]
    return UndeterminedParameter(term.name, term.unit, term.value, confounded, joint)
