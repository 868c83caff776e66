"""The kinematics that a factory measured: read from its files, and put into an arm."""

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import evaluate
from hilcal.robot.factory import (
    flange_difference,
    nominal_rows,
    of_dict,
    of_rows,
    read_factory,
    with_factory,
)
from tests.support.arm_cases import classic_flange
from tests.support.factory_cases import UR5E_YAML, factory_of, measured_arm
from tests.support.refusals import refusal, refusals, refuses, with_edits

CONF = """\
[mounting]
# of one arm
delta_theta = {}
delta_a = {}
delta_d = {}
delta_alpha = {}
joint_checksum = [0xb630883c, 0xb61f6e2e, 0xb5484b61, 0xb612c3a2, 0xb62bd7bc, 0xb61c0e94]
calibration_status = 2   # 0 == notInitialized, 1 == notLinearised, 2 == Linearised
"""


def states(n=50):
    return np.random.default_rng(4).uniform(-np.pi, np.pi, (n, 6))


@pytest.mark.parametrize("name", ["ur5e", "ur15", "ur20"])
def test_rows_whose_distances_cancel_are_held_exactly_near_the_nominal_frames(name):
    nominal, factory = load_arm(name), factory_of(name)
    assert np.abs(factory.rows[2]).max() > 30.0  # m: nearly parallel axes
    arm = with_factory(nominal, factory)
    assert np.abs(arm.links - nominal.links).max() < 0.01
    q = states()
    # rounding of some km: 1e-16 * 2e3 m, a few times
    there = [classic_flange(factory.rows, x)[:3, 3] for x in q]
    np.testing.assert_allclose(evaluate(arm, q).position[-1], there, rtol=0, atol=1e-11)
    assert flange_difference(arm, measured_arm(name))[1] < 1e-11
    assert flange_difference(arm, nominal)[1] > 1e-3
    np.testing.assert_array_equal(arm.coms, nominal.coms)


def test_a_calibration_conf_adds_to_the_nominal_rows(tmp_path):
    nominal, factory = load_arm("ur10e"), factory_of("ur10e")
    deltas = factory.rows - nominal_rows(nominal)
    file = tmp_path / "calibration.conf"
    file.write_text(CONF.format(*(str(list(map(float, row))) for row in deltas)))
    result = read_factory(file, nominal)
    np.testing.assert_allclose(result.rows, factory.rows, rtol=1e-15, atol=1e-15)
    assert result.status == 2
    assert result.checksum[0] == 0xB630883C


def test_the_file_of_ur_calibration_is_the_published_arm(tmp_path):
    """Its transforms, one after the other, are where `ur_description` has tool0."""
    file = tmp_path / "my_robot_calibration.yaml"
    file.write_text(UR5E_YAML)
    nominal = load_arm("ur5e")
    factory = read_factory(file, nominal)
    arm = with_factory(nominal, factory)
    rms, most = flange_difference(arm, nominal)
    assert 5e-4 < rms < most < 3e-3  # some millimetres, as factories find
    q = states()
    pose = np.broadcast_to(factory.links[0], (len(q), 4, 4))
    for k in range(6):
        turn = np.tile(np.eye(4), (len(q), 1, 1))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(q[:, k])
        turn[:, 1, 0], turn[:, 0, 1] = np.sin(q[:, k]), -np.sin(q[:, k])
        pose = pose @ turn @ factory.links[k + 1]
    np.testing.assert_allclose(evaluate(arm, q).position[-1], pose[:, :3, 3], rtol=0, atol=1e-12)


def test_a_file_of_our_own_comes_back(tmp_path):
    made, file = factory_of("ur15"), tmp_path / "arm.toml"
    file.write_text(made.to_toml())
    factory = read_factory(file, load_arm("ur15"))
    np.testing.assert_array_equal(factory.rows, made.rows)
    assert factory.checksum == made.checksum
    np.testing.assert_array_equal(of_dict(factory.to_dict(), "kept").rows, made.rows)


@refusals("factory")
def test_other_files_are_refused_in_one_line(case, given, tmp_path):
    name, _, text = given.partition("\n")
    (tmp_path / name).write_text(with_edits(text, UR5E_YAML=UR5E_YAML))
    refuses(case, lambda: read_factory(tmp_path / name, load_arm("ur5e")), tmp_path / name)


def test_the_kinematics_of_another_arm_are_refused(tmp_path):
    (tmp_path / "x.yaml").write_text(UR5E_YAML)
    refusal("another arm than ur10e", read_factory, tmp_path / "x.yaml", load_arm("ur10e"))
    refusal("four times 6", of_rows, np.zeros((4, 7)), "rows")


def test_a_cell_counts_from_what_the_configuration_says(tmp_path):
    (tmp_path / "x.yaml").write_text(UR5E_YAML)
    robot = {"model": "ur5e", "calibration": "x.yaml"}
    nominal = load_arm("ur5e")
    cell = cell_from_config(CellConfig.model_validate({"robot": robot}), tmp_path)
    np.testing.assert_array_equal(cell.arm.links, nominal.links)
    robot["kinematics"] = "factory"
    used = cell_from_config(CellConfig.model_validate({"robot": robot}), tmp_path)
    assert flange_difference(used.arm, with_factory(nominal, cell.factory))[1] == 0.0
    kept = cell_from_config(CellConfig.model_validate({"robot": robot}), None, None, UR5E_YAML)
    np.testing.assert_array_equal(kept.arm.links, used.arm.links)
    del robot["calibration"]
    with pytest.raises(ValueError, match="needs calibration"):
        CellConfig.model_validate({"robot": robot})
