"""A posterior as JSON: arrays as their little-endian doubles in base64, so that none is rounded."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import __version__, limits
from hilcal.identification.posterior import Posterior, PosteriorEffect, Source
from hilcal.readings.readings import ArmScatter, Range
from hilcal.readings.whitening import MODES
from hilcal.store.codec import (
    decode,
    encode,
    pack,
    read_document,
    read_file,
    unpack,
    write_document,
)
from hilcal.types import Floats

FORMAT, VERSION = "hilcal-posterior", 1


def to_json(p: Posterior) -> dict[str, object]:
    """Return a posterior as JSON, SI; of the information the lower triangle, row by row."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "hilcal": __version__,
        "arm": p.arm,
        "readings": p.mode,
        "parameters": list(p.names),
        "information": pack(p.information[np.tril_indices(len(p.mean))]),
        "arm_scatter": encode(p.scatter),
        "prints": {"columns": p.prints.shape[1], "values": pack(p.prints)},
        **{k: encode(getattr(p, k)) for k in ("links", "source", "effects", "units", "ranges")},
        **{k: encode(getattr(p, k)) for k in ("scale", "mean", "own_precision")},
    }


def from_json(content: Mapping[str, Any]) -> Posterior:
    """Return the posterior that `to_json` wrote; refuses other, newer or damaged documents."""
    return read_document(content, "prior", FORMAT, (VERSION,), _read)


def read(path: Path) -> Posterior:
    """Read a posterior from a JSON file."""
    return read_file(path, "prior", from_json)


def write(p: Posterior, path: Path) -> None:
    """Write a posterior to a JSON file."""
    write_document(path, to_json(p))


def _read(content: Mapping[str, Any]) -> Posterior:
    stored_prints = content["prints"]
    names, units = (decode(tuple[str, ...], content[k]) for k in ("parameters", "units"))
    count, columns = len(names), int(stored_prints["columns"])
    limits.check_parameters(count)
    arrays = ("links", "mean", "scale", "own_precision")
    links, mean, scale, precision = (decode(Floats, content[k]) for k in arrays)
    information = np.zeros((count, count))
    information[np.tril_indices(count)] = unpack(content["information"])
    information += np.tril(information, -1).T
    prints = unpack(stored_prints["values"]).reshape(-1, columns)
    if len(units) != count or len(set(names)) != count or columns < 5:
        raise ValueError("its arrays do not fit its parameters")
    shapes = {a.shape for a in (mean, scale, precision)}
    if shapes != {(count,)} or links.shape != (columns - 3, 4, 4):
        raise ValueError("its arrays do not fit its arm and parameters")
    numbers = (information, links, prints, mean, scale, precision)
    if not all(np.isfinite(a).all() for a in numbers):
        raise ValueError("numbers that are not finite")
    if np.any(scale <= 0) or np.any(precision < 0):
        raise ValueError("a magnitude or precision that cannot be")
    return Posterior(
        arm=str(content["arm"]),
        links=links,
        mode=MODES[MODES.index(content["readings"])],
        effects=decode(tuple[PosteriorEffect, ...], content["effects"]),
        names=names,
        units=units,
        scale=scale,
        mean=mean,
        information=information,
        own_precision=precision,
        scatter=decode(ArmScatter | None, content["arm_scatter"]),
        ranges=decode(tuple[Range, ...], content["ranges"]),
        prints=prints,
        source=decode(Source, content["source"]),
    )
