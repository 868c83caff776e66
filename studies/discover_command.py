"""`python -m studies discover`: whether a hidden law is found, and none where none is hidden."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from hilcal.cli.demo import CELL
from hilcal.cli.options import Jobs, Json, Scheduler
from hilcal.cli.terminal import Terminal, terminal
from hilcal.config import CellConfig, load_config
from hilcal.engine import open_engine
from hilcal.present.document import table
from hilcal.present.progress import counting
from hilcal.readings.whitening import MODES, Mode
from hilcal.robot.catalogue import configs_dir
from studies.discover import DiscoveryCase, DiscoveryOutcome, run_case
from studies.foreign_laws import KINDS
from studies.records import Figure, Keep, keep
from studies.study_cases import effects_shown

ROBOTS = ("ur3e", "ur5e", "ur10e")
FLOOR, SAME = 1.15, 0.98
"""Limits of the claims: error over the noise floor, and correlation of formulas."""
PLAIN = 0.95
"""Required share in all claims about laws at 10 σ with 100 poses."""


def discover(
    law: Annotated[
        list[str] | None, typer.Option("--law", help="Law to hide; repeatable, all by default.")
    ] = None,
    seeds: Annotated[int, typer.Option("--seeds", help="Per law; arms take turns.")] = 3,
    catalogue: Annotated[
        int, typer.Option("--catalogue", help="Per effect of the catalogue and kind of readings.")
    ] = 1,
    nothing: Annotated[int, typer.Option("--nothing", help="Campaigns that hide nothing.")] = 12,
    noise: Annotated[
        int, typer.Option("--noise", help="Of noise stated half, and twice, as large, each.")
    ] = 6,
    strength: Annotated[float, typer.Option("--strength", help="Of what is hidden, σ.")] = 3.0,
    poses: Annotated[int, typer.Option("--poses", help="Each under six loads.")] = 30,
    first_seed: Annotated[int, typer.Option("--first-seed", help="Seeds count from here.")] = 0,
    cases: Annotated[
        Path | None, typer.Option("--cases", help="Add each case to this file, a JSON line each.")
    ] = None,
    counted: Annotated[
        list[Path] | None,
        typer.Option("--counted", help="Count the cases of such files instead; repeatable."),
    ] = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Hide laws that the catalogue lacks, effects that it has, or nothing, and search a law."""
    t = terminal(as_json)
    config = load_config(configs_dir() / "cells" / CELL)
    asked = (
        []
        if counted
        else [
            *_laws(law or list(KINDS), seeds, first_seed, strength, poses),
            *_effects(catalogue, first_seed, strength, poses),
            *_nothing(nothing, noise, first_seed, poses),
        ]
    )
    done = [_outcome(line) for path in counted or () for line in path.read_text().splitlines()]
    if asked:
        done += _run(config, asked, cases, t, (jobs, scheduler))
    outcomes = [o for o in done if not o.impossible]
    rows = table(
        "hidden", "arm", "site", "variables", "correlation", "fresh error", "law found", left=(0, 6)
    )
    for o in outcomes:
        if o.asked.law or o.formula:
            right = [("no", "yes")[x] for x in (o.site, o.variables)]
            error = f"{o.before:.2f} → {o.after:.2f}"
            answer = o.formula or f"({o.reason})"
            rows.add(
                o.truth or "nothing", o.asked.robot, *right, f"{o.correlation:.3f}", error, answer
            )
    t.show(rows)
    figures = list(claims(outcomes))
    for f in figures:
        t.show(f"{f.what}: {f.measured}; required {f.required}")
    title = "Laws discovered, and none where none is hidden"
    if law:
        title = f"Laws discovered: {', '.join(law)}"
    elif outcomes and all(_plain(o) for o in outcomes):
        title = "Laws discovered at 10 σ with 100 poses"
    keep(keep_file, title, figures, {"cases": [_brief(o) for o in done]} if counted else None)
    t.document({"cases": [asdict(o) for o in outcomes], "figures": [asdict(f) for f in figures]})


def _run(
    config: CellConfig,
    asked: Sequence[DiscoveryCase],
    cases: Path | None,
    t: Terminal,
    workers: tuple[int | None, str | None],
) -> list[DiscoveryOutcome]:
    """Run the cases on several workers, and append each to the file of cases when it is done."""
    outcomes: dict[int, DiscoveryOutcome] = {}
    with (
        open_engine(*workers) as engine,
        counting(t.progress, "campaigns", len(asked)) as advance,
    ):
        for k, outcome in engine.results(partial(run_case, config), asked):
            outcomes[k] = outcome
            if cases is not None:
                with cases.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps(asdict(outcome)) + "\n")
            advance(1)
    return [outcomes[k] for k in range(len(asked))]


def _brief(o: DiscoveryOutcome) -> dict[str, object]:
    """Return a case for the record."""
    hidden = o.asked.law or o.asked.effect or "nothing"
    return {**asdict(o), "asked": f"{hidden}, {o.asked.robot}, seed {o.asked.seed}"}


def _outcome(line: str) -> DiscoveryOutcome:
    """Return a case that `--cases` wrote."""
    case = json.loads(line)
    return DiscoveryOutcome(**{**case, "asked": DiscoveryCase(**case["asked"])})


def _laws(
    names: Sequence[str], seeds: int, first: int, strength: float, poses: int
) -> Iterator[DiscoveryCase]:
    for seed in range(first, first + seeds):
        for k, name in enumerate(names):
            robot = ROBOTS[(seed + k) % len(ROBOTS)]
            mode = _mode(KINDS[name][0])
            yield DiscoveryCase(robot, mode, name, seed=seed, strength=strength, poses=poses)


def _effects(count: int, first: int, strength: float, poses: int) -> Iterator[DiscoveryCase]:
    for seed in range(first, first + count):
        for mode in MODES:
            for k, effect in enumerate(e for e in effects_shown(mode) if e != "base_frame"):
                robot = ROBOTS[(seed + k) % len(ROBOTS)]
                yield DiscoveryCase(
                    robot, mode, effect=effect, seed=seed, strength=strength, poses=poses
                )


def _nothing(count: int, noise: int, first: int, poses: int) -> Iterator[DiscoveryCase]:
    for stated, several in ((1.0, count), (0.5, noise), (2.0, noise)):
        for seed in range(first, first + several):
            robot, mode = ROBOTS[seed % len(ROBOTS)], MODES[seed % len(MODES)]
            yield DiscoveryCase(robot, mode, seed=seed, stated=stated, poses=poses)


def _mode(name: str) -> Mode:
    return next(m for m in MODES if m == name)


def claims(outcomes: Sequence[DiscoveryOutcome]) -> Iterator[Figure]:
    """Yield the claims about the search, with counts."""
    laws = [o for o in outcomes if o.asked.law]
    plain = bool(laws) and all(map(_plain, laws))
    of_law: tuple[tuple[str, float, Callable[[DiscoveryOutcome], bool]], ...] = (
        ("error at fresh poses at most 1.15 times the noise", 0.75, lambda o: 0 < o.after <= FLOOR),
        ("excess of the error at fresh poses halved", 0.90, _halved),
        ("site right", 0.90, lambda o: o.site),
        ("variables right", 0.85, lambda o: o.variables),
        ("formula equivalent (correlation 0.98)", 0.70, lambda o: o.correlation >= SAME),
    )
    for claim, least, holds in of_law:
        yield _figure(claim, [holds(o) for o in laws], PLAIN if plain else least)
    silent = (
        ("no law where an effect of the catalogue is hidden", lambda o: bool(o.asked.effect)),
        ("no law where nothing is hidden", lambda o: _bare(o) and o.asked.stated == 1.0),
        (
            "no law where the noise is misjudged by two",
            lambda o: _bare(o) and o.asked.stated != 1.0,
        ),
    )
    for claim, applies in silent:
        least = 1.0 if "misjudged" in claim else 0.99
        held = [not o.formula for o in outcomes if applies(o)]
        if held:
            yield _figure(claim, held, least)


def _plain(o: DiscoveryOutcome) -> bool:
    return o.asked.strength >= 10.0 and o.asked.poses >= 100


def _bare(o: DiscoveryOutcome) -> bool:
    return not o.asked.law and not o.asked.effect


def _halved(o: DiscoveryOutcome) -> bool:
    return o.after > 0 and o.after - 1.0 <= 0.5 * max(o.before - 1.0, 0.0)


def _figure(claim: str, held: Sequence[bool], least: float) -> Figure:
    share = sum(held) / max(len(held), 1)
    measured = f"{100 * share:.3g} % ({sum(held)} of {len(held)})"
    return Figure(claim, measured, f"{100 * least:g} %", share >= least if held else None)
