"""`python -m studies descriptions`: arms, registrations and errors of description at random."""

import time
from collections import Counter
from typing import Annotated

import numpy as np
import typer

from hilcal.cli.options import Jobs, Json, Scheduler
from hilcal.cli.terminal import terminal
from hilcal.engine import open_engine
from hilcal.present.document import table
from hilcal.present.progress import counting
from studies.random_descriptions import DescriptionOutcome, draw, judge
from studies.records import Figure, Keep, keep


def descriptions(
    cases: Annotated[int, typer.Option("--cases", help="Number of draws.")] = 300,
    first: Annotated[int, typer.Option("--first-seed", help="Seed of the first draw.")] = 0,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
    keep_file: Keep = None,
) -> None:
    """Draw arms, poses, noise and errors of description; count what is registered and named."""
    t = terminal(as_json)
    right, visible, named, exact = 0, Counter[str](), Counter[str](), Counter[str]()
    missed: list[int] = []
    start = time.monotonic()
    every = range(first, first + cases)
    with open_engine(jobs, scheduler) as engine, counting(t.progress, "cases", cases) as advance:
        judged = engine.map(_judged, every, advance=advance)
    for seed, (error, outcome) in zip(every, judged, strict=True):
        right += outcome.right
        if outcome.named is not None and error is not None:
            visible[error] += 1
            named[error] += outcome.named
            exact[error] += outcome.exact
        if not outcome.right or outcome.named is False:
            missed.append(seed)
    out = table("error of description", "visible", "named", "of these the very one")
    for kind in sorted(visible):
        out.add(kind, str(visible[kind]), str(named[kind]), str(exact[kind]))
    t.show(out)
    total, hits = sum(visible.values()), sum(named.values())
    figures = [
        Figure(
            "registered to the noise, or refused for the right reason",
            f"{right} of {cases}",
            "98 %",
            right >= 0.98 * cases,
        ),
        Figure(
            "error of description named, where the frames do not hide it",
            f"{hits} of {total}",
            "95 %",
            hits >= 0.95 * total,
        ),
        Figure(
            "of these the very error, not an equivalent one", f"{sum(exact.values())} of {hits}"
        ),
    ]
    t.show([f"{f.what}: {f.measured}" for f in figures])
    t.document(
        {
            "cases": cases,
            "right": right,
            "visible": dict(visible),
            "named": dict(named),
            "exact": dict(exact),
            "missed_seeds": missed,
            "seconds": time.monotonic() - start,
        }
    )
    keep(keep_file, "Errors of description", figures)


def _judged(seed: int) -> tuple[str | None, DescriptionOutcome]:
    """Draw a case, and return its error and the program's answer."""
    case = draw(np.random.default_rng(seed))
    return case.error, judge(case)[0]
