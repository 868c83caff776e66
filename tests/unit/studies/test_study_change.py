"""`studies change`: what it repairs, and what it counts."""

from dataclasses import replace

import numpy as np

from studies.change import ChangeCase
from studies.change_command import figures_of


def test_figures_count_what_was_found_missed_and_claimed():
    good = ChangeCase(
        "ur10e", "zero", 3, False, 1, 1e-3, strength=20.0, limit=5.0, parts="joint 3", z=(1.0,)
    )
    small = replace(good, repair="compliance", joint=6, strength=1.0, parts="", z=(), moved_m=6e-6)
    turned = replace(small, repair="zero", joint=1, anew=True, moved_m=1e-3)
    also = replace(good, others=("link 2",), z=(4.0,))
    quiet = ChangeCase("ur10e", "nothing", 0, True, 2)
    claimed = replace(quiet, parts="joint 2", of_arm=True, other=True)
    figures = {f.what: f for f in figures_of([good, small, turned, also, *[quiet] * 3, claimed])}
    of = {what: f.measured.split(" (")[0] for what, f in figures.items()}
    assert of["repaired joint named, and no other part"] == "1 of 4"
    visible = "the same, where the change is larger than the program states that it can show"
    assert of[visible] == "1 of 2"
    assert figures[visible].met is False
    assert of["not found: zero of joint 1, which a new place of the tracker absorbs"] == "1"
    small_words = "not found: smaller than these readings can show (rms at the target)"
    assert figures[small_words].measured == "compliance of joint 6 (6.00 µm)"
    assert of["not found: others"] == "1"
    assert of["without a change nothing is claimed"] == "3 of 4"
    assert np.isclose(float(of["error of the size over its std, rms"]), np.sqrt(8.5), atol=0.01)
