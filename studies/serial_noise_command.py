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
from hilcal.engine import open_engine
from hilcal.present.progress import counting
from hilcal.robot.catalogue import configs_dir
from studies.records import Figure, Keep, keep
from studies.serial_noise import SerialCase, SerialNoiseOutcome, serial_case

HELD = 0.93
"""Required share of true values within 95 % intervals for strongly correlated noise."""
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
    settings = [
        (first_seed + k, rho, hidden)
        for rho in values
        for hidden, count in (("", campaigns), (DRIFT, drifts))
        for k in range(count)
    ]
    with (
        open_engine(jobs, scheduler) as engine,
        counting(t.progress, "campaigns", len(settings)) as advance,
    ):
        cases = engine.map(run, settings, advance=advance)
    figures = list(_figures(cases, values))
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    t.document({"cases": [asdict(c) for c in cases]})
    title = f"Noise that is correlated along the order of the readings, ρ = {rhos}"
    keep(keep_file, title, figures)


def _figures(cases: Sequence[SerialCase], rhos: Sequence[float]) -> Iterator[Figure]:
    for rho in rhos:
        of_rho = [c for c in cases if c.rho == rho]
        plain = [c for c in of_rho if not c.hidden]
        if plain:
            yield from _of_noise(plain, rho)
        drifts = [c for c in of_rho if c.hidden]
        if drifts:
            named = [_share(drifts, lambda o: o.added == (DRIFT,), w) for w in (False, True)]
            yield Figure(
                f"ρ = {rho:g}, a drift of 2 σ, twice the poses: it alone is named",
                f"white {named[0]}, as it is {named[1]} of {len(drifts)}",
            )


def _of_noise(cases: Sequence[SerialCase], rho: float) -> Iterator[Figure]:
    for part in ("parameters", "predictions"):
        shares = []
        for which in ("before", "after"):
            counts = np.array([getattr(getattr(c, which), part) for c in cases])
            shares.append(float(counts[:, 0].sum() / counts[:, 1].sum()))
        strong = rho >= STRONG
        yield Figure(
            f"ρ = {rho:g}: true {part} within 95 % intervals",
            f"white {100 * shares[0]:.1f} %, as it is {100 * shares[1]:.1f} %",
            f"≥ {100 * HELD:.0f} %" if strong else "",
            shares[1] >= HELD if strong else None,
        )
    for title, holds in (
        ("adequate", lambda o: o.verdict == "adequate"),
        ("an effect is named falsely", lambda o: bool(o.added) or o.verdict == "missing_effect"),
        ("unknown_effect", lambda o: o.verdict == "unknown_effect"),
    ):
        white, serial = (_share(cases, holds, w) for w in (False, True))
        yield Figure(f"ρ = {rho:g}: {title}", f"white {white}, as it is {serial} of {len(cases)}")
    estimates = [c.found for c in cases if c.found is not None and c.proved]
    doubt = sum(c.found is not None and not c.proved for c in cases)
    spread = f", ρ = {np.mean(estimates):.3f} ± {np.std(estimates):.3f}" if estimates else ""
    none = rho == 0.0
    yield Figure(
        f"ρ = {rho:g}: correlation found",
        f"{len(estimates)} of {len(cases)}{spread}; {doubt} in doubt",
        "≤ 1 %" if none else "",
        len(estimates) + doubt <= 0.01 * len(cases) if none else None,
    )


def _share(
    cases: Sequence[SerialCase], holds: Callable[[SerialNoiseOutcome], bool], serial: bool
) -> str:
    true = [holds(c.after if serial else c.before) for c in cases]
    return f"{100 * float(np.mean(true)):.0f} %"
