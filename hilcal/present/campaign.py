"""What a campaign holds, and two of its revisions side by side."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from hilcal import numbers
from hilcal.config.changes import Changes, write_value
from hilcal.identification.fit import Fit
from hilcal.measuring.session_state import RepeatabilityEstimate
from hilcal.present.document import Block, Table, heading, note, pairs, table
from hilcal.present.fit import error_words, model_name
from hilcal.present.registration import observed_words
from hilcal.store.overview import Overview
from hilcal.store.revision import RevisionRecord, change

SHOWN = ("start", "load", "doubted", "goal", "interrupted", "failed", "finished")
"""Kinds of events that are listed; drift is where it is over its limit."""
MOST_EVENTS = 30


def info_report(o: Overview, name: str, covariance: str) -> Iterator[Block]:
    """Yield what the campaign of a file name holds; `covariance` says what its covariances are."""
    count = 0 if o.readings is None else len(o.readings)
    yield heading(f"{name}: {count} readings of {o.poses} poses, {o.config.robot.model}")
    yield pairs(_head(o, covariance))
    yield ""
    if o.planned is not None:
        yield heading("Instruments")
        yield pairs([(i.device, _instrument(i.name, i.serial_number)) for i in o.instruments])
        yield ""
        yield heading("Checks on the way")
        yield pairs([*_checks(o)])
        yield ""
        yield heading("Events (UTC)")
        yield from _events(o)
        yield ""
    yield heading("Revisions")
    if not o.revisions:
        yield "None yet: hilcal identify or refine makes one."
        return
    yield from revisions_tables(o)
    what = "error" if o.readings is None else error_words(o.readings)
    yield note(
        f"fit, left out: rms of the {what}, of the fitted poses and of poses left out, "
        "there in σ of the noise as well; v.f.: variance factor."
    )
    used = "→ used by every command: the latest one; hilcal accept RUN N chooses another."
    if o.accepted is not None:
        used = f"→ revision {o.accepted} is accepted: every command uses it."
    yield used


def _head(o: Overview, covariance: str) -> Iterator[tuple[str, str]]:
    by = f" by hilcal {o.program_version}" if o.program_version else ""
    yield "made", f"{_time(o.created)} UTC{by}; {o.source}"
    if o.planned is not None:
        sessions = sum(e["kind"] == "start" for e in o.events)
        words = f"{sessions} session{'s' * (sessions != 1)}"
        words += f", {o.plans} plans" if o.plans > 1 else ""
        time = None if o.readings is None else o.readings.states.time
        if time is not None:
            words += f", {np.ptp(time) / 60:.0f} min from first to last reading"
        yield "measured", f"{o.measured} of {o.planned} planned steps in {words}"
    if o.readings is None:
        yield "readings", "none yet"
        return
    yield "loads", ", ".join(f"{name} {n}" for name, n in o.loads.items())
    if o.targets:
        yield "targets", ", ".join(f"{name} {n}" for name, n in o.targets.items())
    kind = "positions" if o.readings.m == 3 else "positions and orientations"
    if o.readings.observers:
        kind = observed_words(o.readings)
    yield "readings", f"{kind}; {covariance}"


def _instrument(name: str, serial: str | None) -> str:
    return name if serial is None or serial in name else f"{name}, serial number {serial}"


def _checks(o: Overview) -> Iterator[tuple[str, str]]:
    if o.tares:
        change = np.array([t.wrench for t in o.tares]) - o.tares[0].wrench
        sizes = (np.linalg.norm(m, axis=1).max() for m in np.split(change, 2, axis=1))
        force, moment = (numbers.digits(size, 2) for size in sizes)
        yield "tares", f"{len(o.tares)}; the zero moved by up to {force} N and {moment} N·m"
    else:
        yield "tares", "none: no force sensor, or nothing measured yet"
    yield "drift", _drift(o)
    if o.tool is not None:
        com = ", ".join(f"{1e3 * x + 0.0:z.1f}" for x in o.tool["com_m"])
        yield "tool", f"{o.tool['mass_kg']:.3f} kg, its centre at {com} mm in flange axes"
    if o.repeatability is not None:
        r = RepeatabilityEstimate(**o.repeatability)
        scatter, alone = numbers.length(r.scatter), numbers.length(r.instrument)
        joints = "the joints do not show beside it"
        if r.shown:
            joints = f"joints {numbers.digits(1e6 * r.joint_std, 2)} µrad"
        returns = f"{r.dof} returns to {r.poses} poses scatter by {scatter}"
        yield "repeatability", f"{returns}, the instrument alone by {alone}; {joints}"


def _drift(o: Overview) -> str:
    if not o.returns:
        return "no return to the reference pose"
    sizes = [float(np.linalg.norm(r.shift_m)) for r in o.returns]
    k, over = int(np.argmax(sizes)), sum(r.over for r in o.returns)
    limit = f"{o.config.acquire.drift_limit_sigma:g} σ"
    several = f"{len(o.returns)} return{'s' * (len(o.returns) > 1)} to the reference pose"
    return (
        f"{several}: at most {numbers.length(sizes[k])} ({o.returns[k].sigma:.1f} σ), "
        f"{numbers.length(sizes[-1])} at the last; {over or 'none'} over the limit of {limit}"
    )


def _events(o: Overview) -> Iterator[Block]:
    told = [e for e in o.events if e["kind"] in SHOWN or (e["kind"] == "drift" and e["over"])]
    if not told:
        yield "None yet."
        return
    if len(told) > MOST_EVENTS:
        yield f"{len(told) - MOST_EVENTS} earlier ones, see --json"
    yield pairs([(_time(e["utc"]), event_words(e)) for e in told[-MOST_EVENTS:]])


def event_words(e: Mapping[str, Any]) -> str:
    """Return an event in words."""
    kind = str(e["kind"])
    if kind == "start":
        return f"began, {e['missing']} readings missing"
    if kind == "load":
        if e["hanging"] is None:
            return str(e.get("why", "")) or "another load hangs than should"
        return "nothing hangs" if e["hanging"] == "none" else f"load {e['hanging']}"
    if kind == "doubted":
        r = e["reading"]
        of = f", {r['target']}" if r.get("target") else ""
        how = "stored, doubted later" if e.get("stored") else "kept as doubted"
        return f"reading of {r['pose']}, {r['load']}{of} {how}: {e['why']}"
    if kind == "finished":
        return f"finished, {e['readings']} readings"
    if kind == "goal":
        return f'goal "{e.get("goal", e.get("text", ""))}" {"met" if e.get("met") else "not met"}'
    if kind == "drift":
        return f"the reference pose has moved by {e['sigma']:.1f} σ, over the limit"
    reason = str(e.get("reason", ""))
    return kind if reason in ("", kind) else f"{kind}: {reason}"


def revisions_tables(o: Overview) -> Iterator[Block]:
    """Yield the revisions of each kind of readings, whose errors do not compare, as a table."""
    kinds = dict.fromkeys(str(r.options["readings"]) for r in o.revisions)
    for kind in kinds:
        if len(kinds) > 1:
            yield f"Of {'deflections' if kind == 'deflection' else 'absolute readings'}:"
        yield _revisions_table(o, [r for r in o.revisions if r.options["readings"] == kind])


def _revisions_table(o: Overview, revisions: Sequence[RevisionRecord]) -> Table:
    """Return a table of revisions; an arrow marks the one in use."""
    branched = any(r.made_from not in (None, r.number - 1) for r in o.revisions)
    heads = ("fit", "left out", "σ", "v.f.", "verdict")
    first = ("rev.", "from", "model") if branched else ("rev.", "model")
    out = table(*first, *heads, left=(len(first) - 1, len(first) + 4))
    for r in revisions:
        fit = r.result_json["identify"]
        left_out = fit["error"]["holdout"]
        verdict = r.result_json.get("diagnose", {}).get("verdict", "")
        out.add(
            f"→ {r.number}" if r.number == o.in_use else str(r.number),
            *(("" if r.made_from is None else str(r.made_from),) if branched else ()),
            model_words(r),
            numbers.length(float(fit["error"]["fit"]["rms_m"])),
            numbers.length(float(left_out["rms_m"])),
            f"{float(left_out['rms_sigma']):.2f}",
            numbers.digits(float(fit["variance_factor"])),
            str(verdict).replace("_", " "),
        )
    return out


def model_words(r: RevisionRecord) -> str:
    """Return what a revision changed, or its whole model where it is a first one; and its cell."""
    scatter = r.parameters_json.get("arm_scatter") is not None and not r.cell
    found = change(r.added, r.removed, scatter) or model_name(r.effects)
    return f"{found}; {cell_words(r.cell)}" if r.cell else found


def _time(utc: str) -> str:
    """Return a time without what every time here has: T, seconds' zone."""
    return utc[:19].replace("T", " ")


NONE = "–"


def two_revisions(a: RevisionRecord, b: RevisionRecord) -> Table:
    """Return model, cell, verdict, errors and parameters of two revisions, as they were stored.

    The difference, second minus first, is empty where they agree.
    """
    heads = ("", f"revision {a.number}", f"revision {b.number}", "difference")
    out = table(*heads, left=(0, 1, 2, 3))

    def add(what: str, first: str, second: str, difference: str = "differs") -> None:
        out.add(what, first, second, difference if first != second else "")

    names = [f"+ {name}" for name in b.effects if name not in a.effects]
    names += [f"− {name}" for name in a.effects if name not in b.effects]
    add("model", model_name(a.effects), model_name(b.effects), " ".join(names) or "differs")
    if a.cell or b.cell:
        add("cell", *(cell_words(r.cell) or "as told at first" for r in (a, b)))
    add("verdict", verdict_of(a), verdict_of(b))
    fits = [r.result_json["identify"] for r in (a, b)]
    for what, of in (("error on poses left out", "holdout"), ("error on fitted poses", "fit")):
        before, after = (float(f["error"][of]["rms_m"]) for f in fits)
        share = f" ({100 * (after - before) / before:+.0f} %)" if before else ""
        by = f"{'+' * (after > before)}{numbers.length(after - before)}{share}".replace("-", "−")
        add(what, numbers.length(before), numbers.length(after), by)
    add("variance factor", *(numbers.digits(float(f["variance_factor"])) for f in fits))
    add("readings", *(str(f["n_readings"]) for f in fits))
    for row in _parameters(*fits):
        add(*row)
    return out


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


def _parameters(a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[tuple[str, str, str, str]]:
    known: list[dict[str, Mapping[str, Any]]] = [
        {p["name"]: p for p in f["parameters"]} for f in (a, b)
    ]
    for name in dict.fromkeys([*known[0], *known[1]]):
        found = [of.get(name) for of in known]
        values = [0.0 if p is None or p["value"] is None else float(p["value"]) for p in found]
        given = next(p for p in found if p is not None)
        unit, factor = numbers.unit_for(str(given["unit"]), values)
        first, second = (_value(p, factor) for p in found)
        if {first, second} <= {NONE, UNSEEN}:
            continue
        by = factor * (values[1] - values[0])
        difference = ("+" * (by > 0) + numbers.digits(by, 2)).replace("-", "−")
        if {first, second} & {NONE, UNSEEN}:
            difference = ""
        yield f"{name} [{unit}]" if unit else name, first, second, difference


UNSEEN = "not determined"


def _value(p: Mapping[str, Any] | None, factor: float) -> str:
    if p is None:
        return NONE
    if p["value"] is None or not p["identifiable"]:
        return UNSEEN
    std = float("nan") if p["std"] is None else factor * float(p["std"])
    value, error = numbers.with_std(factor * float(p["value"]), std)
    return f"{value} ± {error}" if error else value
