"""What a state brings about beside its load: sides, temperatures, time, and the joint angles."""

import numpy as np

from drivers.simulated.truth import Truth
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.robot.arm import Arm
from hilcal.types import Floats

LINK_REFERENCE = 20.0
"""Temperature at which links have their nominal length, °C (ISO 1)."""

_UNKNOWN_TORQUE = 150.0  # N·m, rated torque of a drive whose limit is not known
_CROSSING = 0.01  # of the rated torque: within it a joint crosses its play


def drive_errors(hidden: Truth, arm: Arm, states: States, reference: float) -> Floats:
    """Return the displacements (N, n) of the drives that do not depend on the load, rad.

    dq_j = o_j + h_j s_j + kappa_j (T_j - reference)
           + sum_k a_jk cos k q_j + b_jk sin k q_j

    Args:
        hidden: the parameters.
        arm: the arm.
        states: N states.
        reference: temperature at which joints do not drift, °C.

    Raises:
        InputError: hysteresis without approach sides, or drifting joints without their
            temperatures.
    """
    error = np.broadcast_to(hidden.encoder_offset, states.q.shape).copy()
    if np.any(hidden.hysteresis):
        if states.approach is None:
            raise InputError(
                "approach: hysteresis is hidden but the states name no side from which "
                "the joints arrived; valid: -1 or +1 per state and joint"
            )
        error += hidden.hysteresis * states.approach
    if np.any(hidden.thermal_joint_drift):
        error += hidden.thermal_joint_drift * (joint_temperature(states) - reference)
    order = np.arange(1, hidden.transmission_error.shape[1] + 1)
    phase = arm.drive_angles(states.q)[:, :, None] * order
    error += (np.cos(phase) * hidden.transmission_error[:, :, 0]).sum(axis=2)
    error += (np.sin(phase) * hidden.transmission_error[:, :, 1]).sum(axis=2)
    return error


def joint_temperature(states: States) -> Floats:
    """Return the (N, n) temperatures of the joints, °C.

    Raises:
        InputError: the states do not carry them.
    """
    if states.joint_temperature is None:
        raise InputError(
            "joint_temperature: thermal_joint_drift is hidden but the states carry no "
            "temperatures of the joints; valid: °C per state and joint"
        )
    return states.joint_temperature


def further_compliance(hidden: Truth, arm: Arm, states: States) -> Floats | None:
    """Return the (N, n) compliances of the drives beyond c_j, rad/(N·m); None: none anywhere.

    a_j cos 2 q_j + b_j sin 2 q_j + k c_j log10(1 + t / 1 s), q the commanded angle

    Raises:
        InputError: creep without the time under load.
    """
    extra: Floats | None = None
    if np.any(hidden.periodic_joint_compliance):
        cos, sin = hidden.periodic_joint_compliance.T
        angle = arm.drive_angles(states.q)
        extra = cos * np.cos(2.0 * angle) + sin * np.sin(2.0 * angle)
    if np.any(hidden.creep):
        if states.load_time is None:
            raise InputError(
                "load_time: creep is hidden but the states do not tell how long the load "
                "has hung; valid: seconds since its last change"
            )
        crept = hidden.creep * np.log10(1.0 + states.load_time)
        more = crept[:, None] * hidden.joint_compliance
        extra = more if extra is None else extra + more
    return extra


def crossing_torque(arm: Arm) -> Floats:
    """Return the (n,) torques tau_0 in b tanh(tau / tau_0), N·m: 1 % of the rated torque."""
    limit = np.asarray(arm.torque_max, dtype=float)
    rated = np.where(np.isfinite(limit) & (limit > 0.0), limit, _UNKNOWN_TORQUE)
    return np.asarray(_CROSSING * rated)


def link_growth(hidden: Truth, states: States) -> Floats | None:
    """Return the (N,) factor on all lengths of the links, 1 + alpha (T - 20 °C); None: 1.

    T is that of the air, or the mean of the joints' where the states do not carry it.

    Raises:
        InputError: growing links without any temperature.
    """
    if not np.any(hidden.thermal_growth):
        return None
    temperature = states.air_temperature
    if temperature is None and states.joint_temperature is not None:
        temperature = states.joint_temperature.mean(axis=1)
    if temperature is None:
        raise InputError(
            "air_temperature: thermal_growth is hidden but the states carry no temperature; "
            "valid: °C of the air, or of the joints"
        )
    return np.asarray(1.0 + hidden.thermal_growth * (temperature - LINK_REFERENCE))
