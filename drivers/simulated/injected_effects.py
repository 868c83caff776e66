"""Hide an effect in the simulated world: a plausible direction, at a chosen strength."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.drivers.simulated.mechanics import rotation_vector
from hilcal.drivers.simulated.own_law import OwnLaw
from hilcal.drivers.simulated.truth import Truth, joint_temperature, long_links
from hilcal.drivers.simulated.world import IdealReading, SimulatedNoise, World, stand
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.robot.arm import Arm
from hilcal.types import Floats, Ints

_GIVE = np.array([2.0e-3, 2.6e-3, 1.35e-3, 1.7e-3, 2.0e-3, 2.2e-3])


def joint_compliance(arm: Arm, rng: np.random.Generator) -> Floats:
    """Draw the (n,) compliances of the drives, rad/(N·m), ±30 % per joint.

    A drive gives about 2 mrad at its torque limit, whatever its size: 6 to 40 µrad/(N·m) on
    an arm of the UR10e's size (order of magnitude of harmonic drives, e.g. the stiffnesses
    K1..K3 against rated torque in the Harmonic Drive CSD/SHD catalogue); a slide 70 µm.
    """
    return typical_compliance(arm) * rng.uniform(0.7, 1.3, arm.n)


def typical_compliance(arm: Arm) -> Floats:
    """Return the (n,) middle of the compliances that are drawn, rad/(N·m)."""
    give = _GIVE if arm.n == len(_GIVE) else np.full(arm.n, 1.9e-3)
    return np.asarray(np.where(arm.slides, 7e-5, give) / typical_torque(arm))


def typical_torque(arm: Arm) -> Floats:
    """Return the (n,) torque or force limits of the drives; 100 N·m, 1500 N where not known."""
    limit = np.asarray(arm.torque_max, dtype=float)
    unknown = np.where(arm.slides, 1500.0, 100.0)
    return np.asarray(np.where(np.isfinite(limit) & (limit > 0.0), limit, unknown))


def typical_tilt(arm: Arm) -> Floats:
    """Return the (n,) middle of twice the bearings' compliances, rad/(N·m)."""
    carriage = 2e-3 / (0.5 * typical_torque(arm))
    return np.where(arm.slides, carriage, typical_compliance(arm))


@dataclass(frozen=True, slots=True)
class Draw:
    """Draws one effect's parameters in a plausible direction and of a plausible size."""

    arm: Arm
    compliance: Floats  # (n,) the drives' compliances, which stiffening belongs to, rad/(N·m)
    torque: Floats  # (n,) the largest torque at each drive in the states at hand, N·m
    harmonics: int = 6  # number of harmonics of the transmission error

    def effect(self, name: str, rng: np.random.Generator) -> Floats:
        """Return the parameters of the named effect, shaped as in `Truth`."""
        n, typical, order = self.arm.n, typical_compliance(self.arm), self.harmonics
        even, normal, slides = rng.uniform, rng.standard_normal, self.arm.slides
        decay = 1.0 / np.arange(1, order + 1)[:, None]
        tilt = typical_tilt(self.arm)
        plate = 0.3 * float(tilt[-1]) * np.array([0.5, 1.0])  # stiffer about its own axis
        heavy = np.maximum(self.arm.masses, 0.1)[:, None]
        draws: dict[str, Callable[[], Floats]] = {
            "joint_compliance": lambda: joint_compliance(self.arm, rng),
            "joint_stiffening": lambda: (
                -(even(0.7, 1.0, n) / 3.0) * self.compliance / self.torque**2
            ),
            "joint_tilt_compliance": lambda: 0.5 * tilt * even(0.3, 1.0, n),
            "base_compliance": lambda: 0.5 * float(tilt[0]) * even(0.3, 1.0, 3),
            "link_compliance": lambda: self._beams(rng),
            "hysteresis": lambda: 5e-5 * even(0.3, 1.0, n),
            "encoder_offset": lambda: 2e-4 * normal(n),
            "joint_coupling": lambda: self._couplings(rng),
            "transmission_error": lambda: (
                np.where(slides, 2e-5, 1e-4)[:, None, None] * decay * normal((n, order, 2))
            ),
            "guide_error": lambda: 3e-5 * normal(Truth.rigid(self.arm).guide_error.shape),
            "link_geometry": lambda: 3e-4 * normal((n + 1, 6)),
            "load_point": lambda: 5e-3 * normal(3),
            "target_offset": lambda: 5e-3 * normal(3),
            "base_frame": lambda: 1e-3 * normal(6),
            "tracker_drift": lambda: np.repeat([1e-8, 3e-9], 3) * normal(6),
            # further elasticity, and what a force sensor misreads
            "tool_compliance": lambda: plate * even(0.5, 1.0, 2),
            "periodic_joint_compliance": lambda: 0.1 * typical[:, None] * normal((n, 2)),
            "backlash": lambda: 5e-5 * even(0.3, 1.0, n),
            "creep": lambda: 0.03 * even(0.5, 1.5, 1),
            "wrench_bias": lambda: np.repeat([1.0, 0.1], 3) * normal(6),
            "wrench_gain": lambda: 1e-2 * normal(6),
            "sensor_misalignment": lambda: 1e-2 * normal(3),
            # temperature (steel to aluminium), wrong masses (centres some centimetres off), scale
            "thermal_growth": lambda: even(11e-6, 24e-6, 1),
            "thermal_joint_drift": lambda: 5e-6 * normal(n),
            "link_mass": lambda: 0.03 * heavy * normal((n, 3)),
            "tracker_scale": lambda: (
                5e-6 * rng.choice(np.array([-1.0, 1.0]), 1) * even(0.5, 1.5, 1)
            ),
        }
        return np.asarray(draws[name]())

    def _couplings(self, rng: np.random.Generator) -> Floats:
        """Draw k (n, n) of joints that the one before, or the last but two, takes along."""
        n = self.arm.n
        out = np.diag(rng.standard_normal(n - 1), -1) if n > 1 else np.zeros((n, n))
        if n > 2:
            out[n - 1, n - 3] = rng.standard_normal()
        alike = self.arm.slides[:, None] == self.arm.slides
        return np.asarray(2e-4 * out * alike)

    def _beams(self, rng: np.random.Generator) -> Floats:
        """Draw 1/EI and 1/GJ (b, 2): a tube that gives as much as half a drive over its length."""
        which = long_links(self.arm)
        length = np.linalg.norm(self.arm.links[which, :3, 3], axis=1)
        size = 0.5 * typical_tilt(self.arm)[:3].mean() / length
        return np.asarray(size[:, None] * [1.0, 1.3] * rng.uniform(0.5, 1.5, (len(which), 2)))


_SHOWN_BY_DEFLECTIONS = (
    "joint_compliance joint_tilt_compliance base_compliance link_compliance joint_stiffening "
    "hysteresis load_point tracker_drift tool_compliance periodic_joint_compliance backlash creep "
    "wrench_bias wrench_gain sensor_misalignment"
)
_OTHERS = (
    "encoder_offset joint_coupling transmission_error link_geometry target_offset base_frame "
    "thermal_growth thermal_joint_drift link_mass tracker_scale"
)
DEFLECTION_EFFECTS = tuple(_SHOWN_BY_DEFLECTIONS.split())
"""Effects that a deflection shows; the others cancel in it to first order.

What changes with temperature changes little from an unloaded reading to the loaded ones that
follow it; a scale of parts in a million changes a deflection by as little.
"""
EFFECTS = (*DEFLECTION_EFFECTS, *_OTHERS.split())  # all that can be hidden in any arm
OF_SLIDES = ("guide_error",)  # those that only arms with joints that slide have
ALL_EFFECTS = (*EFFECTS, *OF_SLIDES)  # every effect that can be hidden

HARD_TO_SEPARATE = ("base_compliance", "link_compliance")
"""Effects that a campaign of six poses often does not separate from each other, or from
`joint_tilt_compliance`: `demo --ambiguous` draws arms until it does not."""
RESEMBLING = (*HARD_TO_SEPARATE, "joint_tilt_compliance")
"""Effects that few readings take for one another."""

_SAID = ("wrench_bias", "wrench_gain", "sensor_misalignment")  # need something to misread
READINGS_MODES = ("absolute", "deflection")
_TOLERANCE = 1e-4
_TRIALS = 25
_SOFTER = 1.5  # a gear that stiffens starts softer (catalogues: K1 is about half of K3)
_TARGET_SCATTER = 2e-3  # m, how far an unknown target sits from its configured place


def nothing_hidden(
    cell: Cell,
    rng: np.random.Generator,
    *,
    noise: SimulatedNoise | None = None,
    joint_std: float | Floats = 2e-5,
) -> World:
    """Return a world whose arm has joint compliance and nothing else that is wrong.

    Where the cell does not know its registration or its target, the world draws its own. The arm's
    repeatability `joint_std`, rad, is 0.02 mm to 0.03 mm at the flange of an arm of 1.3 m.
    """
    registration, station = stand(cell, rng)
    truth = Truth.rigid(cell.arm)
    truth = truth.with_effect("joint_compliance", joint_compliance(cell.arm, rng))
    offsets: Floats | None = None
    if cell.targets is not None:
        unknown = ~np.array(cell.known_targets)
        offsets = _TARGET_SCATTER * rng.standard_normal((len(unknown), 3)) * unknown[:, None]
    elif not cell.target_known:
        truth = truth.with_effect("target_offset", _TARGET_SCATTER * rng.standard_normal(3))
    return World(
        cell=cell,
        physics=truth,
        registration=registration,
        station=station,
        noise=noise or SimulatedNoise(),
        joint_std=np.broadcast_to(np.asarray(joint_std, dtype=float), (cell.arm.n,)).copy(),
        offsets=offsets,
    )


def softened(world: World, effect: object) -> World:
    """Return a world with softer drives where `effect` is that they stiffen, as real ones do."""
    if effect != "joint_stiffening":
        return world
    softer = _SOFTER * world.physics.joint_compliance
    return replace(world, physics=world.physics.with_effect("joint_compliance", softer))


def hide(
    effect: str | OwnLaw,
    cell: Cell,
    states: States,
    strength_sigma: float,
    readings_mode: str,
    rng: np.random.Generator,
    *,
    world: World | None = None,
    m: int = 3,
    pose: Ints | None = None,
    cycle: Ints | None = None,
    harmonics: int = 6,
) -> World:
    """Return a world in which one effect is hidden at the given strength.

        sqrt(mean |W (r - r_0)|²) = strength_sigma

    r are the noise-free readings with the effect, r_0 without, W whitens by the covariance
    of a reading of m elements, 3 or 6; in deflection mode r is the loaded minus the unloaded
    reading of one pose and W belongs to that difference. The direction is drawn; the length is
    found by secants. Joints that drift with temperature do so from the states' first one on.

    `effect` is one of `ALL_EFFECTS`, one of a user's own, or "none"; it is added to `world`, a
    fresh one when None. `pose` and `cycle` (N,) pair the readings of deflections; equal joints are
    one pose, and all states one cycle, when None.
    """
    _check(effect, strength_sigma, readings_mode, m)
    if world is None:
        world = softened(nothing_hidden(cell, rng), effect)
    if effect == "none" or strength_sigma == 0.0:
        return world
    hidden, reference = (
        _own(effect, world, rng)
        if isinstance(effect, OwnLaw)
        else _simulated(effect, world, states, harmonics, rng)
    )
    before = reference.sight(states)
    pairs = None if readings_mode == "absolute" else _pairs(states, pose, cycle)
    covariance = reference.covariance(before, m)
    if pairs is not None:
        covariance = covariance[pairs[0]] + covariance[pairs[1]]
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))

    def strength(factor: float) -> float:
        change = _change(hidden(factor).sight(states), before, m)
        if pairs is not None:
            change = change[pairs[0]] - change[pairs[1]]
        return float(np.sqrt(np.mean((whiten @ change[:, :, None]) ** 2)))

    name = effect.effect.name if isinstance(effect, OwnLaw) else effect
    return hidden(_scaled(strength, strength_sigma, name, readings_mode))


def _own(
    law: OwnLaw, world: World, rng: np.random.Generator
) -> tuple[Callable[[float], World], World]:
    """Return worlds with an effect of a user's own by its strength, and the one without."""
    direction = law.drawn(rng)

    def hidden(factor: float) -> World:
        return replace(world, own=replace(law, theta=factor * direction))

    return hidden, world


def _simulated(
    effect: str, world: World, states: States, harmonics: int, rng: np.random.Generator
) -> tuple[Callable[[float], World], World]:
    """Return worlds with an effect of `EFFECTS` by its strength, and the one without."""
    if effect in _SAID and not np.any(states.wrench):
        raise InputError(
            f"effect {effect!r} is an error of the measured load but no state has a load; "
            "valid: a wrench that is not zero in some states"
        )
    if effect == "thermal_joint_drift":
        first = 0 if states.time is None else int(np.argmin(states.time))
        world = replace(world, joint_reference=float(joint_temperature(states)[first].mean()))
    torque = np.maximum(
        np.abs(world.drive_torque(states)).max(axis=0), 0.1 * typical_torque(world.cell.arm)
    )
    draw = Draw(world.cell.arm, world.physics.joint_compliance, torque, harmonics)
    direction = draw.effect(effect, rng)
    start = getattr(world.physics, effect)
    if effect == "transmission_error":
        order = max(start.shape[1], direction.shape[1])
        start, direction = _padded(start, order), _padded(direction, order)
    if effect == "joint_compliance":  # always there; hiding it sets its size
        start = np.zeros_like(start)
    clean = world.physics.with_effect(effect, start)

    def hidden(factor: float) -> World:
        return replace(world, physics=clean.with_effect(effect, start + factor * direction))

    return hidden, replace(world, physics=clean)


def _check(effect: str | OwnLaw, strength: float, mode: str, m: int) -> None:
    if mode not in READINGS_MODES:
        raise InputError(f"readings {mode!r} is unknown; valid: {', '.join(READINGS_MODES)}")
    if m not in (3, 6):
        raise InputError(f"a reading has {m} elements; valid: 3 (position) or 6 (pose)")
    if not (np.isfinite(strength) and strength >= 0.0):
        raise InputError(f"strength {strength} sigma cannot be; valid: a number >= 0")
    if isinstance(effect, OwnLaw):
        return
    if effect not in (*ALL_EFFECTS, "none"):
        valid = ", ".join((*ALL_EFFECTS, "none"))
        raise InputError(f"effect {effect!r} is unknown; valid: {valid}")
    if mode == "deflection" and effect not in (*DEFLECTION_EFFECTS, "none"):
        raise InputError(
            f'effect {effect!r} cancels in deflections; valid with readings "deflection": '
            f"{', '.join((*DEFLECTION_EFFECTS, 'none'))}"
        )


def _pairs(states: States, pose: Ints | None, cycle: Ints | None) -> tuple[Ints, Ints]:
    """Return the rows of the loaded readings and of the unloaded ones that they belong to."""
    if pose is None:
        pose = np.unique(states.q, axis=0, return_inverse=True)[1].reshape(-1)
    if cycle is None:
        cycle = np.zeros(len(states), dtype=np.int64)
    loaded = np.any(states.wrench != 0.0, axis=1)
    target = np.zeros_like(pose) if states.target is None else states.target
    first: dict[tuple[int, int, int], int] = {}
    for row in np.flatnonzero(~loaded):
        first.setdefault((int(pose[row]), int(cycle[row]), int(target[row])), int(row))
    rows = np.flatnonzero(loaded)
    if not len(rows):
        raise InputError("states: no loaded reading; valid: one with a wrench that is not zero")
    keys = [(int(pose[row]), int(cycle[row]), int(target[row])) for row in rows]
    for row, key in zip(rows, keys, strict=True):
        if key not in first:
            raise InputError(
                f"state {row}: pose {key[0]} has no unloaded reading in cycle {key[1]}; "
                "valid: one state with a zero wrench per pose and cycle"
            )
    return rows, np.array([first[key] for key in keys])


def _change(after: IdealReading, before: IdealReading, m: int) -> Floats:
    """Return by how much the readings changed, (N, m); rotations as a small rotation."""
    shift = after.position - before.position
    if m == 3:
        return shift
    turn = rotation_vector(after.rotation @ np.swapaxes(before.rotation, 1, 2))
    return np.hstack([shift, turn])


def _padded(value: Floats, order: int) -> Floats:
    """Return (n, order, 2) harmonics, with zeros for those that are not there."""
    return np.pad(value, ((0, 0), (0, order - value.shape[1]), (0, 0)))


def _scaled(strength: Callable[[float], float], wanted: float, effect: str, mode: str) -> float:
    """Return the factor at which `strength` is `wanted`, to 1e-4 of it, by secants."""
    old, new = 0.0, 1e-2
    why = "valid: a smaller strength, or states that the effect acts on"
    below, above = -wanted, strength(new) - wanted
    try:
        for _ in range(_TRIALS):
            if abs(above) <= _TOLERANCE * wanted:
                return new
            if above == below:
                break
            old, new = new, new - above * (new - old) / (above - below)
            below, above = above, strength(new) - wanted
    except InputError as error:
        why = f"{error}; heavier loads or steadier readings reach further"
    raise InputError(
        f"effect {effect!r} cannot reach {wanted:g} sigma in these states ({mode} readings): {why}"
    )
