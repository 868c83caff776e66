"""What `calibrate` says: the next step and its time, decisions, the error before and after."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from rich.console import RenderableType
from rich.text import Text

from hilcal import numbers
from hilcal.calibration.improvement import Improved, Improvement
from hilcal.calibration.poses import BAND
from hilcal.identification.acceptance import Acceptance
from hilcal.present import text
from hilcal.present.text_run import spoken
from hilcal.present.verdict_words import UNCALIBRATED
from hilcal.readings.whitening import Mode
from hilcal.store.plan import UNLOADED

if TYPE_CHECKING:
    from hilcal.procedure.decision import Decision
    from hilcal.procedure.state import Step

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
    "plan": "Poses, loads and their order are chosen",
    "refine": "Effects are added until what is left is noise",
    "decide": "What is in doubt, and what further readings would tell, is predicted",
    "plan_validation": "Poses within what was measured are drawn, none of those that were fitted",
    "validate": "The readings are frozen by their hash and then predicted",
    "correct": "Joint values are found at which each pose is where it should be under its load",
    "compare": "Each point as measured at its uncorrected and at its corrected joint values",
}
LASTING: Mapping[str, str] = {
    "plan": "seconds to a minute",
    "refine": "seconds to minutes, by the number of readings",
    "decide": "seconds; a minute where something is in doubt",
    "plan_validation": "seconds",
    "validate": "seconds",
    "correct": "seconds",
    "compare": "seconds",
}
"""How long computing takes, in words: of a campaign of some hundred readings."""
MOST_LEFT = 6
"""Points without a correction that are listed."""


def heading(step: "Step", clock: float = 1.0) -> Iterator[RenderableType]:
    """Yield what comes next, and how long it takes.

    Args:
        step: the step.
        clock: cell seconds per real second.
    """
    yield ""
    yield text.heading(TITLES[step.kind])
    if not step.moves:
        yield f"{DOES[step.kind]}: {LASTING[step.kind]}.\n"
        return
    of = "" if step.missing == step.planned else f" of {step.planned}"
    changes = step.load_changes
    hung = f", {changes} load change{'s' * (changes != 1)}" if changes else ""
    yield f"{step.missing}{of} readings{hung}: {lasting(step.seconds, clock)}.\n"


def lasting(seconds: float, clock: float = 1.0) -> str:
    """Say how long the arm takes, in cell s; a simulated cell goes `clock` times faster."""
    faster = "" if clock == 1.0 else f" ({clock:g} times faster in this simulated cell)"
    return f"about {spoken(seconds)}{faster}"


def standing(step: "Step") -> str:
    """Say in a line where a calibration stands."""
    if step.kind == "done":
        return "it is complete"
    where = TITLES[step.kind]
    left = f" ({step.missing} of {step.planned} readings are missing)" if step.moves else ""
    return f'its next step is "{where}"{left}'


def decision_report(
    d: "Decision", goal_m: float | None, mode: Mode, clock: float = 1.0
) -> Iterator[str]:
    """Yield what was decided after a refinement, and why.

    Args:
        d: the decision.
        goal_m: the goal, m; None without one.
        mode: what is fitted.
        clock: cell seconds per real second.
    """
    now = numbers.length(d.error.now_m)
    share = f"{100 * BAND:.0f} %"
    yield f"Predicted after compensation: {share} of the points within {now}."
    goal = "" if goal_m is None else numbers.length(goal_m)
    then = "" if d.then_m is None else numbers.length(d.then_m)
    cost = ""
    if d.plan is not None:
        cost = f"{len(d.plan.steps)} further readings ({lasting(d.seconds, clock)})"
    names = numbers.names(d.suspects)
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
        "time": f"{cost} would {_told(d, names, then)}; --max-time does not allow them.",
        "plans": f"{cost} would {_told(d, names, then)}, but as many plans before did not do; "
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


def _told(d: "Decision", names: str, then: str) -> str:
    """Say what a further plan would have told."""
    return f"separate {names}" if d.suspects else f"lower the predicted error to {then}"


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


def improvement_report(found: Improvement, limit_m: float | None) -> Iterator[RenderableType]:
    """Yield the error before and after the correction, as measured, and whether a limit is kept."""
    every = found.everything
    out = text.table("load", "error", "mean", "rms", "max", "95 % within", "inside", left=(0, 1))
    for part in (*found.by_load, *(() if len(found.by_load) == 1 else (every,))):
        for row in _rows(part):
            out.add_row(*row)
    yield out
    yield Text(
        f"{goal_words(found.mode)} noise alone: what the tracker's noise and the arm's "
        "repeatability would leave; 95 % within: the largest distance that was predicted for 95 % "
        "of such readings, noise included; inside: points within their own.\n",
        style="dim",
    )
    yield summary(found)
    for name, why in found.left_out[:MOST_LEFT]:
        yield f"left out: {name}: {why}"
    if (more := len(found.left_out) - MOST_LEFT) > 0:
        yield f"left out: {more} more"
    if limit_m is not None:
        yield _limit_words(found, limit_m)


def summary(found: Improvement) -> str:
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
    name = "unloaded" if part.name == UNLOADED else part.name
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


def failure(found: Improvement, limit_m: float) -> str:
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
