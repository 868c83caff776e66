"""When a background is taken, on simulated arms: many effects at once, an unknown law, noise."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.calibration.scatter import budget
from hilcal.config import load_config
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.background import with_pooled_lines
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.refinement import BACKGROUND, refine
from studies.diagnosis import Asked
from studies.diagnosis_command import simulate
from studies.random_campaigns import rehearsal_states
from studies.study_cases import study_case, with_study_loads
from tests.support.cli_cases import CELL

HIDDEN = (
    "link_geometry", "transmission_error", "encoder_offset", "joint_tilt_compliance",
    "joint_coupling", "hysteresis", "tool_compliance",
)  # fmt: skip


@pytest.mark.long
def test_an_arm_that_errs_in_many_ways_is_predicted_from_few_poses() -> None:
    config = load_config(CELL)
    case = study_case(config, "ur10e", "absolute", HIDDEN, 20.0, 1, n_poses=25)
    some = case.readings[case.readings.load == 0]
    assert len(some) == 25
    found = refine(baseline(case.cell, some, "absolute"), some, "absolute")
    added = [step.added for step in found.steps]
    alone = found.steps[added.index(BACKGROUND) - 1]
    _, loads = with_study_loads(config, "ur10e")
    fresh, *_ = rehearsal_states(case.cell, 20, loads, np.random.default_rng(2))
    true = case.world.sight(fresh).position
    error = np.linalg.norm(found.fit.predict(fresh).position - true, axis=1).mean()
    before = np.linalg.norm(alone.fit.predict(fresh).position - true, axis=1).mean()
    assert error < 0.6 * before
    stated = budget(found.fit)  # fitted poses are far nearer than any other is
    assert stated.combined >= found.fit.holdout.rms_m > 3 * found.fit.error.rms_m
    unloaded = replace(fresh, wrench=np.zeros_like(fresh.wrench))  # as what was fitted
    off = found.fit.predict(unloaded).position - case.world.sight(unloaded).position
    assert np.mean(np.linalg.norm(off, axis=1) <= stated.expanded) >= 0.9
    assert found.verdict in ("missing_effect", "ambiguous")
    assert set(found.fit.model.named) - {"base_frame"} <= set(HIDDEN)


@pytest.mark.long
def test_effects_of_implausible_size_do_not_stand_in_for_an_unknown_law() -> None:
    law = "compliance by another joint"  # link lengths of 14 mm would predict it
    asked = Asked("outside", "ur3e", "deflection", (law,), 3.0, 0)
    case = simulate(asked)
    found = refine(baseline(case.cell, case.readings, asked.mode), case.readings, asked.mode)
    assert found.verdict == "unknown_effect"
    assert not found.fit.model.background


@pytest.mark.long
def test_noise_that_is_stated_too_small_is_no_background() -> None:
    asked = Asked("noise", "ur3e", "absolute", (), 0.0, 0, 0.5, cycles=2)
    case = simulate(asked)
    found = refine(baseline(case.cell, case.readings, asked.mode), case.readings, asked.mode)
    assert found.verdict == "noise_misjudged"
    assert not found.fit.model.background


def test_waves_of_gears_in_pools_predict_better_than_line_by_line() -> None:
    config, ratios = load_config(CELL), []
    for seed in (1, 2, 3):
        case = study_case(
            config, "ur10e", "absolute", ("transmission_error",), 3.0, seed, n_poses=30
        )
        some = case.readings
        start = baseline(case.cell, some, "absolute")
        found = refine(start, some, "absolute")
        by_lines = replace(found.fit.model, random={})
        lines = fit(by_lines, some, "absolute", start=found.fit.theta)
        assert "transmission_error" in found.fit.model.random
        assert not found.fit.model.background
        fresh, *_ = rehearsal_states(case.cell, 40, [], np.random.default_rng(seed))
        true = case.world.sight(fresh).position
        errors = [
            np.linalg.norm(x.predict(fresh).position - true, axis=1).mean()
            for x in (found.fit, lines)
        ]
        ratios.append(errors[0] / errors[1])
        assert found.verdict == "adequate"
        # what a diagnosis of the stored revision would say
        assert diagnose(found.fit, found.diagnosis.history).verdict == found.verdict
    assert np.exp(np.mean(np.log(ratios))) < 0.9


def test_without_shrunk_effects_there_are_no_lines() -> None:
    case = study_case(load_config(CELL), "ur10e", "absolute", (), 0.0, 1, n_poses=12)
    plain = fit(baseline(case.cell, case.readings, "absolute"), case.readings, "absolute")
    assert with_pooled_lines(plain) is None
