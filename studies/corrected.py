"""`python -m studies corrected`: arms moved to corrected joint targets, and measured there.

Simulated cells with one hidden effect each are calibrated by the steps of `hilcal calibrate`
through the real drivers, on simulated devices over their protocols. The validation poses are loaded
with 60 % of the payload and never fitted. The result is the error that the tracker measures at
their uncorrected and corrected joint values, in its frame, by the fitted registration.

Each cell is a case for the engine. Its devices are processes on the worker's machine, with a
loopback address and a folder of their own, and end with the case or with the worker. They run in
real time, so that readings depend on the load of the machine, as with real devices: the draws are
the same on any number of workers, the figures agree within the noise.
"""

import fcntl
import sys
import time
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, TextIO

import numpy as np
import typer
from rich.console import Console

from hilcal.calibration.improvement import Improvement
from hilcal.cell import cell_from_config
from hilcal.cli.calibrating import CalibrationOperator
from hilcal.cli.options import Json, OneJob, Scheduler, one_by_default
from hilcal.cli.terminal import Terminal, terminal
from hilcal.config import CellConfig, load_config
from hilcal.config.sections import CellLoad
from hilcal.drivers.simulated.rehearsal import program_config
from hilcal.effects.catalogue import installed
from hilcal.engine import open_engine
from hilcal.errors import DeviceError
from hilcal.numbers import length
from hilcal.procedure.procedure import Procedure, continued
from hilcal.procedure.state import Settings
from hilcal.robot.catalogue import configs_dir, load_arm
from studies.records import Figure, Keep, keep

ARMS = ("ur10e", "ur3e")
HIDDEN = (
    "joint_tilt_compliance",
    "transmission_error",
    "link_geometry",
    "hysteresis",
    "link_compliance",
    "encoder_offset",
    "base_compliance",
    "joint_coupling",
)
"""Eight effects of different kinds: elastic ones, of the geometry, of the gears."""
SHARE = 0.6
"""Load as a share of the payload."""
POSES = 25
"""Number of poses of the fitted plan."""
WANTED = 0.95
"""Required reduction of the error beyond the noise; the project's goal."""
WANTED_BAND = (0.93, 0.97)
"""Accepted share of points within their 95 % band; the project's goal."""
CLOCK = 50.0
"""Speed of the simulated worlds over real time."""
CANDIDATES = 120
STARTS = 3
"""Most starts of the devices of a cell: on a busy machine they may not run for seconds, and a
controller whose program was left running then needs its pendant. A choice."""
SEED = 11


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedCase:
    """One cell.

    Attributes:
        arm: name of the arm.
        hidden: the hidden effect.
        improvement: the errors before and after correction.
        verdict: of the refinement.
        model: effects of the refined model.
        seconds: duration.
    """

    arm: str
    hidden: str
    improvement: Improvement
    verdict: str
    model: tuple[str, ...]
    seconds: float


def corrected(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR", help="Campaigns; goes on with them. One that all workers reach."
        ),
    ],
    points: Annotated[int, typer.Option("--points", help="Validation poses of a cell.")] = 50,
    poses: Annotated[int, typer.Option("--poses", help="Of the plan that is fitted.")] = POSES,
    arms: Annotated[str, typer.Option("--arms", help="Separated by commas.")] = ",".join(ARMS),
    effects: Annotated[str, typer.Option("--effects", help="The same.")] = ",".join(HIDDEN),
    jobs: OneJob = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Calibrate simulated cells through the drivers, and measure at corrected targets."""
    t = terminal(as_json)
    folder.mkdir(parents=True, exist_ok=True)
    cells = [(arm, hidden) for hidden in effects.split(",") for arm in arms.split(",")]
    run = partial(case, folder=folder.absolute(), points=points, poses=poses)
    done: dict[int, CorrectedCase] = {}
    cases: list[CorrectedCase] = []
    with open_engine(*one_by_default(jobs, scheduler)) as engine:
        for number, finished in engine.results(run, cells):
            done[number] = finished
            cases = [done[k] for k in sorted(done)]
            t.notice(f"{words(finished)} ({finished.seconds:.0f} s)")
            keep(keep_file, "Moved to corrected joint targets, measured there", figures(cases))
    for f in figures(cases):
        t.show(f"{f.what}: {f.measured}")
    t.document(
        {
            "cases": [
                {"arm": c.arm, "hidden": c.hidden, "verdict": c.verdict, **c.improvement.to_dict()}
                for c in cases
            ]
        }
    )


def case(cell: tuple[str, str], folder: Path, points: int, poses: int = POSES) -> CorrectedCase:
    """Calibrate one cell, or continue where its files end.

    Args:
        cell: the arm and the hidden effect.
        folder: of the campaigns.
        points: number of validation poses.
        poses: number of poses of the fitted plan.

    Raises:
        DeviceError: devices failed at every start.
    """
    arm, hidden = cell
    start = time.monotonic()
    seed = zlib.crc32(f"{SEED} {arm} {hidden}".encode())  # independent draws in each cell
    settings = Settings(
        poses=poses, validation=points, seed=seed, readings="absolute", hide=hidden,
        under_load=True,
    )  # fmt: skip
    config = program_config(cell_of(arm, seed), hidden)
    run = folder / f"{arm}-{hidden}.hilcal"
    with _alone(run.with_suffix(".log")) as log:
        quiet = Console(file=log, width=100)
        t = Terminal(json=False, people=quiet, progress=quiet, out=sys.stderr)
        p = _calibrated(t, run, config, settings)
    improvement = p.compare()
    record = p.record()
    verdict = str(record.result_json.get("diagnose", {}).get("verdict", ""))
    return CorrectedCase(
        arm, hidden, improvement, verdict, record.effects, time.monotonic() - start
    )


def _calibrated(t: Terminal, run: Path, config: CellConfig, settings: Settings) -> Procedure:
    """Do the missing steps of a calibration; devices that failed are started again."""
    cell, catalogue = cell_from_config(config), installed()
    for starts_left in reversed(range(STARTS)):
        if run.exists():
            p = continued(run, cell, catalogue)
        else:
            p = Procedure(run, cell, catalogue, settings)
        with ExitStack() as stack:
            try:
                CalibrationOperator(t, p, stack, rehearse=True, yes=True).run_steps()
            except DeviceError as error:
                if not starts_left:
                    raise
                t.notice(f"note: {error}")
                t.notice("going on with devices started anew")
            else:
                break
    return p


@contextmanager
def _alone(path: Path) -> Iterator[TextIO]:
    """Open a log for appending, with an exclusive lock.

    When a study is stopped, a cluster finishes the cases in progress: the next study waits for such
    a case, and continues after it. The kernel releases the lock with the process.
    """
    with path.open("a", encoding="utf-8") as log:
        fcntl.flock(log, fcntl.LOCK_EX)
        yield log


def cell_of(arm: str, seed: int) -> CellConfig:
    """Return the demo's cell with another arm, and loads of `SHARE` of its payload."""
    config = load_config(configs_dir() / "cells" / "demo_ur10e.toml")
    mass = SHARE * load_arm(arm).payload
    pull = mass * 9.80665
    loads = (
        CellLoad(name="weight", mass_kg=mass),
        CellLoad(name="pull", force_N=(pull, 0.0, 0.0), moment_Nm=(0.0, 0.05 * pull, 0.05 * pull)),
    )
    planning = {"candidates": CANDIDATES, "against": (), "readings": "absolute"}
    return config.model_copy(
        update={
            "robot": config.robot.model_copy(update={"model": arm}),
            "loads": loads,
            "planning": config.planning.model_copy(update=planning),
            "simulation": config.simulation.model_copy(update={"clock": CLOCK, "seed": seed}),
        }
    )


def words(c: CorrectedCase) -> str:
    """Return a case in a line."""
    e = c.improvement.everything
    removed = "" if e.removed is None else f", {100 * e.removed:.1f} % of the excess removed"
    return (
        f"{c.arm}, {c.hidden}: {length(e.before.rms_m)} → {length(e.after.rms_m)} rms (noise "
        f"{length(e.noise_m)}){removed}; {e.inside} of {e.count} within their band; {c.verdict}"
    )


def figures(cases: list[CorrectedCase]) -> list[Figure]:
    """Return the figures of all cases together, and of each case."""
    results = [c.improvement.everything for c in cases]
    removed = [e.removed for e in results if e.removed is not None]
    inside, points = sum(e.inside for e in results), sum(e.count for e in results)
    share, left_out = inside / points, sum(len(c.improvement.left_out) for c in cases)
    band = f"{100 * WANTED_BAND[0]:.0f} to {100 * WANTED_BAND[1]:.0f} %"
    out = [
        Figure(
            f"{len(cases)} cells, {points} loaded points: smallest share of what exceeds the noise "
            "that is gone at the corrected targets",
            f"{100 * min(removed):.1f} % (median {100 * float(np.median(removed)):.1f} %)",
            f"at least {100 * WANTED:.0f} %",
            min(removed) >= WANTED,
        ),
        Figure(
            "points within their predicted 95 % band, all cells together",
            f"{100 * share:.1f} % of {points}",
            band,
            WANTED_BAND[0] <= share <= WANTED_BAND[1],
        ),
        Figure("points that could not be corrected or reached", str(left_out)),
    ]
    for c, e in zip(cases, results, strict=True):
        gone = "" if e.removed is None else f"; {100 * e.removed:.1f} % gone"
        out.append(
            Figure(
                f"{c.arm}, {c.hidden} hidden",
                f"{length(e.before.rms_m)} → {length(e.after.rms_m)} rms, noise "
                f"{length(e.noise_m)}{gone}; {e.inside} of {e.count} within their band; "
                f"{' + '.join(c.model)}: {c.verdict.replace('_', ' ')}",
            )
        )
    return out
