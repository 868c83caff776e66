"""The arm's scatter is never taken for zero: repeats show it, else the maker states it."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.scatter import budget
from hilcal.config import Repeatability
from hilcal.diagnosis.noise import RP_PER_RMS
from hilcal.identification.noise.arm_scatter import with_arm_scatter
from hilcal.identification.noise.full_covariance import joint_factors
from hilcal.identification.residual import noise_floor
from hilcal.readings.readings import ArmScatter, Readings
from tests.support.campaigns import campaign
from tests.support.fit_cases import fitted_model
from tests.support.observer_cases import base_cell, observed, stated

TRUE = 1e-5
"""rad; what the simulated arm scatters by."""


def instrument(c):
    """Readings with the covariance of the instrument alone."""
    true = replace(c.cell, registration=c.world.registration)
    f = joint_factors(true, c.readings, np.full(6, TRUE))
    alone = c.readings.covariance - f @ np.swapaxes(f, 1, 2)
    return replace(c.readings, covariance=alone, scatter_stated=False)


def fitted(c, mode, readings, rp=5e-5):
    """Fit a cell that says nothing of its repeatability."""
    config = c.cell.configured().model_copy(update={"repeatability": Repeatability()})
    cell = replace(c.cell, config=config, arm=replace(c.cell.arm, repeatability=rp))
    return fitted_model(cell, readings, mode)


def once(readings):
    """The first reading of each state."""
    _, first = np.unique(np.stack([readings.pose, readings.load]), axis=1, return_index=True)
    return readings[np.sort(first)]


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
def test_repeats_show_the_scatter(mode):
    c = campaign(poses=16, cycles=3)
    calibration = Calibration.of(fitted(c, mode, instrument(c)))
    assert calibration.scatter.source == "repeats"
    np.testing.assert_allclose(calibration.scatter.joint_std, TRUE, rtol=0.25)


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
@pytest.mark.parametrize(("rp", "source"), [(5e-5, "maker"), (None, "industry")])
def test_without_repeats_it_is_the_makers(mode, rp, source):
    c = campaign(poses=16)
    result = fitted(c, mode, once(instrument(c)), rp)
    b = budget(result)
    assert b.scatter_source == source
    arrivals = 2 if mode == "deflection" else 1
    np.testing.assert_allclose(b.scatter, np.sqrt(arrivals) * (rp or 1e-4) / RP_PER_RMS)
    assert b.expanded >= 2 * b.scatter


def test_of_distances_the_scatter_is_that_along_their_line():
    """A distance shows the scatter in one of three directions."""
    c = observed(["A", "B"], 3, cell=base_cell(stated("AB")), base=True)
    positions = campaign(poses=12)
    of = [budget(fitted(x, "absolute", x.readings, 1e-5)).scatter for x in (c, positions)]
    assert of[0] == pytest.approx(of[1] / np.sqrt(3), rel=0.02)


@pytest.mark.parametrize("poses", [8, 12, 24])
@pytest.mark.parametrize("mode", ["absolute", "deflection"])
def test_the_budget_is_never_below_what_poses_left_out_show(mode, poses):
    """An effect that the model lacks, and few poses: fitted ones are nearer than new ones are."""
    c = campaign("joint_tilt_compliance", mode, poses=poses, strength=8.0)
    result = fitted(c, mode, c.readings)
    assert budget(result).combined >= result.holdout.rms_m * (1 - 1e-9)
    assert result.holdout.rms_m > result.error.rms_m


def test_the_instrument_is_as_stated_beside_a_scatter_in_units_of_its_noise():
    c = campaign(poses=16)
    alone = instrument(c)
    scatter = ArmScatter("joints", (TRUE,), (1e-6,), 2e-5, 0.0, 0.3, unit=0.3)
    result = fitted(c, "absolute", with_arm_scatter(c.cell, alone, scatter))
    b = budget(result)
    assert b.instrument == pytest.approx(noise_floor(alone.covariance), rel=0.02)


def test_identical_rows_are_no_repeats():
    """Rows that were copied say that the arm does not scatter at all."""
    c = campaign(poses=16)
    one = once(instrument(c))
    twice = Readings.joined([one, one])
    assert Calibration.of(fitted(c, "absolute", twice)).scatter.source == "maker"


def test_repeats_below_the_noise_say_how_much_it_can_be():
    c = campaign(poses=16, cycles=3)
    alone = instrument(c)
    noisy = replace(alone, covariance=100.0 * alone.covariance)
    scatter = Calibration.of(fitted(c, "absolute", noisy)).scatter
    assert scatter.source == "repeats"
    assert TRUE < scatter.joint_std[0] < 10 * TRUE


def test_what_the_fit_or_the_cell_states_goes_first():
    c = campaign(poses=16, cycles=3)
    result = fitted_model(c.cell, c.readings, "absolute")
    assert Calibration.of(result).scatter.source == "stated"
