"""All effects at once, fitted to simulated campaigns."""

import numpy as np
import pytest

from hilcal.config import load_config
from hilcal.data.whitening import Mode
from hilcal.errors import InputError
from hilcal.identify.baseline import baseline
from hilcal.identify.fit import fit
from hilcal.identify.mixed_fit import mixed_fit
from hilcal.identify.residual import residual
from hilcal.mixed.evidence import evidence
from hilcal.robot.catalogue import configs_dir
from studies.study_cases import study_case
from tests.support.cli_cases import CELL

CONFIG = load_config(configs_dir() / "cells" / CELL)


def test_a_hidden_effect_is_predicted_and_has_the_evidence() -> None:
    mode: Mode = "absolute"
    case = study_case(CONFIG, "ur10e", mode, ("joint_tilt_compliance",), 3.0, 1, n_poses=10)
    start = baseline(case.cell, case.readings, mode)
    found = mixed_fit(start, case.readings, mode, np.random.default_rng(0))
    prediction = found.model.predict(case.readings.states, found.theta)
    white = found.w.whiten(residual(case.readings, prediction, found.w))
    without = fit(start, case.readings, mode)
    assert np.mean(white**2) < 1.3 < np.mean(without.white**2)
    k = found.problem.families.names.index("joint_tilt_compliance")
    assert (
        evidence(found.problem, k, np.random.default_rng(0), found.variances.log_size).p_value
        < 0.01
    )
    fresh = study_case(CONFIG, "ur10e", mode, ("joint_tilt_compliance",), 3.0, 1, n_poses=10)
    position, spread = found.predict(fresh.readings.states, 3)
    assert position.shape == (len(fresh.readings), 3)
    assert np.all(np.linalg.eigvalsh(spread) > -1e-12)


def test_deflections_are_refused_in_words() -> None:
    case = study_case(CONFIG, "ur10e", "deflection", (), 3.0, 1, n_poses=10)
    start = baseline(case.cell, case.readings, "deflection")
    with pytest.raises(InputError, match="absolute readings only"):
        mixed_fit(start, case.readings, "deflection", np.random.default_rng(0))
