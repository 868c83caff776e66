"""`python -m studies carry`: what a campaign of a real arm saves the next one, with frames anew."""

import json
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from scipy.spatial.transform import Rotation

from hilcal.calibration.calibration import Calibration
from hilcal.cell import Cell
from hilcal.cli.options import Json, OneJob, Scheduler, one_by_default
from hilcal.cli.terminal import terminal
from hilcal.engine import open_engine
from hilcal.errors import CannotAnswerError
from hilcal.identification.baseline import baseline
from hilcal.identification.carried.carried_prior import CarriedPrior, carried_prior
from hilcal.identification.carried.posterior import Posterior
from hilcal.identification.fit import Fit, fit
from hilcal.identification.noise.arm_scatter import with_prior_scatter
from hilcal.library import read_table
from hilcal.present.progress import counting, working
from hilcal.readings.readings import Readings
from hilcal.refinement import refine
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Floats
from studies.carry_picture import PICTURE, Point
from studies.compensation_command import judged
from studies.records import Figure, Keep, keep

TURN, FAR_M, OFFSET_M = np.pi, 3.0, 0.05
"""Changes of a new setup: tracker and target turn by up to half a turn; along each axis the tracker
moves by up to 3 m, the target by up to 5 cm."""
MOST_TESTED = 400
"""Most poses that test a fit, at random from those that are not fitted."""


@dataclass(frozen=True, slots=True)
class CarryOutcome:
    """One fit to N poses.

    Attributes:
        mean_m: mean 3-D error of the tested poses.
        inside: share of the tested poses in the 95 % band of the calibration.
    """

    mean_m: float
    inside: float


def carry(
    first: Annotated[Path, typer.Argument(metavar="B.csv", help="The series of the prior.")],
    second: Annotated[
        Path | None, typer.Argument(metavar="C.csv", help="Another series of the same arm.")
    ] = None,
    poses: Annotated[str, typer.Option("--poses", help="N of the rest of B.")] = "10,20,40,80",
    other_poses: Annotated[str, typer.Option("--other-poses", help="N of C.")] = "20,50,100,200",
    draws: Annotated[int, typer.Option("--draws", help="Draws of the N poses.")] = 5,
    without: Annotated[bool, typer.Option("--without/--no-without")] = True,
    before: Annotated[
        Path | None,
        typer.Option("--without-of", metavar="F.json", help="An earlier record's errors without."),
    ] = None,
    jobs: OneJob = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Fit N poses of the IPA UR10 with and without half of Series B as prior."""
    t = terminal(as_json)
    recorded = _without_of(before)
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    figures: list[Figure] = []
    points: list[Point] = []
    with working(t.progress) as say:
        say("refining half of the first series")
        half = _readings("half of B", first)
        refined = refine(baseline(cell, half, "absolute"), half, "absolute").fit
        prior = carried_prior(Posterior.of(refined))
    cases = [("B", first, n) for n in _numbers(poses)]
    if second is not None:
        cases += [("C", second, n) for n in _numbers(other_poses)]
    run = partial(_drawn, prior=prior, draws=draws, without=without)
    with (
        open_engine(*one_by_default(jobs, scheduler)) as engine,
        counting(t.progress, "numbers of poses", len(cases)) as advance,
    ):
        done = engine.map(run, cases, advance=advance)
    for (name, _, n), (with_it, alone) in zip(cases, done, strict=True):
        figures += _figures(name, n, with_it, alone, recorded.get((name, n)))
        errors = [o.mean_m for o in alone] or recorded.get((name, n), [])
        points.append(Point(name, n, [o.mean_m for o in with_it], errors))
        t.show(f"{figures[-1].what}: {figures[-1].measured}")
    title = "A real UR10 measured again: half of Series B as prior, tracker and target set up anew"
    if not _numbers(poses):
        title = (
            "A real UR10 measured again elsewhere: half of Series B as prior of Series C, "
            "frames anew"
        )
    content = {"picture": PICTURE, "points": [asdict(p) for p in points]}
    keep(keep_file, title, figures, content)
    t.document({"figures": [{"what": f.what, "measured": f.measured} for f in figures]})


@cache
def _readings(which: str, path: Path) -> Readings:
    """Return "half of B", its other half as "B", or all of a series as "C"."""
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    readings = read_table(path, cell, "ipa-ur10")
    if which == "C":
        return readings
    order = np.random.default_rng(0).permutation(len(readings))
    first, second = np.split(order, [len(readings) // 2])
    return readings[np.sort(first if which == "half of B" else second)]


def _drawn(
    case: tuple[str, Path, int], prior: CarriedPrior, draws: int, without: bool
) -> tuple[list[CarryOutcome], list[CarryOutcome]]:
    """Fit n poses of a series, drawn several times, with the prior and without any."""
    name, path, n = case
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    readings = _readings(name, path)
    with_it, alone = [], []
    for draw in range(draws):
        rng = np.random.default_rng([draw, n])
        order = rng.permutation(len(readings))
        anew = set_up_anew(readings, rng)
        some = anew[np.sort(order[:n])]
        tested = anew[np.sort(order[n:][:MOST_TESTED])]
        with_it.append(outcome(_carried(cell, some, prior), tested))
        if without:
            alone.append(outcome(_alone(cell, some), tested))
    return with_it, alone


def set_up_anew(readings: Readings, rng: np.random.Generator) -> Readings:
    """Return the readings as of another tracker and another target, with unknown frames."""
    turn = Rotation.from_rotvec(rng.uniform(-TURN, TURN, 3) / np.sqrt(3))
    mount = Rotation.from_rotvec(rng.uniform(-TURN, TURN, 3) / np.sqrt(3))
    place, offset = rng.uniform(-FAR_M, FAR_M, 3), rng.uniform(-OFFSET_M, OFFSET_M, 3)
    attitude = Rotation.from_rotvec(readings.value[:, 3:])
    lever = attitude.apply(offset)
    value = readings.value.copy()
    value[:, :3] = turn.apply(value[:, :3] + lever) + place
    value[:, 3:] = (turn * attitude * mount).as_rotvec()
    # An error of the attitude displaces the new target by its lever.
    moves = np.tile(np.eye(6), (len(value), 1, 1))
    # dp' = dp + dφ × lever
    moves[:, :3, 3:] = np.cross(np.eye(3)[None], lever[:, None, :]).transpose(0, 2, 1)
    axes = np.kron(np.eye(2), turn.as_matrix())
    moves = axes @ moves
    covariance = moves @ readings.covariance @ np.swapaxes(moves, 1, 2)
    return replace(readings, value=value, covariance=(covariance + covariance.swapaxes(1, 2)) / 2)


def outcome(fitted: Fit | None, tested: Readings) -> CarryOutcome:
    """Predict tested poses by the calibration of a fit; without a fit the error is infinite."""
    if fitted is None:
        return CarryOutcome(float("inf"), 0.0)
    c = Calibration.of(fitted)
    errors, inside = judged(c, c.predict(tested.states.q, tested.states.wrench), tested)
    return CarryOutcome(float(errors.mean()), float(inside.mean()))


def _carried(cell: Cell, some: Readings, prior: CarriedPrior) -> Fit:
    model = baseline(cell, some, "absolute", prior=prior)
    return fit(model, with_prior_scatter(model, some), "absolute")


def _alone(cell: Cell, some: Readings) -> Fit | None:
    try:
        return refine(baseline(cell, some, "absolute"), some, "absolute").fit
    except CannotAnswerError:
        return None


def _without_of(record: Path | None) -> dict[tuple[str, int], list[float]]:
    """Mean errors without a prior, m, by series and N, from a record of a previous run."""
    if record is None:
        return {}
    points = json.loads(record.read_text())["points"]
    return {(p["series"], p["poses"]): p["without_m"] for p in points}


def _figures(
    name: str,
    n: int,
    with_it: list[CarryOutcome],
    alone: list[CarryOutcome],
    recorded: list[float] | None = None,
) -> list[Figure]:
    errors = np.array([o.mean_m for o in with_it])
    shares = np.array([o.inside for o in with_it])
    inside = float(shares.mean())
    text = _um(errors)
    met, required = None, ""
    if name == "B" and n == 20:
        met, required = bool(errors.mean() <= 1.2e-4), "120 µm at most"
    if alone:
        without = np.array([o.mean_m for o in alone])
        ratio = float(np.mean(errors / without))
        text += f"; without prior {_um(without)}"
        if name != "B":
            text += f"; ratio {ratio:.2f}, worst {float((errors / without).max()):.2f}"
            met, required = ratio <= 1.05, "ratio 1.05 at most"
    elif recorded:
        mean = float(np.mean(recorded))
        text += f"; without prior {1e6 * mean:.0f} µm (an earlier run)"
        if name != "B":
            ratio = float(errors.mean()) / mean
            text += f"; ratio {ratio:.2f}"
            met, required = ratio <= 1.05, "ratio 1.05 at most"
    title = f"{n} poses of {'the other half of B' if name == 'B' else name}: mean error with prior"
    return [
        Figure(title, text, required, met),
        Figure(
            f"{n} poses of {'B' if name == 'B' else name}: share in the stated 95 % band",
            f"{100 * inside:.1f} % ({len(shares)} draws: {100 * shares.min():.1f} to "
            f"{100 * shares.max():.1f} %)",
            "90 to 97 %",
            0.90 <= inside <= 0.97,
        ),
    ]


def _um(values: Floats) -> str:
    return f"{1e6 * values.mean():.0f} µm (worst draw {1e6 * values.max():.0f})"


def _numbers(text: str) -> list[int]:
    return [int(n) for n in text.split(",") if n.strip()]
