"""Whether an arm is still what its factory measured, on readings of a simulated world."""

import pytest

from hilcal.cell import cell_from_config
from hilcal.cli.planning import make_plan
from hilcal.config import CellConfig
from hilcal.drivers.simulated.rehearsal import case_of_plan, simulate_plan
from hilcal.effects.catalogue import installed
from hilcal.robot.catalogue import load_arm
from hilcal.transfer.compare import check_factory
from tests.support.factory_cases import factory_of, write

CELL = {
    "robot": {"model": "ur15", "kinematics": "factory", "calibration": "arm.toml"},
    "tool": {"target_m": [0.06, 0.02, 0.12], "mass_kg": 0.8, "com_m": [0.01, 0.0, 0.06]},
    "repeatability": {"joint_std_rad": 1e-5},
    "planning": {"readings": "absolute", "candidates": 60, "against": []},
    "simulation": {"strength_sigma": 20.0},
}


def readings(folder, hide, seed):
    """Readings of 20 poses of an arm that the factory had measured, with a later change."""
    write(folder / "arm.toml", "ur15")
    config = CellConfig.model_validate(CELL)
    plan = make_plan(cell_from_config(config, folder), 20, 1, installed())
    secret = case_of_plan(config, plan, hide, seed, None, folder)
    return config, simulate_plan(secret, plan, [seed]).readings


@pytest.mark.parametrize(
    "hide",
    [
        "encoder_offset",
        pytest.param("nothing", marks=pytest.mark.long),
        pytest.param("link_geometry", marks=pytest.mark.long),
    ],
)
def test_a_change_since_the_factory_is_found_and_none_is_invented(tmp_path, hide):
    config, measured = readings(tmp_path, hide, 3)
    cell, nominal = cell_from_config(config, tmp_path), load_arm("ur15")
    check = check_factory(cell, nominal, cell.factory, measured)
    assert check.changed == (hide != "nothing")
    assert check.readings == len(measured)
    assert check.nominal_m > 2.0 * check.factory_m  # the arm is the factory's, not the maker's
    if hide == "nothing":
        assert check.moved_m < 3.0 * check.moved_std_m < 1e-4
        other = check_factory(cell, nominal, factory_of("ur15", seed=8), measured)
        assert other.changed  # somebody else's file
        assert other.factory_m > check.factory_m
    else:
        assert check.moved_m > 3.0 * check.moved_std_m
