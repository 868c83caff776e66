"""Arms on rails, columns and gantries: description, tables, exports, and what fits tell of them.

Chain, statics and all effects are compared with Pinocchio, with differences and with the simulated
world on an arm of three slides in test_chain.py, test_statics.py, tests/unit/effects.
"""

import csv
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import hilcal as hc
from hilcal.calibration.dh_table import dh_rows, flange_poses, to_toml
from hilcal.calibration.handover import urdf
from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.drivers.simulated.rehearsal import case_of_plan, simulate_plan
from hilcal.effects.catalogue import installed
from hilcal.errors import InputError
from hilcal.robot.catalogue import configs_dir, load_arm
from hilcal.robot.chain import evaluate
from hilcal.robot.urdf import arm_from_urdf
from hilcal.store.plan import Plan, Step
from hilcal.tables.table import write_table
from tests.support.arm_cases import flange_at
from tests.support.cli_cases import ok, refused
from tests.support.readings_cases import read_table
from tests.support.refusals import refusals, refuses, with_edits
from tests.support.serial_urdf import serial_urdf

TRACK = """title = "UR10e on a track"
payload_kg = 12.5
base_m_rad = [0.0, 0.0, 0.3, 0.0, 1.5707963267948966, 0.0]

[[joints]]
name = "track"
type = "prismatic"
a_m = 0.0
d_m = 0.0
alpha_deg = -90.0
offset_deg = 90.0
mass_kg = 40.0
q_min_m = 0.0
q_max_m = 3.0
force_max_N = 2000.0

"""
"""A track along x of the base, 0.3 m above it; the arm stands upright on it."""
SLIDE, TOOL = {"type": "prismatic"}, {"link": "tool0", "type": "fixed"}
GANTRY = serial_urdf([
    {**SLIDE, "xyz": "0 0 2.5", "axis": "1 0 0", "lower": -2, "upper": 2, "effort": 3000},
    {**SLIDE, "axis": "0 1 0", "lower": -1, "upper": 1, "effort": 2000},
    {**SLIDE, "axis": "0 0 -1", "lower": 0, "upper": 1.2, "effort": 2000, "mass": 30,
     "com": "0 0 -0.4"},
    {"xyz": "0.1 0 -0.8", "lower": -3, "upper": 3, "effort": 80},
    {"xyz": "0 0 -0.2", "rpy": "1.2 0.3 0", "axis": "0 1 0", "lower": -2, "upper": 2, "effort": 60},
    {**TOOL, "xyz": "0 0.05 -0.15"},
])  # fmt: skip
MIMIC = '<mimic joint="j1" multiplier="1.0" offset="0.1"/>'
LIFT = serial_urdf([
    {**SLIDE, "lower": 0, "upper": 0.5},
    {**SLIDE, "xyz": "0 0 0.4", "lower": 0, "upper": 0.6, "mimic": MIMIC},
    {"xyz": "0.2 0 0", "axis": "0 1 0", "lower": -2, "upper": 2},
    {**TOOL, "xyz": "0.3 0 0"},
])  # fmt: skip
"""A column of two stages, of which the upper one is taken along."""


def track(folder, change="in track"):
    rows = (configs_dir() / "robots" / "ur10e.toml").read_text()
    text = TRACK + rows[rows.index("[[joints]]") :]
    (folder / "track.toml").write_text(with_edits(change, track=text))
    return load_arm("track.toml", folder)


def from_urdf(folder, text):
    (folder / "arm.urdf").write_text(text)
    return arm_from_urdf(folder / "arm.urdf")


def test_a_track_carries_the_arm_along(tmp_path):
    arm, alone = track(tmp_path), load_arm("ur10e")
    assert arm.units == ("m", *("rad",) * 6)
    q = np.random.default_rng(1).uniform(-2.0, 2.0, (10, 7))
    carried, stands = evaluate(arm, q), evaluate(alone, q[:, 1:])
    turned = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about z, by offset
    shift = np.column_stack([q[:, 0], np.zeros(10), np.full(10, 0.3)])
    expected = stands.position[-1] @ turned.T + shift
    np.testing.assert_allclose(carried.position[-1], expected, rtol=0, atol=1e-12)
    assert arm.reach == pytest.approx(alone.reach + 3.0 + 0.3)


def test_a_gantry_is_that_of_its_urdf(tmp_path):
    arm = from_urdf(tmp_path, GANTRY)
    assert arm.slides.tolist() == [True, True, True, False, False]
    assert arm.torque_max.tolist() == [3000, 2000, 2000, 80, 60]
    model = pin.buildModelFromXML(GANTRY)
    data = model.createData()
    q = np.random.default_rng(2).uniform(-1.0, 1.0, (10, 5))
    chain = evaluate(arm, q)
    for i in range(10):
        pin.framesForwardKinematics(model, data, q[i])
        flange_at(chain, i, data.oMf[model.getFrameId("tool0")].homogeneous)


def test_a_column_of_two_stages_moves_by_both(tmp_path):
    arm = from_urdf(tmp_path, LIFT)
    assert arm.independent.tolist() == [True, False, True]
    q = arm.complete(np.array([[0.2, np.nan, 0.0], [0.5, np.nan, 0.0]]))
    np.testing.assert_allclose(q[:, 1], [0.3, 0.6])
    np.testing.assert_allclose(evaluate(arm, q).position[-1][:, 2], [0.9, 1.5], atol=1e-12)
    # one drive lifts both stages, and bears what hangs on them twice
    np.testing.assert_allclose(arm.drive_torques(np.array([[-10.0, -10.0, 0.0]]))[0, 0], -20.0)


@pytest.mark.parametrize("kind", ["track", "gantry"])
def test_exports_are_the_arm_again(tmp_path, kind):
    arm = track(tmp_path) if kind == "track" else from_urdf(tmp_path, GANTRY)
    q = np.random.default_rng(3).uniform(-1.0, 1.0, (8, arm.n))
    there = evaluate(arm, q)
    (tmp_path / "out.urdf").write_text(urdf(arm))
    back = arm_from_urdf(tmp_path / "out.urdf")
    assert back.slides.tolist() == arm.slides.tolist()
    np.testing.assert_allclose(back.q_max, arm.q_max)
    np.testing.assert_allclose(evaluate(back, q).position[-1], there.position[-1], atol=1e-12)
    for convention in ("standard", "modified"):
        rows = dh_rows(arm, convention)
        poses = flange_poses(rows, q)
        np.testing.assert_allclose(poses[:, :3, 3], there.position[-1], rtol=0, atol=1e-9)
        (tmp_path / "rows.toml").write_text(to_toml(rows, arm, "again"))
        again = load_arm("rows.toml", tmp_path)
        assert again.units == arm.units
        np.testing.assert_allclose(evaluate(again, q).position[-1], there.position[-1], atol=1e-9)
        np.testing.assert_allclose(again.torque_max, arm.torque_max)


@refusals("slides")
def test_a_wrong_slide_is_refused(case, given, tmp_path):
    refuses(case, lambda: track(tmp_path, given))


def test_an_effect_of_slides_needs_one():
    cell = cell_from_config(CellConfig.model_validate({"robot": {"model": "ur10e"}}))
    states = hc.States(q=np.zeros((2, 6)), wrench=np.zeros((2, 6)))
    with pytest.raises(InputError, match="guide_error: no joint of ur10e slides"):
        installed().make("guide_error", cell, states)


def test_joints_that_turn_and_slide_share_no_compliance(tmp_path):
    track(tmp_path)
    cell = cell_from_config(track_config(), tmp_path)
    states = hc.States(q=np.zeros((2, 7)), wrench=np.zeros((2, 6)))
    units = [p.unit for p in installed().make("joint_compliance", cell, states).parameters]
    assert units == ["m/N", *("rad/(N·m)",) * 6]
    with pytest.raises(InputError, match="joints 1-2 turn and slide, and share a parameter in rad"):
        _ = installed().make("joint_compliance", cell, states, {"joints": "1-2"}).parameters


# --- campaigns ------------------------------------------------------------------------------


def track_config(**more):
    return CellConfig.model_validate(
        {
            "robot": {"model": "track.toml"},
            "tool": {
                "target_m": [0.06, 0.02, 0.12], "load_point_m": [0.06, 0.0, 0.1],
                "mass_kg": 0.3, "com_m": [0.01, 0.0, 0.04],
            },
            "repeatability": {"joint_std_rad": 1e-5},
            "loads": [{"name": "10kg", "mass_kg": 10.0},
                      {"name": "pull", "force_N": [300.0, 60.0, 0.0]}],
            "planning": {"readings": "absolute"},
            **more,
        }
    )  # fmt: skip


def spread_plan(arm, poses):
    """Poses spread over the travel and over what the joints turn."""
    rng = np.random.default_rng(8)
    low, high = arm.usual_range
    q = rng.uniform(0.6 * low, 0.6 * high, (poses, arm.n))
    q[:, 0] = rng.permutation(np.linspace(low[0], high[0], poses))
    names = tuple(f"p{k}" for k in range(poses))
    steps = tuple(Step(p, load, 0) for load in ("none", "10kg", "pull") for p in names)
    return Plan(names, q, steps)


def campaign(folder, hidden, seed, poses=36):
    arm = track(folder)
    config = track_config(simulation={"strength_sigma": 3.0})
    plan = spread_plan(arm, poses)
    case = case_of_plan(config, plan, hidden, seed, installed(), folder)
    return simulate_plan(case, plan, [seed, 1]), cell_from_config(config, folder)


SEEDS = [1, *(pytest.param(k, marks=pytest.mark.long) for k in (2, 3, 4))]


@pytest.mark.parametrize("seed", SEEDS)
def test_a_hidden_error_of_the_rail_is_found_and_measured(tmp_path, seed):
    r, cell = campaign(tmp_path, "guide_error", seed)
    path = hc.refine(hc.baseline(cell, r.readings), r.readings, readings="absolute")
    assert path.verdict == "adequate"
    assert path.fit.model.named == ("base_frame", "joint_compliance", "guide_error")
    assert path.fit.variance_factor == pytest.approx(1.0, abs=0.25)
    guide = [p for p in path.fit.parameters if p.name.startswith("guide_error.j1.")]
    assert len(guide) == 19
    assert {p.unit for p in guide} == {"m", "rad"}
    off = np.array([(p.value - r.world.truth[p.name]) / p.std for p in guide])
    # 19 standard normal numbers: chi² beyond 43.8, or any beyond 4.2, is rarer than 1 in 1000
    assert np.sum(off**2) < 43.8
    assert np.abs(off).max() < 4.2
    # poses left out are predicted as well as the noise allows
    assert path.fit.holdout.rms_sigma < 1.3


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_errors_of_three_guides_of_a_gantry_are_found_and_measured(tmp_path, seed):
    arm = from_urdf(tmp_path, GANTRY)
    config = track_config(
        robot={"model": "arm.urdf"},
        simulation={"strength_sigma": 3.0},
        loads=[{"name": "10kg", "mass_kg": 10.0}, {"name": "pull", "force_N": [300.0, 200.0, 0.0]}],
    )
    plan = spread_plan(arm, 60)
    case = case_of_plan(config, plan, "guide_error", seed, installed(), tmp_path)
    r, cell = simulate_plan(case, plan, [seed, 1]), cell_from_config(config, tmp_path)
    path = hc.refine(hc.baseline(cell, r.readings), r.readings, readings="absolute")
    assert path.verdict == "adequate"
    assert path.fit.model.named == ("base_frame", "joint_compliance", "guide_error")
    guide_errors = [
        p for p in path.fit.parameters if p.name.startswith("guide_error") and p.identifiable
    ]
    assert len(guide_errors) > 20
    off = np.array([(p.value - r.world.truth[p.name]) / p.std for p in guide_errors])
    # shrunk estimates of one family lie in their bands as often as normal numbers do
    assert np.sqrt(np.mean(off**2)) < 1.6
    assert np.abs(off).max() < 4.2
    assert path.fit.holdout.rms_sigma < 1.3


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_of_a_good_rail_nothing_is_named(tmp_path, seed):
    r, cell = campaign(tmp_path, "nothing", seed)
    path = hc.refine(hc.baseline(cell, r.readings), r.readings, readings="absolute")
    assert path.verdict == "adequate"
    assert path.fit.model.named == ("base_frame", "joint_compliance")
    slide = next(p for p in path.fit.parameters if p.name == "joint_compliance.j1")
    assert slide.unit == "m/N"
    true = r.world.truth["joint_compliance.j1"]
    assert abs(slide.value - true) < 4 * slide.std
    assert slide.std < true  # a pull of 300 N along a drive of 25 N/µm


def test_a_table_of_a_rail_comes_back_and_is_checked(tmp_path):
    r, cell = campaign(tmp_path, "nothing", 1, 6)
    write_table(r.readings, tmp_path / "t.csv", units=cell.arm.units)
    with (tmp_path / "t.csv").open() as file:
        header = next(csv.reader(file))
    assert header[3:10] == ["q1_m", *(f"q{k}_rad" for k in range(2, 8))]
    back = read_table(tmp_path / "t.csv", cell.arm, None)
    np.testing.assert_array_equal(back.states.q, r.readings.states.q)
    text = (tmp_path / "t.csv").read_text()
    (tmp_path / "rad.csv").write_text(text.replace("q1_m", "q1_rad"))
    with pytest.raises(InputError, match="unknown column 'q1_rad'; this joint slides: 'q1_m'"):
        read_table(tmp_path / "rad.csv", cell.arm, None)
    q = r.readings.states.q * np.array([1000.0, *[1.0] * 6])
    far = replace(r.readings, states=replace(r.readings.states, q=q))
    write_table(far, tmp_path / "mm.csv", units=cell.arm.units)
    with pytest.raises(InputError, match=r"m is beyond the limits of track .* 0 to 3 m \(looks li"):
        read_table(tmp_path / "mm.csv", cell.arm, None)


@pytest.mark.long
def test_a_foreign_table_with_a_rail_goes_through_the_commands(tmp_path, capsys):
    """From a table in mm and degrees to corrected joint values, by the commands alone."""
    r, _ = campaign(tmp_path, "guide_error", 5, 30)
    their_table(tmp_path, r, ["E1 mm", *ARM_AXES], ("none", "10kg"))
    (tmp_path / "map.toml").write_text(
        """pose.column = "pose"
[joints]
columns = ["E1 mm", "A1", "A2", "A3", "A4", "A5", "A6"]
unit = "deg"
slide_unit = "mm"
[position]
columns = ["X", "Y", "Z"]
unit = "mm"
[hung_mass]
column = "weight"
"""
    )
    (tmp_path / "cell.toml").write_text(
        """[robot]
model = "track.toml"
[tool]
target_m = [0.06, 0.02, 0.12]
load_point_m = [0.06, 0.0, 0.1]
mass_kg = 0.3
com_m = [0.01, 0.0, 0.04]
[repeatability]
joint_std_rad = 1e-5
"""
    )
    run = tmp_path / "run.hilcal"
    ok(capsys, "import", tmp_path / "theirs.csv", "--config", tmp_path / "cell.toml",
       "--format", tmp_path / "map.toml", "-o", run)  # fmt: skip
    document = ok(capsys, "refine", run, "--readings", "absolute", "--json").document
    assert document["verdict"] == "adequate"
    assert "guide_error" in document["revisions"][-1]["model"]
    points = tmp_path / "points.csv"
    points.write_text(
        "pose,q1_mm,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,q7_deg\na,1500,0,-60,80,-90,-70,5\n"
    )
    out = ok(capsys, "compensate", run, points, "-o", tmp_path / "q.csv", "--json").document
    (point,) = out["points"]
    assert abs(point["q_corrected"][0] - 1.5) < 5e-3
    assert "1 point compensated" in ok(capsys, "compensate", run, points).out
    header = (tmp_path / "q.csv").read_text().splitlines()[0]
    assert header.startswith("pose,q1_m,q2_rad")
    ok(capsys, "report", run, "-o", tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "Joint values that were measured" in page
    assert "Joint values outside of the ranges" in page
    assert "joint 1 travel" in page
    ok(capsys, "export", run, "--urdf", tmp_path / "corrected.urdf")
    assert arm_from_urdf(tmp_path / "corrected.urdf").slides[0]
    points.write_text("pose,q1_m,q2_rad\na,1,0\n")
    said = refused(capsys, 2, "compensate", run, points)
    assert "column 'q3_rad' is missing from its group" in said


ARM_AXES = [f"A{k}" for k in range(1, 7)]
ALL_AXES = [f"J{k}" for k in range(1, 8)]


def their_table(folder, r, header, loads=("none",), mirrored=False):
    """Positions and travel in mm, perhaps counted backwards; joints in degrees; weights, if any."""
    s, weight = r.readings, ["weight"] * (len(loads) > 1)
    with (folder / "theirs.csv").open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(["pose", *header, "X", "Y", "Z", *weight])
        for k, load in enumerate(s.load_names[number] for number in s.load):
            if load not in loads:
                continue
            q, kg = s.states.q[k], [10.0 * (load != "none") for _ in weight]
            travel = 3.0 - q[0] if mirrored else q[0]
            figures = [1e3 * travel, *np.degrees(q[1:]), *(1e3 * s.value[k]), *kg]
            out.writerow([s.pose_names[s.pose[k]], *(f"{x:.6f}" for x in figures)])
    return folder / "theirs.csv"


def plain_table(folder, header, mirrored=False):
    cell = '[robot]\nmodel = "track.toml"\n[tool]\ntarget_m = [0.06, 0.02, 0.12]\n'
    (folder / "cell.toml").write_text(cell)
    return their_table(folder, campaign(folder, "nothing", 2, 24)[0], header, mirrored=mirrored)


@pytest.mark.parametrize("header", [["E1", *ARM_AXES], ["Track [mm]", *ARM_AXES], ALL_AXES])
def test_a_preview_sees_the_travel_in_mm(tmp_path, capsys, header):
    """Also that of an external axis, which controllers name apart from the arm's."""
    table = plain_table(tmp_path, header)
    cell, run = tmp_path / "cell.toml", tmp_path / "run.hilcal"
    mapping = tmp_path / "m.toml"
    ok(capsys, "import", table, "--config", cell, "--preview", "-o", mapping)
    assert 'slide_unit = "mm"' in mapping.read_text()
    ok(capsys, "import", table, "--config", cell, "--format", mapping, "-o", run)
    with hc.Campaign.open(run) as campaign_:
        q = campaign_.readings.states.q
    assert 2.9 < np.ptp(q[:, 0]) <= 3.0
    assert np.abs(q[:, 1:]).max() < 2 * np.pi


def test_a_travel_that_is_counted_backwards_is_named(tmp_path, capsys):
    table = plain_table(tmp_path, ALL_AXES, mirrored=True)
    cell, run = tmp_path / "cell.toml", tmp_path / "run.hilcal"
    mapping = tmp_path / "m.toml"
    ok(capsys, "import", table, "--config", cell, "--preview", "-o", mapping)
    said = ok(capsys, "import", table, "--config", cell, "--format", mapping, "-o", run)
    words = " ".join((said.out + said.err).split())
    assert "joint_sign = [-1, 1, 1, 1, 1, 1, 1]" in words
