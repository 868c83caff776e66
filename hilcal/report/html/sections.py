"""The pages after the certificate: each a section of charts, tables and the words of commands."""

from collections.abc import Iterator, Sequence

import numpy as np

from hilcal.data.command_line import COMMAND
from hilcal.diagnose.diagnosis import Diagnosis
from hilcal.diagnose.effect_ranking import Suspect
from hilcal.diagnose.repeats import classes
from hilcal.identify.fit import Fit
from hilcal.identify.full_prediction import full_prediction
from hilcal.report import numbers, text
from hilcal.report.build_story import curve, regressor
from hilcal.report.charts.added_variable import added_variable
from hilcal.report.charts.error_per_revision import error_per_revision
from hilcal.report.charts.law import law
from hilcal.report.charts.measured_predicted import measured_predicted
from hilcal.report.charts.misfit import misfit_curve, misfit_shares
from hilcal.report.charts.noise_check import noise_check
from hilcal.report.charts.parameters import correlations, identifiability, parameters
from hilcal.report.charts.residuals import (
    residual_by_joint,
    residual_by_load,
    residual_by_pose,
    residual_by_time,
)
from hilcal.report.charts.scalings import scalings
from hilcal.report.charts.suspects import evidence, suspects
from hilcal.report.charts.workspace import workspace
from hilcal.report.covariance_words import covariance_words
from hilcal.report.html.content import ReportContent
from hilcal.report.html.parts import Part, Section, Table, Words, chart, from_terminal, table
from hilcal.report.text_info import info_report, revisions_table
from hilcal.report.text_prior import prior_lines
from hilcal.report.text_scalings import scalings_table
from hilcal.report.text_seen import could_have_been_seen, doubtful, redundant_line

MOST_SUSPECTS = 4
"""Suspects whose added-variable plot is not folded away; a choice."""
MOST_CURVES = 6
NOT_KEPT = "not kept: made by a program of one's own, at the workbench, or before hilcal kept it"
MOST_LISTED = 8
"""Suspects that are not folded away; a choice."""


def sections(m: ReportContent) -> tuple[Section, ...]:
    """Return all sections after the certificate."""
    found = (
        _measured(m),
        _where(m),
        _evidence(m),
        _laws(m),
        _revisions(m),
        _parameters(m),
        _noise(m),
        _scalings(m),
        _plan(m),
        _provenance(m),
    )
    return tuple(s for s in found if s is not None)


def _measured(m: ReportContent) -> Section:
    last = m.story.revisions[-1]
    return Section(
        "measured",
        "Measured against predicted",
        (
            Words(text.misses(m.fit)),
            chart("Measured against predicted", measured_predicted(m.story, last), wide=True),
        ),
    )


def _where(m: ReportContent) -> Section:
    story, last, d = m.story, m.story.revisions[-1], m.diagnosis
    parts: list[Part] = []
    if d is not None:
        parts += [Words(text.follows(d.misfit_breakdown))]
    parts += [
        chart("By pose", residual_by_pose(story, last), wide=True),
        chart("By load", residual_by_load(story, last)),
        chart("Over time", residual_by_time(story, last)),
        chart("Over the workspace", workspace(story, last), wide=True),
    ]
    if d is not None:
        parts.append(chart("What the misfit follows", misfit_shares(d)))
        parts += from_terminal(text.where_table(d.misfit_breakdown), "Where the model fails")
        if d.verdict != "adequate":
            curves = [curve(v) for v in d.dependences if v.determined][:MOST_CURVES]
            parts += [chart(c.variable, misfit_curve(c)) for c in curves]
    worst = text.worst_poses(full_prediction(m.fit))
    parts += from_terminal([text.worst_table(worst)], "Worst poses")
    joints = tuple(
        chart(f"Over joint {j + 1}", residual_by_joint(story, last, j)) for j in range(story.arm.n)
    )
    return Section("where", "Where it fails", tuple(parts), joints)


def _evidence(m: ReportContent) -> Section:
    d = m.diagnosis
    if d is None:
        words = Words("Not diagnosed: only a model fitted with scaling gc can be.")
        return Section("evidence", "What is missing, with its evidence", (words,))
    parts: list[Part] = [Words(m.story.revisions[-1].message)]
    parts += [chart("Suspects: share of the misfit", suspects(d)), chart("Evidence", evidence(d))]
    parts.append(_suspects(d.suspects[:MOST_LISTED], "Suspects, best first"))
    parts += from_terminal([*doubtful(d), *redundant_line(d)])
    tested = [s for s in d.suspects if s.score.rank > 0 and s.plausible]
    strong = [s for s in tested if s.explains or s.score.p_value < text.CERTAIN]
    shown = strong[:MOST_SUSPECTS] or tested[:1]
    parts += _added_variables(d, shown)
    details: list[Part] = [
        *_added_variables(d, [s for s in tested if all(s is not other for other in shown)])
    ]
    if len(d.suspects) > MOST_LISTED:
        details.append(_suspects(d.suspects[MOST_LISTED:], "Other suspects"))
    details += from_terminal(could_have_been_seen(d), "What could have been seen")
    return Section("evidence", "What is missing, with its evidence", tuple(parts), tuple(details))


def _added_variables(d: Diagnosis, of: Sequence[Suspect]) -> Iterator[Part]:
    for s in of:
        found = regressor(d.fit, s)
        if found is not None:
            yield chart(f"Added variable: {s.effect}", added_variable(found, s.effect))


def _laws(m: ReportContent) -> Section | None:
    found = m.story.revisions[-1].laws
    if not found:
        return None
    parts: list[Part] = []
    for name in dict.fromkeys(one.name for one in found):
        curves = [one for one in found if one.name == name]
        first = curves[0]
        parts.append(
            table(
                f"{name}, an effect of a file",
                ("", ""),
                (
                    ("law", first.formula),
                    ("acts on", first.acts_on),
                    ("coefficients", first.coefficients),
                ),
            )
        )
        parts += [chart(f"{name}: {one.y_label}", law(one), wide=True) for one in curves]
    parts.append(
        Words(
            "Each point is the mean over readings of the law's value plus what it leaves of them. "
            "Nothing is known outside of the range that is drawn, nor within its gaps.",
            "note",
        )
    )
    return Section("laws", "Laws beyond the catalogue", tuple(parts))


def _suspects(rows: Sequence[Suspect], caption: str) -> Table:
    heads = ("effect", "explains", "on poses left out", "log evidence", "p-value", "passes")
    return table(
        caption,
        (*heads, "not separable from"),
        (
            (
                s.effect,
                numbers.percent(s.share),
                numbers.percent(max(s.holdout_share, 0.0)),
                f"{s.score.log_evidence:z.1f}",
                numbers.chance(s.score.p_value),
                "yes" if s.passes else "no",
                ", ".join(s.same_as) or "-",
            )
            for s in rows
        ),
    )


def _revisions(m: ReportContent) -> Section:
    parts: list[Part] = [
        chart("Error per revision", error_per_revision(m.story), wide=True),
        table(
            "Revisions",
            ("revision", "change", "fitted, rms", "left out, rms", "left out, σ",
             "variance factor", "verdict"),
            (
                (
                    str(r.revision),
                    r.change or text.model_name(r.model),
                    numbers.length(r.error_fit["rms_m"]),
                    numbers.length(r.error_holdout["rms_m"]),
                    f"{r.error_holdout['rms_sigma']:.2f}",
                    numbers.digits(r.variance_factor),
                    r.verdict.replace("_", " "),
                )
                for r in m.story.revisions
            ),
        ),
    ]  # fmt: skip
    if not m.stored:
        parts.append(
            Words(
                "No revision is stored in the campaign: the baseline was fitted for this report "
                "and is not kept. hilcal refine finds the effects that are missing."
            )
        )
    return Section("revisions", "How the error fell", tuple(parts))


def _parameters(m: ReportContent) -> Section:
    fit = m.fit
    parts: list[Part] = [*from_terminal(prior_lines(fit))]
    parts += [
        chart("Parameters", parameters(m.story.revisions[-1])),
        chart("Identifiability", identifiability(fit)),
        chart("Correlations", correlations(fit), wide=True),
    ]
    details = from_terminal(text.parameters(fit), "Parameters with standard uncertainties")
    details += from_terminal(text.remarks(fit))
    return Section("parameters", "Parameters", tuple(parts), details)


def _noise(m: ReportContent) -> Section:
    d = m.diagnosis
    parts: list[Part] = [chart("Whitened residuals", noise_check(m.fit), wide=True)]
    if d is not None:
        e = d.pure_error
        if e is None:
            parts.append(Words(_too_few_repeats(m.fit)))
        else:
            low, high = e.interval
            parts.append(
                Words(
                    f"Repeated readings scatter {e.factor**0.5:.2f} times as much as stated "
                    f"(variance factor {e.factor:.2f}, 95 % interval {low:.2f} to {high:.2f}, "
                    f"{e.dof:.0f} degrees of freedom)."
                )
            )
    return Section("noise", "Noise check", tuple(parts))


def _too_few_repeats(fit: Fit) -> str:
    """Say that repeats do not judge the noise of what was fitted."""
    kept = fit.readings[~fit.outlier]
    again = len(kept) - len(np.unique(classes(kept)))
    if not again:
        return "No reading was repeated: the noise is judged by the model alone."
    what = "deflection" if fit.mode == "deflection" else "reading"
    return (
        f"{again} of {len(kept)} readings repeat an earlier one, too few to judge the noise of a "
        f"{what} by them: the model alone does."
    )


def _scalings(m: ReportContent) -> Section | None:
    if len(m.scalings) < 2:
        return None
    parts: list[Part] = [chart("Scaling none, gu, gc", scalings(m.scalings), wide=True)]
    details = from_terminal(scalings_table(m.scalings), "The same model with each scaling")
    return Section("scalings", "Scaling none, gu and gc", tuple(parts), details)


def _plan(m: ReportContent) -> Section:
    title = "The plan and its certificate"
    if m.plan is None:
        words = "The readings were imported; the file holds no plan, so nothing proves the choice."
        return Section("plan", title, (Words(words),))
    about = m.plan.about
    return Section("plan", title, tuple(_plan_parts(m, about)))


def _plan_parts(m: ReportContent, about: dict[str, object]) -> Iterator[Part]:
    plan = m.plan
    if plan is None:
        return
    rows = [
        ("poses", str(len(plan.pose_names))),
        ("readings", str(len(plan.steps))),
        ("loads", ", ".join(plan.loads)),
    ]
    efficiency = about.get("efficiency")
    if isinstance(efficiency, int | float):
        yield Words(
            f"This choice of poses and loads is at least {100 * efficiency:.0f} % as informative "
            f"as the best possible one, by criterion {about.get('criterion', '-')}: a bound that "
            "the general equivalence theorem proves."
        )
        rows.append(("certified efficiency", f"≥ {100 * efficiency:.1f} %"))
        rows.append(("criterion", str(about.get("criterion", "-"))))
    std = about.get("position_std_m")
    if isinstance(std, int | float):
        rows.append(("predicted standard deviation of the position", numbers.length(std)))
    yield table("The plan", ("", ""), rows)
    predicted = about.get("predicted_std")
    if isinstance(predicted, dict):
        reached = {p.name: p for p in m.fit.parameters}
        told = [
            (n, float(s), reached[n])
            for n, s in predicted.items()
            if isinstance(s, int | float) and n in reached and reached[n].std is not None
        ]
        if told:
            yield table(
                "Standard uncertainties as planned and as reached",
                ("parameter", "planned", "reached"),
                (
                    (n, numbers.sizes([(p.unit, s)]), numbers.sizes([(p.unit, float(p.std or 0))]))
                    for n, s, p in told
                ),
            )


def _commands(m: ReportContent) -> Iterator[Part]:
    """The commands as they were typed."""
    made = [("the campaign", m.overview.command or NOT_KEPT)]
    made += [
        (f"revision {r.number}", str(r.options.get(COMMAND, NOT_KEPT)))
        for r in m.overview.revisions
    ]
    yield table("Commands as they were typed", ("made", "by"), made)


def _provenance(m: ReportContent) -> Section:
    o = m.overview
    rows = [("campaign", m.name, m.sha256)]
    if m.tested is not None:
        rows.append(("validation", m.tested.name, m.tested.sha256))
    parts: list[Part] = [table("Files", ("file", "name", "SHA-256"), rows)]
    if o.revisions:
        parts += from_terminal([revisions_table(o)], "All revisions of the file")
        parts.append(
            table(
                "Revisions by time and program",
                ("revision", "made (UTC)", "hilcal", "SHA-256 of its readings"),
                (
                    (
                        str(r.number),
                        r.created[:19].replace("T", " "),
                        r.program_version,
                        r.data_hash,
                    )
                    for r in o.revisions
                ),
            )
        )
    parts += _commands(m)
    parts.append(Words("Commands that show the same", "heading"))
    parts += [Words(c, "code") for c in m.commands]
    details = from_terminal(
        info_report(o, m.name, covariance_words(m.covariance)), "The campaign file"
    )
    return Section("provenance", "Provenance", tuple(parts), details)
