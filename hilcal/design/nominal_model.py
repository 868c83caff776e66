"""The nominal model of a plan: the effects to be fitted, at ordinary parameters."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell, plane_frame, tracker_place
from hilcal.config import CellConfig
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.effects.options import Options
from hilcal.effects.protocol import FRAME_ROLES, Effect
from hilcal.effects.written import read_effects_text
from hilcal.errors import InputError
from hilcal.identification.carried.carried_prior import (
    CarriedPrior,
    check_arm,
    coordinates_of,
    prior_of,
    scales_of,
)
from hilcal.identification.fit import Fit, require_gc
from hilcal.mixed.families import families_of
from hilcal.model.model import Model
from hilcal.readings.readings import ObserverKind, ObserverName, States
from hilcal.robot import se3
from hilcal.types import Floats, Ints

DISTANCE = 2.0  # of a tracker of unknown place from the base, over the arm's reach; a choice
FRAME_PRIOR = {"prior_m": 3e-3, "prior_rad": 6e-3}
"""Prior of frames where deflections are planned, which frames only rotate: absolute positions
determine frames up to the arm's elastic sag."""
DURATION_S = 3600.0
LOAD_TIMES_S = (5.0, 100.0)
TEMPERATURES = (25.0, 35.0)  # of joints that warm up during a campaign, °C
_SEED = 20240607


@dataclass(frozen=True, slots=True, eq=False)
class NominalModel:
    """The model that a plan is made for."""

    model: Model  # of unknown frames and effects, with a registered cell
    theta: Floats  # (P,) parameters, SI
    live: Ints  # (L,) indices of the parameters not held at zero
    prior_std: Floats  # (P,) prior standard deviations, SI; infinite without a prior
    station: Floats  # (3,) start of the beam, sensor axes, m
    m: int  # elements of a reading: 3 or 6
    fit: Fit | None  # of the readings so far; None without readings
    notes: tuple[str, ...]  # on assumptions, one line each
    carried: Floats | None = None  # (L, L) information of a carried prior, 1/SI²

    @property
    def elements(self) -> int:
        """Elements measured in one arrival: m of each target by each observer."""
        return self.m * self.each

    @property
    def each(self) -> int:
        """Readings in one arrival: of each target by each observer."""
        return len(self.cell.all_targets) * max(len(self.cell.observers), 1)

    def arrivals(self, states: States) -> States:
        """Return N states, each repeated for every reading of its arrival."""
        targets, observers = len(self.cell.all_targets), len(self.cell.observers)
        if targets == 1 and not observers:
            return states
        several = states[np.repeat(np.arange(len(states)), self.each)]
        number = np.arange(len(several)) % self.each
        if targets > 1:
            several = replace(several, target=number % targets)
        return replace(several, observer=number // targets) if observers else several

    @property
    def cell(self) -> Cell:
        """The cell, registered."""
        return self.model.cell


def nominal_model(
    cell: Cell,
    m: int = 3,  # 3 for positions, 6 for poses
    catalogue: Catalogue | None = None,  # the installed effects by default
    # of another campaign. Its effects enter the model, except families with a shared prior, which
    # enter only if named, and effects that need variables which a plan does not fix.
    prior: CarriedPrior | None = None,
) -> NominalModel:
    """Return the model of `[planning]`: baseline parameters at ordinary values, others zero.

    A plan hardly depends on the values: deflections are linear in them to about 1e-3.
    """
    config = cell.configured()
    catalogue = catalogue or installed()
    place, configured = nominal_tracker_place(cell)
    notes = []
    cell = _observed(cell, place)
    if not configured and not (cell.observers and all(o.tied for o in cell.observers)):
        shown = ", ".join(f"{v:.2g}" for v in place)
        notes.append(
            f"the tracker's place is not configured: assumed at [{shown}] m in base axes "
            "(give [sight] tracker_m)"
        )
    registered, station = _registered(cell, place)
    frames = catalogue.unknown_frames(registered)
    chosen = {name: dict[str, object]() for name in frames} | planned_effects(config, catalogue)
    of_prior = {} if prior is None else _effects_of_prior(prior, registered, catalogue, m)
    chosen = {name: options or of_prior.get(name, {}) for name, options in chosen.items()}
    chosen |= {name: o for name, o in of_prior.items() if name not in chosen}
    if config.planning.readings == "deflection":
        chosen |= {name: {**FRAME_PRIOR, **chosen[name]} for name in frames}
    effects = tuple(build_effect(catalogue, name, registered, m, o) for name, o in chosen.items())
    model = Model(registered, effects, catalogue, prior=prior)
    parts = [(e.role == "baseline") * np.array([p.scale for p in e.parameters]) for e in effects]
    notes += random_columns(effects)
    theta = np.concatenate(parts)
    prior_std, groups = prior_of(model)  # a shrunk family is ordinary
    prior_std = np.where(groups >= 0, scales_of(model), prior_std)
    if prior is not None:
        s = prior.posterior.source
        prefix = f"{s.campaign}: " if s.campaign else ""
        notes.append(
            f"planned with the prior of another campaign ({prefix}{s.n_readings} readings)"
        )
    live = np.arange(model.size)
    carried = carried_information(model, live)
    return NominalModel(model, theta, live, prior_std, station, m, None, tuple(notes), carried)


def _effects_of_prior(
    prior: CarriedPrior, cell: Cell, catalogue: Catalogue, m: int
) -> dict[str, dict[str, object]]:
    """Return the effects of a prior that a plan can include, with their options."""
    check_arm(prior, cell.arm)
    plain = nominal_states(np.zeros((1, 1)), np.zeros((1, 6)))
    included = {}
    for e in prior.posterior.effects:
        if catalogue[e.name].computable(plain):
            options = dict(e.options)
            if build_effect(catalogue, e.name, cell, m, options).groups() is None:
                included[e.name] = options
    return included


def carried_information(model: Model, live: Ints) -> Floats | None:
    """Return the information (L, L) of a model's carried prior on its live parameters, 1/SI²."""
    if model.prior is None:
        return None
    if model.prior.drift is None:
        model = replace(model, prior=model.prior.with_drift(model.prior.least_drift))
    coordinates = coordinates_of(model)
    rows = coordinates.inverse[coordinates.std == 1.0]
    information = np.zeros((model.size, model.size))
    information[np.ix_(coordinates.index, coordinates.index)] = rows.T @ rows
    return information[np.ix_(live, live)]


def model_after(fit: Fit, config: CellConfig) -> NominalModel:
    """Return the nominal model of further readings, from the fit of the readings so far."""
    require_gc(fit, "a plan of further readings")
    cell, prior = replace(fit.model.cell, registration_known=True), fit.solution.prior
    configured = cell.with_config(config)
    _, station = _registered(configured, nominal_tracker_place(configured)[0])
    # the fit scales its priors by the noise factor β
    std = np.where(np.isinf(prior), np.inf, prior / np.sqrt(fit.solution.beta))
    std[fit.solution.space.index] = np.inf
    count = len(fit.readings) - int(fit.outlier.sum())
    origin = f"planned from {count} readings, fitted with {fit.model.title}"
    notes = (origin, *random_columns(fit.model.effects))
    live, m = np.flatnonzero(fit.solution.estimated), fit.readings.m
    carried = carried_information(fit.model, live)
    return NominalModel(fit.model, fit.theta, live, std, station, m, fit, notes, carried)


def build_effect(
    catalogue: Catalogue, name: str, cell: Cell, m: int, options: Options | None = None
) -> Effect:
    """Make an effect for a plan, from a first and a last reading in one pose."""
    one_state = nominal_states(np.zeros((1, cell.arm.n)), np.zeros((1, 6)))
    states = replace(one_state[np.zeros(2, dtype=int)], time=np.array([0.0, DURATION_S]))
    return catalogue.make(name, cell, states, options, m)


def random_columns(effects: tuple[Effect, ...]) -> tuple[str, ...]:
    """Name the effects whose variables a plan has to draw at random, one line each."""
    fixed = nominal_states(np.zeros((1, 1)), np.zeros((1, 6)))
    for e in effects:
        if e.role not in FRAME_ROLES and not type(e).computable(fixed):
            raise InputError(
                f"effect {e.name} needs {', '.join(e.needs)}, which a plan does not fix; leave "
                "it out"
            )
    return tuple(
        f"{e.name}: {', '.join(e.needs)} of the readings drawn at random, as in a shuffled order"
        for e in effects
        if e.needs
    )


def planned_effects(config: CellConfig, catalogue: Catalogue) -> dict[str, dict[str, object]]:
    """Return the effects of `[planning] model` with their options, in the syntax of `--effects`."""
    try:
        return read_effects_text(", ".join(config.planning.model), "effects", catalogue)
    except InputError as error:
        raise InputError(f"[planning] model: {error}") from None


def valid_effects(names: tuple[str, ...], key: str, catalogue: Catalogue) -> tuple[str, ...]:
    """Return the names of effects without duplicates; refuse unknown ones."""
    for name in names:
        try:
            catalogue[name]
        except InputError as error:
            raise InputError(f"{key}: {error}") from None
    return tuple(dict.fromkeys(names))


def check_effects(cell: Cell, catalogue: Catalogue) -> None:
    """Refuse effects of a configuration that a plan cannot include."""
    config = cell.configured()
    try:
        model = nominal_model(cell, catalogue=catalogue).model
    except InputError as error:
        message = str(error)
        prefix = "" if message.startswith("[planning]") else "[planning] model: "
        raise InputError(prefix + message) from None
    potential_names(config, model)
    for section in ("plausible", "ordinary"):
        valid_effects(tuple(getattr(config, section)), f"[{section}]", catalogue)


def potential_names(config: CellConfig, model: Model) -> tuple[str, ...]:
    """Return the names of the effects of `[planning] against`, without those of the model.

    "catalogue" excludes effects whose variables, such as time, depend on the order of a plan.
    """
    against, cell = config.planning.against, model.cell
    if against == "catalogue":
        kinds = (k for k in model.catalogue.effects if k.applies(cell))
        names = tuple(k.name for k in kinds if not k.needs and k.role not in FRAME_ROLES)
    else:
        names = valid_effects(against, "[planning] against", model.catalogue)
    return tuple(name for name in names if name not in model.names)


def expected_std(model: Model, effects: tuple[Effect, ...]) -> Floats:
    """Return the standard deviations (F,), SI, of the parameters of effects outside of a model.

    They are those of the mixed model's families; of a frame, which has none, the ordinary ones.
    """
    alone = replace(model, effects=effects, random={}, background=frozenset(), prior=None)
    std = scales_of(alone)
    for f in families_of(alone).random:
        std[f.parameters] = np.exp(f.prior.mean) * f.magnitude
    return std


def nominal_tracker_place(cell: Cell) -> tuple[Floats, bool]:
    """Return the tracker's place (3,), base axes, m, and whether it is configured."""
    place, reach = tracker_place(cell), cell.arm.reach
    if place is not None:
        return place, True
    return np.array([DISTANCE * reach, 0.0, 0.5 * reach]), False


def nominal_states(q: Floats, wrench: Floats) -> States:
    """Return N states with random times, temperatures and directions of approach."""
    rng = np.random.default_rng(_SEED)
    time, approach = rng.uniform(0.0, DURATION_S, len(q)), rng.choice([-1.0, 1.0], q.shape)
    load_time, warm = rng.uniform(*LOAD_TIMES_S, len(q)), rng.uniform(*TEMPERATURES, q.shape)
    air = rng.uniform(*TEMPERATURES, len(q))  # a model may have effects of either thermometer
    return States(q, wrench, time, load_time, air, warm, approach)


def _registered(cell: Cell, place: Floats) -> tuple[Cell, Floats]:
    """Return the cell with a registration, and the start of the beam (3,), sensor axes, m."""
    if cell.configured().tracker.frame == "base":
        return cell, place
    if cell.registration_known or cell.observers:
        return cell, np.zeros(3)
    registration = np.eye(4)
    registration[:3, 3] = -place
    return replace(cell, registration=registration), np.zeros(3)


def _observed(cell: Cell, place: Floats) -> Cell:
    """Return the cell with the observers of `[tracker]`; a plane of unknown place is level."""
    config = cell.configured()
    kind: ObserverKind = "point" if config.tracker.observes == "distance" else "gauge"
    if config.tracker.observes == "position":
        return cell
    listed = tuple(config.points if kind == "point" else config.gauges) or ("tracker",)
    observed = cell.observed_by([ObserverName(kind, name) for name in listed])
    observers = []
    for k, o in enumerate(observed.observers):
        if o.tied:
            observers.append(o)
            continue
        turn = se3.rotation(np.array([0.0, 0.0, 2.0 * np.pi * k / len(listed)]))
        frame = plane_frame(np.array([0.0, 0.0, 1.0]), place)
        if kind == "point":
            frame = se3.matrix(np.eye(3), -turn @ place)
        observers.append(replace(o, frame=frame))
    return replace(observed, observers=tuple(observers))
