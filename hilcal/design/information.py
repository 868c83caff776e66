"""The design problem: information and cost of each unit of measurement.

Potential terms: effects that the model lacks, and a plan should still be able to find. Their
parameters have the prior N(0, s²) of the mixed model, with s what arms of any kind have
(`mixed.families`). A plan is then judged on all parameters together, so that it keeps power against
what is missing. Source: DuMouchel and Jones, *A simple Bayesian modification of D-optimal designs
to reduce dependence on an assumed model*, Technometrics 36 (1994) 37-47.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from hilcal.config import CellConfig
from hilcal.design.criterion import CandidateSet
from hilcal.design.nominal_model import (
    NominalModel,
    build,
    expected_std,
    nominal_states,
    potential_names,
    random_columns,
)
from hilcal.effects.protocol import Effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.effect_columns import computable, effect_columns
from hilcal.identification.gauss_newton import whitened_jacobian
from hilcal.identification.priors import scales_of
from hilcal.model.model import Prediction
from hilcal.readings.covariance import (
    expected_share_of_mean,
    joint_scatter,
    scatter_factor,
    tracker_covariance,
    tracker_noise,
)
from hilcal.readings.readings import States
from hilcal.readings.whitening import Mode
from hilcal.robot.chain import drive_jacobian
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats, Ints

CHUNK = 4096  # States that are evaluated at once. A choice, of memory.


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """N poses, each of them unloaded and under those of the L loads that it can bear."""

    q: Floats  # (N, n) joint angles, rad
    loads: tuple[str, ...]  # 1 + L names, "none" first
    wrench: Floats  # (1 + L, 6) at the load point, base axes, N and N·m
    allowed: Bools  # (N, 1 + L) which states may be taken

    def __len__(self) -> int:
        """Return the number of poses N."""
        return len(self.q)

    def __getitem__(self, rows: slice | list[int]) -> "Candidates":
        """Return the chosen poses."""
        return Candidates(self.q[rows], self.loads, self.wrench, self.allowed[rows])

    def states(self) -> States:
        """All N·(1 + L) states, pose by pose, with nominal times and sides of approach."""
        count = len(self.loads)
        return nominal_states(
            np.repeat(self.q, count, axis=0), np.tile(self.wrench, (len(self), 1))
        )


@dataclass(frozen=True, slots=True, eq=False)
class ReadingDerivatives:
    """What would be read of a chunk of N poses under 1 + L loads."""

    rows: slice
    jacobian: Floats  # (N, 1 + L, m, P) by the parameters; m of all that one arrival reads
    covariance: Floats  # (N, 1 + L, m, m) of them


def reading_derivatives(
    nominal: NominalModel,  # the model, whose live parameters come first
    config: CellConfig,
    of: Candidates,
    more: tuple[Effect, ...],  # effects that are not in the model
    scale: Floats,  # (P,) what one unit of each parameter is, SI
) -> Iterator[ReadingDerivatives]:
    """Yield derivatives and covariances of candidates, some poses at a time."""
    model, m, loads = nominal.model, nominal.elements, len(of.loads)
    states, each = nominal.arrivals(of.states()), nominal.each
    live = np.concatenate([nominal.live, np.arange(model.size, model.size + sizes(more))])
    step = max(CHUNK // (loads * each), 1)
    for start in range(0, len(of), step):
        rows = slice(start, min(start + step, len(of)))
        count = rows.stop - rows.start
        per_pose = loads * each
        p = model.predict(states[slice(rows.start * per_pose, rows.stop * per_pose)], nominal.theta)
        jacobian = model.jacobian_of((*model.effects, *more), p, nominal.theta, nominal.m, live)
        covariance = arrival_covariance(nominal, config, p)
        yield ReadingDerivatives(
            rows,
            (jacobian * scale).reshape(count, loads, m, len(scale)),
            covariance.reshape(count, loads, m, m),
        )


def sizes(effects: tuple[Effect, ...]) -> int:
    """Return the number of parameters of effects."""
    return sum(len(e.parameters) for e in effects)


def absolute_rows(of: ReadingDerivatives) -> Floats:
    """Whitened derivatives S⁻¹ J (N, 1 + L, m, P) of single readings, V = S Sᵀ."""
    return np.asarray(np.linalg.solve(np.linalg.cholesky(of.covariance), of.jacobian))


def deflection_rows(of: ReadingDerivatives, which: Ints, loads: tuple[int, ...]) -> Floats:
    """Whitened derivatives (k, S·m, P) of deflections of k poses under S loads.

    Block (i, j) of their covariance is δ_ij V_i + V_u: the unloaded reading's error is in all.
    """
    jacobian, v = of.jacobian[which], of.covariance[which]
    count, _, m, size = jacobian.shape
    each, taken = np.arange(len(loads)), list(loads)
    height = len(loads) * m
    change = (jacobian[:, taken] - jacobian[:, :1]).reshape(count, height, size)
    shape = (count, len(loads), m, len(loads), m)
    shared = np.broadcast_to(v[:, 0][:, None, :, None, :], shape).copy()
    shared[:, each, :, each, :] += np.moveaxis(v[:, taken], 1, 0)
    covariance = shared.reshape(count, height, height)
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), change))


def arrival_covariance(nominal: NominalModel, config: CellConfig, predicted: Prediction) -> Floats:
    """Covariance (N, T·m, T·m) of all that is read in each arrival: of N·T states in succession.

    They have the arm's repeatability in common: block (i, j) is δ_ij V_instrument + F_i F_jᵀ with F
    = R J Σ_q^½ (see `reading_covariance`).
    """
    single = reading_covariance(nominal, config, predicted)
    count, m = nominal.each, nominal.m
    if count == 1:
        return single
    o = predicted.observation
    s = predicted.situation
    jac = drive_jacobian(s.cell.arm, s.chain, o.base_position)
    joint_std = config.repeatability.per_joint(nominal.cell.arm.n)
    factor = scatter_factor(jac, joint_std, o.axes, m).reshape(-1, count * m, jac.shape[2])
    out = (factor @ np.swapaxes(factor, 1, 2)).reshape(-1, count, m, count, m)
    each = np.arange(count)
    out[:, each, :, each, :] = np.moveaxis(single.reshape(-1, count, m, m), 1, 0)
    return out.reshape(-1, count * m, count * m)


def reading_covariance(nominal: NominalModel, config: CellConfig, predicted: Prediction) -> Floats:
    """Covariance (N, m, m) of the mean of K samples at predicted states, and of the arm's return.

        V = (s + (1 − s)/K) Σ + R J Σ_q Jᵀ Rᵀ

    with Σ what the tracker states of one sample, s its systematic share, in sensor axes; m², m·rad,
    rad².
    """
    a, o, m = config.acquire, predicted.observation, nominal.m
    stated = _instrument(nominal, config, predicted)
    out = expected_share_of_mean(a.samples, a.systematic_share) * stated
    joint_std = config.repeatability.per_joint(nominal.cell.arm.n)
    if np.any(joint_std):
        jac = drive_jacobian(
            predicted.situation.cell.arm, predicted.situation.chain, o.base_position
        )
        out = out + joint_scatter(jac, joint_std, o.axes, m)
    unread = np.diagonal(out, axis1=1, axis2=2) == 0  # of readings of one number; any noise does
    return np.asarray(out + unread[:, :, None] * np.eye(m))


def _instrument(nominal: NominalModel, config: CellConfig, predicted: Prediction) -> Floats:
    """(N, m, m) covariance that the instrument states; zero in elements that are not read."""
    o, m, t = predicted.observation, nominal.m, config.tracker
    number, by = predicted.situation.states.observer, nominal.cell.observers
    if number is None or not by:
        return tracker_covariance(o.position, tracker_noise(t), nominal.station, m)
    out = np.zeros((len(o.position), m, m))
    for k, one in enumerate(by):
        mine = number == k
        if one.name.kind == "station":
            place = np.zeros(3) if k else nominal.station
            out[mine] = tracker_covariance(o.position[mine], tracker_noise(t), place, m)
            continue
        far = one.name.kind == "point"
        section = (config.points if far else config.gauges).get(one.name.name)
        std = None if section is None else section.std_m
        length = t.range_std_m + t.range_std_per_m * np.abs(o.position[mine, 0])
        out[mine, 0, 0] = np.square(length if std is None else std)
    return out


PAIRS_UP_TO = 4  # pairs of loads are units of their own up to so many loads; a choice
MOST_BYTES = 600_000_000  # Memory that the rows of all units may take. A choice.
MOST_PARAMETERS = 200
SAMPLE = 300  # Candidate poses by which strengths are judged. A choice.
MOST_TIMES = 5.0  # times its expected size at which a family must move readings by 1 σ; a choice


@dataclass(frozen=True, slots=True, eq=False)
class Potential:
    """Families with the sizes that arms have, and what was left out, one line each."""

    effects: tuple[Effect, ...]
    std: Floats  # (F,) standard deviation of each parameter, SI
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class DesignTerm:
    """A parameter of the problem."""

    effect: str  # canonical name of its effect
    name: str  # as identification prints it, e.g. "joint_compliance.j1".
    unit: str  # physical unit, SI
    scale: float  # of one unit of the problem's, SI: an ordinary magnitude, or s if potential
    value: float  # at which it is assumed, SI
    potential: bool  # whether it belongs to an effect that is not in the model


@dataclass(frozen=True, slots=True, eq=False)
class DesignProblem:
    """Everything that a plan is chosen by."""

    nominal: NominalModel  # the model that is planned for
    mode: Mode  # "deflection" or "absolute"
    candidates: Candidates
    units: CandidateSet  # K units; their parameters are those of the model, then potential terms
    what: tuple[tuple[int, tuple[str, ...]], ...]  # pose and loads of each; "none" is unloaded
    terms: tuple[DesignTerm, ...]
    families: tuple[Effect, ...]  # effects of the potential terms
    prior: Floats  # (P, P) what is known before: priors, and what was measured already
    measured: Floats  # (P, P) the part of it that was measured already
    notes: tuple[str, ...]  # what was assumed and left out, one line each

    @property
    def model_size(self) -> int:
        """Number of the model's parameters, which come first."""
        return sum(not t.potential for t in self.terms)

    @property
    def mean_variance(self) -> Floats:
        """(P, P) C whose tr(C M⁻¹) is the mean variance of the model's parameters."""
        return np.diag([(not t.potential) / self.model_size for t in self.terms])

    @property
    def scale(self) -> Floats:
        """(P,) what one unit of each parameter is, SI."""
        return np.array([t.scale for t in self.terms])

    def of_effect(self, name: str) -> Ints:
        """Indices of an effect's parameters."""
        return np.flatnonzero([t.effect == name for t in self.terms])

    def information(self, counts: Floats) -> Floats:
        """(P, P) information of a plan that takes unit k counts[k] times, prior included."""
        taken = np.flatnonzero(counts)
        weight = np.asarray(counts, dtype=float)[taken]
        return np.asarray(self.prior + self.units.information(weight, taken))


def problem(
    nominal: NominalModel, config: CellConfig, q: Floats, allowed: Bools | None = None
) -> DesignProblem:
    """Return the design problem of candidate poses (N, n), rad, under the loads of a cell.

    `allowed` (N, 1 + L) are the states that may be taken; all where None.

    A unit of absolute positions is one reading. A unit of deflections is a pose with its unloaded
    reading and some loads: each by itself, all that the pose bears, and pairs where there are few
    loads. It costs as many readings as it takes, the unloaded one included.
    """
    mode = config.planning.readings
    if mode == "deflection" and not config.loads:
        raise InputError(
            '[planning] readings = "deflection" needs [[loads]]; give one, or readings = "absolute"'
        )
    loads = (UNLOADED, *(load.name for load in config.loads))
    pulls = (load.wrench(nominal.cell.gravity) for load in config.loads)
    if allowed is None:
        allowed = np.ones((len(q), len(loads)), dtype=np.bool_)
    of = Candidates(np.asarray(q, dtype=float), loads, np.array([np.zeros(6), *pulls]), allowed)
    against = potential(nominal, config, of) if len(of) else Potential((), np.zeros(0), ())
    terms = _terms(nominal, against)
    scale = np.array([t.scale for t in terms])
    what, height, layout_notes = _layout(of, mode, nominal.elements, len(terms))
    rows = np.zeros((len(what), height, len(terms)))
    parts = reading_derivatives(nominal, config, of, against.effects, scale)
    for place, block in unit_rows(parts, of.loads, what, mode):
        rows[place, : block.shape[1]] = block
    measured = information_of(nominal, against.effects, scale)
    count = len(nominal.live)
    precision = np.ones(len(terms))
    precision[:count] = (scale[:count] / nominal.prior_std[nominal.live]) ** 2
    cost = np.array([float(len(readings_of(unit, mode))) for unit in what])
    return DesignProblem(
        nominal=nominal, mode=mode, candidates=of, units=CandidateSet(rows, cost),
        what=what, terms=terms, families=against.effects,
        prior=measured + np.diag(precision), measured=measured,
        notes=(*nominal.notes, *against.notes, *layout_notes),
    )  # fmt: skip


def _terms(nominal: NominalModel, against: Potential) -> tuple[DesignTerm, ...]:
    model = [(e.name, p) for e in nominal.model.effects for p in e.parameters]
    known = [
        DesignTerm(effect, f"{effect}.{p.name}", p.unit, p.scale, float(nominal.theta[k]), False)
        for k, (effect, p) in enumerate(model)
        if k in set(nominal.live.tolist())
    ]
    extra = [(e.name, p) for e in against.effects for p in e.parameters]
    return tuple(known) + tuple(
        DesignTerm(effect, f"{effect}.{p.name}", p.unit, float(std), 0.0, True)
        for (effect, p), std in zip(extra, against.std, strict=True)
    )


def _layout(
    of: Candidates, mode: Mode, m: int, size: int
) -> tuple[tuple[tuple[int, tuple[str, ...]], ...], int, tuple[str, ...]]:
    """Return pose and loads of each unit, the most rows that one has, and notes.

    Loads are combined in fewer ways where memory would not do.
    """
    patterns, pattern = np.unique(of.allowed, axis=0, return_inverse=True)
    pattern = pattern.reshape(-1)
    tally = np.bincount(pattern, minlength=len(patterns))
    notes: tuple[str, ...] = ()
    kinds = (
        ({"each"},) if mode == "absolute" else ({"each", "pairs", "all"}, {"each", "all"}, {"all"})
    )
    for wanted in kinds:
        subsets = tuple(tuple(_subsets(np.flatnonzero(p), mode, wanted)) for p in patterns)
        height = m * max((len(s) for some in subsets for s in some), default=0)
        count = sum(int(n) * len(some) for n, some in zip(tally, subsets, strict=True))
        need = 8 * count * height * size
        if need <= MOST_BYTES:
            break
        notes = (f"{len(of)} candidates: loads are not combined in every way, for memory",)
    else:
        raise InputError(
            f"{len(of)} candidate poses with {size} parameters need {need / 1e9:.1f} GB; lower "
            "[planning] candidates, or plan against fewer effects"
        )
    if not count:
        raise CannotAnswerError(
            "no candidate pose may be taken"
            + (" both unloaded and under a load" if mode == "deflection" else "")
        )
    of_pose = [subsets[k] for k in pattern]
    what = tuple(
        (pose, tuple(of.loads[k] for k in s)) for pose, some in enumerate(of_pose) for s in some
    )
    return what, height, notes


def _subsets(allowed: Ints, mode: Mode, kinds: set[str]) -> Iterator[tuple[int, ...]]:
    """Yield the loads of each unit of a pose; `allowed` are indices of loads, 0 is unloaded."""
    if mode == "absolute":
        yield from ((int(k),) for k in allowed)
        return
    if 0 not in allowed:
        return
    loads = [int(k) for k in allowed if k > 0]
    if "each" in kinds:
        yield from ((k,) for k in loads)
    if "pairs" in kinds and 2 < len(loads) <= PAIRS_UP_TO:
        yield from combinations(loads, 2)
    if len(loads) > 1 or (loads and "each" not in kinds):
        yield tuple(loads)


def unit_rows(
    parts: Iterable[ReadingDerivatives],  # of every `step`-th candidate pose
    loads: tuple[str, ...],  # names of all loads, "none" first
    what: Sequence[tuple[int, tuple[str, ...]]],  # pose and loads of each unit
    mode: Mode,
    step: int = 1,
) -> Iterator[tuple[Ints, Floats]]:
    """Yield indices of units and their whitened rows (k, R, P), some poses at a time."""
    several: dict[tuple[str, ...], list[int]] = {}
    for k, (pose, names) in enumerate(what):
        if pose % step == 0:
            several.setdefault(names, []).append(k)
    pose_of = np.array([pose // step for pose, _ in what])
    for part in parts:
        single = absolute_rows(part) if mode == "absolute" else np.empty(0)
        for names, members in several.items():
            mine, which = np.array(members), tuple(loads.index(name) for name in names)
            mine = mine[(pose_of[mine] >= part.rows.start) & (pose_of[mine] < part.rows.stop)]
            at = pose_of[mine] - part.rows.start
            if mode == "absolute":
                yield mine, single[at, which[0]]
            else:
                yield mine, deflection_rows(part, at, which)


def readings_of(what: tuple[int, tuple[str, ...]], mode: Mode) -> tuple[str, ...]:
    """Loads of all readings of a unit, the unloaded one of a deflection included."""
    return what[1] if mode == "absolute" else (UNLOADED, *what[1])


def potential(nominal: NominalModel, config: CellConfig, of: Candidates) -> Potential:
    """Choose the families of `[planning] against`, with the sizes that arms have."""
    names = potential_names(config, nominal.model)
    known = nominal.model.catalogue
    families = tuple(build(known, name, nominal.cell, nominal.m) for name in names)
    std = expected_std(nominal.model, families)
    strength = _strengths(nominal, config, of, families, std)
    chosen: list[int] = []
    notes = [*random_columns(families)]
    room = MOST_PARAMETERS - len(nominal.live)
    for k in sorted(range(len(families)), key=lambda k: len(families[k].parameters)):
        family, rms = families[k], strength[k]
        if rms * MOST_TIMES < 1.0:
            notes.append(
                f"{family.name}: not planned for; {MOST_TIMES:g} times as large as arms have it, "
                f"it would change these readings by {MOST_TIMES * rms:.2g} σ"
            )
        elif len(family.parameters) > room:
            notes.append(
                f"{family.name}: not planned for; its {len(family.parameters)} parameters would "
                f"make more than {MOST_PARAMETERS}"
            )
        else:
            room -= len(family.parameters)
            chosen.append(k)
    place = np.cumsum([0, *(len(e.parameters) for e in families)])
    kept = [std[place[k] : place[k + 1]] for k in sorted(chosen)]
    return Potential(
        tuple(families[k] for k in sorted(chosen)),
        np.concatenate([np.zeros(0), *kept]),
        tuple(notes),
    )


def _strengths(
    nominal: NominalModel,
    config: CellConfig,
    of: Candidates,
    families: tuple[Effect, ...],
    std: Floats,  # (F,) of the families' parameters
) -> list[float]:
    """RMS of each family's whitened readings (single deflections) at its expected size."""
    if not families:
        return []
    sample = of[slice(None, None, -(-len(of) // SAMPLE))]
    scale = np.concatenate([scales_of(nominal.model)[nominal.live], std])
    squares, count = np.zeros(len(scale)), 0
    for part in reading_derivatives(nominal, config, sample, families, scale):
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


def information_of(nominal: NominalModel, more: tuple[Effect, ...], scale: Floats) -> Floats:
    """Return AᵀA (P, P) of the readings that the model was fitted to, and of a carried prior.

    A is the Jacobian at the fit, whitened by the readings' own covariances, by the live parameters
    and those of `more` effects in units of `scale` (P,). Effects that lack a column of the readings
    have no information.
    """
    fit, count = nominal.fit, len(nominal.live)
    known = np.zeros((len(scale), len(scale)))
    if nominal.carried is not None:
        known[:count, :count] = nominal.carried * (scale[:count, None] * scale[:count])
    if fit is None:
        return known
    ordinary = [scales_of(fit.model)[nominal.live]]
    s = fit.solution
    own = whitened_jacobian(fit.model, s.prediction, s.theta, fit.whitening, nominal.live)
    columns = [own * ordinary[0]]
    for e in more:
        ordinary.append(np.array([p.scale for p in e.parameters]))
        missing = np.zeros((len(fit.white), len(e.parameters)))
        columns.append(effect_columns(fit, e).white if computable(fit, e) else missing)
    a = np.hstack(columns) * (scale / np.concatenate(ordinary))
    return np.asarray(known + a.T @ a)
