"""The covariance of a calibration's parameters, stored as the quantities it is computed from.

A transmission error has over a thousand parameters, most of which the readings do not determine.
Their covariance has a million numbers of very different sizes, but follows from few:

    κ C = κ σ² S V (E + σ²)⁻¹ Vᵀ S + κ B Bᵀ,      S AᵀA S = V E Vᵀ

A (R, P) is the whitened Jacobian of the fitted states, S the prior standard deviations, σ² the
noise factor, κ as in `calibration`, B the root of the part by the uncertainty of variances. States,
their noise, S and B take some hundred kilobytes. A and its eigenvectors take seconds to compute,
once, when an uncertainty is first needed.
"""

import base64
import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from hilcal import limits
from hilcal.identification.gauss_newton import whitened_jacobian
from hilcal.model.model import Model
from hilcal.readings.readings import ObserverName, Readings, SerialNoise, States
from hilcal.readings.whitening import Mode, whitening
from hilcal.store.codec import numbers
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class CovarianceSource:
    """Quantities that the covariance is computed from."""

    readings: Readings  # fitted readings; their values are not used
    prior: Floats  # (P,) S
    noise: float  # σ²
    factor: float  # κ
    by_variances: Floats  # (P, K) B

    def root(self, model: Model, theta: Floats, mode: Mode) -> Floats:
        """Return R (P, P + K) with κ C = R Rᵀ; `theta` (P,) are the model's parameters."""
        w = whitening(self.readings, mode, "gc")
        prediction = model.predict(self.readings.states, theta)
        a = whitened_jacobian(model, prediction, theta, w, np.arange(model.size))
        a *= self.prior
        values, vectors = np.linalg.eigh(a.T @ a)
        spread = self.factor * self.noise / (np.maximum(values, 0.0) + self.noise)
        root = self.prior[:, None] * vectors * np.sqrt(spread)
        return np.hstack([root, np.sqrt(self.factor) * self.by_variances])

    def check(self, model: Model) -> None:
        """Refuse quantities whose shapes do not fit a model."""
        r, n = self.readings, model.cell.arm.n
        count = len(r.states)
        limits.check_numbers("the source of its covariance", count * r.m * max(model.size, 1))
        numbers("prior", self.prior, (model.size,), minimum=0.0)
        numbers("by_variances", self.by_variances, (model.size, self.by_variances.shape[1]))
        numbers("noise", self.noise, minimum=float(np.finfo(float).tiny))
        numbers("factor", self.factor, minimum=0.0)
        widths = dict.fromkeys(("q", "joint_temperature", "approach", "q_actual", "torque"), n)
        widths |= {"wrench": 6}
        for f in fields(States):
            values = getattr(r.states, f.name)
            if values is not None:
                width = (widths[f.name],) if f.name in widths else ()
                numbers(f.name, values, (count, *width))
        numbers("covariance", r.covariance, (count, r.m, r.m))
        if r.common is not None:
            numbers("common", r.common, (count, r.m, r.common.shape[-1]))
        indices = {
            "pose": (r.pose, r.pose_names),
            "load": (r.load, r.load_names),
            "target": (r.target, r.target_names or ("",)),
            "observer": (r.observer, r.observers or ("",)),
        }
        for name, (index, names) in indices.items():
            if index.shape != (count,) or np.any((index < 0) | (index >= len(names))):
                raise ValueError(f"readings without a known {name}")

    def to_json(self) -> dict[str, object]:
        """Return the source as JSON; numbers of the readings have 7 digits."""
        r, upper = self.readings, np.triu_indices(self.readings.m)
        state = {f.name: a for f in fields(States) if (a := getattr(r.states, f.name)) is not None}
        cov = r.covariance[:, upper[0], upper[1]]
        return {
            "elements": r.m,
            "states": {name: _packed(a) for name, a in state.items()},
            "covariance": _packed(cov),
            "common": None if r.common is None else _packed(r.common),
            "serial_noise": None if r.serial is None else r.serial.to_json(),
            "along": None if r.along is None else _packed(r.along),
            "stated": None if r.stated is None else _packed(r.stated[:, upper[0], upper[1]]),
            "index": _packed(np.stack([r.pose, r.load, r.cycle])),
            "load_names": list(r.load_names),
            "poses": len(r.pose_names),
            "target_names": list(r.target_names),
            "observers": [[o.kind, o.name] for o in r.observers],
            "prior": self.prior.tolist(),
            "noise": self.noise,
            "factor": self.factor,
            "by_variances": _packed(self.by_variances),
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "CovarianceSource":
        """Return what `to_json` wrote."""
        m = int(content["elements"])
        if m not in (3, 6):
            raise ValueError(f"readings of {m} elements")
        states = States(**{name: _unpacked(a) for name, a in content["states"].items()})
        pose, load, cycle = _unpacked(content["index"])
        i, j = np.triu_indices(m)

        def square(packed: Mapping[str, Any]) -> Floats:
            full = np.zeros((len(states), m, m))
            full[:, i, j] = full[:, j, i] = _unpacked(packed)
            return full

        def optional(name: str, read: Callable[[Any], Any]) -> Any:
            return None if content.get(name) is None else read(content[name])

        readings = Readings(
            states=states,
            pose=pose,
            load=load,
            cycle=cycle,
            value=np.zeros((len(states), m)),
            covariance=square(content["covariance"]),
            load_names=tuple(content["load_names"]),
            pose_names=tuple(f"p{k + 1}" for k in range(min(int(content["poses"]), len(states)))),
            target_names=tuple(content["target_names"]),
            observers=tuple(ObserverName(*o) for o in content.get("observers", ())),
            common=optional("common", _unpacked),
            stated=optional("stated", square),
            serial=optional("serial_noise", SerialNoise.from_json),
            along=optional("along", _unpacked),
        )
        prior = np.array(content["prior"], dtype=float)
        by_variances = optional("by_variances", _unpacked)  # older programs had none
        return cls(
            readings,
            prior,
            noise=float(content["noise"]),
            factor=float(content["factor"]),
            by_variances=np.zeros((len(prior), 0)) if by_variances is None else by_variances,
        )


def _packed(a: np.ndarray) -> dict[str, object]:
    """Return an array as text: 32 bits a number, column by column, deflated."""
    kind = "<i4" if a.dtype.kind == "i" else "<f4"
    data = np.ascontiguousarray(np.moveaxis(a, 0, -1)).astype(kind).tobytes()
    text = base64.b85encode(zlib.compress(data, 9)).decode("ascii")
    return {"type": kind, "shape": list(a.shape), "zlib_base85": text}


def _unpacked(content: Mapping[str, Any]) -> Any:
    shape = [int(k) for k in content["shape"]]
    if content["type"] not in ("<i4", "<f4") or not shape or min(shape) < 0:
        raise ValueError(f"numbers of type {content['type']!r} and shape {shape}")
    limits.check_numbers("an array", math.prod(shape))
    size = 4 * math.prod(shape)
    try:
        data = zlib.decompressobj().decompress(base64.b85decode(content["zlib_base85"]), size + 1)
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if len(data) != size:
        raise ValueError(f"{len(data)} bytes for shape {shape}")
    flat = np.frombuffer(data, dtype=content["type"]).reshape([*shape[1:], shape[0]])
    wide = np.int64 if content["type"] == "<i4" else np.float64
    return np.ascontiguousarray(np.moveaxis(flat, -1, 0).astype(wide))
