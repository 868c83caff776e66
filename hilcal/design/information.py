"""The design problem: information and cost of each unit of measurement.

Potential terms are effects outside of the model that a plan should still be able to detect. Their
parameters have the prior N(0, s²) of the mixed model, with s typical of arms of any kind
(`mixed.families`). A plan is judged on all parameters together, so that it keeps power against
missing effects. Source: DuMouchel and Jones, *A simple Bayesian modification of D-optimal designs
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
    build_effect,
    expected_std,
    nominal_states,
    potential_names,
    random_columns,
)
from hilcal.effects.protocol import Effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.carried.carried_prior import scales_of
from hilcal.identification.gauss_newton import whitened_jacobian
from hilcal.identification.linearisation import computable, effect_columns
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

CHUNK = 4096  # states evaluated at once; a choice, for memory


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """N poses, each unloaded and under those of the L loads that it can bear."""

    q: Floats  # (N, n) joint angles, rad
    loads: tuple[str, ...]  # 1 + L names, "none" first
    wrench: Floats  # (1 + L, 6) at the load point, base axes, N and N·m
    allowed: Bools  # (N, 1 + L) allowed states

    def __len__(self) -> int:
        """Return the number of poses N."""
        return len(self.q)

    def __getitem__(self, rows: slice | list[int]) -> "Candidates":
        """Return the chosen poses."""
        return Candidates(self.q[rows], self.loads, self.wrench, self.allowed[rows])

    def states(self) -> States:
        """Return all N·(1 + L) states, pose by pose, with nominal times and approach directions."""
        q = np.repeat(self.q, len(self.loads), axis=0)
        return nominal_states(q, np.tile(self.wrench, (len(self), 1)))


@dataclass(frozen=True, slots=True, eq=False)
class ReadingDerivatives:
    """Derivatives and covariances of readings at a chunk of N poses under 1 + L loads."""

    rows: slice
    jacobian: Floats  # (N, 1 + L, m, P) of the m elements of one arrival by the parameters
    covariance: Floats  # (N, 1 + L, m, m) of the elements


def reading_derivatives(
    nominal: NominalModel,  # the model, whose live parameters come first
    config: CellConfig,
    candidates: Candidates,
    added: tuple[Effect, ...],  # effects that are not in the model
    scale: Floats,  # (P,) of the parameters, SI
) -> Iterator[ReadingDerivatives]:
    """Yield derivatives and covariances of candidates, some poses at a time."""
    model, m, loads = nominal.model, nominal.elements, len(candidates.loads)
    states, repeats = nominal.arrivals(candidates.states()), nominal.each
    count = len(scale) - len(nominal.live)
    live = np.concatenate([nominal.live, model.size + np.arange(count)])
    step = max(CHUNK // (loads * repeats), 1)
    for start in range(0, len(candidates), step):
        rows = slice(start, min(start + step, len(candidates)))
        count, per_pose = rows.stop - rows.start, loads * repeats
        p = model.predict(states[slice(rows.start * per_pose, rows.stop * per_pose)], nominal.theta)
        jacobian = model.jacobian_of((*model.effects, *added), p, nominal.theta, nominal.m, live)
        jacobian = (jacobian * scale).reshape(count, loads, m, len(scale))
        covariance = arrival_covariance(nominal, config, p).reshape(count, loads, m, m)
        yield ReadingDerivatives(rows, jacobian, covariance)


def absolute_rows(part: ReadingDerivatives) -> Floats:
    """Return whitened derivatives S⁻¹ J (N, 1 + L, m, P) of single readings, V = S Sᵀ."""
    return np.asarray(np.linalg.solve(np.linalg.cholesky(part.covariance), part.jacobian))


def deflection_rows(part: ReadingDerivatives, which: Ints, loads: tuple[int, ...]) -> Floats:
    """Return whitened derivatives (k, S·m, P) of deflections of k poses under S loads.

    Block (i, j) of their covariance is δ_ij V_i + V_u: all share the error of the unloaded reading.
    """
    jacobian, v = part.jacobian[which], part.covariance[which]
    count, _, m, size = jacobian.shape
    diagonal, columns = np.arange(len(loads)), list(loads)
    height = len(loads) * m
    change = (jacobian[:, columns] - jacobian[:, :1]).reshape(count, height, size)
    shape = (count, len(loads), m, len(loads), m)
    shared = np.broadcast_to(v[:, 0][:, None, :, None, :], shape).copy()
    shared[:, diagonal, :, diagonal, :] += np.moveaxis(v[:, columns], 1, 0)
    covariance = shared.reshape(count, height, height)
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), change))


def arrival_covariance(nominal: NominalModel, config: CellConfig, predicted: Prediction) -> Floats:
    """Return the covariance (N, T·m, T·m) of the T readings of each arrival; N·T states in order.

    The readings share the arm's repeatability: block (i, j) is δ_ij V_instrument + F_i F_jᵀ with
    F = R J Σ_q^½ (see `reading_covariance`).
    """
    single = reading_covariance(nominal, config, predicted)
    count, m, o, s = nominal.each, nominal.m, predicted.observation, predicted.situation
    if count == 1:
        return single
    jac = drive_jacobian(s.cell.arm, s.chain, o.base_position)
    joint_std = config.repeatability.per_joint(nominal.cell.arm.n)
    factor = scatter_factor(jac, joint_std, o.axes, m).reshape(-1, count * m, jac.shape[2])
    out = (factor @ np.swapaxes(factor, 1, 2)).reshape(-1, count, m, count, m)
    diagonal = np.arange(count)
    out[:, diagonal, :, diagonal, :] = np.moveaxis(single.reshape(-1, count, m, m), 1, 0)
    return out.reshape(-1, count * m, count * m)


def reading_covariance(nominal: NominalModel, config: CellConfig, predicted: Prediction) -> Floats:
    """Return the covariance (N, m, m) of means of K samples, with the arm's repeatability.

        V = (s + (1 − s)/K) Σ + R J Σ_q Jᵀ Rᵀ

    with Σ the tracker's stated covariance of one sample and s its systematic share. Sensor axes;
    m², m·rad, rad².
    """
    a, o, s, m = config.acquire, predicted.observation, predicted.situation, nominal.m
    stated = _instrument(nominal, config, predicted)
    out = expected_share_of_mean(a.samples, a.systematic_share) * stated
    joint_std = config.repeatability.per_joint(nominal.cell.arm.n)
    if np.any(joint_std):
        jac = drive_jacobian(s.cell.arm, s.chain, o.base_position)
        out = out + joint_scatter(jac, joint_std, o.axes, m)
    # elements that a reading of one number lacks: their noise is arbitrary
    unread = np.diagonal(out, axis1=1, axis2=2) == 0
    return np.asarray(out + unread[:, :, None] * np.eye(m))


def _instrument(nominal: NominalModel, config: CellConfig, predicted: Prediction) -> Floats:
    """Return the instrument's stated covariance (N, m, m); zero for elements that are not read."""
    o, m, t = predicted.observation, nominal.m, config.tracker
    number, observers = predicted.situation.states.observer, nominal.cell.observers
    if number is None or not observers:
        return tracker_covariance(o.position, tracker_noise(t), nominal.station, m)
    out = np.zeros((len(o.position), m, m))
    for k, observer in enumerate(observers):
        of_observer = number == k
        if observer.name.kind == "station":
            station = np.zeros(3) if k else nominal.station
            position = o.position[of_observer]
            out[of_observer] = tracker_covariance(position, tracker_noise(t), station, m)
            continue
        to_point = observer.name.kind == "point"
        section = (config.points if to_point else config.gauges).get(observer.name.name)
        std = None if section is None else section.std_m
        length = t.range_std_m + t.range_std_per_m * np.abs(o.position[of_observer, 0])
        out[of_observer, 0, 0] = np.square(length if std is None else std)
    return out


PAIRS_UP_TO = 4  # number of loads up to which pairs of loads are units, too; a choice
MOST_BYTES = 600_000_000  # of the rows of all units; a choice
MOST_PARAMETERS = 200
SAMPLE = 300  # candidate poses to judge strengths at; a choice
MOST_TIMES = 5.0  # a family below 1 σ at this factor on its expected size is omitted; a choice


@dataclass(frozen=True, slots=True)
class DesignTerm:
    """A parameter of the problem."""

    effect: str  # canonical name of its effect
    name: str  # as identification prints it, e.g. "joint_compliance.j1"
    unit: str  # SI
    scale: float  # ordinary magnitude, or s of a potential term, SI
    value: float  # assumed, SI
    potential: bool  # whether its effect is not in the model


@dataclass(frozen=True, slots=True, eq=False)
class DesignProblem:
    """The candidate units of a plan, their information, and the prior information."""

    nominal: NominalModel
    mode: Mode  # "deflection" or "absolute"
    candidates: Candidates
    units: CandidateSet  # K units; parameters of the model first, then potential terms
    contents: tuple[tuple[int, tuple[str, ...]], ...]  # pose and loads per unit; "none" is unloaded
    terms: tuple[DesignTerm, ...]
    families: tuple[Effect, ...]  # effects of the potential terms
    prior: Floats  # (P, P) information of priors and of the readings so far
    measured: Floats  # (P, P) information of the readings so far and of a carried prior
    notes: tuple[str, ...]  # on assumptions and omissions, one line each

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
        """(P,) scale of each parameter, SI."""
        return np.array([t.scale for t in self.terms])

    def of_effect(self, name: str) -> Ints:
        """Return the indices of an effect's parameters."""
        return np.flatnonzero([t.effect == name for t in self.terms])

    def information(self, counts: Floats) -> Floats:
        """Return the information (P, P) of a plan of counts (K,), prior included."""
        used = np.flatnonzero(counts)
        weight = np.asarray(counts, dtype=float)[used]
        return np.asarray(self.prior + self.units.information(weight, used))


def problem(
    nominal: NominalModel, config: CellConfig, q: Floats, allowed: Bools | None = None
) -> DesignProblem:
    """Return the design problem of candidate poses (N, n), rad, under the loads of a cell.

    `allowed` (N, 1 + L) are the allowed states; None: all.

    A unit of absolute positions is one reading. A unit of deflections is a pose with its unloaded
    reading and one load, all its loads, or, of few loads, a pair. The cost of a unit is its number
    of readings, the unloaded one included.
    """
    mode = config.planned_mode
    loads = (UNLOADED, *(load.name for load in config.loads))
    wrenches = (load.wrench(nominal.cell.gravity) for load in config.loads)
    if allowed is None:
        allowed = np.ones((len(q), len(loads)), dtype=np.bool_)
    wrench = np.array([np.zeros(6), *wrenches])
    candidates = Candidates(np.asarray(q, dtype=float), loads, wrench, allowed)
    families, std, notes = potential(nominal, config, candidates)
    terms = _terms(nominal, families, std)
    scale = np.array([t.scale for t in terms])
    contents, height, layout_notes = _layout(candidates, mode, nominal.elements, len(terms))
    rows = np.zeros((len(contents), height, len(terms)))
    parts = reading_derivatives(nominal, config, candidates, families, scale)
    for units, block in unit_rows(parts, candidates.loads, contents, mode):
        rows[units, : block.shape[1]] = block
    measured = information_of(nominal, families, scale)
    count = len(nominal.live)
    precision = np.ones(len(terms))
    precision[:count] = (scale[:count] / nominal.prior_std[nominal.live]) ** 2
    cost = np.array([float(len(readings_of(unit, mode))) for unit in contents])
    return DesignProblem(
        nominal=nominal, mode=mode, candidates=candidates, units=CandidateSet(rows, cost),
        contents=contents, terms=terms, families=families, prior=measured + np.diag(precision),
        measured=measured, notes=(*nominal.notes, *notes, *layout_notes),
    )  # fmt: skip


def _terms(
    nominal: NominalModel, families: tuple[Effect, ...], std: Floats
) -> tuple[DesignTerm, ...]:
    model = [(e.name, p) for e in nominal.model.effects for p in e.parameters]
    live = ((*model[k], float(nominal.theta[k])) for k in nominal.live)
    extra = [(e.name, p) for e in families for p in e.parameters]
    terms = [DesignTerm(e, f"{e}.{p.name}", p.unit, p.scale, v, False) for e, p, v in live]
    for (e, p), s in zip(extra, std, strict=True):
        terms.append(DesignTerm(e, f"{e}.{p.name}", p.unit, float(s), 0.0, True))
    return tuple(terms)


def _layout(
    candidates: Candidates, mode: Mode, m: int, size: int
) -> tuple[tuple[tuple[int, tuple[str, ...]], ...], int, tuple[str, ...]]:
    """Return pose and loads of each unit, the largest number of rows of a unit, and notes."""
    patterns, pattern = np.unique(candidates.allowed, axis=0, return_inverse=True)
    pattern = pattern.reshape(-1)
    tally = np.bincount(pattern, minlength=len(patterns))
    notes: tuple[str, ...] = ()
    kinds = (
        ({"each"},) if mode == "absolute" else ({"each", "pairs", "all"}, {"each", "all"}, {"all"})
    )
    for combined in kinds:
        subsets = tuple(tuple(_subsets(np.flatnonzero(p), mode, combined)) for p in patterns)
        height = m * max((len(s) for units in subsets for s in units), default=0)
        count = sum(int(n) * len(units) for n, units in zip(tally, subsets, strict=True))
        n_bytes = 8 * count * height * size
        if n_bytes <= MOST_BYTES:
            break
        notes = (f"{len(candidates)} candidates: loads are not combined in every way, for memory",)
    else:
        raise InputError(
            f"{len(candidates)} candidate poses with {size} parameters need "
            f"{n_bytes / 1e9:.1f} GB; lower [planning] candidates, or plan against fewer effects"
        )
    if not count:
        raise CannotAnswerError(
            "no candidate pose is allowed"
            + (" both unloaded and under a load" if mode == "deflection" else "")
        )
    units_of = ((pose, s) for pose, k in enumerate(pattern) for s in subsets[k])
    contents = tuple((pose, tuple(candidates.loads[k] for k in s)) for pose, s in units_of)
    return contents, height, notes


def _subsets(allowed: Ints, mode: Mode, kinds: set[str]) -> Iterator[tuple[int, ...]]:
    """Yield the loads of each unit of a pose, as indices; 0 is unloaded."""
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
    contents: Sequence[tuple[int, tuple[str, ...]]],  # pose and loads per unit
    mode: Mode,
    step: int = 1,
) -> Iterator[tuple[Ints, Floats]]:
    """Yield indices of units and their whitened rows (k, R, P), some poses at a time."""
    by_loads: dict[tuple[str, ...], list[int]] = {}
    for k, (pose, names) in enumerate(contents):
        if pose % step == 0:
            by_loads.setdefault(names, []).append(k)
    pose_of = np.array([pose // step for pose, _ in contents])
    for part in parts:
        single = absolute_rows(part) if mode == "absolute" else np.empty(0)
        for names, members in by_loads.items():
            units, columns = np.array(members), tuple(loads.index(name) for name in names)
            units = units[(pose_of[units] >= part.rows.start) & (pose_of[units] < part.rows.stop)]
            poses = pose_of[units] - part.rows.start
            if mode == "absolute":
                yield units, single[poses, columns[0]]
            else:
                yield units, deflection_rows(part, poses, columns)


def readings_of(unit: tuple[int, tuple[str, ...]], mode: Mode) -> tuple[str, ...]:
    """Return the loads of all readings of a unit, with the unloaded one of deflections."""
    return unit[1] if mode == "absolute" else (UNLOADED, *unit[1])


def potential(
    nominal: NominalModel, config: CellConfig, candidates: Candidates
) -> tuple[tuple[Effect, ...], Floats, tuple[str, ...]]:
    """Choose the families of `[planning] against`, with sizes typical of arms.

    Also return the standard deviation (F,) of each parameter, SI, and notes on omitted families.
    """
    if not len(candidates):
        return (), np.zeros(0), ()
    names = potential_names(config, nominal.model)
    catalogue = nominal.model.catalogue
    families = tuple(build_effect(catalogue, name, nominal.cell, nominal.m) for name in names)
    std = expected_std(nominal.model, families)
    strength = _strengths(nominal, config, candidates, families, std)
    chosen: list[int] = []
    notes = [*random_columns(families)]
    room = MOST_PARAMETERS - len(nominal.live)
    for k in sorted(range(len(families)), key=lambda k: len(families[k].parameters)):
        family, rms = families[k], strength[k]
        if rms * MOST_TIMES < 1.0:
            notes.append(
                f"{family.name}: not planned for; at {MOST_TIMES:g} times its usual size on arms "
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
    start = np.cumsum([0, *(len(e.parameters) for e in families)])
    stds = [std[start[k] : start[k + 1]] for k in sorted(chosen)]
    effects = tuple(families[k] for k in sorted(chosen))
    return effects, np.concatenate([np.zeros(0), *stds]), tuple(notes)


def _strengths(
    nominal: NominalModel,
    config: CellConfig,
    candidates: Candidates,
    families: tuple[Effect, ...],
    std: Floats,  # (F,) of the families' parameters
) -> list[float]:
    """Return the RMS of the whitened readings (single deflections) of each family of usual size."""
    if not families:
        return []
    sample = candidates[slice(None, None, -(-len(candidates) // SAMPLE))]
    scale = np.concatenate([scales_of(nominal.model)[nominal.live], std])
    squares, count = np.zeros(len(scale)), 0
    for part in reading_derivatives(nominal, config, sample, families, scale):
        allowed = sample.allowed[part.rows]
        if config.planning.readings == "absolute":
            rows = [absolute_rows(part)[allowed]]
        else:
            rows = [
                deflection_rows(part, np.flatnonzero(allowed[:, 0] & allowed[:, k]), (k,))
                for k in range(1, len(candidates.loads))
            ]
        for r in rows:
            squares += np.sum(r**2, axis=(0, 1))
            count += r.shape[0] * r.shape[1]
    ends = len(nominal.live) + np.cumsum([0, *(len(e.parameters) for e in families)])
    return [float(np.sqrt(squares[a:b].sum() / max(count, 1))) for a, b in pairwise(ends)]


def information_of(nominal: NominalModel, added: tuple[Effect, ...], scale: Floats) -> Floats:
    """Return the information (P, P) AᵀA of the readings so far, plus that of a carried prior.

    A is the Jacobian at the fit by the live parameters and those of `added` effects over `scale`
    (P,), whitened by the readings' covariances. Effects whose variables the readings lack have no
    information.
    """
    fit, count = nominal.fit, len(nominal.live)
    information = np.zeros((len(scale), len(scale)))
    if nominal.carried is not None:
        information[:count, :count] = nominal.carried * (scale[:count, None] * scale[:count])
    if fit is None:
        return information
    magnitudes = [scales_of(fit.model)[nominal.live]]
    s = fit.solution
    jacobian = whitened_jacobian(fit.model, s.prediction, s.theta, fit.whitening, nominal.live)
    columns = [jacobian * magnitudes[0]]
    for e in added:
        magnitudes.append(np.array([p.scale for p in e.parameters]))
        missing = np.zeros((len(fit.white), len(e.parameters)))
        columns.append(effect_columns(fit, e).white if computable(fit, e) else missing)
    a = np.hstack(columns) * (scale / np.concatenate(magnitudes))
    return np.asarray(information + a.T @ a)
