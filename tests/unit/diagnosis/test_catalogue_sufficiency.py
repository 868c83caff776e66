"""Does the whole catalogue explain the misfit, or does its best effect only resemble the cause?"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from hilcal.config import load_config
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.document import to_json
from hilcal.diagnosis.effect_ranking import candidates
from hilcal.diagnosis.evidence import insufficiency, whole_catalogue
from hilcal.diagnosis.noise import MISFIT_ALARM
from hilcal.diagnosis.stepwise import add
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.baseline import baseline
from hilcal.identification.effect_columns import effect_columns
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import linearise
from hilcal.present.verdict import message
from hilcal.readings.whitening import Mode
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


@pytest.mark.parametrize("seeds", [(0,), pytest.param((1, 2, 3), marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("mode", "law", "variable"),
    [
        pytest.param("deflection", "relaxing bench", "time under load", marks=pytest.mark.long),
        ("absolute", "swaying bench", "air temperature"),
        ("absolute", "coupled joint", "joint 2 torque"),
    ],
)
def test_a_law_that_only_resembles_an_effect_is_unknown(
    mode: Mode, law: str, variable: str, seeds: tuple[int, ...]
) -> None:
    led = 0
    for seed in seeds:
        d = diagnose(fitted(mode, law, seed=seed))
        assert d.verdict == "unknown_effect", (seed, message(d))
        assert variable in [c.variable for c in d.dependences[:2]]
        led += d.lead is not None
        if d.lead is not None:
            check_insufficiency(d)
    assert led > 0


def check_insufficiency(d: Diagnosis) -> None:
    i = d.insufficiency
    assert d.reason == "insufficient_catalogue"
    assert i is not None
    assert d.suspects[0].effect in message(d)
    assert 0.02 < i.share < 1.0
    assert i.variance_factor > 1.0
    assert 0 <= i.refitted <= len(i.effects)
    assert d.separability == ()
    assert to_json(d)["beyond"] == {
        "effects": list(i.effects),
        "refitted": i.refitted,
        "share": i.share,
        "variance_factor": i.variance_factor,
    }


@pytest.mark.parametrize(
    ("mode", "effects"),
    [
        ("deflection", ("creep", "load_point")),  # turns a lever: far from linear
        ("absolute", ("link_geometry",)),
        ("absolute", ("encoder_offset", "load_point")),
        pytest.param("deflection", ("link_compliance",), marks=pytest.mark.slow),
        pytest.param(
            *("deflection", ("sensor_misalignment", "joint_tilt_compliance")),
            marks=pytest.mark.slow,
        ),
        pytest.param("absolute", ("hysteresis", "link_mass"), marks=pytest.mark.slow),
    ],
)
def test_effects_of_the_catalogue_explain_all(mode: Mode, effects: tuple[str, ...]) -> None:
    d = diagnose(fitted(mode, *effects))
    assert d.lead is not None
    assert d.verdict in ("missing_effect", "ambiguous")
    assert d.insufficiency is None


@pytest.mark.long
def test_noise_that_repeats_show_is_not_an_unknown_effect() -> None:
    found = fitted("deflection", "hysteresis", stated=0.5, cycles=2)
    d = diagnose(found)
    assert d.suspects[0].effect == "hysteresis"
    _, square, dof = whole_catalogue(found)
    assert chi2.sf(square, dof) < MISFIT_ALARM
    assert d.verdict in ("missing_effect", "ambiguous")


def test_no_refit_is_made_where_algebra_leaves_noise_and_at_most_two_elsewhere() -> None:
    made: list[str] = []

    def counted(before: Fit, effect: str) -> Fit:
        made.append(effect)
        return add(before, effect)

    explained = fitted("deflection", "link_compliance")
    _, square, dof = whole_catalogue(explained)
    assert chi2.sf(square, dof) >= MISFIT_ALARM
    assert insufficiency(explained, counted) is None
    assert made == []
    unknown = insufficiency(fitted("absolute", "swaying bench"), counted)
    assert unknown is not None
    assert unknown.effects[: unknown.refitted] == tuple(made)
    assert 1 <= len(made) <= 2


def test_a_fit_that_is_not_quite_at_rest_credits_no_effect_with_its_own_step() -> None:
    at_rest = fitted("absolute")
    s = at_rest.solution
    step = np.random.default_rng(0).standard_normal(s.rows.shape[1])
    theta = s.theta - s.equations.basis.transform @ step
    off = replace(at_rest, solution=replace(s, theta=theta, white=s.white + s.rows @ step))
    one, other = linearise(at_rest), linearise(off)
    np.testing.assert_allclose(other.residual, one.residual, atol=1e-9)
    for effect in candidates(at_rest):
        x = effect_columns(at_rest, effect).white
        assert other.score(x).log_evidence == pytest.approx(one.score(x).log_evidence, abs=1e-6)
