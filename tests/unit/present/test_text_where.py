"""The table of variables, curves, and the sentence on an unknown effect, as people read them."""

from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.misfit_breakdown import ROW_ORDER, MisfitShare, misfit_breakdown
from hilcal.diagnosis.residual_regression import Dependence
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import linearise
from hilcal.present.diagnosis import curves, diagnosis_report
from hilcal.present.fit import where_table
from hilcal.present.verdict import message
from tests.support.campaigns import campaign, cell_of, noiseless, plan, with_noise, world_of


def shown(parts: object) -> str:
    console = Console(width=80, record=True)
    with console.capture() as captured:
        for part in parts:  # type: ignore[attr-defined]
            console.print(part)
    return captured.get()


PLACES = (
    MisfitShare("direction vertical", 0.7, 1e-30),
    MisfitShare("pose", 0.95, 1e-9),
    MisfitShare("time", 0.2, 1e-4),
    MisfitShare("joint 4 angle", 0.4, 1e-12),
    MisfitShare("load", 0.02, 1e-3),
    MisfitShare("joint 1 angle", 0.0, 1e-20),
    MisfitShare("air temperature", 0.004, 0.3),
)


def test_variables_stand_in_groups_and_those_without_a_share_are_counted() -> None:
    told = shown(where_table(PLACES))
    order = ["joint 4 angle", "load", "time", "same in all readings of a pose", "points vertical"]
    places = [told.index(name) for name in order]
    assert places == sorted(places)
    assert "joint 1 angle" not in told
    assert "0 %" not in told.replace("20 %", "").replace("40 %", "").replace("70 %", "")
    assert "2 more are below 1 %" in " ".join(told.split())


def dependence(error: float, share: float = 0.3) -> Dependence:
    x, y = np.arange(5.0), 1e-5 * np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    return Dependence("time", "s", share, "joint 2", np.zeros(3), x, y, np.full(5, error), "rad")


def test_a_curve_is_shown_only_where_it_is_determined_and_carries_something() -> None:
    assert "joint 2 errs by" in shown(curves([dependence(2e-6)]))
    told = shown(curves([dependence(5e-2)]))
    assert "do not determine its curve" in told
    assert "±" not in told
    assert shown(curves([dependence(2e-6, share=0.004)])) == ""


def drifting(strength: float) -> Diagnosis:
    """Judge a drift of the tracker where nothing states the time."""
    cell, p = cell_of(registration_known=True), plan(16, 3)
    rng = np.random.default_rng(4)
    readings = with_noise(noiseless(world_of(cell, rng), p), rng)
    along = np.linspace(-1, 1, len(readings))
    value = readings.value + strength * along[:, None] * np.array([0.0, 0.0, 1.0])
    states = replace(readings.states, time=None, load_time=None)
    found = fit(
        baseline(cell, replace(readings, value=value, states=states), "absolute"),
        replace(readings, value=value, states=states),
        "absolute",
    )
    return diagnose(found)


def test_row_order_stands_for_the_time_where_there_is_none() -> None:
    d = drifting(1e-4)
    by_name = {v.variable: v for v in d.misfit_breakdown}
    assert "time" not in by_name
    assert by_name[ROW_ORDER].p_value < 1e-6
    assert by_name[ROW_ORDER].share > 0.5
    assert by_name[ROW_ORDER].group == "time and air"
    c = campaign(plan_seed=0)
    timed = fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute")
    assert ROW_ORDER not in {v.variable for v in misfit_breakdown(linearise(timed))}


@pytest.mark.parametrize("strength", [2e-5, 4e-5, 1e-4])
def test_an_unknown_effect_never_stands_beside_nothing_predicted(strength: float) -> None:
    d = drifting(strength)
    if d.verdict == "unknown_effect":
        assert d.predictable_share >= 0.01
        assert " 0 % of the misfit" not in message(d)


def test_what_the_pose_alone_predicts_is_said_so() -> None:
    """Each pose is off by its own random amount; its repeats are off by the same."""
    cell, p = cell_of(registration_known=True), plan(16, 3, 2)
    rng = np.random.default_rng(4)
    readings = with_noise(noiseless(world_of(cell, rng), p), rng)
    # Each load of a pose by itself, so that only repeats have the error in common.
    kind = readings.pose * 10 + readings.load
    off = 1e-4 * rng.standard_normal((int(kind.max()) + 1, 3))[kind]
    moved = replace(readings, value=readings.value + off)
    d = diagnose(fit(baseline(cell, moved, "absolute"), moved, "absolute"))
    assert d.verdict == "unknown_effect"
    assert d.repeated_share > 0.9
    same = f"{100 * d.repeated_share:.0f} % of the misfit is the same"
    assert f"{same} in them" in message(d)
    # Had nothing recorded been significant:
    alone = replace(d, predictable_share=0.0, follows=())
    assert f"{same} when a pose is repeated: the pose itself predicts it" in message(alone)
    assert "predicts 0 %" not in shown(diagnosis_report(alone))
