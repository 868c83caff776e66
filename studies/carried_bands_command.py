"""`python -m studies carried-bands`: whether bands of a carried prior hold, over many arms."""

from collections.abc import Iterable, Sequence
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
from studies.carried_bands import BandCase, band_cases
from studies.records import Figure, Keep, keep

WANTED = (0.90, 0.97)


def carried_bands(
    arms: Annotated[int, typer.Option("--arms", help="Simulated arms.")] = 40,
    robot: Annotated[str, typer.Option("--robot", help="Their type.")] = "ur10e",
    poses: Annotated[str, typer.Option("--poses", help="N.")] = "20,50,100,200",
    first_seed: Annotated[int, typer.Option("--first-seed", help="Seeds count from here.")] = 0,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Measure simulated arms twice, the first time as prior, in other joint ranges."""
    t = terminal(as_json)
    numbers = [int(n) for n in poses.split(",") if n.strip()]
    config = load_config(configs_dir() / "cells" / CELL)
    run = partial(band_cases, config=config, robot=robot, numbers=numbers)
    with (
        open_engine(jobs, scheduler) as engine,
        counting(t.progress, "arms", arms) as advance,
    ):
        by_arm = engine.map(run, range(first_seed, first_seed + arms), advance=advance)
    cases = [case for of_arm in by_arm for case in of_arm]
    figures = list(_figures(cases, numbers))
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    t.document({"cases": [asdict(c) for c in cases]})
    title = "Bands of a carried prior over many simulated arms, joint 2 in another range"
    keep(keep_file, title, figures)


def _figures(cases: Sequence[BandCase], numbers: Iterable[int]) -> Iterable[Figure]:
    """Yield the share in the band over the arms, and the range of nine arms in ten."""
    low, high = WANTED
    for n in numbers:
        of_number = [c for c in cases if c.poses == n]
        share = np.array([c.inside for c in of_number])
        mean = float(share.mean())
        ends = np.quantile(share, [0.05, 0.95])
        lacking = np.array([bool(c.lacking) for c in of_number])
        parts = [
            f"{models} {100 * float(share[which].mean()):.1f} %"
            for models, which in (("complete models", ~lacking), ("one effect lacking", lacking))
            if which.any()
        ]
        yield Figure(
            f"{n} poses: share of other poses in the stated 95 % band",
            f"{100 * mean:.1f} % over {len(of_number)} arms ({'; '.join(parts)}); "
            f"nine single arms in ten {100 * ends[0]:.1f} to {100 * ends[1]:.1f} %",
            f"{100 * low:.0f} to {100 * high:.0f} %",
            low <= mean <= high,
        )
