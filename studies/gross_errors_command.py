"""`python -m studies gross-errors`: campaigns with errors of millimetres in many readings."""

from collections import Counter
from collections.abc import Sequence
from typing import Annotated

import typer

from hilcal.cli.options import Jobs, Json, Scheduler
from hilcal.cli.terminal import terminal
from hilcal.config import load_config
from hilcal.engine import open_engine
from hilcal.present.document import table
from hilcal.present.progress import counting
from hilcal.robot.catalogue import configs_dir
from studies.gross_errors import GrossErrorCase, GrossErrorCounts, count
from studies.records import Figure, Keep, keep

CELL = "demo_ur10e.toml"
ARMS: tuple[tuple[float, float, float | None], ...] = (
    (0.2, 5e-3, 0.95),
    (0.4, 5e-3, 0.8),
    (0.2, 1e-3, None),
    (0.4, 1e-3, None),
    (0.2, 5e-2, None),
    (0.4, 5e-2, None),
)
"""Share of the readings, size of the errors in m, and the share of them that must be found."""
FALSE = 0.01
"""Largest share of the good readings that may be set aside."""
TOO_MANY = 0.6
"""Share of gross errors with which no answer is possible."""


def gross_errors(
    campaigns: Annotated[
        int, typer.Option("--campaigns", help="Campaigns of each share and size.")
    ] = 60,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
    keep_file: Keep = None,
) -> None:
    """Spoil readings of campaigns, refine their models, and count what was set aside."""
    t = terminal(as_json)
    kinds = [(share, size) for share, size, _ in ARMS] + [(0.0, 5e-3), (TOO_MANY, 5e-3)]
    every = [
        GrossErrorCase(share, size, k * campaigns + seed)
        for k, (share, size) in enumerate(kinds)
        for seed in range(campaigns)
    ]
    with (
        open_engine(jobs, scheduler) as engine,
        counting(t.progress, "campaigns", len(every)) as advance,
    ):
        counted = engine.map(_counted, every, advance=advance)
    figures = []
    out = table("wrong", "size", "campaigns", "readings", "found", "false", "verdicts")
    for k, (share, size) in enumerate(kinds):
        of_kind = counted[k * campaigns : (k + 1) * campaigns]
        figures += _figures(of_kind, share, size)
        hits, wrong = sum(c.found for c in of_kind), sum(c.wrong for c in of_kind)
        readings, false = sum(c.readings for c in of_kind), sum(c.false for c in of_kind)
        row = (len(of_kind), readings, f"{hits} of {wrong}", false, _verdicts(of_kind))
        out.add(f"{100 * share:.0f} %", f"{1e3 * size:g} mm", *(str(x) for x in row))
    t.show(out)
    t.document({"campaigns": [_row(c) for c in counted]})
    keep(keep_file, "Gross errors", figures)


def _counted(campaign: GrossErrorCase) -> GrossErrorCounts:
    return count(load_config(configs_dir() / "cells" / CELL), campaign)


def _figures(campaigns: Sequence[GrossErrorCounts], share: float, size: float) -> list[Figure]:
    """Figures of the campaigns of one share and size."""
    total = len(campaigns)
    readings, wrong = sum(c.readings for c in campaigns), sum(c.wrong for c in campaigns)
    hits, false = sum(c.found for c in campaigns), sum(c.false for c in campaigns)
    kind = f"{100 * share:.0f} % of the readings {1e3 * size:g} mm off"
    where = f"{total} campaigns of {readings} readings"
    adequate = sum(c.outcome == "adequate" for c in campaigns)
    verdicts = Figure(f"{kind}: verdicts", _verdicts(campaigns))
    if share > 0.45:
        reported = sum(c.said or c.outcome == "refused" for c in campaigns)
        return [
            Figure(
                f"{kind}: said, of {where}",
                f"{reported} of {total}",
                f"{total}",
                reported == total,
            ),
            Figure(f"{kind}: adequate", f"{adequate} of {total}", "0", adequate == 0),
            verdicts,
        ]
    right = readings - wrong
    false_share = Figure(
        f"{kind}: good readings set aside",
        f"{false} of {right} ({100 * false / right:.2f} %)",
        f"{100 * FALSE:.0f} %",
        false <= FALSE * right,
    )
    if not wrong:
        return [false_share, verdicts]
    required = next(r for s, z, r in ARMS if (s, z) == (share, size))
    return [
        Figure(
            f"{kind}: found, in {where}",
            f"{hits} of {wrong} ({100 * hits / wrong:.1f} %)",
            "" if required is None else f"{100 * required:.0f} %",
            None if required is None else hits >= required * wrong,
        ),
        false_share,
        verdicts,
    ]


def _verdicts(campaigns: Sequence[GrossErrorCounts]) -> str:
    return ", ".join(f"{n} {v}" for v, n in Counter(c.outcome for c in campaigns).most_common())


def _row(c: GrossErrorCounts) -> dict[str, object]:
    return {
        "share": c.case.share,
        "size_m": c.case.size_m,
        "seed": c.case.seed,
        "readings": c.readings,
        "mode": c.mode,
        "wrong": c.wrong,
        "found": c.found,
        "false": c.false,
        "outcome": c.outcome,
        "said": c.said,
        "what": c.what,
    }
