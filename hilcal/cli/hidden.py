"""`study hidden`: how often a hidden effect is found, and one is named where there is none."""

from dataclasses import asdict
from typing import Annotated

import typer
from rich.table import Table

from drivers.simulated.hidden import DEFLECTION_EFFECTS
from drivers.simulated.rehearsal import NOTHING, choices, rehearse
from hilcal.cell import Cell
from hilcal.cli.demo import CELL
from hilcal.cli.terminal import Json, terminal
from hilcal.config import load_config
from hilcal.data.readings import Readings
from hilcal.data.whitening import Mode
from hilcal.errors import InputError
from hilcal.report import text
from hilcal.report.progress import counting
from hilcal.robot.catalogue import configs_dir
from hilcal.study.hidden import Case, Rate, rates, run_case


def hidden(
    seeds: Annotated[int, typer.Option("--seeds", help="Campaigns per hidden effect.")] = 20,
    nothing: Annotated[int, typer.Option("--nothing", help="Campaigns that hide nothing.")] = 200,
    as_json: Json = False,
) -> None:
    """Hide each effect in simulated campaigns, and count how often it is found."""
    t = terminal(as_json)
    if min(seeds, nothing) < 1:
        raise InputError(f"--seeds {seeds}, --nothing {nothing}; valid: whole numbers from 1")
    config = load_config(configs_dir() / "cells" / CELL)

    def simulate(effect: str, mode: Mode, seed: int) -> tuple[Cell, Readings]:
        r = rehearse(config, effect, seed)
        return r.cell, r.readings

    effects = choices()
    cases: list[Case] = []
    with counting(t.progress, "campaigns", len(effects) * seeds + nothing) as advance:
        for effect in (*effects, NOTHING):
            mode: Mode = "deflection" if effect in DEFLECTION_EFFECTS else "absolute"
            for seed in range(nothing if effect == NOTHING else seeds):
                cases.append(run_case(simulate, effect, mode, seed))
                advance(1)
    found = rates(cases)
    t.show(_table(found))
    t.show(
        "right: the verdict names what is hidden, alone or in a set that cannot be told apart; "
        "before, after: median variance factor without and with it; 1 in interval: its 95 % "
        "interval afterwards."
    )
    t.document({"rates": [asdict(r) for r in found], "cases": [asdict(c) for c in cases]})


def _table(found: tuple[Rate, ...]) -> Table:
    out = text.table(
        "hidden", "readings", "n", "right", "1 in interval", "before", "after", left=(0, 1)
    )
    for r in found:
        out.add_row(
            r.effect,
            r.mode,
            str(r.seeds),
            f"{r.found:.1%}",
            f"{r.covered:.1%}",
            f"{r.before:.2f}",
            f"{r.after:.2f}",
        )
    return out
