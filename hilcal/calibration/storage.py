"""A calibration as one JSON file with everything that predicting and compensating needs.

The covariance is stored in the smaller of two forms. One is its factor, as 32-bit floats, each row
scaled by its parameter's standard deviation. The other (key `learnt`) is the source that it is
computed from, if that reproduces the standard deviations at fitted states to `STD_TOLERANCE`, which
is checked before writing. Everything else is decimal numbers, exactly.
"""

import base64
import json
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from hilcal import __version__, limits
from hilcal.calibration.calibration import Calibration
from hilcal.calibration.covariance_source import CovarianceSource
from hilcal.calibration.measured import CONDITION_NAMES, Condition, MeasuredRanges, SensorMount
from hilcal.calibration.scatter import Scatter
from hilcal.cell import Cell, Observer
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.effects.protocol import Effect
from hilcal.errors import InputError
from hilcal.identification.prediction.collinear_conditions import CONDITIONS, DEGREE, Proxy
from hilcal.identification.prediction.other_temperatures import OtherTemperatures
from hilcal.identification.registration.robot_frames import state_with_every_column
from hilcal.model.model import Model
from hilcal.readings.readings import ObserverName
from hilcal.readings.whitening import MODES
from hilcal.robot.arm import Arm
from hilcal.store.codec import decode, encode, frames, numbers, read_document
from hilcal.types import Floats

FORMAT, VERSION = "hilcal-calibration", 2
FACTOR_VERSION = 1  # version of a file with the factor of the covariance, which older programs read
STD_TOLERANCE = 5e-3  # largest relative change of a standard deviation by the source form; a choice
CHECKED_STATES = 40  # fitted states at which that is checked
_CELL = (
    *("target", "load_point", "tool_mass", "tool_com", "gravity", "registration", "targets"),
    *("target_names", "known_targets", "registration_known", "measured_torques"),
)


def to_json(c: Calibration) -> dict[str, object]:
    """Return a calibration as JSON, SI."""
    cell = c.model.cell
    std, source = np.sqrt(np.einsum("pk,pk->p", c.covariance_root, c.covariance_root)), _source(c)
    covariance: dict[str, object] = {"learnt": source}
    if source is None:
        scaled = c.covariance_root / np.where(std > 0, std, 1.0)[:, None]
        text = base64.b64encode(scaled.astype("<f4").tobytes()).decode("ascii")
        covariance = {"covariance_root": text}
    observers = [
        encode(o.name) | {"free": o.free, "offset_m": o.offset, "frame": o.frame}
        for o in cell.observers
    ]
    content = {
        "format": FORMAT,
        "version": FACTOR_VERSION if source is None else VERSION,
        "hilcal": __version__,
        "source": dict(c.source),
        "readings": c.mode,
        "arm": cell.arm,
        "cell": {**{name: getattr(cell, name) for name in _CELL}, "observers": observers},
        "effects": [{"name": e.name, "options": dict(e.options)} for e in c.model.effects],
        "parameters": [f"{e.name}.{p.name}" for e in c.model.effects for p in e.parameters],
        "theta": c.theta,
        "std": std,
        **covariance,
        "misfit_m2": c.misfit,
        "scatter": {**encode(c.scatter), "known": c.scatter.known},
        "measured": c.measured,
        "conditions": c.conditions,
        "loads": c.loads,
        "force_sensor": c.sensor,
        "refuted_by": c.refuted_by,
        "turn_std_rad": c.turn_std,
        "proxies": c.proxies,
        "other_temperatures": _effects_and_covariance(c.other_temperatures),
    }
    return {key: encode(value) for key, value in content.items()}


def _effects_and_covariance(thermal: OtherTemperatures | None) -> dict[str, object] | None:
    if thermal is None:
        return None
    effects = [{"name": e.name, "options": dict(e.options)} for e in thermal.unnamed.effects]
    return {"effects": effects, "covariance": thermal.covariance}


def from_json(content: Mapping[str, Any], catalogue: Catalogue | None = None) -> Calibration:
    """Return the calibration that `to_json` wrote."""
    read = partial(_read, catalogue=catalogue or installed())
    return read_document(content, "calibration", FORMAT, (FACTOR_VERSION, VERSION), read)


def _effects(stored: Any, cell: Cell, catalogue: Catalogue) -> tuple[Effect, ...]:
    states, out = state_with_every_column(cell), []
    for e in stored:
        if e["name"] not in catalogue.names:
            raise InputError(
                f"it has the effect {e['name']}, which is not in the catalogue; give the file "
                "that defines it: --effects-from FILE.py"
            )
        out.append(catalogue.make(e["name"], cell, states, e["options"]))
    return tuple(out)


def _read(content: Mapping[str, Any], catalogue: Catalogue) -> Calibration:
    cell = _cell(content["cell"], decode(Arm, content["arm"]))
    effects = _effects(content["effects"], cell, catalogue)
    model = Model(cell, effects, catalogue)
    names = [f"{e.name}.{p.name}" for e in effects for p in e.parameters]
    limits.check_parameters(len(names))
    if names != content["parameters"]:
        raise InputError(
            f"written by hilcal {content['hilcal']}, whose effects have other parameters"
        )
    theta = numbers("theta", content["theta"], (len(names),))
    std = numbers("std", content["std"], (len(names),), minimum=0.0)
    root = source = None
    if "learnt" in content:
        source = CovarianceSource.from_json(content["learnt"])
        source.check(model)
    else:
        flat = np.frombuffer(base64.b64decode(content["covariance_root"]), dtype="<f4")
        root = flat.reshape(len(std), -1).astype(float) * std[:, None]
        numbers("covariance_root", root, root.shape)
    measured, thermal = decode(MeasuredRanges, content["measured"]), None
    if (stored := content.get("other_temperatures")) is not None:
        unnamed = Model(cell, _effects(stored["effects"], cell, catalogue), catalogue)
        variances = numbers("covariance", stored["covariance"], (unnamed.size, unnamed.size))
        thermal = OtherTemperatures(unnamed, variances, measured.ranges)
    stored = dict(content["scatter"])  # older programs wrote `known` alone
    scatter = decode(Scatter, {"source": "stated" if stored["known"] else "unknown"} | stored)
    calibration = Calibration(
        model=model,
        theta=theta,
        mode=MODES[MODES.index(content["readings"])],
        root=root,
        covariance_source=source,
        misfit=float(content["misfit_m2"]),
        scatter=scatter,
        measured=measured,
        loads=decode(Mapping[str, Floats], content["loads"]),
        source=dict(content["source"]),
        sensor=decode(SensorMount | None, content.get("force_sensor")),
        conditions=decode(Mapping[str, Condition], content.get("conditions", {})),
        turn_std=float(content.get("turn_std_rad", 0.0)),
        refuted_by=decode(tuple[int, int] | None, content.get("refuted_by")),
        other_temperatures=thermal,
        proxies=decode(tuple[Proxy, ...], content.get("proxies", ())),
    )
    _check(calibration, cell.arm.n)
    return calibration


def _source(c: Calibration) -> dict[str, object] | None:
    """Source of the covariance as JSON; None if it is not smaller or does not reproduce it."""
    if c.covariance_source is None:
        return None
    source = c.covariance_source.to_json()
    if c.root is None:
        return source
    if len(json.dumps(source)) > 4 * c.root.size * 4 / 3:
        return None
    states = c.covariance_source.readings.states
    states = states[:: max(len(states) // CHECKED_STATES, 1)]
    jacobian = c.model.jacobian(c.model.predict(states, c.theta), c.theta, 3)
    copy = CovarianceSource.from_json(source).root(c.model, c.theta, c.mode)
    stated, copied = (np.linalg.norm(jacobian @ root, axis=(1, 2)) for root in (c.root, copy))
    return source if np.all(np.abs(copied - stated) <= STD_TOLERANCE * stated) else None


def _cell(content: Mapping[str, Any], arm: Arm) -> Cell:
    """Return a stored cell; refuse impossible values."""
    _check_arm(arm)
    cell = Cell(
        arm=arm,
        target=frames("target", content["target"]),
        registration=frames("registration", content["registration"]),
        tool_mass=float(numbers("tool_mass", content["tool_mass"], minimum=0.0)),
        load_point=numbers("load_point", content["load_point"], (3,)),
        tool_com=numbers("tool_com", content["tool_com"], (3,)),
        gravity=numbers("gravity", content["gravity"], (3,)),
        registration_known=bool(content["registration_known"]),
        target_known=all(content["known_targets"]),
        measured_torques=bool(content.get("measured_torques", False)),
        observers=tuple(map(_observer, content.get("observers", ()))),
    )
    if content["targets"] is None:
        return cell
    targets = frames("targets", content["targets"], several=True)
    with_names = replace(cell, targets=targets, target_names=tuple(content["target_names"]))
    return with_names.with_targets(targets, content["known_targets"])


def _observer(content: Mapping[str, Any]) -> Observer:
    frame = frames("observer", content["frame"])
    free = decode(tuple[int, ...], content["free"])
    return Observer(decode(ObserverName, content), frame, free, float(content["offset_m"]))


def _check_arm(arm: Arm) -> None:
    n = arm.links.shape[0] - 1
    if n < 1:
        raise ValueError("the arm has no joints")
    frames("links", arm.links, several=True)
    numbers("masses", arm.masses, (n,), minimum=0.0)
    numbers("coms", arm.coms, (n, 3))
    if not arm.payload >= 0.0:  # infinite where it is not known
        raise ValueError("payload is negative or no number")
    for name, shape in (("coupling", (n, n)), ("drive", (n, n)), ("mimic", (n, n + 1))):
        if getattr(arm, name) is not None:
            numbers(name, getattr(arm, name), shape)
    if arm.sign is not None and not np.all(np.abs(arm.sign) == np.ones(n)):
        raise ValueError("sign has other numbers than ±1")
    for ends in (arm.q_min, arm.q_max, arm.torque_max):
        if ends.shape != (n,) or np.any(np.isnan(ends)):
            raise ValueError("not every joint has its limits")
    if len(arm.joint_names) != n or (arm.prismatic is not None and len(arm.prismatic) != n):
        raise ValueError("not every joint has a name and a type")


def _check(c: Calibration, n: int) -> None:
    numbers("misfit_m2", c.misfit, minimum=0.0)
    numbers("joint_std", c.scatter.joint_std, (n,), minimum=0.0)
    numbers("std_m", c.scatter.std_m, minimum=0.0)
    if np.isnan(c.measured.most_std_m):
        raise ValueError("most_std_m is no number")
    for r in c.measured.ranges:
        numbers(f"range of {r.variable}", np.array([r.low, r.high]), (2,))
    for name, x in c.conditions.items():
        if name not in CONDITION_NAMES:
            raise ValueError(f"{name!r} is no condition")
        shape = (n,) if name in ("joint_temperature", "approach") else ()
        numbers(name, x.mean, shape)
        numbers(f"variance by {name}", x.variance_m2, minimum=0.0)
        if x.high is not None:
            numbers(f"largest {name}", x.high, shape)
    for p in c.proxies:
        if p.column not in CONDITIONS or not 0 <= p.joint < n or not p.low < p.high:
            raise ValueError(f"proxy {p.column!r} is no condition with a range")
        numbers("probability of a proxy", p.probability, minimum=0.0)
        for name, cubic in p.polynomials.items():
            if name not in CONDITIONS:
                raise ValueError(f"{name!r} is no condition")
            numbers(name, cubic, (DEGREE + 1, *((n,) if name == "joint_temperature" else ())))
    if c.refuted_by is not None and not 0 <= c.refuted_by[0] <= c.refuted_by[1]:
        raise ValueError("refuted_by is not a number of points within their band, and of all")
    for name, wrench in c.loads.items():
        numbers(f"load {name}", wrench, (6,))
    if c.sensor is not None:
        pose = np.stack([c.sensor.origin_m, c.sensor.rotvec_rad])
        numbers("force_sensor", pose, (2, 3))
