"""All effects at once, fitted to simulated campaigns."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.config import load_config
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.mixed_fit import mixed_fit
from hilcal.mixed.variances import evidence
from studies.random_campaigns import rehearsal_states
from studies.study_cases import study_case, with_study_loads
from tests.support.cli_cases import CELL

CONFIG = load_config(CELL)
HIDDEN = "joint_tilt_compliance"


def test_a_hidden_effect_is_predicted_at_fresh_poses_and_has_the_evidence() -> None:
    case = study_case(CONFIG, "ur10e", "absolute", (HIDDEN,), 3.0, 1, n_poses=10)
    start = baseline(case.cell, case.readings, "absolute")
    found = mixed_fit(start, case.readings, "absolute")
    without = fit(start, case.readings, "absolute")
    _, loads = with_study_loads(CONFIG, "ur10e")
    fresh, *_ = rehearsal_states(case.cell, 20, loads, np.random.default_rng(2))
    true = case.world.sight(fresh).position
    position, spread = found.predict(fresh, 3)
    error = np.linalg.norm(true - position, axis=1).mean()
    assert error < 0.5 * np.linalg.norm(true - without.predict(fresh).position, axis=1).mean()
    std = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    assert 0.85 < np.mean(np.abs(true - position) < 1.96 * std) <= 1.0
    k = found.problem.families.names.index(HIDDEN)
    rng, log_std = np.random.default_rng(0), found.variances.log_std
    assert evidence(found.problem, k, rng, log_std).p_value < 0.01


def test_a_cell_says_how_large_an_effect_is_expected_to_be() -> None:
    """It moves where a size begins, and what the readings do not tell stays there."""
    sizes = {}
    for factor in (1.0, 0.1):
        config = CONFIG.model_copy(update={"ordinary": {"tracker_scale": factor}})
        case = study_case(config, "ur10e", "absolute", (HIDDEN,), 3.0, 1, n_poses=8)
        cell = replace(case.cell, config=config)
        found = mixed_fit(baseline(cell, case.readings, "absolute"), case.readings, "absolute")
        (f,) = (f for f in found.problem.families.random if f.effect == "tracker_scale")
        assert f.prior.mean == pytest.approx(np.log(0.5 * factor), abs=0.01)
        sizes[factor] = found.std("tracker_scale")
    assert sizes[0.1] < 0.3 * sizes[1.0]


def test_a_hidden_effect_of_deflections_has_the_evidence() -> None:
    case = study_case(CONFIG, "ur10e", "deflection", (HIDDEN,), 3.0, 1, n_poses=10)
    start = baseline(case.cell, case.readings, "deflection")
    found = mixed_fit(start, case.readings, "deflection")
    names, log_std = found.problem.families.names, found.variances.log_std
    p = {
        name: evidence(found.problem, k, np.random.default_rng(0), log_std).p_value
        for k, name in enumerate(names)
        if name in (HIDDEN, "base_compliance", "link_compliance", "backlash", "creep")
    }
    assert p.pop(HIDDEN) < 0.001
    assert min(p.values()) > 0.01
    # the registration is known by its prior, and nothing else is of its size
    assert found.std("base_frame") == pytest.approx(1.0, abs=0.01)
