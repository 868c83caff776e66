"""The sections after the certificate, and the appendix, which only another expert asks for."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from hilcal import numbers
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.effect_ranking import LEAST_SHARE, Suspect
from hilcal.diagnosis.noise import classes
from hilcal.identification.family_sizes import family_sizes
from hilcal.present.campaign import info_report
from hilcal.present.charts import evidence, readings
from hilcal.present.charts.comparisons import error_per_revision, made_of
from hilcal.present.diagnosis import REVISION_HEADS, could_have_been_seen, doubtful, redundant_line
from hilcal.present.document import (
    Block,
    Chart,
    PageSection,
    Table,
    Words,
    captioned,
    heading,
    note,
    table,
)
from hilcal.present.fit import background_line, parameters, remarks, scalings_table, where_table
from hilcal.present.html.certificate import ReportContent, certificate, first_screen, utc
from hilcal.present.html.page import render
from hilcal.present.registration import covariance_words
from hilcal.present.story import curve, laws, regressor
from hilcal.present.validation import worst_table
from hilcal.present.verdict import message
from hilcal.store.command_line import COMMAND

MOST_CURVES = 2
MOST_LISTED = 6
"""Suspects that stand on the page; a choice, as the others are."""
MOST_PARAMETERS = 48
MOST_LAWS = 4


def page(m: ReportContent) -> str:
    """Return the report of one campaign as HTML."""
    about = f"{m.overview.config.robot.model}, {m.name}, {m.made[:10]}"
    parts = (certificate(m), *sections(m), *(appendix(m) if m.appendix else ()))
    return render("Calibration report", about, first_screen(m), parts)


def sections(m: ReportContent) -> tuple[PageSection, ...]:
    """Return all sections after the certificate."""
    found = (_revisions(m), _where(m), _evidence(m), _laws(m), _parameters(m))
    return tuple(s for s in found if s is not None)


def _where(m: ReportContent) -> PageSection:
    story, last, d = m.story, m.left_out, m.diagnosis
    parts: list[Block] = [
        "Errors are those of poses left out: each is predicted by a fit to the others."
        + (" Readings set aside as gross errors are drawn, too." * bool(m.fit.outlier.any())),
        Chart("By pose", readings.residual_by_pose(story, last), wide=True),
        Chart("Measured against predicted", readings.measured_predicted(story, last)),
    ]
    if len(set(story.load_names)) > 1:
        parts.append(Chart("By load", readings.residual_by_load(story, last)))
    if story.time_s is not None:
        parts.append(Chart("Over time", readings.residual_by_time(story, last)))
    parts += [
        Chart("From above", readings.workspace(story, last, "xy")),
        Chart("From the side", readings.workspace(story, last, "xz")),
        Chart("Noise check: fitted poses", evidence.noise_check(m.fit)),
    ]
    if d is not None:
        if d.verdict != "adequate":
            curves = [curve(v) for v in d.dependences if v.determined][:MOST_CURVES]
            parts += [Chart(c.title, evidence.curve_chart(c)) for c in curves]
        told = captioned(where_table(d.misfit_breakdown), "What the error follows")
        parts += [replace(p, narrow=True) if isinstance(p, Table) else p for p in told]
    parts.append(_noise(m))
    return PageSection("where", "Where it fails", tuple(parts))


def _evidence(m: ReportContent) -> PageSection:
    d, title = m.diagnosis, "What is missing, with its evidence"
    if d is None:
        said = "Not diagnosed: only a model fitted with scaling gc can be."
        return PageSection("evidence", title, (said,))
    parts: list[Block] = []
    if d.verdict == "adequate":  # else the first screen has it
        parts.append(numbers.sentence(message(d)))
    parts.append(suspects_table(d.suspects[:MOST_LISTED], "Suspects, best first"))
    parts += [*doubtful(d), *redundant_line(d)]
    parts += added_variables(d, [s for s in d.suspects if s.passes][:MOST_CURVES])
    return PageSection("evidence", title, tuple(parts))


def added_variables(d: Diagnosis, of: Sequence[Suspect]) -> Iterator[Chart]:
    """Yield the added-variable plot of each suspect that has one."""
    for s in of:
        found = regressor(d.fit, s)
        if found is not None:
            yield Chart(f"Added variable: {s.effect}", evidence.added_variable(found, s.effect))


def _laws(m: ReportContent) -> PageSection | None:
    found = laws(m.fit)
    if not found:
        return None
    parts: list[Block] = []
    for name, facts in {one.title: one.facts for one in found}.items():
        parts.append(table("", "", rows=facts, caption=f"{name}, an effect of a file"))
    parts += [
        Chart(f"{one.title}: {one.y_label}", evidence.curve_chart(one)) for one in found[:MOST_LAWS]
    ]
    parts.append(
        note(
            "Each point is the mean over readings of the law's value plus what it leaves of them. "
            "Nothing is known outside of the range that is drawn, nor within its gaps.",
        )
    )
    return PageSection("laws", "Laws beyond the catalogue", tuple(parts))


def suspects_table(rows: Sequence[Suspect], caption: str) -> Table:
    """Return a table of suspects."""
    heads = ("effect", "explains", "on poses left out", "log evidence", "p-value", "passes")
    cells = (
        (
            *(s.effect, numbers.percent(s.share), numbers.percent(max(s.holdout_share, 0.0))),
            *(f"{s.score.log_evidence:z.1f}", numbers.chance(s.score.p_value)),
            *("yes" if s.passes else "no", ", ".join(s.same_as) or "-"),
        )
        for s in rows
    )
    return table(*heads, "not separable from", caption=caption, rows=cells)


def _revisions(m: ReportContent) -> PageSection:
    parts: list[Block] = [
        Chart("Error per revision", error_per_revision(m.story), wide=True, height=0),
        table(*REVISION_HEADS, rows=(r.cells for r in m.story.revisions), caption="Revisions"),
    ]
    if not m.stored:
        parts.append(
            "No revision is stored in the campaign: the baseline was fitted for this report "
            "and is not kept. hilcal refine finds the effects that are missing."
        )
    return PageSection("revisions", "How the error fell", tuple(parts))


def _parameters(m: ReportContent) -> PageSection:
    fit = m.fit
    parts: list[Block] = []
    for name in fit.model.named:
        if name in fit.model.catalogue.names:
            parts.append(note(f"{name}: {fit.model.catalogue[name].summary}."))
    more = "hilcal report --appendix"
    for part in captioned(parameters(fit, MOST_PARAMETERS, more), "Parameters"):
        parts += _halves(part) if isinstance(part, Table) else (part,)
    parts += background_line(fit)
    if sizes := family_sizes(fit):
        parts.append(Chart("What this arm is made of", made_of(sizes), wide=True, height=0))
    return PageSection("parameters", "Parameters", tuple(parts))


def _halves(t: Table) -> Iterator[Table]:
    """Yield the two halves of a table of parameters, without what they mean."""
    middle = -(-len(t.rows) // 2)
    for rows, more in ((t.rows[:middle], ""), (t.rows[middle:], ", continued")):
        if rows:
            cut = [row[:-1] for row in rows]
            caption = f"{t.caption}{more}"
            yield replace(t, caption=caption, heads=t.heads[:-1], rows=cut, narrow=True)


def _noise(m: ReportContent) -> str:
    """Say what the repeats tell of the noise."""
    e = None if m.diagnosis is None else m.diagnosis.pure_error
    if e is not None:
        low, high = e.interval
        return (
            f"Repeated readings scatter {e.factor**0.5:.2f} times as much as stated (variance "
            f"factor {e.factor:.2f}, 95 % interval {low:.2f} to {high:.2f}, {e.dof:.0f} degrees of "
            "freedom)."
        )
    kept = m.fit.readings[~m.fit.outlier]
    again = len(kept) - len(np.unique(classes(kept)))
    if not again:
        return "No reading was repeated: the noise is judged by the model alone."
    what = "deflection" if m.fit.mode == "deflection" else "reading"
    return (
        f"{again} of {len(kept)} readings repeat an earlier one, too few to judge the noise of a "
        f"{what} by them: the model alone does."
    )


NOT_KEPT = "not kept: made by a program of one's own, at the workbench, or before hilcal kept it"


def appendix(m: ReportContent) -> tuple[PageSection, ...]:
    """Return the sections of the appendix."""
    found = {
        "joints": ("Over each joint", _joints(m)),
        "rejected": ("Rejected suspects", _rejected(m)),
        "all": ("Parameters and what they mean", _all_parameters(m)),
        "scalings": ("Scaling none, gu and gc", _scalings(m)),
        "planned": ("As planned and as reached", _planned(m)),
        "provenance": ("Provenance", _provenance(m)),
    }
    told = ((name, title, tuple(parts)) for name, (title, parts) in found.items())
    return tuple(
        PageSection(name, f"Appendix: {title}", parts) for name, title, parts in told if parts
    )


def _joints(m: ReportContent) -> Iterator[Block]:
    for j in range(m.story.arm.n):
        yield Chart(f"Over joint {j + 1}", readings.residual_by_joint(m.story, m.left_out, j))
    if m.tested is not None:
        yield replace(worst_table(m.tested.found.shares), caption="Worst poses")


def _rejected(m: ReportContent) -> Iterator[Block]:
    d = m.diagnosis
    if d is None:
        return
    if len(d.suspects) > MOST_LISTED:
        yield suspects_table(d.suspects[MOST_LISTED:], "Other suspects")
    rejected = [s for s in d.suspects if not s.passes and s.plausible and s.share >= LEAST_SHARE]
    yield from added_variables(d, rejected)
    yield from captioned(could_have_been_seen(d), "What could have been seen")


def _all_parameters(m: ReportContent) -> Iterator[Block]:
    yield from captioned(parameters(m.fit), "Parameters with standard uncertainties")
    yield from captioned(remarks(m.fit))
    yield Chart("Correlations", evidence.correlations(m.fit), wide=True, height=0)


def _scalings(m: ReportContent) -> Iterator[Block]:
    if len(m.scalings) > 1:
        yield from captioned(scalings_table(m.scalings), "The same model with each scaling")


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
    made = [("the campaign", o.command or NOT_KEPT)]
    made += [(f"revision {r.number}", str(r.options.get(COMMAND, NOT_KEPT))) for r in o.revisions]
    yield table("made", "by", rows=made, caption="Commands as they were typed")
    yield heading("Commands that show the same")
    yield from (Words(c, "code") for c in m.commands)
    yield from captioned(
        info_report(o, m.name, covariance_words(m.covariance)), "The campaign file"
    )
