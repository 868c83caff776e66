"""A simulated cell with a hidden effect; campaigns in it, with or without simulated devices."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig
from hilcal.drivers.simulated import injected_effects as injected
from hilcal.drivers.simulated.cell_processes import SimulatedCell
from hilcal.drivers.simulated.truth import warm_up
from hilcal.drivers.simulated.user_effect import hidden_user_effect
from hilcal.drivers.simulated.world import SimulatedNoise, World
from hilcal.effects.catalogue import BUILT_IN, Catalogue
from hilcal.errors import InputError
from hilcal.measuring.route import approach_sides, route
from hilcal.readings.covariance import COVERS_KEY, INSTRUMENT_AND_ARM
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import Mode
from hilcal.shown import Brief
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import UNLOADED, Plan
from hilcal.toml import suggest
from hilcal.types import Floats, Ints

NO_EFFECT = "nothing"
RANDOM = "random"
INVENTED = "invented"  # a law that the catalogue lacks; see `invented_law`
REGISTRATION_XYZ = (2.4, -1.6, -0.5)
REGISTRATION_ROTVEC = (0.0, 0.0, 2.1)


def choices() -> tuple[str, ...]:
    """Effects that can be hidden; joint compliance is in every arm."""
    return tuple(e for e in injected.ALL_EFFECTS if e != "joint_compliance")


def user_choices(catalogue: Catalogue | None) -> tuple[str, ...]:
    """User's effects that can be hidden; see `user_effect`."""
    effects = () if catalogue is None else catalogue.with_role("effect")
    others = (k for k in effects if k not in BUILT_IN)
    return tuple(k.name for k in others if k.name not in injected.ALL_EFFECTS)


def invented_law(catalogue: Catalogue) -> Catalogue:
    """Return a catalogue with the invented law, for the world that hides it."""
    return catalogue.with_file(Path(__file__).with_name("invented.py"))


def check_choice(choice: str, catalogue: Catalogue | None = None) -> None:
    """Raise InputError, with the valid choices, for what cannot be hidden."""
    valid = (*choices(), *user_choices(catalogue), RANDOM, NO_EFFECT)
    if choice not in valid:
        raise InputError(f"hide {choice!r}{suggest(choice, valid)}; valid: {', '.join(valid)}")


@dataclass(frozen=True, slots=True, eq=False)
class SimulationCase(Brief):
    """A simulated cell with a hidden effect."""

    cell: Cell
    mode: Mode  # the kind of readings that shows the hidden effect
    world: World
    hidden: str  # the name of the hidden effect, or "nothing"
    strength_sigma: float  # rms of its change of the readings, in units of their noise
    home: Floats | None = field(default=None, kw_only=True)
    """(n,) joint values at the start; None without a plan."""

    @property
    def config(self) -> CellConfig:
        """The configuration of the cell."""
        return self.cell.configured()

    def measured(self, readings: Readings, config: CellConfig | None = None) -> "Rehearsal":
        """Return the campaign with these readings; `config`: None for that of the case."""
        case = {f.name: getattr(self, f.name) for f in fields(SimulationCase)}
        case["cell"] = self.cell.with_config(config or self.config)
        return Rehearsal(**case, readings=readings)


@dataclass(frozen=True, slots=True, eq=False)
class Rehearsal(SimulationCase):
    """A simulated campaign in a cell with a hidden effect."""

    readings: Readings

    def save(self, path: str | Path) -> None:
        """Write the readings to a new campaign file."""
        CampaignFile.create(
            Path(path),
            self.config.to_json(),
            str(self.cell.base_dir),
            "simulated campaign",
            more_texts={COVERS_KEY: INSTRUMENT_AND_ARM},
            readings=self.readings,
        ).close()


@dataclass(frozen=True, slots=True, eq=False)
class CampaignStates:
    """States of a campaign, in order, with the indices of pose, load and cycle."""

    states: States
    pose: Ints
    load: Ints
    cycle: Ints


def measurement_noise(config: CellConfig, samples: int = 1) -> SimulatedNoise:
    """Return the tracker's noise of the configuration, for the mean of `samples` measurements."""
    t = config.tracker
    share = config.acquire.systematic_share if samples > 1 else 0.0
    factor = float(np.sqrt(share + (1.0 - share) / samples))
    return SimulatedNoise(
        (factor * t.range_std_m, factor * t.range_std_per_m),
        (factor * t.transverse_std_m, factor * t.transverse_std_per_m),
        factor * t.orientation_std_rad,
    )


def program_config(
    config: CellConfig, choice: str, catalogue: Catalogue | None = None
) -> CellConfig:
    """Return the configuration that the program gets when an effect is hidden."""
    check_choice(choice, catalogue)
    if not config.loads and choice in injected.DEFLECTION_EFFECTS:
        valid = ", ".join(
            (*(e for e in choices() if e not in injected.DEFLECTION_EFFECTS), NO_EFFECT)
        )
        raise InputError(
            f"the cell has no [[loads]]; {choice}, which loads show, needs at least one; valid to "
            f"hide: {valid}"
        )
    if choice != "base_frame":
        return config
    registration = {"base_xyz_m": REGISTRATION_XYZ, "base_rotvec_rad": REGISTRATION_ROTVEC}
    return config.with_keys("tracker", **registration)


def simulation_case(
    config: CellConfig,
    choice: str,
    rng: np.random.Generator,
    visit: Callable[[Cell], CampaignStates],
    noise: SimulatedNoise,
    catalogue: Catalogue | None = None,
    base_dir: Path | None = None,
) -> SimulationCase:
    """Make a simulated cell and hide an effect in it, at the strength of `[simulation]`.

    `choice` is one of `choices()` or `user_choices(catalogue)`, "random" or "nothing"; the strength
    is that at the states which `visit` returns, with the tracker's `noise` of one reading.
    """
    config = program_config(config, choice, catalogue)
    cell = cell_from_config(config, base_dir)
    slides, hidden = bool(cell.arm.slides.any()), choice
    if choice in injected.OF_SLIDES and not slides:
        raise InputError(f"hide {choice}: no joint of {cell.arm.name} slides")
    if choice == RANDOM:  # a wrong registration shows only if one is configured
        excluded = ("base_frame", *(() if config.loads else injected.DEFLECTION_EFFECTS))
        excluded += () if slides else injected.OF_SLIDES
        hidden = str(rng.choice([e for e in choices() if e not in excluded]))
    v = visit(cell)
    law = None
    if catalogue is not None and hidden in user_choices(catalogue):
        law = hidden_user_effect(catalogue, hidden, cell, v.states)
    loaded = choice in injected.DEFLECTION_EFFECTS if law is None else law.effect.elastic
    mode: Mode = "deflection" if loaded and _paired(v) else "absolute"
    joint_std = config.repeatability.per_joint(cell.arm.n)
    world = injected.world_without_effect(cell, rng, noise=noise, joint_std=joint_std)
    strength = 0.0
    if hidden != NO_EFFECT:
        strength = config.simulation.strength_sigma
        world = injected.softened(world, hidden)
        effect = law or hidden
        world = injected.hide_effect(
            effect, cell, v.states, strength, mode, rng, world=world, pose=v.pose, cycle=v.cycle
        )
    return SimulationCase(cell, mode, world, hidden, strength)


def _paired(v: CampaignStates) -> bool:
    """Whether every loaded state has an unloaded one of its pose and cycle."""
    keys = list(zip(v.pose.tolist(), v.cycle.tolist(), strict=True))
    unloaded = {key for key, load in zip(keys, v.load.tolist(), strict=True) if load == 0}
    return bool(unloaded) and all(key in unloaded for key in keys)


def simulate(
    world: World,
    states: States,
    pose: Ints,
    load: Ints,
    cycle: Ints,
    load_names: Sequence[str],
    rng: np.random.Generator,
    m: int = 3,
) -> Readings:
    """Return the tracker's readings of N states, m = 3 or 6, with the covariance of each.

    `pose`, `load` (into `load_names`, "none" for unloaded) and `cycle` (N,) are the indices.
    """
    if m not in (3, 6):
        raise InputError(f"a reading has {m} elements; valid: 3 (position) or 6 (pose)")
    readings = Readings(
        states=states,
        pose=np.asarray(pose, dtype=np.int64),
        load=np.asarray(load, dtype=np.int64),
        cycle=np.asarray(cycle, dtype=np.int64),
        value=np.zeros((len(states), m)),
        covariance=np.zeros((len(states), m, m)),
        load_names=tuple(load_names),
        pose_names=tuple(f"p{i + 1}" for i in range(int(np.max(pose)) + 1)),
        target_names=world.cell.target_names if states.target is not None else (),
    )
    arrival, ideal = None, world.ideal_readings(states)
    if states.target is not None:
        arrival = readings.arrivals
        readings = replace(readings, common=ideal.jacobian[:, :m] * world.joint_std)
    value = world.observe(states, rng, m, arrival)
    return replace(readings, value=value, covariance=world.covariance(ideal, m))


_LOADING = 60.0  # s, to change a load
_MEASURING = 5.0  # s, to settle and to measure


def planned_states(cell: Cell, plan: Plan, start: float = 0.0) -> CampaignStates:
    """Return the N states of a plan's steps in order, with their times from `start` on, s.

    All targets are read at every step. The arm takes the route of a session; its joints warm up as
    with simulated devices.
    """
    config = cell.configured()
    names = [UNLOADED, *(load.name for load in config.loads)]
    wrenches = {load.name: load.wrench(cell.gravity) for load in config.loads}
    q = np.array([plan.joints(step.pose) for step in plan.steps])
    wrench = np.array([wrenches.get(step.load, np.zeros(6)) for step in plan.steps])
    load = np.array([names.index(step.load) for step in plan.steps])
    motion = np.diff(q, axis=0, prepend=q[:1] - 1.0)
    stops = route(plan, cell.arm, config.limits.joint_margin_rad)
    speed, acceleration = config.motion.speed_rad_s, config.motion.acceleration_rad_s2
    changed = np.diff(load, prepend=0) != 0
    count = len(cell.all_targets)
    resting = _MEASURING * count
    duration = np.abs(motion).max(axis=1) / speed + speed / acceleration + resting
    time = start + np.cumsum(duration + _LOADING * changed)
    hung = np.maximum.accumulate(np.where(changed, time - resting, start))
    row = np.repeat(np.arange(len(q)), count)
    target = np.tile(np.arange(count), len(q))
    delay = _MEASURING * target
    states = States(
        q=q[row],
        wrench=wrench[row],
        time=time[row] + delay,
        load_time=np.maximum(time - hung, 1.0)[row] + delay,
        joint_temperature=warm_up(time, cell.arm.n)[row],
        approach=approach_sides(stops)[row],
        target=None if cell.targets is None else target,
    )
    pose = np.array([plan.pose_names.index(step.pose) for step in plan.steps])
    cycle = np.array([step.cycle for step in plan.steps])
    return CampaignStates(states, pose[row], load[row], cycle[row])


def case_of_plan(
    config: CellConfig,
    plan: Plan,
    choice: str,
    seed: int,
    catalogue: Catalogue | None = None,
    base_dir: Path | None = None,
) -> SimulationCase:
    """Hide an effect in the simulated cell of a configuration.

    Its strength is that at the readings of the plan, each the mean of several measurements; the
    world's tracker has the noise of a single measurement.
    """
    rng = np.random.default_rng(seed)
    mean = measurement_noise(config, config.acquire.samples)
    case = simulation_case(
        config,
        choice,
        rng,
        lambda cell: planned_states(cell.with_config(config), plan),
        mean,
        catalogue,
        base_dir,
    )
    world = replace(case.world, noise=measurement_noise(config))
    return replace(case, world=world, home=plan.joints(plan.home))


def simulate_plan(
    s: SimulationCase, plan: Plan, seed: Sequence[int], start: float = 0.0
) -> Rehearsal:
    """Draw the readings of a plan, each a mean, from the time `start` of the campaign on, s."""
    config = s.config
    world = replace(s.world, noise=measurement_noise(config, config.acquire.samples))
    v = planned_states(s.cell, plan, start)
    names = (UNLOADED, *(load.name for load in config.loads))
    rng = np.random.default_rng(seed)
    readings = simulate(world, v.states, v.pose, v.load, v.cycle, names, rng)
    return replace(s, world=world).measured(replace(readings, pose_names=plan.pose_names))


@contextmanager
def simulated_cell(
    case: SimulationCase,
    seed: int,
    base_dir: Path,
    directory: Path | None = None,
    start_s: float = 0.0,
) -> Iterator[SimulatedCell]:
    """Run the simulated devices of a cell, their files in `directory`, until the block ends.

    The world's time starts at `start_s`, s.
    """
    with (
        tempfile.TemporaryDirectory(prefix="hilcal-") as temporary,
        SimulatedCell.start(
            case.world,
            case.config,
            directory or Path(temporary),
            seed,
            base_dir=base_dir,
            start_s=start_s,
            home=case.home,
        ) as cell,
    ):
        yield cell
