"""Elements of the page: the status strip, titles, numbers, tables, buttons, charts."""

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
    """The strip that shows the current task and the state of the file."""

    def __init__(self, view: View) -> None:
        """Make an empty strip."""
        with ui.column().classes("strip").style("gap: 0"):
            rows = [ui.row().classes("bench items-center").style("gap: 12px") for _ in range(3)]
        self.busy, self.answered, self.stale = rows
        with self.busy.classes("no-wrap"):
            ui.spinner(size="1.3em")
            self.doing = ui.label().classes("soft").props("aria-live=polite")
        with self.answered:
            self.message = ui.label().classes("answer").props("role=alert data-answer=file")
            self.refit = button(view, "Fit anew to all readings", view.fit_anew, "outline dense")
        with self.stale:
            ui.label("Another command has changed the file.").classes("bad")
            button(view, "Read it again", view.again, "outline dense")
        for row in rows:
            row.set_visibility(False)

    def show(self, work: Work) -> None:
        """Show the current task, or the answer of the last one."""
        line = work.line
        self.busy.set_visibility(bool(line))
        self.doing.set_text(f"{line} …")
        self.answered.set_visibility("file" in work.answers and not line)
        self.refit.set_visibility("readings were appended" in work.failure())


def answer(view: View, place: str) -> None:
    """Draw the label for progress and answer of the buttons above."""
    view.answers[place] = ui.label().classes("answer").props(f"role=status data-answer={place}")


def number(name: str, value: str) -> None:
    """Draw a number with its name."""
    ui.html(f"<b>{plain(value)}</b><span>{plain(name)}</span>", sanitize=False).classes("number")


def title(text: str) -> None:
    """Draw the title of a part."""
    ui.html(f"<h2>{plain(text)}</h2>", sanitize=False)


def soft(text: str) -> ui.label:
    """Draw an explanation."""
    return ui.label(text).classes("soft")


def drawn(table: Table, selection: Literal["single"] | None = None) -> ui.table:
    """Draw a table of a document; the keys of a row are the numbers of the columns."""
    columns = [
        {
            "name": str(k),
            "label": head,
            "field": str(k),
            "align": "left" if k in table.left else "right",
        }
        for k, head in enumerate(table.heads)
    ]
    rows = [
        {"at": i} | {str(k): cell for k, cell in enumerate(row)} for i, row in enumerate(table.rows)
    ]
    element = ui.table(columns=columns, rows=rows, row_key="at", selection=selection)
    return element.props("flat dense").style("width: 100%")


def button(view: View, text: str, act: Callable[[], object], props: str) -> ui.button:
    """Draw a button that is disabled during a task."""
    color = None if "outline" in props or "flat" in props else "primary"
    element = ui.button(text, on_click=act, color=color).props(f"no-caps {props}")
    return element.bind_enabled_from(view.work, "task", backward=lambda task: task is None)


def chart(view: View, figure: go.Figure) -> ui.plotly:
    """Draw a chart in the page's scheme, with its sentence for screen readers."""
    content = style.in_scheme(figure, view.tab.dark).to_plotly_json()
    element = ui.plotly({**content, "config": style.CONFIG}).classes("chart")
    element.props["role"], element.props["aria-label"] = "img", says(figure)
    return element


def point(e: GenericEventArguments) -> dict[str, Any]:
    """Return the clicked point of a chart, as plotly.js describes it."""
    return dict((e.args.get("points") or [{}])[0])


def plain(text: str) -> str:
    """Return a text escaped for HTML."""
    return html.escape(escaped(text))
