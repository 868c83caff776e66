"""Reports of `compare A B` (changes of an arm) and `fleet` (arms that differ from their type)."""

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hilcal import numbers
from hilcal.diagnosis.change import LEVEL, POWER, Candidate, Change, Limit
from hilcal.diagnosis.comparison import Comparison
from hilcal.identification.carried.posterior import Differences
from hilcal.identification.prediction.validation import POSITION_STD
from hilcal.names import quoted
from hilcal.present.document import Block, Table, Words, heading, note, table
from hilcal.present.fit import error_words, measurements

if TYPE_CHECKING:
    from hilcal.transfer.fleet import Fleet, PooledType, UnlikeParameter
    from hilcal.transfer.members import TypeSize

MOST_LISTED = 5  # gross errors
MOST_PARAMETERS, MOST_ROWS = 6, 12  # listed parameters of a change; of both fits
CLEAR = 2.0  # least σ of a listed parameter of a change that has several
FAR = 3.0  # standard deviations between which most arms lie; a choice
ARM_SOURCES = {
    "list": "arms.csv",
    "serial number": "the serial number that the arm reported",
    "folder": "the folder of the file, because there is no serial number",
    "file": "the name of the file, as nothing else is known: each file counts as another arm",
}
KINDS = {"trait": ", a trait of the type", "defect": ", of single arms: a defect", "some": ""}


def part_name(c: Candidate) -> str:
    """Return a name of the part that may have changed."""
    name = c.change.words or c.effect
    if c.joint:
        return f"joint {c.joint}'s {name}"
    return f"the {name} of {c.part}" if c.kind == "link" else name


def comparison_report(c: Comparison, earlier: str, later: str) -> Iterator[Block]:
    """Yield the report of a comparison; `earlier` and `later` are the names of the two files."""
    yield from (*_setup(c, earlier, later), "", *_today(c, earlier), "", *_changes(c))
    yield from (*_parameters(c.differences), "", f"Next: {next_step(c, earlier)}")


def _setup(c: Comparison, earlier: str, later: str) -> Iterator[str]:
    quantity = measurements(c.mode, c.today.prediction.readings)
    yield f"{len(c.today.prediction.raw)} {quantity} of {later}, measured later."
    if c.shared:
        model = "the baseline" if c.number is None else f"revision {c.number}"
        yield f"{c.shared} of its {c.readings} readings were fitted by {model}; they are left out."
    if gross := c.changes.gross:
        turns = ("" if g.off_rad is None else f" and {1e3 * g.off_rad:.3g} mrad" for g in gross)
        listed = [
            f"{g.pose}/{g.load} (off by {numbers.length(g.off_m)}{turn})"
            for g, turn in zip(gross, turns, strict=True)
        ]
        yield f"Set aside as gross errors: {numbers.few(listed, MOST_LISTED)}; measure them again."
    if c.later_mode not in (None, c.mode):
        kinds = {"deflection": "deflections", "absolute": "absolute readings"}
        was, used = kinds[str(c.later_mode)], kinds[c.mode]
        yield f"{later} was fitted to {was}, {earlier} to {used}: {used} are compared."
    if c.lacked:
        yield (
            f"The model of {earlier} lacks {numbers.names(c.lacked)} by its own readings; added "
            "for this comparison alone (hilcal refine EARLIER keeps it)."
        )
    reason = "as stated" if c.setup_stated else "both cells configure the same place"
    place = f"that of {earlier} ({reason})"
    if c.anew:
        unless = "" if c.setup_stated else " (--same-setup: tracker and base were not moved)"
        place = f"estimated from them, as if it had been moved{unless}"
    yield f"The tracker's place is {place}."
    if c.tool:
        yield tool_differs(c.tool, later)


def tool_differs(keys: Sequence[str], later: str) -> str:
    """Return in one sentence whose tool is predicted where two campaigns state different ones."""
    return f"[tool] {numbers.names(keys)} of {later} differ; those of {later} are used."


def _today(c: Comparison, earlier: str) -> Iterator[Block]:
    t, error = c.today, c.today.prediction.error
    drawing = "-" if t.drawing_m is None else numbers.length(t.drawing_m)
    sizes = map(numbers.length, (error.rms_m, error.mean_m, error.max_m, t.stated_m))
    heads = (error_words(t.prediction.readings), "rms", "mean", "largest", "expected", "as drawn")
    yield table(*heads, rows=[(f"calibration of {earlier}", *sizes, drawing)])
    yield (
        f"The error is {numbers.digits(t.z, 2)} times the stated one, correlations included "
        f"({numbers.p_equals(t.p_value)}): {'no ' * (t.p_value >= LEVEL)}more than its uncertainty."
    )
    # The expected error includes the distance of the poses from the measured ones (`POSITION_STD`).
    variables = (v for v in t.beyond.variables if v.variable != POSITION_STD)
    if ranges := numbers.few([f"{v.variable} ({v.count})" for v in variables], 3):
        yield f"Outside the range of {earlier}: {ranges}; an error there need not be a change."


def headline(c: Comparison) -> str:
    """Return in a clause whether something has changed."""
    changes = c.changes
    if not changes.found and changes.explained:
        return "Nothing has changed beyond the uncertainty"
    if c.another_arm:
        return "This looks like another arm of the same type"
    if parts := _parts(x.parts for x in changes.found):
        return f"Something has changed: {parts}"
    return "Something has changed, and no single candidate explains it"


def _parts(changes: Iterable[Sequence[str]]) -> str:
    """Return the parts of changes; "or" is between those of one change."""
    one = (numbers.names(list(dict.fromkeys(parts)), "or") for parts in changes)
    return numbers.names(list(dict.fromkeys(one)))


def _changes(c: Comparison) -> Iterator[Block]:
    changes = c.changes
    yield heading("What has changed" if changes.found and not c.another_arm else f"{headline(c)}.")
    if not changes.found and changes.explained:
        yield from _limits(c)
        return
    if c.another_arm:
        yield (
            "The calibration predicts these readings no better than the arm as drawn, and no few "
            "changes explain them."
        )
        return
    if not changes.found:
        yield _remainder(c)
        return
    for change in changes.found:
        yield sentence(change)
        if change.same_as:
            alternatives = numbers.names([part_name(o) for o in change.same_as], "or")
            yield f"  These readings do not distinguish it from {alternatives}."
    yield from ("", _table(changes.found))
    of_setup = [x.candidate for x in changes.found if not any(o.of_arm for o in x.possible)]
    if setup := dict.fromkeys(map(part_name, of_setup)):
        yield f"Not of the arm: {numbers.names(list(setup))}."
    yield _remainder(c)
    tests = numbers.many_tests(changes.tested, LEVEL, "candidates")
    yield tests.replace("diagnoses", "comparisons")


def sentence(change: Change) -> str:
    """Return a change in one sentence."""
    c, s = change.candidate, change.sizes[0]
    name, why = part_name(c), c.change.cause
    head = name[:1].upper() + name[1:]
    if len(change.sizes) > 1:
        return (
            f"{head} has changed: it moves the target by {numbers.length(change.moved_m)} rms "
            f"({numbers.p_equals(change.p_value)}). {why[:1].upper()}{why[1:]}".rstrip()
        )
    value, std, unit = numbers.measured(s.unit, s.value, s.std)
    share = ""
    if c.effect_directions.effect.elastic and s.before is not None and s.before[0] > 0:
        share = f", to {numbers.digits((s.before[0] + s.value) / s.before[0], 2)} times what it was"
    signed = value if value.startswith("-") else f"+{value}"
    statement = f"{head} has moved by {signed} ± {std} {unit}{share} ({abs(s.z):.0f} σ)"
    return f"{statement}: {why}" if why else f"{statement}."


def _table(changes: Sequence[Change]) -> Table:
    out = table("change", "by", "±", "unit", "σ", "p", "at target", left=(0, 3))
    for change in changes:
        common = (numbers.chance(change.p_value), numbers.length(change.moved_m))
        alone = len(change.sizes) == 1
        shown = [s for s in change.sizes if alone or abs(s.z) >= CLEAR]
        if not shown:
            out.add(change.candidate.name, *[""] * 4, *common)
        for k, s in enumerate(shown[:MOST_PARAMETERS]):
            measured = numbers.measured(s.unit, s.value, s.std, [s.value, s.std])
            name = change.candidate.name if alone else f"{change.candidate.effect}.{s.parameter}"
            out.add(name, *measured, f"{abs(s.z):.1f}", *(("", "") if k else common))
        if len(shown) > MOST_PARAMETERS:
            out.add(f"  … {len(shown) - MOST_PARAMETERS} more", *[""] * 6)
    return out


def _remainder(c: Comparison) -> str:
    changes, scatter = c.changes, numbers.digits(c.changes.scatter, 2)
    if changes.explained:
        return f"What is left after that is scatter as stated ({scatter} times)."
    outside = any(v.variable != POSITION_STD for v in c.today.beyond.variables)
    extrapolated = ", or the earlier model is wrong where it was not measured" * outside
    return (
        f"What is left is {scatter} times the stated scatter "
        f"({numbers.p_equals(changes.unexplained)}): more has changed than the candidates explain, "
        f"or these readings are noisier than stated{extrapolated}."
    )


def _limits(c: Comparison) -> Iterator[Block]:
    changes = c.changes
    by_joint: dict[str, dict[str, str]] = {}
    for limit in changes.limits:
        if limit.change.listed:
            by_joint.setdefault(limit.part, {})[limit.change.words] = _least(limit)
    shown = list(dict.fromkeys(name for row in by_joint.values() for name in row))
    rows = ((part, *(row.get(name, "-") for name in shown)) for part, row in by_joint.items())
    yield table("detectable change", *shown, rows=rows)
    yield (
        f"The smallest change that these readings would have shown in {POWER * 10:.0f} cases of "
        f"10; where nothing has changed, a change is claimed once in {1 / LEVEL:.0f}."
    )
    zeros = [x.part for x in changes.limits if x.change.by_frame and _least(x) == "-"]
    if c.mode == "deflection":
        yield "Deflections do not show joint zeros and geometry: these cancel in them."
    elif zeros:
        frames = "the place of the tracker, estimated again," if c.anew else "a frame"
        yield f"Not detectable: the zero of {numbers.names(zeros)}; {frames} absorbs it."


def _least(limit: Limit) -> str:
    return "-" if limit.size == float("inf") else numbers.sizes([(limit.unit, limit.size)])


def _parameters(d: Differences | None) -> Iterator[Block]:
    if d is None:
        return
    yield from ("", heading("The separate fits of both campaigns, as far as they can be compared"))
    comparable = sorted(((r.z, r) for r in d.rows if r.z is not None), key=lambda zr: -abs(zr[0]))
    if comparable:
        out = table("parameter", "before", "after", "by", "±", "unit", "σ", left=(0, 5))
        for z, r in comparable[:MOST_ROWS]:
            unit, factor = numbers.unit_for(r.unit, [r.before, r.after, r.difference])
            values = (factor * v for v in (r.difference, r.std or 0.0, r.before, r.after))
            difference, error, *sizes = numbers.with_std(*values)
            out.add(r.name, *sizes, difference, error, unit, f"{abs(z):.1f}")
        yield out
        if len(comparable) > MOST_ROWS:
            yield f"{len(comparable) - MOST_ROWS} more differ less."
    for e in d.effects:
        chance = numbers.p_equals(e.p_value)
        yield f"{e.effect}, as a whole: χ² {e.chi2:.0f} of {e.rank} ({chance})."
    if excluded := len(d.rows) - len(comparable):
        yield (
            f"{excluded} cannot be compared one by one: frames absorb them, or a campaign does not "
            "determine them."
        )
    if d.not_in_both:
        yield f"Not in both, or with other options: {numbers.names(d.not_in_both)}."


def next_step(c: Comparison, earlier: str) -> str:
    """Return the recommended next step as a clause."""
    changes = c.changes
    if c.another_arm:
        return "calibrate it separately."
    if not changes.found and changes.explained:
        sizes = [x.moved_m for x in changes.limits if x.change.listed and x.moved_m < np.inf]
        holds = f"nothing; the calibration of {earlier} holds"
        if not sizes:
            return f"{holds}."
        least = numbers.length(max(sizes))
        return (
            f"{holds}; a change of a joint that moves the target by less than {least} may not show."
        )
    arm = [x for x in changes.found if any(o.of_arm for o in x.possible)]
    if changes.explained and changes.found and not arm:
        return f"correct the setup, and compare again; the calibration of {earlier} holds."
    doubtful = [x for x in arm if not all(o.of_arm for o in x.possible)]
    parts = _parts(x.parts for x in arm if x not in doubtful)
    parts = parts or "the arm" * (not doubtful)
    setup = list(dict.fromkeys(part_name(o) for x in doubtful for o in x.possible if not o.of_arm))
    links = _parts([o.part for o in x.possible if o.of_arm] for x in doubtful)
    if doubtful and parts:
        parts = f"{parts}, and, only if {numbers.names(setup)} is as it was, {links}"
    check = f"check {numbers.names(setup)}; only if that is as it was, " if not parts else ""
    more = "more readings reduce the uncertainty"
    return f"{check}recalibrate {parts or links}, with {earlier} as prior; {more}."


def next_command(
    c: Comparison,
    earlier: str,
    later: str,
    effect_files: Sequence[str] = (),
    revision: int | None = None,
) -> str | None:
    """Return the command line for the next step; None without one.

    `revision`: that of the earlier campaign where it is not the one in use.

    `effect_files`: the options that give a command the files of the effects. Readings that were
    fitted already cannot be fitted with that fit as prior.
    """
    options = " ".join(["--readings", c.mode, *effect_files])
    refit = f"hilcal refine {quoted(later)}"
    if c.another_arm:
        return f"{refit} {options}"
    possible = (o for x in c.changes.found for o in x.possible)
    if c.shared or not (any(o.of_arm for o in possible) or not c.changes.explained):
        return None
    first = f"hilcal refine {quoted(earlier)} {options} && " * (c.number is None)
    chosen = "" if revision is None else f" --prior-revision {revision}"
    return f"{first}{refit} --prior {quoted(earlier)}{chosen} {options}"


def comparison_json(c: Comparison, earlier: str, command: str | None) -> dict[str, object]:
    """Return the comparison as JSON, SI, with its sentences and the next command."""
    changes = [{**x.to_dict(), "words": sentence(x)} for x in c.changes.found]
    step = {"next": next_step(c, earlier), "next_command": command}
    return {**c.to_dict(), "changes": changes, **step}


def fleet_report(fleet: "Fleet") -> Iterator[Block]:
    """Yield the report of a fleet."""
    for t in fleet.types:
        yield from type_report(t)
    yield from closing(fleet)


def closing(fleet: "Fleet") -> Iterator[Block]:
    """Yield how arms were identified, and the files that were not used."""
    sources = {m.arm_source for m in fleet.members}
    by = "; ".join(words for source, words in ARM_SOURCES.items() if source in sources)
    yield f"Arms are identified by {by}."
    if fleet.failures:
        yield from ("", heading(f"Not used: {len(fleet.failures)}"))
        yield from (f"  {f.name}: {f.reason}" for f in fleet.failures)


def type_report(t: "PooledType") -> Iterator[Block]:
    """Yield the pooled parameters, unusual arms and drifts of one type."""
    yield heading(f"{t.type}: {len(t.arms)} arms, {len(t.campaigns)} campaigns")
    repeated = any(p.within is not None for p in t.parameters)
    within_head = ["between campaigns"] * repeated
    heads = ("parameter", "mean", "±", "between arms", "±", *within_head, "unit")
    out = table(*heads, left=(0, len(heads) - 1))
    for p in t.parameters:
        unit, factor = numbers.unit_for(p.unit, [p.mean, p.between])
        mean = numbers.with_std(factor * p.mean, factor * p.mean_std)
        between = numbers.with_std(factor * p.between, factor * p.between_std)
        within = [numbers.digits(factor * (p.within or 0.0))] * repeated
        out.add(p.parameter, *mean, *between, *within, unit)
    yield out
    yield note(
        "±: standard uncertainty; between arms, and campaigns of an arm: standard deviations.\n"
    )
    if not repeated:
        yield "No arm was measured twice: what changes with time is part of the arms' spread.\n"
    yield "Unlike the others:" if t.unlike else "No arm is unlike the others in these parameters."
    yield from (f"  {unlike_words(o)}" for o in t.unlike)
    if t.wear:
        drifts = {p.parameter: p for p in t.parameters}
        yield "Common drift with time (wear):"
        for name in t.wear:
            p = drifts[name]
            value, std, unit = numbers.measured(p.unit, p.per_year or 0.0, p.per_year_std or 0.0)
            yield f"  {name}: {value} ± {std} {unit} a year"
    if t.effects_added:
        yield "Effects that the diagnoses added:"
        for s in t.effects_added:
            who = f": {', '.join(s.arms)}" if s.kind == "defect" else ""
            yield f"  {s.effect}: on {len(s.arms)} of {s.of} arms{KINDS[s.kind]}{who}"
    yield from (*size_lines(t.sizes), "")


def size_lines(sizes: Sequence["TypeSize"]) -> Iterator[str | Words]:
    """Yield the [ordinary] section of CELL.toml for effects of unusual size on this type."""
    if differing := [s for s in sizes if s.differs]:
        yield "Effects whose size differs from that on other arms, for another arm of this type:"
        section = ["[ordinary]"]
        for s in differing:
            factor, low, high = map(numbers.digits, (s.factor, s.low, s.high))
            section.append(f"{s.effect} = {factor} # 95 %: {low} to {high}")
        yield Words("\n".join(section), "code", indent=2)


def unlike_words(o: "UnlikeParameter") -> str:
    """Return the parameter of an unusual arm and its deviation."""
    unit, factor = numbers.unit_for(o.unit, [o.off])
    off = f"{'+' if o.off > 0 else '−'}{numbers.digits(factor * abs(o.off))} {unit}"
    who = f"{o.arm} has changed by {o.campaign}" if o.campaign else o.arm
    return f"{who}: {o.parameter} {off} ({o.sigma:.1f} σ)"
