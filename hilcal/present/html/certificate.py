"""The certificate: before and after, limit, uncertainty, what was not tested, by what."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from hilcal import numbers
from hilcal.calibration.budget import COVERAGE, Budget, budget
from hilcal.identification.fit import Fit
from hilcal.present.document import (
    Block,
    Items,
    PageSection,
    Table,
    Words,
    captioned,
    heading,
    note,
    table,
)
from hilcal.present.fit import errors, prior_lines
from hilcal.present.html.content import ReportContent
from hilcal.present.html.first_screen import left_out_errors, limit_words
from hilcal.present.registration import base_line, covariance_words
from hilcal.present.validation import loads_report, opening, validation_report
from hilcal.present.verdict import repeatability_source
from hilcal.robot.arm import Arm
from hilcal.store.plan import UNLOADED


def certificate(m: ReportContent) -> PageSection:
    """Return the certificate for a quality manager."""
    fit = m.fit
    parts: list[Block] = [replace(errors(fit), caption="Error before and after")]
    if m.corrected is not None:
        parts.append(_corrected(m.corrected))
    parts += [heading("Uncertainty"), *_uncertainty(fit)]
    parts += [heading("Limit"), *_limit(m)]
    parts += [heading("Poses and loads"), *_conditions(m)]
    parts += [heading("What was not tested"), Items(tuple(not_tested(m)))]
    parts += [heading("Measured with"), *_instruments(m)]
    return PageSection("certificate", "Certificate", tuple(parts))


def _corrected(found: Mapping[str, Any]) -> Table:
    """Errors where the arm was moved to corrected joint targets and measured again."""
    rows = []
    for part in (*found["loads"], found["error"]):
        name = "unloaded" if part["name"] == UNLOADED else str(part["name"])
        sizes = [part[when][k] for when in ("before", "after") for k in ("rms_m", "max_m")]
        within = f"{part['inside']} of {part['count']}"
        rows.append((name, str(part["count"]), *(numbers.length(float(x)) for x in sizes), within))
    heads = ("load", "n", "before, rms", "largest", "corrected, rms", "largest", "in 95 % band")
    caption = "Measured at uncorrected and at corrected joint targets"
    return table(*heads, rows=rows, caption=caption)


def _conditions(m: ReportContent) -> Iterator[Block]:
    o, r = m.overview, m.fit.readings
    count = f"{len(r)} readings of {len(np.unique(r.pose))} poses"
    loads = ", ".join(
        f"{'unloaded' if name == UNLOADED else name} ({n})" for name, n in o.loads.items()
    )
    set_aside = int(m.fit.outlier.sum())
    gross = f"; {set_aside} set aside as gross errors" if set_aside else ""
    yield f"{count}{gross}. Loads (readings): {loads}."
    yield from (*prior_lines(m.fit), _choice(m))
    q, units = r.states.q, m.fit.model.cell.arm.units
    joints = range(q.shape[1])
    yield table(
        "joint",
        *(str(j + 1) for j in joints),
        caption="Joint angles that were measured",
        rows=(
            ("from", *(numbers.joint_value(q[:, j].min(), units[j], 0) for j in joints)),
            ("to", *(numbers.joint_value(q[:, j].max(), units[j], 0) for j in joints)),
        ),
    )
    if m.tested is None:
        yield _by_load(m)


def _choice(m: ReportContent) -> str:
    """Say what proves the choice of poses and loads."""
    if m.plan is None:
        return "The readings were imported; the file holds no plan, so nothing proves the choice."
    efficiency, criterion = (m.plan.about.get(key) for key in ("efficiency", "criterion"))
    if not isinstance(efficiency, int | float):
        return "They were planned."
    return (
        f"This choice is at least {100 * efficiency:.1f} % as informative as the best possible "
        f"one, by criterion {criterion}: a bound that the general equivalence theorem proves."
    )


def _limit(m: ReportContent) -> Iterator[Block]:
    words, passed = limit_words(m)
    if passed is None:
        yield "No limit was given (hilcal report --limit LENGTH), so nothing is passed or failed."
    else:
        yield Words(words, "strong")
    if m.tested is not None:
        t = m.tested.found
        yield f"Validation campaign {m.tested.name}"
        yield from opening(t.judged, t.prediction)
        told = validation_report(t.judged, t.prediction, t.beyond)
        yield from captioned(told, "Validation")
        yield from captioned(loads_report(t.shares), "Errors of the validation campaign")


def _by_load(m: ReportContent) -> Table:
    """Errors of poses left out by load."""
    fit, error = m.fit, left_out_errors(m.fit)
    kept = fit.readings[~fit.outlier][fit.whitening.reading]
    load, pose = kept.load, kept.pose
    rows = []
    for k in np.unique(load):
        mine = np.flatnonzero(load == k)
        worst = mine[int(np.argmax(error[mine]))]
        name = fit.readings.load_names[k]
        row = [
            "unloaded" if name == UNLOADED else name,
            str(len(mine)),
            numbers.length(float(np.sqrt(np.mean(error[mine] ** 2)))),
            numbers.length(float(error[worst])),
            fit.readings.pose_names[pose[worst]],
        ]
        if m.limit_m is not None:
            row.append("kept" if error[worst] <= m.limit_m else "over")
        rows.append(row)
    heads = ["load", "n", "rms", "largest", "at pose"] + (["limit"] if m.limit_m else [])
    return table(*heads, rows=rows, caption="Error of poses left out, by load")


def _uncertainty(fit: Fit) -> Iterator[Block]:
    if fit.scaling != "gc":
        yield "No uncertainty is stated: the fit is not weighted by the full covariance."
        return
    b = budget(fit)
    whole = ~fit.readings[~fit.outlier].scalar[fit.whitening.reading]
    error = left_out_errors(fit)[whole]
    inside = int(np.sum(error <= b.expanded))
    what = "deflection" if fit.mode == "deflection" else "position"
    yield Words(
        f"Expected accuracy of a predicted {what} at a pose that was not fitted: expanded "
        f"uncertainty U = {numbers.length(b.expanded)} (3-D, k = {COVERAGE:.0f})"
        + f"; {inside} of {len(error)} {what}s of poses left out are within it" * bool(len(error))
        + ".",
        "strong",
    )
    yield table(
        *("contribution", "evaluated by", "3-D", "share of u²"),
        rows=(
            (name, how, numbers.length(u), numbers.percent((u / b.combined) ** 2))
            for name, how, u in _contributions(b, fit.model.cell.arm)
        ),
        caption="Contributions (GUM): standard uncertainties",
    )
    yield note(
        "This holds for poses and loads among those below. It does not contain what no reading "
        "here can show: an error of scale or alignment of the instrument beyond its stated "
        "covariance, temperatures and loads that were not measured, and changes of the arm since.",
    )


def _contributions(b: Budget, arm: Arm) -> Iterator[tuple[str, str, float]]:
    yield "estimated parameters", "type A: errors of poses left out", b.parameters
    yield "misfit at fitted poses", "type A: residuals beyond the noise", b.misfit
    yield "repeatability of the arm", repeatability_source(b.scatter_source, arm), b.scatter
    yield "noise of the instrument", "type B: as stated", b.instrument
    yield "combined, u", "", b.combined


def not_tested(m: ReportContent) -> Iterator[str]:
    """Yield what these readings say nothing of."""
    s, fit = m.fit.readings.states, m.fit
    if m.tested is None:
        yield "No validation campaign: the errors are those of poses left out in turn."
    elif not m.tested.found.judged.unseen:
        yield f"{m.tested.name} was fitted itself: it tests nothing."
    yield "Joint angles outside of the ranges above, and loads other than those above."
    if not np.any(s.wrench):
        yield "Any load: all readings are unloaded."
    for values, name in (
        (s.air_temperature, "temperature of the air"),
        (s.joint_temperature, "temperature of the joints"),
        (s.approach, "side from which joints arrive"),
        (s.load_time, "time under load (creep)"),
    ):
        if values is None:
            yield f"Not recorded: {name}."
        elif np.ptp(values) == 0:
            yield f"Always the same: {name}."
    if fit.readings.m == 3:
        yield "Orientation of the tool: positions alone were measured."
    yield "The arm in motion: all readings were taken at rest."
    d = m.diagnosis
    if fit.mode == "deflection":
        yield "Geometry: deflections were fitted, in which it cancels."
    if d is not None and d.not_shown:
        yield f"At no plausible size would these readings show {numbers.names(d.not_shown, 'or')}."


def _instruments(m: ReportContent) -> Iterator[Block]:
    o = m.overview
    if o.instruments:
        yield table(
            *("part", "instrument", "serial number", "answered first (UTC)", "further"),
            caption="Instruments",
            rows=(
                (
                    i.part,
                    i.name,
                    i.serial or "not told",
                    i.utc[:19].replace("T", " "),
                    "; ".join(f"{k}: {v}" for k, v in i.facts.items() if k != "serial number"),
                )
                for i in o.instruments
            ),
        )
    else:
        imported = ": the readings were imported from a table" if o.planned is None else ""
        yield f"The file names no instrument{imported}."
    yield note(f"Noise of the readings: {covariance_words(m.covariance)}.")
    revision = m.chapters[-1].number
    yield table(
        *("", ""),
        caption="Identity of this report",
        rows=(
            ("Robot", o.config.robot.model),
            ("Base", base_line(m.fit.model.cell, m.fit.frames, m.fit.mode)),
            ("Operator", m.operator or "not stated"),
            ("Campaign", f"{m.name}, made {o.created[:19].replace('T', ' ')} UTC"),
            ("SHA-256", m.sha256),
            *([("Validation SHA-256", m.tested.sha256)] if m.tested else []),
            ("Revision", str(revision) if m.stored else "none stored: the baseline"),
            ("Report made", f"{m.made[:19].replace('T', ' ')} UTC by hilcal {m.version}"),
        ),
    )
