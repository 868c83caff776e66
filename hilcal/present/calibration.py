"""A calibration made and put to use: `calibrate`, step by step, and `compensate`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hilcal import numbers
from hilcal.calibration.calibration import Calibration
from hilcal.calibration.compensation import BAND, Compensation
from hilcal.calibration.improvement import Improved, Improvement
from hilcal.calibration.measured import WORDS, Outside
from hilcal.calibration.programs.program import ProgramPoint
from hilcal.calibration.urscript import Waypoint
from hilcal.identification.validation import Acceptance
from hilcal.present.document import Block, heading, load_name, note, table
from hilcal.present.registration import base_line
from hilcal.present.running import spoken
from hilcal.present.verdict import UNCALIBRATED, repeatability_source
from hilcal.readings.whitening import Mode
from hilcal.types import Floats

if TYPE_CHECKING:
    from hilcal.procedure.next_plan import Decision
    from hilcal.procedure.state import ProcedureStep

TITLES: Mapping[str, str] = {
    "plan": "Choose a plan",
    "measure": "Measure",
    "refine": "Fit, and find what is missing",
    "decide": "Is more to be measured?",
    "plan_validation": "Plan a validation campaign",
    "measure_validation": "Measure the validation campaign",
    "validate": "Predict the validation campaign",
    "correct": "Correct the joint targets of its poses",
    "measure_corrected": "Measure at the corrected targets",
    "compare": "Compare before and after",
}
DOES: Mapping[str, str] = {
    "plan": "Poses, loads and their order are chosen: seconds to a minute",
    "refine": "Effects are added until what is left is noise: seconds to minutes, by the number of "
    "readings",
    "decide": "What is in doubt, and what further readings would tell, is predicted: seconds; a "
    "minute where something is in doubt",
    "plan_validation": "Poses within what was measured are drawn, none of those that were fitted: "
    "seconds",
    "validate": "The readings are frozen by their hash and then predicted: seconds",
    "correct": "Joint values are found at which each pose is where it should be under its load: "
    "seconds",
    "compare": "Each point as measured at its uncorrected and at its corrected joint values: "
    "seconds",
}
"""Steps that compute, and how long they take for a campaign of some hundred readings."""
MOST_LEFT = 6
"""Points without a correction that are listed."""


def step_heading(step: "ProcedureStep", clock: float = 1.0) -> Iterator[Block]:
    """Yield what comes next, and how long it takes, of `clock` cell seconds per real second."""
    yield ""
    yield heading(TITLES[step.kind])
    if not step.moves:
        yield f"{DOES[step.kind]}.\n"
        return
    of = "" if step.missing == step.planned else f" of {step.planned}"
    changes = step.load_changes
    hung = f", {changes} load change{'s' * (changes != 1)}" if changes else ""
    yield f"{step.missing}{of} readings{hung}: {lasting(step.seconds, clock)}.\n"


def lasting(seconds: float, clock: float = 1.0) -> str:
    """Say how long the arm takes, in cell s; a simulated cell goes `clock` times faster."""
    faster = "" if clock == 1.0 else f" ({clock:g} times faster in this simulated cell)"
    return f"about {spoken(seconds)}{faster}"


def standing(step: "ProcedureStep") -> str:
    """Say in a line where a calibration stands."""
    if step.kind == "done":
        return "it is complete"
    where = TITLES[step.kind]
    left = f" ({step.missing} of {step.planned} readings are missing)" if step.moves else ""
    return f'its next step is "{where}"{left}'


def decision_report(
    d: "Decision", goal_m: float | None, mode: Mode, clock: float = 1.0
) -> Iterator[str]:
    """Yield what was decided after a refinement of deflections or absolute readings, and why.

    `goal_m` is in m, None without one; `clock` in cell seconds per real second.
    """
    now = numbers.length(d.error.now_m)
    yield f"Predicted after compensation: {100 * BAND:.0f} % of the points within {now}."
    goal = "" if goal_m is None else numbers.length(goal_m)
    then = "" if d.then_m is None else numbers.length(d.then_m)
    cost = f"further readings ({lasting(d.seconds, clock)})"
    cost = "" if d.plan is None else f"{len(d.plan.steps)} {cost}"
    names = numbers.names(d.suspects)
    would = f"separate {names}" if d.suspects else f"lower the predicted error to {then}"
    power = "" if d.power is None else f"with a power of {d.power:.2f} at least"
    of, rest = "", ""
    if mode == "deflection":
        of, rest = " for deflections", f" {numbers.sentence(UNCALIBRATED)}"
    reasons = {
        "adequate": f"The model is adequate{of}; nothing more is measured to fit it.{rest}",
        "goal_met": f"The model is adequate, and the goal of {goal} is met{of}: nothing more is "
        f"measured to fit it.{rest}",
        "doubt": f"{names} are in doubt: {cost} will separate them, {power}.",
        "goal": f"The goal is {goal}: {cost} are predicted to lower this to {then}.",
        "floor": f"The goal of {goal} is out of reach: the arm's repeatability and what the model "
        f"leaves alone are {numbers.length(d.error.floor_m)}. Nothing more is measured.",
        "no_gain": f"The goal is {goal}, but further readings are predicted to change little"
        f"{f' ({then})' if then else ''}. Nothing more is measured.",
        "inseparable": f"{names} are in doubt, and no measurement in this cell separates them: any "
        "of them corrects these readings. Nothing more is measured.",
        "time": f"{cost} would {would}; --max-time does not allow them.",
        "plans": f"{cost} would {would}, but as many plans before did not do; "
        "nothing more is measured.",
        "unknown_effect": "Something is missing that no effect of the catalogue explains: more "
        "readings of this kind will not name it. The validation says how much it matters.",
        "noise_misjudged": "The stated noise is wrong; more readings will not mend that. The "
        "validation says how far the arm is off.",
        "missing_effect": "An effect is missing that does not lower the error on poses left out.",
        "ambiguous": "Several effects explain the misfit alike, or a figure that was entered "
        "wrongly does: the diagnosis names them.",
    }
    yield f"{reasons[d.reason]}\n"


def validation_lines(found: Acceptance) -> Iterator[str]:
    """Yield how well the model predicts readings that were never fitted."""
    e = found.everything
    yield (
        f"{e.count} measurements that nothing was fitted to are predicted to "
        f"{numbers.length(e.rms_m)} rms, {numbers.length(e.max_m)} at most; the fit states "
        f"{numbers.length(e.stated_m)}, noise alone would leave {numbers.length(found.noise_m)}. "
        f"{100 * e.within:.0f} % lie inside of their 95 % region.\n"
    )


def goal_words(mode: str) -> str:
    """Say where a point was asked to be."""
    if mode == "deflection":
        return (
            "A point is where the unloaded arm was measured at the same nominal joint values: the "
            f"correction removes what the load does; {UNCALIBRATED}."
        )
    return (
        "A point is where the nominal arm has the tool, in the tracker's frame by the fitted "
        "registration."
    )


def improvement_report(found: Improvement, limit_m: float | None) -> Iterator[Block]:
    """Yield the error before and after the correction, as measured, and whether a limit is kept."""
    every = found.everything
    heads = ("load", "error", "mean", "rms", "max", "95 % within", "inside")
    parts = (*found.by_load, *(() if len(found.by_load) == 1 else (every,)))
    yield table(*heads, rows=(row for part in parts for row in _rows(part)), left=(0, 1))
    yield note(
        f"{goal_words(found.mode)} noise alone: what the tracker's noise and the arm's "
        "repeatability would leave; 95 % within: the largest distance that was predicted for 95 % "
        "of such readings, noise included; inside: points within their own.\n"
    )
    yield improvement_summary(found)
    for name, why in found.left_out[:MOST_LEFT]:
        yield f"left out: {name}: {why}"
    if (more := len(found.left_out) - MOST_LEFT) > 0:
        yield f"left out: {more} more"
    if limit_m is not None:
        yield _limit_words(found, limit_m)


def improvement_summary(found: Improvement) -> str:
    """Return the improvement in two sentences."""
    e = found.everything
    removed = ""
    if e.removed is not None:
        removed = f"; of what exceeded the noise {100 * e.removed:.1f} % is gone"
    left = len(found.left_out)
    without = f" {left} points could not be corrected." if left else ""
    return (
        f"At the corrected joint targets the arm is off by {numbers.length(e.after.mean_m)} (mean) "
        f"instead of {numbers.length(e.before.mean_m)}, measured by the tracker at {e.count} points"
        f"{removed}. {e.inside} of {e.count} lie within their predicted 95 % band.{without}"
    )


def _rows(part: Improved) -> Iterator[tuple[str, ...]]:
    """Yield before, after and noise of some points."""
    name = load_name(part.name)
    before, after = (
        tuple(numbers.length(x) for x in (s.mean_m, s.rms_m, s.max_m))
        for s in (part.before, part.after)
    )
    band, inside = numbers.length(part.band_m), f"{part.inside} of {part.count}"
    yield (name, "before", *before, "", "")
    yield ("", "after", *after, band, inside)
    yield ("", "noise alone", "", numbers.length(part.noise_m), "", "", "")


def _limit_words(found: Improvement, limit_m: float) -> str:
    over, size = found.over(limit_m), numbers.length(limit_m)
    largest = numbers.length(found.everything.after.max_m)
    of = " for deflections" if found.mode == "deflection" else ""
    if not over:
        words = f"no error at the corrected targets is over {size}, the largest is {largest}."
        return f"PASSED{of}: {words}"
    return (
        f"FAILED{of}: {over} of {found.everything.count} errors at the corrected targets are over "
        f"{size}; the largest is {largest}."
    )


def limit_failure(found: Improvement, limit_m: float) -> str:
    """Return the one line on a limit that is not kept."""
    e, size = found.everything, numbers.length(limit_m)
    line = (
        f"{found.over(limit_m)} of {e.count} errors at the corrected targets are over the limit of "
        f"{size}, the largest is {numbers.length(e.after.max_m)}"
    )
    if limit_m < e.noise_m:
        noise = numbers.length(e.noise_m)
        return f"{line}; noise alone is {noise} rms, so that these readings cannot show it kept"
    return line


LISTED = 12
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
            at = numbers.joint_value(c.q[k, j], c.units[j])
            why.append(f"joint {j + 1} would be beyond its limit ({at})")
        if not allowed_outside:
            why += [_outside(o, k) for o in c.after.outside if o.points[k]]
        out.append("; ".join(why))
    return out


def _outside(o: Outside, k: int) -> str:
    """Say what a point leaves of that which was measured."""
    value, r = float(o.values[k]), o.of
    if r.unit == "rad" or (r.unit == "m" and r.variable.endswith(" travel")):
        at, low, high = (numbers.joint_value(x, r.unit) for x in (value, r.low, r.high))
        return f"{r.variable} {at}, measured {low} to {high}"
    if r.unit == "m":
        return (
            f"far from all that was measured (± {numbers.length(value)} by the parameters alone, "
            f"{numbers.length(r.high)} there)"
        )
    low, high = numbers.digits(r.low), numbers.digits(r.high)
    return f"{r.variable} {numbers.digits(value)} {r.unit}, measured {low} to {high}"


def compensation_report(
    calibration: Calibration, names: Sequence[str], before: Floats, c: Compensation
) -> Iterator[Block]:
    """Yield the summary and the points with the largest corrections.

    `before` (N, n) are the joint values that were given for the points of these names.
    """
    now, later = c.before.error_m, c.after.band_m
    expected = numbers.length(float(np.sqrt(np.mean(c.after.std_m**2))))
    asked = "the unloaded arm" if calibration.mode == "deflection" else "the nominal arm"
    yield heading(f"{len(names)} points compensated")
    yield (
        f"  error before   {numbers.length(float(now.mean()))} mean, "
        f"{numbers.length(float(now.max()))} largest, from where {asked} has the tool\n"
        f"  error after    {100 * BAND:.0f} % of the points within "
        f"{numbers.length(float(later.max()))}; expected {expected} rms"
    )
    yield f"  the latter includes {', '.join(_parts(calibration, c.untold))}"
    yield f"  {base_line(calibration.model.cell, calibration.frames, calibration.mode)}"
    out = table("point", "before", "after, 95 %", "largest correction")
    order = np.argsort(-now, kind="stable")[:LISTED]
    for k in sorted(order):
        turn = np.abs(c.q[k] - before[k])
        joint = int(np.argmax(turn))
        largest = f"joint {joint + 1}: {numbers.joint_value(turn[joint], c.units[joint], 3)}"
        was, left = (numbers.length(float(x[k])) for x in (now, later))
        out.add(names[k], was, f"± {left}", largest)
    yield ""
    yield out
    for o in c.turned_on:
        yield (
            f"{o.of.variable}: in {int(o.points.sum())} of {len(names)} points whole turns from "
            f"what was measured, {np.degrees(o.of.low):.1f}° to {np.degrees(o.of.high):.1f}°. The "
            "model is the same there; what cables do is not in it."
        )
    if len(names) > LISTED:
        yield f"The {LISTED} of {len(names)} points with the largest error before are listed."


def _parts(calibration: Calibration, untold: Sequence[str]) -> list[str]:
    """What the stated error after compensation consists of."""
    parts = ["the parameters"]
    for name in untold:
        moved = numbers.length(float(np.sqrt(3 * calibration.conditions[name].variance_m2)))
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


def fates(waypoints: Sequence[Waypoint | ProgramPoint], refused: Sequence[str]) -> list[Fate]:
    """Return what becomes of each waypoint; `refused` says why, of those that are not left."""
    rest, out = iter(refused), []
    for w in waypoints:
        why = w.left or next(rest)
        done = "left" if w.left else "refused" if why else "corrected"
        out.append(Fate(w.line, done, why or None, w.blend_m))
    return out


def waypoints_table(found: Sequence[Fate]) -> Iterator[Block]:
    """Yield a table of all waypoints of a program; nothing where there are none."""
    if not found:
        return
    out = table("line", "waypoint", "why")
    for f in found:
        passed = f"the arm passes its place within {numbers.length(f.blend_m)} and does not stop"
        out.add(str(f.line), f.done, f.why or (passed if f.blend_m > 0 else ""))
    yield from ("", out)
    if any(f.blend_m > 0 and f.done == "corrected" for f in found):
        yield "Of a blended waypoint the corner of the path is corrected; the radius stays."
