"""The page: what happens when something is clicked, and when it is drawn anew."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from fastapi import FastAPI, Request
from fastapi.responses import PlainTextResponse, Response
from nicegui import app as bench
from nicegui import ui

from hilcal import numbers
from hilcal.campaign.changes import Changed
from hilcal.present.campaign import refitted
from hilcal.present.diagnosis import addition_lines, fell, rose
from hilcal.workbench import cards, next_card
from hilcal.workbench.elements import Status
from hilcal.workbench.session import Say, WorkbenchSession
from hilcal.workbench.snapshot import Snapshot
from hilcal.workbench.viewer import WebViewer
from hilcal.workbench.work import Answer, Work

TICK = 0.2
"""How often a tab looks whether something has changed, s."""
LOOK = 2.0
"""How often it looks at the file, s."""
CSS = Path(__file__).with_name("page.css")
SCRIPT = Path(__file__).with_name("page.js")
DARK = "matchMedia('(prefers-color-scheme: dark)').matches"


@dataclass
class Tab:
    """What one tab looks at; nothing of it is stored.

    Attributes:
        snapshot: the snapshot that the rest belongs to.
        suspect: the missing effect whose evidence is shown.
        variable: the variable over which residuals are drawn; None for the pose.
        picked: measurements of the story that were clicked; None before.
        told: what they are, in words.
        dark: whether the browser asks for a dark page.
        texts: values of the cell by section and key, as they were typed and not used yet.
        pair: the two revisions that are shown side by side.
        looks: whether the 3-D view was asked for.
        viewer: address of the 3-D view; empty before it was opened.
    """

    snapshot: Snapshot | None = None
    suspect: str | None = None
    variable: str | None = None
    picked: list[int] | None = None
    told: str = ""
    dark: bool = False
    texts: dict[tuple[str, str], str] = field(default_factory=dict)
    pair: tuple[int, int] | None = None
    looks: bool = False
    viewer: str = ""


@dataclass
class TabsShared:
    """What all tabs share."""

    session: WorkbenchSession
    work: Work = field(default_factory=Work)
    viewer: WebViewer = field(default_factory=WebViewer)
    drawing: tuple[Snapshot, tuple[str, ...]] | None = None


def install(app: FastAPI, session: WorkbenchSession) -> None:
    """Add the page, and the files of the 3-D viewer, to an application; begin to read."""
    shared = TabsShared(session)

    @app.get("/viewer/{name:path}")
    def viewer(name: str) -> Response:
        found = shared.viewer.file(name)
        if found is None:
            return PlainTextResponse("nothing here\n", status_code=404)
        content, kind = found
        return Response(content, media_type=kind, headers={"rerun-final-length": str(len(content))})

    @ui.page("/")
    async def page(request: Request) -> None:
        view = View(shared, str(request.base_url))
        view.build()
        await ui.context.client.connected()
        view.begin(dark=bool(await ui.run_javascript(DARK, timeout=5.0)))

    bench.on_startup(lambda: shared.work.start(f"Reading {session.path.name}", read(session)))


def read(session: WorkbenchSession, revision: int | None = None) -> Callable[[Say], str]:
    """Return what reads the file and shows a revision."""

    def do(say: Say) -> str:
        known = session.snapshot is not None
        found = session.load(say, revision)
        return f"{found.name} was read again." if known else ""

    return do


def told(c: Changed | None) -> str:
    """Return what adding or removing an effect did."""
    if c is None:
        return ""
    say = fell if c.added else rose
    lines = [say(c.before, c.fit, c.added or c.removed or ""), f"It is revision {c.number}."]
    return " ".join(lines + ([] if c.expected is None else [*addition_lines(c.expected)]))


class View:
    """One tab of the page."""

    def __init__(self, shared: TabsShared, address: str) -> None:
        """Begin with what is there.

        Args:
            shared: what all tabs share.
            address: of this server, as the browser calls it.
        """
        self.shared, self.address, self.tab = shared, address, Tab()
        self.readings: ui.column | None = None
        self.evidence: ui.column | None = None
        self.planned: ui.column | None = None
        self.adder: ui.button | None = None
        self.answers: dict[str, ui.label] = {}
        self._drawn = -1, False
        self._ready = False
        self._file: tuple[str, bytes] | None = None
        self._planned: object = None

    @property
    def session(self) -> WorkbenchSession:
        """The session."""
        return self.shared.session

    @property
    def work(self) -> Work:
        """The work."""
        return self.shared.work

    def build(self) -> None:
        """Make the parts that stay, and look for changes from time to time."""
        ui.colors(primary="#1f6f9f", positive="#00785a", negative="#c0274b", warning="#8a5a00")
        ui.add_css(CSS)
        ui.add_body_html(f"<script>{SCRIPT.read_text(encoding='utf-8')}</script>")
        self.status = Status(self)
        self.body = ui.column().classes("bench")
        self.below = ui.column().classes("bench")
        ui.timer(TICK, self.tick)
        ui.timer(LOOK, self.look)

    def begin(self, *, dark: bool) -> None:
        """Draw, now that it is known whether the browser asks for a dark page."""
        self.tab.dark, self._ready = dark, True
        self.draw()

    def tick(self) -> None:
        """Show what is being done, and draw anew what has changed."""
        self.status.show(self.work)
        self.show_answers()
        if self._file is not None:
            name, content = self._file
            self._file = None
            ui.download.content(content, name)
        if not self._ready:
            return
        state = self.session.count, self.work.what is not None
        if state != self._drawn and (state[0] != self._drawn[0] or self.session.snapshot is None):
            self.draw()
        self._drawn = state
        if self.session.planned is not self._planned:
            self.draw_plan()
        drawing = self.shared.drawing
        asked = self.tab.looks and not self.tab.viewer
        if asked and drawing is not None and drawing[0] is self.tab.snapshot:
            at = f"{self.address}viewer/"
            files = "".join(f"&url={at}{name}" for name in drawing[1])
            self.tab.viewer = f"{at}?persist=0&notebook=0&theme=dark{files}"
            self.draw_below()

    def show_answers(self) -> None:
        """Show at each place what is being done there, or what came of it."""
        for place, label in self.answers.items():
            busy = self.work.line if self.work.place == place else ""
            found = self.work.answers.get(place)
            label.set_text(f"{busy} …" if busy else numbers.sentence(found.words if found else ""))
            label.set_visibility(bool(busy or found))
            done = found is not None and found.done
            label.props(f"data-came={'busy' if busy else 'done' if done else 'failed'}")

    def look(self) -> None:
        """Say when another command has changed the file."""
        self.status.stale.set_visibility(self.work.what is None and self.session.stale)

    def draw(self) -> None:
        """Draw everything for what the session shows now."""
        self._drawn = self.session.count, self.work.what is not None
        snapshot, before = self.session.snapshot, self.tab
        if snapshot is not before.snapshot:
            named = snapshot.diagnosis.significant if snapshot else ()
            self.tab = Tab(
                snapshot,
                named[0] if named else None,
                dark=before.dark,
                texts=before.texts,
                pair=before.pair,
            )
        self.answers = {"file": self.status.told}
        self.body.clear()
        with self.body:
            if snapshot is None:
                cards.waiting(self)
            else:
                cards.snapshot(self, snapshot)
        self.draw_below()
        self.show_answers()

    def draw_below(self) -> None:
        """Draw the 3-D view alone."""
        self.below.clear()
        with self.below:
            if self.tab.snapshot is not None:
                cards.viewer(self)

    # what can be clicked

    def do(self, place: str, what: str, act: Callable[[Snapshot, Say], object]) -> None:
        """Begin something on the snapshot of this tab; only one thing is done at a time.

        Args:
            place: of the button, where the answer stays: what `act` returns if it is a text.
            what: is done, in words.
            act: does it.
        """
        snapshot = self.tab.snapshot
        if snapshot is not None and not self.work.start(
            what, lambda say: act(snapshot, say), place
        ):
            self.work.answers[place] = Answer("Something else was being done; nothing was begun.")

    def add(self) -> None:
        """Add the chosen effect."""
        effect = self.tab.suspect or ""

        def act(snapshot: Snapshot, say: Say) -> str:
            self.session.add(snapshot, effect, say)
            return told(self.session.changed)

        self.do("missing", f"Adding {effect}", act)

    def remove(self, effect: str) -> None:
        """Take an effect out."""

        def act(snapshot: Snapshot, say: Say) -> str:
            self.session.remove(snapshot, effect, say)
            return told(self.session.changed)

        self.do("model", f"Removing {effect}", act)

    def go_back(self, number: int) -> None:
        """Show a revision and let every command use it."""

        def act(snapshot: Snapshot, say: Say) -> str:
            self.session.go_back(snapshot, number, say)
            return f"Revision {number} is shown, and every command uses it."

        self.do("revisions", f"Going to revision {number}", act)

    def show(self, number: int) -> None:
        """Show a revision; nothing is written."""

        def act(snapshot: Snapshot, say: Say) -> str:
            self.session.load(say, number)
            return f"Revision {number} is shown; what commands use is as it was."

        self.do("revisions", f"Reading revision {number}", act)

    def again(self) -> None:
        """Read the file again."""
        self.work.start(f"Reading {self.session.path.name}", read(self.session))

    def fit_anew(self) -> None:
        """Fit the model of the revision in use to all readings."""
        snapshot = self.session.snapshot

        def act(say: Say) -> str:
            found = self.session.fit_anew(snapshot, say)
            return f"Fitted to all {found.n_readings} readings: revision {found.number}."

        self.work.start("Fitting anew", act)

    def change_cell(self) -> None:
        """Fit in the cell as it was typed; what was typed stays until it is used."""
        texts = dict(self.tab.texts)

        def act(snapshot: Snapshot, say: Say) -> str:
            before = snapshot.fit
            found = self.session.change_cell(snapshot, texts, say)
            for key in texts:
                self.tab.texts.pop(key, None)
            return f"{refitted(before, found.fit)} It is revision {found.number}."

        self.do("cell", "Fitting in the changed cell", act)

    def download(self, kind: str) -> None:
        """Make a file about the shown revision, and give it to the browser."""

        def act(snapshot: Snapshot, say: Say) -> str:
            name, content = self._file = self.session.document(snapshot, kind, say)
            size = f"{len(content) / 1e6:.1f} MB" if len(content) > 1e5 else f"{len(content)} bytes"
            return f"Your browser has {name} now ({size})."

        self.do("download", f"Making the {kind}", act)

    def plan(self, poses: float | None, file: str, *, quick: bool) -> None:
        """Plan the next measurements."""
        output = self.session.path.parent / Path(file).name
        count = None if poses is None else int(poses)
        self.do(
            "next",
            "Planning the next measurements",
            lambda snapshot, say: self.session.plan(snapshot, count, output, say, quick=quick),
        )

    def open_viewer(self) -> None:
        """Prepare the 3-D view, unless another tab has."""
        self.tab.looks = True
        if self.shared.drawing is not None and self.shared.drawing[0] is self.tab.snapshot:
            return

        def act(snapshot: Snapshot, say: Say) -> None:
            names = self.shared.viewer.prepare(snapshot.story, self.session.count, say)
            self.shared.drawing = snapshot, names

        self.do("viewer", "Opening the 3-D view", act)

    def choose(self, effect: str) -> None:
        """Show the evidence of a suspect."""
        if effect != self.tab.suspect:
            self.tab.suspect = effect
            if self.adder is not None:
                self.adder.set_text(f"Add {effect}")
                self.adder.set_visibility(True)
            self.draw_evidence()

    def pick_variable(self, name: str) -> None:
        """Show the residuals over a variable, and its readings that are furthest off."""
        self.tab.variable = name
        worst = cards.furthest(self.tab.snapshot) if self.tab.snapshot else []
        self.pick(worst, "The readings that are furthest off")

    def pick(self, measurements: list[int], told: str) -> None:
        """Show some readings, and what distinguishes them."""
        self.tab.picked, self.tab.told = measurements, told
        self.draw_readings()

    def pick_pose(self, measurement: int) -> None:
        """Show the readings of the pose of one."""
        snapshot = self.tab.snapshot
        if snapshot is not None and 0 <= measurement < len(snapshot.story):
            mine = np.flatnonzero(snapshot.story.pose == snapshot.story.pose[measurement])
            self.pick(
                mine.tolist(), f"The readings of pose {snapshot.story.pose_name(measurement)}"
            )

    def draw_readings(self) -> None:
        """Draw the readings that were picked."""
        if self.readings is None:
            return
        self.readings.clear()
        with self.readings:
            if self.tab.snapshot is not None:
                cards.readings(self, self.tab.snapshot)

    def draw_plan(self) -> None:
        """Draw the next measurements, where they are planned."""
        self._planned = self.session.planned
        if self.planned is None:
            return
        self.planned.clear()
        with self.planned:
            next_card.planned(self.session)

    def draw_evidence(self) -> None:
        """Draw the evidence of the chosen suspect."""
        if self.evidence is None:
            return
        self.evidence.clear()
        with self.evidence:
            if self.tab.snapshot is not None:
                cards.evidence(self, self.tab.snapshot)
