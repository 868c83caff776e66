"""What the diagnosis must reach, on simulated campaigns of every kind; takes many minutes.

`python -m studies diagnosis` counts the same on more arms and seeds. A claim fails here where so
few hits would be rarer than 1 in 1000 if it held.
"""

from functools import partial

import pytest
from scipy.stats import binom

from hilcal.readings.whitening import Mode
from studies.diagnosis import KINDS, DiagnosisOutcome, Kind, run_case
from studies.diagnosis_claims import FOUND, Claim, claims
from studies.diagnosis_command import simulate
from studies.diagnosis_pool import run_all
from studies.diagnosis_questions import Extent, questions
from studies.diagnosis_rates import Rate, by_effect
from studies.diagnosis_table import report
from studies.study_cases import effects_shown, laws_shown

pytestmark = pytest.mark.slow

MODES: tuple[Mode, ...] = ("absolute", "deflection")
ARMS = ("ur10e", "ur3e", "ur5e")
RARE = 1e-3


def studied(kind: Kind, mode: Mode, robots: tuple[str, ...] = ARMS) -> tuple[DiagnosisOutcome, ...]:
    extent = Extent(
        kinds=(kind,),
        robots=robots,
        modes=(mode,),
        effects={mode: effects_shown(mode)},
        laws={mode: laws_shown(mode)},
        seeds=3,
        nothing=100,
        noise=25,
        pairs=40,
    )
    run = partial(run_case, simulate=simulate)
    outcomes, complete = run_all(questions(extent), run, 1, lambda step: None)
    assert complete
    for part in report(outcomes):
        print(part)
    assert [o.failure for o in outcomes if o.failure] == []
    return outcomes


def refuted(rate: Rate, least: float, most: float = 1.0) -> bool:
    """Whether the counts are too rare by chance where the share is within [least, most]."""
    low = binom.cdf(rate.hits, rate.cases, least) < RARE
    high = most < 1.0 and binom.sf(rate.hits - 1, rate.cases, most) < RARE
    return bool(low or high)


def failing(found: tuple[Claim, ...]) -> list[tuple[str, float]]:
    asked = [(c, c.least) for c in found if c.least is not None]
    assert asked
    return [(c.words, c.rate.share) for c, least in asked if refuted(c.rate, least, c.most)]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", [k for k in KINDS if k != "hidden"])
def test_claims_are_not_refuted(kind: Kind, mode: Mode) -> None:
    assert failing(claims(studied(kind, mode))) == []


@pytest.mark.parametrize("robot", ARMS)
@pytest.mark.parametrize("mode", MODES)
def test_a_hidden_effect_is_found(mode: Mode, robot: str) -> None:
    outcomes = studied("hidden", mode, (robot,))
    assert failing(claims(outcomes)) == []
    by_themselves = [(f, FOUND[f.strength]) for f in by_effect(outcomes)]
    assert {f.effect for f, _ in by_themselves} == set(effects_shown(mode))
    missed = [(f.effect, f.strength) for f, least in by_themselves if refuted(f.found, least)]
    assert missed == []
