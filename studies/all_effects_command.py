"""`python -m studies all-effects`: arms that have every effect at once, and the best predictor.

Like real arms, the simulated ones have all families of the catalogue that unloaded readings allow,
u ~ N(0, (k s)² D), with their ordinary sizes s and one factor k for the arm, 1 unless `--sizes`
spreads it. A few random poses are refined as by `hilcal refine`; 300 others are predicted. The best
linear predictor has the true standard deviations and noise, and is linearised at the truth: no
predictor is better on average.

With `--law` the arms also follow a law that the catalogue lacks: joint 2 errs by a sin 3 q_4, as a
crossed gear does. The best linear predictor knows the law.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Annotated

import numpy as np
import typer
from scipy.stats import chi2

from hilcal.cell import Cell, cell_from_config
from hilcal.cli.options import Json, OneJob, Scheduler, one_by_default
from hilcal.cli.terminal import terminal
from hilcal.config import CellConfig
from hilcal.engine import open_engine
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.mixed_fit import (
    SCATTER_RAD,
    linearised_problem,
    with_all_effects,
)
from hilcal.identification.noise.full_covariance import joint_factors
from hilcal.mixed.equations import equations
from hilcal.mixed.families import families_of
from hilcal.model.model import Model
from hilcal.present.progress import counting
from hilcal.readings.readings import Readings
from hilcal.refinement import refine
from hilcal.robot.chain import evaluate
from hilcal.types import Floats
from studies.few_poses_command import share_in_band
from studies.random_descriptions import readings_of
from studies.records import Figure, Keep, keep

ROBOTS = ("ur3e", "ur5", "ur10e")
TEST = 300
TARGET_M = np.array([0.05, 0.02, 0.1])  # flange frame
INSTRUMENT_M, SCATTER = 1e-5, 1e-5
"""Standard deviations of a coordinate, m, and of a joint's arrival, rad."""
TURN = 2.5
"""Largest absolute joint angle, rad."""
MOST_RATIO = 1.1
BAND = (0.93, 0.97)


@dataclass(frozen=True, slots=True)
class AllEffectsCase:
    """A campaign on a simulated arm.

    Attributes:
        poses: number of fitted poses.
        seed: of arm, poses and noise.
        factor: factor k of all sizes.
        without: whether the poses are also refined without a background.
        law_rad: amplitude a of a law that the catalogue lacks, rad.
    """

    poses: int
    seed: int
    factor: float
    without: bool
    law_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class AllEffectsResult:
    """Result of a case.

    Attributes:
        poses: number of fitted poses.
        factor: k.
        rms_m: rms error of predicted positions.
        best_m: rms error of the best linear predictor.
        inside: share of the predicted positions within their 95 % band.
        best_inside: share within the band of the best linear predictor, with the same arms.
        named: named effects of the last model.
        verdict: of the last model.
        without_m: rms error without a background; None where this was not requested.
    """

    poses: int
    factor: float
    rms_m: float
    best_m: float
    inside: float
    best_inside: float
    named: tuple[str, ...]
    verdict: str
    without_m: float | None


def all_effects(
    poses: Annotated[str, typer.Option("--poses", help="Numbers that are fitted.")] = "20,30,60",
    seeds: Annotated[int, typer.Option("--seeds", help="Arms of each number.")] = 20,
    sizes: Annotated[
        float, typer.Option("--sizes", help="Factor of all sizes at most, either way.")
    ] = 1.0,
    without: Annotated[
        bool, typer.Option("--without", help="Also refine without a background.")
    ] = False,
    law: Annotated[
        float, typer.Option("--law", help="Of a law that the catalogue lacks, mrad.")
    ] = 0.0,
    first_seed: Annotated[int, typer.Option("--first-seed", help="Of the arms.")] = 0,
    jobs: OneJob = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Refine few poses of simulated arms that have all effects at once."""
    t = terminal(as_json)
    counts = [int(n) for n in poses.split(",")]
    cases = [
        AllEffectsCase(
            n, s, float(sizes ** np.random.default_rng([s, 1]).uniform(-1, 1)), without, 1e-3 * law
        )
        for n, s in product(counts, range(first_seed, first_seed + seeds))
    ]
    with (
        open_engine(*one_by_default(jobs, scheduler)) as engine,
        counting(t.progress, "arms", len(cases)) as advance,
    ):
        done: Sequence[AllEffectsResult | None] = engine.map(refined, cases, advance=advance)
    answered = [d for d in done if d is not None]
    figures = [f for n in counts for f in _figures(n, [d for d in answered if d.poses == n])]
    if law:  # what is required holds for arms that the catalogue describes
        figures = [Figure(f.what, f.measured) for f in figures]
    if refused := len(done) - len(answered):
        figures.append(Figure("campaigns refused: the arm is not as described", f"{refused}"))
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    title = f"All effects at once, sizes 1/{sizes:g} to {sizes:g} times ordinary"
    law_too = f"{title}, and a law of {law:g} mrad that the catalogue lacks"
    keep(keep_file, law_too if law else title, figures)
    t.document({"cases": [asdict(d) for d in answered]})


def campaign_of(case: AllEffectsCase) -> tuple[Cell, Readings, Readings]:
    """Return the cell, the readings to fit, and those to predict."""
    cell, _, every, *_ = _campaign(case)
    return cell, every[np.arange(case.poses)], every[np.arange(case.poses, len(every))]


def _campaign(case: AllEffectsCase) -> tuple[Cell, Readings, Readings, Model, Floats, Floats]:
    """Return the cell, readings without and with the law, the true model, (P,) and log s (F,)."""
    rng = np.random.default_rng(case.seed)
    cell = cell_from_config(
        CellConfig.model_validate(
            {
                "robot": {"model": ROBOTS[case.seed % len(ROBOTS)]},
                "tool": {"target_m": TARGET_M.tolist(), "mass_kg": 1.0, "com_m": [0.0, 0.0, 0.04]},
            }
        )
    )
    q = rng.uniform(-TURN, TURN, (case.poses + TEST, cell.arm.n))
    known, model, theta, log_std = _measured(cell, q, case.factor, rng)
    return cell, known, _with_law(cell, known, case.law_rad), model, theta, log_std


def refined(case: AllEffectsCase) -> AllEffectsResult | None:
    """Refine the poses of a case, and predict others; None where the program refuses them."""
    cell, known, every, model, theta, log_std = _campaign(case)
    some, test = every[np.arange(case.poses)], every[np.arange(case.poses, len(every))]
    try:
        start = baseline(cell, some, "absolute")
    except InputError:
        return None
    last = refine(start, some, "absolute")
    error = test.value - last.fit.model.predict(test.states, last.fit.theta).observation.position
    inside = share_in_band(last.fit, test, error)
    some, test = known[np.arange(case.poses)], known[np.arange(case.poses, len(every))]
    problem = linearised_problem(model, some, "absolute", theta)
    noise = [0.0, float(np.log(SCATTER / SCATTER_RAD))][: len(problem.noise)]
    best = equations(problem, np.concatenate([log_std, noise]))
    best_theta = problem.parameters(best.coordinates, model.size)
    ideal_prediction = model.predict(test.states, best_theta)
    ideal = test.value - ideal_prediction.observation.position
    x = problem.coordinates(model.jacobian(ideal_prediction, best_theta, 3))
    moved = joint_factors(cell, test, np.full(cell.arm.n, SCATTER))
    band = x @ best.covariance @ np.swapaxes(x, 1, 2) + moved @ np.swapaxes(moved, 1, 2)
    band += INSTRUMENT_M**2 * np.eye(3)
    square = np.einsum("ni,nij,nj->n", ideal, np.linalg.inv(band), ideal)
    names = last.fit.model.named
    without = None
    if case.without:
        plain = refine(start, some, "absolute", background=False).fit
        position = plain.model.predict(test.states, plain.theta).observation.position
        without = _rms(test.value - position)
    return AllEffectsResult(
        case.poses,
        case.factor,
        _rms(error),
        _rms(ideal),
        inside,
        float(np.mean(square < chi2.ppf(0.95, 3))),
        tuple(n for n in names if n not in ("base_frame", "target_offset")),
        last.verdict,
        without,
    )


def _measured(
    cell: Cell, q: Floats, factor: float, rng: np.random.Generator
) -> tuple[Readings, Model, Floats, Floats]:
    """Return readings at q (N, n), the true model, its parameters (P,), and log s (F,)."""
    target = evaluate(cell.arm, q).point(TARGET_M)
    plain = readings_of(q, target, np.full(3, INSTRUMENT_M))
    model = with_all_effects(baseline(cell, plain, "absolute"), plain.states)
    families = families_of(model).random
    log_std = np.array([f.prior.mean + (0.0 if f.known else np.log(factor)) for f in families])
    theta = np.zeros(model.size)
    for f, size in zip(families, np.exp(log_std), strict=True):
        theta[f.parameters] = size * f.magnitude * rng.standard_normal(len(f.parameters))
    value = model.predict(plain.states, theta).observation.position
    moved = joint_factors(cell, plain, np.full(cell.arm.n, SCATTER))
    value = value + INSTRUMENT_M * rng.standard_normal(value.shape)
    value += np.einsum("nij,nj->ni", moved, rng.standard_normal((len(q), moved.shape[2])))
    readings = readings_of(q, value, np.full(3, INSTRUMENT_M))
    return replace(readings, scatter_stated=False), model, theta, log_std


def _with_law(cell: Cell, readings: Readings, law_rad: float) -> Readings:
    """Return readings of an arm of which joint 2 also errs by a sin 3 q_4, a in rad."""
    dq = np.zeros_like(readings.states.q)
    dq[:, 1] = law_rad * np.sin(3.0 * readings.states.q[:, 3])
    at, there = (
        evaluate(cell.arm, q).point(TARGET_M) for q in (readings.states.q, readings.states.q + dq)
    )
    return replace(readings, value=readings.value + there - at)


def _rms(error: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def _figures(poses: int, results: list[AllEffectsResult]) -> list[Figure]:
    """Figures of the arms of one number of poses."""
    ratio = np.array([f.rms_m / f.best_m for f in results])
    inside = float(np.mean([f.inside for f in results]))
    verdicts = [f.verdict for f in results]
    counted = ", ".join(f"{verdicts.count(v)} {v}" for v in dict.fromkeys(verdicts))
    middle = float(np.exp(np.mean(np.log(ratio))))
    best = 1e6 * float(np.median([f.best_m for f in results]))
    least = min(f.inside for f in results)
    ideal, lowest = np.mean([f.best_inside for f in results]), min(f.best_inside for f in results)
    gains = np.array([f.rms_m / f.without_m for f in results if f.without_m])
    out = []
    if len(gains):
        mean = float(np.exp(np.mean(np.log(gains))))
        title = "error by that of refine without a background, geometric mean (largest)"
        measured = f"{mean:.2f} ({gains.max():.2f})"
        out.append(Figure(f"{poses} positions: {title}", measured, "at most 1", mean <= 1.0))
    return [
        *out,
        Figure(
            f"{poses} positions: error at {TEST} others by that of the best linear predictor, "
            f"geometric mean of {len(results)} arms (largest)",
            f"{middle:.2f} ({ratio.max():.2f}); the best leaves {best:.0f} µm (median)",
            f"at most {MOST_RATIO}",
            middle <= MOST_RATIO,
        ),
        Figure(
            f"{poses} positions: of them within their 95 % band (least arm)",
            f"{inside:.0%} ({least:.0%})",
            f"{BAND[0]:.0%} to {BAND[1]:.0%}",
            BAND[0] <= inside <= BAND[1],
        ),
        Figure(
            f"{poses} positions: of the best linear predictor's errors, within its own (least arm)",
            f"{ideal:.0%} ({lowest:.0%})",
        ),
        Figure(f"{poses} positions: verdicts", counted),
    ]
