"""The small parts that the page is made of: the strip of the status, titles, buttons, charts."""

from __future__ import annotations

import html
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import plotly.graph_objects as go
from nicegui import ui
from nicegui.events import GenericEventArguments

from hilcal.names import escaped
from hilcal.present import charts as style
from hilcal.present.document import Table, says
from hilcal.workbench.work import Work

if TYPE_CHECKING:
    from hilcal.workbench.page import View


class Status:
    """The strip that says what is being done, and what became of the file."""

    def __init__(self, view: View) -> None:
        """Make it, empty."""
        with ui.column().classes("strip").style("gap: 0"):
            rows = [ui.row().classes("bench items-center").style("gap: 12px") for _ in range(3)]
        self.busy, self.answered, self.stale = rows
        with self.busy.classes("no-wrap"):
            ui.spinner(size="1.3em")
            self.doing = ui.label().classes("soft").props("aria-live=polite")
        with self.answered:
            self.told = ui.label().classes("answer").props("role=alert data-answer=file")
            self.refit = button(view, "Fit anew to all readings", view.fit_anew, "outline dense")
        with self.stale:
            ui.label("Another command has changed the file.").classes("bad")
            button(view, "Read it again", view.again, "outline dense")
        for row in rows:
            row.set_visibility(False)

    def show(self, work: Work) -> None:
        """Show how the work stands."""
        line = work.line
        self.busy.set_visibility(bool(line))
        self.doing.set_text(f"{line} …")
        self.answered.set_visibility("file" in work.answers and not line)
        self.refit.set_visibility("readings were appended" in work.failure())


def answer(view: View, place: str) -> None:
    """Draw where it is said what is being done for the buttons above, and what came of it."""
    view.answers[place] = ui.label().classes("answer").props(f"role=status data-answer={place}")


def number(what: str, value: str) -> None:
    """Draw a number with what it is."""
    ui.html(f"<b>{plain(value)}</b><span>{plain(what)}</span>", sanitize=False).classes("number")


def title(words: str) -> None:
    """Draw the title of a part."""
    ui.html(f"<h2>{plain(words)}</h2>", sanitize=False)


def soft(words: str) -> ui.label:
    """Draw words that explain."""
    return ui.label(words).classes("soft")


def drawn(of: Table, selection: Literal["single"] | None = None) -> ui.table:
    """Draw a table of a document; a row has its cells by the number of the column."""
    columns = [
        {
            "name": str(k),
            "label": head,
            "field": str(k),
            "align": "left" if k in of.left else "right",
        }
        for k, head in enumerate(of.heads)
    ]
    rows = [
        {"at": i} | {str(k): cell for k, cell in enumerate(row)} for i, row in enumerate(of.rows)
    ]
    made = ui.table(columns=columns, rows=rows, row_key="at", selection=selection)
    return made.props("flat dense").style("width: 100%")


def button(view: View, words: str, act: Callable[[], object], props: str) -> ui.button:
    """Draw a button that cannot be pressed while something is being done."""
    color = None if "outline" in props or "flat" in props else "primary"
    made = ui.button(words, on_click=act, color=color).props(f"no-caps {props}")
    return made.bind_enabled_from(view.work, "what", backward=lambda what: what is None)


def chart(view: View, figure: go.Figure) -> ui.plotly:
    """Draw a chart in the page's scheme, with its sentence for those who do not see it."""
    dressed = style.in_scheme(figure, view.tab.dark).to_plotly_json()
    shown = ui.plotly({**dressed, "config": style.CONFIG}).classes("chart")
    shown.props["role"], shown.props["aria-label"] = "img", says(figure)
    return shown


def point(e: GenericEventArguments) -> dict[str, Any]:
    """Return the point of a chart that was clicked, as plotly.js describes it."""
    return dict((e.args.get("points") or [{}])[0])


def plain(words: str) -> str:
    """Return words without a meaning in HTML."""
    return html.escape(escaped(words))
