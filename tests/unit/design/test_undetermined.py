"""What the loads of a cell cannot determine is named, and everything else is planned."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.config.sections import CellLoad
from hilcal.design.information import DesignProblem, problem
from hilcal.design.nominal_model import nominal_model, planned_effects
from hilcal.design.planner import Request, make
from hilcal.design.summary import summarise
from hilcal.design.undetermined import UndeterminedParameter, without_undetermined
from hilcal.effects.catalogue import installed
from hilcal.errors import CannotAnswerError, InputError
from tests.support.plan_cases import config_of, poses_of

WEIGHT = CellLoad(name="5kg", mass_kg=5.0)
PULL = CellLoad(name="pull x", force_N=(80.0, 0.0, 0.0))
J1 = "joint_compliance.j1"


def cell_with(*loads: CellLoad, **planning: object) -> CellConfig:
    return config_of(**planning).model_copy(update={"loads": loads})


def problem_of(config: CellConfig, count: int = 12) -> DesignProblem:
    model = nominal_model(cell_from_config(config), config)
    return problem(model, config, poses_of(count))


def test_weights_make_no_torque_about_a_vertical_joint() -> None:
    whole = problem_of(cell_with(WEIGHT))
    reduced, lost = without_undetermined(whole)
    assert [u.name for u in lost] == [J1]
    assert "joint 1 needs a side pull" in lost[0].remark
    left = [t.name for t in reduced.terms]
    assert left == [t.name for t in whole.terms if t.name != J1]
    kept = [k for k, t in enumerate(whole.terms) if t.name != J1]
    np.testing.assert_array_equal(reduced.units.rows, whole.units.rows[:, :, kept])
    np.testing.assert_array_equal(reduced.prior, whole.prior[np.ix_(kept, kept)])


def test_with_a_side_pull_everything_is_determined() -> None:
    whole = problem_of(cell_with(WEIGHT, PULL))
    reduced, lost = without_undetermined(whole)
    assert lost == ()
    assert reduced is whole


def test_confounded_parameters_are_named_together() -> None:
    """Two columns that are multiples of each other: one of them is left out, both are named."""
    whole = problem_of(cell_with(WEIGHT, PULL))
    a, b = (whole.of_effect("joint_compliance")[k] for k in (1, 2))
    rows = whole.units.rows.copy()
    rows[:, :, a] = 2.0 * rows[:, :, b]
    same = replace(whole, units=type(whole.units)(rows, whole.units.cost))
    _, (lost,) = without_undetermined(same)
    assert {lost.name, *lost.confounded} == {"joint_compliance.j2", "joint_compliance.j3"}
    assert "separates it from" in lost.remark


def test_a_cell_that_determines_nothing_is_refused() -> None:
    config = cell_with(WEIGHT, model=("joint_compliance(joints=1)",))
    with pytest.raises(CannotAnswerError, match="side pull"):
        without_undetermined(problem_of(config))


def test_other_parameters_have_plain_words() -> None:
    assert "changes with it" in UndeterminedParameter("tracker_scale.s", "1", 0.0).remark
    slide = UndeterminedParameter("joint_compliance.j1", "m/N", 0.0, (), "joint 1").remark
    assert "joint 1 needs a pull along it" in slide


def test_the_plan_goes_on_without_and_states_it() -> None:
    config = cell_with(WEIGHT, candidates=40, against=())
    cell, rng = cell_from_config(config), np.random.default_rng(1)
    planned = make(cell, config, Request(5), rng)
    s = summarise(planned, config, rng, compare=False)
    std = {p.name: p.std for p in s.parameters}
    assert std[J1] == np.inf
    assert all(np.isfinite(std[f"joint_compliance.j{k}"]) for k in range(2, 7))
    assert next(name for name in std if name.startswith("joint")) == J1  # in the model's order
    assert s.remarks[0].startswith(f"{J1}: not determined")
    assert s.position_std_m is not None
    assert s.position_std_m > 0


# options in [planning] model


def test_options_are_those_of_identify() -> None:
    config = cell_with(WEIGHT, model=("joint_compliance(joints=2/3/4-6)", "creep"))
    wanted = planned_effects(config, installed())
    assert wanted == {"joint_compliance": {"joints": "2/3/4-6"}, "creep": {}}
    model = nominal_model(cell_from_config(config), config).model
    named = [p.name for e in model.effects if e.name == "joint_compliance" for p in e.parameters]
    assert named == ["j2", "j3", "j4-6"]


@pytest.mark.parametrize(
    ("model", "why"),
    [
        (("joint_compliance(joints=2",), r"\[planning\] model: .*missing at the end"),
        (("joint_compliance(joints=9)",), "there is no joint 9"),
        (("ghost(joints=2)",), r"\[planning\] model: unknown effect 'ghost'"),
        (("creep", "creep"), r"\[planning\] model: .*there twice"),
    ],
)
def test_options_that_cannot_be(model: tuple[str, ...], why: str) -> None:
    config = cell_with(WEIGHT, model=model)
    with pytest.raises(InputError, match=why):
        nominal_model(cell_from_config(config), config)
