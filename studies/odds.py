"""`python -m studies odds`: whether laws said to have a probability are right as often.

Laws are drawn as the priors of the search have it: complexity c with probability ∝ 2⁻ᶜ, all
candidates of it alike, two terms in one case of four; each is added to readings of a simulated arm
that hides nothing, at a strength from 0.5 σ to 2 σ. Where `discover` proposes a law, the structures
that it lists are compared with what was drawn, and predictions of fresh poses by the proposed law
alone, and averaged over the listed ones, with the truth there.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Annotated

import numpy as np
import typer

from drivers.simulated.injected_effects import nothing_hidden
from drivers.simulated.rehearsal import measurement_noise, simulate
from hilcal.cell import cell_from_config
from hilcal.cli.demo import CELL
from hilcal.cli.options import Jobs, Json
from hilcal.cli.terminal import terminal
from hilcal.config import CellConfig, load_config
from hilcal.discovery.discovery import discover
from hilcal.discovery.law import form_of
from hilcal.discovery.screen import Screen, screen
from hilcal.discovery.sites import motions_of
from hilcal.discovery.structures import averaged, structure_of
from hilcal.discovery.terms import LawTerm
from hilcal.engine.engine import open_engine
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import linearise
from hilcal.identification.residual import residual
from hilcal.present.progress import counting
from hilcal.readings.whitening import MODES, whitening
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Floats
from studies.discover_command import ROBOTS
from studies.random_campaigns import rehearsal_states
from studies.records import Figure, Keep, keep
from studies.study_cases import with_study_loads

POSES, LOADS = 16, 2
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


def run_case(config: CellConfig, seed: int) -> Drawn:
    """Draw a law, search it, and predict fresh poses."""
    rng = np.random.default_rng([20261126, seed])
    own, loads = with_study_loads(config, ROBOTS[seed % len(ROBOTS)])
    mode = MODES[(seed // len(ROBOTS)) % len(MODES)]
    loads = loads[:LOADS]
    cell = cell_from_config(own)
    world = nothing_hidden(
        cell, rng, noise=measurement_noise(own), joint_std=own.repeatability.per_joint(cell.arm.n)
    )
    names = ("none", *(name for name, _ in loads))
    made = rehearsal_states(cell, POSES, loads, rng)
    readings = simulate(world, *made, names, rng)
    bare = fit(baseline(cell, readings, mode), readings, mode)
    if bare.outlier.any():
        return Drawn("readings set aside")
    s = screen(linearise(bare))
    terms = _drawn(s, rng)
    form, situation = form_of(s, terms), bare.solution.prediction.situation
    x = form.columns(s, situation)
    by = rng.standard_normal(form.count)
    size = float(np.sqrt(np.mean(s.linear.project_out(x @ by) ** 2)))
    by *= np.exp(rng.uniform(*np.log(STRENGTHS))) / size
    moved = form.motion(s.sites, s.motion, situation) @ by
    readings = replace(readings, value=readings.value + moved)
    before = fit(baseline(cell, readings, mode), readings, mode)
    d = discover(before)
    out = Drawn(form.text(), d.laws[0].formula if d.laws else f"({d.reason})")
    if not d.laws:
        return out
    truth = structure_of(s, terms)
    fresh = simulate(world, *rehearsal_states(cell, POSES, loads, rng), names, rng)
    at = bare.model.predict(fresh.states, bare.theta)
    there = form.motion(*motions_of(bare.model, at, bare.theta, bare.whitening.m), at.situation)
    fresh = replace(fresh, value=world.sight(fresh.states).position + there @ by)
    w = whitening(fresh, mode)
    left = residual(fresh, before.model.predict(fresh.states, before.theta), w)[:, :3]
    law = next(x for x in d.structures if x.law == d.laws[0].name)
    return replace(
        out,
        said=tuple((x.probability, x.kind == truth) for x in d.structures),
        alone=_errors(left, *averaged(before, [law], fresh)),
        average=_errors(left, *d.average(fresh)),
        before=float(np.sqrt(np.mean(np.sum(left**2, axis=1)))),
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
    laws: Annotated[int, typer.Option("--laws", help="Laws that are drawn.")] = 60,
    first_seed: Annotated[int, typer.Option("--first-seed", help="Seeds count from here.")] = 0,
    jobs: Jobs = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Draw laws from the priors of the search, and compare probabilities with frequencies."""
    t = terminal(as_json)
    config = load_config(configs_dir() / "cells" / CELL)
    seeds = range(first_seed, first_seed + laws)
    with open_engine(jobs, None) as engine, counting(t.progress, "laws", laws) as advance:
        done = engine.map(partial(run_case, config), seeds, advance=advance)
    figures = list(claims(done))
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    keep(keep_file, "Probabilities of laws", figures, {"cases": [asdict(o) for o in done]})
    t.document({"cases": [asdict(o) for o in done], "figures": [asdict(f) for f in figures]})


def claims(done: Sequence[Drawn]) -> Iterator[Figure]:
    """Yield frequencies by probability, and errors of one law and of the average."""
    found = [o for o in done if o.said]
    yield Figure("laws drawn, and proposed", f"{len(done)}, {len(found)}")
    said = np.array([p for o in found for p in o.said]).reshape(-1, 2)
    for low, high in itertools.pairwise(BINS):
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
    first = [o.said[0] for o in found]
    expected = sum(p for p, _ in first)
    spread = float(np.sqrt(sum(p * (1 - p) for p, _ in first)))
    right = sum(hit for _, hit in first)
    yield Figure(
        "the likeliest structure of each law",
        f"right in {right} of {len(first)}; expected {expected:.1f} ± {spread:.1f}",
        "within 2 standard deviations", abs(right - expected) <= 2 * spread,
    )  # fmt: skip
    alone, average = (np.array([getattr(o, k) for o in found]) for k in ("alone", "average"))
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
