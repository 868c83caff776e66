"""Reports of plans: of a campaign, and of the measurements of `next`."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from hilcal import numbers
from hilcal.design.next import SEPARATED_POWER, PairPower, SeparatingPlan
from hilcal.design.run_order import Confounding
from hilcal.design.summary import (
    NOTABLE_EFFICIENCY,
    CurvePoint,
    PlanSummary,
    PredictedParameter,
)
from hilcal.names import quoted
from hilcal.numbers import digits, length
from hilcal.present.document import Block, Table, heading, load_name, note, pairs, table
from hilcal.present.progress import duration_text
from hilcal.store.plan import UNLOADED

CRITERIA = {
    "D": "volume of the confidence region of all parameters",
    "A": "mean variance of the parameters",
    "E": "variance of the worst determined combination of parameters",
    "K": "condition number of the model alone, without effects outside of it",
    "I": "mean variance of the predicted position",
    "separate": "power to separate the leading suspects (T-optimality)",
}
BAR_WIDTH = 30
MOST_REMARKS = 4  # remarks on the first screen; the most important come first
NAMED_FROM = "a diagnosis names effects about ten times as large"
"""6 to 16 times in one simulated campaign of 20 poses: tests at the level of a whole catalogue."""
MIN_EFFICIENCY = 1e-3  # least certified efficiency that is reported: the last printed digit
SIMILAR_RATIO = 1.1
"""Poses are enough if their predicted uncertainty is at most this multiple of that at the end of
the curve. A choice."""
_STRETCHED, _MOST_LOADS, _LEAST_SHARE = 1.15, 2, 0.1


def plan_facts(s: PlanSummary) -> Iterator[Block]:
    """Yield costs and predicted uncertainty of a plan, and of plans with more poses."""
    yield from (heading("Plan"), pairs(cost_rows(s)), "")
    if larger := [c for c in s.curve if c.poses > s.poses]:
        larger_plans = [f"{c.poses} poses ± {length(_std(c))}" for c in larger[::2]]
        yield f"More would give, predicted for the {s.quantity}: {', '.join(larger_plans)}."


def plan_screen(s: PlanSummary) -> Iterator[Block]:
    """Yield the summary of a plan on one screen; `plan_report` is the full report."""
    yield from plan_facts(s)
    if s.parameters:
        heads = ("predicted for", "parameters", "±", "unit", "± in %, worst")
        yield from (table(*heads, rows=_effect_rows(s.parameters), left=(0, 3)), "")
    if detectable := _detectable(s):
        (first, least), (last, most) = detectable[0], detectable[-1]
        yield (
            f"Outside the model: {first} of {least}, ..., {last} of {most} are one σ of "
            f"these readings; {NAMED_FROM}."
        )
    yield from _undetectable(s)
    yield from (f"note: {remark}" for remark in s.remarks[:MOST_REMARKS])
    unlisted = len(s.remarks) - MOST_REMARKS
    details = f"{unlisted} more notes, every parameter" if unlisted > 0 else "every parameter"
    yield f"--details: {details}, criteria, numbers of poses, effects outside the model."


def _effect_rows(parameters: Sequence[PredictedParameter]) -> Iterator[tuple[str, ...]]:
    """Yield a row for all parameters of an effect with the same unit."""
    for (effect, si), members in _by_effect(parameters).items():
        determined = [p for p in members if math.isfinite(p.std)]
        count = f"{f'{len(determined)} of ' * (len(determined) < len(members))}{len(members)}"
        if not determined:
            yield effect, count, "not determined", "", ""
            continue
        stds = [p.std for p in determined]
        unit, factor = numbers.unit_for(si, stds)
        least, most = (digits(factor * x, 2) for x in (min(stds), max(stds)))
        shares = [p.std / abs(p.value) for p in determined if p.value]
        worst = f"{digits(100 * max(shares), 2)} %" if shares else ""
        yield effect, count, least if least == most else f"{least} to {most}", unit, worst


def plan_report(s: PlanSummary) -> Iterator[Block]:
    """Yield the tables and remarks of a plan."""
    yield from (heading("Plan"), pairs(cost_rows(s)), "")
    if s.confounding is not None:
        yield f"{order_remark(s)}\n"
    if s.parameters:
        yield heading("Predicted standard uncertainty")
        heads = ("parameter", "±", "magnitude", "unit", "± in %")
        yield table(*heads, rows=_parameter_rows(s.parameters), left=(0, 3))
        yield note("magnitude: the estimate so far, or the ordinary magnitude of the effect.\n")
    if s.criteria:
        yield heading("Comparison of criteria, for the same number of readings")
        yield from _criteria_table(s)
    if s.curve:
        yield heading("Sample-size curve: how many poses are enough")
        yield from (_curve(s), f"{enough_poses_sentence(s.curve)}\n")
    if s.detectable:
        yield heading("Minimum detectable effects outside the model")
        if detectable := _detectable(s):
            yield table("effect", "from", rows=detectable)
            yield note(
                "from: rms displacement of the target that is one σ of these readings; "
                f"{NAMED_FROM}.\n"
            )
        yield from (f"{sentence}\n" for sentence in _undetectable(s))
    yield from (f"note: {remark}" for remark in s.remarks)


def efficiency_sentence(efficiency: float) -> str:
    """Return a sentence on a certified efficiency, rounded down because it is a lower bound."""
    if efficiency < MIN_EFFICIENCY:
        return "of the plan: not certified, as the bound of the best plan did not converge"
    return f"of the plan: at least {_percent(efficiency)} (certified lower bound); not accuracy"


def _percent(efficiency: float) -> str:
    return f"{int(min(max(efficiency, 0.0), 1.0) * 1000 + 1e-6) / 10:.1f} %"


def cost_rows(s: PlanSummary) -> Iterator[tuple[str, str]]:
    """Yield names and values of the costs and predicted results of a plan."""
    fewer = ""
    if s.asked_poses not in (None, s.poses):
        fewer = f": the candidates leave no more of {s.asked_poses}; some are read again"
    yield "poses", f"{s.poses} and the reference{fewer}"
    loads = ", ".join(f"{load_name(name)} {count}" for name, count in s.loads.items())
    yield "readings", f"{s.readings}: {loads}"
    time = s.duration
    changes = f"{s.load_changes} load change{'s' * (s.load_changes != 1)}"
    parts = f"motion {duration_text(time.motion)}, readings {duration_text(time.readings)}"
    yield "takes about", duration_text(time.total)
    yield "", f"{parts}, {changes} by hand {duration_text(time.load_changes)}"
    meaning = CRITERIA.get(s.criterion)
    yield "criterion", f"{s.criterion}: {meaning}" if meaning else s.criterion
    if s.efficiency is not None:
        yield "efficiency", efficiency_sentence(s.efficiency)
        if s.all_effects_std_m is not None and s.efficiency < NOTABLE_EFFICIENCY:
            yield "", "the bound splits a reading over many poses, which no plan can"
    if s.all_effects_std_m is not None:
        yield s.quantity, f"± {length(s.all_effects_std_m)}, predicted for the {s.position}"
        yield "", _all_effects_note(s)
    elif s.position_std_m is not None:
        yield s.quantity, f"± {length(s.position_std_m)}, predicted for the {s.position}"
        yield "", s.position_note


def _all_effects_note(s: PlanSummary) -> str:
    """Return a sentence on what `all_effects_std_m` includes, and on other plans."""
    note = (
        f"rms error of the fitted {s.quantity}, repeatability not included: every effect of the "
        "catalogue is unknown, and as large as arms have it or as the readings so far tell it"
    )
    if s.random_std_m is not None:
        note += f"; as many random poses: ± {length(s.random_std_m)}"
    if s.position_std_m is not None:
        note += f"; if the model were complete: ± {length(s.position_std_m)}"
    return note


def _std(point: CurvePoint) -> float:
    """Return the uncertainty with all effects, where the plan is for them."""
    std = point.all_effects_std_m
    return point.position_std_m if std is None else std


def order_remark(s: PlanSummary) -> str:
    """Return sentences on the cost of the order and on the effect of a linear drift."""
    c, order, in_shortest, returns = s.confounding, "The order is the shortest one.", "", ""
    if c is None:
        return ""
    if s.longer >= 5e-4:
        order = (
            "The order is randomised, so that drift is little correlated with joints and loads, "
            f"and takes {100 * s.longer:.1f} % longer than the shortest one."
        )
        if s.shortest is not None:
            in_shortest = f" ({_loss(s.shortest)} in the shortest order)"
    if c.drift_std is not None:
        rate = digits(3.6e9 * c.drift_std, 2)
        returns = f"; the returns to the reference pose determine it to ± {rate} µm/h"
    mean = length(abs(c.bias_m)) if abs(c.bias_m) >= 1e-7 else "less than 0.1 µm"
    return (
        f"{order} Estimating a drift as well costs up to about {_loss(c)} of a parameter's "
        f"information{in_shortest}. Without it in the fit, a drift of "
        f"{digits(3.6e9 * c.drift, 2)} µm/h shifts deflections by {length(c.error_m)} rms and "
        f"{mean} on average{returns}."
    )


def _loss(c: Confounding) -> str:
    """Return the share of information that a drift costs, rounded up to whole percent."""
    return f"{max(1, math.ceil(100 * c.correlation**2 - 1e-6))} %"


def _parameter_rows(parameters: Sequence[PredictedParameter]) -> Iterator[tuple[str, ...]]:
    """Yield a row per parameter; parameters of one effect and unit share a prefix of the unit."""
    groups = _by_effect(parameters)
    for p in parameters:
        alike = groups[p.name.split(".")[0], p.unit]
        sizes = [o.std if o.value is None else o.value for o in alike]
        unit, factor = numbers.unit_for(p.unit, sizes)
        magnitude = "" if p.value is None else digits(factor * p.value)
        std, share = "not determined", ""
        if math.isfinite(p.std):
            std = digits(factor * p.std, 2)
            share = f"{digits(100 * p.std / abs(p.value), 2)} %" if p.value else ""
        yield p.name, std, magnitude, unit, share


def _by_effect(
    parameters: Sequence[PredictedParameter],
) -> dict[tuple[str, str], list[PredictedParameter]]:
    groups: dict[tuple[str, str], list[PredictedParameter]] = {}
    for p in parameters:
        groups.setdefault((p.name.split(".")[0], p.unit), []).append(p)
    return groups


def _criteria_table(s: PlanSummary) -> Iterator[Block]:
    heads = ("criterion", "predicted ±", "open ±", "joint ±", "O1 (D)", "O2 (K)", "O3 (E)")
    out = table(*heads, "certified")
    for c in s.criteria:
        this = c.criterion == s.criterion
        out.add(
            f"{c.criterion} (this)" if this else c.criterion,
            *("-" if x is None else length(x) for x in (c.position_std_m, c.position_open_m)),
            "-" if c.joint_share is None else f"{digits(100 * c.joint_share, 2)} %",
            *(digits(c.o1), digits(c.o2, 2), digits(c.o3)),
            "-" if c.efficiency is None else _percent(c.efficiency),
            tone="strong" if this else "text",
        )
    yield out
    yield note(
        "predicted: standard uncertainty of the prediction at the prediction poses; open: the same "
        "with the effects outside of the model estimated as well. joint: largest relative "
        "uncertainty of a joint compliance. O1 to O3: observability indices, larger is better; O1 "
        "and O3 with these effects estimated as well. certified: lower bound of the efficiency by "
        "its own criterion.\n"
    )


def _curve(s: PlanSummary) -> Table:
    out = table("poses", "predicted ±", "", left=(2,))
    top = max(map(_std, s.curve))
    for point in s.curve:
        size = max(1, round(BAR_WIDTH * _std(point) / top)) if top > 0 else 1
        this = point.poses == s.poses
        bar, std = "█" * size + "  this plan" * this, length(_std(point))
        out.add(str(point.poses), std, bar, tone="strong" if this else "text")
    return out


def enough_poses_sentence(curve: Sequence[CurvePoint]) -> str:
    """Return a sentence on the number of poses from which more of them change little."""
    last = curve[-1]
    first = next(p for p in curve if _std(p) <= SIMILAR_RATIO * _std(last))
    if first is last:
        return f"More than {last.poses} poses still improve the prediction."
    gain = numbers.percent(1.0 - _std(last) / _std(first))
    what = "the prediction's uncertainty falls by"
    return f"From {first.poses} to {last.poses} poses {what} {gain} only."


def _detectable(s: PlanSummary) -> list[tuple[str, str]]:
    """Return effects with their minimum detectable displacement, smallest first."""
    least = sorted((d.least_m, d.effect) for d in s.detectable if d.least_m is not None)
    return [(effect, length(metres)) for metres, effect in least]


def _undetectable(s: PlanSummary) -> Iterator[str]:
    if names := [d.effect for d in s.detectable if d.least_m is None]:
        yield f"These readings cannot detect {numbers.names(names, 'or')}."


def brief_plan(s: PlanSummary) -> str:
    """Return two sentences on the cost and the efficiency of a plan."""
    loads = numbers.names([load_name(name) for name in s.loads])
    certain = "" if s.efficiency is None else f" Efficiency {efficiency_sentence(s.efficiency)}."
    return (
        f"Plan: {s.readings} readings at {s.poses} poses and the reference, {loads}; takes about "
        f"{duration_text(s.duration.total)}.{certain} --details shows the rest.\n"
    )


def next_report(
    plan: SeparatingPlan, poses: int, readings: int, details: bool = True
) -> Iterator[Block]:
    """Yield the powers of pairs of suspects; without `details` of each suspect's weakest pair."""
    yield heading("Power to separate the suspects")
    yield power_table(plan.powers if details else _weakest(plan.powers))
    yield note(
        "now, then: if the first effect is present, the chance that the readings so far (now), or "
        "with the planned ones (then), reject a fit with the second in its place (test at 1 %). An "
        "effect that the readings so far do not support is assumed to change them by 1 σ rms.\n"
    )
    yield f"{powers_summary(plan.powers, poses, readings)} {_difference(plan)}\n"
    yield from (f"note: {remark}" for remark in plan.notes)


def adding_lines(run: Path, plan: Path, cell: Path | None, appendable: bool) -> tuple[str, ...]:
    """Return how the readings of a further plan are added to a campaign, and the commands.

    A campaign that was imported, and so is not `appendable`, is imported again with them.
    """
    config = cell or "CELL.toml"
    if appendable:
        return (
            "To add its readings to the campaign:",
            f"hilcal run {quoted(config)} -o {quoted(run)} --append --plan {quoted(plan)}",
        )
    return (
        "Export, add the new readings as rows (new pose names), import:",
        f"hilcal export {quoted(run)} --readings READINGS.csv",
        f"hilcal import READINGS.csv --config {quoted(config)} -o NEW.hilcal",
    )


def poses_report(
    plan: SeparatingPlan, poses: int, readings: int, details: bool = True
) -> Iterator[Block]:
    """Yield the plan of poses for a misfit that depends on the pose alone; see `next_report`."""
    yield heading("New poses")
    yield (
        f"The misfit is the same under every load of a pose, so that loads do not help: {readings} "
        f"unloaded readings at {poses} poses, spread over the joints' range.\n"
    )
    if plan.powers:
        yield power_table(plan.powers if details else _weakest(plan.powers), "and this is fitted")
        yield note(
            "now, then: chance that it passes every test of a missing effect, also on poses left "
            "out, with the readings so far and with the planned ones.\n"
        )


def _weakest(powers: Sequence[PairPower]) -> tuple[PairPower, ...]:
    """Return for each possible effect the pair with the lowest power."""
    least: dict[str, PairPower] = {}
    for t in powers:
        if t.effect not in least or t.power_planned < least[t.effect].power_planned:
            least[t.effect] = t
    return tuple(least.values())


def power_table(powers: Sequence[PairPower], rival: str = "chance to rule out") -> Table:
    """Return the table of powers of pairs, with the readings so far and with the plan."""
    return table("if this is present", rival, "now", "then", rows=power_rows(powers), left=(0, 1))


def power_rows(powers: Sequence[PairPower]) -> Iterator[tuple[str, str, str, str]]:
    """Yield effect, rival, and the powers with the readings so far and with the plan."""
    for t in powers:
        then = "not in this cell" if t.not_separable else _chance(t.power_planned)
        yield t.effect, t.rival, _chance(t.power_now), then


def _chance(power: float) -> str:
    """Return a power as text; none is 100 %."""
    return "> 99 %" if power > 0.995 else numbers.percent(power)


def powers_summary(powers: Sequence[PairPower], poses: int, readings: int) -> str:
    """Return a sentence on the power of the plan."""
    able = [t for t in powers if not t.not_separable]
    head = f"{readings} readings at {poses} poses"
    if not able:
        return f"{head} rule out none of the suspects."
    least = min(able, key=lambda t: t.power_planned)
    if least.power_planned < SEPARATED_POWER:
        return (
            f"{head}: the weakest pair is {least.effect}, if it is present, and {least.rival}, "
            f"which they rule out with a chance of {_chance(least.power_planned)} "
            f"({_chance(least.power_now)} now); more poses raise it."
        )
    what = "what can be separated in this cell: each of these pairs"
    if len(able) == len(powers):
        what = "the suspects: whichever is present, each of the others is ruled out"
    at_least = min(int(100 * least.power_planned + 1e-9), 99)  # rounded down
    return f"{head} separate {what} with a chance of at least {at_least} %."


def _difference(plan: SeparatingPlan) -> str:
    shares = sorted(plan.shares.items(), key=lambda item: -item[1])
    named = [
        f"{'the unloaded readings' if load == UNLOADED else load} ({numbers.percent(share)})"
        for load, share in shares[:_MOST_LOADS]
        if share >= _LEAST_SHARE
    ]
    sentence = f"What separates the weakest pair comes from {numbers.names(named)}"
    if plan.reach_ratio > _STRETCHED:
        sentence += ", most of it with the arm stretched out"
    elif plan.reach_ratio < 1 / _STRETCHED:
        sentence += ", most of it with the arm drawn in"
    return f"{sentence}."
