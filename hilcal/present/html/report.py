"""The report of one campaign: first screen, certificate, sections, and an appendix for experts."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from hilcal import numbers
from hilcal.calibration.improvement import refuted
from hilcal.calibration.scatter import COVERAGE, budget
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.effect_ranking import LEAST_SHARE, Suspect
from hilcal.diagnosis.noise import repeat_classes
from hilcal.identification.background import family_sizes
from hilcal.identification.fit import Fit
from hilcal.identification.noise.full_covariance import CovarianceParts
from hilcal.identification.prediction.full_prediction import nominal_error, reading_name
from hilcal.identification.prediction.validation import CampaignValidation
from hilcal.identification.residual import CONFIDENCE, ErrorBlock
from hilcal.numbers import length, percent
from hilcal.present import charts
from hilcal.present import fit as fit_words
from hilcal.present.calibration import (
    MIN_ERROR_RATIO,
    REFUTED,
    fit_and_test_lines,
    loads_report,
    validation_report,
    worst_poses_table,
)
from hilcal.present.campaign import info_report, robot_name, utc
from hilcal.present.diagnosis import (
    detectable_sizes,
    doubtful_lines,
    redundant_line,
    repeats_sentence,
)
from hilcal.present.document import (
    Block,
    Chart,
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
from hilcal.present.html import FirstScreen, render
from hilcal.present.registration import base_line, covariance_words
from hilcal.present.story import (
    REVISION_HEADS,
    Chapter,
    Story,
    StoryRevision,
    curve,
    laws,
    regressor,
)
from hilcal.present.verdict import headline, message, noise_unknown, repeatability_source
from hilcal.readings.whitening import Scaling
from hilcal.store.overview import Overview
from hilcal.store.plan import Plan
from hilcal.store.stored_texts import COMMAND
from hilcal.types import Floats

MOST_CURVES, MOST_LISTED, MOST_PARAMETERS, MOST_LAWS = 2, 6, 48, 4
"""Most curves, suspects, parameters and curves of laws on the page; choices."""
NOT_STORED = "not stored: made by the library, at the workbench, or by an older version"


@dataclass(frozen=True, slots=True, eq=False)
class TestCampaign:
    """A validation by another campaign, with the name and the hash of its file."""

    name: str
    sha256: str
    validation: CampaignValidation


@dataclass(frozen=True, slots=True, eq=False)
class ReportContent:
    """The contents of a report."""

    name: str  # of the campaign's file
    sha256: str  # of that file
    created: str  # time of the report, ISO 8601, UTC
    version: str  # of the program
    overview: Overview
    covariance: CovarianceParts
    chapters: tuple[Chapter, ...]  # revisions, oldest first; the report is about the last one
    stored: bool  # whether the file has the revisions; else the baseline, fitted for the report
    story: Story  # of the same revisions
    left_out: StoryRevision  # the last revision with the errors of poses left out
    scalings: Mapping[Scaling, Fit]  # fits of the last model; empty without an appendix
    plan: Plan | None
    test: TestCampaign | None  # on readings that were never fitted
    corrected: Mapping[str, Any] | None
    """Errors at uncorrected and corrected joint targets that `calibrate` measured with this
    revision: the stored JSON of `Improvement`."""
    limit_m: float | None  # largest allowed 3-D position error
    operator: str  # responsible for the measurement; empty if not stated
    commands: tuple[str, ...]  # that reproduce the result
    appendix: bool  # whether the page has an appendix

    @property
    def fit(self) -> Fit:
        """The fit of the last revision."""
        return self.chapters[-1].fit

    @property
    def diagnosis(self) -> Diagnosis | None:
        """The diagnosis of the last revision; None unless it is scaled by gc."""
        return self.chapters[-1].diagnosis


def page(m: ReportContent) -> str:
    """Return the report of one campaign as HTML."""
    about = f"{robot_name(m.overview.config)}, {m.name}, {m.created[:10]}"
    parts = (_certificate(m), *sections(m), *(_appendix(m) if m.appendix else ()))
    return render("Calibration report", about, first_screen(m), parts)


def sections(m: ReportContent) -> tuple[PageSection, ...]:
    """Return all sections after the certificate."""
    return (_revisions(m), _where(m), _evidence(m), *_laws(m), _parameters(m))


def first_screen(m: ReportContent) -> FirstScreen:
    """Return the contents of the first screen."""
    d, good = m.diagnosis, fit_words.holdout_sentence(m.fit)
    verdict = None if d is None else d.verdict
    if (prior := m.fit.model.prior) is not None:
        good += f" It also rests on a prior: {prior.posterior.source.campaign or 'a posterior'}."
    if d is None:
        title, tone = "not judged: this needs a fit with scaling gc", "doubt"
        missing = "Not judged; run hilcal identify --scaling gc, then hilcal diagnose."
    else:
        title, missing = headline(d), message(d)
        if verdict == "missing_effect" and d.lead is not None:
            title += f": {d.lead.effect}"
        doubt = verdict in ("ambiguous", "noise_misjudged") and not d.wrong_figures
        tone = "doubt" if doubt else "good" if verdict == "adequate" else "bad"
        if verdict == "noise_misjudged":
            why = "nothing shows whether the stated noise is right"
            why = why if noise_unknown(d) else "the stated noise is wrong"
            good = f"This cannot be judged, because {why}. {good}"
        else:
            yes = verdict == "adequate" or d.reason == "inseparable_addition"
            answer = "Yes" if yes else "Not yet"
            if verdict == "unknown_effect" and d.background:
                answer = "In part: smooth functions of the pose stand for an effect that is unknown"
            elif d.reason == "background":
                answer = "In part: it includes effects that these poses do not prove"
            good = f"{answer}. {good}"
        if verdict == "adequate":
            missing = "No effect that these readings could show."
        elif d.lead is not None and not d.wrong_figures:
            name = d.lead.coarse or d.lead.effect
            missing += f" {name} is: {d.fit.model.catalogue[name].summary}."
    z = 0.0
    if m.test is not None and m.test.validation.judged.unseen:
        z = m.test.validation.shares.everything.z
    if m.test is not None and z > MIN_ERROR_RATIO:
        if verdict == "adequate":
            title, tone = "refuted by its validation", "bad"
            good = f"Only where it was fitted. {good.removeprefix('Yes. ')}"
        good += f" The readings of {m.test.name} are {z:.2g} times as far off as the fit states."
    answers = (
        ("Is the model good?", good),
        ("Where is it wrong?", misfit_sentence(m)),
        ("What is missing?", missing),
    )
    title, cards = f"{title[0].upper()}{title[1:]}", tuple(_cards(m))
    return FirstScreen(title, tone, answers, cards, *limit_words(m), verdict)


def misfit_sentence(m: ReportContent) -> str:
    """Return sentences on the worst pose and on the variables that the misfit follows."""
    d, fit, error = m.diagnosis, m.fit, left_out_errors(m.fit)
    furthest = int(fit.whitening.reading[np.argmax(error)])
    pose, load = reading_name(fit.readings[~fit.outlier], furthest)
    place = f"{pose} {load_name(load, 'under ')}"
    worst = f"Of the poses left out, {place} is furthest off: {length(error.max())}."
    if d is None:
        return worst
    if d.follows and not d.residual_is_noise:  # on poses left out, if not on the fitted ones
        what = "What the named effects leave" if d.background else "The misfit there"
        return f"{worst} {what} follows {' and '.join(d.follows)}."
    if not d.residual_is_noise:
        return f"{worst} {fit_words.dependence_sentence(d.misfit_breakdown)}"
    # The sum of squares of R whitened elements of standard deviation 1 is distributed as χ²(R).
    count = fit.whitening.rank
    if fit.holdout.rms_sigma**2 * count <= scipy.stats.chi2.isf((1 - CONFIDENCE) / 2, count):
        return "Nowhere beyond the noise: all poses and loads are predicted within it."
    return (
        "Nowhere in particular: what is left of the fitted poses is noise. Poses left out are off "
        f"by {fit.holdout.rms_sigma:.2f} times the noise, more than by chance; more poses would "
        f"lower that. {worst}"
    )


def _cards(m: ReportContent) -> Iterator[tuple[str, str, str]]:
    def card(label: str, e: ErrorBlock, remark: str = "") -> tuple[str, str, str]:
        return label, length(e.rms_m), f"rms; largest {length(e.max_m)}{remark}"

    model = "nominal arm, only its frames fitted"
    if m.fit.mode == "deflection":
        model = "deflection under load; a rigid arm has none"
    yield card("Before", nominal_error(m.fit), f"; {model}")
    if m.test is not None:
        kind = "never fitted" if m.test.validation.judged.unseen else "fitted, so no test"
        yield card("After, validation", m.test.validation.prediction.error, f"; {kind}")
    if m.corrected is not None:
        error = m.corrected["error"]
        uncorrected, corrected = (length(float(error[k]["rms_m"])) for k in ("before", "after"))
        text = f"rms; {uncorrected} without correction; {error['count']} points"
        yield "Measured at corrected targets", corrected, text
    yield card("After, poses left out", m.fit.holdout)
    yield "Noise alone", length(m.story.noise_floor_m), "rms that noise alone would leave"


def limit_words(m: ReportContent) -> tuple[str, bool | None]:
    """Return the verdict on the limit with its basis, and whether it is kept; "", None without."""
    if m.limit_m is None:
        return "", None
    error = left_out_errors(m.fit)
    if m.corrected is not None:
        error = np.array([point["after_m"] for point in m.corrected["points"]])
    count, over, most = len(error), int(np.sum(error > m.limit_m)), float(error.max())
    passed = over == 0
    if m.test is not None and m.test.validation.judged.unseen:
        a = m.test.validation.shares
        count, over, passed, most = a.everything.count, a.over, bool(a.passed), a.everything.max_m
        end = f" (campaign {m.test.name}, never fitted; largest {length(most)})."
        if a.undecided:
            end += " Noise alone exceeds the limit, so that these readings cannot decide."
    elif m.corrected is not None:
        end = f" (measured at corrected targets, never fitted; largest {length(most)})."
    else:
        none = "No validation campaign was given"
        if m.test is not None:
            none = f"{m.test.name} was fitted itself"
        end = (
            f", each pose predicted without itself (largest {length(most)}). {none}: an "
            "independent test is missing."
        )
    head = f"{'PASSED' if passed else 'FAILED'}: {count - over} of {count} errors are within"
    return f"{head} {length(m.limit_m)}{end}", passed


def left_out_errors(fit: Fit) -> Floats:
    """Return the 3-D errors (D,) of the fitted measurements when their pose is left out, m."""
    return np.asarray(np.linalg.norm(fit.left_out[:, :3], axis=1))


def _certificate(m: ReportContent) -> PageSection:
    parts: list[Block] = [replace(fit_words.errors(m.fit), caption="Error before and after")]
    if m.corrected is not None:
        heads = ("load", "n", "before, rms", "largest", "corrected, rms", "largest", "in 95 % band")
        out = table(*heads, caption="Measured at uncorrected and at corrected joint targets")
        for part in (*m.corrected["loads"], m.corrected["error"]):
            sizes = [part[when][k] for when in ("before", "after") for k in ("rms_m", "max_m")]
            name, within = load_name(str(part["name"])), f"{part['inside']} of {part['count']}"
            out.add(name, str(part["count"]), *(length(float(x)) for x in sizes), within)
        parts.append(out)
        if refuted(m.corrected["error"]["inside"], m.corrected["error"]["count"]):
            parts.append(Words(REFUTED, "strong"))
    for title, blocks in (
        ("Uncertainty", _uncertainty(m.fit)),
        ("Limit" if m.test is None else "Limit and validation", _limit(m)),
        ("Poses and loads", _conditions(m)),
        ("What was not tested", [Items(tuple(_not_tested(m)))]),
        ("Measured with", _instruments(m)),
    ):
        parts += [heading(title), *blocks]
    return PageSection("certificate", "Certificate", tuple(parts))


def _uncertainty(fit: Fit) -> Iterator[Block]:
    if fit.scaling != "gc":
        yield "No uncertainty is stated: the fit is not weighted by the full covariance."
        return
    b = budget(fit)
    error, of_3d = left_out_errors(fit), not fit.readings.scalar.any()
    inside = int(np.sum(error <= b.expanded))
    quantity = "deflection" if fit.mode == "deflection" else "position" if of_3d else "reading"
    within = f"; {inside} of {len(error)} {quantity}s of poses left out are within it"
    accuracy = f"Expected accuracy of a predicted {quantity} at a pose that was not fitted"
    expanded = f"U = {length(b.expanded)} ({'3-D, ' * of_3d}k = {COVERAGE:.0f})"
    yield Words(f"{accuracy}: expanded uncertainty {expanded}{within}.", "strong")
    repeats = repeatability_source(b.scatter_source, fit.model.cell.arm)
    parts = (
        ("estimated parameters", "type A: errors of poses left out", b.parameters),
        ("misfit at fitted poses", "type A: residuals beyond the noise", b.misfit),
        ("repeatability of the arm", repeats, b.scatter),
        ("noise of the instrument", "type B: as stated", b.instrument),
        ("combined, u", "", b.combined),
    )
    rows = [(*x, length(u), percent((u / b.combined) ** 2)) for *x, u in parts]
    caption = "Contributions (GUM): standard uncertainties"
    heads = ("contribution", "evaluated by", "3-D" if of_3d else "u", "share of u²")
    yield table(*heads, rows=rows, caption=caption)
    yield note(
        "This holds for poses and loads among those below. It does not contain what no reading "
        "here can show: an error of scale or alignment of the instrument beyond its stated "
        "covariance, temperatures and loads that were not measured, and changes of the arm since."
    )


def _limit(m: ReportContent) -> Iterator[Block]:
    verdict, passed = limit_words(m)
    if passed is None:
        yield "No limit was given (hilcal report --limit LENGTH), so that none is tested."
    else:
        yield Words(verdict, "strong")
    if m.test is not None:
        t = m.test.validation
        yield f"Validation campaign {m.test.name}"
        yield from fit_and_test_lines(t.judged, t.prediction)
        yield from captioned(validation_report(t.judged, t.prediction, t.beyond), "Validation")
        yield from captioned(loads_report(t.shares), "Errors of the validation campaign")


def _conditions(m: ReportContent) -> Iterator[Block]:
    o, r = m.overview, m.fit.readings
    loads = ", ".join(f"{load_name(name)} ({n})" for name, n in o.loads.items())
    outliers, poses = int(m.fit.outlier.sum()), len(np.unique(r.pose))
    gross = f"; {outliers} set aside as gross errors" if outliers else ""
    yield f"{len(r)} readings of {poses} poses{gross}. Loads (readings): {loads}."
    yield from fit_words.prior_lines(m.fit)
    about = {} if m.plan is None else m.plan.about
    efficiency, criterion = about.get("efficiency"), about.get("criterion")
    if m.plan is None:
        yield "The file holds no plan, so that no efficiency is certified."
    elif not isinstance(efficiency, int | float):
        yield "They were planned."
    else:
        yield (
            f"Efficiency of this choice by criterion {criterion}: at least {100 * efficiency:.1f} "
            "% of the best possible one (bound by the general equivalence theorem)."
        )
    q, units = r.states.q, m.fit.model.cell.arm.units
    rows = [
        (name, *(numbers.joint_value(x, unit, 0) for x, unit in zip(ends, units, strict=True)))
        for name, ends in (("from", q.min(axis=0)), ("to", q.max(axis=0)))
    ]
    heads = ("joint", *(str(j + 1) for j in range(q.shape[1])))
    yield table(*heads, caption=f"Joint {_values(m)} that were measured", rows=rows)
    if m.test is not None:
        return
    error, fitted = left_out_errors(m.fit), r[~m.fit.outlier][m.fit.whitening.reading]
    heads = ("load", "n", "rms", "largest", "at pose", *["limit"] * (m.limit_m is not None))
    out = table(*heads, caption="Error of poses left out, by load")
    for k in np.unique(fitted.load):
        of_load = np.flatnonzero(fitted.load == k)
        worst = of_load[int(np.argmax(error[of_load]))]
        rms, most = float(np.sqrt(np.mean(error[of_load] ** 2))), float(error[worst])
        row = [load_name(r.load_names[k]), str(len(of_load)), length(rms), length(most)]
        row.append(r.pose_names[fitted.pose[worst]])
        if m.limit_m is not None:
            row.append("kept" if most <= m.limit_m else "over")
        out.add(*row)
    yield out


def _values(m: ReportContent) -> str:
    return "values" if m.fit.model.cell.arm.slides.any() else "angles"


def _not_tested(m: ReportContent) -> Iterator[str]:
    s, fit, d = m.fit.readings.states, m.fit, m.diagnosis
    if m.test is None:
        yield "No validation campaign: the errors are those of poses left out in turn."
    elif not m.test.validation.judged.unseen:
        yield f"{m.test.name} was fitted itself: it tests nothing."
    yield f"Joint {_values(m)} outside of the ranges above, and loads other than those above."
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
        yield "Orientation of the tool: it was not measured."
    yield "The arm in motion: all readings were taken at rest."
    if fit.mode == "deflection":
        yield "Geometry: deflections were fitted, in which it cancels."
    if d is not None and d.not_shown:
        yield f"These readings cannot show, at any plausible size: {numbers.names(d.not_shown)}."


def _instruments(m: ReportContent) -> Iterator[Block]:
    o = m.overview
    if o.instruments:
        heads = ("part", "instrument", "serial number", "answered first (UTC)", "further")
        out = table(*heads, caption="Instruments")
        for i in o.instruments:
            facts = "; ".join(f"{k}: {v}" for k, v in i.facts.items() if k != "serial number")
            out.add(i.device, i.name, i.serial_number or "not reported", utc(i.utc), facts)
        yield out
    else:
        yield f"The file names no instrument; origin of the readings: {o.source}."
    yield note(f"Noise of the readings: {covariance_words(m.covariance)}.")
    yield identity(
        ("Robot", robot_name(o.config)),
        ("Base", base_line(m.fit.model.cell, m.fit.frames, m.fit.mode)),
        ("Operator", m.operator or "not stated"),
        ("Campaign", f"{m.name}, made {utc(o.created)} UTC"),
        ("SHA-256", m.sha256),
        *([("Validation SHA-256", m.test.sha256)] if m.test else []),
        ("Revision", str(m.chapters[-1].number) if m.stored else "none stored: the baseline"),
        ("Report made", f"{utc(m.created)} UTC by hilcal {m.version}"),
    )


def identity(*facts: tuple[str, str]) -> Table:
    """Return the table that identifies the subject and the author of a report."""
    return table("", "", caption="Identity of this report", rows=facts)


def _revisions(m: ReportContent) -> PageSection:
    parts: list[Block] = [
        Chart("Error per revision", charts.error_per_revision(m.story), wide=True, height=0),
        table(*REVISION_HEADS, rows=(r.cells for r in m.story.revisions), caption="Revisions"),
    ]
    if not m.stored:
        parts.append(
            "No revision is stored in the campaign: the baseline was fitted for this report "
            "and is not kept. hilcal refine finds the effects that are missing."
        )
    return PageSection("revisions", "How the error fell", tuple(parts))


def _where(m: ReportContent) -> PageSection:
    held_out, d = (m.story, m.left_out), m.diagnosis
    gross = " Gross errors are drawn, too." * bool(m.fit.outlier.any())
    parts: list[Block] = [
        f"Errors are those of poses left out: each is predicted by a fit to the others.{gross}",
        Chart("By pose", charts.residual_by_pose(*held_out), wide=True),
        Chart("Measured against predicted", charts.measured_predicted(*held_out)),
    ]
    if len(set(m.story.load_names)) > 1:
        parts.append(Chart("By load", charts.residual_by_load(*held_out)))
    if m.story.time_s is not None:
        parts.append(Chart("Over time", charts.residual_by_time(*held_out)))
    parts += [
        Chart("From above", charts.workspace(*held_out, "xy")),
        Chart("From the side", charts.workspace(*held_out, "xz")),
        Chart("Noise check: fitted poses", charts.noise_check(m.fit)),
    ]
    if d is not None:
        if d.verdict != "adequate":
            curves = [curve(v) for v in d.dependences if v.determined][:MOST_CURVES]
            parts += [Chart(c.title, charts.curve_chart(c)) for c in curves]
        blocks = captioned(fit_words.where_table(d.misfit_breakdown), "What the error follows")
        parts += [replace(p, narrow=True) if isinstance(p, Table) else p for p in blocks]
    return PageSection("where", "Where it fails", (*parts, _noise(m)))


def _noise(m: ReportContent) -> str:
    e = None if m.diagnosis is None else m.diagnosis.pure_error
    if e is not None:
        return repeats_sentence(e)
    fitted = m.fit.readings[~m.fit.outlier]
    repeats = len(fitted) - len(np.unique(repeat_classes(fitted)))
    if not repeats:
        return "No reading was repeated: the noise is judged by the model alone."
    quantity = "deflection" if m.fit.mode == "deflection" else "reading"
    return (
        f"{repeats} of {len(fitted)} readings repeat an earlier one, too few to judge the noise of "
        f"a {quantity}: it is judged by the model alone."
    )


def _evidence(m: ReportContent) -> PageSection:
    d, title = m.diagnosis, "What is missing, with its evidence"
    if d is None:
        reason = "Not diagnosed: this needs a fit with scaling gc."
        return PageSection("evidence", title, (reason,))
    parts: list[Block] = []
    if d.verdict == "adequate":  # other verdicts are on the first screen
        parts.append(message(d))
    parts.append(_suspects_table(d.suspects[:MOST_LISTED], "Suspects, best first"))
    parts += [*doubtful_lines(d), *redundant_line(d)]
    parts += _added_variables(d, [s for s in d.suspects if s.passes][:MOST_CURVES])
    return PageSection("evidence", title, tuple(parts))


def _added_variables(d: Diagnosis, suspects: Sequence[Suspect]) -> Iterator[Chart]:
    for s in suspects:
        if (added := regressor(d.fit, s)) is not None:
            yield Chart(f"Added variable: {s.effect}", charts.added_variable(added, s.effect))


def _suspects_table(rows: Sequence[Suspect], caption: str) -> Table:
    heads = ("effect", "explains", "on poses left out", "log evidence", "p-value", "passes")
    out = table(*heads, "inseparable from", caption=caption)
    for s in rows:
        shares = percent(s.share), percent(max(s.holdout_share, 0.0))
        scores = f"{s.score.log_evidence:z.1f}", numbers.chance(s.score.p_value)
        passes = "yes" if s.passes else "no"
        out.add(s.effect, *shares, *scores, passes, ", ".join(s.same_as) or "-")
    return out


def _laws(m: ReportContent) -> Iterator[PageSection]:
    if not (law_curves := laws(m.fit)):
        return
    facts = {f"{law.title}, an effect of a file": law.facts for law in law_curves}
    shown = law_curves[:MOST_LAWS]
    parts: tuple[Block, ...] = (
        *(table("", "", rows=rows, caption=caption) for caption, rows in facts.items()),
        *(Chart(f"{law.title}: {law.y_label}", charts.curve_chart(law)) for law in shown),
        note(
            "Each point is the mean over readings of the law's value plus their residual. The law "
            "is not tested outside the drawn range, nor within its gaps."
        ),
    )
    yield PageSection("laws", "Laws beyond the catalogue", parts)


def _parameters(m: ReportContent) -> PageSection:
    fit, catalogue = m.fit, m.fit.model.catalogue
    effects = [name for name in fit.model.named if name in catalogue.names]
    parts: list[Block] = [note(f"{name}: {catalogue[name].summary}.") for name in effects]
    command = "hilcal report --appendix"
    for part in captioned(fit_words.parameters(fit, MOST_PARAMETERS, command), "Parameters"):
        if not isinstance(part, Table):
            parts.append(part)
            continue
        middle = -(-len(part.rows) // 2)  # two halves, without the column of meanings
        for rows, suffix in ((part.rows[:middle], ""), (part.rows[middle:], ", continued")):
            if rows:
                cut, caption = [row[:-1] for row in rows], f"{part.caption}{suffix}"
                heads = part.heads[:-1]
                parts.append(replace(part, caption=caption, heads=heads, rows=cut, narrow=True))
    parts += fit_words.background_line(fit)
    if sizes := family_sizes(fit):
        chart = charts.family_sizes(sizes)
        parts.append(Chart("Size of each family of effects", chart, wide=True, height=0))
    return PageSection("parameters", "Parameters", tuple(parts))


def _appendix(m: ReportContent) -> Iterator[PageSection]:
    joints: list[Block] = [
        Chart(f"Over joint {j + 1}", charts.residual_by_joint(m.story, m.left_out, j))
        for j in range(m.story.arm.n)
    ]
    if m.test is not None:
        joints.append(replace(worst_poses_table(m.test.validation.shares), caption="Worst poses"))
    explained = (
        *captioned(fit_words.parameters(m.fit), "Parameters with standard uncertainties"),
        *captioned(fit_words.remarks(m.fit)),
        Chart("Correlations", charts.correlations(m.fit), wide=True, height=0),
    )
    scalings = fit_words.scalings_table(m.scalings) if len(m.scalings) > 1 else ()
    by_scaling = captioned(scalings, "The same model with each scaling")
    for name, title, parts in (
        ("joints", "Over each joint", joints),
        ("rejected", "Rejected suspects", _rejected(m)),
        ("all", "Parameters and what they mean", explained),
        ("scalings", "Scaling none, gu and gc", by_scaling),
        ("planned", "As planned and as reached", _planned(m)),
        ("provenance", "Provenance", _provenance(m)),
    ):
        if blocks := tuple(parts):
            yield PageSection(name, f"Appendix: {title}", blocks)


def _rejected(m: ReportContent) -> Iterator[Block]:
    d = m.diagnosis
    if d is None:
        return
    if len(d.suspects) > MOST_LISTED:
        yield _suspects_table(d.suspects[MOST_LISTED:], "Other suspects")
    rejected = [s for s in d.suspects if not s.passes and s.plausible and s.share >= LEAST_SHARE]
    yield from _added_variables(d, rejected)
    yield from captioned(detectable_sizes(d), "Detectable sizes")


def _planned(m: ReportContent) -> Iterator[Block]:
    predicted = None if m.plan is None else m.plan.about.get("predicted_std")
    if not isinstance(predicted, dict):
        return
    out = table("parameter", "planned", "reached", caption="Standard uncertainties")
    for p in m.fit.parameters:
        planned = predicted.get(p.name)
        if p.std is not None and isinstance(planned, int | float):
            out.add(p.name, *(numbers.sizes([(p.unit, float(s))]) for s in (planned, p.std)))
    if out.rows:
        yield out


def _provenance(m: ReportContent) -> Iterator[Block]:
    o = m.overview
    heads = ("revision", "made (UTC)", "hilcal", "SHA-256 of its readings")
    rows = [(str(r.number), utc(r.created), r.program_version, r.data_hash) for r in o.revisions]
    yield table(*heads, rows=rows, caption="Revisions by time and program")
    typed = [("the campaign", o.command or NOT_STORED)]
    typed += [
        (f"revision {r.number}", str(r.options.get(COMMAND, NOT_STORED))) for r in o.revisions
    ]
    yield table("made", "by", rows=typed, caption="Commands as they were typed")
    yield heading("Commands that show the same")
    yield from (Words(c, "code") for c in m.commands)
    info = info_report(o, m.name, covariance_words(m.covariance))
    yield from captioned(info, "The campaign file")
