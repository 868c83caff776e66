"""What `validate` says of readings that were never fitted: inside and outside of what was."""

from collections.abc import Iterator

import numpy as np
from rich.console import RenderableType
from rich.text import Text

from hilcal.identify.errors import ErrorBlock
from hilcal.identify.extrapolation import Beyond, Extrapolation
from hilcal.identify.validation import Validation
from hilcal.report import numbers, text
from hilcal.types import Floats

MOST = 4
"""Variables that are listed."""
DOUBTED = 1.5
"""Error over the stated standard deviation from which the statement is called too small."""


def validation_report(found: Validation, beyond: Extrapolation) -> Iterator[RenderableType]:
    """Yield the errors, inside and outside of what was measured, and where outside is."""
    out = text.table("3-D position error", "rms", "mean", "largest", "rms in σ", "stated", "z")
    inside, outside = beyond.inside_error, beyond.outside_error
    everything = np.ones(len(beyond.z), dtype=np.bool_)
    rows = [("never fitted", found.error, everything)]
    if inside is not None and outside is not None:
        rows += [
            ("inside", inside, ~beyond.outside),
            ("outside", outside, beyond.outside),
        ]
    for name, e, mine in rows:
        out.add_row(
            name,
            numbers.length(e.rms_m),
            numbers.length(e.mean_m),
            numbers.length(e.max_m),
            f"{e.rms_sigma:.2f}",
            numbers.length(_rms(beyond.stated_m[mine])),
            f"{_rms(beyond.z[mine]):.2f}",
        )
    out.add_row("noise alone", numbers.length(found.noise_floor), "", "", "1.00", "", "")
    yield out
    yield Text(
        "stated: standard deviation that the fit states for these readings, what it does not know "
        "where nothing was measured included; z: error over it.\n",
        style="dim",
    )
    yield from _where(beyond)
    if (z := _rms(beyond.z)) > DOUBTED:
        yield f"These readings are {z:.2g} times as far off as the fit states.\n"


def _where(beyond: Extrapolation) -> Iterator[str]:
    """Yield where readings lie outside."""
    count, total = int(beyond.outside.sum()), len(beyond.outside)
    if not count:
        yield "All of them lie inside of what was measured.\n"
        return
    yield f"Extrapolation: {count} of {total} lie outside of what was measured:"
    for v in beyond.variables[:MOST]:
        yield f"  {_beyond(v)}"
    more = len(beyond.variables) - MOST
    yield f"  and {more} more variables\n" if more > 0 else ""


def _beyond(v: Beyond) -> str:
    if v.variable == "leverage":
        return f"leverage: {v.count}, far from all fitted poses in several joints together"
    if v.unit == "rad":
        low, high, most = (f"{np.degrees(x):.0f}°" for x in (v.low, v.high, v.most))
    else:
        low, high, most = (f"{numbers.digits(x)} {v.unit}" for x in (v.low, v.high, v.most))
    return f"{v.variable}: {v.count}, by up to {most} (measured: {low} to {high})"


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))


def to_json(beyond: Extrapolation) -> dict[str, object]:
    """Return the keys of `validate --json` on extrapolation and stated standard deviations."""

    def block(e: ErrorBlock | None) -> dict[str, float] | None:
        return None if e is None else e.to_json()

    return {
        "stated_rms_m": _rms(beyond.stated_m),
        "z_rms": _rms(beyond.z),
        "extrapolation": {
            "n_outside": int(beyond.outside.sum()),
            "variables": [
                {
                    "variable": v.variable,
                    "unit": v.unit,
                    "measured": [v.low, v.high],
                    "n_outside": v.count,
                    "beyond": v.most,
                }
                for v in beyond.variables
            ],
            "error_inside": block(beyond.inside_error),
            "error_outside": block(beyond.outside_error),
            "z_inside": _rms(beyond.z[~beyond.outside]) if (~beyond.outside).any() else None,
            "z_outside": _rms(beyond.z[beyond.outside]) if beyond.outside.any() else None,
        },
    }
