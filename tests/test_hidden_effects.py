"""How often a hidden effect is found, over many simulated campaigns; takes some minutes."""

import pytest
from campaigns import campaign

from drivers.simulated.hidden import DEFLECTION_EFFECTS
from hilcal.cell import Cell
from hilcal.data.readings import Readings
from hilcal.data.whitening import Mode
from hilcal.effects.catalogue import BUILT_IN
from hilcal.study.hidden import NOTHING, Case, Rate, hidden_study, rates

pytestmark = pytest.mark.slow

NAMES = tuple(e.name for e in BUILT_IN if e.name != "joint_compliance")
IN_DEFLECTIONS = tuple(n for n in NAMES if n in DEFLECTION_EFFECTS)
MODES: tuple[Mode, ...] = ("absolute", "deflection")


def rehearse(effect: str, mode: Mode, seed: int) -> tuple[Cell, Readings]:
    """150 readings of 30 poses, 3 σ of the hidden effect."""
    known = effect == "base_frame"  # a wrong registration shows only where one is believed
    hidden = "none" if effect == NOTHING else effect
    c = campaign(hidden, mode, seed, poses=30, registration_known=known)
    assert len(c.readings) == 150
    return c.cell, c.readings


def studied(effect: str, mode: Mode, seeds: range) -> tuple[list[Case], Rate]:
    cases = list(hidden_study(rehearse, [(effect, mode)], seeds))
    (rate,) = rates(cases)
    missed = [(c.seed, c.verdict, c.lead, c.same_as) for c in cases if not c.found]
    print(
        f"\n{effect} ({mode}): found {rate.found:.0%}, interval contains 1 {rate.covered:.0%}, "
        f"variance factor {rate.before:.1f} -> {rate.after:.2f}, missed {missed}"
    )
    return cases, rate


@pytest.mark.parametrize("mode", MODES)
def test_a_hidden_effect_is_found(mode):
    found: dict[str, float] = {}
    cases: list[Case] = []
    for effect in NAMES if mode == "absolute" else IN_DEFLECTIONS:
        mine, rate = studied(effect, mode, range(20))
        assert rate.seeds == 20
        found[effect] = rate.found
        cases += mine
    assert {effect: share for effect, share in found.items() if share < 0.95} == {}
    # A 95 % interval: 20 seeds of one effect say little of it, those of all effects do.
    covered = sum(c.covered for c in cases) / len(cases)
    print(f"\n{mode}: interval contains 1 in {covered:.1%} of {len(cases)}")
    assert covered >= 0.9


@pytest.mark.parametrize("mode", MODES)
def test_nothing_hidden_is_adequate(mode):
    cases, rate = studied(NOTHING, mode, range(200))
    assert len(cases) == 200
    assert rate.found >= 0.98
    assert rate.covered >= 0.9
