"""The cards of the page: verdict, misfit, suspects, revisions, cell, next plan; their elements."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import plotly.graph_objects as go
from nicegui import background_tasks, events, run, ui

from hilcal import numbers
from hilcal.diagnosis.recorded import Difference
from hilcal.names import escaped
from hilcal.present import charts
from hilcal.present.campaign import left_out_m, model_words, two_revisions, verdict_of
from hilcal.present.diagnosis import ORDER, next_command, shown_suspects, suspects_table
from hilcal.present.document import Table, description_of, load_name
from hilcal.present.document import table as block
from hilcal.present.fit import dependence_sentence, holdout_sentence, model_name
from hilcal.present.plan import adding_lines, power_rows, powers_summary
from hilcal.present.story import laws as curves_of_laws
from hilcal.present.verdict import headline, message
from hilcal.store.plan import UNLOADED
from hilcal.workbench.session import Snapshot, Work

if TYPE_CHECKING:
    from hilcal.workbench.page import View

FURTHEST, FURTHEST_SHARE = 8, 0.05  # least number, and share, of readings "furthest off"; choices
DIFFERENCES = 4
DOWNLOADS = {"report": "Report", "calibration": "Calibration", "table": "Table of readings"}


def loading(view: View) -> None:
    """Draw the page before the first snapshot."""
    with ui.column().classes("part").style("margin-top: 16px"):
        title(view.session.path.name)
        if view.work.failure():
            small_print("There is nothing to show: see above.")
            button(view, "Read it again", view.reload, "outline")
        else:
            small_print("The readings are fitted and judged; this takes some seconds.")


@contextmanager
def _part(name: str = "") -> Iterator[ui.column]:
    with ui.column().classes("part") as column:
        if name:
            title(name)
        yield column


def snapshot(view: View, d: Snapshot) -> None:
    """Draw all cards."""
    kind, arm = "deflections" if d.fit.mode == "deflection" else "absolute readings", d.story.arm
    with ui.row().classes("items-baseline").style("gap: 4px 16px; padding-top: 16px"):
        ui.html(f"<h1 class='verdict'>{plain(view.session.path.name)}</h1>", sanitize=False)
        small_print(f"{arm.name} · {d.n_readings} readings, judged as {kind} · from {d.source}")
    _verdict(view, d)
    with ui.element("div").classes("two"):
        _misfit(view, d)
        _suspects(view, d)
        for name in ("readings", "evidence"):
            view.places[name] = ui.column().classes("part")
            view.redraw(name)
    with ui.element("div").classes("two"):
        with ui.column().classes("stack"):
            with _part("How the error fell"):
                chart(view, charts.error_per_revision(d.story)).props("data-part=fell")
            with _part("Model and measurement"):
                small_print(holdout_sentence(d.fit))
                chart(view, charts.measured_predicted(d.story, d.revision))
            _laws(view, d)
        with ui.column().classes("stack"):
            _revisions(view, d)
            _next_measurement(view, d)
    _side_by_side(view, d)
    _cell(view, d)
    with _part("Downloads"):
        small_print(
            f"Of {'the baseline' if d.number is None else f'revision {d.number}'}: the story as "
            "one page, the calibration for hilcal compensate, and the readings as an exchange "
            "table."
        )
        with ui.row().style("gap: 8px"):
            for file, name in DOWNLOADS.items():
                button(view, name, partial(view.download, file), "outline")
        answer_label(view, "download")
    view.redraw("planned")


def _verdict(view: View, d: Snapshot) -> None:
    judged, fit = d.diagnosis, d.fit
    kind, mark = ("good", "✓") if judged.verdict == "adequate" else ("bad", "!")
    with _part() as part:
        part.props("data-part=verdict")
        text = plain(numbers.sentence(headline(judged)))
        ui.html(f"<h2 class='verdict {kind}'>{mark} {text}</h2>", sanitize=False)
        ui.label(message(judged))
        if judged.verdict not in ("missing_effect", "ambiguous"):  # for these the page has buttons
            for line in next_command(judged, view.session.path, d.number):
                ui.label(line).classes("code" * line.startswith("hilcal "))
        low, high = fit.variance_factor_interval
        with ui.element("div").classes("numbers"):
            for name, value in (
                ("error on poses left out", numbers.length(fit.holdout.rms_m)),
                ("error on fitted poses", numbers.length(fit.error.rms_m)),
                ("noise alone would leave", numbers.length(d.story.noise_floor_m)),
                (f"variance factor, 95 %: {low:.2f} to {high:.2f}", f"{fit.variance_factor:.2f}"),
            ):
                text = f"<b>{plain(value)}</b><span>{plain(name)}</span>"
                ui.html(text, sanitize=False).classes("number")
        name = "Baseline, not stored" if d.number is None else f"Revision {d.number}"
        with ui.row().classes("items-center").style("gap: 6px 10px"):
            small_print(f"{name}: {model_name(fit.model.named)}")
            for effect in d.removable:
                button(view, f"Remove {effect}", partial(view.remove, effect), "outline dense")
        answer_label(view, "model")


def _misfit(view: View, d: Snapshot) -> None:
    with _part("Where it fails"):
        if d.diagnosis.residual_is_noise:
            small_print("Nowhere: the residuals are no larger than the noise.")
            return
        small_print(dependence_sentence(d.diagnosis.misfit_breakdown))
        names = [v.variable for v in d.diagnosis.misfit_breakdown]

        def clicked(e: events.GenericEventArguments) -> None:
            if (name := str(point(e).get("y", ""))) in names:
                view.pick_variable(name)

        shown = chart(view, charts.misfit_shares(d.diagnosis)).props("data-part=fails")
        shown.on("plotly_click", clicked)
        small_print("Click a bar: the readings over that variable.")


def _suspects(view: View, d: Snapshot) -> None:
    rows = shown_suspects(d.diagnosis) if d.diagnosis.significant else []
    with _part("What is missing"):
        if rows:
            shown = suspects_table(d.diagnosis)  # the last column is a sentence below
            shown = replace(shown, heads=shown.heads[:4], rows=[row[:4] for row in shown.rows])
            table = draw_table(shown, selection="single")
            table.props("hide-selected-banner data-part=missing").classes("choice")
            table.selected = [row for row in table.rows if row["0"] == view.tab.suspect]

            def clicked(e: events.GenericEventArguments) -> None:
                table.selected = [e.args[1]]
                view.choose(e.args[1]["0"])

            def ticked(e: events.TableSelectionEventArguments) -> None:
                for row in e.selection:
                    view.choose(row["0"])

            table.on("row-click", clicked)
            table.on_select(ticked)
            if same := rows[0].same_as if rows[0].passes else ():
                small_print(
                    f"These readings do not separate {rows[0].effect} from {numbers.few(same)}."
                )
            small_print(
                f"{ORDER} explains: share of the misfit that adding it would remove; p-value: "
                "chance of that much if it were not there."
            )
        else:
            small_print("No effect passes the tests by itself: see the verdict.")
        effects, view.adder = [s.effect for s in d.diagnosis.suspects], None
        if effects:
            kind = "unelevated" if rows else "outline"
            view.adder = button(view, f"Add {view.tab.suspect}", view.add, f"{kind} data-part=add")
            view.adder.set_visibility(view.tab.suspect is not None)
        answer_label(view, "missing")
        if effects:
            ui.select(
                effects,
                label="Another effect",
                value=view.tab.suspect,
                on_change=lambda e: view.choose(e.value),
            ).props("dense outlined options-dense").style("width: 100%")


def evidence(view: View, d: Snapshot) -> None:
    """Draw the evidence of the chosen suspect."""
    effect = view.tab.suspect
    title("The evidence" if effect is None else f"The evidence for {effect}")
    if effect is None:
        small_print("Choose an effect above to see what the readings say of it.")
        return
    with ui.column().style("width: 100%; gap: 8px") as place:
        small_print("…")

    async def draw() -> None:
        curve = await run.io_bound(view.session.evidence, d, effect)
        if place.is_deleted:  # another effect was chosen meanwhile
            return
        place.clear()
        with place:
            if curve is None:
                small_print("These readings do not show this effect.")
            else:
                chart(view, charts.added_variable(curve, effect)).props("data-part=evidence")

    background_tasks.create(draw(), name="evidence")


def readings(view: View, d: Snapshot) -> None:
    """Draw the residuals over a variable, the selected readings and their differences."""
    variable = view.tab.variable
    title("The readings" if variable is None else f"The readings over {variable}")
    recorded = view.session.recorded(d) if variable not in (None, "load") else {}
    if (r := recorded.get(variable or "")) is not None:
        unit, factor = numbers.variable_unit(r.unit)
        figure = charts.residual_over(d.story, d.revision, factor * r.values, r.name, unit)
    else:
        kind = charts.residual_by_load if variable == "load" else charts.residual_by_pose
        figure = kind(d.story, d.revision)
    shown = chart(view, figure).props("data-part=readings")
    shown.on("plotly_click", lambda e: view.pick_pose(int(point(e).get("customdata", -1))))
    picked = view.tab.selected
    if picked is None:
        small_print("Click a point: the readings of its pose, and what sets them apart.")
        return
    ui.label(f"{view.tab.selected_title}:").style("font-weight: 500")
    clear = [difference(x) for x in view.session.differences(d, np.array(picked)) if x.clear]
    apart = f"What sets them apart: {'; '.join(clear[:DIFFERENCES])}."
    text = apart if clear else "Nothing recorded sets them apart from the others."
    ui.label(text).props("data-part=differences")
    sigma, size = d.revision.sigma, d.revision.size_m
    rows = block("pose", "load", "error", "in noise", left=(0, 1, 2, 3))
    for k in sorted(picked, key=lambda k: -sigma[k])[:FURTHEST]:
        error, load = numbers.length(float(size[k])), load_name(d.story.load_names[k])
        rows.add(d.story.pose_name(k), load, error, f"{sigma[k]:.1f} σ")
    draw_table(rows).props("data-part=picked")
    if len(picked) > FURTHEST:
        small_print(f"and {len(picked) - FURTHEST} more")


def difference(x: Difference) -> str:
    """Return the difference of the selected readings from the others as text."""
    if x.variable.startswith("load "):
        name = "unloaded" if x.variable == f"load {UNLOADED}" else x.variable
        a, b = numbers.percent(x.picked), numbers.percent(x.others)
        return f"{name}: {a} of them, {b} of the others"
    unit, factor = numbers.variable_unit(x.unit)
    a, b = (numbers.digits(factor * value) for value in (x.picked, x.others))
    return f"{x.variable} {a} {unit}, the others {b} {unit}".replace(" ,", ",").rstrip()


def worst_readings(d: Snapshot) -> list[int]:
    """Return the readings that are furthest off, in units of the noise."""
    norm2 = d.revision.whitened_norm2
    count = max(FURTHEST, round(FURTHEST_SHARE * len(norm2)))
    return [int(k) for k in np.argsort(-norm2, kind="stable")[:count]]


def _revisions(view: View, d: Snapshot) -> None:
    with _part("Revisions"):
        if not d.records:
            small_print("None yet: the baseline is kept when something is added to it.")
        for r in reversed(d.records):
            marks = ["shown"] * (r.number == d.number)
            marks += ["used by every command"] * (r.number == d.in_use)
            with ui.element("div").classes("line").props(f"data-revision={r.number}"):
                with ui.column().style("gap: 0"):
                    ui.label(f"{r.number}: {model_words(r)}").style("font-weight: 500")
                    error = f"{numbers.length(left_out_m(r))} on poses left out"
                    small_print(" · ".join([error, verdict_of(r), *marks]))
                if r.number != d.number:
                    button(view, "Look", partial(view.show, r.number), "flat dense")
                if not r.number == d.number == d.in_use:
                    text = "Go back to it" if r.number != d.number else "Use it"
                    button(view, text, partial(view.go_back, r.number), "outline dense")
        if d.accepted is not None:
            small_print(f"Revision {d.accepted} is accepted: every command uses it.")
        answer_label(view, "revisions")
        small_print("Revisions are only appended: nothing that was tried is lost.")


def _side_by_side(view: View, d: Snapshot) -> None:
    with _part("Two revisions side by side"):
        if len(d.records) < 2:
            small_print("Nothing to compare yet: each change of model or cell adds a revision.")
            return
        by_number = {r.number: r for r in d.records}
        shown = d.number or d.records[-1].number
        pair = view.tab.pair or (shown - 1 or shown + 1, shown)
        names = {n: f"{n}: {model_words(r)}" for n, r in by_number.items()}
        with ui.element("div").classes("two"):
            chosen = [
                ui.select(names, label=label, value=n).props("dense outlined options-dense")
                for label, n in zip(("First", "Second"), pair, strict=True)
            ]
        place = ui.column().classes("wide").props("data-part=pair")

        def draw() -> None:
            place.clear()
            with place:
                table = two_revisions(by_number[chosen[0].value], by_number[chosen[1].value])
                draw_table(table).props("wrap-cells").classes("tall")

        def changed() -> None:
            view.tab.pair = chosen[0].value, chosen[1].value
            draw()

        for select in chosen:
            select.on_value_change(changed)
        if set(pair) <= by_number.keys():
            draw()


def _laws(view: View, d: Snapshot) -> None:
    if not (curves := curves_of_laws(d.fit)):
        return
    with _part("Laws beyond the catalogue"):
        for law in curves:
            small_print(f"{law.title}: " + "; ".join(f"{name}: {text}" for name, text in law.facts))
            chart(view, charts.curve_chart(law)).props("data-part=law")


def viewer(view: View, d: Snapshot) -> None:
    """Draw the 3-D view, or the button that opens it."""
    with ui.column().classes("part").style("margin: 16px 0 32px"):
        title("The arm and its readings in space")
        if view.tab.viewer:
            frame = ui.element("iframe").classes("view3d")
            frame.props["src"], frame.props["title"] = view.tab.viewer, "3-D view"
        else:
            button(view, "Open the 3-D view", view.open_viewer, "outline")
            answer_label(view, "viewer")


def _cell(view: View, d: Snapshot) -> None:
    """Draw the values of the cell that can be changed; typed values stay until they are used."""

    def keep(key: tuple[str, str], e: events.ValueChangeEventArguments[Any]) -> None:
        view.tab.texts[key] = e.value or ""

    with _part("Noise and cell"):
        small_print(
            "Change values, written as in CELL.toml; an empty field leaves the key out. The shown "
            "model is then fitted anew, as a revision; what was measured stays as it is."
        )
        small_print(f"Now: {d.covariance}.")
        for why in dict.fromkeys(f.why_fixed for f in d.cell_keys if f.why_fixed):
            keys = [f.key for f in d.cell_keys if f.why_fixed == why]
            small_print(f"Not to be changed here: {', '.join(keys)}: {why}.")
        with ui.element("div").classes("figures").props("data-part=cell"):
            for f in d.cell_keys:
                if not f.why_fixed:
                    key = f.section, f.key
                    value = view.tab.texts.get(key, f.text)
                    field = ui.input(f"[{f.section}] {f.key}", value=value).props("dense outlined")
                    field.props["hint"] = f.valid
                    field.on_value_change(partial(keep, key))
        button(view, "Fit with these values", view.change_cell, "unelevated data-part=change")
        answer_label(view, "cell")


def _next_measurement(view: View, d: Snapshot) -> None:
    with _part("Measure next"):
        small_print("Plan the poses and loads that tell apart what these readings leave open.")
        with ui.row().classes("items-center").style("gap: 12px; width: 100%"):
            poses = ui.number("poses (as needed)", min=1, precision=0).props("dense outlined")
            poses.style("width: 190px")
            name = f"{view.session.path.stem}-next-{d.number or 0}.json"
            file = ui.input("plan file", value=name).props("dense outlined")
            file.style("flex: 1 1 180px")
        compare = ui.checkbox("Compare criteria and numbers of poses first; takes longer")

        def plan() -> None:
            view.plan(poses.value, file.value, quick=not compare.value)

        button(view, "Plan the next measurements", plan, "unelevated")
        answer_label(view, "next")
        view.places["planned"] = ui.column().style("width: 100%; gap: 8px")


def plan_card(view: View, d: Snapshot) -> None:
    """Draw the planned next measurements, if any."""
    if view.session.planned is None:
        return
    next_, path = view.session.planned
    summary, powers = next_.checked.summary, next_.separating.powers
    ui.label(powers_summary(powers, summary.poses, summary.readings)).props("data-part=planned")
    for effect, rival, power_now, power_then in power_rows(powers):
        small_print(
            f"If {effect} is there, {rival} is ruled out: {power_now} now, {power_then} then."
        )
    how, *commands = adding_lines(view.session.path, path, None, next_.appendable)
    ui.label(f"The plan is in {path.name}. {how}")
    for line in commands:
        ui.label(line).classes("code")
    if next_.appendable:
        small_print("Then read the file again here.")


class Status:
    """The strip that shows the current task and the state of the file."""

    def __init__(self, view: View) -> None:
        with ui.column().classes("strip").style("gap: 0"):
            rows = [ui.row().classes("bench items-center").style("gap: 12px") for _ in range(3)]
        self.busy, self.answered, self.stale = rows
        with self.busy.classes("no-wrap"):
            ui.spinner(size="1.3em")
            self.doing = ui.label().classes("soft").props("aria-live=polite")
        with self.answered:
            self.message = ui.label().classes("answer").props("role=alert data-answer=file")
            self.refit = button(view, "Fit anew to all readings", view.refit, "outline dense")
        with self.stale:
            ui.label("Another command has changed the file.").classes("bad")
            button(view, "Read it again", view.reload, "outline dense")
        for row in rows:
            row.set_visibility(False)

    def show(self, work: Work) -> None:
        """Show the current task, or the answer of the last one."""
        line = work.line
        self.busy.set_visibility(bool(line))
        self.doing.set_text(f"{line} …")
        self.answered.set_visibility("file" in work.answers and not line)
        self.refit.set_visibility("readings were appended" in work.failure())


def answer_label(view: View, section: str) -> None:
    """Draw the label for progress and answer of the buttons above."""
    view.answers[section] = ui.label().classes("answer").props(f"role=status data-answer={section}")


def title(text: str) -> None:
    """Draw the title of a part."""
    ui.html(f"<h2>{plain(text)}</h2>", sanitize=False)


def small_print(text: str) -> ui.label:
    """Draw an explanation."""
    return ui.label(text).classes("soft")


def draw_table(table: Table, selection: Literal["single"] | None = None) -> ui.table:
    """Draw a table of a document; the keys of a row are the numbers of the columns."""
    columns = []
    for k, head in enumerate(table.heads):
        side = "left" if k in table.left else "right"
        columns.append({"name": str(k), "label": head, "field": str(k), "align": side})
    rows = [{"at": i, **{str(k): x for k, x in enumerate(r)}} for i, r in enumerate(table.rows)]
    element = ui.table(columns=columns, rows=rows, row_key="at", selection=selection)
    return element.props("flat dense").style("width: 100%")


def button(view: View, text: str, act: Callable[[], object], props: str) -> ui.button:
    """Draw a button that is disabled during a task."""
    color = None if "outline" in props or "flat" in props else "primary"
    element = ui.button(text, on_click=act, color=color).props(f"no-caps {props}")
    return element.bind_enabled_from(view.work, "task", backward=lambda task: task is None)


def chart(view: View, figure: go.Figure) -> ui.plotly:
    """Draw a chart in the page's scheme, with its sentence for screen readers."""
    content = charts.in_scheme(figure, view.tab.dark).to_plotly_json()
    element = ui.plotly({**content, "config": charts.CONFIG}).classes("chart")
    element.props["role"], element.props["aria-label"] = "img", description_of(figure)
    return element


def point(e: events.GenericEventArguments) -> dict[str, Any]:
    """Return the clicked point of a chart, as plotly.js describes it."""
    return dict((e.args.get("points") or [{}])[0])


def plain(text: str) -> str:
    """Return a text escaped for HTML."""
    return html.escape(escaped(text))
