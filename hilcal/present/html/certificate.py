"""The first screen and the certificate: is the model good, by how much, within which limits."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import chi2

from hilcal import numbers
from hilcal.calibration.scatter import COVERAGE, budget
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.identification.fit import Fit
from hilcal.identification.full_covariance import CovarianceParts
from hilcal.identification.full_prediction import error_before, names
from hilcal.identification.residual import CONFIDENCE
from hilcal.identification.validation import CampaignValidation
from hilcal.present.document import (
    Block,
    Items,
    PageSection,
    Table,
    Words,
    captioned,
    heading,
    load_name,
    note,
    table,
)
from hilcal.present.fit import errors, follows, misses, prior_lines
from hilcal.present.html.page import Card, FirstScreen
from hilcal.present.registration import base_line, covariance_words
from hilcal.present.story import Chapter, Story, StoryRevision
from hilcal.present.validation import loads_report, opening, validation_report
from hilcal.present.verdict import headline, message, repeatability_source
from hilcal.readings.whitening import Scaling
from hilcal.store.overview import Overview
from hilcal.store.plan import Plan
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Tested:
    """A model against readings of another campaign.

    Attributes:
        name: of the campaign's file.
        sha256: of that file.
        found: errors of its readings, what the fit states of them, and the limit.
    """

    name: str
    sha256: str
    found: CampaignValidation


@dataclass(frozen=True, slots=True, eq=False)
class ReportContent:
    """Everything that a report says.

    Attributes:
        name: of the campaign's file.
        sha256: of that file.
        made: when the report was made, ISO 8601, UTC.
        version: of the program.
        overview: what the campaign holds.
        covariance: what the covariances consist of.
        chapters: the revisions, oldest first; the last is what the report is about.
        stored: whether they are in the file; else the baseline was fitted for the report alone.
        story: of the same revisions.
        left_out: the last of them with the errors of poses left out.
        scalings: the last model fitted with each scaling; empty without an appendix.
        plan: what was planned; None where nothing was.
        tested: on readings that were never fitted; None without a validation campaign.
        corrected: error at uncorrected and at corrected joint targets, as `calibrate` measured it
            with this revision and the file keeps it: a document of `Improvement`; None without.
        limit_m: the largest 3-D position error that is allowed, m; None without a limit.
        operator: who answers for the measurement; empty where nobody is named.
        commands: that lead to the same result.
        appendix: whether the page has one.
    """

    name: str
    sha256: str
    made: str
    version: str
    overview: Overview
    covariance: CovarianceParts
    chapters: tuple[Chapter, ...]
    stored: bool
    story: Story
    left_out: StoryRevision
    scalings: Mapping[Scaling, Fit]
    plan: Plan | None
    tested: Tested | None
    corrected: Mapping[str, Any] | None
    limit_m: float | None
    operator: str
    commands: tuple[str, ...]
    appendix: bool

    @property
    def fit(self) -> Fit:
        """The fit that the report is about."""
        return self.chapters[-1].fit

    @property
    def diagnosis(self) -> Diagnosis | None:
        """Its diagnosis; None where it is not scaled by gc."""
        return self.chapters[-1].diagnosis


def first_screen(m: ReportContent) -> FirstScreen:
    """Return what the first screen says."""
    answers = (
        ("Is the model good?", how_good(m)),
        ("Where is it wrong?", where_wrong(m)),
        ("What is missing?", missing(m.diagnosis)),
    )
    return FirstScreen(*headline_of(m.diagnosis), answers, tuple(_cards(m)), *limit_words(m))


def headline_of(d: Diagnosis | None) -> tuple[str, str]:
    """Return the verdict in a few words, and its tone."""
    if d is None:
        return "Not judged: only a model fitted with scaling gc can be", "doubt"
    said = headline(d)
    if d.verdict == "missing_effect" and d.lead is not None:
        said = f"{said}: {d.lead.effect}"
    good, open_ = d.verdict == "adequate", d.verdict in ("ambiguous", "noise_misjudged")
    tone = "good" if good else "doubt" if open_ and not d.wrong_figures else "bad"
    return f"{said[0].upper()}{said[1:]}", tone


def how_good(m: ReportContent) -> str:
    """Say in a sentence how well the model predicts."""
    d, prior = m.diagnosis, m.fit.model.prior
    told = misses(m.fit)
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
    d, fit, error = m.diagnosis, m.fit, left_out_errors(m.fit)
    furthest = int(fit.whitening.reading[np.argmax(error)])
    pose, load = names(fit.readings[~fit.outlier], furthest)
    at = load_name(load, "under ")
    said = f"Of the poses left out, {pose} {at} is furthest off: {numbers.length(error.max())}."
    if d is None:
        return said
    if not d.residual_is_noise:
        return f"{said} {follows(d.misfit_breakdown)}"
    # With R whitened elements of standard deviation 1 their sum of squares is χ²(R).
    count = fit.whitening.rank
    if fit.holdout.rms_sigma**2 * count <= chi2.isf((1 - CONFIDENCE) / 2, count):
        return "Nowhere beyond the noise: all poses and loads are predicted within it."
    return (
        "Nowhere in particular: what is left of the fitted poses is noise. Poses left out are off "
        f"by {fit.holdout.rms_sigma:.2f} times the noise, more than by chance; more poses would "
        f"lower that. {said}"
    )


def missing(d: Diagnosis | None) -> str:
    """Say what is missing, and what that effect is."""
    if d is None:
        return "Not judged; hilcal identify --scaling gc, then hilcal diagnose, say it."
    if d.verdict == "adequate":
        return "Nothing that these readings could show."
    said = numbers.sentence(message(d), d.significant)
    if d.lead is None or d.wrong_figures:
        return said
    name = d.lead.coarse or d.lead.effect
    return f"{said} {name} is: {d.fit.model.catalogue[name].summary}."


def _cards(m: ReportContent) -> Iterator[Card]:
    before, held = error_before(m.fit), m.fit.holdout
    what = "nominal arm, only its frames fitted"
    if m.fit.mode == "deflection":
        what = "deflection under load; a rigid arm has none"

    def card(label: str, rms_m: float, max_m: float, more: str = "") -> Card:
        return Card(label, numbers.length(rms_m), f"rms; largest {numbers.length(max_m)}{more}")

    yield card("Before", before.rms_m, before.max_m, f"; {what}")
    if m.tested is not None:
        e = m.tested.found.prediction.error
        seen = "never fitted" if m.tested.found.judged.unseen else "fitted, so no test"
        yield card("After, validation", e.rms_m, e.max_m, f"; {seen}")
    if m.corrected is not None:
        e = m.corrected["error"]
        was, now = (numbers.length(float(e[k]["rms_m"])) for k in ("before", "after"))
        told = f"rms; {was} without correction; {e['count']} points"
        yield Card("Measured at corrected targets", now, told)
    yield card("After, poses left out", held.rms_m, held.max_m)
    floor = numbers.length(m.story.noise_floor_m)
    yield Card("Noise alone", floor, "rms that the stated noise would leave")


def limit_words(m: ReportContent) -> tuple[str, bool | None]:
    """Say whether the limit is kept, and by what that was judged."""
    if m.limit_m is None:
        return "", None
    limit = numbers.length(m.limit_m)
    if m.tested is not None:
        a = m.tested.found.shares
        passed = bool(a.passed)
        head = "PASSED" if passed else "FAILED"
        so = f"{a.everything.count - a.over} of {a.everything.count} errors are within {limit}"
        largest = numbers.length(a.everything.max_m)
        end = f" (campaign {m.tested.name}, never fitted; largest {largest})."
        if a.undecided:
            end += " Noise alone exceeds the limit, so that these readings cannot tell."
        return f"{head}: {so}{end}", passed
    error = left_out_errors(m.fit)
    over = int(np.sum(error > m.limit_m))
    largest = numbers.length(float(error.max()))
    return (
        f"{'FAILED' if over else 'PASSED'}: {len(error) - over} of {len(error)} errors are within "
        f"{limit}, each pose predicted without itself (largest {largest}). No validation campaign "
        "was given: an independent test is missing."
    ), over == 0


def left_out_errors(fit: Fit) -> Floats:
    """Return the 3-D errors (D,) of fitted measurements predicted without their pose, m."""
    return np.asarray(np.linalg.norm(fit.left_out[:, :3], axis=1))


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
        name = load_name(str(part["name"]))
        sizes = [part[when][k] for when in ("before", "after") for k in ("rms_m", "max_m")]
        within = f"{part['inside']} of {part['count']}"
        rows.append((name, str(part["count"]), *(numbers.length(float(x)) for x in sizes), within))
    heads = ("load", "n", "before, rms", "largest", "corrected, rms", "largest", "in 95 % band")
    caption = "Measured at uncorrected and at corrected joint targets"
    return table(*heads, rows=rows, caption=caption)


def _conditions(m: ReportContent) -> Iterator[Block]:
    o, r = m.overview, m.fit.readings
    count = f"{len(r)} readings of {len(np.unique(r.pose))} poses"
    loads = ", ".join(f"{load_name(name)} ({n})" for name, n in o.loads.items())
    set_aside = int(m.fit.outlier.sum())
    gross = f"; {set_aside} set aside as gross errors" if set_aside else ""
    yield f"{count}{gross}. Loads (readings): {loads}."
    yield from (*prior_lines(m.fit), _choice(m))
    q, units = r.states.q, m.fit.model.cell.arm.units
    rows = [
        (name, *(numbers.joint_value(x, unit, 0) for x, unit in zip(ends, units, strict=True)))
        for name, ends in (("from", q.min(axis=0)), ("to", q.max(axis=0)))
    ]
    heads = ("joint", *(str(j + 1) for j in range(q.shape[1])))
    yield table(*heads, caption="Joint angles that were measured", rows=rows)
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
        sizes = (np.sqrt(np.mean(error[mine] ** 2)), error[worst])
        row = [load_name(fit.readings.load_names[k]), str(len(mine))]
        row += [*(numbers.length(float(x)) for x in sizes), fit.readings.pose_names[pose[worst]]]
        if m.limit_m is not None:
            row.append("kept" if error[worst] <= m.limit_m else "over")
        rows.append(row)
    limit = () if m.limit_m is None else ("limit",)
    heads = ("load", "n", "rms", "largest", "at pose", *limit)
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
    repeats = repeatability_source(b.scatter_source, fit.model.cell.arm)
    parts = (
        ("estimated parameters", "type A: errors of poses left out", b.parameters),
        ("misfit at fitted poses", "type A: residuals beyond the noise", b.misfit),
        ("repeatability of the arm", repeats, b.scatter),
        ("noise of the instrument", "type B: as stated", b.instrument),
        ("combined, u", "", b.combined),
    )
    rows = [(*x, numbers.length(u), numbers.percent((u / b.combined) ** 2)) for *x, u in parts]
    caption = "Contributions (GUM): standard uncertainties"
    yield table("contribution", "evaluated by", "3-D", "share of u²", rows=rows, caption=caption)
    yield note(
        "This holds for poses and loads among those below. It does not contain what no reading "
        "here can show: an error of scale or alignment of the instrument beyond its stated "
        "covariance, temperatures and loads that were not measured, and changes of the arm since.",
    )


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
        rows = []
        for i in o.instruments:
            more = "; ".join(f"{k}: {v}" for k, v in i.facts.items() if k != "serial number")
            rows.append((i.device, i.name, i.serial_number or "not told", utc(i.utc), more))
        heads = ("part", "instrument", "serial number", "answered first (UTC)", "further")
        yield table(*heads, caption="Instruments", rows=rows)
    else:
        imported = ": the readings were imported from a table" if o.planned is None else ""
        yield f"The file names no instrument{imported}."
    yield note(f"Noise of the readings: {covariance_words(m.covariance)}.")
    revision = str(m.chapters[-1].number) if m.stored else "none stored: the baseline"
    yield identity(
        ("Robot", o.config.robot.model),
        ("Base", base_line(m.fit.model.cell, m.fit.frames, m.fit.mode)),
        ("Operator", m.operator or "not stated"),
        ("Campaign", f"{m.name}, made {utc(o.created)} UTC"),
        ("SHA-256", m.sha256),
        *([("Validation SHA-256", m.tested.sha256)] if m.tested else []),
        ("Revision", revision),
        ("Report made", f"{utc(m.made)} UTC by hilcal {m.version}"),
    )


def identity(*facts: tuple[str, str]) -> Table:
    """Return what a report is of, and who made it."""
    return table("", "", caption="Identity of this report", rows=facts)


def utc(time: str) -> str:
    """Return a time (ISO 8601, UTC) to the second."""
    return time[:19].replace("T", " ")
