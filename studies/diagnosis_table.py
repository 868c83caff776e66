"""Tables of the study of the diagnosis."""

from collections.abc import Iterable, Iterator, Sequence

from rich import box
from rich.table import Table
from rich.text import Text

from studies.diagnosis import DiagnosisOutcome
from studies.diagnosis_claims import Claim, claims
from studies.diagnosis_rates import (
    EffectRates,
    Rate,
    both_added,
    both_found,
    by_effect,
    coverage_by_effect,
    followed,
    found,
    rate,
    unknown,
)

CAPTION = (
    "found: the hidden effect is first, or one of at most three that the program says it cannot "
    "tell apart and that are first; named: and the verdict names it. set: mean number of effects "
    "in that set. first instead: what led where it was not found. Each "
    "of two effects, and one outside of the catalogue, act with 3 σ."
)
_NAMES = 3  # effects that a row lists


def report(outcomes: Sequence[DiagnosisOutcome]) -> Iterator[Table | Text | str]:
    """Yield the tables of the cases, and their totals."""
    hidden = [o for o in outcomes if o.case.kind == "hidden"]
    effects = by_effect(hidden)
    for mode in dict.fromkeys(f.mode for f in effects):
        yield _title(f"effects hidden in {mode} readings: found")
        of_mode = [f for f in effects if f.mode == mode]
        yield _effects(of_mode)
        yield ""
        if any(f.instead for f in of_mode):
            yield _title("first instead")
            yield _first_instead(of_mode)
            yield ""
    if len({o.case.robot for o in hidden}) > 1:
        yield _title("found, by arm")
        yield _robots(hidden)
        yield ""
    covered = coverage_by_effect(hidden)
    if covered:
        yield _title("true parameters in 95 % intervals, by effect")
        yield _coverage(covered)
        yield ""
    pairs = [o for o in outcomes if o.case.kind == "pairs"]
    if pairs:
        yield _title("two hidden effects, by one of them")
        yield _pairs(pairs)
        yield ""
    outside = [o for o in outcomes if o.case.kind == "outside"]
    if outside:
        yield _title("effects outside of the catalogue")
        yield _outside(outside)
        yield ""
    yield _title("all of it")
    yield _claims(claims(outcomes))
    impossible = [o for o in outcomes if o.impossible]
    if impossible:
        yield ""
        yield f"{len(impossible)} campaigns cannot be; the first: {_case(impossible[0])}"
    failures = [o for o in outcomes if o.failure]
    if failures:
        yield ""
        yield f"{len(failures)} cases failed and count as misses; the first: {_case(failures[0])}"


def _case(o: DiagnosisOutcome) -> str:
    a = o.case
    hidden, reason = " + ".join(a.hidden) or "nothing", o.failure or o.impossible
    return f"{hidden}, {a.robot}, {a.mode}, {a.strength:g} σ, seed {a.seed}: {reason}"


def _title(text: str) -> Text:
    return Text(text, style="bold")


def _effects(rows: Sequence[EffectRates]) -> Table:
    strengths = sorted({f.strength for f in rows}, reverse=True)
    again = any(f.again.cases for f in rows)
    names = [name for s in strengths for name in (f"{s:g} σ", "named", "set")]
    out = _table("hidden", "n", *names, *(["next", "set"] if again else []))
    cell = {(f.effect, f.strength): f for f in rows}
    for effect in dict.fromkeys(f.effect for f in rows):
        of_effect = [cell[effect, s] for s in strengths if (effect, s) in cell]
        shown = {f.strength: (_share(f.found), _share(f.named), _size(f.size)) for f in of_effect}
        values = [value for s in strengths for value in shown.get(s, ("", "", ""))]
        if again:
            last = next((f for f in of_effect if f.again.cases), None)
            values += ["", ""] if last is None else [_share(last.again), _size(last.size_again)]
        out.add_row(effect, str(max(f.found.cases for f in of_effect)), *values)
    return out


def _first_instead(rows: Sequence[EffectRates]) -> Table:
    out = _table("hidden", "what led, and how often")
    out.columns[-1].justify = "left"
    for effect in dict.fromkeys(f.effect for f in rows):
        instead = _instead([f for f in rows if f.effect == effect])
        if instead:
            out.add_row(effect, instead)
    return out


def _instead(rows: Iterable[EffectRates]) -> str:
    count: dict[str, int] = {}
    for row in rows:
        for name, number in row.instead:
            count[name] = count.get(name, 0) + number
    order = sorted(count.items(), key=lambda item: (-item[1], item[0]))
    further = sum(number for _, number in order[_NAMES:])
    shown = [f"{name} {number}" for name, number in order[:_NAMES]]
    return ", ".join([*shown, *([f"others {further}"] if further else [])])


def _robots(cases: Sequence[DiagnosisOutcome]) -> Table:
    strengths = sorted({o.case.strength for o in cases}, reverse=True)
    out = _table("arm", "n", *(f"{s:g} σ" for s in strengths))
    for robot in dict.fromkeys(o.case.robot for o in cases):
        of_robot = [o for o in cases if o.case.robot == robot and not o.impossible]
        shares = [rate([o for o in of_robot if o.case.strength == s], found) for s in strengths]
        out.add_row(robot, str(len(of_robot)), *(_share(r) for r in shares))
    return out


def _coverage(rows: Iterable[tuple[str, Rate]]) -> Table:
    out = _table("effect", "parameters", "inside")
    for effect, inside in rows:
        out.add_row(effect, str(inside.cases), _share(inside))
    return out


def _pairs(cases: Sequence[DiagnosisOutcome]) -> Table:
    out = _table("one of them", "n", "both found", "both in the model")
    for effect in sorted({e for o in cases for e in o.case.hidden}):
        of_effect = [o for o in cases if effect in o.case.hidden and not o.impossible]
        shares = (_share(rate(of_effect, both_found)), _share(rate(of_effect, both_added)))
        out.add_row(effect, str(len(of_effect)), *shares)
    return out


def _outside(cases: Sequence[DiagnosisOutcome]) -> Table:
    out = _table("law", "readings", "n", "unknown_effect", "its variable", "first instead")
    out.columns[1].justify = out.columns[-1].justify = "left"
    for law, mode in dict.fromkeys((o.case.hidden[0], o.case.mode) for o in cases):
        of_law = [o for o in cases if (o.case.hidden[0], o.case.mode) == (law, mode)]
        count: dict[str, int] = {}
        for o in of_law:
            if o.first is not None and not followed(o):
                names = " and ".join(o.first.variables)
                count[names] = count.get(names, 0) + 1
        order = sorted(count.items(), key=lambda item: (-item[1], item[0]))
        instead = ", ".join(f"{names} {number}" for names, number in order[:_NAMES])
        shares = (_share(rate(of_law, unknown)), _share(rate(of_law, followed)))
        out.add_row(law, mode, str(len(of_law)), *shares, instead)
    return out


def _claims(rows: Iterable[Claim]) -> Table:
    out = _table("", "n", "share", "asked", "so")
    for c in rows:
        required = "" if c.least is None else f"≥ {100 * c.least:g} %"
        if c.least is not None and c.most < 1.0:
            required = f"{100 * c.least:g} to {100 * c.most:g} %"
        so = "" if c.met is None else ("yes" if c.met else "no")
        out.add_row(c.words, str(c.rate.cases), _share(c.rate, 1), required, so)
    return out


def _share(r: Rate, digits: int = 0) -> str:
    return f"{100 * r.share:.{digits}f} %" if r.cases else "-"


def _size(value: float) -> str:
    return "-" if value != value else f"{value:.1f}"


def _table(*columns: str) -> Table:
    out = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for k, name in enumerate(columns):
        # Names of effects are not wrapped; the texts of the last table do not fit on a line.
        no_wrap = k == 0 and bool(name)
        out.add_column(name, justify="right" if k else "left", overflow="fold", no_wrap=no_wrap)
    return out
