"""[planning], [[obstacles]], [sight] and what hangs from a load: read, checked, written back."""

from pathlib import Path

import pytest

from hilcal.config import CellConfig, Load, load_config
from hilcal.config.write import to_toml
from hilcal.errors import InputError

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
WRONG = {
    "criterion": (PLAN + "criterion = 'G'", r"\[planning\] criterion = \"G\" is not valid: it mus"),
    "test without work": (PLAN + "criterion = 'test'", r"\[planning\] criterion = \"I\" needs"),
    "no effect": (PLAN + "model = []", r"\[planning\] model = \[\] is not valid: it must be the e"),
    "against": (PLAN + "against = 'all'", r'\[planning\] against = "all" is not valid.*"catalogue'),
    "half a box": (PLAN + "work_max_m = [1, 1, 1]", r"work_max_m alone; a box needs work_min_m"),
    "box upside down": (
        PLAN + "work_min_m = [0, 0, 1]\nwork_max_m = [1, 1, 1]",
        r"work_min_m = \[0.0, 0.0, 1.0\] is not below work_max_m",
    ),
    "work twice": (
        PLAN + "work_q_rad = [[0, 0]]\nwork_min_m = [0, 0, 0]\nwork_max_m = [1, 1, 1]",
        "work_q_rad together with work_min_m",
    ),
    "ragged work": (PLAN + "work_q_rad = [[0, 0], [0]]", "joint vectors of different lengths"),
    "work not numbers": (PLAN + "work_q_rad = [[0, nan]]", r"\[planning\] work_q_rad, element 1"),
    "unknown work load": (
        PLAN + "work_load = '5 kg'\n" + MASS,
        r'\[planning\] work_load = "5 kg" is not in \[\[loads\]\] \(did you mean "5kg"\?\); valid: '
        "none, 5kg",
    ),
    "no time": (PLAN + "reading_s = 0.0", r"reading_s = 0.0 is not valid: .* over 0"),
    "no candidates": (PLAN + "candidates = 0", "candidates = 0 is not valid"),
    "half a candidate": (PLAN + "candidates = 1.5", "candidates = 1.5 is not valid"),
    "singularity": (PLAN + "singularity = 1.0", "singularity = 1.0 is not valid"),
    "unknown key": (
        PLAN + "criterium = 'D'",
        r'\[planning\] has no key "criterium" \(did you mean "criterion"\?\)',
    ),
    "no shape": (OBSTACLE, r'\[\[obstacles\]\] number 1 obstacle "a" has no shape; give center_m'),
    "half a box of an obstacle": (
        OBSTACLE + "size_m = [1, 1, 1]",
        r'obstacle "a" has size_m; give center_m and size_m for a box, or bottom_m, radius_m',
    ),
    "two shapes": (
        OBSTACLE + "center_m = [0, 0, 0]\nsize_m = [1, 1, 1]\nradius_m = 1.0",
        "has center_m, size_m, radius_m; give",
    ),
    "flat": (OBSTACLE + "center_m = [0, 0, 0]\nsize_m = [1, 0, 1]", "size_m, element 2 = 0"),
    "obstacle in mm": (
        OBSTACLE + "center_m = [0, 0, 0]\nsize_m = [1000, 100, 100]",
        'obstacle "a" measures 1000 m; is it in m',
    ),
    "two obstacles of one name": (
        OBSTACLE
        + "center_m = [0, 0, 0]\nsize_m = [1, 1, 1]\n"
        + OBSTACLE.removeprefix(ROBOT)
        + "center_m = [0, 0, 0]\nsize_m = [1, 1, 1]\n",
        r'two \[\[obstacles\]\] have the name "a"',
    ),
    "nowhere": (ROBOT + "[sight]\ntarget_normal = [0, 0, 0]", "target_normal = .* points nowhere"),
    "in degrees": (ROBOT + "[sight]\nincidence_max_rad = 30.0", "incidence_max_rad = 30.0 is not"),
    "clearance in mm": (ROBOT + "[sight]\nclearance_m = 30.0", "clearance_m = 30.0 is over 1 m"),
    "tracker told twice": (
        ROBOT
        + "[tracker]\nbase_xyz_m = [1, 2, 3]\nbase_rotvec_rad = [0, 0, 0]\n"
        + "[sight]\ntracker_m = [1, 0, 0]",
        r"\[sight\] tracker_m together with \[tracker\] base_xyz_m",
    ),
    "station told twice": (
        ROBOT + "[tracker]\nframe = 'base'\nstation_m = [1, 2, 3]\n[sight]\ntracker_m = [1, 0, 0]",
        r"\[sight\] tracker_m together with \[tracker\] station_m",
    ),
    "cable of a weight": (ROBOT + MASS + "cable_m = 1.0", 'load "5kg" has cable_m without force_N'),
    "hang in mm": (ROBOT + MASS + "hang_m = 300.0", "hang_m = 300.0 is over 50 m; is it in m"),
    "no radius": (ROBOT + MASS + "radius_m = 0.0", "radius_m = 0.0 is not valid"),
}


@pytest.mark.parametrize(("text", "message"), WRONG.values(), ids=WRONG.keys())
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        load(tmp_path, text)
    assert "\n" not in str(raised.value)
    assert raised.value.exit_code == 2
