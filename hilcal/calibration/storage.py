"""A calibration as one JSON file: everything that predicting and compensating needs.

The covariance is stored in the smaller of two forms: its factor, as 32-bit floats, each row scaled
by its parameter's standard deviation; or what it follows from (`learnt`), where that gives the same
standard deviations at fitted states to `AGREES`, which is tried before it is written. Everything
else is decimal numbers, exactly.
"""

import base64
import json
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from hilcal import __version__, limits
from hilcal.calibration.calibration import Calibration
from hilcal.calibration.covariance_source import CovarianceSource, check_numbers
from hilcal.calibration.measured import WORDS, Condition, Measured, SensorMount
from hilcal.calibration.scatter import Scatter, ScatterSource
from hilcal.cell import Cell, Observer
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError
from hilcal.identification.robot_frames import one_of_each
from hilcal.model.model import Model
from hilcal.names import check_names
from hilcal.readings.ranges import Range
from hilcal.readings.readings import ObserverKind, ObserverName
from hilcal.readings.whitening import MODES
from hilcal.robot.arm import Arm
from hilcal.toml import parse_json
from hilcal.types import Floats
from hilcal.whole_file import replace_file

FORMAT, VERSION = "hilcal-calibration", 2
BY_FACTOR = 1
"""Version of a file with the factor of the covariance, which earlier programs read."""
AGREES = 5e-3
"""Share by which a standard deviation may change where the small form is written; a choice."""
TRIED = 40
"""Fitted states at which that is tried."""
_CELL = ("target", "load_point", "tool_mass", "tool_com", "gravity", "registration", "targets")


def write(c: Calibration, path: Path) -> None:
    """Write a calibration to a file."""
    content = json.dumps(to_json(c), indent=1, allow_nan=False)
    replace_file(path, content + "\n")


@limits.bounded
def read(path: Path, catalogue: Catalogue | None = None) -> Calibration:
    """Read a calibration from a file."""
    try:
        content = parse_json(limits.read_text(path, limits.DOCUMENT))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no calibration: {error}") from None
    try:
        return from_json(content, catalogue)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise InputError(f"{path}: a damaged calibration: {error!r}") from None


def to_json(c: Calibration) -> dict[str, object]:
    """Return a calibration as JSON, SI."""
    cell = c.model.cell
    std, small = np.sqrt(np.einsum("pk,pk->p", c.covariance_root, c.covariance_root)), _small(c)
    known: dict[str, object] = {"learnt": small}
    if small is None:
        scaled = c.covariance_root / np.where(std > 0, std, 1.0)[:, None]
        text = base64.b64encode(scaled.astype("<f4").tobytes()).decode("ascii")
        known = {"covariance_root": text}
    return {
        "format": FORMAT,
        "version": BY_FACTOR if small is None else VERSION,
        "hilcal": __version__,
        "source": dict(c.source),
        "readings": c.mode,
        "arm": {f.name: _plain(getattr(cell.arm, f.name)) for f in fields(cell.arm)},
        "cell": {
            **{name: _plain(getattr(cell, name)) for name in _CELL},
            "target_names": list(cell.target_names),
            "known_targets": list(cell.known_targets),
            "registration_known": cell.registration_known,
            "measured_torques": cell.measured_torques,
            "observers": [
                {
                    "kind": o.name.kind,
                    "name": o.name.name,
                    "free": list(o.free),
                    "offset_m": o.offset,
                    "frame": o.frame.tolist(),
                }
                for o in cell.observers
            ],
        },
        "effects": [{"name": e.name, "options": _plain(dict(e.options))} for e in c.model.effects],
        "parameters": [f"{e.name}.{p.name}" for e in c.model.effects for p in e.parameters],
        "theta": c.theta.tolist(),
        "std": std.tolist(),
        **known,
        "misfit_m2": c.misfit,
        "scatter": {**_plain(asdict(c.scatter)), "known": c.scatter.known},
        "measured": asdict(c.measured),
        "conditions": {name: _plain(asdict(x)) for name, x in c.conditions.items()},
        "loads": {name: wrench.tolist() for name, wrench in c.loads.items()},
        "force_sensor": None if c.sensor is None else _plain(asdict(c.sensor)),
    }


def from_json(content: Mapping[str, Any], catalogue: Catalogue | None = None) -> Calibration:
    """Return the calibration that `to_json` wrote."""
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f'no calibration; valid: a JSON document with "format": "{FORMAT}"')
    if content["version"] not in (BY_FACTOR, VERSION):
        raise InputError(
            f"a calibration of version {content['version']}, written by hilcal "
            f"{content['hilcal']}; this program reads versions {BY_FACTOR} and {VERSION}"
        )
    check_names({k: v for k, v in content.items() if k != "source"}, "calibration")
    known = catalogue or installed()
    arm = _arm(content["arm"])
    check_arm(arm)
    cell = _cell(content["cell"], arm)
    check_cell(cell)
    effects = []
    for e in content["effects"]:
        if e["name"] not in known.names:
            raise InputError(
                f"it has the effect {e['name']}, which is not in the catalogue; give the file "
                "that defines it: --effects-from FILE.py"
            )
        effects.append(known.make(e["name"], cell, one_of_each(cell), e["options"]))
    model = Model(cell, tuple(effects), known)
    names = [f"{e.name}.{p.name}" for e in effects for p in e.parameters]
    limits.check_parameters(len(names))
    if names != content["parameters"]:
        raise InputError(
            f"written by hilcal {content['hilcal']}, whose effects have other parameters"
        )
    theta, std = (np.array(content[k], dtype=float) for k in ("theta", "std"))
    check_numbers("theta", theta, (len(names),))
    check_numbers("std", std, (len(names),), least=0.0)
    root = learnt = None
    if "learnt" in content:
        learnt = CovarianceSource.from_json(content["learnt"])
        learnt.check(model)
    else:
        flat = np.frombuffer(base64.b64decode(content["covariance_root"]), dtype="<f4")
        root = flat.reshape(len(std), -1).astype(float) * std[:, None]
        check_numbers("covariance_root", root, root.shape)
    check_numbers("misfit_m2", float(content["misfit_m2"]), least=0.0)
    of = content["measured"]
    measured = Measured(tuple(Range(**r) for r in of["ranges"]), float(of["most_std_m"]))
    scatter = _scatter(content["scatter"])
    check_spread(scatter, measured, arm.n)
    conditions = {
        k: Condition(_array(x["mean"]), float(x["variance_m2"]))
        for k, x in content.get("conditions", {}).items()
    }
    check_conditions(conditions, arm.n)
    loads = {name: _array(wrench) for name, wrench in content["loads"].items()}
    for name, wrench in loads.items():
        check_numbers(f"load {name}", wrench, (6,))
    sensor = None
    if (mount := content.get("force_sensor")) is not None:
        sensor = SensorMount(_array(mount["origin_m"]), _array(mount["rotvec_rad"]))
        check_numbers("force_sensor", np.array([sensor.origin_m, sensor.rotvec_rad]), (2, 3))
    return Calibration(
        model=model,
        theta=theta,
        mode=MODES[MODES.index(content["readings"])],
        root=root,
        learnt=learnt,
        misfit=float(content["misfit_m2"]),
        scatter=scatter,
        measured=measured,
        loads=loads,
        source=content["source"],
        sensor=sensor,
        conditions=conditions,
    )


def _small(c: Calibration) -> dict[str, object] | None:
    """What the covariance follows from, as JSON; None where that is no smaller, or not the same."""
    if c.learnt is None:
        return None
    small = c.learnt.to_json()
    if c.root is None:
        return small
    if len(json.dumps(small)) > 4 * c.root.size * 4 / 3:
        return None
    states = c.learnt.readings.states
    states = states[:: max(len(states) // TRIED, 1)]
    jacobian = c.model.jacobian(c.model.predict(states, c.theta), c.theta, 3)
    again = CovarianceSource.from_json(small).root(c.model, c.theta, c.mode)
    stated, found = (np.linalg.norm(jacobian @ root, axis=(1, 2)) for root in (c.root, again))
    return small if np.all(np.abs(found - stated) <= AGREES * stated) else None


def _arm(content: Mapping[str, Any]) -> Arm:
    """Return an arm as it was stored."""
    given = {f.name: content[f.name] for f in fields(Arm)}
    for name, value in given.items():
        if isinstance(value, list):
            words = name in ("joint_names", "notes")
            given[name] = tuple(value) if words else _array(value)
    return Arm(**given)


def _cell(content: Mapping[str, Any], arm: Arm) -> Cell:
    """Return a cell as it was stored."""
    cell = Cell(
        arm=arm,
        target=_array(content["target"]),
        load_point=_array(content["load_point"]),
        tool_mass=float(content["tool_mass"]),
        tool_com=_array(content["tool_com"]),
        gravity=_array(content["gravity"]),
        registration=_array(content["registration"]),
        registration_known=bool(content["registration_known"]),
        target_known=all(content["known_targets"]),
        measured_torques=bool(content.get("measured_torques", False)),
        observers=tuple(map(_observer, content.get("observers", ()))),
    )
    if content["targets"] is None:
        return cell
    several = replace(
        cell, targets=_array(content["targets"]), target_names=tuple(content["target_names"])
    )
    return several.with_targets(_array(content["targets"]), content["known_targets"])


def _scatter(content: Mapping[str, Any]) -> Scatter:
    """Return a scatter; older programs told whether it was known alone."""
    source = content.get("source", "stated" if content["known"] else "unknown")
    if source not in get_args(ScatterSource):
        raise ValueError(f"a scatter from {source!r}")
    return Scatter(_array(content["joint_std"]), float(content["std_m"]), source)


def _observer(content: Mapping[str, Any]) -> Observer:
    kind, frame = content["kind"], _array(content["frame"])
    if kind not in get_args(ObserverKind) or frame.shape != (4, 4):
        raise ValueError("an observer that is none")
    name = ObserverName(kind, str(content["name"]))
    return Observer(name, frame, tuple(map(int, content["free"])), float(content["offset_m"]))


def _array(value: object) -> Floats:
    """Return numbers as an array; "inf" and "-inf" are among them."""
    return np.array(value, dtype=float)


def _plain(value: Any) -> Any:
    """Return arrays and tuples as lists, infinite numbers, which JSON lacks, as text."""
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, float) and np.isinf(value):
        return str(value)
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, tuple | list) else value


def check_frames(what: str, frames: Floats) -> None:
    """Refuse (..., 4, 4) matrices that are no rotation and translation."""
    check_numbers(what, frames, (*frames.shape[:-2], 4, 4))
    turn = frames[..., :3, :3]
    orthonormal = np.allclose(turn @ np.swapaxes(turn, -1, -2), np.eye(3), atol=1e-6)
    if not orthonormal or np.any(frames[..., 3, :] != [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"{what} is no frame")


def check_arm(arm: Arm) -> None:
    """Refuse an arm that cannot be.

    Raises:
        ValueError: says why.
    """
    n = arm.links.shape[0] - 1
    if n < 1:
        raise ValueError("the arm has no joints")
    check_frames("links", arm.links)
    check_numbers("masses", arm.masses, (n,), least=0.0)
    check_numbers("coms", arm.coms, (n, 3))
    check_numbers("payload", arm.payload, least=0.0)
    for name, shape in (("coupling", (n, n)), ("drive", (n, n)), ("mimic", (n, n + 1))):
        values = getattr(arm, name)
        if values is not None:
            check_numbers(name, values, shape)
    if arm.sign is not None and not np.all(np.abs(arm.sign) == np.ones(n)):
        raise ValueError("sign is not ±1 for each joint")
    for ends in (arm.q_min, arm.q_max, arm.torque_max):
        if ends.shape != (n,) or np.any(np.isnan(ends)):
            raise ValueError("limits are not one for each joint")
    if len(arm.joint_names) != n or not all(isinstance(name, str) for name in arm.joint_names):
        raise ValueError("joints are not named each")


def check_cell(cell: Cell) -> None:
    """Refuse a cell that cannot be."""
    for name in ("target", "registration"):
        check_frames(name, getattr(cell, name))
    check_numbers("load_point", cell.load_point, (3,))
    if cell.targets is not None:
        check_frames("targets", cell.targets)
    check_numbers("tool_mass", cell.tool_mass, least=0.0)
    check_numbers("tool_com", cell.tool_com, (3,))
    check_numbers("gravity", cell.gravity, (3,))


def check_spread(scatter: Scatter, measured: Measured, n: int) -> None:
    """Refuse a scatter or ranges that cannot be."""
    check_numbers("joint_std", scatter.joint_std, (n,), least=0.0)
    check_numbers("std_m", scatter.std_m, least=0.0)
    if np.isnan(measured.most_std_m):
        raise ValueError("most_std_m is no number")
    for r in measured.ranges:
        if not isinstance(r.variable, str) or not isinstance(r.unit, str):
            raise ValueError("a range without a name")
        check_numbers(f"range of {r.variable}", np.array([r.low, r.high], dtype=float), (2,))


def check_conditions(conditions: Mapping[str, Condition], n: int) -> None:
    """Refuse conditions that cannot be."""
    for name, c in conditions.items():
        if name not in WORDS:
            raise ValueError(f"{name!r} is no condition")
        check_numbers(name, c.mean, (n,) if name in ("joint_temperature", "approach") else ())
        check_numbers(f"variance by {name}", c.variance_m2, least=0.0)
