"""Cost of a diagnosis, a refinement and a plan of what separates suspects, against one fit.

The machine's speed cancels in the ratios: works are timed in turn, and the shortest times compared;
processor time of this process, so that what else runs does not count. Nothing is asserted of
times; `make bench` prints the ratios at its end and stores them in `extra_info`.
"""

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hilcal.design.next import CANDIDATES, SeparatingPlan, plan_separating
from hilcal.design.planner import PlanRequest
from hilcal.diagnosis.effect_ranking import Suspect, candidates, rank_suspects
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import linearise
from hilcal.model.model import Model
from hilcal.readings.whitening import Mode
from hilcal.refinement import Refinement, refine
from tests.benchmarks.conftest import Claim
from tests.support.campaigns import SimulatedCampaign, campaign
from tests.support.effect_cases import make
from tests.support.plan_cases import config_of
from tests.support.timing import shortest

pytestmark = pytest.mark.slow

LOADS = 5  # readings of a pose
ROUNDS = 3
SUSPECTS = ("base_compliance", "joint_tilt_compliance", "link_compliance", "tool_compliance")


def based(c: SimulatedCampaign) -> Fit:
    return fit(baseline(c.cell, c.readings, c.mode), c.readings, c.mode)


def largest(found: Fit) -> Model:
    """The baseline and the suspect with most parameters."""
    names = {e.name: len(e.parameters) for e in candidates(found)}
    name = max(names, key=lambda n: names[n])
    states = found.readings.states
    return found.model + make(name, found.model.cell, states, m=found.readings.m)


def score(found: Fit) -> tuple[Suspect, ...]:
    return rank_suspects(linearise(found), candidates(found))


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
@pytest.mark.parametrize("readings", [180, 1000])
def test_scoring_against_a_fit_of_the_largest_model(
    readings: int, mode: Mode, benchmark: Any, claim: Claim
) -> None:
    """`ratio`: scoring the catalogue over one fit of the largest model; `diagnose_s`: all of it."""
    found = based(campaign("hysteresis", mode, poses=readings // LOADS, strength=2.0))
    assert len(found.readings) == readings
    model = largest(found)
    seconds = shortest(
        {
            "fit": lambda: fit(model, found.readings, mode),
            "scoring": lambda: score(found),
            "diagnose": lambda: diagnose(found),
        },
        ROUNDS,
    )
    ratio = seconds["scoring"] / seconds["fit"]
    benchmark.extra_info.update(
        ratio=ratio, readings=readings, parameters=model.size, diagnose_s=seconds["diagnose"]
    )
    what = f"{readings} {mode} readings"
    one = f"one fit of {model.size} parameters"
    claim(f"{what}: scoring the catalogue over {one}", f"{ratio:.2f}", "aim: 1")
    whole = seconds["diagnose"] / seconds["fit"]
    claim(f"{what}: the whole diagnosis over {one}", f"{whole:.2f}", "no limit")
    aim = "aim: 1 of 1000 readings"
    claim(f"{what}: the whole diagnosis, s", f"{seconds['diagnose']:.2f}", aim)
    suspects = benchmark.pedantic(score, args=(found,), rounds=1)
    assert "hysteresis" in {s.effect for s in suspects}


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
def test_diagnosing_what_nothing_explains(mode: Mode, benchmark: Any, claim: Claim) -> None:
    """`diagnose_s`: with smooth laws and trees on the residual, which a good suspect spares."""
    c = campaign("none", mode, poses=1000 // LOADS)
    found = based(replace(c, readings=replace(c.readings, covariance=c.readings.covariance / 4)))
    seconds = shortest({"diagnose": lambda: diagnose(found)}, ROUNDS)["diagnose"]
    benchmark.extra_info["diagnose_s"] = seconds
    what = f"1000 {mode} readings of twice the stated noise: the whole diagnosis, s"
    claim(what, f"{seconds:.2f}", "aim: 1")
    told = benchmark.pedantic(diagnose, args=(found,), rounds=1)
    assert told.verdict == "noise_misjudged"


def refined() -> Refinement:
    """Poses with a transmission error, of which the model knows nothing yet."""
    c = campaign("transmission_error", "absolute", poses=100, m=6, strength=2.0)
    return refine(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute")


def test_a_refinement_against_a_fit_of_its_largest_model(benchmark: Any, claim: Claim) -> None:
    """`ratio`: the whole refinement over one fit; `each`: the same for each of its steps."""
    found = benchmark.pedantic(refined, rounds=1)
    largest = max((s.fit for s in found.steps), key=lambda f: f.model.size)
    assert "transmission_error" in largest.model.names
    refinements, fits = [], []
    for _ in range(2):
        start = time.process_time()
        refined()
        between = time.process_time()
        again = fit(largest.model, largest.readings, "absolute")
        assert again.holdout.rms_m > 0  # what a step computes, too
        assert again.uncertainty.std.shape == (largest.model.size,)
        refinements.append(between - start)
        fits.append(time.process_time() - between)
    ratio = min(refinements) / min(fits)
    steps = len(found.steps)
    benchmark.extra_info.update(ratio=ratio, steps=steps, parameters=largest.model.size)
    what = f"{len(largest.readings)} readings, {steps} steps: refinement"
    one = f"one fit of {largest.model.size} parameters"
    claim(f"{what} over {one}", f"{ratio:.1f}", "no limit")
    claim(f"{what}, each step over {one}", f"{ratio / steps:.1f}", "no limit")


@pytest.mark.parametrize(("mode", "poses"), [("deflection", 30), ("absolute", 60)])
def test_what_separates_four_suspects(mode: Mode, poses: int, benchmark: Any, claim: Claim) -> None:
    """`ratio`: the plan and its powers over one fit of the campaign."""
    c = campaign(SUSPECTS[1], mode, poses=poses, strength=0.5)
    config = config_of(mode, candidates=CANDIDATES)

    def fitted() -> Fit:
        found = based(c)
        assert found.uncertainty.std.shape == (found.model.size,)
        assert found.holdout.rms_m > 0
        return found

    def planned(found: Fit) -> SeparatingPlan:
        rng = np.random.default_rng(0)
        return plan_separating(c.cell.with_config(config), found, SUSPECTS, PlanRequest(20), rng)

    fitted()  # what is imported late
    start = time.process_time()
    found = fitted()
    one = time.process_time() - start
    start = time.process_time()
    made = benchmark.pedantic(planned, (found,), rounds=1)
    ratio = (time.process_time() - start) / one
    assert len(made.powers) == 12
    assert made.planned.design.efficiency > 0.9
    benchmark.extra_info.update(ratio=ratio, poses=poses)
    claim(f"{poses} poses, {mode}: next of four suspects over one fit", f"{ratio:.1f}", "no limit")
