"""A plan, and the one that `next` makes, in words and tables."""

import math
from collections.abc import Iterator, Sequence

from hilcal import numbers
from hilcal.design.next import SURE, Next, PairPower
from hilcal.design.run_order import Confounding
from hilcal.design.summary import CurvePoint, PlanSummary, PredictedParameter
from hilcal.present.document import Block, Table, heading, load_name, note, pairs, table
from hilcal.present.running import spoken
from hilcal.store.plan import UNLOADED

CRITERIA = {
    "D": "volume of the confidence region of all parameters",
    "A": "mean variance of the parameters",
    "E": "variance of the worst determined combination of parameters",
    "K": "condition number of the model alone, without effects outside of it",
    "I": "mean variance of the predicted position",
    "separate": "power to separate the leading suspects (T-optimality)",
}
BAR = 30
SCREEN = 4
"""Remarks on the first screen; the most important come first."""
UNCERTAIN = 1e-3
"""Least certified efficiency that tells anything. A choice: the last digit that is printed."""
LIKE = 1.1
"""A number of poses is enough where the end of the curve is not better by more than this factor.
A choice."""


def plan_facts(s: PlanSummary) -> Iterator[Block]:
    """Yield what a plan costs and reaches, and what more poses would give."""
    yield from (heading("Plan"), pairs(cost_rows(s)), "")
    if larger := [c for c in s.curve if c.poses > s.poses]:
        told = [f"{c.poses} poses ± {numbers.length(c.position_std_m)}" for c in larger[::2]]
        yield f"More would give, predicted for the {s.quantity}: {', '.join(told)}."


def plan_screen(s: PlanSummary) -> Iterator[Block]:
    """Yield what a plan costs and reaches, on one screen; `plan_report` yields the rest as well."""
    yield from plan_facts(s)
    heads = ("predicted for", "parameters", "±", "unit", "± in %, worst")
    if s.parameters:
        yield from (table(*heads, rows=effect_rows(s.parameters), left=(0, 3)), "")
    if seen := detectable(s):
        (first, least), (last, most) = seen[0], seen[-1]
        yield f"Outside of the model: {first} is seen from {least}, ..., {last} from {most}."
    if words := undetectable(s):
        yield words
    yield from (f"note: {remark}" for remark in s.remarks[:SCREEN])
    rest = len(s.remarks) - SCREEN
    more = f"{rest} more notes, every parameter" if rest > 0 else "every parameter"
    yield f"--details: {more}, criteria, numbers of poses, effects outside of the model."


def effect_rows(parameters: Sequence[PredictedParameter]) -> Iterator[tuple[str, ...]]:
    """Yield a row for the parameters of an effect that have one unit."""
    groups: dict[tuple[str, str], list[PredictedParameter]] = {}
    for p in parameters:
        groups.setdefault((_effect(p.name), p.unit), []).append(p)
    for (effect, si), all_of in groups.items():
        known = [p for p in all_of if math.isfinite(p.std)]
        some = f"{len(known)} of " if len(known) < len(all_of) else ""
        count = f"{some}{len(all_of)}"
        if not known:
            yield effect, count, "not determined", "", ""
            continue
        stds = [p.std for p in known]
        unit, factor = numbers.unit_for(si, stds)
        least, most = (numbers.digits(factor * x, 2) for x in (min(stds), max(stds)))
        shares = [p.std / abs(p.value) for p in known if p.value]
        worst = f"{numbers.digits(100 * max(shares), 2)} %" if shares else ""
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
        yield note("magnitude: estimated so far, else the effect's ordinary magnitude.\n")
    if s.criteria:
        yield heading("Comparison of criteria, for the same number of readings")
        yield from criteria_table(s)
    if s.curve:
        yield heading("Sample-size curve: how many poses are enough")
        yield _curve(s)
        yield f"{enough(s.curve)}\n"
    if s.detectable:
        yield heading("Minimum detectable effects outside of the model")
        if found := detectable(s):
            yield table("effect", "from", rows=found)
            yield note(
                "from: rms displacement of the target that is one sigma of these readings.\n"
            )
        if words := undetectable(s):
            yield f"{words}\n"
    for remark in s.remarks:
        yield f"note: {remark}"


def certified(efficiency: float) -> str:
    """Return a certified efficiency in words; rounded down, it is a bound."""
    if efficiency < UNCERTAIN:
        return "of the plan: not certified, since the bound of the best plan did not close"
    return f"of the plan: at least {_floor(efficiency)} (certified lower bound); not accuracy"


def _floor(efficiency: float) -> str:
    return f"{int(min(max(efficiency, 0.0), 1.0) * 1000 + 1e-6) / 10:.1f} %"


def cost_rows(s: PlanSummary) -> Iterator[tuple[str, str]]:
    """Yield names and values of what a plan costs and reaches."""
    yield "poses", f"{s.poses} and the reference{_asked(s)}"
    loads = ", ".join(f"{load_name(name)} {count}" for name, count in s.loads.items())
    yield "readings", f"{s.readings}: {loads}"
    time = s.duration
    changes = f"{s.load_changes} load change{'s' * (s.load_changes != 1)}"
    parts = f"motion {spoken(time.motion)}, readings {spoken(time.readings)}"
    yield "takes about", spoken(time.total)
    yield "", f"{parts}, {changes} by hand {spoken(time.load_changes)}"
    meaning = CRITERIA.get(s.criterion)
    yield "criterion", f"{s.criterion}: {meaning}" if meaning else s.criterion
    if s.efficiency is not None:
        yield "efficiency", certified(s.efficiency)
    if s.position_std_m is not None:
        yield s.quantity, f"± {numbers.length(s.position_std_m)}, predicted for the {s.position}"
        yield "", s.position_note


def _asked(s: PlanSummary) -> str:
    """Say why there are other poses than were asked for; nothing where there are as many."""
    if s.asked_poses in (None, s.poses):
        return ""
    return f": the cell leaves no more of {s.asked_poses}, so that some are read again"


def order_remark(s: PlanSummary) -> str:
    """Return in sentences what the order costs and how a linear drift acts."""
    own, randomised = s.confounding, s.longer >= 5e-4
    if own is None:
        return ""
    out = (
        "The order is randomised, so that drift is little correlated with joints and loads, and "
        f"takes {100 * s.longer:.1f} % longer than the shortest one. "
        if randomised
        else "The order is the shortest one. "
    )
    out += f"Estimating a drift as well costs up to about {_lost(own)} of a parameter's information"
    if randomised and s.shortest is not None:
        out += f" ({_lost(s.shortest)} in the shortest order)"
    mean = abs(own.bias_m)
    out += (
        f". Without it in the fit, a drift of {numbers.digits(3.6e9 * own.drift, 2)} µm/h shifts "
        f"deflections by {numbers.length(own.error_m)} rms and "
        f"{numbers.length(mean) if mean >= 1e-7 else 'less than 0.1 µm'} on average"
    )
    if own.drift_std is not None:
        rate = numbers.digits(3.6e9 * own.drift_std, 2)
        out += f"; the returns to the reference pose determine it to ± {rate} µm/h"
    return f"{out}."


def _lost(c: Confounding) -> str:
    """Return the share of information that a drift costs, rounded up to whole percent."""
    return f"{max(1, math.ceil(100 * c.correlation**2 - 1e-6))} %"


def _parameter_rows(parameters: Sequence[PredictedParameter]) -> Iterator[tuple[str, ...]]:
    """Yield rows; parameters of one effect and unit share a prefix."""
    for p in parameters:
        alike = [o for o in parameters if o.unit == p.unit and _effect(o.name) == _effect(p.name)]
        sizes = [o.std if o.value is None else o.value for o in alike]
        unit, factor = numbers.unit_for(p.unit, sizes)
        magnitude = "" if p.value is None else numbers.digits(factor * p.value)
        if not math.isfinite(p.std):
            yield p.name, "not determined", magnitude, unit, ""
            continue
        share = f"{numbers.digits(100 * p.std / abs(p.value), 2)} %" if p.value else ""
        yield p.name, numbers.digits(factor * p.std, 2), magnitude, unit, share


def _effect(name: str) -> str:
    return name.split(".")[0]


def criteria_table(s: PlanSummary) -> Iterator[Block]:
    """Yield what plans by other criteria would reach with as many readings."""
    heads = ("criterion", "predicted ±", "open ±", "joint ±", "O1 (D)", "O2 (K)", "O3 (E)")
    out = table(*heads, "certified")
    for c in s.criteria:
        this = c.criterion == s.criterion
        sizes = (c.position_std_m, c.position_open_m)
        out.add(
            f"{c.criterion} (this)" if this else c.criterion,
            *("-" if x is None else numbers.length(x) for x in sizes),
            "-" if c.joint_share is None else f"{numbers.digits(100 * c.joint_share, 2)} %",
            *(numbers.digits(c.o1), numbers.digits(c.o2, 2), numbers.digits(c.o3)),
            "-" if c.efficiency is None else _floor(c.efficiency),
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
    top = max(point.position_std_m for point in s.curve)
    for point in s.curve:
        size = max(1, round(BAR * point.position_std_m / top)) if top > 0 else 1
        this = point.poses == s.poses
        bar, length = "█" * size + "  this plan" * this, numbers.length(point.position_std_m)
        out.add(str(point.poses), length, bar, tone="strong" if this else "text")
    return out


def enough(curve: Sequence[CurvePoint]) -> str:
    """Return in words from which number of poses on more of them change little."""
    last = curve[-1]
    first = next(p for p in curve if p.position_std_m <= LIKE * last.position_std_m)
    if first is last:
        return f"More than {last.poses} poses still improve the prediction."
    gain = 1.0 - last.position_std_m / first.position_std_m
    return (
        f"From {first.poses} to {last.poses} poses the prediction's uncertainty falls by "
        f"{100 * gain:.0f} % only."
    )


def detectable(s: PlanSummary) -> list[tuple[str, str]]:
    """Return effects with their minimum detectable displacement, smallest first."""
    found = [(d.least_m, d.effect) for d in s.detectable if d.least_m is not None]
    return [(effect, numbers.length(least)) for least, effect in sorted(found)]


def undetectable(s: PlanSummary) -> str:
    """Return in words which effects the readings cannot detect; empty where there are none."""
    names = [d.effect for d in s.detectable if d.least_m is None]
    return f"These readings cannot detect {numbers.names(names, 'or')}." if names else ""


_STRETCHED = 1.15
_MOST_LOADS = 2
_LEAST_SHARE = 0.1


def next_report(found: Next, poses: int, readings: int, details: bool = True) -> Iterator[Block]:
    """Yield the powers of the pairs, now and then, and what makes the difference.

    `poses` beside the reference and `readings` are the plan's; without `details` of each suspect
    only the pair that is separated least.
    """
    yield heading("Telling the suspects apart")
    yield power_table(found.powers if details else weakest(found.powers))
    yield note(
        "now, then: where the first effect is there, the chance that the readings so far, and with "
        "those planned as well, reject a fit with the second in its place (test at 1 %).\n"
    )
    yield f"{powers_summary(found.powers, poses, readings)} {_difference(found)}\n"
    for remark in found.notes:
        yield f"note: {remark}"


def weakest(powers: Sequence[PairPower]) -> tuple[PairPower, ...]:
    """Return of each effect that may be there the pair that is separated least."""
    least: dict[str, PairPower] = {}
    for t in powers:
        if t.effect not in least or t.then < least[t.effect].then:
            least[t.effect] = t
    return tuple(least.values())


def brief_plan(s: PlanSummary) -> str:
    """Say in two sentences what a plan costs and how good it is."""
    loads = numbers.names([load_name(name) for name in s.loads])
    certain = "" if s.efficiency is None else f" Efficiency {certified(s.efficiency)}."
    return (
        f"Plan: {s.readings} readings at {s.poses} poses and the reference, {loads}; takes about "
        f"{spoken(s.duration.total)}.{certain} --details shows the rest.\n"
    )


def poses_report(found: Next, poses: int, readings: int, details: bool = True) -> Iterator[Block]:
    """Yield what further poses tell of a misfit of the pose alone; arguments of `next_report`."""
    yield heading("Poses where nothing was read yet")
    yield (
        f"The misfit is the same under every load of a pose, so that loads tell nothing of it: "
        f"{readings} unloaded readings at {poses} poses, spread over the joints' range.\n"
    )
    if found.powers:
        some = found.powers if details else weakest(found.powers)
        yield power_table(some, "and this is fitted")
        yield note(
            "now, then: chance that it passes every test of a missing effect, poses left out "
            "included, with the readings so far and with those planned as well.\n"
        )


def power_table(powers: Sequence[PairPower], rival: str = "this is ruled out") -> Table:
    """Return the table of powers of pairs, now and with the plan."""
    return table("if this is there", rival, "now", "then", rows=power_rows(powers), left=(0, 1))


def power_rows(powers: Sequence[PairPower]) -> Iterator[tuple[str, str, str, str]]:
    """Yield effect, rival, and the powers now and with the plan."""
    for t in powers:
        then = "not in this cell" if t.not_separable else chance(t.then)
        yield t.effect, t.rival, chance(t.now), then


def chance(power: float) -> str:
    """Write a chance; no test is certain."""
    return "> 99 %" if power > 0.995 else numbers.percent(power)


def _at_least(power: float) -> str:
    """Write a lower bound of a chance, rounded down."""
    return f"{min(int(100 * power + 1e-9), 99)} %"


def powers_summary(powers: Sequence[PairPower], poses: int, readings: int) -> str:
    """Say in a sentence what the plan will settle."""
    able = [t for t in powers if not t.not_separable]
    head = f"{readings} readings at {poses} poses"
    if not able:
        return f"{head} rule out none of the suspects."
    least = min(able, key=lambda t: t.then)
    if least.then < SURE:
        return (
            f"{head}: the weakest pair is {least.effect}, where it is there, and {least.rival}, "
            f"which they rule out with a chance of {chance(least.then)} ({chance(least.now)} now); "
            "more poses raise it."
        )
    if len(able) == len(powers):
        return (
            f"{head} separate the suspects: whichever is there, each of the others is ruled out "
            f"with a chance of at least {_at_least(least.then)}."
        )
    return (
        f"{head} separate what can be separated in this cell: each of these pairs with a chance of "
        f"at least {_at_least(least.then)}."
    )


def _difference(found: Next) -> str:
    """Say which loads and poses make the difference."""
    by = sorted(found.shares.items(), key=lambda pair: -pair[1])
    named = [
        f"{'the unloaded readings' if load == UNLOADED else load} ({numbers.percent(share)})"
        for load, share in by[:_MOST_LOADS]
        if share >= _LEAST_SHARE
    ]
    words = f"What separates the weakest pair comes from {numbers.names(named)}"
    if found.reach_ratio > _STRETCHED:
        words += ", most of it with the arm stretched out"
    elif found.reach_ratio < 1 / _STRETCHED:
        words += ", most of it with the arm drawn in"
    return f"{words}."
