"""The hidden parameters of a simulated world, named like the effects that they cause; their laws.

The laws here are those of joint angles, approach sides, temperatures and time, and of the errors of
a force sensor; those of the load are in `mechanics`.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import pinocchio as pin

from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.robot.arm import Arm
from hilcal.types import Floats, Ints

_AXES = ("x", "y", "z")
_TURNS = ("rx", "ry", "rz")
_TWIST = (*_AXES, *_TURNS)
_WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")
_GUIDE = {"x": (2, 3, 4), "y": (2, 3, 4), "z": (1,)} | dict.fromkeys(_TURNS, (1, 2, 3, 4))
"""Orders of the Legendre polynomials of a guide's motion errors, by direction."""


def long_links(arm: Arm) -> Ints:
    """Return the indices k of at most two links between joints, over a third of the longest."""
    lengths = np.linalg.norm(arm.links[1:-1, :3, 3], axis=1)
    longest = np.argsort(-lengths, kind="stable")[:2]
    return np.sort(longest[lengths[longest] > lengths.max() / 3.0]) + 1


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The parameters that the program under test must find; SI, all zero if nothing is hidden."""

    joint_compliance: Floats  # (n,) rad/(N·m)
    joint_stiffening: Floats  # (n,) s in dq = c tau + s tau³, rad/(N·m)³
    joint_tilt_compliance: Floats  # (n,) rad/(N·m)
    base_compliance: Floats  # (3,) about x, y, z of the base, rad/(N·m)
    link_compliance: Floats  # (b, 2) 1/EI and 1/GJ of the long links, 1/(N·m²)
    hysteresis: Floats  # (n,) h in dq = h s, rad
    encoder_offset: Floats  # (n,) rad
    joint_coupling: Floats  # (n, n) k in dq_j = sum_i k_ji q_i, q as commanded, 1
    transmission_error: Floats
    """(n, h, 2) a_k, b_k in dq = sum a_k cos k q + b_k sin k q, rad; q is the commanded angle."""
    link_geometry: Floats  # (n + 1, 6) twist of all beyond slot k, in its axes, m and rad
    load_point: Floats  # (3,) offset of the load's point of action, flange axes, m
    target_offset: Floats  # (3,) offset of the tracked target, flange axes, m
    base_frame: Floats  # (6,) twist of the base against its registration, base axes, m and rad
    tracker_drift: Floats
    """(6,) twist rate of the readings about the station, tracker axes, m/s and rad/s; the station
    moves in the opposite direction."""
    tool_compliance: Floats
    """(2,) compliance of the flange to moments along and across its z axis, rad/(N·m)."""
    periodic_joint_compliance: Floats  # (n, 2) a, b in dq = tau (a cos 2q + b sin 2q), rad/(N·m)
    backlash: Floats  # (n,) b in dq = b tanh(tau / tau_0), rad
    creep: Floats  # (1,) k in dq = k c tau log10(1 + t / 1 s), 1 per decade of the load's time t
    thermal_growth: Floats  # (1,) alpha: every link's translation grows by alpha (T - 20 °C), 1/K
    thermal_joint_drift: Floats  # (n,) kappa in dq = kappa (T_j - reference), rad/K
    link_mass: Floats  # (n, 3) errors of the bodies' first moments, body axes, kg·m
    wrench_bias: Floats  # (6,) of the force sensor, flange axes, N and N·m
    wrench_gain: Floats  # (6,) errors of the gains of its six channels, 1
    sensor_misalignment: Floats  # (3,) rotation vector of its axes against the flange, rad
    guide_error: Floats
    """(g, 19) of the g joints that slide: amplitudes of Legendre polynomials, over the travel as -1
    to 1, of the carriage's motion: x and y of orders 2 to 4, z of order 1, m; rx, ry and rz of
    orders 1 to 4, rad."""
    tracker_scale: Floats  # (1,) s: positions are read multiplied by 1 + s, 1

    @staticmethod
    def rigid(arm: Arm, harmonics: int = 0) -> "Truth":
        """Return the truth of a perfect, rigid arm."""

        def zeros(effect: str) -> Floats:
            out = np.zeros([len(axis) for axis in _labels(effect, arm, harmonics)])
            return out.reshape(arm.n, harmonics, 2) if effect == "transmission_error" else out

        return Truth(**{f.name: zeros(f.name) for f in fields(Truth)})

    def with_effect(self, effect: str, value: Floats) -> "Truth":
        """Return the truth with one effect's parameters replaced."""
        return replace(self, **{effect: value})

    def nonzero_parameters(self, arm: Arm) -> dict[str, float]:
        """Return the parameters that are not zero, as "effect.part": value in SI."""
        out: dict[str, float] = {}
        for f in fields(self):
            axes = _labels(f.name, arm, self.transmission_error.shape[1])
            values = getattr(self, f.name).ravel()
            for parts, value in zip(itertools.product(*axes), values, strict=True):
                if value != 0.0:
                    out[".".join((f.name, *parts))] = float(value)
        return out


def _labels(effect: str, arm: Arm, harmonics: int) -> tuple[Sequence[str], ...]:
    """Return the labels of one effect's parameters along each axis of their array."""
    joints, links = [f"j{j + 1}" for j in range(arm.n)], [f"link{k}" for k in range(arm.n + 1)]
    waves = [f"{part}{k + 1}" for k in range(harmonics) for part in ("cos", "sin")]
    errors = [f"{kind}{k}" for kind, orders in _GUIDE.items() for k in orders]
    axes: dict[str, tuple[Sequence[str], ...]] = {
        "base_frame": (_TWIST,),
        "tracker_drift": (_TWIST,),
        "base_compliance": (_AXES,),
        "load_point": (_AXES,),
        "target_offset": (_AXES,),
        "tool_compliance": (("along", "across"),),
        "creep": (("k",),),
        "thermal_growth": (("alpha",),),
        "wrench_bias": (_WRENCH,),
        "wrench_gain": (_WRENCH,),
        "sensor_misalignment": (_TURNS,),
        "tracker_scale": (("scale",),),
        "transmission_error": (joints, waves),
        "joint_coupling": (joints, [f"q{i + 1}" for i in range(arm.n)]),
        "link_geometry": (links, _TWIST),
        "link_compliance": ([links[k] for k in long_links(arm)], ("bend", "twist")),
        "link_mass": (links[1:], _AXES),
        "guide_error": ([joints[j] for j in np.flatnonzero(arm.slides)], errors),
        "periodic_joint_compliance": (joints, ("cos2", "sin2")),
    }
    return axes.get(effect, (joints,))


LINK_REFERENCE = 20.0  # temperature at which links have their nominal length, °C (ISO 1)

_CROSSING = 0.01  # share of the rated torque within which a joint crosses its play


AIR = 22.0  # air temperature of the simulated devices' cell and of a rehearsal's start, °C

_WARM_START = 4.0  # °C above the air at the world's start
_WARM_RISE = np.array([9.0, 11.0, 10.0, 8.0, 8.0, 7.0])  # °C above the air at the end
_WARM_TIME = 2400.0  # s, time constant of the warm-up


def warm_up(time: Floats, n: int = 6) -> Floats:
    """Return the (N, n) temperatures of the joints in the simulated devices' cell, °C.

    T = air + rise + (start - rise) exp(-t / 2400 s), with `time` (N,) since its start, s.
    """
    decay = np.exp(-np.asarray(time) / _WARM_TIME)[:, None]
    rise = np.resize(_WARM_RISE, n)
    return np.asarray(AIR + rise + (_WARM_START - rise) * decay)


def required_column(effect: str, name: str, values: Floats | None, missing_text: str) -> Floats:
    """Return a column of the states that a hidden effect needs; else raise `missing_text`."""
    if values is None:
        raise InputError(f"{name}: {effect} is hidden but the states {missing_text}")
    return values


def joint_errors(hidden: Truth, arm: Arm, states: States, reference: float) -> Floats:
    """Return the joint displacements (N, n) that do not depend on the load, rad.

    dq_j = o_j + h_j s_j + kappa_j (T_j - reference) + sum_k a_jk cos k q_j + b_jk sin k q_j
           + sum_i k_ji q_i

    where the errors of the first line are the drives'; `reference` is the temperature without
    drift, °C. A slide's guide adds its displacement along the travel.
    """
    error = np.broadcast_to(hidden.encoder_offset, states.q.shape).copy()
    if np.any(hidden.hysteresis):
        lack = "name no side from which the joints arrived; valid: -1 or +1 per state and joint"
        error += hidden.hysteresis * required_column(
            "hysteresis", "approach", states.approach, lack
        )
    if np.any(hidden.thermal_joint_drift):
        error += hidden.thermal_joint_drift * (joint_temperature(states) - reference)
    order = np.arange(1, hidden.transmission_error.shape[1] + 1)
    phase = arm.phases(states.q)[:, :, None] * order
    error += (np.cos(phase) * hidden.transmission_error[:, :, 0]).sum(axis=2)
    error += (np.sin(phase) * hidden.transmission_error[:, :, 1]).sum(axis=2)
    error = np.asarray(arm.driven(error) + states.q @ hidden.joint_coupling.T)
    guided = guide_motion(hidden, arm, states)
    if guided is not None:
        error[:, arm.slides] += guided[:, :, 2]
    return error


def guide_motion(hidden: Truth, arm: Arm, states: States) -> Floats | None:
    """Return the (N, g, 6) motion errors of the carriages, z along the guide; None if zero."""
    if not np.any(hidden.guide_error):
        return None
    slides = arm.slides
    low, high = arm.q_min[slides], arm.q_max[slides]
    s = 2.0 * (states.q[:, slides] - low) / (high - low) - 1.0
    curves = (s, 1.5 * s**2 - 0.5, 2.5 * s**3 - 1.5 * s, 4.375 * s**4 - 3.75 * s**2 + 0.375)
    out = np.zeros((*s.shape, 6))
    terms = [(i, k) for i, kind in enumerate(_TWIST) for k in _GUIDE[kind]]
    for column, (i, k) in enumerate(terms):
        out[:, :, i] += hidden.guide_error[:, column] * curves[k - 1]
    return out


def joint_temperature(states: States) -> Floats:
    """Return the (N, n) temperatures of the joints, °C."""
    lack = "carry no temperatures of the joints; valid: °C per state and joint"
    return required_column(
        "thermal_joint_drift", "joint_temperature", states.joint_temperature, lack
    )


def further_compliance(hidden: Truth, arm: Arm, states: States) -> Floats | None:
    """Return the (N, n) additions to the drives' compliances c_j, rad/(N·m); None: zero.

    a_j cos 2 q_j + b_j sin 2 q_j + k c_j log10(1 + t / 1 s), q the commanded angle
    """
    extra: Floats | None = None
    if np.any(hidden.periodic_joint_compliance):
        cos, sin = hidden.periodic_joint_compliance.T
        angle = arm.phases(states.q)
        extra = cos * np.cos(2.0 * angle) + sin * np.sin(2.0 * angle)
    if np.any(hidden.creep):
        lack = "do not state how long the load has hung; valid: seconds since its last change"
        time = required_column("creep", "load_time", states.load_time, lack)
        growth = hidden.creep * np.log10(1.0 + time)
        creep = growth[:, None] * hidden.joint_compliance
        extra = creep if extra is None else extra + creep
    return extra


def rated_torque(arm: Arm, unknown: float) -> Floats:
    """Return the (n,) torque or force limits of the drives; `unknown` N·m, 1500 N if unknown."""
    limit = np.asarray(arm.torque_max, dtype=float)
    known = np.isfinite(limit) & (limit > 0.0)
    return np.where(known, limit, np.where(arm.slides, 1500.0, unknown))


def crossing_torque(arm: Arm) -> Floats:
    """Return the (n,) torques tau_0 in b tanh(tau / tau_0), N·m: 1 % of the rated torque."""
    return np.asarray(_CROSSING * rated_torque(arm, unknown=150.0))


def link_growth(hidden: Truth, states: States) -> Floats | None:
    """Return the (N,) factor on lengths, 1 + alpha (T - 20 °C), T of air or joints; None: 1."""
    if not np.any(hidden.thermal_growth):
        return None
    temperature = states.air_temperature
    if temperature is None and states.joint_temperature is not None:
        temperature = states.joint_temperature.mean(axis=1)
    lack = "carry no temperature; valid: °C of the air, or of the joints"
    temperature = required_column("thermal_growth", "air_temperature", temperature, lack)
    return np.asarray(1.0 + hidden.thermal_growth * (temperature - LINK_REFERENCE))


@dataclass(frozen=True, slots=True, eq=False)
class Misreading:
    """acting = G (reading - b), both at the load point, in the axes of the body that carries it.

    The sensor reads b + diag(1 + g) exp([delta])ᵀ acting, so G = exp([delta]) diag(1 / (1 + g)),
    the same rotation for force and moment.
    """

    gain: Floats  # (6, 6) G
    bias: Floats  # (6,) b, N and N·m

    @classmethod
    def of(cls, truth: Truth) -> "Misreading | None":
        """Return the misreading of a truth, flange axes; None for a perfect sensor."""
        parts = (truth.wrench_bias, truth.wrench_gain, truth.sensor_misalignment)
        if not any(np.any(part) for part in parts):
            return None
        if np.any(truth.wrench_gain <= -1.0):
            raise InputError(
                f"wrench_gain {truth.wrench_gain.tolist()}: a channel would read nothing, or "
                "backwards; valid: errors over -1"
            )
        turn = np.asarray(pin.exp3(truth.sensor_misalignment))
        return cls(_both(turn) / (1.0 + truth.wrench_gain), truth.wrench_bias)

    def in_axes(self, axes: Floats) -> "Misreading":
        """Return the misreading in other axes; `axes` (3, 3) maps present components into them."""
        turn = _both(axes)
        return Misreading(turn @ self.gain @ turn.T, turn @ self.bias)


def _both(turn: Floats) -> Floats:
    """Return the (6, 6) rotation of force and moment."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = turn
    return out
