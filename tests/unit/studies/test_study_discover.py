"""The study of `discover`: its laws displace the target, and its claims count what they say."""

from dataclasses import replace

import numpy as np

from studies.discover import DiscoveryCase, DiscoveryOutcome
from studies.discover_command import claims
from studies.foreign_laws import KINDS
from studies.law_scene import scene
from tests.unit.studies.test_study_cases import case

GOOD = DiscoveryCase("ur5e", "absolute", law="wear")


def test_every_law_displaces_the_target_as_it_is_drawn():
    c = case("creep", mode="absolute", poses=8)
    s = scene(c.world, c.readings.states)
    assert len(KINDS) >= 10
    for _, draw in KINDS.values():
        law, same = (draw(np.random.default_rng(3)) for _ in range(2))
        moved = law.displaced(s)
        assert moved.shape == s.seen.shape
        assert np.ptp(moved) > 0
        assert np.array_equal(moved, same.displaced(s))
        assert law.words == same.words
        assert law.sites
        assert law.variables


def test_claims_count_what_they_say():
    right = DiscoveryOutcome(GOOD, "law", "dq_2 = a", "wear", True, True, 0.99, 2.0, 1.1)
    wrong = DiscoveryOutcome(GOOD, "law", "dq_3 = a", "wear", False, True, 0.9, 2.0, 1.6)
    silent = DiscoveryOutcome(DiscoveryCase("ur5e", "absolute"), "adequate")
    alarm = DiscoveryOutcome(DiscoveryCase("ur5e", "absolute", stated=0.5), "law", "dq_1 = a")
    found = {f.what: f for f in claims([right, wrong, silent, alarm])}
    assert found["site right"].measured == "50 % (1 of 2)"
    assert found["error at fresh poses at most 1.15 times the noise"].met is False
    assert found["excess of the error at fresh poses halved"].measured == "50 % (1 of 2)"
    assert found["variables right"].met is True
    assert found["no law where nothing is hidden"].met is True
    assert found["no law where the noise is misjudged by two"].met is False
    assert "no law where an effect of the catalogue is hidden" not in found  # none was
    plain = replace(GOOD, strength=10.0, poses=100)
    nine = [DiscoveryOutcome(plain, "law", "dq_2 = a", "wear", True, True, 0.99, 2.0, 1.1)] * 9
    wrong = DiscoveryOutcome(plain, "law", "dq_3 = a", "wear", False, True, 0.99, 2.0, 1.1)
    found = {f.what: f for f in claims([*nine, wrong])}
    assert found["site right"].met is False  # nine of ten are enough elsewhere
    assert found["variables right"].required == "95 %"
