"""A plan for several targets: what it predicts is what identification then states."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.config.cell import Target
from hilcal.design.information import problem
from hilcal.design.nominal_model import nominal_model
from hilcal.design.predicted import predicted
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.measuring.clearance import LineOfSight, clearance_of
from hilcal.measuring.route import seconds_at_rest
from hilcal.readings.whitening import MODES, Mode
from tests.support.plan_cases import config_of, everything_once, poses_in
from tests.support.reflector_cases import NAMES, OFFSETS, reflectors


@pytest.mark.parametrize("mode", MODES)
def test_prediction_is_what_identification_states(mode: Mode) -> None:
    config = config_of(mode)
    scatter = config.repeatability.model_copy(update={"joint_std_rad": 5e-5})
    config = config.model_copy(update={"repeatability": scatter})
    c = reflectors(poses=14, joint_std=5e-5, known=(True, False, True), registration_known=True)
    found = fit(baseline(c.cell, c.readings, mode), c.readings, mode)
    p = problem(nominal_model(c.cell, config), config, poses_in(c.readings))
    foreseen = predicted(p, everything_once(p)).by_name()
    names = [t.name for t in p.terms if not t.potential]
    stated = dict(zip(names, found.uncertainty.formal, strict=True))
    if mode == "absolute":  # in deflections a prior of another size holds the offset
        assert foreseen["target_offset.R2.x"] == pytest.approx(
            stated["target_offset.R2.x"], rel=0.05
        )
    for j in range(1, 7):
        name = f"joint_compliance.j{j}"
        assert foreseen[name] == pytest.approx(stated[name], rel=0.05), name


def test_sight_and_time_of_each_target() -> None:
    config = config_of()
    tool = config.tool.model_copy(
        update={
            "target_m": None,
            "targets": tuple(
                Target(name=n, target_m=tuple(at))
                for n, at in zip(NAMES, OFFSETS.tolist(), strict=True)
            ),
        }
    )
    several = config.model_copy(update={"tool": tool})
    assert seconds_at_rest(several) > 2 * seconds_at_rest(config)
    c = reflectors(poses=6)
    cell = replace(c.cell, registration_known=True)
    q = poses_in(c.readings)
    view = LineOfSight(clearance_of(cell, several), np.array([3.0, 0.5, 0.4]))
    seen = np.array([view.sees(q, "none", k) for k in range(3)])
    np.testing.assert_array_equal(view.free(q, "none"), seen.all(axis=0))
    for k in range(len(q)):
        hidden = view.hidden(q[k : k + 1], "none")
        assert hidden == tuple(np.flatnonzero(~seen[:, k]))
        told = [key for key in view.problems(q[k : k + 1], "none", "here") if key[0] == "sight"]
        assert bool(told) == (len(hidden) == 3)
