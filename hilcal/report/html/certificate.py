"""The certificate: before and after, limit, uncertainty, what was not tested, by what."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from hilcal.calibration.budget import COVERAGE, Budget, budget
from hilcal.data.plan import UNLOADED
from hilcal.identify.fit import Fit, all_left_out
from hilcal.report import numbers, text, text_validate
from hilcal.report.covariance_words import covariance_words
from hilcal.report.html.content import ReportContent
from hilcal.report.html.first_screen import limit_words, mm
from hilcal.report.html.parts import Items, Part, Section, Table, Words, from_terminal, table
from hilcal.report.scatter_words import repeatability_source
from hilcal.report.text_prior import prior_lines
from hilcal.report.text_registration import base_line
from hilcal.robot.arm import Arm
from hilcal.types import Floats


def certificate(m: ReportContent) -> Section:
    """Return the certificate for a quality manager."""
    fit = m.fit
    parts: list[Part] = [Words(text.before_and_after(fit))]
    parts += from_terminal([text.errors(fit)], "Error before and after")
    if m.corrected is not None:
        parts.append(_corrected(m.corrected))
    parts += [Words("Poses and loads", "heading"), *_conditions(m)]
    parts += [Words("Limit", "heading"), *_limit(m)]
    parts += [Words("Uncertainty", "heading"), *_uncertainty(fit)]
    parts += [Words("What was not tested", "heading"), Items(tuple(not_tested(m)))]
    parts += [Words("Measured with", "heading"), *_instruments(m)]
    return Section("certificate", "Certificate", tuple(parts))


def _corrected(found: Mapping[str, Any]) -> Table:
    """Errors where the arm was moved to corrected joint targets and measured again."""
    rows = []
    for part in (*found["loads"], found["error"]):
        name = "unloaded" if part["name"] == UNLOADED else str(part["name"])
        sizes = [part[when][k] for when in ("before", "after") for k in ("rms_m", "max_m")]
        within = f"{part['inside']} of {part['count']}"
        rows.append((name, str(part["count"]), *(mm(float(x)) for x in sizes), within))
    heads = ("load", "n", "before, rms", "largest", "corrected, rms", "largest", "in 95 % band")
    return table("Measured at uncorrected and at corrected joint targets", heads, rows)


def _conditions(m: ReportContent) -> Iterator[Part]:
    o, r = m.overview, m.fit.readings
    count = f"{len(r)} readings of {len(np.unique(r.pose))} poses"
    loads = ", ".join(
        f"{'unloaded' if name == UNLOADED else name} ({n})" for name, n in o.loads.items()
    )
    set_aside = int(m.fit.outlier.sum())
    gross = f"; {set_aside} set aside as gross errors" if set_aside else ""
    yield Words(f"{count}{gross}. Loads (readings): {loads}.")
    yield from (Words(line.strip()) for line in prior_lines(m.fit))
    q = np.degrees(r.states.q)
    joints = range(q.shape[1])
    yield table(
        "Joint angles that were measured",
        ("joint", *(str(j + 1) for j in joints)),
        (
            ("from", *(f"{q[:, j].min():.0f}°" for j in joints)),
            ("to", *(f"{q[:, j].max():.0f}°" for j in joints)),
        ),
    )


def _limit(m: ReportContent) -> Iterator[Part]:
    words, passed = limit_words(m)
    if passed is None:
        yield Words(
            "No limit was given, so nothing is passed or failed: hilcal report --limit LENGTH "
            "states the largest 3-D error that is allowed."
        )
    else:
        yield Words(words, "strong")
    if m.tested is not None:
        t = m.tested
        yield Words(f"Validation campaign {t.name}")
        yield from from_terminal(text_validate.opening(t.judged, t.prediction))
        yield from from_terminal(
            text_validate.validation_report(t.judged, t.prediction, t.beyond), "Validation"
        )
        yield from from_terminal(
            text_validate.shares_report(t.shares), "Errors of the validation campaign"
        )
    else:
        yield _by_load(m)


def _by_load(m: ReportContent) -> Table:
    """Errors of poses left out by load."""
    fit = m.fit
    raw, w = all_left_out(fit)
    error = np.linalg.norm(raw[:, :3], axis=1)
    load, pose = fit.readings.load[w.reading], fit.readings.pose[w.reading]
    rows = []
    for k in np.unique(load):
        mine = np.flatnonzero(load == k)
        worst = mine[int(np.argmax(error[mine]))]
        name = fit.readings.load_names[k]
        row = [
            "unloaded" if name == UNLOADED else name,
            str(len(mine)),
            mm(float(np.sqrt(np.mean(error[mine] ** 2)))),
            mm(float(error[worst])),
            fit.readings.pose_names[pose[worst]],
        ]
        if m.limit_m is not None:
            row.append("kept" if error[worst] <= m.limit_m else "over")
        rows.append(row)
    heads = ["load", "n", "rms", "largest", "at pose"] + (["limit"] if m.limit_m else [])
    return table("Error of poses left out, by load", heads, rows)


def _uncertainty(fit: Fit) -> Iterator[Part]:
    if fit.scaling != "gc":
        yield Words("No uncertainty is stated: the fit is not weighted by the full covariance.")
        return
    b = budget(fit)
    u, big = b.combined, b.expanded
    what = "deflection" if fit.mode == "deflection" else "position"
    yield Words(
        f"Expanded uncertainty of a predicted {what} (3-D, k = {COVERAGE:.0f}, at least about "
        f"95 %): U = {mm(_rms(big))} rms over what was measured, {mm(float(big.max()))} at most.",
        "strong",
    )
    yield table(
        "Contributions (GUM): standard uncertainties of the 3-D position",
        ("contribution", "evaluated by", "rms", "share of u²"),
        (
            (name, how, mm(_rms(part)), numbers.percent(float(np.mean(part**2) / np.mean(u**2))))
            for name, how, part in _contributions(b, fit.model.cell.arm)
        ),
    )
    yield Words(
        "It contains the instrument's noise as stated (through the parameters), the arm's "
        "repeatability and what the model misses at the measured poses. It does not contain what "
        "no reading here can show: an error of scale or alignment of the instrument beyond its "
        "stated covariance, temperatures and loads that were not measured, and changes of the arm "
        "since.",
        "note",
    )


def _contributions(b: Budget, arm: Arm) -> Iterator[tuple[str, str, Floats]]:
    yield "estimated parameters", "type A: covariance of the fit", b.parameters
    yield "repeatability of the arm", repeatability_source(b.scatter_source, arm), b.scatter
    yield "what the model misses", "type A: residuals beyond the noise", b.misfit
    yield "combined", "", b.combined


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))


def not_tested(m: ReportContent) -> Iterator[str]:
    """Yield what these readings say nothing of."""
    s, fit = m.fit.readings.states, m.fit
    if m.tested is None:
        yield "No validation campaign: the errors are those of poses left out in turn."
    elif not m.tested.judged.unseen:
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


def _instruments(m: ReportContent) -> Iterator[Part]:
    o = m.overview
    if o.instruments:
        yield table(
            "Instruments",
            ("part", "instrument", "serial number", "answered first (UTC)", "further"),
            (
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
        yield Words(f"The file names no instrument{imported}.")
    yield Words(f"Noise of the readings: {covariance_words(m.covariance)}.", "note")
    revision = m.chapters[-1].number
    yield table(
        "Identity of this report",
        ("", ""),
        (
            ("Robot", o.config.robot.model),
            ("Base", base_line(m.fit.model.cell, m.fit.frames, m.fit.mode)),
            ("Operator", m.operator or "not stated"),
            ("Campaign", f"{m.name}, made {o.created[:19].replace('T', ' ')} UTC"),
            ("SHA-256 of the file", m.sha256),
            ("Revision", str(revision) if m.stored else "none stored: the baseline"),
            ("Report made", f"{m.made[:19].replace('T', ' ')} UTC by hilcal {m.version}"),
        ),
    )
