"""What `compare A B` says: the error of the earlier calibration today, and what has changed."""

from collections.abc import Iterator, Sequence

from hilcal import numbers
from hilcal.diagnosis.change import LEVEL, POWER, Candidate, Change, Limit
from hilcal.diagnosis.comparison import Comparison
from hilcal.identification.parameter_differences import Differences
from hilcal.names import quoted
from hilcal.present.document import Block, Table, heading, table
from hilcal.present.fit import error_words, measurements

MOST_PARAMETERS = 6
"""Parameters of a change that are listed."""
MOST_ROWS = 12
"""Parameters of both fits that are listed."""
CLEAR = 2.0
"""Standard deviations from which one of several parameters of a change is listed."""


def words_of(c: Candidate) -> str:
    """Return what may have changed, in words."""
    if c.joint:
        return f"joint {c.joint}'s {c.change.words or c.effect}"
    if c.kind == "link":
        return f"the {c.change.words or c.effect} of {c.part}"
    return c.change.words or c.effect


def comparison_report(c: Comparison, earlier: str, later: str) -> Iterator[Block]:
    """Yield everything that is said, with the names of the two files."""
    yield from _setup(c, earlier, later)
    yield ""
    yield from _today(c, earlier)
    yield ""
    yield from _changes(c)
    yield from _parameters(c.differences)
    yield ""
    yield f"Next: {next_step(c, earlier)}"


def _setup(c: Comparison, earlier: str, later: str) -> Iterator[str]:
    what = measurements(c.mode, c.today.prediction.readings)
    count = len(c.today.prediction.raw)
    yield f"{count} {what} of {later}, measured later."
    if c.shared:
        model = "the baseline" if c.number is None else f"revision {c.number}"
        yield f"{c.shared} of its {c.readings} readings were fitted by {model}; they are left out."
    if c.later_mode not in (None, c.mode):
        yield (
            f"{later} was fitted to {_kind(c.later_mode)}, {earlier} to {_kind(c.mode)}: "
            f"{_kind(c.mode)} are compared."
        )
    if c.lacked:
        yield (
            f"The model of {earlier} lacks {numbers.names(c.lacked)} by its own readings; added "
            "for this comparison alone (hilcal refine EARLIER keeps it)."
        )
    if c.anew:
        yield (
            "The tracker's place is estimated from them, as if it had been set up anew"
            + ("." if c.told else " (--same-setup: nobody moved tracker or base).")
        )
    else:
        reason = "as told" if c.told else "both cells configure the same place"
        yield f"The tracker's place is that of {earlier} ({reason})."
    if c.tool:
        yield f"[tool] {numbers.names(c.tool)} of {later} differ; those of {later} are used."


def _kind(mode: str | None) -> str:
    return "deflections" if mode == "deflection" else "absolute readings"


def _today(c: Comparison, earlier: str) -> Iterator[Block]:
    t, error = c.today, c.today.prediction.error
    drawing = "-" if t.drawing_m is None else numbers.length(t.drawing_m)
    sizes = (error.rms_m, error.mean_m, error.max_m, t.stated_m)
    row = (f"calibration of {earlier}", *map(numbers.length, sizes), drawing)
    heads = (error_words(t.prediction.readings), "rms", "mean", "largest", "expected", "as drawn")
    yield table(*heads, rows=[row])
    yield (
        f"The error is {numbers.digits(t.z, 2)} times what it states, all correlations counted "
        f"({numbers.p_equals(t.p_value)}): {'no ' * (t.p_value >= LEVEL)}more than its uncertainty."
    )
    beyond = t.beyond
    # How far the poses are from the measured ones, the expected error counts.
    ranges = [f"{v.variable} ({v.count})" for v in beyond.variables if v.variable != "leverage"]
    if ranges:
        yield (
            f"Outside of what {earlier} measured: {numbers.few(ranges, 3)}; an error there need "
            "not be a change."
        )


def headline(c: Comparison) -> str:
    """Say in a few words whether something has changed."""
    found = c.changes
    if not found.found and found.explained:
        return "Nothing has changed beyond the uncertainty"
    if c.another_arm:
        return "This looks like another arm of the same type"
    if found.found:
        parts = numbers.names(list(dict.fromkeys(x.candidate.part for x in found.found)))
        return f"Something has changed: {parts}"
    return "Something has changed, and no single candidate explains it"


def _changes(c: Comparison) -> Iterator[Block]:
    found = c.changes
    yield heading("What has changed" if found.found and not c.another_arm else f"{headline(c)}.")
    if not found.found and found.explained:
        yield from _limits(c)
        return
    if c.another_arm:
        yield (
            "The calibration predicts these readings no better than the arm as drawn, and no few "
            "changes explain them."
        )
        return
    if not found.found:
        yield _left(c)
        return
    for change in found.found:
        yield sentence(change)
        if change.same_as:
            others = numbers.names([words_of(o) for o in change.same_as], "or")
            yield f"  These readings do not tell it from {others}."
    yield ""
    yield _table(found.found)
    if not all(change.candidate.of_arm for change in found.found):
        named = dict.fromkeys(words_of(x.candidate) for x in found.found if not x.candidate.of_arm)
        yield f"Not of the arm: {numbers.names(list(named))}."
    yield _left(c)
    yield numbers.many_tests(found.tested, LEVEL, "candidates").replace("diagnoses", "comparisons")


def sentence(change: Change) -> str:
    """Return a change in one sentence."""
    c, s = change.candidate, change.sizes[0]
    what = words_of(c)
    head = what[:1].upper() + what[1:]
    why = c.change.cause
    if len(change.sizes) > 1:
        return (
            f"{head} has changed: it moves the target by {numbers.length(change.moved_m)} rms "
            f"({numbers.p_equals(change.p_value)}). {why[:1].upper()}{why[1:]}".rstrip()
        )
    value, std, unit = numbers.measured(s.unit, s.value, s.std)
    share = ""
    if c.moving.effect.elastic and s.before is not None and s.before[0] > 0:
        share = f", to {numbers.digits((s.before[0] + s.value) / s.before[0], 2)} times what it was"
    signed = value if value.startswith("-") else f"+{value}"
    words = f"{head} has moved by {signed} ± {std} {unit}{share} ({abs(s.z):.0f} σ)"
    return f"{words}: {why}" if why else f"{words}."


def _table(found: Sequence[Change]) -> Table:
    out = table("change", "by", "±", "unit", "σ", "p", "at target", left=(0, 3))
    for change in found:
        more = (numbers.chance(change.p_value), numbers.length(change.moved_m))
        alone = len(change.sizes) == 1
        shown = [s for s in change.sizes if alone or abs(s.z) >= CLEAR]
        if not shown:
            out.add(change.candidate.name, *[""] * 4, *more)
        for k, s in enumerate(shown[:MOST_PARAMETERS]):
            value, std, unit = numbers.measured(s.unit, s.value, s.std, [s.value, s.std])
            name = change.candidate.name if alone else f"{change.candidate.effect}.{s.parameter}"
            out.add(name, value, std, unit, f"{abs(s.z):.1f}", *(("", "") if k else more))
        if len(shown) > MOST_PARAMETERS:
            out.add(f"  … {len(shown) - MOST_PARAMETERS} more", *[""] * 6)
    return out


def _left(c: Comparison) -> str:
    found = c.changes
    if found.explained:
        return (
            f"What is left after that is scatter as stated ({numbers.digits(found.scatter, 2)} "
            "times)."
        )
    outside = any(v.variable != "leverage" for v in c.today.beyond.variables)
    more = ", or the earlier model is wrong where it was not measured" if outside else ""
    return (
        f"What is left is {numbers.digits(found.scatter, 2)} times the stated scatter "
        f"({numbers.p_equals(found.unexplained)}): more has changed than the candidates explain, "
        f"or these readings are noisier than stated{more}."
    )


def _limits(c: Comparison) -> Iterator[Block]:
    found = c.changes
    by_joint: dict[str, dict[str, Limit]] = {}
    for limit in found.limits:
        if limit.change.listed:
            by_joint.setdefault(limit.part, {})[limit.change.words] = limit
    shown = list(dict.fromkeys(words for of in by_joint.values() for words in of))
    rows = ((part, *(_least(of.get(words)) for words in shown)) for part, of in by_joint.items())
    yield table("would have been seen", *shown, rows=rows)
    yield (
        f"The smallest change that these readings would have shown in {POWER * 10:.0f} cases of "
        f"10; where nothing has changed, a change is claimed once in {1 / LEVEL:.0f}."
    )
    zeros = [x.part for x in found.limits if x.change.by_frame and _least(x) == "-"]
    if c.mode == "deflection":
        yield "Deflections do not show zeros and geometry: these cancel in them."
    elif zeros:
        frames = "the place of the tracker, estimated anew," if c.anew else "a frame"
        yield f"Not to be seen: the zero of {numbers.names(zeros)}; {frames} absorbs it."


def _parameters(d: Differences | None) -> Iterator[Block]:
    """Yield the parameters of both fits, those that differ most first."""
    if d is None:
        return
    yield ""
    yield heading("Both campaigns' own fits, as far as they can be compared")
    told = sorted((r for r in d.rows if r.z is not None), key=lambda r: -abs(r.z or 0.0))
    if told:
        out = table("parameter", "before", "after", "by", "±", "unit", "σ", left=(0, 5))
        for r in told[:MOST_ROWS]:
            std = r.std or 0.0
            unit, factor = numbers.unit_for(r.unit, [r.before, r.after, r.difference])
            by, error = numbers.with_std(factor * r.difference, factor * std)
            places = len(error.partition(".")[2])
            sizes = (f"{factor * v:.{places}f}" for v in (r.before, r.after))
            out.add(r.name, *sizes, by, error, unit, f"{abs(r.z or 0.0):.1f}")
        yield out
        if len(told) > MOST_ROWS:
            yield f"{len(told) - MOST_ROWS} more differ less."
    for e in d.effects:
        chance = numbers.p_equals(e.p_value)
        yield f"{e.effect}, as a whole: χ² {e.chi2:.0f} of {e.rank} ({chance})."
    open_ = sum(r.z is None for r in d.rows)
    if open_:
        yield (
            f"{open_} cannot be compared one by one: frames absorb them, or a campaign tells "
            "nothing of them."
        )
    if d.apart:
        yield f"Not in both, or with other options: {numbers.names(d.apart)}."


def _least(limit: Limit | None) -> str:
    if limit is None or limit.size == float("inf"):
        return "-"
    return numbers.sizes([(limit.unit, limit.size)])


def next_step(c: Comparison, earlier: str) -> str:
    """Return in one sentence what to do next; `next_command` is the line for it."""
    found = c.changes
    if c.another_arm:
        return "calibrate it by itself."
    if not found.found and found.explained:
        return f"nothing; the calibration of {earlier} holds."
    arm = [x for x in found.found if x.candidate.of_arm]
    if found.explained and found.found and not arm:
        return f"put the setup right, and compare again; the calibration of {earlier} holds."
    parts = numbers.names(list(dict.fromkeys(x.candidate.part for x in arm)))
    what = f"recalibrate {parts}" if parts else "recalibrate the arm"
    return f"{what}, with what {earlier} knows as prior; more readings make it surer."


def next_command(c: Comparison, earlier: str, later: str) -> str | None:
    """Return the command line for the next step; None where there is none."""
    if c.another_arm:
        return f"hilcal refine {quoted(later)}"
    arm = [x for x in c.changes.found if x.candidate.of_arm]
    changed = bool(arm) or not c.changes.explained
    return f"hilcal refine {quoted(later)} --prior {quoted(earlier)}" if changed else None


def comparison_json(c: Comparison, earlier: str, later: str) -> dict[str, object]:
    """Return the comparison as JSON, SI, with its sentences."""
    changes = [{**x.to_dict(), "words": sentence(x)} for x in c.changes.found]
    after = {"next": next_step(c, earlier), "next_command": next_command(c, earlier, later)}
    return {**c.to_dict(), "changes": changes, **after}
