"""Many arms: what is known of a type, which arms are unlike it, what wears."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from hilcal import numbers
from hilcal.present.document import Block, heading, note, table

if TYPE_CHECKING:
    from hilcal.transfer.fleet import Fleet
    from hilcal.transfer.members import TypeSize
    from hilcal.transfer.pooled import DiagnosedEffect, Odd, Pooled

FAR = 3.0
"""Standard deviations between which most arms lie; a choice."""
KNOWN = {
    "list": "arms.csv",
    "serial number": "the serial number that the arm told",
    "folder": "the folder of the file, for want of a serial number",
    "file": "the file's name, for want of anything better: each counts as an arm of its own",
}
KINDS = {"trait": "a trait of the type", "defect": "of single arms: a defect", "some": ""}


def fleet_report(fleet: "Fleet") -> Iterator[Block]:
    """Yield all that people want to know of a fleet."""
    for t in fleet.types:
        yield from type_report(t)
    yield from closing(fleet)


def closing(fleet: "Fleet") -> Iterator[Block]:
    """Yield how arms are known, and what was not used."""
    known = {m.known for m in fleet.members}
    yield f"Which arm a campaign is of: by {'; '.join(KNOWN[k] for k in KNOWN if k in known)}."
    if fleet.failures:
        yield ""
        yield heading(f"Not used: {len(fleet.failures)}")
        for f in fleet.failures:
            yield f"  {f.name}: {f.reason}"


def type_report(t: "Pooled") -> Iterator[Block]:
    """Yield what is known of one type."""
    yield heading(f"{t.type}: {len(t.arms)} arms, {len(t.campaigns)} campaigns")
    repeated = any(p.within is not None for p in t.parameters)
    heads = (
        "parameter",
        "mean",
        "±",
        "between arms",
        "±",
        *["between campaigns"] * repeated,
        "unit",
    )
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
    yield from type_lines(t)
    yield ""


def type_lines(t: "Pooled") -> Iterator[str]:
    """Yield what is said below the table of a type."""
    if all(p.within is None for p in t.parameters):
        yield "No arm was measured twice: what changes with time is part of the arms' spread.\n"
    if t.odd:
        yield "Unlike the others:"
        yield from (f"  {unlike_words(o)}" for o in t.odd)
    else:
        yield "No arm is unlike the others."
    if t.wear:
        drifts = {p.parameter: p for p in t.parameters}
        yield "Common drift with time (wear):"
        for name in t.wear:
            p = drifts[name]
            value, std, unit = numbers.measured(p.unit, p.per_year or 0.0, p.per_year_std or 0.0)
            yield f"  {name}: {value} ± {std} {unit} a year"
    if t.seen:
        yield "Effects that the diagnoses added:"
        yield from (f"  {_seen(s)}" for s in t.seen)
    yield from size_lines(t.sizes)


def size_lines(sizes: Sequence["TypeSize"]) -> Iterator[str]:
    """Yield the section of a cell for effects whose size differs from that on other arms."""
    if other := [s for s in sizes if s.differs]:
        yield "Effects whose size differs from that on other arms, for another arm of this type:"
        yield "  [ordinary]"
        yield from (f"  {_size(s)}" for s in other)


def unlike_words(o: "Odd") -> str:
    """Say what is unlike, and by how much."""
    unit, factor = numbers.unit_for(o.unit, [o.off])
    off = f"{'+' if o.off > 0 else '−'}{numbers.digits(factor * abs(o.off))} {unit}"
    if o.campaign:
        return f"{o.arm} has changed by {o.campaign}: {o.parameter} {off} ({o.sigma:.1f} σ)"
    return f"{o.arm}: {o.parameter} {off} ({o.sigma:.1f} σ)"


def _size(s: "TypeSize") -> str:
    low, high = numbers.digits(s.low), numbers.digits(s.high)
    return f"{s.effect} = {numbers.digits(s.factor)} # 95 %: {low} to {high}"


def _seen(s: "DiagnosedEffect") -> str:
    kind = f", {KINDS[s.kind]}" if KINDS[s.kind] else ""
    who = f": {', '.join(s.arms)}" if s.kind == "defect" else ""
    return f"{s.effect}: on {len(s.arms)} of {s.of} arms{kind}{who}"
