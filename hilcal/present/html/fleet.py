"""The page of a fleet."""

from typing import TYPE_CHECKING

from hilcal import numbers
from hilcal.present.charts.fleet import arms_chart
from hilcal.present.document import (
    Block,
    Chart,
    Section,
    captioned,
    table,
)
from hilcal.present.fleet import closing, type_report, unlike_words
from hilcal.present.html.first_screen import Card, FirstScreen
from hilcal.present.html.page import render

if TYPE_CHECKING:  # above this layer
    from hilcal.transfer.fleet import Fleet


def page(fleet: "Fleet", directory: str, made: str, version: str) -> str:
    """Return a fleet as HTML.

    Args:
        fleet: the fleet.
        directory: that its campaigns are in.
        made: when the page was made, ISO 8601, UTC.
        version: of the program.
    """
    sections = []
    for k, t in enumerate(fleet.types):
        drawn: tuple[Block, ...] = (Chart("Arms of the type", arms_chart(t), wide=True, height=0),)
        told = captioned(list(type_report(t))[1:], f"Parameters of the {t.type}")
        sections.append(Section(f"type{k}", f"{t.type}: {len(t.arms)} arms", drawn + told))
    rows = [(m.name, m.arm, m.date[:10], m.verdict, numbers.length(m.rms_m)) for m in fleet.members]
    heads = ("campaign", "arm", "date", "verdict", "rms on poses left out")
    sections.append(
        Section(
            "campaigns",
            "Campaigns",
            (table(*heads, rows=rows, caption="Campaigns"), *closing(fleet)),
        )
    )
    about = f"{directory}, {made[:10]}, hilcal {version}"
    return render("A fleet of arms", about, _first(fleet), tuple(sections))


def _first(fleet: "Fleet") -> FirstScreen:
    odd = [o for t in fleet.types for o in t.odd]
    arms = list(dict.fromkeys(o.arm for o in odd))
    wear = [name for t in fleet.types for name in t.wear]
    headline = f"Unlike their type: {numbers.names(arms)}" if arms else "No arm is unlike its type"
    cards = (
        Card("Arms", str(sum(len(t.arms) for t in fleet.types)), "that were pooled"),
        Card("Campaigns", str(len(fleet.members)), f"used; not used: {len(fleet.failures)}"),
    )
    answers = (
        ("Which arms are unlike, and by how much?", "; ".join(map(unlike_words, odd)) or "None."),
        ("What wears?", ", ".join(wear) or "No drift that the arms have in common."),
        (
            "What to do?",
            "Measure these arms again, and look at these joints."
            if arms
            else "Nothing; the prior serves the next arm.",
        ),
    )
    return FirstScreen(headline, "bad" if arms else "good", answers, cards, "", None)
