"""A posterior as JSON: arrays as their little-endian doubles in base64, so that none is rounded."""

import base64
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import __version__, limits
from hilcal.errors import InputError
from hilcal.identification.posterior import Posterior, PosteriorEffect, Source
from hilcal.names import check_names
from hilcal.readings.arm_scatter import ArmScatter
from hilcal.readings.ranges import Range
from hilcal.readings.whitening import MODES
from hilcal.toml import parse_json
from hilcal.types import Floats
from hilcal.whole_file import replace_file

FORMAT, VERSION = "hilcal-posterior", 1


def to_json(p: Posterior) -> dict[str, object]:
    """Return a posterior as JSON, SI; of the information the lower triangle, row by row."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "hilcal": __version__,
        "arm": p.arm,
        "links": p.links.tolist(),
        "readings": p.mode,
        "source": asdict(p.source),
        "effects": [{"name": e.name, "options": dict(e.options)} for e in p.effects],
        "parameters": list(p.names),
        "units": list(p.units),
        "scale": p.scale.tolist(),
        "mean": p.mean.tolist(),
        "information": _pack(p.information[np.tril_indices(len(p.mean))]),
        "own_precision": p.own_precision.tolist(),
        "arm_scatter": None if p.scatter is None else p.scatter.to_json(),
        "ranges": [asdict(r) for r in p.ranges],
        "prints": {"columns": p.prints.shape[1], "values": _pack(p.prints)},
    }


def from_json(content: Mapping[str, Any]) -> Posterior:
    """Return the posterior that `to_json` wrote."""
    if not isinstance(content, Mapping) or content.get("format") != FORMAT:
        raise InputError(f'no prior; valid: a JSON document with "format": "{FORMAT}"')
    if content.get("version") != VERSION:
        raise InputError(
            f"a prior of version {content.get('version')}, written by hilcal "
            f"{content.get('hilcal')}; this program reads version {VERSION}"
        )
    check_names({k: v for k, v in content.items() if k != "source"}, "prior")
    try:
        return _read(content)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"a damaged prior: {error!r}") from None


@limits.bounded
def read(path: Path) -> Posterior:
    """Read a posterior from a JSON file."""
    try:
        content = parse_json(limits.read_text(path, limits.DOCUMENT))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no prior: {error}") from None
    try:
        return from_json(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def write(p: Posterior, path: Path) -> None:
    """Write a posterior to a JSON file."""
    replace_file(path, json.dumps(to_json(p), allow_nan=False) + "\n")


def _read(content: Mapping[str, Any]) -> Posterior:
    scatter, kept = content["arm_scatter"], content["prints"]
    names, units = _texts(content["parameters"]), _texts(content["units"])
    count, columns = len(names), int(kept["columns"])
    limits.check_parameters(count)
    mean, scale, own = (_numbers(content[k], count) for k in ("mean", "scale", "own_precision"))
    information = np.zeros((count, count))
    information[np.tril_indices(count)] = _unpack(content["information"])
    information += np.tril(information, -1).T
    links = np.array(content["links"], dtype=float)
    prints = _unpack(kept["values"]).reshape(-1, columns)
    if len(units) != count or len(set(names)) != count or columns < 5:
        raise ValueError("its arrays do not fit its parameters")
    if links.shape != (columns - 3, 4, 4) or not all(
        np.isfinite(a).all() for a in (information, links, prints)
    ):
        raise ValueError("its arrays do not fit its arm")
    if np.any(scale <= 0) or np.any(own < 0):
        raise ValueError("a magnitude or precision that cannot be")
    return Posterior(
        arm=str(content["arm"]),
        links=links,
        mode=MODES[MODES.index(content["readings"])],
        effects=tuple(
            PosteriorEffect(str(e["name"]), dict(e["options"])) for e in content["effects"]
        ),
        names=names,
        units=units,
        scale=scale,
        mean=mean,
        information=information,
        own_precision=own,
        scatter=None if scatter is None else ArmScatter.from_json(scatter),
        ranges=tuple(Range(**r) for r in content["ranges"]),
        prints=prints,
        source=Source(**content["source"]),
    )


def _texts(values: object) -> tuple[str, ...]:
    """Return a list of texts."""
    if not isinstance(values, list) or not all(isinstance(v, str) for v in values):
        raise ValueError("names that are none")
    return tuple(values)


def _numbers(values: object, count: int) -> Floats:
    """Return a list of finite numbers (count,)."""
    found = np.array(values, dtype=float)
    if found.shape != (count,) or not np.isfinite(found).all():
        raise ValueError(f"numbers that are not {count} finite ones")
    return found


def _pack(values: Floats) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f8").tobytes()).decode("ascii")


def _unpack(text: str) -> Floats:
    return np.frombuffer(base64.b64decode(text), dtype="<f8").astype(float)
