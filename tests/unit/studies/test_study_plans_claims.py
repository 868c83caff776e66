"""What planning buys, on simulated arms: errors as predicted, half of the readings."""

import pytest

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from studies.plans import TEST, PlansStudy, plans_study
from studies.plans_command import arms, with_robot
from studies.plans_table import as_predicted, halved
from tests.support.study_plans_cases import configured


def studied(config: CellConfig, campaigns: int) -> PlansStudy:
    cell = cell_from_config(config)
    return plans_study(cell, config, arms(0), campaigns=campaigns, candidates=400)


def needs_at_most_half(study: PlansStudy, kind: str) -> bool:
    """As predicted, and not truly worse than random plans of twice the readings."""
    (s,) = (s for s in study.shrinkage() if s.kind == kind)
    assert s.twice.std < 0.1
    return halved(study, s) != "no"


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["ur10e", "ur5e"])
def test_errors_are_those_predicted_and_shrink_as_predicted(robot: str) -> None:
    """Within 10 %, with a registered tracker: what is predicted then is all that there is."""
    study = studied(with_robot(configured(known=True), robot), 150)
    for line in study.lines:
        r = line.result
        assert max(r.spread.std, r.position_ratio.std) < 0.05
        assert abs(r.spread.value - 1.0) <= 0.1, line.kind
        assert abs(r.position_ratio.value - 1.0) <= 0.1, line.kind
    for s in study.shrinkage():
        for ratio in (s.agreement, s.position_agreement):
            assert ratio.std < 0.06
            assert as_predicted(ratio) != "no", s.kind
    assert needs_at_most_half(study, TEST)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["ur10e", "ur5e"])
def test_half_of_the_readings_of_random_plans_do(robot: str) -> None:
    """50 campaigns each, registration unknown; each plan in the measure that it was made for."""
    study = studied(with_robot(configured(robust=True), robot), 50)
    for line in study.lines:
        assert as_predicted(line.result.spread) != "no", line.kind
        # The registration is better than a plan takes for granted: errors are hardly larger.
        assert line.result.position_ratio.value <= 1.1, line.kind
    assert all(as_predicted(s.agreement) != "no" for s in study.shrinkage())
    assert needs_at_most_half(study, TEST)
    needs = study.of("test, robust").random_readings_open
    assert needs is None or needs >= 2 * study.readings
