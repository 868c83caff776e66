"""[planning], [[obstacles]], [sight] and what hangs from a load: read, checked, written back."""

from pathlib import Path

import pytest

from hilcal.config import CellConfig, Load, load_config
from hilcal.config.write import to_toml

ROBOT = '[robot]\nmodel = "ur10e"\n'
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


def load(tmp_path: Path, text: str) -> CellConfig:
    path = tmp_path / "cell.toml"
    path.write_text(text, encoding="utf-8")
    return load_config(path)


def test_defaults(tmp_path: Path) -> None:
    config = load(tmp_path, ROBOT)
    planning, sight = config.planning, config.sight
    assert planning.model == ("joint_compliance",)
    assert (planning.readings, planning.against, planning.criterion) == (
        "deflection",
        "catalogue",
        "D",
    )
    assert planning.work_q_rad == ()
    assert planning.work_min_m is planning.work_max_m is planning.reading_s is None
    assert (planning.work_load, planning.load_change_s) == ("none", 60.0)
    assert (planning.candidates, planning.singularity) == (2000, 0.05)
    assert config.obstacles == ()
    assert sight.tracker_m is sight.target_normal is None
    assert (sight.incidence_max_rad, sight.clearance_m) == (0.5, 0.03)


def test_everything_is_taken_over_and_written_back(tmp_path: Path) -> None:
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


def test_the_work_may_be_a_box(tmp_path: Path) -> None:
    text = ROBOT + (
        '[planning]\ncriterion = "test"\nwork_min_m = [0, 0, 0]\nwork_max_m = [1, 1, 1]\nagainst=[]'
    )
    planning = load(tmp_path, text).planning
    assert planning.criterion == "I"  # "test" is its former name
    assert planning.work_max_m == (1, 1, 1)
    assert planning.against == ()


@pytest.mark.parametrize(
    ("load", "hangs"),
    [
        (Load(name="a", mass_kg=1.0), 0.3),
        (Load(name="a", mass_kg=1.0, hang_m=0.0), 0.0),
        (Load(name="a", force_N=(1.0, 0.0, 0.0)), 0.0),
        (Load(name="a", force_N=(1.0, 0.0, 0.0), hang_m=0.1), 0.1),
    ],
)
def test_only_a_load_with_a_mass_hangs_unless_told(load: Load, hangs: float) -> None:
    assert load.hanging_m == hangs


PLAN = ROBOT + "[planning]\n"
OBSTACLE = ROBOT + "[[obstacles]]\nname = 'a'\n"
MASS = "[[loads]]\nname = '5kg'\nmass_kg = 5.0\n"
