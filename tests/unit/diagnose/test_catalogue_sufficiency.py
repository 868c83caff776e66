"""Looking ahead: does the catalogue explain the misfit, or does its best only resemble it?"""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.config import load_config
from hilcal.data.whitening import Mode
from hilcal.diagnose.catalogue_sufficiency import look_ahead, rest
from hilcal.diagnose.diagnosis_document import to_json
from hilcal.diagnose.effect_ranking import candidates, family
from hilcal.diagnose.projection import projection
from hilcal.diagnose.verdict import Diagnosis, diagnose
from hilcal.identify.baseline import baseline
from hilcal.identify.fit import Fit, fit
from hilcal.robot.catalogue import configs_dir
from studies.study_cases import study_case

CELL = configs_dir() / "cells" / "demo_ur10e.toml"


def fitted(
    mode: Mode, *hidden: str, seed: int = 1, strength: float = 3.0, stated: float = 1.0, cycles=1
) -> Fit:
    c = study_case(
        load_config(CELL), "ur5e", mode, hidden, strength, seed, stated=stated, cycles=cycles
    )
    return fit(baseline(c.cell, c.readings, mode), c.readings, mode)


@pytest.mark.parametrize(
    ("mode", "law", "variable"),
    [
        ("deflection", "relaxing bench", "time under load"),
        ("absolute", "swaying bench", "air temperature"),
        ("absolute", "coupled joint", "joint 2 torque"),
    ],
)
def test_what_only_resembles_an_effect_is_unknown(mode: Mode, law: str, variable: str) -> None:
    led = 0
    for seed in range(2):
        first = diagnose(fitted(mode, law, seed=seed))
        d = look_ahead(first)
        led += bool(first.significant)
        assert d.verdict == "unknown_effect", (seed, d.message)
        assert variable in [c.variable for c in d.carriers[:2]]
        if first.significant:
            assert d.suspects is first.suspects
            assert d.significant == first.significant
            check_beyond(d)
    assert led > 0


def check_beyond(d: Diagnosis) -> None:
    assert d.beyond is not None
    assert d.significant[0] in d.message
    assert 0.02 < d.beyond.share < 1.0
    assert d.beyond.variance_factor > 1.0
    assert 0 <= d.beyond.refitted <= len(d.beyond.effects)
    assert to_json(d)["beyond"] == {
        "effects": list(d.beyond.effects),
        "refitted": d.beyond.refitted,
        "share": d.beyond.share,
        "variance_factor": d.beyond.variance_factor,
    }


@pytest.mark.parametrize(
    ("mode", "effects"),
    [
        ("deflection", ("link_compliance",)),
        ("deflection", ("creep", "load_point")),  # turns a lever: far from linear
        ("deflection", ("sensor_misalignment", "joint_tilt_compliance")),
        ("absolute", ("link_geometry",)),
        ("absolute", ("encoder_offset", "load_point")),
        ("absolute", ("hysteresis", "link_mass")),
    ],
)
def test_effects_of_the_catalogue_explain_all(mode: Mode, effects: tuple[str, ...]) -> None:
    d = diagnose(fitted(mode, *effects))
    assert d.significant
    assert look_ahead(d) is d


def test_noise_that_repeats_show_is_not_an_unknown_effect() -> None:
    d = diagnose(fitted("deflection", "hysteresis", stated=0.5, cycles=2))
    assert d.significant[0] == "hysteresis"
    assert not rest(d.fit).is_noise
    assert look_ahead(d) is d


def test_nothing_is_looked_for_where_nothing_leads() -> None:
    d = diagnose(fitted("deflection"))
    assert d.verdict == "adequate"
    assert look_ahead(d) is d


def test_a_fit_that_is_not_quite_at_rest_credits_no_effect_with_its_own_step() -> None:
    at_rest = fitted("absolute")
    s = at_rest.solution
    step = np.random.default_rng(0).standard_normal(s.rows.shape[1])
    theta = s.theta - s.equations.basis.transform @ step
    off = replace(at_rest, solution=replace(s, theta=theta, white=s.white + s.rows @ step))
    one, other = projection(at_rest), projection(off)
    np.testing.assert_allclose(other.white, one.white, atol=1e-9)
    for effect in candidates(at_rest):
        x = family(at_rest, effect).white
        assert other.score(x).log_evidence == pytest.approx(one.score(x).log_evidence, abs=1e-6)
