"""Gross errors in many readings: found from a robust start, or said to be too many."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.config import CellConfig, load_config
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.identification.fit_document import notes
from hilcal.identification.misdescription import examine
from hilcal.identification.registration import register
from hilcal.present.verdict import message
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import MODES, Mode
from hilcal.refinement import refine
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Floats
from studies.gross_errors import Spoilt, count, spoil
from tests.support.campaigns import campaign
from tests.support.reflector_cases import reflectors
from tests.support.rows import first


@pytest.fixture(scope="module")
def config() -> CellConfig:
    return load_config(configs_dir() / "cells" / "demo_ur10e.toml")


def fitted(readings: Readings, mode: Mode, **given: object) -> Fit:
    c = campaign(mode=mode, plan_seed=0, poses=12, **given)
    return fit(baseline(c.cell, readings, mode), readings, mode)


def shifted(readings: Readings, rows: slice, shift: Floats) -> Readings:
    value = readings.value.copy()
    value[rows, :3] += shift
    return replace(readings, value=value)


@pytest.mark.parametrize("m", first(1, [3, 6]))
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("share", "size"), [(0.2, 5e-3), (0.4, 5e-3), (0.4, 1e-3), (0.3, 5e-2)])
def test_all_of_many_gross_errors_are_found(share: float, size: float, mode: Mode, m: int) -> None:
    c = campaign(mode=mode, plan_seed=0, poses=12, m=m)
    readings, wrong = spoil(c.readings, share, size, np.random.default_rng(0))
    found = fit(baseline(c.cell, readings, mode), readings, mode)
    # The same as without them; deflections go with their unloaded reading.
    out = np.isin(np.arange(len(readings)), wrong)
    if mode == "deflection":
        r = c.readings
        out |= np.isin(r.pose, r.pose[out & r.unloaded])
        out |= ~np.isin(r.pose, r.pose[~out & ~r.unloaded])
    right = fit(baseline(c.cell, c.readings[~out], mode), c.readings[~out], mode)
    out[np.flatnonzero(~out)[right.outlier]] = True
    np.testing.assert_array_equal(found.outlier, out)
    if m == 3:  # the target's axes, which attitudes show, are those of the registration
        assert found.variance_factor == pytest.approx(right.variance_factor, rel=0.1)


@pytest.mark.parametrize(
    ("seed", "share"), first(1, [(13, 0.4), (22, 0.4), (24, 0.4), (33, 0.4), (5, 0.2)])
)
def test_refine_finds_them_beside_an_effect_and_in_few_poses(
    config: CellConfig, seed: int, share: float
) -> None:
    """24 to 180 readings, nothing or an unmodelled effect of 10 to 20 σ."""
    found = count(config, Spoilt(share, 5e-3, seed))
    assert found.found == found.wrong
    assert found.false <= 0.01 * found.readings
    assert found.outcome != "refused"


@pytest.mark.long
@pytest.mark.parametrize("mode", MODES)
def test_more_than_can_be_told_is_said(mode: Mode) -> None:
    c = campaign(mode=mode, plan_seed=0, poses=12)
    readings, _ = spoil(c.readings, 0.6, 5e-3, np.random.default_rng(0))
    found = refine(baseline(c.cell, readings, mode), readings, mode)
    assert found.verdict == "unknown_effect"
    assert "more than 45 % of the readings disagree" in message(found.diagnosis)
    assert not found.fit.outlier.any()


@pytest.mark.parametrize("of_tool", [False, True])
def test_a_block_off_alike_is_said_and_not_set_aside(of_tool: bool) -> None:
    """From one reading to another the shift is the same in the sensor's, or the target's axes."""
    c = campaign(plan_seed=0, poses=12)
    rows, shift = slice(12, 30), np.array([5e-3, 0.0, 0.0])
    if of_tool:
        model = baseline(c.cell, c.readings, "absolute")
        axes = model.predict(c.readings.states, np.zeros(model.size)).observation.rotation
        shift = axes[rows] @ shift
    readings = shifted(c.readings, rows, shift)
    found = fit(baseline(c.cell, readings, "absolute"), readings, "absolute")
    assert not found.outlier.any()
    assert found.disagreement is not None
    np.testing.assert_array_equal(found.disagreement.rows, np.arange(12, 30))
    assert any("are off by the same shift" in note for note in notes(found))


def test_a_block_is_not_taken_for_random_errors_among_such() -> None:
    c = campaign(plan_seed=0, poses=12)
    readings, wrong = spoil(c.readings, 0.1, 5e-3, np.random.default_rng(1))
    readings = shifted(readings, slice(20, 32), np.array([0.0, 0.0, -8e-3]))
    found = fit(baseline(c.cell, readings, "absolute"), readings, "absolute")
    outside = wrong[(wrong < 20) | (wrong >= 32)]
    assert found.outlier[outside].all()
    assert found.disagreement is not None
    assert found.outlier[20:32].sum() <= np.isin(np.arange(20, 32), wrong).sum()


def test_an_unloaded_reading_that_several_deflections_share() -> None:
    c = campaign(mode="deflection", plan_seed=0, poses=12)
    rows = np.flatnonzero(c.readings.unloaded)[::4]
    value = c.readings.value.copy()
    value[rows] += 5e-3 * np.random.default_rng(0).normal(size=(len(rows), 3))
    readings = replace(c.readings, value=value)
    found = fit(baseline(c.cell, readings, "deflection"), readings, "deflection")
    expected = np.isin(readings.pose, readings.pose[rows])
    np.testing.assert_array_equal(found.outlier, expected)


@pytest.mark.parametrize("mode", MODES)
def test_readings_of_several_targets(mode: Mode) -> None:
    c = reflectors(poses=10)
    readings, wrong = spoil(c.readings, 0.3, 5e-3, np.random.default_rng(0))
    found = fit(baseline(c.cell, readings, mode), readings, mode)
    assert found.outlier[wrong].all()


def test_a_registration_does_not_follow_errors_of_centimetres() -> None:
    c = campaign(plan_seed=0, poses=12)
    readings, wrong = spoil(c.readings, 0.4, 5e-2, np.random.default_rng(0))
    found = register(c.cell, readings)
    np.testing.assert_array_equal(np.flatnonzero(found.far), np.sort(wrong))
    assert found.rms < 1.1 * register(c.cell, c.readings).rms + 1e-4
    finding = examine(found, readings)
    assert finding is not None
    assert not finding.refused


@pytest.mark.long
def test_a_block_off_by_centimetres_is_refused() -> None:
    c = campaign(plan_seed=0, poses=12)
    readings = shifted(c.readings, slice(12, 30), np.array([0.05, 0.0, 0.0]))
    with pytest.raises(InputError, match=r"rows do not fit|Nothing that was tried"):
        baseline(c.cell, readings, "absolute")


def test_equal_readings_give_equal_fits() -> None:
    c = campaign(plan_seed=0, poses=12)
    readings, _ = spoil(c.readings, 0.3, 5e-3, np.random.default_rng(0))
    first, second = (fitted(readings, "absolute") for _ in range(2))
    np.testing.assert_array_equal(first.theta, second.theta)
