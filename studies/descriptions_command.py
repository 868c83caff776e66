"""`python -m studies descriptions`: arms, registrations and errors of description at random."""

import time
from collections import Counter
from typing import Annotated

import numpy as np
import typer

from hilcal.cli.terminal import Json, terminal
from hilcal.report import text
from hilcal.report.progress import working
from studies.random_descriptions import draw, judge
from studies.records import Figure, Keep, keep


def descriptions(
    cases: Annotated[int, typer.Option("--cases", help="Number of draws.")] = 300,
    first: Annotated[int, typer.Option("--first-seed", help="Seed of the first draw.")] = 0,
    as_json: Json = False,
    keep_file: Keep = None,
) -> None:
    """Draw arms, poses, noise and errors of description; count what is registered and named."""
    t = terminal(as_json)
    right, seen, named, exact = 0, Counter[str](), Counter[str](), Counter[str]()
    missed: list[int] = []
    begun = time.monotonic()
    with working(t.progress) as say:
        for seed in range(first, first + cases):
            say(f"case {seed - first + 1} of {cases}")
            case = draw(np.random.default_rng(seed))
            outcome, _ = judge(case)
            right += outcome.right
            if outcome.named is not None and case.error is not None:
                seen[case.error] += 1
                named[case.error] += outcome.named
                exact[case.error] += outcome.exact
            if not outcome.right or outcome.named is False:
                missed.append(seed)
    out = text.table("error of description", "visible", "named", "of these the very one")
    for kind in sorted(seen):
        out.add_row(kind, str(seen[kind]), str(named[kind]), str(exact[kind]))
    t.show(out)
    whole, found = sum(seen.values()), sum(named.values())
    figures = [
        Figure(
            "registered to the noise, or refused for the right reason",
            f"{right} of {cases}",
            "98 %",
            right >= 0.98 * cases,
        ),
        Figure(
            "error of description named, where the frames do not hide it",
            f"{found} of {whole}",
            "95 %",
            found >= 0.95 * whole,
        ),
        Figure(
            "of these the very error, not an equivalent one", f"{sum(exact.values())} of {found}"
        ),
    ]
    t.show([f"{f.what}: {f.measured}" for f in figures])
    t.document(
        {
            "cases": cases,
            "right": right,
            "visible": dict(seen),
            "named": dict(named),
            "exact": dict(exact),
            "missed_seeds": missed,
            "seconds": time.monotonic() - begun,
        }
    )
    keep(keep_file, "Errors of description", figures)
