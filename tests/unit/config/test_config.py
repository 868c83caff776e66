"""Cell files: what is read, and one clear line for everything that is wrong."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.cell import STANDARD_GRAVITY, cell_from_config
from hilcal.config import CellConfig, CellLoad, load_config
from hilcal.config.reference import to_toml
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.robot.catalogue import configs_dir
from tests.support.campaigns import configuration
from tests.support.refusals import refusal, refusals, refuses

ROBOT = '[robot]\nmodel = "ur10e"\n'


def load(tmp_path, text):
    path = tmp_path / "cell.toml"
    path.write_text(text, encoding="utf-8")
    return load_config(path)


def test_the_least_that_is_needed(tmp_path):
    config = load(tmp_path, ROBOT)
    cell = cell_from_config(config, tmp_path)
    assert cell.arm.name == "ur10e"
    assert not cell.target_known
    assert not cell.registration_known
    np.testing.assert_array_equal(cell.target, np.eye(4))
    np.testing.assert_array_equal(cell.registration, np.eye(4))
    np.testing.assert_array_equal(cell.gravity, STANDARD_GRAVITY)
    np.testing.assert_array_equal(cell.load_point, np.zeros(3))
    assert cell.tool_mass == 0.0
    assert config.loads == ()


def test_a_stored_cell_is_read_though_checks_were_added_since(tmp_path):
    tracker = {"base_xyz_m": [2.0, 1.0, 0.5], "base_rotvec_rad": [0.0, 0.0, 90.0]}
    content = {"robot": {"model": "ur10e"}, "tracker": tracker}
    assert CellConfig.from_json(json.dumps(content)).tracker.base_rotvec_rad == (0.0, 0.0, 90.0)
    tracker["base_rotvec_rad"] = [0.0, 0.0, "90"]
    refusal("it must be a rotation vector", CellConfig.from_json, json.dumps(content))


def test_everything_is_taken_over(tmp_path):
    config = load(
        tmp_path,
        """
        [robot]
        model = "ur5"
        gravity_m_s2 = [0, 9.8, 0]
        [tool]
        target_m = [0.1, 0.2, 0.3]
        target_rotvec_rad = [0, 0, 1.5707963267948966]
        load_point_m = [0, 0, 1]
        mass_kg = 2
        com_m = [0.01, 0.02, 0.03]
        [tracker]
        frame = "tracker"
        base_xyz_m = [3, 1, -0.5]
        base_rotvec_rad = [3.141592653589793, 0, 0]
        range_std_m = 1e-5
        [repeatability]
        joint_std_rad = [1e-5, 2e-5, 3e-5, 4e-5, 5e-5, 6e-5]
        [[loads]]
        name = "pull"
        mass_kg = 2.0
        force_N = [10, 0, 0]
        moment_Nm = [0, 0, 3]
        [limits]
        joint_margin_rad = 0.1
        [simulation]
        seed = 7
        hide = "hysteresis"
        """,
    )
    cell = cell_from_config(config, tmp_path)
    expected = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    np.testing.assert_allclose(cell.target, expected, atol=1e-15)
    expected = [[1, 0, 0, 3], [0, -1, 0, 1], [0, 0, -1, -0.5], [0, 0, 0, 1]]
    np.testing.assert_allclose(cell.registration, expected, atol=1e-15)
    assert cell.target_known
    assert cell.registration_known
    np.testing.assert_array_equal(cell.load_point, [0, 0, 1])
    np.testing.assert_array_equal(cell.tool_com, [0.01, 0.02, 0.03])
    assert cell.tool_mass == 2.0
    # the weight hangs along gravity, whatever its direction in base axes
    wrench = config.loads[0].wrench(cell.gravity)
    np.testing.assert_allclose(wrench, [10, 19.6, 0, 0, 0, 3])
    np.testing.assert_allclose(config.repeatability.per_joint(6), np.arange(1, 7) * 1e-5)
    assert (config.tracker.range_std_m, config.limits.joint_margin_rad) == (1e-5, 0.1)
    assert (config.simulation.seed, config.simulation.hide) == (7, "hysteresis")


def test_readings_in_base_axes_need_no_registration(tmp_path):
    config = load(tmp_path, ROBOT + '[tracker]\nframe = "base"\nstation_m = [3, 0, 1]\n')
    cell = cell_from_config(config, tmp_path)
    assert cell.registration_known
    np.testing.assert_array_equal(cell.registration, np.eye(4))
    assert config.tracker.station_m == (3.0, 0.0, 1.0)


def test_one_repeatability_holds_for_all_joints(tmp_path):
    config = load(tmp_path, ROBOT + "[repeatability]\njoint_std_rad = 1e-5\n")
    np.testing.assert_array_equal(config.repeatability.per_joint(6), np.full(6, 1e-5))


def test_a_robot_file_is_found_beside_the_cell_file(tmp_path):
    (tmp_path / "arms").mkdir()
    text = (configs_dir() / "robots" / "ur3.toml").read_text()
    (tmp_path / "arms" / "mine.toml").write_text(text)
    config = load(tmp_path, '[robot]\nmodel = "arms/mine.toml"\n')
    assert cell_from_config(config, tmp_path).arm.name == "mine"


@pytest.mark.parametrize(
    "path", sorted((configs_dir() / "cells").glob("*.toml")), ids=lambda p: p.stem
)
def test_example_cells(path):
    cell = cell_from_config(load_config(path), path.parent)
    assert cell.arm.n == 6


def test_the_demo_cell_stays_within_the_payload():
    config = configuration()
    cell = cell_from_config(config)
    for load in config.loads:
        force = np.linalg.norm(load.wrench(cell.gravity)[:3])
        assert force / 9.81 + cell.tool_mass <= cell.arm.payload


number = st.floats(-3.0, 3.0)
vector = st.tuples(number, number, number)
LOAD_NAME = st.text(min_size=1).filter(lambda name: escaped(name) == name)


@given(
    target=st.none() | vector,
    mass=st.floats(0, 20),
    loads=st.lists(st.tuples(LOAD_NAME, st.floats(0.1, 20), vector), max_size=4),
    joint_std=st.floats(0, 1e-3) | st.tuples(*[st.floats(0, 1e-3)] * 6),
    base=st.none() | st.tuples(vector, vector),
)
@pytest.mark.long
def test_json_round_trip(target, mass, loads, joint_std, base):
    tracker = {} if base is None else {"base_xyz_m": base[0], "base_rotvec_rad": base[1]}
    config = CellConfig.model_validate(
        {
            "robot": {"model": "ur10"},
            "tool": {"target_m": target, "mass_kg": mass},
            "tracker": tracker,
            "loads": [
                {"name": f"{i} {name}", "mass_kg": m, "force_N": f}
                for i, (name, m, f) in enumerate(loads)
            ],
            "repeatability": {"joint_std_rad": joint_std},
        }
    )
    assert CellConfig.from_json(config.to_json()) == config


@refusals("cell")
def test_wrong_cell_file(tmp_path, case, given):
    refuses(case, lambda: cell_from_config(load(tmp_path, given), tmp_path), tmp_path)


@pytest.mark.parametrize(
    ("text", "place"),
    [("[tool\n", "line 3"), ("[tool]\nmass_kg =", "line 4"), ('model = "ur5"\n', "line 3")],
)
def test_what_is_not_toml_is_told_by_its_place(tmp_path, text, place):
    refusal(rf"^cell.toml: TOML syntax error: .*{place}", load, tmp_path, ROBOT + text)


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"absent\.toml: no such file; expected a TOML file"):
        load_config(tmp_path / "absent.toml")
    refusal("cannot be read", load_config, tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    refusal("not UTF-8", load_config, tmp_path / "binary.toml")


@pytest.mark.parametrize(("text", "message"), [
    ("{", r"stored cell configuration: not JSON.*line 1"),
    ("[]", "stored cell configuration: "),
    ('{"robot": {"model": "ur10", "x": 1}}', r'\[robot\] has no key "x"')])  # fmt: skip
def test_wrong_json(text, message):
    refusal(message, CellConfig.from_json, text)


EVERYTHING = (
    ROBOT
    + """
[tracker]
frame = "base"
[[loads]]
name = "5kg"
mass_kg = 5.0
hang_m = 0.4
radius_m = 0.08
[[loads]]
name = "pull"
force_N = [80.0, 0.0, 0.0]
cable_m = 1.5
[planning]
model = ["joint_compliance", "link_compliance"]
readings = "absolute"
against = ["thermal"]
criterion = "I"
work_q_rad = [[0.0, -1.5, 1.5, 0.0, 0.0, 0.0], [0.1, -1.5, 1.5, 0, 0, 0]]
work_load = "5kg"
reading_s = 8.0
load_change_s = 90.0
candidates = 100000
singularity = 0.1
[[obstacles]]
name = "table"
center_m = [0.0, 0.0, -0.05]
size_m = [2.0, 1.0, 0.1]
[[obstacles]]
name = "tripod"
bottom_m = [2.0, 0.0, -0.8]
radius_m = 0.4
height_m = 1.6
[sight]
tracker_m = [2.0, 0.0, 0.8]
target_normal = [1, 0, 0]
incidence_max_rad = 0.7
clearance_m = 0.02
"""
)


def test_everything_is_taken_over_and_written_back(tmp_path):
    config = load(tmp_path, EVERYTHING)
    assert config.planning.against == ("thermal",)
    assert config.planning.work_q_rad[1] == (0.1, -1.5, 1.5, 0, 0, 0)
    table, tripod = config.obstacles
    assert (table.size_m, table.radius_m) == ((2.0, 1.0, 0.1), None)
    assert (tripod.bottom_m, tripod.height_m) == ((2.0, 0.0, -0.8), 1.6)
    assert config.sight.tracker_m == (2.0, 0.0, 0.8)
    assert [load.hanging_m for load in config.loads] == [0.4, 0.0]
    assert config.loads[1].cable_m == 1.5
    assert load(tmp_path, to_toml(config)) == config
    assert CellConfig.from_json(config.to_json()) == config


def test_the_work_may_be_a_box(tmp_path):
    text = ROBOT + (
        '[planning]\ncriterion = "test"\nwork_min_m = [0, 0, 0]\nwork_max_m = [1, 1, 1]\nagainst=[]'
    )
    planning = load(tmp_path, text).planning
    assert planning.criterion == "I"  # "test" is its former name
    assert planning.work_max_m == (1, 1, 1)
    assert planning.against == ()


@pytest.mark.parametrize(("load", "hangs"), [
    (CellLoad(name="a", mass_kg=1.0), 0.3),
    (CellLoad(name="a", mass_kg=1.0, hang_m=0.0), 0.0),
    (CellLoad(name="a", force_N=(1.0, 0.0, 0.0)), 0.0),
    (CellLoad(name="a", force_N=(1.0, 0.0, 0.0), hang_m=0.1), 0.1)])  # fmt: skip
def test_only_a_load_with_a_mass_hangs_unless_told(load, hangs):
    assert load.hanging_m == hangs
