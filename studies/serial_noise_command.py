"""`python -m studies serial-noise`: intervals and verdicts where noise is correlated in time."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from typing import Annotated

import numpy as np
import typer

from hilcal.cli.demo import CELL
from hilcal.cli.options import Jobs, Json, Scheduler
from hilcal.cli.terminal import terminal
from hilcal.config import load_config
from hilcal.engine.engine import open_engine
from hilcal.present.progress import counting
from hilcal.robot.catalogue import configs_dir
from studies.records import Figure, Keep, keep
from studies.serial_noise import Outcome, SerialCase, serial_case

HELD = 0.93
"""Share of true values within 95 % intervals that is required of strongly correlated noise."""
STRONG = 0.9
DRIFT = "tracker_drift"


def serial_noise(
    campaigns: Annotated[int, typer.Option("--campaigns", help="For each ρ.")] = 100,
    drifts: Annotated[int, typer.Option("--drifts", help="With a drift of 2 σ, for each ρ.")] = 12,
    rhos: Annotated[str, typer.Option("--rho", help="ρ of successive readings.")] = "0,0.5,0.7,0.9",
    robot: Annotated[str, typer.Option("--robot", help="The arm.")] = "ur10e",
    poses: Annotated[int, typer.Option("--poses", help="Of six readings each.")] = 10,
    first_seed: Annotated[int, typer.Option("--first-seed", help="Seeds count from here.")] = 0,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Fit campaigns of AR(1) noise of the stated variance, taken for white and as it is."""
    t = terminal(as_json)
    run = partial(
        serial_case, config=load_config(configs_dir() / "cells" / CELL), robot=robot, poses=poses
    )
    values = [float(rho) for rho in rhos.split(",")]
    asked = [
        (first_seed + k, rho, hidden)
        for rho in values
        for hidden, count in (("", campaigns), (DRIFT, drifts))
        for k in range(count)
    ]
    with (
        open_engine(jobs, scheduler) as engine,
        counting(t.progress, "campaigns", len(asked)) as advance,
    ):
        cases = engine.map(run, asked, advance=advance)
    figures = list(_figures(cases, values))
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    t.document({"cases": [asdict(c) for c in cases]})
    title = f"Noise that is correlated along the order of the readings, ρ = {rhos}"
    keep(keep_file, title, figures)


def _figures(cases: Sequence[SerialCase], rhos: Sequence[float]) -> Iterator[Figure]:
    for rho in rhos:
        own = [c for c in cases if c.rho == rho]
        mine = [c for c in own if not c.hidden]
        if mine:
            yield from _of_noise(mine, rho)
        drifts = [c for c in own if c.hidden]
        if drifts:
            named = [_share(drifts, lambda o: o.added == (DRIFT,), w) for w in (False, True)]
            yield Figure(
                f"ρ = {rho:g}, a drift of 2 σ, twice the poses: it alone is named",
                f"white {named[0]}, as it is {named[1]} of {len(drifts)}",
            )


def _of_noise(mine: Sequence[SerialCase], rho: float) -> Iterator[Figure]:
    for words, part in (("parameters", "parameters"), ("predictions", "predictions")):
        shares = []
        for which in ("before", "after"):
            counts = np.array([getattr(getattr(c, which), part) for c in mine])
            shares.append(float(counts[:, 0].sum() / counts[:, 1].sum()))
        strong = rho >= STRONG
        yield Figure(
            f"ρ = {rho:g}: true {words} within 95 % intervals",
            f"white {100 * shares[0]:.1f} %, as it is {100 * shares[1]:.1f} %",
            f"≥ {100 * HELD:.0f} %" if strong else "",
            shares[1] >= HELD if strong else None,
        )
    for words, of in (
        ("adequate", lambda o: o.verdict == "adequate"),
        ("an effect is named falsely", lambda o: bool(o.added) or o.verdict == "missing_effect"),
        ("unknown_effect", lambda o: o.verdict == "unknown_effect"),
    ):
        shares_of = [_share(mine, of, w) for w in (False, True)]
        yield Figure(
            f"ρ = {rho:g}: {words}", f"white {shares_of[0]}, as it is {shares_of[1]} of {len(mine)}"
        )
    found = [c.found for c in mine if c.found is not None and c.proved]
    doubt = sum(c.found is not None and not c.proved for c in mine)
    spread = f", ρ = {np.mean(found):.3f} ± {np.std(found):.3f}" if found else ""
    none = rho == 0.0
    yield Figure(
        f"ρ = {rho:g}: correlation found",
        f"{len(found)} of {len(mine)}{spread}; {doubt} in doubt",
        "≤ 1 %" if none else "",
        len(found) + doubt <= 0.01 * len(mine) if none else None,
    )


def _share(cases: Sequence[SerialCase], of: Callable[[Outcome], bool], after: bool) -> str:
    true = [of(c.after if after else c.before) for c in cases]
    return f"{100 * float(np.mean(true)):.0f} %"
