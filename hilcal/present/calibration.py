"""Reports of `calibrate`, `validate`, `bootstrap` and `compensate`."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hilcal import numbers
from hilcal.calibration.calibration import Calibration
from hilcal.calibration.compensation import BAND, Compensation
from hilcal.calibration.improvement import Improvement
from hilcal.calibration.measured import CONDITION_NAMES, Outside
from hilcal.calibration.programs.program import ProgramPoint
from hilcal.calibration.programs.urscript import Waypoint
from hilcal.identification.bootstrap import Bootstrap
from hilcal.identification.carried.carried_prior import names_of
from hilcal.identification.prediction import validation
from hilcal.names import quoted
from hilcal.numbers import length
from hilcal.present.document import Block, Table, heading, load_name, note, table
from hilcal.present.fit import error_words, kind, model_name
from hilcal.present.progress import duration_text
from hilcal.present.registration import base_line
from hilcal.present.verdict import UNCALIBRATED, repeatability_source
from hilcal.readings.whitening import Mode
from hilcal.types import Bools, Floats

if TYPE_CHECKING:
    from hilcal.procedure.next_plan import Decision
    from hilcal.procedure.state import ProcedureStep

TITLES: Mapping[str, str] = {
    "plan": "Choose a plan",
    "measure": "Measure",
    "refine": "Fit, and find what is missing",
    "decide": "Decide whether to measure more",
    "plan_validation": "Plan a validation campaign",
    "measure_validation": "Measure the validation campaign",
    "validate": "Predict the validation campaign",
    "correct": "Correct the joint targets of its poses",
    "measure_corrected": "Measure at the corrected targets",
    "compare": "Compare before and after",
}
DESCRIPTIONS: Mapping[str, str] = {
    "plan": "Poses, loads and their order are chosen: seconds to a minute",
    "refine": "Effects are added until what is left is noise: seconds to minutes, by the number of "
    "readings",
    "decide": "The gain of further readings is predicted: seconds; a minute if in doubt",
    "plan_validation": "New poses are drawn within the measured range: seconds",
    "validate": "A hash of the readings is stored, then they are predicted: seconds",
    "correct": "Joint values are computed that bring the tool to each pose under its load: seconds",
    "compare": "Measured errors at uncorrected and corrected joint values are compared: seconds",
}
"""Steps that compute, with their duration for a campaign of some hundred readings."""
REFUTED = (
    "That refutes the prediction: no 95 % band or accuracy stated by these fits holds. Since the "
    "fitted readings the arm, its tool or the tracker has changed, or an effect acts at these "
    "points that they do not show."
)
MOST_NOT_CORRECTED, MOST_POINTS = 6, 12  # listed points: without a correction, compensated
MOST_VARIABLES, MOST_POSES = 4, 6  # listed variables; listed poses
FAR_TURN_RAD = np.radians(5.0)  # correction of a joint that is warned of; arms' errors are 0.1°
MOVED_TRACKER_RATIO = 5.0  # rms of z above which a moved tracker is suspected; a guess
MOST_GROSS_SHARE = 0.05  # most measurements of a validation that can be gross errors; a choice
NEXT = {
    "register": "If the tracker was moved before these readings: --register fits its place first.",
    "compare": "hilcal compare says what has changed.",
}
MIN_ERROR_RATIO = 1.5  # least rms ratio of error to stated standard deviation that is reported
WIDE_RATIO = 1.5
"""Ratio of drawn to stated standard uncertainty above which the stated one is called too small; a
choice. 200 draws determine a standard deviation to 5 %, few poses much less well."""
MAX_PARAMETERS_PER_POSE = 0.5  # effective ones, above which the draws scatter too much; a choice


def step_heading(step: "ProcedureStep", clock: float = 1.0) -> Iterator[Block]:
    """Yield the next step and its duration; `clock` is in cell seconds per real second."""
    yield from ("", heading(TITLES[step.kind]))
    if not step.moves:
        yield f"{DESCRIPTIONS[step.kind]}.\n"
        return
    of_planned = "" if step.missing == step.planned else f" of {step.planned}"
    changes = step.load_changes
    load_changes = f", {changes} load change{'s' * (changes != 1)}" if changes else ""
    duration = cell_duration(step.seconds, clock)
    yield f"{step.missing}{of_planned} readings{load_changes}: {duration}.\n"


def cell_duration(seconds: float, clock: float = 1.0) -> str:
    """Return a duration, in cell seconds; a simulated cell runs `clock` times faster."""
    faster = "" if clock == 1.0 else f" ({clock:g} times faster in this simulated cell)"
    return f"about {duration_text(seconds)}{faster}"


def state_clause(step: "ProcedureStep") -> str:
    """Return the state of a calibration in a clause."""
    if step.kind == "done":
        return "it is complete"
    missing = f" ({step.missing} of {step.planned} readings are missing)" if step.moves else ""
    return f'its next step is "{TITLES[step.kind]}"{missing}'


def decision_report(
    d: "Decision", goal_m: float | None, mode: Mode, clock: float = 1.0
) -> Iterator[str]:
    """Yield the decision after a refinement, with its reason.

    `goal_m` is None without a goal; `clock` is in cell seconds per real second.
    """
    band = length(d.error.now_m)
    share = f"{100 * BAND:.0f} % of the points within {band}"
    known = "where approach directions and temperatures are known as in these readings"
    yield f"Predicted after compensation: {share}, {known}."
    goal, then = ("" if x is None else length(x) for x in (goal_m, d.then_m))
    cost = f"further readings ({cell_duration(d.seconds, clock)})"
    cost = "" if d.plan is None else f"{len(d.plan.steps)} {cost}"
    names = numbers.names(d.suspects)
    would = f"separate {names}" if d.suspects else f"lower the predicted error to {then}"
    power = "" if d.power is None else f"with a power of {d.power:.2f} at least"
    scope, also = "", ""
    if mode == "deflection":
        scope, also = " for deflections", f" {numbers.sentence(UNCALIBRATED)}"
    reasons = {
        "adequate": f"The model is adequate{scope}; nothing more is measured to fit it.{also}",
        "goal_met": ("The model is adequate, and the" if d.verdict == "adequate" else "The")
        + f" goal of {goal} is met{scope}: nothing more is measured to fit the model.{also}",
        "doubt": f"{names} are in doubt: {cost} will separate them, {power}.",
        "goal": f"The goal is {goal}: {cost} are predicted to lower this to {then}.",
        "floor": f"The goal of {goal} is out of reach: the arm's repeatability and what the model "
        f"leaves alone are {length(d.error.floor_m)}. Nothing more is measured.",
        "no_gain": f"The goal is {goal}, but further readings are predicted to change little"
        f"{f' ({then})' if then else ''}. Nothing more is measured.",
        "inseparable": f"{names} are in doubt, and no measurement in this cell separates them: any "
        "of them corrects these readings. Nothing more is measured.",
        "time": f"{cost} would {would}; --max-time does not allow them.",
        "plans": f"{cost} would {would}, but the previous plans did not; nothing more is measured.",
        "unknown_effect": "An effect is missing that is not in the catalogue: more readings of "
        "this kind will not name it. The validation shows how much it matters.",
        "noise_misjudged": "The residuals are not those of the stated noise, and nothing recorded "
        "predicts them; more readings will not correct that. The validation states the error of "
        "the arm.",
        "missing_effect": "An effect is missing that does not lower the error on poses left out.",
        "ambiguous": "These readings do not tell which effects the arm has, or a figure of the "
        "cell seems to be wrong: the diagnosis names them.",
    }
    yield f"{reasons[d.reason]}\n"


def validation_lines(test: validation.Acceptance) -> Iterator[str]:
    """Yield how well the model predicts readings that were never fitted."""
    e = test.everything
    rms, most, stated, noise = map(length, (e.rms_m, e.max_m, e.stated_m, test.noise_m))
    yield (
        f"{e.count} measurements that were never fitted are predicted to {rms} rms, {most} at "
        f"most; the fit states {stated}, noise alone would leave {noise}. {100 * e.within:.0f} % "
        "lie inside their 95 % region.\n"
    )
    if e.z > MIN_ERROR_RATIO:
        yield _as_far_off(e.z)


def _as_far_off(z: float) -> str:
    return f"These readings are {z:.2g} times as far off as the fit states.\n"


def improvement_report(gain: Improvement, limit_m: float | None) -> Iterator[Block]:
    """Yield the measured errors before and after the correction, and the verdict on a limit."""
    out = table("load", "error", "mean", "rms", "max", "95 % within", "inside", left=(0, 1))
    for p in (*gain.by_load, *[gain.everything] * (len(gain.by_load) > 1)):
        before, after = (map(length, (s.mean_m, s.rms_m, s.max_m)) for s in (p.before, p.after))
        out.add(load_name(p.name), "before", *before, "", "")
        out.add("", "after", *after, length(p.band_m), f"{p.inside} of {p.count}")
        out.add("", "noise alone", "", length(p.noise_m), "", "", "")
    yield out
    goal = (
        "A point is where the nominal arm has the tool, in the tracker's frame by the fitted "
        "registration."
    )
    if gain.mode == "deflection":
        goal = (
            "A point is where the unloaded arm was measured at the same nominal joint values: the "
            f"correction removes what the load does; {UNCALIBRATED}."
        )
    yield note(
        f"{goal} noise alone: what the tracker's noise and the arm's "
        "repeatability would leave; 95 % within: the largest distance that was predicted for 95 % "
        "of such readings, noise included; inside: points within their own.\n"
    )
    e, removed = gain.everything, ""
    if e.removed is not None:
        removed = f"; of what exceeded the noise {100 * e.removed:.1f} % is removed"
    uncorrected = len(gain.left_out)
    without = f" {uncorrected} points could not be corrected." if uncorrected else ""
    yield (
        f"At the corrected joint targets the arm is off by {length(e.after.mean_m)} (mean) "
        f"instead of {length(e.before.mean_m)}, measured by the tracker at {e.count} points"
        f"{removed}. {e.inside} of {e.count} lie within their predicted 95 % band.{without}"
    )
    if gain.refuted:
        yield REFUTED
    for name, why in gain.left_out[:MOST_NOT_CORRECTED]:
        yield f"not corrected: {name}: {why}"
    if uncorrected > MOST_NOT_CORRECTED:
        yield f"not corrected: {uncorrected - MOST_NOT_CORRECTED} more"
    if limit_m is not None:
        over, scope = gain.over(limit_m), " for deflections" if gain.mode == "deflection" else ""
        verdict = f"PASSED{scope}: no error at the corrected targets is"
        if over:
            verdict = f"FAILED{scope}: {over} of {e.count} errors at the corrected targets are"
        largest = f"the largest is {length(e.after.max_m)}"
        yield f"{verdict} over {length(limit_m)}{';' if over else ','} {largest}."


def limit_failure(gain: Improvement, limit_m: float) -> str:
    """Return the error message for a limit that is exceeded."""
    e = gain.everything
    line = (
        f"{gain.over(limit_m)} of {e.count} errors at the corrected targets are over the limit of "
        f"{length(limit_m)}, the largest is {length(e.after.max_m)}"
    )
    if limit_m < e.noise_m:
        noise = length(e.noise_m)
        return f"{line}; noise alone is {noise} rms, so that these readings cannot show it kept"
    return line


def refusals(c: Compensation, allowed_outside: bool) -> list[str]:
    """Return the reasons to refuse each of N points; an empty string accepts a point."""
    out = []
    for k in range(len(c.q)):
        why = []
        if not c.inverse.solved[k]:
            residual = length(float(c.inverse.residual_m[k]))
            why.append(f"cannot be reached on its branch, {residual} are left")
        if c.singular[k]:
            why.append("the pose is singular")
        if c.other_branch[k]:
            why.append("its correction lies beyond a singular pose: elbow or wrist would flip")
        for j in np.flatnonzero(c.limits[k]):
            value = numbers.joint_value(c.q[k, j], c.units[j])
            why.append(f"joint {j + 1} would be beyond its limit ({value})")
        if not allowed_outside:
            why += [_outside(o, k) for o in c.after.outside if o.points[k]]
        out.append("; ".join(why))
    return out


def _outside(o: Outside, k: int) -> str:
    value, r = float(o.values[k]), o.range
    if r.unit == "rad" or (r.unit == "m" and r.variable.endswith(" travel")):
        at_point, low, high = (numbers.joint_value(x, r.unit) for x in (value, r.low, r.high))
        return f"{r.variable} {at_point}, measured {low} to {high}"
    if r.unit == "m":
        return (
            f"far from all that was measured (± {length(value)} by the parameters alone, "
            f"{length(r.high)} there)"
        )
    at_point, low, high = (numbers.digits(x) for x in (value, r.low, r.high))
    return f"{r.variable} {at_point} {r.unit}, measured {low} to {high}"


def compensation_report(
    calibration: Calibration, names: Sequence[str], before: Floats, c: Compensation
) -> Iterator[Block]:
    """Yield a summary and the points with the largest errors; `before` (N, n): nominal joints."""
    errors, bands = c.before.error_m, c.after.band_m
    expected = length(float(np.sqrt(np.mean(c.after.std_m**2))))
    uncorrected = "the unloaded arm" if calibration.mode == "deflection" else "the nominal arm"
    yield heading(f"{len(names)} point{'s' * (len(names) != 1)} compensated")
    yield (
        f"  error before   {length(float(errors.mean()))} mean, "
        f"{length(float(errors.max()))} largest, from where {uncorrected} has the tool\n"
        f"  error after    {100 * BAND:.0f} % of the points within "
        f"{length(float(bands.max()))}; expected {expected} rms"
    )
    yield f"  the latter includes {', '.join(_contributions(calibration, c.unstated))}"
    joints = int(np.sum(calibration.model.cell.arm.independent))
    if joints < 6:
        turned = np.degrees(float(c.after.error_rad.max()))
        yield f"  {joints} joints correct the position alone; orientations are off by {turned:.2g}°"
    yield f"  {base_line(calibration.model.cell, calibration.frames, calibration.mode)}"
    rows = table("point", "before", "after, 95 %", "largest correction")
    for k in sorted(np.argsort(-errors, kind="stable")[:MOST_POINTS]):
        turn = np.abs(c.q[k] - before[k])
        joint = int(np.argmax(turn))
        largest = f"joint {joint + 1}: {numbers.joint_value(turn[joint], c.units[joint], 3)}"
        rows.add(names[k], length(float(errors[k])), f"± {length(float(bands[k]))}", largest)
    yield from ("", rows)
    for o in c.turned_on:
        yield (
            f"{o.range.variable}: in {int(o.points.sum())} of {len(names)} points whole turns from "
            f"what was measured, {np.degrees(o.range.low):.1f}° to "
            f"{np.degrees(o.range.high):.1f}°. "
            "The model is the same there, but does not include forces of cables."
        )
    if len(names) > MOST_POINTS:
        yield f"The {MOST_POINTS} of {len(names)} points with the largest error before are listed."


def far_turned(names: Sequence[str], given: Floats, c: Compensation) -> str:
    """Return which correction turns a joint farthest, beyond `FAR_TURN_RAD`; "" where none does."""
    turns = np.where(np.array(c.units) == "rad", np.abs(c.q - given), 0.0)
    far = turns.max(axis=1) > FAR_TURN_RAD
    if not far.any():
        return ""
    k, joint = np.unravel_index(int(np.argmax(turns)), turns.shape)
    more = f" (of {far.sum()} points by over {np.degrees(FAR_TURN_RAD):.0f}°)"
    more = more if far.sum() > 1 else ""
    turn = numbers.joint_value(float(turns[k, joint]), "rad")
    return (
        f"the correction of {names[int(k)]} turns joint {joint + 1} by {turn}{more}: close to a "
        "singular pose a small correction turns joints far; check the motion there"
    )


def refuted_line(calibration: Calibration, path: Path, run: Path, validation: Path) -> str:
    """Return that a test at corrected targets refutes a calibration; "" where none does.

    `path` is the file that it was read from, `run` its campaign.
    """
    if calibration.refuted_by is None:
        return ""
    inside, count = calibration.refuted_by
    return (
        f"{path}: {inside} of {count} points that were measured at corrected targets lie within "
        "their 95 % band: the bands stated here do not hold; calibrate again, or ask what has "
        f"changed: hilcal compare {quoted(run)} {quoted(validation)}"
    )


def _contributions(calibration: Calibration, unstated: Sequence[str]) -> Iterator[str]:
    yield "the parameters"
    for name in unstated:
        moved = length(float(np.sqrt(3 * calibration.conditions[name].variance_m2)))
        yield f"{CONDITION_NAMES[name]}, which the points do not state ({moved} rms)"
    if calibration.misfit > 0:
        yield f"what the model leaves ({length(float(np.sqrt(3 * calibration.misfit)))} rms)"
    source = repeatability_source(calibration.scatter.source, calibration.model.cell.arm)
    known = calibration.scatter.source != "unknown"
    yield f"the arm's repeatability ({source})" if known else "no repeatability, which is not known"


def waypoint_outcomes(
    waypoints: Sequence[Waypoint | ProgramPoint], refused: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the outcome of each waypoint; `refused`: a reason or "" per understood waypoint.

    What is not "corrected" is unchanged: "left" (not understood) or "refused", by the reason "why".
    """
    reasons, out = iter(refused), []
    for w in waypoints:
        why = w.not_corrected or next(reasons)
        done = "left" if w.not_corrected else "refused" if why else "corrected"
        out.append({"line": w.line, "done": done, "why": why or None, "blend_m": w.blend_m})
    return out


def waypoints_table(outcomes: Sequence[Mapping[str, Any]]) -> Iterator[Block]:
    """Yield a table of all waypoints of a program; nothing without waypoints."""
    if not outcomes:
        return
    out = table("line", "waypoint", "reason")
    for f in outcomes:
        passed = f"the arm passes its place within {length(f['blend_m'])} and does not stop"
        out.add(str(f["line"]), f["done"], f["why"] or (passed if f["blend_m"] > 0 else ""))
    yield from ("", out)
    if any(f["blend_m"] > 0 and f["done"] == "corrected" for f in outcomes):
        yield "Of a blended waypoint the corner of the path is corrected; the radius stays."


def fit_and_test_lines(judged: validation.Judged, test: validation.Validation) -> Iterator[str]:
    """Yield the number of readings that were fitted, and the error of the tested ones."""
    error = f"{length(test.error.rms_m)} rms"
    noise = f"noise alone would leave {length(test.noise_floor)}.\n"
    count = f"{len(test.raw)} {judged.what}"
    if not judged.unseen:
        every = "All" if judged.fitted == judged.readings else f"{judged.fitted} of the"
        yield (
            f"{every} {judged.readings} readings were fitted by {judged.model}: these errors say "
            f"how well it fits, not how well it predicts. {count} are off by {error}; {noise}"
        )
        return
    if judged.fitted:
        shared = judged.sharing_unloaded
        sharing = f", and {shared} more share an unloaded reading" if shared else ""
        yield (
            f"{judged.fitted} of the {judged.readings} readings were fitted by {judged.model}"
            f"{sharing}; they are left out."
        )
    yield f"{count} that were never fitted are predicted to {error}; {noise}"
    if judged.turns_aside:
        yield (
            "Orientations are left aside: the model was fitted to positions, and target_rotvec_rad "
            "of [tool] does not state how the target is turned.\n"
        )


def validation_report(
    judged: validation.Judged, test: validation.Validation, beyond: validation.Extrapolation
) -> Iterator[Block]:
    """Yield the errors inside and outside of the measured range, and variables that leave it."""
    out = table(error_words(test.readings), "rms", "mean", "largest", "rms in σ", "stated", "z")
    inside, outside = beyond.inside_error, beyond.outside_error
    every = np.ones(len(beyond.z), dtype=np.bool_)
    rows = [("never fitted" if judged.unseen else "fitted", test.error, every)]
    if inside is not None and outside is not None:
        rows.append(("inside", inside, ~beyond.outside))
        rows.append(("outside", outside, beyond.outside))
    for name, e, some in rows:
        sizes = map(length, (e.rms_m, e.mean_m, e.max_m))
        stated, z = length(_rms(beyond.stated_m[some])), f"{_rms(beyond.z[some]):.2f}"
        out.add(name, *sizes, f"{e.rms_sigma:.2f}", stated, z)
    out.add("noise alone", length(test.noise_floor), "", "", "1.00", "", "")
    yield out
    yield note(
        "stated: standard deviation that the fit states for these readings, with extrapolation; "
        f"z: ratio of error to stated{', orientations included' * (test.readings.m > 3)}.\n"
    )
    if not (count := int(beyond.outside.sum())):
        yield "All of them lie inside the measured range.\n"
    else:
        total = len(beyond.outside)
        yield f"Extrapolation: {count} of {total} lie outside the measured range:"
        yield from (f"  {_beyond(v)}" for v in beyond.variables[:MOST_VARIABLES])
        unlisted = len(beyond.variables) - MOST_VARIABLES
        more = f"  and {unlisted} more variable{'s' * (unlisted != 1)}\n"
        yield more if unlisted > 0 else ""
    if (z_all := _rms(beyond.z)) > MIN_ERROR_RATIO:
        yield _as_far_off(z_all)
        if test.readings.m > 3:
            yield f"Their positions alone are {_rms(beyond.z_position):.2g} times as far off.\n"
    if test.registered:
        yield "The place of the tracker was fitted to these readings (--register).\n"
    if step := next_of(test, beyond):
        yield f"{NEXT[step]}\n"
    if (few := _far_alone(beyond)).any():
        yield _gross_error_note(test, beyond, few)


def next_of(test: validation.Validation, beyond: validation.Extrapolation) -> str:
    """Return what tells why readings are off: "register", "compare", or "" where nothing need."""
    z = _rms(beyond.z)
    if z <= MIN_ERROR_RATIO or _far_alone(beyond).any():
        return ""
    return "register" if z > MOVED_TRACKER_RATIO and not test.registered else "compare"


def _far_alone(beyond: validation.Extrapolation) -> Bools:
    """Return the few measurements (D,) that are far off while all others are as stated."""
    far = beyond.z > MOVED_TRACKER_RATIO
    few = 0 < far.sum() <= max(1.0, MOST_GROSS_SHARE * len(far)) and not far.all()
    return far if few and _rms(beyond.z[~far]) <= MIN_ERROR_RATIO else np.zeros_like(far)


def _gross_error_note(
    test: validation.Validation, beyond: validation.Extrapolation, far: Bools
) -> str:
    r, rows = test.readings, test.whitening.reading
    listed = [
        f"{r.pose_names[r.pose[rows[k]]]}/{r.load_names[r.load[rows[k]]]} ({beyond.z[k]:.0f} times)"
        for k in np.flatnonzero(far)[np.argsort(-beyond.z[far])]
    ]
    rest = np.sqrt(np.mean(np.sum(test.raw[~far, :3] ** 2, axis=1)))
    return (
        f"That is due to {numbers.few(listed, 3)} alone; the error of the {(~far).sum()} others is "
        f"{length(float(rest))} rms, {_rms(beyond.z[~far]):.2f} times the stated one: a gross "
        "error? Measure it again.\n"
    )


def _beyond(v: validation.ExceededRange) -> str:
    if v.variable == validation.POSITION_STD:
        return f"{v.count} are far from all fitted poses in several joints together"
    if v.unit == "rad":
        low, high, most = (f"{np.degrees(x):.0f}°" for x in (v.low, v.high, v.most))
    else:
        unit = "°C" if v.unit == "K" else v.unit  # the readings hold °C, differences are in K
        low, high = (f"{numbers.digits(x)} {unit}" for x in (v.low, v.high))
        most = f"{numbers.digits(v.most)} {v.unit}"
    return f"{v.variable}: {v.count}, by up to {most} (measured: {low} to {high})"


def shares_report(test: validation.Acceptance) -> Iterator[Block]:
    """Yield the errors by load, the worst poses, and the verdict on a limit."""
    yield from loads_report(test)
    yield from (worst_poses_table(test), "")
    if test.limit_m is None:
        return
    size, a, worst = length(test.limit_m), test.everything, test.poses[0]
    largest = f"the largest error is {length(a.max_m)}, at {_place(worst)}"
    poses = sum(not s.passes(test.limit_m) for s in test.poses)
    result = f"FAILED: {test.over} of {a.count} errors are over the limit of {size}"
    result += f", at {poses} of {len(test.poses)} poses"
    if test.passed:
        result = f"PASSED: no error is over the limit of {size}"
    yield f"{result}; {largest}.\n"


def loads_report(test: validation.Acceptance) -> Iterator[Block]:
    """Yield the errors by load."""
    every = () if len(test.loads) == 1 else (test.everything,)
    yield _shares_table("load", "at", (*test.loads, *every), test.limit_m)
    region = f"{100 * validation.BAND:.0f} % region"
    yield note(f"in 95 %: share of the readings inside their stated {region}.\n")


def worst_poses_table(test: validation.Acceptance) -> Table:
    """Return the errors of the worst poses."""
    return _shares_table("worst poses", "load", test.poses[:MOST_POSES], test.limit_m)


def _shares_table(
    head: str, worst: str, shares: Iterable[validation.Share], limit: float | None
) -> Table:
    heads = (head, "n", "rms", "largest", worst, "stated", "z", "in 95 %")
    out = table(*heads, *(() if limit is None else ("limit",)), left=(0, 4))
    for s in shares:
        rms, largest, stated = map(length, (s.rms_m, s.max_m, s.stated_m))
        verdict = () if limit is None else ("kept" if s.passes(limit) else "over",)
        within = f"{100 * s.within:.0f} %"
        of, at = (load_name(x) if k == "load" else x for k, x in ((head, s.name), (worst, s.worst)))
        out.add(of, str(s.count), rms, largest, at, stated, f"{s.z:.2f}", within, *verdict)
    return out


def _place(worst: validation.Share) -> str:
    return f"{worst.name} {load_name(worst.worst, 'under ')}"


def validation_failure(test: validation.Acceptance, judged: validation.Judged) -> str:
    """Return the error message for a limit that is exceeded."""
    worst = test.poses[0]
    head = (
        f"the limit of {length(test.limit_m or 0.0)} is not kept: {test.over} of "
        f"{test.everything.count} {judged.what} are further off, {_place(worst)} by "
        f"{length(worst.max_m)}"
    )
    if not test.undecided:
        return head
    return (
        f"{head}; but noise alone leaves {length(test.noise_m)} rms, so that these "
        "readings cannot decide: measure with less noise, or give a larger limit"
    )


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))


def bootstrap_report(draws: Bootstrap) -> Iterator[Block]:
    """Yield the report of a bootstrap: stated and drawn standard uncertainty of each parameter."""
    fit, ends = draws.fit, draws.interval()
    yield heading(f"Model: {model_name(fit.model.named)}")
    yield (
        f"Fitted to {kind(fit)}; {len(draws.theta)} times to {draws.poses} poses drawn from its "
        f"{draws.poses}, with replacement.\n"
    )
    heads = ("parameter", "value", "± stated", "± drawn", "ratio", "95 % of the draws", "unit")
    out, names = table(*heads, left=(0, 5, 6)), names_of(fit.model)
    units = [p.unit for e in fit.model.effects for p in e.parameters]
    for k in np.flatnonzero(draws.compared):
        theta, std = float(fit.theta[k]), float(fit.uncertainty.std[k])
        unit, factor = numbers.unit_for(units[k], [theta])
        limits = (factor * float(end[k]) for end in ends)
        value, stated, *between = numbers.with_std(factor * theta, factor * std, *limits)
        drawn, ratio = numbers.with_std(0.0, factor * float(draws.std[k]))[1], draws.ratio[k]
        out.add(names[k], value, stated, drawn, f"{ratio:.2f}", ", ".join(between), unit)
    if out.rows:
        meaning = "± drawn: standard deviation over the draws."
        yield from (out, note(f"± stated: standard uncertainty of the fit. {meaning}\n"))
    yield from bootstrap_remarks(draws)


def bootstrap_remarks(draws: Bootstrap) -> Iterator[str]:
    """Yield the conclusions on the stated standard uncertainties."""
    ratios, solution = draws.ratio[draws.compared], draws.fit.solution
    if len(ratios):
        yield (
            f"Over the draws the parameters scatter by {ratios.min():.2f} to {ratios.max():.2f} "
            f"times the stated uncertainty (median {np.median(ratios):.2f})."
        )
    wide = sorted(np.flatnonzero(draws.ratio > WIDE_RATIO), key=lambda k: -draws.ratio[k])
    if wide:
        names = names_of(draws.fit.model)
        listed = numbers.few([f"{names[k]} ({draws.ratio[k]:.1f} times)" for k in wide], 5)
        if solution.effective > MAX_PARAMETERS_PER_POSE * draws.poses:
            yield (
                f"Wider than stated: {listed}. This does not show that the stated ones are too "
                f"small: the fit spends {solution.effective:.0f} degrees of freedom on "
                f"{draws.poses} poses, and draws, which have 63 % of the poses, scatter too much "
                "then. More poses would decide."
            )
        else:
            yield (
                f"Stated too small, or determined by few poses: {listed}. Use the drawn one, and "
                "measure more poses that depend on these parameters."
            )
    elif draws.fit.uncertainty.inflated:
        yield (
            "The residuals are larger than the noise. What neighbouring poses then have in common "
            "is chance for draws of single poses; the stated ones, found by leaving out regions of "
            "joint space, are the ones to use."
        )
    elif len(ratios):
        yield f"None scatters by more than {WIDE_RATIO:g} times it: the stated ones can be used."
    if excluded := int((solution.estimated & ~draws.compared).sum()):
        yield (
            f"{excluded} parameters are not compared: the readings do not determine them, or they "
            "are of a family that shrinks its parameters towards zero."
        )
    if draws.failed:
        yield (
            f"{draws.failed} further draws are left out: their poses do not determine the "
            "parameters. The figures of the other draws are therefore optimistic."
        )
