"""One reading as a row of the campaign, and everything raw behind it as JSON."""

from dataclasses import fields
from typing import Any

import numpy as np

from hilcal.measuring.devices import ArmSample, Losses, TrackerSample, WrenchSample
from hilcal.measuring.force import TaredWrench
from hilcal.measuring.measure import MeasuredStop
from hilcal.readings.readings import Readings, States
from hilcal.store.plan import Step
from hilcal.types import Floats


def reading_of(
    step: Step,
    q: Floats,
    measured: MeasuredStop,
    wrench: Floats,
    time: float,
    load_time: float,
    side: Floats,
    joint_temperature: Floats | None,
    torque: Floats | None = None,
    target: int | None = None,
    target_names: tuple[str, ...] = (),
) -> Readings:
    """Return one reading; its covariance is the instrument's alone.

    Args:
        step: which one.
        q: (n,) commanded joint angles, rad.
        measured: what was measured.
        wrench: (6,) of the load at the load point, base axes, N and N·m.
        time: since the campaign's start, cell s.
        load_time: since the load's last change, cell s.
        side: (n,) from which each joint arrived, -1 or +1.
        joint_temperature: (n,) °C; None in a campaign without.
        torque: (n,) that the drives were measured to exert, N·m, NaN where this reading has none;
            None in a campaign without.
        target: number of the target that was read; None where there is one.
        target_names: the cell's names of them.
    """
    states = States(
        q=q[None].copy(),
        wrench=wrench[None].copy(),
        time=np.array([time]),
        load_time=np.array([load_time]),
        joint_temperature=None if joint_temperature is None else joint_temperature[None].copy(),
        approach=side[None].copy(),
        q_actual=measured.q[None].copy(),
        torque=None if torque is None else torque[None].copy(),
        target=None if target is None else np.array([target]),
    )
    return Readings(
        states=states,
        pose=np.zeros(1, dtype=np.int64),
        load=np.zeros(1, dtype=np.int64),
        cycle=np.array([step.cycle], dtype=np.int64),
        value=measured.mean.value[None].copy(),
        covariance=measured.mean.covariance[None].copy(),
        load_names=(step.load,),
        pose_names=(step.pose,),
        target_names=() if target is None else target_names,
    )


def detail(
    step: Step,
    measured: MeasuredStop,
    tared: TaredWrench | None,
    zero: Floats | None,
    session: dict[str, Any],
) -> dict[str, Any]:
    """Return everything raw behind a reading.

    `tared` is the mean wrench against the session's zero (6,), None without a force sensor;
    `session` has further keys: times, losses, sides.
    """
    out: dict[str, Any] = {
        "pose": step.pose,
        "load": step.load,
        "cycle": step.cycle,
        "value": measured.mean.value.tolist(),
        "tracker_covariance": measured.mean.covariance.tolist(),
        "scatter": measured.mean.scatter,
        "left_out": list(measured.mean.left_out),
        "q_actual": measured.q.tolist(),
        "torque": None if measured.torque is None else measured.torque.tolist(),
        "settling_s": measured.settling,
        "remarks": list(measured.remarks),
        "arm_before": sample_json(measured.before),
        "arm_after": sample_json(measured.after),
        "tracker": [sample_json(sample) for sample in measured.tracker],
        "force": sample_json(measured.force),
    }
    if tared is not None and zero is not None:
        out["felt"] = {
            "wrench": tared.wrench.tolist(),
            "covariance": tared.covariance.tolist(),
            "zero": zero.tolist(),
        }
    return out | session


def stored_wrench(stored: dict[str, Any]) -> TaredWrench | None:
    """Return the mean wrench in a stored detail; None without one."""
    felt = stored.get("felt")
    if felt is None:
        return None
    return TaredWrench(
        np.array(felt["wrench"]), np.array(felt["covariance"]), np.array(stored["q_actual"])
    )


def sample_json(sample: ArmSample | TrackerSample | WrenchSample | Losses | None) -> Any:
    """Return a sample as a JSON object with the names of its fields; arrays as lists."""
    if sample is None:
        return None
    return {f.name: _value(getattr(sample, f.name)) for f in fields(sample)}


def _value(value: Any) -> Any:
    """Return a JSON value; what is not a finite number becomes null."""
    if isinstance(value, np.ndarray):
        return [_value(x) for x in value.tolist()]
    if isinstance(value, list):
        return [_value(x) for x in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value
