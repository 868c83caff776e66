"""Reports on the preparation of a campaign, on its contents, and on two of its revisions."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from hilcal import numbers
from hilcal.config.cell import CellConfig, Changes, write_value
from hilcal.config.reference import REQUIRED, KeyTable
from hilcal.doctor import Finding
from hilcal.identification.fit import Fit
from hilcal.measuring.session_state import RepeatabilityEstimate
from hilcal.present.document import (
    Block,
    Table,
    Words,
    heading,
    load_name,
    note,
    pairs,
    table,
)
from hilcal.present.fit import error_words, model_name
from hilcal.present.progress import duration_text
from hilcal.present.registration import observed_words
from hilcal.store.overview import Overview
from hilcal.store.revision import RevisionRecord, change
from hilcal.tables.proposal import Proposal

if TYPE_CHECKING:
    from hilcal.measuring.connect import ConnectionResult
    from hilcal.measuring.route import DryRun
    from hilcal.transfer.compare import FactoryCheck

MARKS = {"ok": "✓", "warning": "!", "problem": "✗"}
MOST_CHARACTERS, MOST_COLUMNS = 34, 12  # of a table cell; unused ones that are listed
LISTED_EVENTS = ("start", "load", "moved", "doubted", "goal", "interrupted", "failed", "finished")
"""Kinds of events that are always listed; drift is listed only above its limit."""
MOST_EVENTS = 30
NO_VALUE, UNDETERMINED = "–", "not determined"


def sections_overview(tables: Sequence[KeyTable]) -> Iterator[Block]:
    """Yield the list of sections."""
    yield heading("Sections of CELL.toml")
    yield from (pairs((t.header, t.about) for t in tables), "")
    yield "hilcal config SECTION explains the keys of one; hilcal init writes a file."


def section_report(t: KeyTable) -> Iterator[Block]:
    """Yield all keys of a section."""
    yield from (heading(t.header), t.about)
    for key in t.keys:
        unit = f"unit: {key.unit}; " if key.unit else ""
        default = REQUIRED if key.default == REQUIRED else f"default: {key.default}"
        yield from ("", Words(key.name, "strong", indent=2))
        for line in (key.valid, unit + default, f"example: {key.example}"):
            yield Words(line, indent=6)


def doctor_report(findings: Sequence[Finding]) -> Iterator[Block]:
    """Yield all findings by topic, with their remedies."""
    for topic, of_topic in itertools.groupby(findings, lambda f: f.topic):
        rows = pairs(())
        for f in of_topic:
            rows.add(MARKS[f.state], f"{f.name}: {f.said}")
            if f.mend:
                rows.add("", f"→ {f.mend}")
        yield from ("", Words(topic, "strong", indent=2), rows)
    yield from ("", doctor_summary(findings))


def doctor_summary(findings: Sequence[Finding]) -> str:
    """Return the outcome in a line."""
    problems = [f.name for f in findings if f.state == "problem"]
    warnings = sum(f.state == "warning" for f in findings)
    more = f"; {warnings} warning{'s' * (warnings != 1)}, marked !" if warnings else ""
    if problems:
        return f"{len(problems)} of {len(findings)} checks failed: {', '.join(problems)}{more}"
    return f"No check failed{more}."


def import_preview(proposal: Proposal, rows: int, source: str) -> Iterator[Block]:
    """Yield the parts of a table that were understood, missing, unsure and not used."""
    yield heading(f"{source}: {rows} rows")
    if file := proposal.sections.get("file", {}):
        yield "  " + ", ".join(f"{key} = {value!r}" for key, value in file.items())
    understood = [
        (u.section, _short(u.columns), u.meaning, _short(u.example)) for u in proposal.quantities
    ]
    if understood:
        yield table("what", "columns", "meaning", "first row", rows=understood, left=(0, 1, 2, 3))
    unused = [f"{name} ({why})" for name, why in proposal.unused]
    if len(unused) > MOST_COLUMNS:
        unused = [*unused[:MOST_COLUMNS], f"and {len(unused) - MOST_COLUMNS} more"]
    for title, sentences in (
        ("missing:", proposal.missing),
        ("unsure:", [f"{column}: {doubt}" for column, doubt in proposal.doubts]),
        ("not used:", [", ".join(unused)] if unused else []),
    ):
        if sentences:
            yield heading(title)
        yield from (Words(sentence, indent=2) for sentence in sentences)


def _short(cells: Sequence[str]) -> str:
    """Join names or values, of many the first two and the last, cut to a width."""
    line = ", ".join(cells) if len(cells) <= 3 else f"{cells[0]}, {cells[1]} … {cells[-1]}"
    return line if len(line) <= MOST_CHARACTERS else line[: MOST_CHARACTERS - 1] + "…"


def check_report(answers: "tuple[ConnectionResult, ...]", dry: "DryRun | None") -> Iterator[Block]:
    """Yield the answer and state of each device, every problem, and the result of a dry run."""
    out = table("device", "driver", "", "who answers, and what it says", left=(0, 1, 2, 3))
    for a in answers:
        name, facts = ("no answer", ()) if a.report is None else (a.report.name, a.report.facts)
        out.add(a.device, a.driver, "✗" if a.problems else "✓", name)
        for fact, value in facts:
            out.add("", "", "", f"{fact}: {value}")
        for problem in a.problems:
            out.add("", "", "!", problem)
    if answers:
        yield from ("", out, "")
    count, result = sum(len(a.problems) for a in answers), "All devices are ready"
    if not answers:
        result = "The cell does not name all its devices: none was asked"
    elif count:
        result = f"{count} problem{'s' * (count > 1)}"
    yield f"{result}. Nothing was moved."
    if dry is None:
        return
    if dry.problems:
        yield f"The plan cannot be run ({len(dry.problems)}):"
        yield from (f"  {problem}" for problem in dry.problems)
    else:
        yield (
            f"The plan keeps every limit: {dry.motions} motions, {dry.load_changes} load changes, "
            f"about {duration_text(dry.duration)}."
        )
    yield from (f"note: {remark}" for remark in dry.remarks)


def factory_words(check: "FactoryCheck") -> Iterator[Block]:
    """Yield whether the geometry of an arm differs from its factory calibration."""
    lengths = (check.moved_m, check.moved_std_m, check.factory_m, check.nominal_m, check.noise_m)
    moved, std, factory, nominal, noise = map(numbers.length, lengths)
    conclusion = (
        "These readings show no difference from the factory calibration "
        f"(p = {check.p_value:.2g}): the difference in geometry"
    )
    if check.changed:
        conclusion = (
            "The geometry of the arm has changed since the factory calibration "
            f"(p = {check.p_value:.1g}), which"
        )
    yield from ("", f"{conclusion} moves the target by {moved} (rms, ± {std}).")
    yield (
        f"The rms error of {check.readings} readings, the arm's weight included, is {factory} with "
        f"the factory's kinematics and {nominal} with the maker's nominal ones; noise: {noise}."
    )


def robot_name(config: CellConfig) -> str:
    """Return the name of the arm; of one that a file describes, the name of the file."""
    return PurePath(config.robot.model).name


def info_report(o: Overview, name: str, covariance: str) -> Iterator[Block]:
    """Yield the contents of a campaign; `covariance` describes the covariances of its readings."""
    count = 0 if o.readings is None else len(o.readings)
    yield heading(f"{name}: {count} readings of {o.poses} poses, {robot_name(o.config)}")
    yield from (pairs(_head(o, covariance)), "")
    if o.planned is not None:
        instruments = pairs(())
        for i in o.instruments:
            number = i.serial_number
            complete = number is None or number in i.name
            instruments.add(i.device, i.name if complete else f"{i.name}, serial number {number}")
        yield from (heading("Instruments"), instruments, "")
        yield from (heading("Checks during the run"), pairs(_checks(o)), "")
        yield from (heading("Events (UTC)"), *_events(o), "")
    yield heading("Revisions")
    if not o.revisions:
        yield "None yet: hilcal identify and refine make one."
        return
    yield from _revisions_tables(o)
    error_name = "error" if o.readings is None else error_words(o.readings)
    yield note(
        f"fit, left out: rms {error_name} at fitted poses and at poses left out; σ: the latter in "
        "units of the noise; v.f.: variance factor."
    )
    yield (
        "→ used by every command (the latest one); hilcal accept RUN N chooses another one."
        if o.accepted is None
        else f"→ revision {o.accepted} is accepted: every command uses it."
    )


def _head(o: Overview, covariance: str) -> Iterator[tuple[str, str]]:
    program = f" by hilcal {o.program_version}" if o.program_version else ""
    yield "made", f"{utc(o.created)} UTC{program}; {o.source}"
    if o.planned is not None:
        sessions = sum(e["kind"] == "start" for e in o.events)
        extent = f"{sessions} session{'s' * (sessions != 1)}"
        extent += f", {o.plans} plans" if o.plans > 1 else ""
        time = None if o.readings is None else o.readings.states.time
        if time is not None:
            extent += f", {duration_text(float(np.ptp(time)))} from first to last reading"
        yield "measured", f"{o.measured} of {o.planned} planned steps in {extent}"
    if o.readings is None:
        yield "readings", "none yet"
        return
    yield "loads", ", ".join(f"{load_name(name)} ({n})" for name, n in o.loads.items())
    if o.targets:
        yield "targets", ", ".join(f"{name} ({n})" for name, n in o.targets.items())
    kind = "positions" if o.readings.m == 3 else "positions and orientations"
    kind = observed_words(o.readings) if o.readings.observers else kind
    yield "readings", f"{kind}; {covariance}"


def _checks(o: Overview) -> Iterator[tuple[str, str]]:
    if tares := [np.array(e["force"]["wrench"]) for e in o.of_kind("tare")]:
        moved = np.array(tares) - tares[0]
        largest = (np.linalg.norm(m, axis=1).max() for m in np.split(moved, 2, axis=1))
        force, moment = (numbers.digits(size, 2) for size in largest)
        yield "tares", f"{len(tares)}; the zero moved by up to {force} N and {moment} N·m"
    else:
        yield "tares", "none: no force sensor, or nothing measured yet"
    drift = "no return to the reference pose"
    if drifts := o.of_kind("drift"):
        count, sizes = len(drifts), [float(np.linalg.norm(r["shift_m"])) for r in drifts]
        k, over = int(np.argmax(sizes)), sum(r["over"] for r in drifts)
        drift = (
            f"{count} return{'s' * (count > 1)} to the reference pose: at most "
            f"{numbers.length(sizes[k])} ({drifts[k]['sigma']:.1f} σ), "
            f"{numbers.length(sizes[-1])} at the last; {over or 'none'} over the limit of "
            f"{o.config.acquire.drift_limit_sigma:g} σ"
        )
    yield "drift", drift
    if o.tool is not None:
        com = ", ".join(f"{1e3 * x + 0.0:z.1f}" for x in o.tool["com_m"])
        yield "tool", f"{o.tool['mass_kg']:.3f} kg, its centre at {com} mm in flange axes"
    if o.repeatability is not None:
        r = RepeatabilityEstimate(**o.repeatability)
        joints = "that of the joints is too small to be estimated"
        if r.significant:
            joints = f"joints {numbers.digits(1e6 * r.joint_std, 2)} µrad"
        scatter, alone = numbers.length(r.scatter), numbers.length(r.instrument)
        returns = f"{r.returns_text} scatter{'s' * (r.dof == 1)} by {scatter}"
        yield "repeatability", f"{returns}, the instrument alone by {alone}; {joints}"


def _events(o: Overview) -> Iterator[Block]:
    shown = [
        e for e in o.events if e["kind"] in LISTED_EVENTS or (e["kind"] == "drift" and e["over"])
    ]
    if not shown:
        yield "None yet."
        return
    if len(shown) > MOST_EVENTS:
        yield f"{len(shown) - MOST_EVENTS} earlier ones, see --json"
    yield pairs([(utc(e["utc"]), event_words(e)) for e in shown[-MOST_EVENTS:]])


def event_words(e: Mapping[str, Any]) -> str:
    """Return the description of an event."""
    kind = str(e["kind"])
    if kind == "start":
        return f"began, {e['missing']} readings missing"
    if kind == "load":
        if e["hanging"] is None:
            return str(e.get("why", "")) or "a load hangs that should not"
        return "nothing hangs" if e["hanging"] == "none" else f"load {e['hanging']}"
    if kind == "doubted":
        r = e["reading"]
        target = f", {r['target']}" if r.get("target") else ""
        fate = "stored, doubted later" if e.get("stored") else "kept as doubted"
        return f"reading of {r['pose']}, {r['load']}{target} {fate}: {e['why']}"
    if kind == "finished":
        return f"finished, {e['readings']} readings"
    if kind == "goal":
        return f'goal "{e.get("goal", e.get("text", ""))}" {"met" if e.get("met") else "not met"}'
    if kind == "drift":
        return f"the reference pose has moved by {e['sigma']:.1f} σ, over the limit"
    reason = str(e.get("reason", ""))
    return kind if reason in ("", kind) else f"{kind}: {reason}"


def _revisions_tables(o: Overview) -> Iterator[Block]:
    """Yield a table of revisions per kind of readings, as their errors do not compare.

    → marks the revision in use.
    """
    kinds = dict.fromkeys(str(r.options["readings"]) for r in o.revisions)
    branched = int(any(r.made_from not in (None, r.number - 1) for r in o.revisions))
    heads = ("rev.", *["from"] * branched, "model", "fit", "left out", "σ", "v.f.", "verdict")
    for kind in kinds:
        if len(kinds) > 1:
            yield f"Of {'deflections' if kind == 'deflection' else 'absolute readings'}:"
        out = table(*heads, left=(1 + branched, 6 + branched))
        for r in (r for r in o.revisions if r.options["readings"] == kind):
            fit = r.result_json["identify"]
            held = fit["error"]["holdout"]
            out.add(
                f"→ {r.number}" if r.number == o.in_use else str(r.number),
                *["" if r.made_from is None else str(r.made_from)] * branched,
                model_words(r),
                numbers.length(float(fit["error"]["fit"]["rms_m"])),
                numbers.length(float(held["rms_m"])),
                f"{float(held['rms_sigma']):.2f}",
                numbers.digits(float(fit["variance_factor"])),
                (r.verdict or "").replace("_", " "),
            )
        yield out


def model_words(r: RevisionRecord) -> str:
    """Return the changes of a revision, or its whole model if it is the first; and its cell."""
    scatter = r.parameters_json.get("arm_scatter") is not None and not r.cell
    model = change(r.added, r.removed, scatter, r.effects) or model_name(r.effects)
    return f"{model}; {cell_words(r.cell)}" if r.cell else model


def utc(time: str) -> str:
    """Return a time (ISO 8601, UTC) to the second, without T and time zone."""
    return time[:19].replace("T", " ")


def two_revisions(a: RevisionRecord, b: RevisionRecord) -> Table:
    """Return a table of two stored revisions with their difference, second minus first."""
    heads = ("", f"revision {a.number}", f"revision {b.number}", "difference")
    out = table(*heads, left=(0, 1, 2, 3))

    def add(quantity: str, first: str, second: str, difference: str = "differs") -> None:
        out.add(quantity, first, second, difference if first != second else "")

    names = [f"+ {name}" for name in b.effects if name not in a.effects]
    names += [f"− {name}" for name in a.effects if name not in b.effects]
    add("model", model_name(a.effects), model_name(b.effects), " ".join(names) or "differs")
    if a.cell or b.cell:
        add("cell", *(cell_words(r.cell) or "as in the campaign" for r in (a, b)))
    add("verdict", verdict_of(a), verdict_of(b))
    fits = [r.result_json["identify"] for r in (a, b)]
    for name, key in (("error on poses left out", "holdout"), ("error on fitted poses", "fit")):
        rms_a, rms_b = (float(f["error"][key]["rms_m"]) for f in fits)
        share = f" ({100 * (rms_b - rms_a) / rms_a:+.0f} %)" if rms_a else ""
        gain = f"{'+' * (rms_b > rms_a)}{numbers.length(rms_b - rms_a)}{share}".replace("-", "−")
        add(name, numbers.length(rms_a), numbers.length(rms_b), gain)
    add("variance factor", *(numbers.digits(float(f["variance_factor"])) for f in fits))
    add("readings", *(str(f["n_readings"]) for f in fits))
    parameters = [{str(p["name"]): p for p in f["parameters"]} for f in fits]
    for name in dict.fromkeys([*parameters[0], *parameters[1]]):
        both = [p.get(name) for p in parameters]
        values = [0.0 if p is None or p["value"] is None else float(p["value"]) for p in both]
        unit_si = next(str(p["unit"]) for p in both if p is not None)
        unit, factor = numbers.unit_for(unit_si, values)
        first, second = (_value(p, factor) for p in both)
        if {first, second} <= {NO_VALUE, UNDETERMINED}:
            continue
        moved = factor * (values[1] - values[0])
        difference = ("+" * (moved > 0) + numbers.digits(moved, 2)).replace("-", "−")
        difference *= not {first, second} & {NO_VALUE, UNDETERMINED}
        add(f"{name} [{unit}]" if unit else name, first, second, difference)
    return out


def verdict_of(record: RevisionRecord) -> str:
    """Return the verdict, or a dash without one."""
    return NO_VALUE if record.verdict is None else record.verdict.replace("_", " ")


def left_out_m(record: RevisionRecord) -> float:
    """Return the rms 3-D position error on poses left out, m."""
    return float(record.result_json["identify"]["error"]["holdout"]["rms_m"])


def cell_words(changes: Changes) -> str:
    """Return changes of a cell in a line, in the syntax of CELL.toml."""
    return "; ".join(
        f"[{section}] " + ", ".join(f"{key} = {write_value(value)}" for key, value in keys.items())
        for section, keys in changes.items()
    )


def refitted(before: Fit, after: Fit) -> str:
    """Return the change of error and variance factor by a fit in a changed cell."""
    errors = " → ".join(numbers.length(f.holdout.rms_m) for f in (before, after))
    factors = " → ".join(f"{f.variance_factor:.2f}" for f in (before, after))
    return f"The error on poses left out goes {errors}, the variance factor {factors}."


def _value(p: Mapping[str, Any] | None, factor: float) -> str:
    if p is None:
        return NO_VALUE
    if p["value"] is None or not p["identifiable"]:
        return UNDETERMINED
    std = float("nan") if p["std"] is None else factor * float(p["std"])
    return numbers.plus_minus(factor * float(p["value"]), std)
