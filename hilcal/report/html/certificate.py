"""The first page: verdict, before and after, limit, uncertainty, what was not tested, by what."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilcal.calibration.budget import COVERAGE, Budget, budget
from hilcal.data.plan import UNLOADED
from hilcal.diagnose.diagnosis import Diagnosis
from hilcal.identify.before import error_before
from hilcal.identify.fit import Fit, all_left_out
from hilcal.identify.full_prediction import full_prediction
from hilcal.report import numbers, text, text_validate
from hilcal.report.covariance_words import covariance_words
from hilcal.report.html.content import ReportContent
from hilcal.report.html.parts import Items, Part, Section, Table, Words, from_terminal, table
from hilcal.report.text_prior import prior_lines
from hilcal.report.verdict_words import message
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class Card:
    """One number of the first screen: `label`, `value` with unit, and a note."""

    label: str
    value: str
    note: str


@dataclass(frozen=True, slots=True)
class FirstScreen:
    """What the first screen says.

    Attributes:
        headline: the verdict in a few words.
        tone: "good", "doubt" or "bad", for the colour; the headline says it in words.
        answers: question and answer: is it good, where is it wrong, what is missing.
        cards: before and after.
        limit: "PASSED" or "FAILED" and why; empty without a limit.
        passed: whether the limit is kept; None without one.
    """

    headline: str
    tone: str
    answers: tuple[tuple[str, str], ...]
    cards: tuple[Card, ...]
    limit: str
    passed: bool | None


def first_screen(m: ReportContent) -> FirstScreen:
    """Return what the first screen says."""
    d, fit = m.diagnosis, m.fit
    headline, tone = headline_of(d)
    limit, passed = limit_words(m)
    return FirstScreen(
        headline,
        tone,
        (
            ("Is the model good?", how_good(m)),
            ("Where is it wrong?", where_wrong(m)),
            ("What is missing?", missing(d)),
        ),
        tuple(_cards(m, fit)),
        limit,
        passed,
    )


def headline_of(d: Diagnosis | None) -> tuple[str, str]:
    """Return the verdict in a few words, and its tone."""
    if d is None:
        return "Not judged: only a model fitted with scaling gc can be", "doubt"
    lead = d.lead.effect if d.lead is not None else ""
    if d.verdict == "adequate":
        return "The model is good: what is left is noise", "good"
    if d.verdict == "missing_effect":
        return f"The model is incomplete: {lead} is missing", "bad"
    if d.verdict == "ambiguous":
        if d.reason == "inseparable_addition":
            return "The model is good, but another one would be as good", "doubt"
        return "The model is incomplete, and these readings cannot tell what is missing", "doubt"
    if d.verdict == "unknown_effect":
        return "The model is incomplete: no known effect explains what is left", "bad"
    return "The stated noise is wrong: the model cannot be judged by it", "doubt"


def how_good(m: ReportContent) -> str:
    """Say in a sentence how well the model predicts."""
    d, prior = m.diagnosis, m.fit.model.prior
    told = text.misses(m.fit)
    if prior is not None:
        told += f" It also rests on a prior: {prior.posterior.source.campaign or 'a posterior'}."
    if d is None:
        return told
    if d.verdict == "noise_misjudged":
        return f"It cannot be told, for the stated noise is wrong. {told}"
    good = d.verdict == "adequate" or d.reason == "inseparable_addition"
    return f"{'Yes' if good else 'Not yet'}. {told}"


def where_wrong(m: ReportContent) -> str:
    """Say in a sentence where it is worst, and what the misfit follows."""
    d = m.diagnosis
    if d is not None and d.residual_is_noise:
        return "Nowhere beyond the noise: all poses and loads are predicted within it."
    worst = text.worst_poses(full_prediction(m.fit), most=1)
    places = "" if d is None else text.follows(d.misfit_breakdown)
    at = ""
    if worst:
        w = worst[0]
        load = "unloaded" if w.load == UNLOADED else f"under {w.load}"
        at = f"Worst at pose {w.pose} {load}: off by {numbers.length(w.error_m)}. "
    return f"{at}{places}".strip()


def missing(d: Diagnosis | None) -> str:
    """Say in few words what is missing; the whole sentence stands with the evidence."""
    if d is None:
        return "Not judged; hilcal identify --scaling gc, then hilcal diagnose, say it."
    if d.verdict == "adequate":
        return "Nothing that these readings could show."
    if d.reason == "inseparable_addition":
        return _as_good(d)
    if d.reason == "no_suspect":
        best = f": the best, {d.suspects[0].effect}, does not" if d.suspects else ""
        return (
            f"No effect of the catalogue surely explains what is left{best}. hilcal discover "
            "searches a law for it."
        )
    lead = d.lead
    if lead is None or d.reason == "insufficient_catalogue":
        return numbers.sentence(message(d), d.significant)
    explained = (
        f"explains {numbers.percent(lead.share)} of the misfit, "
        f"{numbers.percent(max(lead.holdout_share, 0.0))} on poses left out"
    )
    name = lead.coarse or lead.effect
    law = f"{name} is: {d.fit.model.catalogue[name].summary}."
    if d.reason == "inseparable_suspects":
        others = numbers.few([r.effect for r in d.separability])
        return (
            f"{lead.effect}, which {explained}; or {others}: these readings do not separate them. "
            f"hilcal next plans those that do. {law}"
        )
    what = f"joints that differ in {name}: it" if lead.coarse else f"{name}: it"
    return numbers.sentence(f"{what} {explained}. {law}", d.significant)


def _as_good(d: Diagnosis) -> str:
    """Say which effects of an adequate model others could replace."""
    doubts = [
        f"{a.effect} could as well be "
        + (numbers.few(a.same_as, 1) if a.same_as else f"{len(a.others)} other effects together")
        for a in d.alternatives
        if a.inseparable
    ]
    told = "; ".join(doubts)
    return f"Nothing that lowers the error. But {told}. hilcal next plans what separates them."


def _cards(m: ReportContent, fit: Fit) -> Iterator[Card]:
    before = error_before(fit)
    what = (
        "deflection under load; a rigid arm has none"
        if fit.mode == "deflection"
        else "nominal arm, only its frames fitted"
    )
    yield Card("Before", mm(before.rms_m), f"rms; largest {mm(before.max_m)}; {what}")
    if m.tested is not None:
        e = m.tested.prediction.error
        seen = "never fitted" if m.tested.judged.unseen else "fitted, so no test"
        yield Card("After, validation", mm(e.rms_m), f"rms; largest {mm(e.max_m)}; {seen}")
    if m.corrected is not None:
        e = m.corrected["error"]
        before_m, after_m = (mm(float(e[k]["rms_m"])) for k in ("before", "after"))
        yield Card(
            "Measured at corrected targets",
            after_m,
            f"rms; {before_m} without correction; {e['count']} points",
        )
    held = fit.holdout
    yield Card("After, poses left out", mm(held.rms_m), f"rms; largest {mm(held.max_m)}")
    yield Card("Noise alone", mm(m.story.noise_floor_m), "rms that no model can go below")


def mm(metres: float) -> str:
    """Return a length in mm, three digits or µm at the least."""
    return f"{1e3 * metres:.3f} mm"


def limit_words(m: ReportContent) -> tuple[str, bool | None]:
    """Say whether the limit is kept, and by what that was judged."""
    if m.limit_m is None:
        return "", None
    limit = mm(m.limit_m)
    if m.tested is not None:
        a = m.tested.shares
        passed = bool(a.passed)
        head = "PASSED" if passed else "FAILED"
        so = f"{a.everything.count - a.over} of {a.everything.count} errors are within {limit}"
        end = f" (campaign {m.tested.name}, never fitted; largest {mm(a.everything.max_m)})."
        if a.undecided:
            end += " Noise alone exceeds the limit, so that these readings cannot tell."
        return f"{head}: {so}{end}", passed
    error = left_out_errors(m.fit)
    over = int(np.sum(error > m.limit_m))
    head = "PASSED" if over == 0 else "FAILED"
    return (
        f"{head}: {len(error) - over} of {len(error)} errors are within {limit}, each pose "
        f"predicted without itself (largest {mm(float(error.max()))}). No validation campaign was "
        "given: an independent test is missing."
    ), over == 0


def left_out_errors(fit: Fit) -> Floats:
    """Return the 3-D errors (D,) of measurements predicted without their pose, m."""
    raw, _ = all_left_out(fit)
    return np.asarray(np.linalg.norm(raw[:, :3], axis=1))


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
            for name, how, part in _contributions(b)
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


def _contributions(b: Budget) -> Iterator[tuple[str, str, Floats]]:
    yield "estimated parameters", "type A: covariance of the fit", b.parameters
    how = "type B: as stated, or estimated" if b.scatter_known else "not known, taken as zero"
    yield "repeatability of the arm", how, b.scatter
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
    hidden = () if d is None else tuple(
        x.effect for x in d.suspects if not x.passes and not x.least.visible
    )  # fmt: skip
    if hidden:
        yield f"These readings cannot show, however strong: {numbers.names(list(hidden))}."


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
            ("Operator", m.operator or "not stated"),
            ("Campaign", f"{m.name}, made {o.created[:19].replace('T', ' ')} UTC"),
            ("SHA-256 of the file", m.sha256),
            ("Revision", str(revision) if m.stored else "none stored: the baseline"),
            ("Report made", f"{m.made[:19].replace('T', ' ')} UTC by hilcal {m.version}"),
        ),
    )
