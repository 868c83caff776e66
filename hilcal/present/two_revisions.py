"""Two revisions of a campaign side by side, in words."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from hilcal import numbers
from hilcal.config.changes import Changes, write_value
from hilcal.identification.fit import Fit
from hilcal.present import text
from hilcal.store.revision import RevisionRecord

NONE = "–"


@dataclass(frozen=True, slots=True)
class Row:
    """What two revisions say of one thing.

    Attributes:
        what: it is about, with its unit.
        first: what the one says.
        second: what the other says.
        difference: second minus first; empty where they agree.
    """

    what: str
    first: str
    second: str
    difference: str


def two_revisions(a: RevisionRecord, b: RevisionRecord) -> tuple[Row, ...]:
    """Return model, cell, verdict, errors and parameters of two revisions, as they were stored."""
    added = [f"+ {name}" for name in b.effects if name not in a.effects]
    removed = [f"− {name}" for name in a.effects if name not in b.effects]
    rows = [_row("model", text.model_name(a.effects), text.model_name(b.effects))]
    if added or removed:
        rows = [Row("model", rows[0].first, rows[0].second, " ".join([*added, *removed]))]
    if a.cell or b.cell:
        cells = [cell_words(r.cell) or "as told at first" for r in (a, b)]
        rows.append(_row("cell", *cells))
    rows.append(_row("verdict", verdict_of(a), verdict_of(b)))
    for what, of in (("error on poses left out", "holdout"), ("error on fitted poses", "fit")):
        errors = [float(r.result_json["identify"]["error"][of]["rms_m"]) for r in (a, b)]
        by = errors[1] - errors[0]
        share = f" ({100 * by / errors[0]:+.0f} %)" if errors[0] else ""
        sign = "+" if by > 0 else ""
        first, second = (numbers.length(x) for x in errors)
        differs = f"{sign}{numbers.length(by)}{share}".replace("-", "−")
        rows.append(Row(what, first, second, differs if first != second else ""))
    factors = [float(r.result_json["identify"]["variance_factor"]) for r in (a, b)]
    rows.append(_row("variance factor", *(numbers.digits(x) for x in factors)))
    count = [str(r.result_json["identify"]["n_readings"]) for r in (a, b)]
    rows.append(_row("readings", *count))
    return (*rows, *_parameters(a, b))


def verdict_of(record: RevisionRecord) -> str:
    """Return the verdict as words; a line for none."""
    found = record.result_json.get("diagnose", {}).get("verdict")
    return NONE if found is None else str(found).replace("_", " ")


def left_out_m(record: RevisionRecord) -> float:
    """Return the rms 3-D position error on poses left out, m."""
    return float(record.result_json["identify"]["error"]["holdout"]["rms_m"])


def cell_words(changes: Changes) -> str:
    """Return changes of a cell in a line, as CELL.toml would have them."""
    return "; ".join(
        f"[{section}] " + ", ".join(f"{key} = {write_value(value)}" for key, value in keys.items())
        for section, keys in changes.items()
    )


def refitted(before: Fit, after: Fit) -> str:
    """Return what a fit in a changed cell did to error and variance factor."""
    errors = (numbers.length(f.holdout.rms_m) for f in (before, after))
    factors = (f"{f.variance_factor:.2f}" for f in (before, after))
    return (
        f"The error on poses left out goes {' → '.join(errors)}, the variance factor "
        f"{' → '.join(factors)}."
    )


def _row(what: str, first: str, second: str) -> Row:
    return Row(what, first, second, "differs" if first != second else "")


def _parameters(a: RevisionRecord, b: RevisionRecord) -> Iterator[Row]:
    known: list[dict[str, Mapping[str, Any]]] = [
        {p["name"]: p for p in r.result_json["identify"]["parameters"]} for r in (a, b)
    ]
    for name in dict.fromkeys([*known[0], *known[1]]):
        found = [of.get(name) for of in known]
        values = [0.0 if p is None or p["value"] is None else float(p["value"]) for p in found]
        given = next(p for p in found if p is not None)
        unit, factor = numbers.unit_for(str(given["unit"]), values)
        first, second = (_value(p, factor) for p in found)
        if {first, second} <= {NONE, UNSEEN}:
            continue
        difference = ""
        if first != second and not {first, second} & {NONE, UNSEEN}:
            by = factor * (values[1] - values[0])
            difference = ("+" * (by > 0) + numbers.digits(by, 2)).replace("-", "−")
        yield Row(f"{name} [{unit}]" if unit else name, first, second, difference)


UNSEEN = "not determined"


def _value(p: Mapping[str, Any] | None, factor: float) -> str:
    if p is None:
        return NONE
    if p["value"] is None or not p["identifiable"]:
        return UNSEEN
    std = float("nan") if p["std"] is None else factor * float(p["std"])
    value, error = numbers.with_std(factor * float(p["value"]), std)
    return f"{value} ± {error}" if error else value
