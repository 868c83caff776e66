"""What `compensate` says: error before and after at each point, and why points are refused."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import RenderableType

from hilcal import numbers
from hilcal.calibration.calibration import Calibration
from hilcal.calibration.compensated import Compensation
from hilcal.calibration.conditions import WORDS
from hilcal.calibration.measured import Outside
from hilcal.calibration.poses import BAND
from hilcal.calibration.urscript import Waypoint
from hilcal.present import text
from hilcal.present.scatter_words import repeatability_source
from hilcal.present.text_registration import base_line
from hilcal.robot import se3
from hilcal.types import Floats

MOST = 12
"""Points that are listed."""


def refusals(c: Compensation, allowed_outside: bool) -> list[str]:
    """Return why each point is refused, of N points; empty where it is not."""
    out = []
    for k in range(len(c.q)):
        why = []
        if not c.inverse.solved[k]:
            left = numbers.length(float(c.inverse.residual_m[k]))
            why.append(f"cannot be reached on its branch, {left} are left")
        if c.singular[k]:
            why.append("the pose is singular")
        for j in np.flatnonzero(c.limits[k]):
            why.append(f"joint {j + 1} would be beyond its limit ({_degrees(c.q[k, j])})")
        if not allowed_outside:
            why += [_outside(o, k) for o in c.after.outside if o.points[k]]
        out.append("; ".join(why))
    return out


def _outside(o: Outside, k: int) -> str:
    """Say what a point leaves of that which was measured."""
    value, r = float(o.values[k]), o.of
    if r.unit == "rad":
        return f"{r.variable} {_degrees(value)}, measured {_degrees(r.low)} to {_degrees(r.high)}"
    if r.unit == "m":
        return (
            f"far from all that was measured (± {numbers.length(value)} by the parameters alone, "
            f"{numbers.length(r.high)} there)"
        )
    low, high = numbers.digits(r.low), numbers.digits(r.high)
    return f"{r.variable} {numbers.digits(value)} {r.unit}, measured {low} to {high}"


def _degrees(value: float) -> str:
    return f"{np.degrees(value):.1f}°"


def report(
    calibration: Calibration, names: Sequence[str], before: Floats, c: Compensation
) -> Iterator[RenderableType]:
    """Yield the summary and the points with the largest corrections.

    Args:
        calibration: the calibration.
        names: of the N points.
        before: (N, n) joint values that were given.
        c: the compensation.
    """
    now, later = c.before.error_m, c.after.band_m
    asked = "the unloaded arm" if calibration.mode == "deflection" else "the nominal arm"
    yield text.heading(f"{len(names)} points compensated")
    yield (
        f"  error before   {numbers.length(float(now.mean()))} mean, "
        f"{numbers.length(float(now.max()))} largest, from where {asked} has the tool\n"
        f"  error after    {100 * BAND:.0f} % of the points within "
        f"{numbers.length(float(later.max()))}; expected {numbers.length(_rms(c.after.std_m))} rms"
    )
    yield f"  the latter includes {', '.join(_parts(calibration, c.untold))}"
    yield f"  {base_line(calibration.model.cell, calibration.frames, calibration.mode)}"
    out = text.table("point", "before", "after, 95 %", "largest correction")
    order = np.argsort(-now, kind="stable")[:MOST]
    for k in sorted(order):
        turn = np.abs(c.q[k] - before[k])
        joint = int(np.argmax(turn))
        out.add_row(
            names[k],
            numbers.length(float(now[k])),
            f"± {numbers.length(float(later[k]))}",
            f"joint {joint + 1}: {np.degrees(turn[joint]):.3f}°",
        )
    yield ""
    yield out
    for o in c.turned_on:
        yield (
            f"{o.of.variable}: in {int(o.points.sum())} of {len(names)} points whole turns from "
            f"what was measured, {_degrees(o.of.low)} to {_degrees(o.of.high)}. The model is the "
            "same there; what cables do is not in it."
        )
    if len(names) > MOST:
        yield f"The {MOST} of {len(names)} points with the largest error before are listed."


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _parts(calibration: Calibration, untold: Sequence[str]) -> list[str]:
    """What the stated error after compensation consists of."""
    parts = ["the parameters"]
    for name in untold:
        moved = numbers.length(float(np.sqrt(3 * calibration.conditions[name].variance)))
        parts.append(f"{WORDS[name]}, which the points do not tell ({moved} rms)")
    if calibration.misfit > 0:
        left = numbers.length(float(np.sqrt(3 * calibration.misfit)))
        parts.append(f"what the model leaves ({left} rms)")
    source, arm = calibration.scatter.source, calibration.model.cell.arm
    if source == "unknown":
        return [*parts, "no repeatability, which is not known"]
    return [*parts, f"the arm's repeatability ({repeatability_source(source, arm)})"]


@dataclass(frozen=True, slots=True)
class Fate:
    """What became of a waypoint of a program.

    Attributes:
        line: of the program.
        done: "corrected", "left" (not understood) or "refused"; the latter two are as they were.
        why: it is left or refused.
        blend_m: radius within which the arm passes it without a stop, m.
    """

    line: int
    done: str
    why: str | None
    blend_m: float


def fates(waypoints: Sequence[Waypoint], refused: Sequence[str]) -> list[Fate]:
    """Return what becomes of each waypoint; `refused` says why, of those that are not left."""
    rest, out = iter(refused), []
    for w in waypoints:
        why = w.left or next(rest)
        done = "left" if w.left else "refused" if why else "corrected"
        out.append(Fate(w.line, done, why or None, w.blend_m))
    return out


def waypoints(found: Sequence[Fate]) -> Iterator[RenderableType]:
    """Yield a table of all waypoints of a program; nothing where there are none."""
    if not found:
        return
    out = text.table("line", "waypoint", "why")
    for f in found:
        passed = f"the arm passes its place within {numbers.length(f.blend_m)} and does not stop"
        out.add_row(str(f.line), f.done, f.why or (passed if f.blend_m > 0 else ""))
    yield ""
    yield out
    if any(f.blend_m > 0 and f.done == "corrected" for f in found):
        yield "Of a blended waypoint the corner of the path is corrected; the radius stays."


def document(calibration: Calibration, names: Sequence[str], c: Compensation) -> dict[str, object]:
    """Return the JSON document, SI.

    `expected_error_m` is the rms error to be expected at the corrected joint values: what the
    inversion leaves, and the standard deviation of the position.
    """
    expected, inside = np.hypot(c.inverse.residual_m, c.after.std_m), c.inside
    return {
        "calibration": dict(calibration.source),
        "readings": calibration.mode,
        "base_in_tracker": se3.six(calibration.base_in_tracker()),
        "base_is": calibration.frames.base_is,
        "n_points": len(names),
        "error_before": _block(c.before.error_m),
        "error_after": {
            "std_m": _rms(c.after.std_m),
            "band_m": float(c.after.band_m.max()),
            "band_share": BAND,
        },
        "points": [
            {
                "name": name,
                "q_command": c.given[k].tolist(),
                "q_corrected": c.q[k].tolist(),
                "expected_error_m": float(expected[k]),
                "inside": bool(inside[k]),
                "q_rad": c.q[k].tolist(),
                "before_m": float(c.before.error_m[k]),
                "before_rad": float(c.before.error_rad[k]),
                "residual_m": float(c.inverse.residual_m[k]),
                "std_m": float(c.after.std_m[k]),
                "band_m": float(c.after.band_m[k]),
                "refused": None,
            }
            for k, name in enumerate(names)
        ],
    }


def _block(values: Floats) -> dict[str, float]:
    return {"mean_m": float(values.mean()), "rms_m": _rms(values), "max_m": float(values.max())}
