"""`python -m studies corrected`: arms moved to corrected joint targets, measured there.

Simulated cells with a hidden effect each, calibrated by the steps of `hilcal calibrate` through the
real drivers, on simulated devices over their protocols. The validation poses are loaded with 60 %
of the payload; nothing is fitted to them. Counted is the error that the tracker measures at their
uncorrected and at their corrected joint values, in its own frame by the fitted registration.

Every cell is a case of its own, on the engine: its devices are processes of the worker's machine,
on a loopback address and in a folder of their own, and end with the case or with the worker. They
run in real time, so that readings depend on the load of the machine, as those of real devices do:
the draws are the same on any number of workers, the figures agree within the noise.
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
from hilcal.drivers.simulated.rehearsal import as_told
from hilcal.effects.catalogue import installed
from hilcal.engine.engine import open_engine
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
"""Of the payload."""
POSES = 25
"""Size of the plan that is fitted."""
WANTED = 0.95
"""Share of what exceeds the noise that is to be gone; the project's goal."""
WANTED_BAND = (0.93, 0.97)
"""Share of points within their 95 % band that counts as true; the project's goal."""
CLOCK = 50.0
"""How much faster than real time the simulated worlds go."""
CANDIDATES = 120
STARTS = 3
"""Of the devices of a cell: a busy machine gives them no turn for seconds, and a controller whose
program was left running wants its pendant. A choice."""
SEED = 11


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One cell.

    Attributes:
        arm: of the catalogue.
        hidden: the effect.
        found: the errors before and after.
        verdict: of the refinement.
        model: its effects.
        seconds: that it took.
    """

    arm: str
    hidden: str
    found: Improvement
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
    asked = [(arm, hidden) for hidden in effects.split(",") for arm in arms.split(",")]
    run = partial(case, folder=folder.absolute(), points=points, poses=poses)
    done: dict[int, Case] = {}
    cases: list[Case] = []
    with open_engine(*one_by_default(jobs, scheduler)) as engine:
        for number, found in engine.results(run, asked):
            done[number] = found
            cases = [done[k] for k in sorted(done)]
            t.notice(f"{words(found)} ({found.seconds:.0f} s)")
            keep(keep_file, "Moved to corrected joint targets, measured there", figures(cases))
    for f in figures(cases):
        t.show(f"{f.what}: {f.measured}")
    t.document(
        {
            "cases": [
                {"arm": c.arm, "hidden": c.hidden, "verdict": c.verdict, **c.found.to_dict()}
                for c in cases
            ]
        }
    )


def case(of: tuple[str, str], folder: Path, points: int, poses: int = POSES) -> Case:
    """Calibrate one cell, or go on where its files end.

    Args:
        of: the arm and the hidden effect.
        folder: of the campaigns.
        points: validation poses.
        poses: of the plan that is fitted.

    Raises:
        DeviceError: a device failed, again and again.
    """
    arm, hidden = of
    begun = time.monotonic()
    seed = zlib.crc32(f"{SEED} {arm} {hidden}".encode())  # independent draws in each cell
    settings = Settings(
        poses=poses, validation=points, seed=seed, readings="absolute", hide=hidden,
        under_load=True,
    )  # fmt: skip
    config = as_told(cell_of(arm, seed), hidden)
    run = folder / f"{arm}-{hidden}.hilcal"
    with _alone(run.with_suffix(".log")) as log:
        quiet = Console(file=log, width=100)
        t = Terminal(json=False, people=quiet, progress=quiet, out=sys.stderr)
        p = _calibrated(t, run, config, settings)
    found = p.compare()
    record = p.record()
    verdict = str(record.result_json.get("diagnose", {}).get("verdict", ""))
    return Case(arm, hidden, found, verdict, record.effects, time.monotonic() - begun)


def _calibrated(t: Terminal, run: Path, config: CellConfig, settings: Settings) -> Procedure:
    """Do what is missing of a calibration, on devices started anew where some have failed."""
    cell, catalogue = cell_from_config(config), installed()
    for left in reversed(range(STARTS)):
        if run.exists():
            p = continued(run, cell, config, catalogue)
        else:
            p = Procedure(run, cell, config, run.parent, catalogue, settings)
        with ExitStack() as stack:
            try:
                CalibrationOperator(t, p, stack, rehearse=True, yes=True).to_the_end()
            except DeviceError as error:
                if not left:
                    raise
                t.notice(f"note: {error}")
                t.notice("going on with devices started anew")
            else:
                break
    return p


@contextmanager
def _alone(path: Path) -> Iterator[TextIO]:
    """Open a log to append to, when nobody else has it open by this.

    A cluster does not end what its workers compute when the study is stopped: the next one waits
    for the case, and goes on where it ended. The kernel lets go of a file with its process.
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


def words(c: Case) -> str:
    """Return a case in a line."""
    e = c.found.everything
    removed = "" if e.removed is None else f", {100 * e.removed:.1f} % of the excess removed"
    return (
        f"{c.arm}, {c.hidden}: {length(e.before.rms_m)} → {length(e.after.rms_m)} rms (noise "
        f"{length(e.noise_m)}){removed}; {e.inside} of {e.count} within their band; {c.verdict}"
    )


def figures(cases: list[Case]) -> list[Figure]:
    """Return what is counted of all cases, and of each."""
    each = [c.found.everything for c in cases]
    removed = [e.removed for e in each if e.removed is not None]
    inside, points = sum(e.inside for e in each), sum(e.count for e in each)
    share, left = inside / points, sum(len(c.found.left_out) for c in cases)
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
        Figure("points that could not be corrected or reached", str(left)),
    ]
    for c, e in zip(cases, each, strict=True):
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
