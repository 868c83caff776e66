"""`python -m studies odds`: stated probabilities of laws against the frequency of right ones.

Laws are drawn from the priors of the search: complexity c with probability ∝ 2⁻ᶜ, all candidates of
a complexity alike. One law in four has two terms, for which the prior of the search is 1 in 21.
Each law is added with noise to the linear problem of a simulated campaign, at a strength from 0.5 σ
to 2 σ. Where the search chooses a law, the listed structures are compared with the drawn one.
Predictions of fresh poses, by the chosen law alone and averaged over the listed ones, are compared
with the truth.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
import typer

from hilcal.cell import cell_from_config
from hilcal.cli.demo import CELL
from hilcal.cli.options import Json
from hilcal.cli.terminal import terminal
from hilcal.config import load_config
from hilcal.discovery.law import form_of
from hilcal.discovery.problem import SearchProblem
from hilcal.discovery.screen import LawTerm, Screen, screen
from hilcal.discovery.search import averaged, search, structure_of, structures
from hilcal.discovery.sites import motions_of
from hilcal.drivers.simulated.injected_effects import world_without_effect
from hilcal.drivers.simulated.rehearsal import measurement_noise, simulate
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import Linearisation, linearise
from hilcal.present.progress import counting
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import MODES, whitening
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Floats
from studies.discover_command import ROBOTS
from studies.random_campaigns import rehearsal_states
from studies.records import Cases, Figure, Keep, keep, resumed
from studies.study_cases import with_study_loads

POSES, LOADS, OF_CAMPAIGN = 12, 2, 12
STRENGTHS = (0.5, 2.0)
SECOND = 0.25
"""Share of the drawn laws that have two terms."""
COVERED = 1.96
BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)


@dataclass(frozen=True, slots=True)
class OddsCase:
    """Result of one drawn law.

    Attributes:
        truth: its formula.
        found: formula of the proposed law; empty for none.
        said: probability of each listed structure, and whether it is the drawn one.
        alone: rms error at fresh poses by the proposed law, m, and share of elements within 95 %.
        average: the same of the average over the listed structures.
        before: rms error without a law, m.
    """

    truth: str
    found: str = ""
    said: tuple[tuple[float, bool], ...] = ()
    alone: tuple[float, float] = (0.0, 0.0)
    average: tuple[float, float] = (0.0, 0.0)
    before: float = 0.0


@cache
def _campaign(number: int) -> tuple[Screen, Readings]:
    """Return the screen of a simulated campaign, and readings of as many fresh poses."""
    rng = np.random.default_rng([20261126, number])
    config = load_config(configs_dir() / "cells" / CELL)
    robot_config, loads = with_study_loads(config, ROBOTS[number % len(ROBOTS)])
    mode, loads = MODES[number % len(MODES)], loads[:LOADS]
    cell = cell_from_config(robot_config)
    world = world_without_effect(
        cell,
        rng,
        noise=measurement_noise(robot_config),
        joint_std=robot_config.repeatability.per_joint(cell.arm.n),
    )
    names = ("none", *(name for name, _ in loads))
    readings, fresh = (
        simulate(world, *rehearsal_states(cell, POSES, loads, rng), names, rng) for _ in range(2)
    )
    return screen(linearise(fit(baseline(cell, readings, mode), readings, mode))), fresh


def run_case(seed: int) -> OddsCase:
    """Draw a law and noise, search, and predict fresh poses."""
    bare, fresh = _campaign(seed // OF_CAMPAIGN)
    rng, linear = np.random.default_rng([20261127, seed]), bare.linear
    base = linear.fit
    terms = _drawn(bare, rng)
    form, situation = form_of(bare, terms), base.solution.prediction.situation
    x = form.columns(bare, situation)
    coefficients = rng.standard_normal(form.count)
    size = float(np.sqrt(np.mean(linear.project_out(x @ coefficients) ** 2)))
    coefficients *= np.exp(rng.uniform(*np.log(STRENGTHS))) / size
    noise = rng.standard_normal(len(x))
    residual = linear.project_out(x @ coefficients + noise)
    fitted = Linearisation(replace(base, white=residual), linear.projection, residual)
    s = replace(bare, linear=fitted)
    problem = SearchProblem(s)
    selections = search(problem)
    if not selections:
        return OddsCase(form.text())
    listed = structures(problem, selections)
    chosen = {structure_of(s, f.terms) for f in selections[-1:]}
    (law,) = (f for f in listed if f.kind in chosen)
    truth = structure_of(bare, terms)
    # The model was fitted to readings with the law and the noise, and absorbed a part of both.
    prediction = base.model.predict(fresh.states, base.theta)
    w = whitening(fresh, base.mode)
    motions = motions_of(base.model, prediction, base.theta, w.m)
    by_law = form.motion(*motions, prediction.situation)
    by_model = w.raw(base.model.jacobian(prediction, base.theta, w.m)) @ base.solution.transform
    absorbed = linear.projection.solve(linear.rows.T @ (x @ coefficients + noise))
    error = w.raw(by_law @ coefficients) - by_model @ absorbed
    return OddsCase(
        form.text(),
        law.form.text(),
        tuple((f.probability, f.kind == truth) for f in listed),
        _errors(error, *averaged(base, [law], fresh)),
        _errors(error, *averaged(base, listed, fresh)),
        float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
    )


def _errors(truth: Floats, mean: Floats, std: Floats) -> tuple[float, float]:
    error = truth - mean[:, :3]
    inside = np.abs(error) <= COVERED * std[:, :3]
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1)))), float(np.mean(inside))


def _drawn(s: Screen, rng: np.random.Generator) -> tuple[LawTerm, ...]:
    """Draw the terms of a law among all candidates that the model does not explain."""
    out: list[LawTerm] = []
    costs = np.arange(1, int(s.grammar.cost.max()) + 1)
    count = 1 + (rng.random() < SECOND)
    while len(out) < count:
        cost = rng.choice(costs, p=2.0**-costs / np.sum(2.0**-costs))
        site = int(rng.integers(len(s.sites)))
        amplitude = int(rng.choice(np.flatnonzero(s.grammar.cost == cost)))
        if s.square[site, amplitude] > 0:
            out.append(LawTerm(((site, amplitude),), 0.0))
    return tuple(out)


def odds(
    laws: Annotated[
        int, typer.Option("--laws", help="Laws that are drawn; 0 for those of --cases.")
    ] = 60,
    cases: Cases = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Draw laws from the priors of the search, and compare probabilities with frequencies."""
    t = terminal(as_json)
    done: list[dict[str, Any]] = []
    with counting(t.progress, "laws", laws) as advance:
        for case in resumed(cases, [*map(str, range(laws))], lambda k: asdict(run_case(int(k)))):
            done.append(case)
            advance(1)
    figures = list(claims(done))
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    keep(keep_file, "Probabilities of laws", figures, {"cases": done})
    t.document({"cases": done, "figures": [asdict(f) for f in figures]})


def claims(done: Sequence[dict[str, Any]]) -> Iterator[Figure]:
    """Yield frequencies by probability, and errors of one law and of the average."""
    proposed = [o for o in done if o["said"]]
    yield Figure("laws drawn, and proposed", f"{len(done)}, {len(proposed)}")
    stated = np.array([p for o in proposed for p in o["said"]]).reshape(-1, 2)
    for low, high in pairwise(BINS):
        in_bin = stated[(stated[:, 0] > low) & (stated[:, 0] <= high)]
        if len(in_bin):
            right, mean = int(in_bin[:, 1].sum()), float(in_bin[:, 0].mean())
            yield Figure(
                f"structures said to have a probability of {100 * low:.0f} % to {100 * high:.0f} %",
                f"right {right} of {len(in_bin)} ({100 * right / len(in_bin):.0f} %); "
                f"said on average {100 * mean:.0f} %",
            )
    if not proposed:
        return
    for count, two in (
        ("one term", False),
        ("two terms, which the prior of the search doubts", True),
    ):
        first = [o["said"][0] for o in proposed if ("b·" in o["truth"]) == two]
        expected = sum(p for p, _ in first)
        spread = float(np.sqrt(sum(p * (1 - p) for p, _ in first)))
        right = sum(hit for _, hit in first)
        yield Figure(
            f"the likeliest structure of drawn laws of {count}",
            f"right in {right} of {len(first)}; expected {expected:.1f} ± {spread:.1f}",
            "" if two else "within 2 standard deviations",
            None if two else abs(right - expected) <= 2 * spread,
        )
    alone, average = (np.array([o[k] for o in proposed]) for k in ("alone", "average"))
    ratio = np.log(average[:, 0] / alone[:, 0])
    better = int(np.count_nonzero(ratio < 0))
    yield Figure(
        "error at fresh poses, averaged over that of the first law alone",
        f"{float(np.exp(ratio.mean())):.3f} (geometric mean), "
        f"smaller in {better} of {len(proposed)}",
        "below 1", bool(ratio.mean() < 0),
    )  # fmt: skip
    for name, errors in (("the first law alone", alone), ("the average", average)):
        yield Figure(
            f"elements of fresh poses inside the 95 % interval of {name}",
            f"{100 * float(errors[:, 1].mean()):.1f} %",
        )
