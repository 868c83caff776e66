"""Lengths and durations, ranges, several targets, and readings that are the same."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hilcal.cell import Cell
from hilcal.errors import InputError
from hilcal.readings.covariance import TrackerNoise
from hilcal.readings.readings import Range
from hilcal.readings.same_readings import found_among, never_fitted
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.rows import content_hash
from hilcal.tables.table import write_table
from hilcal.tables.units import parse_duration, parse_length
from tests.support.campaigns import cell_of
from tests.support.readings_cases import read_table, readings_at
from tests.support.refusals import refusals, refuses


@pytest.mark.parametrize(
    ("parse", "text", "number"),
    [
        *((parse_length, text, 1e-4) for text in ("0.1 mm", "100um", "100 µm", " 1e-4 m ")),
        *((parse_duration, text, 5400) for text in ("90 min", "1.5h", "5400 s")),
    ],
)
def test_a_length_or_a_duration(parse, text, number):
    assert math.isclose(parse(text, "--option"), number)


@refusals("lengths")
def test_anything_else_is_refused_with_its_reason(case, given):
    refuses(case, lambda: parse_length(given[:-1], "--limit"))


MEASURED = Range("joint 1 angle", "rad", np.radians(-176.0), np.radians(168.0))


@pytest.mark.parametrize(("degrees", "plain", "turning"), [
    (0.0, -168.0, -168.0),
    (184.8, 16.8, -0.8),  # -175.2 a turn before
    (-190.0, 14.0, 2.0),  # 170
    (172.0, 4.0, 4.0),
    (181.0, 13.0, 3.0),  # three degrees before -176
    (360.0, 192.0, -168.0),
    (-720.0, 544.0, -168.0)])  # fmt: skip
def test_whole_turns(degrees, plain, turning):
    value = np.radians([degrees])
    np.testing.assert_allclose(np.degrees(MEASURED.over(value)), plain, atol=1e-9)
    over = np.degrees(MEASURED.over(value, turning=True))
    if turning > 0:
        np.testing.assert_allclose(over, turning, atol=1e-9)
    else:
        assert over[0] <= 0.0


def test_a_range_of_more_than_a_turn_has_every_angle():
    wide = Range("joint 6 angle", "rad", -4.0, 4.0)
    angles = np.linspace(-20, 20, 500)
    assert not wide.beyond(angles, turning=True).any()
    assert wide.beyond(angles).any()


@pytest.mark.parametrize(
    ("measured", "values"),
    [
        (Range("joint 1 temperature", "K", 293.0, 294.0), [291.9, 292.1, 294.9, 295.1]),
        (Range("joint 4 angle", "rad", 0.3, 0.3), [0.289, 0.299, 0.301, 0.311]),
    ],
)
def test_a_little_warmer_or_a_small_correction_is_no_extrapolation(measured, values):
    assert measured.beyond(np.array(values)).tolist() == [True, False, False, True]


NAMES = ("R1", "R2", "R3")
CELL = """
[robot]
model = "ur10e"
[[tool.targets]]
name = "R1"
target_m = [0.06, 0.02, 0.12]
[[tool.targets]]
name = "R2"
[[tool.targets]]
name = "R3"
target_m = [0.02, -0.11, 0.15]
target_rotvec_rad = [0.0, 0.1, 0.0]
"""
HEADER = "pose,load,target,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad,x_m,y_m,z_m\n"


def readings_of(target, names=NAMES, seed=0):
    """Readings of two poses in turn, one for each number of a target."""
    rng, count = np.random.default_rng(seed), len(target)
    pose = np.arange(count) % 2
    q, value = rng.uniform(-1.5, 1.5, (2, 6))[pose], rng.uniform(-0.5, 0.5, (count, 3))
    columns = {"pose_names": ("p1", "p2"), "covariance": np.tile(1e-10 * np.eye(3), (count, 1, 1))}
    return readings_at(q, value, target=np.array(target), pose=pose, target_names=names, **columns)


def table_of(path, *targets):
    at = "0,-1,0,0,0,0,0.1,0.2,0.3"
    rows = [f"p{k},none,{name},{at}" for k, name in enumerate(targets)]
    path.write_text(HEADER + "\n".join(rows) + "\n")
    return path


@given(st.lists(st.integers(0, 2), min_size=1, max_size=8))
def test_tables_and_files_keep_the_targets(tmp_path_factory, target):
    folder, arm = tmp_path_factory.mktemp("targets"), cell_of().arm
    one = readings_of(target)
    write_table(one, folder / "t.csv")
    back = read_table(folder / "t.csv", arm, NOISE, targets=NAMES)
    with CampaignFile.create(folder / "r.hilcal", "{}", ".", "test") as file:
        file.append_readings(one[:1])
        file.append_readings(one[1:])
        stored = file.readings()
    for copy in (back, stored):
        assert copy.target_names == NAMES
        np.testing.assert_array_equal(copy.target, target)
        assert content_hash(copy) == content_hash(one)


def test_a_campaign_numbers_targets_by_their_names(tmp_path):
    first, other = readings_of([0, 1, 2]), readings_of([0, 1, 1], ("R3", "R1"))
    with CampaignFile.create(tmp_path / "r.hilcal", "{}", ".", "test") as file:
        file.append_readings(first)
        other = replace(other, states=replace(other.states, q=first.states.q))
        file.append_readings(other)
        assert file.readings().target.tolist() == [0, 1, 2, 2, 0, 0]
        with pytest.raises(InputError, match=r"target 'R4' is not one of this .*: R1"):
            file.append_readings(replace(first, target_names=("R1", "R2", "R4")))


def test_one_target_is_stored_as_before(tmp_path):
    several = readings_of([0, 0])
    one = replace(several, states=replace(several.states, target=None), target_names=())
    assert content_hash(one) == ("eae7c0c5c00b9316cd4e55433994b936612c7b72e5f6544934f63c6fc6bc16f6")
    assert content_hash(one) != content_hash(several)
    versions = []
    for name, readings in (("one", one), ("several", several)):
        with CampaignFile.create(tmp_path / name, "{}", ".", "test") as file:
            file.append_readings(readings)
            versions += file.connection.execute("PRAGMA user_version").fetchone()
    assert versions == [2, 3]


def test_readings_of_one_arrival():
    target = np.array([0, 1, 2, 0, 1, 2, 0, 1, 0])
    load = np.array([0, 0, 0, 1, 1, 1, 1, 1, 0])
    many = readings_of(target.tolist())
    same = replace(many, pose=0 * load, load=load, load_names=("none", "5kg"))
    _, arrival = np.unique(same.arrivals, return_inverse=True)
    # The target R1 was read twice unloaded and twice loaded: four arrivals.
    groups = [set(np.flatnonzero(arrival == k)) for k in range(4)]
    assert sorted(map(sorted, groups)) == [[0, 1, 2], [3, 4, 5], [6, 7], [8]]
    assert len(np.unique(replace(same, cycle=np.arange(9)).arrivals)) == 9


def test_the_cell_names_its_targets(tmp_path):
    (tmp_path / "cell.toml").write_text(CELL)
    cell = Cell.load(tmp_path / "cell.toml")
    assert cell.target_names == NAMES
    assert cell.known_targets == (True, False, True)
    assert not cell.target_known
    np.testing.assert_array_equal(cell.all_targets[:, 0, 3], [0.06, 0.0, 0.02])
    np.testing.assert_array_equal(cell.target, cell.all_targets[0])
    arm = cell.arm
    read = read_table(table_of(tmp_path / "t.csv", "R3", "R1"), arm, NOISE, targets=NAMES)
    assert read.target.tolist() == [2, 0]


NOISE = TrackerNoise(5e-6, 0.0, 7e-6, 0.0)


@pytest.mark.parametrize(("targets", "rows", "message"), [
    ((), ("A", "B"), r"column 'target' names 'A', 'B', but the cell has one target"),
    (NAMES, ("R1", "r2"), r"row 3, column 'target': target 'r2' is .* valid: R1, R2, R3"),
    (NAMES, ("R1", ""), r"row 3, column 'target': the cell is empty; name the target"),
])  # fmt: skip
def test_table_and_cell_disagree(tmp_path, targets, rows, message):
    with pytest.raises(InputError, match=message) as raised:
        read_table(table_of(tmp_path / "t.csv", *rows), cell_of().arm, None, targets=targets)
    assert "\n" not in str(raised.value)


def test_a_table_without_the_column(tmp_path):
    path = table_of(tmp_path / "t.csv", "R1", "R1")
    assert read_table(path, cell_of().arm, NOISE).states.target is None
    path.write_text(path.read_text().replace("target,", "").replace(",R1", ""))
    with pytest.raises(InputError, match=r"no column 'target', but the cell's targets are R1"):
        read_table(path, cell_of().arm, NOISE, targets=NAMES)


LOADS = 3
NOISE_M = 5e-6


def campaign(m=3, poses=40, seed=0):
    """Poses with an unloaded and two loaded readings each."""
    rng = np.random.default_rng(seed)
    n = poses * LOADS
    pose, load = np.divmod(np.arange(n), LOADS)
    value = rng.normal(size=(n, m))
    if m == 6:
        value[:, 3:] = Rotation.random(n, random_state=1).as_rotvec()
    q, wrench = rng.uniform(-3, 3, (poses, 6))[pose], rng.normal(size=(n, 6))
    return readings_at(q, value, wrench=wrench, pose=pose, load=load, std=NOISE_M)


@pytest.mark.parametrize("m", [3, 6])
def test_a_copy_is_known_whatever_it_went_through(m):
    r = campaign(m)
    order = np.random.default_rng(1).permutation(len(r))
    shuffled = r[order]
    value, states = shuffled.value.copy(), shuffled.states
    value[:, :3] = np.round(value[:, :3] * 1e3, 4) / 1e3  # mm, four decimals
    if m == 6:  # degrees, three decimals, and the other way round where that is as short
        value[:, 3:] = np.radians(np.round(np.degrees(value[:, 3:]), 3))
        value[:, 3:] -= (
            2 * np.pi * value[:, 3:] / np.linalg.norm(value[:, 3:], axis=1, keepdims=True)
        )
    copy = replace(
        shuffled,
        value=value,
        states=replace(
            states, q=np.radians(np.round(np.degrees(states.q), 3)), wrench=states.wrench * 1.02
        ),
        covariance=shuffled.covariance * 4,
        load_names=("none", "five", "ten"),
        pose_names=tuple(f"P {k}" for k in range(len(r.pose_names))),
    )
    assert found_among(copy, r).all()
    assert found_among(r, copy).all()
    positions = replace(r, value=r.value[:, :3], covariance=r.covariance[:, :3, :3])
    assert found_among(positions, r).all()


def test_what_was_measured_again_is_another_reading():
    r = campaign(poses=300)
    again = replace(r, value=r.value + np.random.default_rng(2).normal(0, NOISE_M, r.value.shape))
    assert found_among(again, r).mean() < 0.002  # (0.2 µm)³ in (5 µm √2π)³: none is expected
    turned = replace(r, states=replace(r.states, q=r.states.q + 1e-3))
    assert not found_among(turned, r).any()


def test_loaded_and_unloaded_readings_differ_and_arms_with_other_joints():
    r = campaign()
    swapped = replace(r, load=np.where(r.load == 0, 1, 0))
    assert not found_among(swapped, r)[r.load < 2].any()
    assert not found_among(replace(r, states=replace(r.states, q=r.states.q[:, :5])), r).any()
    assert not found_among(r, r[:0]).any()
    assert len(found_among(r[:0], r)) == 0


def test_a_deflection_is_unseen_only_if_neither_reading_of_it_was_fitted():
    r = campaign(poses=4)
    fitted = r[[0, 4, 8]]  # p0 unloaded, p1 under 5kg, p2 under 10kg
    known, unseen = never_fitted(r, fitted, deflections=True)
    assert np.flatnonzero(known).tolist() == [0, 4, 8]
    assert np.flatnonzero(unseen).tolist() == [3, 5, 6, 7, 9, 10, 11]
    known, unseen = never_fitted(r, fitted, deflections=False)
    assert np.flatnonzero(~unseen).tolist() == [0, 4, 8]
    known, unseen = never_fitted(r, r[[1, 2]], deflections=True)
    assert not unseen[:3].any()  # the unloaded reading alone tells nothing
