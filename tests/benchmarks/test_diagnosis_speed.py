"""Cost of a diagnosis, a refinement and a plan of what separates suspects, against one fit.

The machine's speed cancels in the ratios: works are timed in turn, and the shortest times compared;
processor time of this process, so that what else runs does not count. Nothing is asserted of
times; `make bench` prints the ratios at its end and stores them in `extra_info`.
"""

from dataclasses import replace

import pytest

from hilcal.diagnosis.effect_ranking import candidates, rank_suspects
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import linearise
from tests.support.campaigns import campaign
from tests.support.effect_cases import make
from tests.support.timing import shortest

pytestmark = pytest.mark.slow

LOADS = 5  # readings of a pose
ROUNDS = 3


def based(c):
    return fit(baseline(c.cell, c.readings, c.mode), c.readings, c.mode)


def largest(found):
    """The baseline and the suspect with most parameters."""
    names = {e.name: len(e.parameters) for e in candidates(found)}
    name = max(names, key=lambda n: names[n])
    states = found.readings.states
    return found.model + make(name, found.model.cell, states, m=found.readings.m)


def score(found):
    return rank_suspects(linearise(found), candidates(found))


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
@pytest.mark.parametrize("readings", [180, 1000])
def test_scoring_against_a_fit_of_the_largest_model(readings, mode, benchmark, claim):
    """`ratio`: scoring the catalogue over one fit of the largest model; `diagnose_s`: all of it."""
    fitted = based(campaign("hysteresis", mode, poses=readings // LOADS, strength=2.0))
    assert len(fitted.readings) == readings
    model = largest(fitted)
    seconds = shortest(
        {
            "fit": lambda: fit(model, fitted.readings, mode),
            "scoring": lambda: score(fitted),
            "diagnose": lambda: diagnose(fitted),
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
    suspects = benchmark.pedantic(score, args=(fitted,), rounds=1)
    assert "hysteresis" in {s.effect for s in suspects}


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
def test_diagnosing_what_nothing_explains(mode, benchmark, claim):
    """`diagnose_s`: with smooth laws of the residual, which a good suspect spares."""
    c = campaign("none", mode, poses=1000 // LOADS)
    fitted = based(replace(c, readings=replace(c.readings, covariance=c.readings.covariance / 4)))
    seconds = shortest({"diagnose": lambda: diagnose(fitted)}, ROUNDS)["diagnose"]
    benchmark.extra_info["diagnose_s"] = seconds
    what = f"1000 {mode} readings of twice the stated noise: the whole diagnosis, s"
    claim(what, f"{seconds:.2f}", "aim: 1")
    diagnosis = benchmark.pedantic(diagnose, args=(fitted,), rounds=1)
    assert diagnosis.verdict == "noise_misjudged"
