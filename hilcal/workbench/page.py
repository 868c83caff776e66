"""The page: actions of its buttons, and updates of its parts."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from fastapi import FastAPI, Request
from fastapi.responses import PlainTextResponse, Response
from nicegui import app as nicegui_app
from nicegui import ui

from hilcal import numbers
from hilcal.present.campaign import refitted
from hilcal.present.diagnosis import change_lines
from hilcal.present.progress import Say
from hilcal.workbench import cards
from hilcal.workbench.session import Answer, Snapshot, WorkbenchSession

TICK, LOOK = 0.2, 2.0  # intervals at which a tab checks the session and the file for changes, s
CSS = Path(__file__).with_name("page.css")
SCRIPT = Path(__file__).with_name("page.js")
DARK = "matchMedia('(prefers-color-scheme: dark)').matches"


@dataclass
class Tab:
    """State of one browser tab; it is not stored."""

    snapshot: Snapshot | None = None  # that the other fields refer to
    suspect: str | None = None  # the missing effect whose evidence is shown
    variable: str | None = None  # over which residuals are drawn; None for the pose
    selected: list[int] | None = None  # selected measurements of the story
    selected_title: str = ""  # their description
    dark: bool = False  # whether the browser prefers a dark page
    texts: dict[tuple[str, str], str] = field(default_factory=dict)
    """Values of the cell by section and key that were typed and not used yet."""
    pair: tuple[int, int] | None = None  # the two revisions that are shown side by side
    viewer_requested: bool = False
    viewer: str = ""  # address of the 3-D view; empty before it was opened


def install(app: FastAPI, session: WorkbenchSession) -> None:
    """Add page and 3-D viewer to an application, and start to read the file."""

    @app.get("/viewer/{name:path}")
    def viewer(name: str) -> Response:
        file = session.viewer.file(name)
        if file is None:
            return PlainTextResponse("nothing here\n", status_code=404)
        content, kind = file
        return Response(content, media_type=kind, headers={"rerun-final-length": str(len(content))})

    @ui.page("/")
    async def page(request: Request) -> None:
        view = View(session, str(request.base_url))
        view.build()
        ui.on("scheme", lambda e: view.draw_page(dark=bool(e.args)))
        await ui.context.client.connected()
        view.draw_page(dark=bool(await ui.run_javascript(DARK, timeout=5.0)))

    nicegui_app.on_startup(lambda: read_file(session))


def read_file(session: WorkbenchSession) -> None:
    """Start to read the file."""
    name = session.path.name

    def read(say: Say) -> str:
        again = session.snapshot is not None
        session.load(say)
        return f"{name} was read again." if again else ""

    session.work.start(f"Reading {name}", read)


class View:
    """One tab of the page."""

    def __init__(self, session: WorkbenchSession, address: str) -> None:
        """Create an empty tab; `address` is this server's, as the browser calls it."""
        self.session, self.work = session, session.work
        self.address, self.tab = address, Tab()
        self.places: dict[str, ui.column] = {}  # of the parts in `REDRAWN`
        self.adder: ui.button | None = None
        self.answers: dict[str, ui.label] = {}
        self._drawn, self._ready = (-1, False), False
        self._file: tuple[str, bytes] | None = None
        self._planned: object = None

    def build(self) -> None:
        """Create the permanent parts and the timers that check for changes."""
        ui.colors(primary="#1f6f9f", positive="#00785a", negative="#c0274b", warning="#8a5a00")
        ui.add_css(CSS)
        ui.add_body_html(f"<script>{SCRIPT.read_text(encoding='utf-8')}</script>")
        self.status = cards.Status(self)
        self.body, self.places["viewer"] = (ui.column().classes("bench") for _ in range(2))
        ui.timer(TICK, self.tick)
        ui.timer(LOOK, self.show_file_change)

    def draw_page(self, *, dark: bool) -> None:
        """Draw the page in the browser's colour scheme."""
        self.tab.dark, self._ready = dark, True
        self.draw()

    def tick(self) -> None:
        """Show the current task, and redraw the parts that have changed."""
        self.status.show(self.work)
        self.show_answers()
        if self._file is not None:
            name, content = self._file
            self._file = None
            ui.download.content(content, name)
        if not self._ready:
            return
        state = self.session.count, self.work.task is not None
        if state != self._drawn and (state[0] != self._drawn[0] or self.session.snapshot is None):
            self.draw()
        self._drawn = state
        if self.session.planned is not self._planned:
            self.redraw("planned")
        pending = self.tab.viewer_requested and not self.tab.viewer
        if pending and self._recorded:
            folder = f"{self.address}viewer/"
            files = "".join(f"&url={folder}{name}" for name in self.session.viewer.recorded)
            self.tab.viewer = f"{folder}?persist=0&notebook=0&theme=dark{files}"
            self.redraw("viewer")

    def show_answers(self) -> None:
        """Show at each place the progress of its task, or its last answer."""
        for place, label in self.answers.items():
            busy = self.work.line if self.work.section == place else ""
            answer = self.work.answers.get(place)
            label.set_text(f"{busy} …" if busy else numbers.sentence(answer.text if answer else ""))
            label.set_visibility(bool(busy or answer))
            done = answer is not None and answer.done
            label.props(f"data-came={'busy' if busy else 'done' if done else 'failed'}")

    def show_file_change(self) -> None:
        """Show whether another command has changed the file."""
        self.status.stale.set_visibility(self.work.task is None and self.session.stale)

    def draw(self) -> None:
        """Draw the complete page for the current snapshot."""
        self._drawn = self.session.count, self.work.task is not None
        snapshot, tab = self.session.snapshot, self.tab
        if snapshot is not tab.snapshot:
            suspect = next(iter(snapshot.diagnosis.significant), None) if snapshot else None
            self.tab = Tab(snapshot, suspect, dark=tab.dark, texts=tab.texts, pair=tab.pair)
        self.answers = {"file": self.status.message}
        self.body.clear()
        with self.body:
            if snapshot is None:
                cards.loading(self)
            else:
                cards.snapshot(self, snapshot)
        self.redraw("viewer")
        self.show_answers()

    def redraw(self, name: str) -> None:
        """Draw one of the parts in `REDRAWN`, if the page has it."""
        if name == "planned":
            self._planned = self.session.planned
        if (place := self.places.get(name)) is not None:
            place.clear()
            with place:
                if self.tab.snapshot is not None:
                    REDRAWN[name](self, self.tab.snapshot)

    def _do(self, place: str, task: str, act: Callable[[Snapshot, Say], object]) -> None:
        """Start a task on this tab's snapshot; the text that `act` returns is its answer."""
        snapshot = self.tab.snapshot
        if snapshot is None or self.work.start(task, lambda say: act(snapshot, say), place):
            return
        self.work.answers[place] = Answer("Another task is running; this one was not started.")

    def _change(
        self, place: str, verb: str, effect: str, act: Callable[[Snapshot, str, Say], Snapshot]
    ) -> None:
        """Start to add or remove an effect; the answer states the change of the error."""

        def do(snapshot: Snapshot, say: Say) -> str:
            act(snapshot, effect, say)
            if (c := self.session.changed) is None:
                return ""
            error, *warnings = change_lines(c, c.added or c.removed or "")
            return " ".join([error, f"It is revision {c.number}.", *warnings])

        self._do(place, f"{verb} {effect}", do)

    def add(self) -> None:
        """Add the chosen effect."""
        self._change("missing", "Adding", self.tab.suspect or "", self.session.add)

    def remove(self, effect: str) -> None:
        """Remove an effect."""
        self._change("model", "Removing", effect, self.session.remove)

    def go_back(self, number: int) -> None:
        """Show a revision, and accept it for every command."""

        def act(snapshot: Snapshot, say: Say) -> str:
            self.session.go_back(snapshot, number, say)
            return f"Revision {number} is shown, and every command uses it."

        self._do("revisions", f"Going to revision {number}", act)

    def show(self, number: int) -> None:
        """Show a revision without writing to the file."""

        def act(snapshot: Snapshot, say: Say) -> str:
            self.session.load(say, number)
            return f"Revision {number} is shown; what commands use is as it was."

        self._do("revisions", f"Reading revision {number}", act)

    def reload(self) -> None:
        """Read the file again."""
        read_file(self.session)

    def refit(self) -> None:
        """Fit the model of the revision in use to all readings."""
        snapshot = self.session.snapshot

        def act(say: Say) -> str:
            refit = self.session.refit(snapshot, say)
            return f"Fitted to all {refit.n_readings} readings: revision {refit.number}."

        self.work.start("Fitting anew", act)

    def change_cell(self) -> None:
        """Fit in the cell with the typed values, which stay in their fields if that fails."""
        texts = dict(self.tab.texts)

        def act(snapshot: Snapshot, say: Say) -> str:
            refit = self.session.change_cell(snapshot, texts, say)
            for key in texts:
                self.tab.texts.pop(key, None)
            return f"{refitted(snapshot.fit, refit.fit)} It is revision {refit.number}."

        self._do("cell", "Fitting in the changed cell", act)

    def download(self, kind: str) -> None:
        """Write a file on the shown revision for the browser to download."""

        def act(snapshot: Snapshot, say: Say) -> str:
            name, content = self._file = self.session.document(snapshot, kind, say)
            size = f"{len(content) / 1e6:.1f} MB" if len(content) > 1e5 else f"{len(content)} bytes"
            return f"Your browser has {name} now ({size})."

        self._do("download", f"Making the {kind}", act)

    def plan(self, poses: float | None, file: str, *, quick: bool) -> None:
        """Plan the next measurements."""
        output = self.session.path.parent / Path(file).name
        count = None if poses is None else int(poses)

        def act(snapshot: Snapshot, say: Say) -> None:
            self.session.plan(snapshot, count, output, say, quick=quick)

        self._do("next", "Planning the next measurements", act)

    def open_viewer(self) -> None:
        """Prepare the 3-D view, unless another tab has done so."""
        self.tab.viewer_requested = True
        if self._recorded:
            return

        def act(snapshot: Snapshot, say: Say) -> None:
            self.session.viewer.prepare(snapshot.story, self.session.count, say)

        self._do("viewer", "Opening the 3-D view", act)

    @property
    def _recorded(self) -> bool:
        snapshot = self.tab.snapshot
        return snapshot is not None and self.session.viewer.story is snapshot.story

    def choose(self, effect: str) -> None:
        """Show the evidence of a suspect."""
        if effect != self.tab.suspect:
            self.tab.suspect = effect
            if self.adder is not None:
                self.adder.set_text(f"Add {effect}")
                self.adder.set_visibility(True)
            self.redraw("evidence")

    def pick_variable(self, name: str) -> None:
        """Show the residuals over a variable, and the readings that are furthest off."""
        self.tab.variable = name
        worst = cards.worst_readings(self.tab.snapshot) if self.tab.snapshot else []
        self._pick(worst, "The readings that are furthest off")

    def pick_pose(self, measurement: int) -> None:
        """Show the readings of the pose of a measurement."""
        snapshot = self.tab.snapshot
        if snapshot is not None and 0 <= measurement < len(snapshot.story):
            story = snapshot.story
            readings = np.flatnonzero(story.pose == story.pose[measurement]).tolist()
            self._pick(readings, f"The readings of pose {story.pose_name(measurement)}")

    def _pick(self, measurements: list[int], title: str) -> None:
        self.tab.selected, self.tab.selected_title = measurements, title
        self.redraw("readings")


REDRAWN: dict[str, Callable[[View, Snapshot], None]] = {
    "readings": cards.readings,
    "evidence": cards.evidence,
    "planned": cards.plan_card,
    "viewer": cards.viewer,
}
"""Parts of the page that are redrawn separately."""
