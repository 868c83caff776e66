"""`python -m studies change`: how often 15 readings name the joint that was repaired."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilcal.cli.demo import CELL
from hilcal.cli.options import Jobs, Json, Scheduler
from hilcal.cli.terminal import Terminal, terminal
from hilcal.config import load_config
from hilcal.engine import open_engine
from hilcal.numbers import length
from hilcal.present.document import table
from hilcal.present.progress import counting
from hilcal.robot.catalogue import configs_dir
from studies.change import READINGS_B, REPAIRS, ChangeCase, StudiedArm, case, studied_arm
from studies.change_real import ZERO_RAD, RealCase, RealStudy, real_case
from studies.records import Figure, Keep, keep

ARMS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("ur10e", ()),
    ("ur3e", ()),
    ("ur5e", ("hysteresis", "joint_tilt_compliance")),
    ("ur10e", ("thermal_growth", "backlash")),
)
"""Robots, and their effects besides geometry, transmission errors and joint compliance."""
WILSON = 1.959964
"""Half width of a 95 % interval, in standard deviations."""


def change(
    seeds: Annotated[int, typer.Option("--seeds", help="Repairs.")] = 100,
    nothing: Annotated[int, typer.Option("--nothing", help="Comparisons without any.")] = 200,
    readings: Annotated[
        int, typer.Option("--readings", help="Of the later campaign.")
    ] = READINGS_B,
    first_seed: Annotated[int, typer.Option("--first-seed", help="Seeds count from here.")] = 0,
    real: Annotated[
        Path | None,
        typer.Option("--real", metavar="F.csv", help="Of a real arm instead: an IPA UR10 series."),
    ] = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Repair a joint of simulated arms, measure a few readings, and ask what has changed."""
    t = terminal(as_json)
    if real is not None:
        study = RealStudy(real.absolute(), seeds, first_seed, readings)
        with (
            open_engine(jobs, scheduler) as engine,
            counting(t.progress, "comparisons", 2 * seeds) as advance,
        ):
            compare = partial(real_case, study=study)
            halves = engine.map(compare, range(2 * seeds), advance=advance)
        _show(t, real_figures(halves), [asdict(c) for c in halves])
        keep(
            keep_file,
            f"What has changed on a real arm, by {readings} readings",
            real_figures(halves),
        )
        return
    comparisons = [(True, k) for k in range(seeds)] + [(False, k) for k in range(nothing)]
    run = partial(_case, first=first_seed, count=readings)
    with (
        open_engine(jobs, scheduler) as engine,
        counting(t.progress, "comparisons", len(comparisons)) as advance,
    ):
        cases = engine.map(run, comparisons, advance=advance)
    figures = figures_of(cases)
    _show(t, figures, [asdict(c) for c in cases])
    keep(keep_file, f"What has changed on an arm, by {readings} readings", figures)


def _show(t: Terminal, figures: Sequence[Figure], cases: list[dict[str, object]]) -> None:
    out = table("what", "measured", "required", left=(0, 1, 2))
    for f in figures:
        out.add(f.what, f.measured, f.required)
    t.show(out)
    t.document({"cases": cases})


def real_figures(cases: Sequence[RealCase]) -> list[Figure]:
    """Return the figures of a real arm."""
    quiet, moved = [c for c in cases if not c.joint], [c for c in cases if c.joint]
    silent = [not c.parts and c.explained for c in quiet]
    named = [c.parts == (f"joint {c.joint}",) for c in moved]
    inside = [c.z is not None and abs(c.z) < WILSON for c in moved]
    size = f"{1e3 * ZERO_RAD:g} mrad"
    return [
        _rate("other poses of the same series: nothing is claimed", quiet, silent, 0.98),
        _rate(
            f"a joint's zero moved by {size} in them: the joint is named, alone", moved, named, 0.95
        ),
        _rate("… and its size is in the stated 95 %", moved, inside),
    ]


@cache
def _arms() -> tuple[StudiedArm, ...]:
    """Measure the arms, once in each process."""
    config = load_config(configs_dir() / "cells" / CELL)
    return tuple(studied_arm(config, robot, k, more=more) for k, (robot, more) in enumerate(ARMS))


def _case(comparison: tuple[bool, int], first: int, count: int) -> ChangeCase:
    """Return the k-th case with a repair, or the k-th case without."""
    repaired, k = comparison
    arms = _arms()
    if repaired:
        return _repaired(arms, k, first, count)
    arm, seed = arms[k % len(arms)], first + 10_000 + k
    anew, other = k // 4 % 2 == 1, k // 8 % 2 == 1
    return case(arm, "nothing", 0, anew, seed, other=other, count=count)


def _repaired(arms: Sequence[StudiedArm], k: int, first: int, count: int) -> ChangeCase:
    """Return the k-th repair: kinds, arms, joints and setups in turn, all combined."""
    arm, repair = arms[k % len(arms)], REPAIRS[k // len(arms) % len(REPAIRS)]
    rng = np.random.default_rng([first + k, 5])
    joint, anew = int(rng.integers(1, arm.cell.arm.n + 1)), bool(rng.integers(2))
    return case(arm, repair, joint, anew, first + k, count=count)


def figures_of(cases: Sequence[ChangeCase]) -> list[Figure]:
    """Return the figures of simulated arms."""
    quiet = [c for c in cases if c.repair == "nothing"]
    repaired = [c for c in cases if c.repair != "nothing"]
    visible = [c for c in repaired if c.visible]
    right = [not c.set_aside for c in cases]
    out = [_rate("no reading is set aside as a gross error, which none has", cases, right, 0.98)]
    if repaired:
        out += [
            _rate("repaired joint named, and no other part", repaired, [c.found for c in repaired]),
            _rate(
                "the same, where the change is larger than the program states that it can show",
                visible,
                [c.found for c in visible],
                0.95,
            ),
        ]
        for kind in REPAIRS:
            of_kind = [c for c in repaired if c.repair == kind]
            out.append(_rate(f"… of all: {kind}", of_kind, [c.found for c in of_kind]))
        for anew in (False, True):
            chosen = [c for c in visible if c.anew == anew]
            place = "set up anew" if anew else "where it was"
            out.append(_rate(f"… of those, tracker {place}", chosen, [c.found for c in chosen]))
        wrong = [bool(c.parts) and c.parts != f"joint {c.joint}" for c in repaired]
        out.append(_rate("another part than the joint is named first", repaired, wrong))
        out += _missed([c for c in repaired if not c.found])
        alone = [c for c in repaired if c.repair != "gearbox"]
        z = np.array([x for c in alone for x in c.z])
        if len(z):
            inside = np.abs(z) < WILSON
            out += [
                _rate("true zero or compliance in its 95 % (no gearbox)", list(z), list(inside)),
                Figure("error of the size over its std, rms", f"{np.sqrt(np.mean(z**2)):.2f}"),
            ]
    if quiet:
        silent = [not c.parts and c.explained and not c.failure for c in quiet]
        out.append(_rate("without a change nothing is claimed", quiet, silent, 0.98))
        arm = [not c.of_arm and not c.failure for c in quiet]
        out.append(_rate("… no change of the arm itself", quiet, arm))
        for other in (False, True):
            chosen = [c for c in quiet if c.other == other]
            setting = "other loads, 5 K warmer" if other else "loads and temperature as before"
            silent = [not c.parts and c.explained and not c.failure for c in chosen]
            out.append(_rate(f"… {setting}: nothing is claimed", chosen, silent))
    return out


def _missed(cases: Sequence[ChangeCase]) -> list[Figure]:
    """Count missed changes that these readings cannot show, and other missed ones."""
    hidden = [c for c in cases if not c.visible]
    turned = [c for c in hidden if c.size_rad and c.joint == 1 and c.anew]
    small = [c for c in hidden if all(c is not t for t in turned)]
    further = len(cases) - len(turned) - len(small)
    out = [
        Figure(
            "not found: zero of joint 1, which a new place of the tracker absorbs", str(len(turned))
        )
    ]
    if small:
        which = ", ".join(
            f"{c.repair} of joint {c.joint} ({length(c.moved_m)})"
            for c in sorted(small, key=lambda c: c.moved_m)
        )
        out.append(
            Figure("not found: smaller than these readings can show (rms at the target)", which)
        )
    return [*out, Figure("not found: others", str(further))]


def _rate(
    name: str, cases: Sequence[object], hits: Iterable[bool], least: float | None = None
) -> Figure:
    """Return a share with its 95 % interval by Wilson."""
    count, hit = len(cases), sum(hits)
    if not count:
        return Figure(name, "no case")
    share, z2 = hit / count, WILSON**2
    middle = (share + z2 / (2 * count)) / (1 + z2 / count)
    half = WILSON * np.sqrt(share * (1 - share) / count + z2 / (4 * count**2)) / (1 + z2 / count)
    text = f"{hit} of {count} ({100 * (middle - half):.0f} to {100 * (middle + half):.0f} %)"
    if least is None:
        return Figure(name, text)
    return Figure(name, text, f"{100 * least:g} %", share >= least)
