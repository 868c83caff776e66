"""The cards of the page: the verdict, where it fails, what is missing, revisions."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from nicegui import background_tasks, run, ui
from nicegui.events import GenericEventArguments, TableSelectionEventArguments

from hilcal import numbers
from hilcal.diagnosis.distinguish import Difference
from hilcal.present.campaign import left_out_m, model_words, two_revisions, verdict_of
from hilcal.present.charts import (
    added_variable,
    curve_chart,
    error_per_revision,
    measured_predicted,
    misfit_shares,
    residual_by_load,
    residual_by_pose,
    residual_over,
)
from hilcal.present.diagnosis import shown_suspects, suspects_table
from hilcal.present.document import load_name
from hilcal.present.document import table as block
from hilcal.present.fit import follows, misses, model_name
from hilcal.present.story import DependenceCurve
from hilcal.present.story import laws as curves_of_laws
from hilcal.present.verdict import headline, message
from hilcal.store.plan import UNLOADED
from hilcal.store.revision import RevisionRecord
from hilcal.workbench.elements import (
    answer,
    button,
    chart,
    drawn,
    number,
    plain,
    point,
    soft,
    title,
)
from hilcal.workbench.next_card import next_measurement
from hilcal.workbench.snapshot import Figure, Snapshot

if TYPE_CHECKING:
    from hilcal.workbench.page import View

FURTHEST = 8
FURTHEST_SHARE = 0.05
"""Share of the readings that are compared with the others as those furthest off; a choice."""
DIFFERENCES = 4
DOWNLOADS = {"report": "Report", "calibration": "Calibration", "table": "Table of readings"}
NONE_PASSES = "No effect passes the tests by itself; what that means, the verdict says."
"""Whether one is missing is the verdict's alone to say."""


def waiting(view: View) -> None:
    """Say that nothing is there yet."""
    with ui.column().classes("part").style("margin-top: 16px"):
        ui.html(f"<h2>{plain(view.session.path.name)}</h2>", sanitize=False)
        if view.work.failure():
            soft("There is nothing to show: see above.")
            button(view, "Read it again", view.again, "outline")
        else:
            soft("The readings are fitted and judged; this takes some seconds.")


def snapshot(view: View, d: Snapshot) -> None:
    """Draw everything."""
    head(d)
    verdict(view, d)
    with ui.element("div").classes("two"):
        with ui.column().classes("part"):
            fails(view, d)
        with ui.column().classes("part"):
            missing(view, d)
        view.readings = ui.column().classes("part")
        view.evidence = ui.column().classes("part")
    view.draw_readings()
    view.draw_evidence()
    with ui.element("div").classes("two"):
        with ui.column().classes("stack"):
            with ui.column().classes("part"):
                fell(view, d)
            with ui.column().classes("part"):
                compared(view, d)
            if found := curves_of_laws(d.fit):
                with ui.column().classes("part"):
                    laws(view, found)
        with ui.column().classes("stack"):
            with ui.column().classes("part"):
                revisions(view, d)
            with ui.column().classes("part"):
                next_measurement(view, d)
                view.planned = ui.column().style("width: 100%; gap: 8px")
    with ui.column().classes("part"):
        side_by_side(view, d)
    with ui.column().classes("part"):
        cell(view, d)
    with ui.column().classes("part"):
        downloads(view, d)
    view.draw_plan()


def head(d: Snapshot) -> None:
    """Draw which campaign this is."""
    kind = "deflections" if d.fit.mode == "deflection" else "absolute readings"
    with ui.row().classes("items-baseline").style("gap: 4px 16px; padding-top: 16px"):
        ui.html(f"<h1 class='verdict'>{plain(d.name)}</h1>", sanitize=False)
        soft(f"{d.arm} · {d.n_readings} readings, judged as {kind} · from {d.source}")


def verdict(view: View, d: Snapshot) -> None:
    """Draw whether the model is good."""
    found, fit = d.diagnosis, d.fit
    good = found.verdict == "adequate"
    with ui.column().classes("part").props("data-part=verdict"):
        mark = "✓" if good else "!"
        said = numbers.sentence(headline(found))
        ui.html(
            f"<h2 class='verdict {'good' if good else 'bad'}'>{mark} {plain(said)}</h2>",
            sanitize=False,
        )
        ui.label(numbers.sentence(message(found), fit.model.catalogue.names))
        with ui.element("div").classes("numbers"):
            number("error on poses left out", numbers.length(fit.holdout.rms_m))
            number("error on fitted poses", numbers.length(fit.error.rms_m))
            number("noise alone would leave", numbers.length(d.story.noise_floor_m))
            low, high = fit.variance_factor_interval
            factor = f"{fit.variance_factor:.2f}"
            number(f"variance factor, 95 %: {low:.2f} to {high:.2f}", factor)
        model(view, d)


def model(view: View, d: Snapshot) -> None:
    """Draw the effects of the model, each with a button that takes it out."""
    called = "Baseline, not kept yet" if d.number is None else f"Revision {d.number}"
    with ui.row().classes("items-center").style("gap: 6px 10px"):
        soft(f"{called}: {model_name(d.fit.model.named)}")
        for name in d.removable:
            button(view, f"Remove {name}", partial(view.remove, name), "outline dense")
    answer(view, "model")


def fails(view: View, d: Snapshot) -> None:
    """Draw where the model fails."""
    title("Where it fails")
    if d.diagnosis.residual_is_noise:
        soft("Nowhere beyond the noise: what is left is what it explains.")
        return
    soft(follows(d.diagnosis.misfit_breakdown))
    shown = chart(view, misfit_shares(d.diagnosis))
    shown.props("data-part=fails")
    shown.on("plotly_click", lambda e: _picked_bar(view, d, e))
    soft("Click a bar: the readings over that variable.")


def _picked_bar(view: View, d: Snapshot, e: GenericEventArguments) -> None:
    names = [v.variable for v in d.diagnosis.misfit_breakdown]
    told = str(point(e).get("y", ""))
    if told in names:
        view.pick_variable(told)


def missing(view: View, d: Snapshot) -> None:
    """Draw the ranked missing effects."""
    title("What is missing")
    rows = shown_suspects(d.diagnosis) if d.diagnosis.significant else []
    if not rows:
        soft(NONE_PASSES)
    else:
        found = suspects_table(d.diagnosis)  # what it is inseparable from is said below
        found = replace(found, heads=found.heads[:4], rows=[row[:4] for row in found.rows])
        table = drawn(found, selection="single")
        table.props("hide-selected-banner data-part=missing").classes("choice")
        table.selected = [row for row in table.rows if row["0"] == view.tab.suspect]

        def clicked(e: GenericEventArguments) -> None:
            row = e.args[1]
            table.selected = [row]
            view.choose(row["0"])

        table.on("row-click", clicked)

        def ticked(e: TableSelectionEventArguments) -> None:
            for row in e.selection:
                view.choose(row["0"])

        table.on_select(ticked)
        same = rows[0].same_as if rows[0].passes else ()
        if same:
            soft(f"These readings do not separate {rows[0].effect} from {numbers.few(same)}.")
        soft(
            "explains: share of the misfit that adding it would remove; p-value: chance of that "
            "much if it were not there."
        )
    others = [s.effect for s in d.diagnosis.suspects]
    view.adder = None
    if not others:
        answer(view, "missing")
    else:
        kind = "unelevated" if rows else "outline"
        view.adder = button(view, f"Add {view.tab.suspect}", view.add, f"{kind} data-part=add")
        view.adder.set_visibility(view.tab.suspect is not None)
        answer(view, "missing")
        ui.select(
            others,
            label="Another effect",
            value=view.tab.suspect,
            on_change=lambda e: view.choose(e.value),
        ).props("dense outlined options-dense").style("width: 100%")


def evidence(view: View, d: Snapshot) -> None:
    """Draw the evidence of the chosen suspect."""
    effect = view.tab.suspect
    title("The evidence" if effect is None else f"The evidence for {effect}")
    if effect is None:
        soft("Choose an effect above to see what the readings say of it.")
        return
    with ui.column().style("width: 100%; gap: 8px") as place:
        soft("…")

    async def draw() -> None:
        found = await run.io_bound(view.session.evidence, d, effect)
        if place.is_deleted:  # something else was chosen meanwhile
            return
        place.clear()
        with place:
            if found is None:
                soft("These readings say nothing of it.")
            else:
                chart(view, added_variable(found, effect)).props("data-part=evidence")

    background_tasks.create(draw(), name="evidence")


def readings(view: View, d: Snapshot) -> None:
    """Draw the residuals over a variable, the readings that were picked and what they share."""
    variable = view.tab.variable
    plain_kind = variable in (None, "load")
    found = None if plain_kind else view.session.recorded(d).get(variable or "")
    title("The readings" if variable is None else f"The readings over {variable}")
    if found is None or variable == "load":
        kind = residual_by_load if variable == "load" else residual_by_pose
        figure = kind(d.story, d.revision)
    else:
        name, factor = numbers.angle_or(found.unit)
        figure = residual_over(d.story, d.revision, factor * found.values, found.name, name)
    shown = chart(view, figure).props("data-part=readings")
    shown.on("plotly_click", lambda e: view.pick_pose(int(point(e).get("customdata", -1))))
    picked = view.tab.picked
    if picked is None:
        soft("Click a point: the readings of its pose, and what sets them apart.")
        return
    ui.label(f"{view.tab.told}:").style("font-weight: 500")
    differences = [x for x in view.session.differences(d, np.array(picked)) if x.clear]
    told = [difference(x) for x in differences[:DIFFERENCES]]
    ui.label(
        f"What sets them apart: {'; '.join(told)}."
        if told
        else "Nothing recorded sets them apart from the others."
    ).props("data-part=differences")
    picked_table(d, picked)


def picked_table(d: Snapshot, picked: list[int]) -> None:
    """Draw the picked readings, the furthest off first."""
    sigma, size = d.revision.sigma, d.revision.size_m
    order = sorted(picked, key=lambda k: -sigma[k])[:FURTHEST]
    told = block("pose", "load", "error", "in noise", left=(0, 1, 2, 3))
    for k in order:
        size_of, load = numbers.length(float(size[k])), load_name(d.story.load_names[k])
        told.add(d.story.pose_name(k), load, size_of, f"{sigma[k]:.1f} σ")
    drawn(told).props("data-part=picked")
    if len(picked) > len(order):
        soft(f"and {len(picked) - len(order)} more")


def difference(x: Difference) -> str:
    """Write how picked readings differ from the others."""
    if x.variable.startswith("load "):
        name = "unloaded" if x.variable == f"load {UNLOADED}" else x.variable
        mine, others = numbers.percent(x.picked), numbers.percent(x.others)
        return f"{name}: {mine} of them, {others} of the others"
    unit, factor = numbers.angle_or(x.unit)
    a, b = (numbers.digits(factor * value) for value in (x.picked, x.others))
    return f"{x.variable} {a} {unit}, the others {b} {unit}".replace(" ,", ",").rstrip()


def furthest(d: Snapshot) -> list[int]:
    """Return the readings that are furthest off, in units of the noise."""
    norm2 = d.revision.whitened_norm2
    count = max(FURTHEST, round(FURTHEST_SHARE * len(norm2)))
    return [int(k) for k in np.argsort(-norm2, kind="stable")[:count]]


def fell(view: View, d: Snapshot) -> None:
    """Draw how the error fell."""
    title("How the error fell")
    chart(view, error_per_revision(d.story)).props("data-part=fell")


def revisions(view: View, d: Snapshot) -> None:
    """Draw all revisions, each with the way back to it."""
    title("Revisions")
    if not d.records:
        soft("None yet: the baseline is kept when something is added to it.")
    for record in reversed(d.records):
        one_revision(view, d, record)
    if d.accepted is not None:
        soft(f"Revision {d.accepted} is accepted: every command uses it.")
    answer(view, "revisions")
    soft("Revisions are only appended: nothing that was tried is lost.")


def one_revision(view: View, d: Snapshot, r: RevisionRecord) -> None:
    """Draw one revision."""
    marks = [word for word, holds in (("shown", r.number == d.number),
                                      ("used by every command", r.number == d.in_use))
             if holds]  # fmt: skip
    with ui.element("div").classes("line").props(f"data-revision={r.number}"):
        with ui.column().style("gap: 0"):
            ui.label(f"{r.number}: {model_words(r)}").style("font-weight: 500")
            said = [f"{numbers.length(left_out_m(r))} on poses left out", verdict_of(r), *marks]
            soft(" · ".join(said))
        if r.number != d.number:
            button(view, "Look", lambda: view.show(r.number), "flat dense")
        if r.number not in (d.number, d.in_use) or d.number != d.in_use:
            button(view, "Go back to it" if r.number != d.number else "Use it",
                   lambda: view.go_back(r.number), "outline dense")  # fmt: skip


def side_by_side(view: View, d: Snapshot) -> None:
    """Draw two revisions side by side."""
    title("Two revisions side by side")
    if len(d.records) < 2:
        soft("There are two to compare once something was added, removed or changed.")
        return
    by_number = {r.number: r for r in d.records}
    shown = d.number or d.records[-1].number
    first, second = view.tab.pair or (shown - 1 or shown + 1, shown)
    names = {n: f"{n}: {model_words(r)}" for n, r in by_number.items()}
    with ui.element("div").classes("two"):
        chosen = [
            ui.select(names, label=label, value=n).props("dense outlined options-dense")
            for label, n in (("First", first), ("Second", second))
        ]
    place = ui.column().classes("wide").props("data-part=pair")

    def draw() -> None:
        view.tab.pair = first, second = chosen[0].value, chosen[1].value
        place.clear()
        with place:
            drawn(two_revisions(by_number[first], by_number[second])).props("wrap-cells")

    for one in chosen:
        one.on_value_change(draw)
    if {first, second} <= by_number.keys():
        with place:
            drawn(two_revisions(by_number[first], by_number[second])).props("wrap-cells")


def compared(view: View, d: Snapshot) -> None:
    """Draw what was measured against what is predicted."""
    title("Model and measurement")
    soft(misses(d.fit))
    chart(view, measured_predicted(d.story, d.revision))


def laws(view: View, found: tuple[DependenceCurve, ...]) -> None:
    """Draw the laws of the model that the catalogue does not have."""
    title("Laws beyond the catalogue")
    for one in found:
        told = "; ".join(f"{what}: {said}" for what, said in one.facts)
        soft(f"{one.title}: {told}")
        chart(view, curve_chart(one)).props("data-part=law")


def viewer(view: View) -> None:
    """Draw the 3-D view, or what opens it."""
    with ui.column().classes("part").style("margin: 16px 0 32px"):
        title("The arm and its readings in space")
        if view.tab.viewer:
            frame = ui.element("iframe").classes("view3d")
            frame.props["src"], frame.props["title"] = view.tab.viewer, "3-D view"
        else:
            button(view, "Open the 3-D view", view.open_viewer, "outline")
            answer(view, "viewer")


def cell(view: View, d: Snapshot) -> None:
    """Draw what can be changed in the cell; what is typed stays until it is used."""
    title("Noise and cell")
    soft(
        "Change values, written as in CELL.toml; an empty field leaves the key out. The shown "
        "model is then fitted anew, as a revision; what was measured stays as it is."
    )
    soft(f"Now: {d.covariance}.")
    for why in dict.fromkeys(f.fixed for f in d.figures if f.fixed):
        keys = [f.key for f in d.figures if f.fixed == why]
        soft(f"Not to be changed here: {', '.join(keys)}: {why}.")
    with ui.element("div").classes("figures").props("data-part=cell"):
        for f in d.figures:
            if not f.fixed:
                figure_field(view, f)
    button(view, "Fit with these values", view.change_cell, "unelevated data-part=change")
    answer(view, "cell")


def figure_field(view: View, f: Figure) -> None:
    """Draw a value of the cell."""
    at = f.section, f.key
    field = ui.input(f"[{f.section}] {f.key}", value=view.tab.texts.get(at, f.text))
    field.props("dense outlined").props["hint"] = f.valid

    def typed() -> None:
        view.tab.texts[at] = field.value or ""

    field.on_value_change(typed)


def downloads(view: View, d: Snapshot) -> None:
    """Draw what can be had as a file."""
    title("Downloads")
    soft(
        f"Of {'the baseline' if d.number is None else f'revision {d.number}'}: the story as one "
        "page, the calibration for hilcal compensate, and the readings as an exchange table."
    )
    with ui.row().style("gap: 8px"):
        for kind, name in DOWNLOADS.items():
            button(view, name, partial(view.download, kind), "outline")
    answer(view, "download")
