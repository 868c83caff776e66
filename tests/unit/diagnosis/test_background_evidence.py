"""Which effects of a background are proved, where others are sure to be there."""

from hilcal.config import load_config
from hilcal.diagnosis.background_evidence import background_evidence, p_value_of_others, proved
from hilcal.identification.background import with_background
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.readings.whitening import Mode
from hilcal.refinement import refine
from studies.study_cases import StudyCase, study_case
from tests.support.cli_cases import CELL


def case_of(mode: Mode, hidden: tuple[str, ...], strength: float) -> StudyCase:
    return study_case(load_config(CELL), "ur10e", mode, hidden, strength, 0)


def test_gears_that_all_give_in_one_direction_are_no_scale_of_the_tracker() -> None:
    # Their zero mean leaves what a scale of some per cent would explain; ordinary ones have 1e-5.
    case = case_of("deflection", ("joint_stiffening",), 1.0)
    first = fit(baseline(case.cell, case.readings, "deflection"), case.readings, "deflection")
    found = with_background(first, first.model.names)
    assert found is not None
    tested = {b.effect: b for b in background_evidence(found)}
    assert tested["tracker_scale"].p_value < 0.001
    assert proved(tuple(tested.values())) == ("joint_stiffening",)


def test_a_model_with_pooled_lines_is_refined_further() -> None:
    case = case_of("absolute", ("transmission_error",), 3.0)
    found = refine(baseline(case.cell, case.readings, "absolute"), case.readings, "absolute")
    assert "transmission_error" in found.fit.model.random
    assert p_value_of_others(found.fit) > 0.01  # nothing else is there
    again = refine(found.fit.model, case.readings, "absolute")
    assert again.verdict == found.verdict == "adequate"
