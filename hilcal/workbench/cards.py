"""The cards of the page: the verdict, where it fails, what is missing, revisions."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from nicegui import background_tasks, run, ui
from nicegui.events import GenericEventArguments, TableSelectionEventArguments

from hilcal.data.plan import UNLOADED
from hilcal.diagnose.diagnosis import Diagnosis
from hilcal.diagnose.distinguish import Difference
from hilcal.diagnose.effect_ranking import Suspect
from hilcal.report import numbers, text, text_refine
from hilcal.report.charts import error_per_revision, measured_predicted, misfit, residuals
from hilcal.report.charts.added_variable import added_variable
from hilcal.report.charts.law import law
from hilcal.report.charts.residual_over import residual_over
from hilcal.report.verdict_words import headline, message
from hilcal.workbench.elements import button, chart, number, plain, point, title
from hilcal.workbench.next_card import next_measurement
from hilcal.workbench.snapshot import RevisionRow, Snapshot

if TYPE_CHECKING:
    from hilcal.workbench.page import View

CERTAIN = text.CERTAIN
SUSPECTS = 6
FURTHEST = 8
FURTHEST_SHARE = 0.05
"""Share of the readings that are compared with the others as those furthest off; a choice."""
DIFFERENCES = 4


def waiting(view: View) -> None:
    """Say that nothing is there yet."""
    with ui.column().classes("part").style("margin-top: 16px"):
        ui.html(f"<h2>{plain(view.session.path.name)}</h2>", sanitize=False)
        if view.work.failure:
            ui.label("There is nothing to show: see above.").classes("soft")
            button(view, "Read it again", view.again, "outline")
        else:
            ui.label("The readings are fitted and judged; this takes some seconds.").classes("soft")


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
            if d.revision.laws:
                with ui.column().classes("part"):
                    laws(view, d)
        with ui.column().classes("stack"):
            with ui.column().classes("part"):
                revisions(view, d)
            with ui.column().classes("part"):
                next_measurement(view, d)
                view.planned = ui.column().style("width: 100%; gap: 8px")
    view.draw_plan()


def head(d: Snapshot) -> None:
    """Draw which campaign this is."""
    kind = "deflections" if d.fit.mode == "deflection" else "absolute readings"
    with ui.row().classes("items-baseline").style("gap: 4px 16px; padding-top: 16px"):
        ui.html(f"<h1 class='verdict'>{plain(d.name)}</h1>", sanitize=False)
        ui.label(f"{d.arm} · {d.n_readings} readings, judged as {kind}").classes("soft")


def verdict(view: View, d: Snapshot) -> None:
    """Draw whether the model is good."""
    found, fit = d.diagnosis, d.fit
    good = found.verdict == "adequate"
    with ui.column().classes("part").props("data-part=verdict"):
        changed = view.session.changed
        if changed is not None and changed.number == d.number:
            effect = changed.added or changed.removed or ""
            words = text_refine.fell if changed.added else text_refine.rose
            ui.label(words(changed.before, changed.fit, effect)).classes("told").props(
                "role=status"
            )
            for line in (
                () if changed.expected is None else text_refine.addition_lines(changed.expected)
            ):
                ui.label(line).classes("bad")
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
        ui.label(f"{called}: {text.model_name(d.fit.model.named)}").classes("soft")
        for name in d.removable:
            button(view, f"Remove {name}", partial(view.remove, name), "outline dense")


def fails(view: View, d: Snapshot) -> None:
    """Draw where the model fails."""
    title("Where it fails")
    if d.diagnosis.residual_is_noise:
        ui.label("Nowhere beyond the noise: what is left is what it explains.").classes("soft")
        return
    ui.label(text.follows(d.diagnosis.misfit_breakdown)).classes("soft")
    shown = chart(view, misfit.misfit_shares(d.diagnosis))
    shown.props("data-part=fails")
    shown.on("plotly_click", lambda e: _picked_bar(view, d, e))
    ui.label("Click a bar: the readings over that variable.").classes("soft")


def _picked_bar(view: View, d: Snapshot, e: GenericEventArguments) -> None:
    names = [v.variable for v in d.diagnosis.misfit_breakdown]
    told = str(point(e).get("y", ""))
    if told in names:
        view.pick_variable(told)


def missing(view: View, d: Snapshot) -> None:
    """Draw the ranked missing effects."""
    title("What is missing")
    rows = suspects(d.diagnosis)
    if not rows:
        ui.label(none_passes(d.diagnosis)).classes("soft")
    else:
        columns = [
            {"name": "effect", "label": "effect", "field": "effect", "align": "left"},
            {"name": "share", "label": "explains", "field": "share"},
            {"name": "left_out", "label": "left out", "field": "left_out"},
            {"name": "p", "label": "p-value", "field": "p"},
        ]
        table = ui.table(
            columns=columns,
            rows=[
                {
                    "effect": s.effect,
                    "share": numbers.percent(s.share),
                    "left_out": numbers.percent(max(s.holdout_share, 0.0)),
                    "p": numbers.chance(s.score.p_value),
                }
                for s in rows
            ],
            row_key="effect",
            selection="single",
        )
        table.props("flat dense hide-selected-banner data-part=missing")
        table.classes("choice").style("width: 100%")
        table.selected = [row for row in table.rows if row["effect"] == view.tab.suspect]

        def clicked(e: GenericEventArguments) -> None:
            row = e.args[1]
            table.selected = [row]
            view.choose(row["effect"])

        table.on("row-click", clicked)

        def ticked(e: TableSelectionEventArguments) -> None:
            for row in e.selection:
                view.choose(row["effect"])

        table.on_select(ticked)
        same = rows[0].same_as if rows[0].passes else ()
        if same:
            ui.label(
                f"These readings do not separate {rows[0].effect} from {numbers.few(same)}."
            ).classes("soft")
        ui.label(
            "explains: share of the misfit that adding it would remove; left out: the same on "
            "poses left out; p-value: chance of that much if it were not there."
        ).classes("soft")
    others = [s.effect for s in d.diagnosis.suspects]
    view.adder = None
    if others:
        kind = "unelevated" if rows else "outline"
        view.adder = button(view, f"Add {view.tab.suspect}", view.add, f"{kind} data-part=add")
        view.adder.set_visibility(view.tab.suspect is not None)
        ui.select(
            others,
            label="Another effect",
            value=view.tab.suspect,
            on_change=lambda e: view.choose(e.value),
        ).props("dense outlined options-dense").style("width: 100%")


def none_passes(d: Diagnosis) -> str:
    """Say why no suspects are listed; whether an effect is missing is the verdict's to say."""
    if d.verdict == "adequate":
        return "No effect of the catalogue is needed: none passes the tests."
    return "No single effect of the catalogue passes the tests; the verdict says what is known."


def suspects(d: Diagnosis) -> list[Suspect]:
    """Return the suspects that chance alone does not explain, as the commands list them."""
    if not d.significant:
        return []
    return [s for s in d.suspects if s.passes or s.score.p_value < CERTAIN][:SUSPECTS]


def evidence(view: View, d: Snapshot) -> None:
    """Draw the evidence of the chosen suspect."""
    effect = view.tab.suspect
    title("The evidence" if effect is None else f"The evidence for {effect}")
    if effect is None:
        ui.label("Choose an effect above to see what the readings say of it.").classes("soft")
        return
    with ui.column().style("width: 100%; gap: 8px") as place:
        ui.label("…").classes("soft")

    async def draw() -> None:
        found = await run.io_bound(view.session.evidence, d, effect)
        if place.is_deleted:  # something else was chosen meanwhile
            return
        place.clear()
        with place:
            if found is None:
                ui.label("These readings say nothing of it.").classes("soft")
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
        kind = residuals.residual_by_load if variable == "load" else residuals.residual_by_pose
        figure = kind(d.story, d.revision)
    else:
        name, factor = numbers.angle_or(found.unit)
        figure = residual_over(d.story, d.revision, factor * found.values, found.name, name)
    shown = chart(view, figure).props("data-part=readings")
    shown.on("plotly_click", lambda e: view.pick_pose(int(point(e).get("customdata", -1))))
    picked = view.tab.picked
    if picked is None:
        ui.label("Click a point: the readings of its pose, and what sets them apart.").classes(
            "soft"
        )
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
    sigma = np.sqrt(d.revision.whitened_norm2)
    size = np.linalg.norm(d.revision.residual, axis=1)
    order = sorted(picked, key=lambda k: -sigma[k])[:FURTHEST]
    rows = [
        {
            "at": k,
            "pose": d.story.pose_name(k),
            "load": "unloaded" if d.story.load_names[k] == UNLOADED else d.story.load_names[k],
            "error": numbers.length(float(size[k])),
            "sigma": f"{sigma[k]:.1f} σ",
        }
        for k in order
    ]
    columns = [
        {"name": n, "label": n.replace("sigma", "in noise"), "field": n, "align": "left"}
        for n in ("pose", "load", "error", "sigma")
    ]
    table = ui.table(columns=columns, rows=rows, row_key="at").props("flat dense data-part=picked")
    table.style("width: 100%")
    if len(picked) > len(order):
        ui.label(f"and {len(picked) - len(order)} more").classes("soft")


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
    chart(view, error_per_revision.error_per_revision(d.story)).props("data-part=fell")


def revisions(view: View, d: Snapshot) -> None:
    """Draw all revisions, each with the way back to it."""
    title("Revisions")
    if not d.rows:
        ui.label("None yet: the baseline is kept when something is added to it.").classes("soft")
    for row in reversed(d.rows):
        one_revision(view, d, row)
    if d.accepted is not None:
        ui.label(f"Revision {d.accepted} is accepted: every command uses it.").classes("soft")
    ui.label("Revisions are only appended: nothing that was tried is lost.").classes("soft")


def one_revision(view: View, d: Snapshot, row: RevisionRow) -> None:
    """Draw one revision."""
    marks = [word for word, holds in (("shown", row.number == d.number),
                                      ("used by every command", row.number == d.in_use))
             if holds]  # fmt: skip
    change = row.change or text.model_name(row.model)
    with ui.element("div").classes("line").props(f"data-revision={row.number}"):
        with ui.column().style("gap: 0"):
            ui.label(f"{row.number}: {change}").style("font-weight: 500")
            said = [
                f"{numbers.length(row.left_out_m)} on poses left out",
                row.verdict.replace("_", " "),
                *marks,
            ]
            ui.label(" · ".join(word for word in said if word)).classes("soft")
        if row.number != d.number:
            button(view, "Look", lambda: view.show(row.number), "flat dense")
        if row.number not in (d.number, d.in_use) or d.number != d.in_use:
            button(view, "Go back to it" if row.number != d.number else "Use it",
                   lambda: view.go_back(row.number), "outline dense")  # fmt: skip


def compared(view: View, d: Snapshot) -> None:
    """Draw what was measured against what is predicted."""
    title("Model and measurement")
    ui.label(text.misses(d.fit)).classes("soft")
    chart(view, measured_predicted.measured_predicted(d.story, d.revision))


def laws(view: View, d: Snapshot) -> None:
    """Draw the laws of the model that the catalogue does not have."""
    title("Laws beyond the catalogue")
    for one in d.revision.laws:
        ui.label(f"{one.name}: {one.formula}; {one.coefficients}; acts on {one.acts_on}").classes(
            "soft"
        )
        chart(view, law(one)).props("data-part=law")


def viewer(view: View) -> None:
    """Draw the 3-D view, or what opens it."""
    with ui.column().classes("part").style("margin: 16px 0 32px"):
        title("The arm and its readings in space")
        if view.tab.viewer:
            frame = ui.element("iframe").classes("view3d")
            frame.props["src"], frame.props["title"] = view.tab.viewer, "3-D view"
        else:
            button(view, "Open the 3-D view", view.open_viewer, "outline")
