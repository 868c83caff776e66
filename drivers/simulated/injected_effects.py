"""Hide an effect in the simulated world: in a plausible direction, at a chosen strength."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.drivers.simulated.mechanics import rotation_vector
from hilcal.drivers.simulated.truth import Truth, joint_temperature, long_links, rated_torque
from hilcal.drivers.simulated.user_effect import HiddenUserEffect
from hilcal.drivers.simulated.world import IdealReading, SimulatedNoise, World, place_tracker
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.robot.arm import Arm
from hilcal.types import Floats, Ints

_DEFLECTION = np.array([2.0e-3, 2.6e-3, 1.35e-3, 1.7e-3, 2.0e-3, 2.2e-3])


def joint_compliance(arm: Arm, rng: np.random.Generator) -> Floats:
    """Draw the (n,) compliances of the drives, rad/(N·m), ±30 % per joint.

    A drive of any size deflects by about 2 mrad at its torque limit: 6 to 40 µrad/(N·m) on an arm
    of the UR10e's size (order of magnitude of harmonic drives, e.g. the stiffnesses K1..K3 against
    rated torque in the Harmonic Drive CSD/SHD catalogue); a slide deflects by 70 µm.
    """
    return typical_compliance(arm) * rng.uniform(0.7, 1.3, arm.n)


def typical_compliance(arm: Arm) -> Floats:
    """Return the (n,) mean of the drawn compliances, rad/(N·m)."""
    deflection = _DEFLECTION if arm.n == len(_DEFLECTION) else np.full(arm.n, 1.9e-3)
    return np.asarray(np.where(arm.slides, 7e-5, deflection) / typical_torque(arm))


def typical_torque(arm: Arm) -> Floats:
    """Return the (n,) torque or force limits of the drives; 100 N·m, 1500 N if unknown."""
    return rated_torque(arm, unknown=100.0)


def typical_tilt(arm: Arm) -> Floats:
    """Return (n,) twice the largest compliances drawn for the bearings, rad/(N·m)."""
    carriage = 2e-3 / (0.5 * typical_torque(arm))
    return np.where(arm.slides, carriage, typical_compliance(arm))


@dataclass(frozen=True, slots=True)
class Draw:
    """Draws one effect's parameters in a plausible direction and of a plausible size."""

    arm: Arm
    compliance: Floats  # (n,) the drives' compliances, for stiffening, rad/(N·m)
    torque: Floats  # (n,) the largest torque at each drive in the states, N·m
    harmonics: int = 6  # number of harmonics of the transmission error

    def effect(self, name: str, rng: np.random.Generator) -> Floats:
        """Return the parameters of the named effect, shaped as in `Truth`."""
        n, typical, order = self.arm.n, typical_compliance(self.arm), self.harmonics
        uniform, normal, slides = rng.uniform, rng.standard_normal, self.arm.slides
        decay = 1.0 / np.arange(1, order + 1)[:, None]
        tilt = typical_tilt(self.arm)
        plate = 0.3 * float(tilt[-1]) * np.array([0.5, 1.0])  # stiffer about its own axis
        heavy = np.maximum(self.arm.masses, 0.1)[:, None]
        draws: dict[str, Callable[[], Floats]] = {
            "joint_compliance": lambda: joint_compliance(self.arm, rng),
            "joint_stiffening": lambda: (
                -(uniform(0.7, 1.0, n) / 3.0) * self.compliance / self.torque**2
            ),
            "joint_tilt_compliance": lambda: 0.5 * tilt * uniform(0.3, 1.0, n),
            "base_compliance": lambda: 0.5 * float(tilt[0]) * uniform(0.3, 1.0, 3),
            "link_compliance": lambda: self._beams(rng),
            "hysteresis": lambda: 5e-5 * uniform(0.3, 1.0, n),
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
            # further elasticity, and errors of a force sensor
            "tool_compliance": lambda: plate * uniform(0.5, 1.0, 2),
            "periodic_joint_compliance": lambda: 0.1 * typical[:, None] * normal((n, 2)),
            "backlash": lambda: 5e-5 * uniform(0.3, 1.0, n),
            "creep": lambda: 0.03 * uniform(0.5, 1.5, 1),
            "wrench_bias": lambda: np.repeat([1.0, 0.1], 3) * normal(6),
            "wrench_gain": lambda: 1e-2 * normal(6),
            "sensor_misalignment": lambda: 1e-2 * normal(3),
            # temperature (steel to aluminium), wrong masses (centres some centimetres off), scale
            "thermal_growth": lambda: uniform(11e-6, 24e-6, 1),
            "thermal_joint_drift": lambda: 5e-6 * normal(n),
            "link_mass": lambda: 0.03 * heavy * normal((n, 3)),
            "tracker_scale": lambda: (
                5e-6 * rng.choice(np.array([-1.0, 1.0]), 1) * uniform(0.5, 1.5, 1)
            ),
        }
        return np.asarray(draws[name]())

    def _couplings(self, rng: np.random.Generator) -> Floats:
        """Draw k (n, n): each joint follows its predecessor, the last one also the last but two."""
        n = self.arm.n
        out = np.diag(rng.standard_normal(n - 1), -1) if n > 1 else np.zeros((n, n))
        if n > 2:
            out[n - 1, n - 3] = rng.standard_normal()
        same_kind = self.arm.slides[:, None] == self.arm.slides
        return np.asarray(2e-4 * out * same_kind)

    def _beams(self, rng: np.random.Generator) -> Floats:
        """Draw 1/EI and 1/GJ (b, 2) of tubes, each about half as compliant as a drive."""
        links = long_links(self.arm)
        length = np.linalg.norm(self.arm.links[links, :3, 3], axis=1)
        size = 0.5 * typical_tilt(self.arm)[:3].mean() / length
        return np.asarray(size[:, None] * [1.0, 1.3] * rng.uniform(0.5, 1.5, (len(links), 2)))


_SHOWN_BY_DEFLECTIONS = (
    "joint_compliance joint_tilt_compliance base_compliance link_compliance joint_stiffening "
    "hysteresis load_point tracker_drift tool_compliance periodic_joint_compliance backlash creep "
    "wrench_bias wrench_gain sensor_misalignment"
)
_CANCELLING = (
    "encoder_offset joint_coupling transmission_error link_geometry target_offset base_frame "
    "thermal_growth thermal_joint_drift link_mass tracker_scale"
)
DEFLECTION_EFFECTS = tuple(_SHOWN_BY_DEFLECTIONS.split())
"""Effects that a deflection shows; all other effects cancel in it to first order.

Thermal effects change little between an unloaded reading and the loaded ones that follow; a scale
error of parts per million changes a deflection by parts per million.
"""
EFFECTS = (*DEFLECTION_EFFECTS, *_CANCELLING.split())  # all that can be hidden in any arm
OF_SLIDES = ("guide_error",)  # only in arms with sliding joints
ALL_EFFECTS = (*EFFECTS, *OF_SLIDES)  # every effect that can be hidden

HARD_TO_SEPARATE = ("base_compliance", "link_compliance")
"""Effects that a campaign of six poses often cannot separate from each other or from
`joint_tilt_compliance`; `demo --ambiguous` draws arms until this happens."""
RESEMBLING = (*HARD_TO_SEPARATE, "joint_tilt_compliance")
"""Effects that few readings cannot distinguish."""

_SENSOR_ERRORS = ("wrench_bias", "wrench_gain", "sensor_misalignment")  # need a load
READINGS_MODES = ("absolute", "deflection")
_TOLERANCE = 1e-4
_TRIALS = 25
_SOFTER = 1.5  # a stiffening gear is softer at low torque (catalogues: K1 is about half of K3)
_TARGET_SCATTER = 2e-3  # m, scatter of an unknown target about its configured place


def world_without_effect(
    cell: Cell,
    rng: np.random.Generator,
    *,
    noise: SimulatedNoise | None = None,
    joint_std: float | Floats = 2e-5,
) -> World:
    """Return a world whose arm has joint compliance and no other error.

    An unknown registration or target of the cell is drawn. The default repeatability `joint_std`,
    rad, is 0.02 mm to 0.03 mm at the flange of an arm of 1.3 m.
    """
    registration, station = place_tracker(cell, rng)
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
    """Return a world with softer drives if `effect` is their stiffening, as real ones have."""
    if effect != "joint_stiffening":
        return world
    softer = _SOFTER * world.physics.joint_compliance
    return replace(world, physics=world.physics.with_effect("joint_compliance", softer))


def hide_effect(
    effect: str | HiddenUserEffect,
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
    """Return a world in which an effect is hidden at a given strength.

        sqrt(mean |W (r - r_0)|²) = strength_sigma

    r are the noise-free readings with the effect, r_0 without; W whitens by the covariance of a
    reading of m elements, 3 or 6. In deflection mode r is the loaded minus the unloaded reading of
    a pose, and W whitens this difference. The direction is drawn; the length is found by the secant
    method. The reference temperature of a thermal drift is that of the first state.

    `effect` is one of `ALL_EFFECTS`, a user's effect, or "none"; it is added to `world` (None: a
    new one). `pose` and `cycle` (N,) pair the readings of deflections; None: equal joints are one
    pose, and all states one cycle.
    """
    _check(effect, strength_sigma, readings_mode, m)
    if world is None:
        world = softened(world_without_effect(cell, rng), effect)
    if effect == "none" or strength_sigma == 0.0:
        return world
    if isinstance(effect, HiddenUserEffect):
        name, hidden, reference = effect.effect.name, _user_effect(effect, world, rng), world
    else:
        name = effect
        hidden, reference = _shipped_effect(effect, world, states, harmonics, rng)
    baseline = reference.ideal_readings(states)
    pairs = None if readings_mode == "absolute" else _pairs(states, pose, cycle)
    covariance = reference.covariance(baseline, m)
    if pairs is not None:
        covariance = covariance[pairs[0]] + covariance[pairs[1]]
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))

    def strength(factor: float) -> float:
        change = _change(hidden(factor).ideal_readings(states), baseline, m)
        if pairs is not None:
            change = change[pairs[0]] - change[pairs[1]]
        return float(np.sqrt(np.mean((whiten @ change[:, :, None]) ** 2)))

    return hidden(_scaled(strength, strength_sigma, name, readings_mode))


def _user_effect(
    law: HiddenUserEffect, world: World, rng: np.random.Generator
) -> Callable[[float], World]:
    """Return the world with a user's effect as a function of its strength."""
    direction = law.draw(rng)
    return lambda factor: replace(world, user_effect=replace(law, theta=factor * direction))


def _shipped_effect(
    effect: str, world: World, states: States, harmonics: int, rng: np.random.Generator
) -> tuple[Callable[[float], World], World]:
    """Return the world with an effect of `EFFECTS` as a function of its strength, and without."""
    if effect in _SENSOR_ERRORS and not np.any(states.wrench):
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
    if effect == "transmission_error":  # pad with zeros to the same number of harmonics
        order = max(start.shape[1], direction.shape[1])
        start, direction = (
            np.pad(value, ((0, 0), (0, order - value.shape[1]), (0, 0)))
            for value in (start, direction)
        )
    if effect == "joint_compliance":  # always present; hiding it sets its size
        start = np.zeros_like(start)
    clean = world.physics.with_effect(effect, start)

    def hidden(factor: float) -> World:
        return replace(world, physics=clean.with_effect(effect, start + factor * direction))

    return hidden, replace(world, physics=clean)


def _check(effect: str | HiddenUserEffect, strength: float, mode: str, m: int) -> None:
    if mode not in READINGS_MODES:
        raise InputError(f"readings {mode!r} is unknown; valid: {', '.join(READINGS_MODES)}")
    if m not in (3, 6):
        raise InputError(f"a reading has {m} elements; valid: 3 (position) or 6 (pose)")
    if not (np.isfinite(strength) and strength >= 0.0):
        raise InputError(f"strength {strength} sigma is not valid; valid: a number >= 0")
    if isinstance(effect, HiddenUserEffect):
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
    """Return the rows of the loaded readings and of their unloaded readings."""
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


def _change(changed: IdealReading, baseline: IdealReading, m: int) -> Floats:
    """Return the change of the readings, (N, m); rotations as rotation vectors."""
    shift = changed.position - baseline.position
    if m == 3:
        return shift
    turn = rotation_vector(changed.rotation @ np.swapaxes(baseline.rotation, 1, 2))
    return np.hstack([shift, turn])


def _scaled(strength: Callable[[float], float], goal: float, effect: str, mode: str) -> float:
    """Return the factor at which `strength` is `goal`, to 1e-4 of it, by the secant method."""
    old, new = 0.0, 1e-2
    why = "valid: a smaller strength, or states that the effect acts on"
    residual, new_residual = -goal, strength(new) - goal
    try:
        for _ in range(_TRIALS):
            if abs(new_residual) <= _TOLERANCE * goal:
                return new
            if new_residual == residual:
                break
            old, new = new, new - new_residual * (new - old) / (new_residual - residual)
            residual, new_residual = new_residual, strength(new) - goal
    except InputError as error:
        why = f"{error}; heavier loads or steadier readings reach further"
    raise InputError(
        f"effect {effect!r} cannot reach {goal:g} sigma in these states ({mode} readings): {why}"
    )
