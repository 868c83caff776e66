"""Several targets per pose: the column `target`, the campaign file, the configuration."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.cell import Cell
from hilcal.errors import InputError
from hilcal.readings.covariance import TrackerNoise
from hilcal.readings.readings import Readings, States
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.rows import content_hash
from hilcal.tables.table import read_table, write_table
from tests.support.campaigns import cell_of

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


def readings_of(target: list[int], names: tuple[str, ...] = NAMES, seed: int = 0) -> Readings:
    """Readings of two poses in turn, one for each number of a target."""
    rng, count = np.random.default_rng(seed), len(target)
    pose = np.arange(count) % 2
    zero = np.zeros(count, dtype=np.int64)
    q = rng.uniform(-1.5, 1.5, (2, 6))
    return Readings(
        states=States(q[pose], np.zeros((count, 6)), target=np.array(target)),
        pose=pose,
        load=zero,
        cycle=zero,
        value=rng.uniform(-0.5, 0.5, (count, 3)),
        covariance=np.tile(1e-10 * np.eye(3), (count, 1, 1)),
        load_names=("none",),
        pose_names=("p1", "p2"),
        target_names=names,
    )


def table_of(path: Path, *targets: str) -> Path:
    at = "0,-1,0,0,0,0,0.1,0.2,0.3"
    rows = [f"p{k},none,{name},{at}" for k, name in enumerate(targets)]
    path.write_text(HEADER + "\n".join(rows) + "\n")
    return path


@given(st.lists(st.integers(0, 2), min_size=1, max_size=8))
def test_tables_and_files_keep_the_targets(
    tmp_path_factory: pytest.TempPathFactory, target: list[int]
) -> None:
    folder, arm = tmp_path_factory.mktemp("targets"), cell_of().arm
    one = readings_of(target)
    write_table(one, folder / "t.csv")
    back = read_table(folder / "t.csv", arm, NOISE, targets=NAMES)
    with CampaignFile.create(folder / "r.hilcal", "{}", ".", "test") as file:
        file.append_readings(one[:1])
        file.append_readings(one[1:])
        stored = file.readings()
    for found in (back, stored):
        assert found.target_names == NAMES
        np.testing.assert_array_equal(found.target, target)
        assert content_hash(found) == content_hash(one)


def test_a_campaign_numbers_targets_by_their_names(tmp_path: Path) -> None:
    first, other = readings_of([0, 1, 2]), readings_of([0, 1, 1], ("R3", "R1"))
    with CampaignFile.create(tmp_path / "r.hilcal", "{}", ".", "test") as file:
        file.append_readings(first)
        other = replace(other, states=replace(other.states, q=first.states.q))
        file.append_readings(other)
        assert file.readings().target.tolist() == [0, 1, 2, 2, 0, 0]
        with pytest.raises(InputError, match=r"target 'R4' is not one of this .*: R1"):
            file.append_readings(replace(first, target_names=("R1", "R2", "R4")))


def test_one_target_is_stored_as_before(tmp_path: Path) -> None:
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


def test_readings_of_one_arrival() -> None:
    target = np.array([0, 1, 2, 0, 1, 2, 0, 1, 0])
    load = np.array([0, 0, 0, 1, 1, 1, 1, 1, 0])
    many = readings_of(target.tolist())
    same = replace(many, pose=0 * load, load=load, load_names=("none", "5kg"))
    _, arrival = np.unique(same.arrivals, return_inverse=True)
    # The target R1 was read twice unloaded and twice loaded: four arrivals.
    groups = [set(np.flatnonzero(arrival == k)) for k in range(4)]
    assert sorted(map(sorted, groups)) == [[0, 1, 2], [3, 4, 5], [6, 7], [8]]
    assert len(np.unique(replace(same, cycle=np.arange(9)).arrivals)) == 9


def test_the_cell_names_its_targets(tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    ("targets", "rows", "message"),
    [
        ((), ("A", "B"), r"column 'target' names 'A', 'B', but the cell has one target"),
        (
            NAMES,
            ("R1", "r2"),
            r"row 3, column 'target': target 'r2' is .* valid: R1, R2, R3",
        ),
        (NAMES, ("R1", ""), r"row 3, column 'target': the cell is empty; name the target"),
    ],
)
def test_table_and_cell_disagree(
    tmp_path: Path, targets: tuple[str, ...], rows: tuple[str, ...], message: str
) -> None:
    with pytest.raises(InputError, match=message) as raised:
        read_table(table_of(tmp_path / "t.csv", *rows), cell_of().arm, None, targets=targets)
    assert "\n" not in str(raised.value)


def test_a_table_without_the_column(tmp_path: Path) -> None:
    path = table_of(tmp_path / "t.csv", "R1", "R1")
    assert read_table(path, cell_of().arm, NOISE).states.target is None
    path.write_text(path.read_text().replace("target,", "").replace(",R1", ""))
    with pytest.raises(InputError, match=r"no column 'target', but the cell's targets are R1"):
        read_table(path, cell_of().arm, NOISE, targets=NAMES)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "R2"', 'name = "R1"', r'two \[\[tool.targets\]\] have the name "R1"'),
        (
            "[[tool.targets]]",
            "[tool]\ntarget_m = [0, 0, 0]\n[[tool.targets]]",
            "target_m together",
        ),
        ("[0.06, 0.02, 0.12]", "[60.0, 20.0, 120.0]", r"over 5 m off the flange; is it in m"),
        ('name = "R2"', 'nam = "R2"', r'has no key "nam"'),
    ],
)
def test_wrong_targets(tmp_path: Path, old: str, new: str, message: str) -> None:
    (tmp_path / "cell.toml").write_text(CELL.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as raised:
        Cell.load(tmp_path / "cell.toml")
    assert "\n" not in str(raised.value)
