"""The pages that compare two campaigns of one arm, or the arms of a fleet."""

from typing import TYPE_CHECKING

from hilcal import numbers
from hilcal.diagnosis.change import LEVEL
from hilcal.diagnosis.comparison import Comparison
from hilcal.names import quoted
from hilcal.present.campaign import utc
from hilcal.present.charts import arms_chart, changes_chart, error_by_pose
from hilcal.present.comparison import (
    closing,
    comparison_report,
    headline,
    next_step,
    sentence,
    type_report,
    unlike_words,
)
from hilcal.present.document import Block, Chart, PageSection, Words, captioned, heading, table
from hilcal.present.html import Card, FirstScreen, render
from hilcal.present.html.report import identity

if TYPE_CHECKING:
    from hilcal.transfer.fleet import Fleet

Named = tuple[str, str]  # name and SHA-256 of a campaign's file


def comparison_page(
    c: Comparison, files: tuple[Named, Named], operator: str, made: str, version: str
) -> str:
    """Return the comparison of an earlier and a later file as HTML; `made` is an ISO 8601 time."""
    (earlier, _), (later, _) = files
    arm = c.fit.model.cell.arm.name
    charts: list[Block] = [Chart("Error today, by pose", error_by_pose(c), wide=True, height=0)]
    if c.changes.found:
        charts.append(Chart("What each change moves", changes_chart(c), wide=True, height=0))
    shas = [(which, *file) for which, file in zip(("earlier", "later"), files, strict=True)]
    provenance = (
        table("campaign", "name", "SHA-256", rows=shas, caption="Files"),
        identity(
            ("Robot", arm),
            ("Operator", operator or "not stated"),
            ("Report made", f"{utc(made)} UTC by hilcal {version}"),
        ),
        heading("Commands that show the same"),
        Words(f"hilcal compare {quoted(earlier)} {quoted(later)}", "code"),
    )
    sections = (
        PageSection("changes", "What has changed", tuple(comparison_report(c, earlier, later))),
        PageSection("today", "The earlier calibration today", tuple(charts)),
        PageSection("provenance", "Provenance", provenance),
    )
    about = f"{arm}, {earlier} and {later}, {made[:10]}"
    return render("Comparison of two campaigns", about, comparison_screen(c, earlier), sections)


def comparison_screen(c: Comparison, earlier: str) -> FirstScreen:
    """Return what the first screen says."""
    found, t, error = c.changes, c.today, c.today.prediction.error
    beyond = "more" if t.p_value < LEVEL else "no more"
    good = (
        f"The calibration of {earlier} is off by {numbers.length(error.rms_m)} rms today, "
        f"{numbers.digits(t.z, 2)} times what it states: {beyond} than its uncertainty."
    )
    largest = f"rms; largest {numbers.length(error.max_m)}"
    cards = [
        Card("Error today", numbers.length(error.rms_m), largest),
        Card("Expected", numbers.length(t.stated_m), "rms that the calibration states"),
    ]
    if t.drawing_m is not None:
        cards.append(Card("Uncalibrated", numbers.length(t.drawing_m), "rms of the arm as drawn"))
    answers = (
        ("Is the calibration still good?", good),
        ("What has changed?", " ".join(map(sentence, found.found)) or f"{headline(c)}."),
        ("What to do?", numbers.sentence(next_step(c, earlier))),
    )
    tone = "good" if not found.found and found.explained else "bad"
    return FirstScreen(headline(c), tone, answers, tuple(cards))


def fleet_page(fleet: "Fleet", directory: str, made: str, version: str) -> str:
    """Return a fleet of campaigns in a directory as HTML; `made` is an ISO 8601 time, UTC."""
    sections = []
    for k, t in enumerate(fleet.types):
        drawn: tuple[Block, ...] = (Chart("Arms of the type", arms_chart(t), wide=True, height=0),)
        report = captioned(list(type_report(t))[1:], f"Parameters of the {t.type}")
        sections.append(PageSection(f"type{k}", f"{t.type}: {len(t.arms)} arms", drawn + report))
    rows = [(m.name, m.arm, m.date[:10], m.verdict, numbers.length(m.rms_m)) for m in fleet.members]
    heads = ("campaign", "arm", "date", "verdict", "rms on poses left out")
    campaigns = table(*heads, rows=rows, caption="Campaigns")
    sections.append(PageSection("campaigns", "Campaigns", (campaigns, *closing(fleet))))
    about = f"{directory}, {made[:10]}, hilcal {version}"
    return render("A fleet of arms", about, _fleet_screen(fleet), tuple(sections))


def _fleet_screen(fleet: "Fleet") -> FirstScreen:
    odd = [o for t in fleet.types for o in t.odd]
    arms = list(dict.fromkeys(o.arm for o in odd))
    wear = ", ".join(name for t in fleet.types for name in t.wear)
    headline, todo = "No arm is unlike its type", "Nothing; the prior serves the next arm."
    if arms:
        headline = f"Unlike their type: {numbers.names(arms)}"
        todo = "Measure these arms again, and look at these joints."
    cards = (
        Card("Arms", str(sum(len(t.arms) for t in fleet.types)), "that were pooled"),
        Card("Campaigns", str(len(fleet.members)), f"used; not used: {len(fleet.failures)}"),
    )
    answers = (
        ("Which arms are unlike, and by how much?", "; ".join(map(unlike_words, odd)) or "None."),
        ("What wears?", wear or "No drift that the arms have in common."),
        ("What to do?", todo),
    )
    return FirstScreen(headline, "bad" if arms else "good", answers, cards)
