"""`python -m studies odds`: whether laws said to have a probability are right as often.

Laws are drawn as the priors of the search have it: complexity c with probability ∝ 2⁻ᶜ, all
candidates of it alike; in one case of four two of them, which it holds for 1 in 21. Each is added
with noise to the linear problem of a simulated campaign, at a strength from 0.5 σ to 2 σ. Where the
search chooses a law, the structures that are listed are compared with what was drawn; and so are
predictions of fresh poses, by the chosen law alone and averaged over the listed ones, with the
truth there.
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
from hilcal.discovery.search import search
from hilcal.discovery.sites import motions_of
from hilcal.discovery.structures import averaged, structure_of, structures
from hilcal.drivers.simulated.injected_effects import nothing_hidden
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
class Drawn:
    """What came of one drawn law.

    Attributes:
        truth: its formula.
        found: that of the proposed law; empty for none.
        said: probability of each listed structure, and whether it is what was drawn.
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
    """Return all candidates of a simulated campaign, and readings of as many fresh poses."""
    rng = np.random.default_rng([20261126, number])
    config = load_config(configs_dir() / "cells" / CELL)
    own, loads = with_study_loads(config, ROBOTS[number % len(ROBOTS)])
    mode, loads = MODES[number % len(MODES)], loads[:LOADS]
    cell = cell_from_config(own)
    world = nothing_hidden(
        cell, rng, noise=measurement_noise(own), joint_std=own.repeatability.per_joint(cell.arm.n)
    )
    names = ("none", *(name for name, _ in loads))
    readings, fresh = (
        simulate(world, *rehearsal_states(cell, POSES, loads, rng), names, rng) for _ in range(2)
    )
    return screen(linearise(fit(baseline(cell, readings, mode), readings, mode))), fresh


def run_case(seed: int) -> Drawn:
    """Draw a law and noise, search, and predict fresh poses."""
    bare, fresh = _campaign(seed // OF_CAMPAIGN)
    rng, linear = np.random.default_rng([20261127, seed]), bare.linear
    base = linear.fit
    terms = _drawn(bare, rng)
    form, situation = form_of(bare, terms), base.solution.prediction.situation
    x = form.columns(bare, situation)
    by = rng.standard_normal(form.count)
    size = float(np.sqrt(np.mean(linear.project_out(x @ by) ** 2)))
    by *= np.exp(rng.uniform(*np.log(STRENGTHS))) / size
    noise = rng.standard_normal(len(x))
    left = linear.project_out(x @ by + noise)
    s = replace(bare, linear=Linearisation(replace(base, white=left), linear.projection, left))
    problem = SearchProblem(s)
    selections = search(problem)
    if not selections:
        return Drawn(form.text())
    found = structures(problem, selections)
    chosen = {structure_of(s, f.terms) for f in selections[-1:]}
    (law,) = (f for f in found if f.kind in chosen)
    truth = structure_of(bare, terms)
    # The model was fitted with the law and the noise in the readings: it has taken part of both.
    at = base.model.predict(fresh.states, base.theta)
    w = whitening(fresh, base.mode)
    there = form.motion(*motions_of(base.model, at, base.theta, w.m), at.situation)
    known = w.raw(base.model.jacobian(at, base.theta, w.m)) @ base.solution.transform
    taken = linear.projection.solve(linear.rows.T @ (x @ by + noise))
    off = w.raw(there @ by) - known @ taken
    return Drawn(
        form.text(),
        law.form.text(),
        tuple((f.probability, f.kind == truth) for f in found),
        _errors(off, *averaged(base, [law], fresh)),
        _errors(off, *averaged(base, found, fresh)),
        float(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
    )


def _errors(left: Floats, mean: Floats, std: Floats) -> tuple[float, float]:
    off = left - mean[:, :3]
    inside = np.abs(off) <= COVERED * std[:, :3]
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))), float(np.mean(inside))


def _drawn(s: Screen, rng: np.random.Generator) -> tuple[LawTerm, ...]:
    """Draw the terms of a law among all that the model does not describe."""
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
    found = [o for o in done if o["said"]]
    yield Figure("laws drawn, and proposed", f"{len(done)}, {len(found)}")
    said = np.array([p for o in found for p in o["said"]]).reshape(-1, 2)
    for low, high in pairwise(BINS):
        mine = said[(said[:, 0] > low) & (said[:, 0] <= high)]
        if len(mine):
            right, mean = int(mine[:, 1].sum()), float(mine[:, 0].mean())
            yield Figure(
                f"structures said to have a probability of {100 * low:.0f} % to {100 * high:.0f} %",
                f"right {right} of {len(mine)} ({100 * right / len(mine):.0f} %); "
                f"said on average {100 * mean:.0f} %",
            )
    if not found:
        return
    for count, two in (
        ("one term", False),
        ("two terms, which the prior of the search doubts", True),
    ):
        first = [o["said"][0] for o in found if ("b·" in o["truth"]) == two]
        expected = sum(p for p, _ in first)
        spread = float(np.sqrt(sum(p * (1 - p) for p, _ in first)))
        right = sum(hit for _, hit in first)
        yield Figure(
            f"the likeliest structure of drawn laws of {count}",
            f"right in {right} of {len(first)}; expected {expected:.1f} ± {spread:.1f}",
            "" if two else "within 2 standard deviations",
            None if two else abs(right - expected) <= 2 * spread,
        )
    alone, average = (np.array([o[k] for o in found]) for k in ("alone", "average"))
    ratio = np.log(average[:, 0] / alone[:, 0])
    better = int(np.count_nonzero(ratio < 0))
    yield Figure(
        "error at fresh poses, averaged over that of the first law alone",
        f"{float(np.exp(ratio.mean())):.3f} (geometric mean), smaller in {better} of {len(found)}",
        "below 1", bool(ratio.mean() < 0),
    )  # fmt: skip
    for name, of in (("the first law alone", alone), ("the average", average)):
        yield Figure(
            f"elements of fresh poses inside the 95 % interval of {name}",
            f"{100 * float(of[:, 1].mean()):.1f} %",
        )
