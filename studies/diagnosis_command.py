"""`python -m studies diagnosis`: how often the diagnosis is right, on simulated campaigns."""

import time
from functools import cache, partial
from typing import Annotated

import typer

from hilcal.cli.demo import CELL
from hilcal.cli.options import Jobs, Json, Scheduler
from hilcal.cli.terminal import terminal
from hilcal.config import CellConfig, load_config
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.errors import InputError
from hilcal.present.progress import counting
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import MODES, Mode
from hilcal.robot.catalogue import configs_dir, robot_names
from hilcal.toml import suggest
from studies.diagnosis import KINDS, DiagnosisCase, Kind, Sample, run_case
from studies.diagnosis_claims import claims
from studies.diagnosis_document import document
from studies.diagnosis_pool import run_all
from studies.diagnosis_questions import Extent, questions
from studies.diagnosis_table import CAPTION, report
from studies.records import Figure, Keep, keep
from studies.study_cases import StudyCase, effects_shown, laws_shown, study_case
from studies.study_more import measure_more

ROBOTS = ("ur3e", "ur5e", "ur10e")
STRENGTHS = (2.0, 1.0, 0.5)
_INTERRUPTED = 130


def diagnosis(
    what: Annotated[
        list[str] | None,
        typer.Argument(metavar="[WHAT]...", help=f"Of {', '.join(KINDS)}; all by default."),
    ] = None,
    robot: Annotated[
        list[str] | None, typer.Option("--robot", help="Repeatable; ur3e, ur5e and ur10e.")
    ] = None,
    readings: Annotated[
        list[str] | None,
        typer.Option("--readings", metavar="KIND", help="deflection or absolute; both."),
    ] = None,
    effect: Annotated[
        list[str] | None, typer.Option("--effect", help="To hide; repeatable, all by default.")
    ] = None,
    strength: Annotated[
        list[float] | None, typer.Option("--strength", help="In σ; repeatable: 2, 1 and 0.5.")
    ] = None,
    seeds: Annotated[
        int, typer.Option("--seeds", help="Per effect or law, arm, readings and strength.")
    ] = 20,
    nothing: Annotated[
        int, typer.Option("--nothing", help="Campaigns that hide nothing, per readings.")
    ] = 500,
    noise: Annotated[
        int, typer.Option("--noise", help="Of noise stated too small, and too large, each.")
    ] = 100,
    pairs: Annotated[int, typer.Option("--pairs", help="With two effects, per readings.")] = 100,
    first_seed: Annotated[int, typer.Option("--first-seed", help="Seeds count from here.")] = 0,
    refine: Annotated[
        bool, typer.Option("--refine/--no-refine", help="Also add what is found to be missing.")
    ] = True,
    again: Annotated[
        bool,
        typer.Option("--next", help="At 0.5 σ, also plan and measure what separates suspects."),
    ] = False,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Hide effects in simulated campaigns, and count how often the diagnosis is right.

    Ctrl-C ends it with what there is.
    """
    t = terminal(as_json)
    _check_numbers(seeds, nothing, noise, pairs, first_seed, jobs, strength)
    modes = _modes(readings)
    chosen = _effects(effect, modes)
    extent = Extent(
        kinds=_kinds(what),
        robots=_robots(robot),
        modes=modes,
        effects={m: tuple(e for e in effects_shown(m) if e in chosen) for m in modes},
        laws={m: laws_shown(m) for m in modes},
        strengths=tuple(strength) if strength else STRENGTHS,
        seeds=seeds,
        nothing=nothing,
        noise=noise,
        pairs=pairs,
        first_seed=first_seed,
        again=again,
    )
    cases = questions(extent)
    start = time.monotonic()
    with counting(t.progress, "campaigns", len(cases)) as advance:
        run = partial(run_case, simulate=simulate, more=more, refined=refine)
        outcomes, complete = run_all(cases, run, jobs, advance, scheduler)
    t.notice(f"{len(outcomes)} of {len(cases)} campaigns in {time.monotonic() - start:.0f} s")
    if outcomes:
        t.show(report(outcomes))
        t.show("")
        t.show(CAPTION)
    figures = [
        Figure(
            c.words,
            f"{100 * c.rate.share:.1f} % of {c.rate.cases}",
            "" if c.least is None else f"{100 * c.least:g} to {100 * c.most:g} %",
            c.met,
        )
        for c in claims(outcomes)
    ]
    kinds = ", ".join(what or KINDS)
    keep(keep_file, f"How often the diagnosis is right: {kinds}", figures)
    t.document(document(outcomes, complete))
    if not complete:
        raise typer.Exit(_INTERRUPTED)


def simulate(asked: DiagnosisCase) -> Sample:
    """Measure the campaign of a case in the simulated world."""
    c = _case(asked)
    return Sample(c.cell, c.readings, c.noise, c.world.truth, c.variables)


def more(asked: DiagnosisCase, diagnosis: Diagnosis) -> Readings | None:
    """Measure readings that separate the suspects of a diagnosis, in the same world."""
    return measure_more(_config(), asked.robot, _case(asked), diagnosis, asked.seed)


def _case(asked: DiagnosisCase) -> StudyCase:
    return study_case(
        _config(), asked.robot, asked.mode, asked.hidden, asked.strength, asked.seed,
        stated=asked.stated, cycles=asked.cycles,
    )  # fmt: skip


@cache
def _config() -> CellConfig:
    return load_config(configs_dir() / "cells" / CELL)


def _check_numbers(
    seeds: int,
    nothing: int,
    noise: int,
    pairs: int,
    first_seed: int,
    jobs: int | None,
    strength: list[float] | None,
) -> None:
    counts = {
        "--seeds": seeds,
        "--nothing": nothing,
        "--noise": noise,
        "--pairs": pairs,
        "--jobs": 1 if jobs is None else jobs,
    }
    for name, value in counts.items():
        if value < 1:
            raise InputError(f"{name} {value}; valid: a whole number from 1")
    if first_seed < 0:
        raise InputError(f"--first-seed {first_seed}; valid: a whole number from 0")
    for sigma in strength or ():
        if not 0.0 < sigma < float("inf"):
            raise InputError(f"--strength {sigma:g}; valid: a number over 0, in σ")


def _kinds(options: list[str] | None) -> tuple[Kind, ...]:
    _all_valid("", options, KINDS)
    return tuple(k for k in KINDS if not options or k in options)


def _robots(options: list[str] | None) -> tuple[str, ...]:
    _all_valid("--robot ", options, robot_names())
    return tuple(dict.fromkeys(options)) if options else ROBOTS


def _modes(options: list[str] | None) -> tuple[Mode, ...]:
    _all_valid("--readings ", options, MODES)
    return tuple(m for m in MODES if not options or m in options)


def _effects(options: list[str] | None, modes: tuple[Mode, ...]) -> tuple[str, ...]:
    shown = tuple(dict.fromkeys(e for m in modes for e in effects_shown(m)))
    _all_valid("--effect ", options, shown)
    return tuple(options) if options else shown


def _all_valid(option: str, options: list[str] | None, valid: tuple[str, ...]) -> None:
    for word in options or ():
        if word not in valid:
            raise InputError(f"{option}{word!r}{suggest(word, valid)}; valid: {', '.join(valid)}")
