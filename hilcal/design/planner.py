"""From a cell to a plan: candidates, loads, the optimum with its certificate, and the order."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Literal

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.approximate_design import ApproximateDesign
from hilcal.design.choice import (
    EFFORT,
    Objective,
    canonical,
    certified,
    choose,
    choose_poses,
    compound_objective,
    costly_loads,
    only,
    pose_units,
    promising,
)
from hilcal.design.criterion import CandidateSet
from hilcal.design.feasible import DrawnPoses, Space, draw
from hilcal.design.information import DesignProblem, problem, reading_covariance, readings_of
from hilcal.design.nominal_model import after, nominal_model
from hilcal.design.optimum import Design
from hilcal.design.predicted import (
    PredictedUncertainty,
    PredictionPoses,
    predicted,
    prediction_poses,
)
from hilcal.design.run_order import Chosen, Ordered, Ordering, order_plan, pace
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.per_joint import PerJoint
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.carried import CarriedPrior
from hilcal.identification.fit import Fit
from hilcal.identification.registration import MIN_POSES
from hilcal.regression.normal_equations import INFORMATION
from hilcal.regression.schur import DETERMINED
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats, Ints

SHARE = 0.1  # parameters with a larger share of a singular direction are confounded; a choice


@dataclass(frozen=True, slots=True)
class UndeterminedParameter:
    """A parameter that is left out of a plan."""

    name: str  # as identification prints it, e.g. "joint_compliance.j1".
    unit: str  # SI
    value: float  # at which it is assumed, SI
    confounded: tuple[str, ...] = ()  # not separated from these; none where nothing changes
    joint: str = ""  # "joint 1" or "joints 1-2" where it is the compliance of these; else empty

    @property
    def remark(self) -> str:
        """What is not determined, why, and what would determine it, in a sentence or two."""
        why, remedy = "no reading in this cell changes with it", ""
        if self.confounded:
            why = f"no reading in this cell separates it from {', '.join(self.confounded)}"
        elif self.joint:
            slides = self.unit == "m/N"
            what = "force along the travel of" if slides else "torque about"
            needs = "need" if self.joint.startswith("joints") else "needs"
            pull, across = ("pull along it", "") if slides else ("side pull", " across the axis")
            why = f"no load of this cell makes a {what} {self.joint}"
            remedy = f": {self.joint} {needs} a {pull}, [[loads]] with force_N{across}, e.g. "
            remedy += "[80.0, 0.0, 0.0]"
        return f"{self.name}: not determined; {why}. The plan goes on without it{remedy}"


def without_undetermined(
    of: DesignProblem,
) -> tuple[DesignProblem, tuple[UndeterminedParameter, ...]]:
    """Return the problem of those parameters that the candidates determine, and the others.

    A parameter without a prior is left out where all candidates together change by less than
    `INFORMATION` with an ordinary magnitude of it; of those that are confounded as many as it
    takes.
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


HOMES = 4  # Central poses of which one becomes the reference. A choice.
PROBES = 60  # Poses by which the reference is judged. A choice.
SAMPLE = 50  # Poses by which the noise of a reading is judged. A choice.
ROUNDS = 6  # How often poses that are not reached from the reference may be replaced. A choice.

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Request:
    """Size and criterion of a plan."""

    poses: int = 20  # just so many, each read once unloaded and under every load that it bears
    readings: int | None = None  # or this many, but for reference and repeats
    criterion: str | None = None  # of `[planning]` by default, else I, or D for deflections
    effort: int = EFFORT  # of the search for whole numbers
    unloaded: Literal["around", "first"] = "around"  # "around" or "first", see `Ordering`


@dataclass(frozen=True, slots=True, eq=False)
class Planned:
    """A plan with its design problem."""

    ordered: Ordered  # the plan in order, with what the order costs
    design: Design  # the units that were chosen, with the certificate
    costly: tuple[tuple[str, float], ...]  # loads not worth their change, and the gain
    problem: DesignProblem
    asked: Objective  # the design problem with its criterion
    usable: Bools  # (K,) which units were to choose from
    work: PredictionPoses
    drawn: DrawnPoses
    budget: float  # readings of the design
    criterion: str
    predicted: PredictedUncertainty  # standard uncertainties that a fit to the readings will have
    undetermined: tuple[UndeterminedParameter, ...]  # by no reading of the cell
    asked_poses: int | None  # poses that were asked for, see `Request`; None where readings were

    @property
    def counts(self) -> Floats:
        """(K,) how often each unit of the problem is taken."""
        out = np.zeros(len(self.problem.units))
        out[np.flatnonzero(self.usable)] = self.design.counts
        return out


def make(
    cell: Cell,
    config: CellConfig,  # limits, loads, noise, and `[planning]`: what it is for
    request: Request,  # how many readings, and the criterion
    rng: np.random.Generator,
    known: Fit | None = None,  # fit of what has been measured already
    say: Say = lambda words: None,
    catalogue: Catalogue | None = None,  # those of `known`, or the installed effects
    prior: CarriedPrior | None = None,  # what another campaign taught, if nothing is known
    reference: Floats | None = None,  # (n,) the campaign's joints, rad; else a new one
) -> Planned:
    """Return the plan."""
    usual = "I" if config.planning.readings == "absolute" else "D"
    criterion = canonical(request.criterion or config.planning.criterion or usual)
    say("drawing candidate poses")
    space = Space(cell, config)
    drawn = draw(space, config.planning.candidates, rng, least=2)
    if reference is None:
        home, poses = _reference(space, drawn, rng)
        drawn = replace(drawn, q=drawn.q[poses], allowed=drawn.allowed[poses])
    else:
        home = reference
    say("computing the information of each pose")
    if known is None:
        model = nominal_model(cell, config, 3, catalogue, prior)
    else:
        model = after(known, config)
    of, undetermined = without_undetermined(problem(model, config, drawn.q, drawn.allowed))
    work = prediction_poses(of.nominal, config, drawn.q, space.clear)
    budget = _budget(request, of)
    asked = compound_objective(of, config, criterion, work, budget, rng)
    whole = request.readings is None
    costly: tuple[tuple[str, float], ...] = ()
    if whole:
        say("weighing what each load costs")
        seconds = pace(config)
        costly = costly_loads(asked, of, budget, seconds.change_s / seconds.reading_s, rng)
    say(f"choosing poses by criterion {criterion}")
    pose_of = np.array([pose for pose, _ in of.what])
    first, relaxed = promising(asked, budget)
    usable = ~np.isin(pose_of, _unreachable(space, of, home, first))
    by_pose = pose_units(asked, of) if whole else None
    reached: set[int] = set()
    over_poses: ApproximateDesign | None = None
    for left in reversed(range(ROUNDS)):
        if not left:  # of those that were chosen before, enough are reached
            usable &= np.isin(pose_of, [*reached])
        if by_pose is not None:
            among = np.isin(by_pose.poses, pose_of[usable])
            counts, over_poses = choose_poses(
                asked, by_pose, among, request.poses, rng, request.effort, over_poses
            )
        else:
            start = relaxed.among(usable)
            design = choose(only(asked, usable), budget, rng, request.effort, start)
            counts = np.zeros(len(usable), dtype=np.int64)
            counts[usable] = design.counts
        units = np.flatnonzero(counts)
        lost = _unreachable(space, of, home, units)
        if not len(lost):
            break
        usable &= ~np.isin(pose_of, lost)
        reached |= {of.what[k][0] for k in units} - set(lost.tolist())
    else:
        raise CannotAnswerError(
            f"after {ROUNDS} rounds there are still poses that no clear straight motion from the "
            "reference pose reaches; widen the workspace"
        )
    if whole:
        design = certified(asked, counts, usable, relaxed)
    visited = len({of.what[k][0] for k in units}) + 1
    if not cell.registration_known and known is None and visited < MIN_POSES:
        raise CannotAnswerError(
            f"the plan has {visited} poses, the reference among them; an unknown registration "
            f"needs at least {MIN_POSES}: ask for more {'poses' if whole else 'readings'}"
        )
    say("ordering the readings")
    repeats = max(2, (visited - 1) // 10)
    some = of.candidates[slice(0, SAMPLE)].states()
    covariance = reading_covariance(
        of.nominal, config, of.nominal.model.predict(some, of.nominal.theta)
    )
    std = float(np.sqrt(np.mean(np.diagonal(covariance[:, :3, :3], axis1=1, axis2=2))))
    how = Ordering(unloaded=request.unloaded, repeats=repeats, reading_std=std)
    order = ordered(space, of, home, counts, rng, how)
    knows = predicted(of, counts.astype(float), work=work)
    return Planned(
        order, design, costly, of, asked, usable, work, drawn, budget, criterion, knows,
        undetermined, request.poses if whole else None,
    )  # fmt: skip


def _budget(request: Request, of: DesignProblem) -> float:
    whole = request.readings is None
    count, what = (request.poses, "poses") if whole else (request.readings or 0, "readings")
    if count < 1:
        raise InputError(f"{count} {what}; valid: a whole number from 1")
    return float(count * (len(of.candidates.loads) if whole else 1))


def _reference(space: Space, drawn: DrawnPoses, rng: np.random.Generator) -> tuple[Floats, Ints]:
    """Return the reference (n,), where every load can hang, and which other poses are left.

    It is central, and of some such poses the one from which most others are reached.
    """
    every = np.asarray(drawn.allowed.any(axis=0))  # loads that are of use at all
    bears = np.flatnonzero(drawn.allowed[:, every].all(axis=1))
    if not len(bears):
        raise CannotAnswerError(
            "no pose bears every load, so there is none to change them at; leave out a load "
            "or widen [limits]"
        )
    q = drawn.q[bears]
    nearest = bears[np.argsort(np.linalg.norm(q - np.median(drawn.q, axis=0), axis=1))]
    usable = [name for name, used in zip(drawn.loads, every, strict=True) if used]
    begins = (k for k in nearest if space.begins(drawn.q[k], usable))
    central = list(islice(begins, HOMES))
    if not central:
        raise CannotAnswerError(
            "no pose that bears every load can be approached; widen [limits] or the room around"
        )
    probes = drawn.q[rng.permutation(len(drawn.q))[:PROBES]]
    reached = [int(space.passable(drawn.q[k], probes, UNLOADED).sum()) for k in central]
    home = int(central[int(np.argmax(reached))])
    return drawn.q[home], np.delete(np.arange(len(drawn.q)), home)


def _unreachable(space: Space, of: DesignProblem, home: Floats, units: Ints) -> Ints:
    """Return the poses among the chosen units that the arm cannot go to straight from home."""
    wanted: dict[str, set[int]] = {}
    for k in units:
        pose, loads = of.what[k]
        for load in readings_of((pose, loads), of.mode):
            wanted.setdefault(load, set()).add(pose)
    lost: set[int] = set()
    for load, poses in wanted.items():
        which = np.array(sorted(poses))
        good = space.passable(home, of.candidates.q[which], load)
        lost |= set(which[~good].tolist())
    return np.array(sorted(lost), dtype=np.int64)


def ordered(
    space: Space,
    of: DesignProblem,
    home: Floats,  # (n,) joints of the reference pose, from which all units are reached, rad
    counts: Ints,  # (K,) how often each unit is taken
    rng: np.random.Generator,
    how: Ordering,
) -> Ordered:
    """Name the poses of the chosen units p1, p2, ..., and put their readings in order."""
    taken = np.flatnonzero(counts)
    poses = sorted({of.what[k][0] for k in taken})
    name = {pose: f"p{k}" for k, pose in enumerate(poses, start=1)}
    chosen = [
        Chosen(name[of.what[k][0]], readings_of(of.what[k], of.mode), int(counts[k])) for k in taken
    ]
    q = of.candidates.q[poses]
    return order_plan(
        space.cell, space.config, list(name.values()), q, home, chosen, space.passable, rng, how
    )
