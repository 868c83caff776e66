"""The appendix: what only another expert asks for; off by default."""

from collections.abc import Iterator
from dataclasses import replace

from hilcal import numbers
from hilcal.diagnosis.effect_ranking import LEAST_SHARE
from hilcal.present.campaign import info_report
from hilcal.present.charts.correlations import correlations
from hilcal.present.charts.residuals import residual_by_joint
from hilcal.present.diagnosis import could_have_been_seen
from hilcal.present.document import (
    Block,
    Chart,
    Section,
    Words,
    captioned,
    heading,
    table,
)
from hilcal.present.fit import parameters, remarks, scalings_table
from hilcal.present.html.content import ReportContent
from hilcal.present.html.sections import MOST_LISTED, added_variables, suspects_table
from hilcal.present.registration import covariance_words
from hilcal.present.validation import worst_table
from hilcal.store.command_line import COMMAND

NOT_KEPT = "not kept: made by a program of one's own, at the workbench, or before hilcal kept it"


def appendix(m: ReportContent) -> tuple[Section, ...]:
    """Return the sections of the appendix."""
    found = {
        "joints": ("Over each joint", _joints(m)),
        "rejected": ("Rejected suspects", _rejected(m)),
        "all": ("Parameters and what they mean", _parameters(m)),
        "scalings": ("Scaling none, gu and gc", _scalings(m)),
        "planned": ("As planned and as reached", _planned(m)),
        "provenance": ("Provenance", _provenance(m)),
    }
    told = ((name, title, tuple(parts)) for name, (title, parts) in found.items())
    return tuple(Section(name, f"Appendix: {title}", parts) for name, title, parts in told if parts)


def _joints(m: ReportContent) -> Iterator[Block]:
    for j in range(m.story.arm.n):
        yield Chart(f"Over joint {j + 1}", residual_by_joint(m.story, m.left_out, j))
    if m.tested is not None:
        yield replace(worst_table(m.tested.shares), caption="Worst poses")


def _rejected(m: ReportContent) -> Iterator[Block]:
    d = m.diagnosis
    if d is None:
        return
    if len(d.suspects) > MOST_LISTED:
        yield suspects_table(d.suspects[MOST_LISTED:], "Other suspects")
    rejected = [s for s in d.suspects if not s.passes and s.plausible and s.share >= LEAST_SHARE]
    yield from added_variables(d, rejected)
    yield from captioned(could_have_been_seen(d), "What could have been seen")


def _parameters(m: ReportContent) -> Iterator[Block]:
    yield from captioned(parameters(m.fit), "Parameters with standard uncertainties")
    yield from captioned(remarks(m.fit))
    yield Chart("Correlations", correlations(m.fit), wide=True, height=0)


def _scalings(m: ReportContent) -> Iterator[Block]:
    if len(m.scalings) > 1:
        yield from captioned(scalings_table(m.scalings), "The same model with each scaling")


def _planned(m: ReportContent) -> Iterator[Block]:
    predicted = None if m.plan is None else m.plan.about.get("predicted_std")
    if not isinstance(predicted, dict):
        return
    reached = {p.name: p for p in m.fit.parameters if p.std is not None}
    rows = [
        (n, numbers.sizes([(reached[n].unit, s)]),
         numbers.sizes([(reached[n].unit, float(reached[n].std or 0.0))]))
        for n, s in predicted.items() if isinstance(s, int | float) and n in reached
    ]  # fmt: skip
    if rows:
        heads = ("parameter", "planned", "reached")
        yield table(*heads, rows=rows, caption="Standard uncertainties")


def _provenance(m: ReportContent) -> Iterator[Block]:
    o = m.overview
    yield table(
        *("revision", "made (UTC)", "hilcal", "SHA-256 of its readings"),
        rows=(
            (str(r.number), r.created[:19].replace("T", " "), r.program_version, r.data_hash)
            for r in o.revisions
        ),
        caption="Revisions by time and program",
    )
    made = [("the campaign", o.command or NOT_KEPT)]
    made += [(f"revision {r.number}", str(r.options.get(COMMAND, NOT_KEPT))) for r in o.revisions]
    yield table("made", "by", rows=made, caption="Commands as they were typed")
    yield heading("Commands that show the same")
    yield from (Words(c, "code") for c in m.commands)
    yield from captioned(
        info_report(o, m.name, covariance_words(m.covariance)), "The campaign file"
    )
