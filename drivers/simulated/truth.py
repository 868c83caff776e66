"""The hidden parameters of a simulated world, named like the effects that they cause."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np

from drivers.simulated.elastic_tree import long_links
from hilcal.robot.arm import Arm
from hilcal.types import Floats

_AXES = ("x", "y", "z")
_TURNS = ("rx", "ry", "rz")
_TWIST = (*_AXES, *_TURNS)
_WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")
_LABELS: dict[str, tuple[str, ...]] = {
    "base_frame": _TWIST,
    "tracker_drift": _TWIST,
    "base_compliance": _AXES,
    "load_point": _AXES,
    "target_offset": _AXES,
    "tool_compliance": ("along", "across"),
    "creep": ("k",),
    "thermal_growth": ("alpha",),
    "wrench_bias": _WRENCH,
    "wrench_gain": _WRENCH,
    "sensor_misalignment": _TURNS,
    "tracker_scale": ("scale",),
}


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What the program under test must find out; SI, all zero where nothing is hidden.

    Attributes:
        joint_compliance: (n,) rad/(N·m).
        joint_stiffening: (n,) s in dq = c tau + s tau³, rad/(N·m)³.
        joint_tilt_compliance: (n,) rad/(N·m).
        base_compliance: (3,) about x, y, z of the base, rad/(N·m).
        link_compliance: (b, 2) 1/EI and 1/GJ of the long links, 1/(N·m²).
        hysteresis: (n,) h in dq = h s, rad.
        encoder_offset: (n,) rad.
        joint_coupling: (n, n) k in dq_j = sum_i k_ji q_i, q as commanded, 1.
        transmission_error: (n, h, 2) a_k, b_k in dq = sum a_k cos k q + b_k sin k q, rad;
            q is the commanded angle.
        link_geometry: (n + 1, 6) twist of everything beyond slot k, its axes, m and rad.
        load_point: (3,) the load acts so far from its configured point, flange axes, m.
        target_offset: (3,) the same of the tracked target, flange axes, m.
        base_frame: (6,) twist of the base against its registration, base axes, m and rad.
        tracker_drift: (6,) twist rate of the readings about the station, tracker axes, m/s
            and rad/s: the station itself moves the other way.
        tool_compliance: (2,) of the flange by the moment there, along and across its z axis,
            rad/(N·m).
        periodic_joint_compliance: (n, 2) a, b in dq = tau (a cos 2q + b sin 2q), rad/(N·m).
        backlash: (n,) b in dq = b tanh(tau / tau_0), rad.
        creep: (1,) k in dq = k c tau log10(1 + t / 1 s), 1 per decade of the load's time t.
        thermal_growth: (1,) alpha: every link's translation grows by alpha (T - 20 °C), 1/K.
        thermal_joint_drift: (n,) kappa in dq = kappa (T_j - reference), rad/K.
        link_mass: (n, 3) first moments of the bodies beyond their own, body axes, kg·m.
        wrench_bias: (6,) of the force sensor, flange axes, N and N·m.
        wrench_gain: (6,) error of the gain of its six channels, 1.
        sensor_misalignment: (3,) its axes are turned against the flange, rotation vector, rad.
        tracker_scale: (1,) s: positions read (1 + s) times as long, 1.
    """

    joint_compliance: Floats
    joint_stiffening: Floats
    joint_tilt_compliance: Floats
    base_compliance: Floats
    link_compliance: Floats
    hysteresis: Floats
    encoder_offset: Floats
    joint_coupling: Floats
    transmission_error: Floats
    link_geometry: Floats
    load_point: Floats
    target_offset: Floats
    base_frame: Floats
    tracker_drift: Floats
    tool_compliance: Floats
    periodic_joint_compliance: Floats
    backlash: Floats
    creep: Floats
    thermal_growth: Floats
    thermal_joint_drift: Floats
    link_mass: Floats
    wrench_bias: Floats
    wrench_gain: Floats
    sensor_misalignment: Floats
    tracker_scale: Floats

    @staticmethod
    def rigid(arm: Arm, harmonics: int = 0) -> "Truth":
        """Return the truth of an arm that is perfect and rigid."""
        n = arm.n
        return Truth(
            joint_compliance=np.zeros(n),
            joint_stiffening=np.zeros(n),
            joint_tilt_compliance=np.zeros(n),
            base_compliance=np.zeros(3),
            link_compliance=np.zeros((len(long_links(arm)), 2)),
            hysteresis=np.zeros(n),
            encoder_offset=np.zeros(n),
            joint_coupling=np.zeros((n, n)),
            transmission_error=np.zeros((n, harmonics, 2)),
            link_geometry=np.zeros((n + 1, 6)),
            load_point=np.zeros(3),
            target_offset=np.zeros(3),
            base_frame=np.zeros(6),
            tracker_drift=np.zeros(6),
            tool_compliance=np.zeros(2),
            periodic_joint_compliance=np.zeros((n, 2)),
            backlash=np.zeros(n),
            creep=np.zeros(1),
            thermal_growth=np.zeros(1),
            thermal_joint_drift=np.zeros(n),
            link_mass=np.zeros((n, 3)),
            wrench_bias=np.zeros(6),
            wrench_gain=np.zeros(6),
            sensor_misalignment=np.zeros(3),
            tracker_scale=np.zeros(1),
        )

    def with_effect(self, effect: str, value: Floats) -> "Truth":
        """Return the same truth with one effect's parameters replaced."""
        return replace(self, **{effect: value})

    def named(self, arm: Arm) -> dict[str, float]:
        """Return every parameter that is not zero, as "effect.part": value in SI."""
        out: dict[str, float] = {}
        for f in fields(self):
            values = getattr(self, f.name)
            labels = _labels(f.name, values.shape, arm)
            for label, value in zip(labels, values.ravel(), strict=True):
                if value != 0.0:
                    out[f"{f.name}.{label}"] = float(value)
        return out


def _labels(effect: str, shape: tuple[int, ...], arm: Arm) -> Iterator[str]:
    """Yield the labels of one effect's parameters in the order of their array."""
    if effect == "transmission_error":
        for j in range(shape[0]):
            for k in range(shape[1]):
                yield from (f"j{j + 1}.cos{k + 1}", f"j{j + 1}.sin{k + 1}")
    elif effect == "joint_coupling":
        for j in range(shape[0]):
            yield from (f"j{j + 1}.q{i + 1}" for i in range(shape[1]))
    elif effect == "link_geometry":
        for k in range(shape[0]):
            yield from (f"link{k}.{part}" for part in _TWIST)
    elif effect == "link_compliance":
        for k in long_links(arm):
            yield from (f"link{k}.bend", f"link{k}.twist")
    elif effect == "link_mass":
        for k in range(shape[0]):
            yield from (f"link{k + 1}.{axis}" for axis in _AXES)
    elif effect == "periodic_joint_compliance":
        for j in range(shape[0]):
            yield from (f"j{j + 1}.cos2", f"j{j + 1}.sin2")
    elif effect in _LABELS:
        yield from _LABELS[effect]
    else:
        yield from (f"j{j + 1}" for j in range(shape[0]))
