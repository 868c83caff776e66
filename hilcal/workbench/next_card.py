"""The card that asks for the next measurement, and the plan that came of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from nicegui import ui

from hilcal.present.plan import power_rows, powers_summary
from hilcal.workbench.elements import answer, button, soft, title
from hilcal.workbench.session import WorkbenchSession
from hilcal.workbench.snapshot import Snapshot

if TYPE_CHECKING:
    from hilcal.workbench.page import View


def next_measurement(view: View, d: Snapshot) -> None:
    """Draw what asks for the next measurement."""
    title("Measure next")
    soft("Plan the poses and loads that tell apart what these readings leave open.")
    stem = view.session.path.stem
    with ui.row().classes("items-center").style("gap: 12px; width: 100%"):
        poses = ui.number("poses (as needed)", min=1, precision=0).props("dense outlined")
        poses.style("width: 190px")
        file = ui.input("plan file", value=f"{stem}-next-{d.number or 0}.json")
        file.props("dense outlined").style("flex: 1 1 180px")
    compare = ui.checkbox("Compare criteria and numbers of poses first; takes longer")

    def plan() -> None:
        view.plan(poses.value, file.value, quick=not compare.value)

    button(view, "Plan the next measurements", plan, "unelevated")
    answer(view, "next")


def planned(session: WorkbenchSession) -> None:
    """Draw the next measurements."""
    if session.planned is None:
        return
    found, path = session.planned
    summary = found.made.summary
    ui.label(powers_summary(found.found.powers, summary.poses, summary.readings)).props(
        "data-part=planned"
    )
    for effect, rival, now, then in power_rows(found.found.powers):
        soft(f"If {effect} is there, {rival} is ruled out: {now} now, {then} then.")
    ui.label(f"The plan is in {path.name}. Measure it into the same campaign with:")
    ui.label(session.run_line()).classes("code")
    soft("Then read the file again here.")
