"""Signs, zeros and couplings of a controller; modified DH tables; URDFs that lack something."""

import csv
import json
from dataclasses import replace

import numpy as np
import pinocchio as pin

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.config.sections import Conventions, Coupling
from hilcal.design.feasible import FeasibleSpace, draw_poses
from hilcal.model.model import Model
from hilcal.readings.covariance import TrackerNoise
from hilcal.readings.readings import States
from hilcal.robot.arm import with_controller_conventions
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import drive_jacobian, evaluate
from hilcal.robot.urdf import arm_from_urdf
from tests.support.arm_cases import flange_at, same_flange
from tests.support.effect_cases import make
from tests.support.readings_cases import read_table
from tests.support.refusals import refusal, refusals, refuses
from tests.support.serial_urdf import serial_urdf

SIGN = [1, -1, 1, 1, -1, 1]
OFFSET = [0.0, 90.0, -30.0, 0.0, 180.0, 5.0]
COUPLED = [{"joint": 3, "follows": 2, "factor": 1.0}, {"joint": 6, "follows": 5, "factor": -0.5}]
KEYS = {"joint_sign": SIGN, "joint_offset_deg": OFFSET, "joint_coupling": COUPLED}


def described(**robot):
    return cell_from_config(CellConfig.model_validate({"robot": {"model": "ur10e", **robot}})).arm


def turned(q):
    """Angles of the arm as drawn, written out joint by joint."""
    out = q * SIGN + np.radians(OFFSET)
    out[:, 2] += q[:, 1]
    out[:, 5] -= 0.5 * q[:, 4]
    return out


def test_flange_and_masses_are_those_of_the_drawn_arm_at_the_turned_angles():
    q = np.random.default_rng(0).uniform(-2, 2, (20, 6))
    drawn, counted = load_arm("ur10e"), described(**KEYS)
    a, b = evaluate(drawn, turned(q)), evaluate(counted, q)
    same_flange(b, a)
    np.testing.assert_allclose(b.com, a.com, atol=1e-12)


def test_jacobian_by_the_controllers_values_agrees_with_differences():
    arm, q, step = described(**KEYS), np.random.default_rng(1).uniform(-2, 2, (3, 6)), 1e-6
    chain = evaluate(arm, q)
    derivative = drive_jacobian(arm, chain, chain.position[-1])[:, :3]
    for j in range(6):
        ahead, back = (evaluate(arm, q + s * np.eye(6)[j]).position[-1] for s in (step, -step))
        np.testing.assert_allclose(derivative[:, :, j], (ahead - back) / (2 * step), atol=1e-8)


@refusals("conventions")
def test_bad_conventions_are_refused(case, given):
    refuses(case, lambda: described(**json.loads(given)))


ROW = """
[[joints]]
name = "{name}"
a_m = {a}
d_m = {d}
alpha_deg = {alpha}
offset_deg = {offset}
mass_kg = 1.0
com_m = [0.1, 0.2, 0.3]
q_min_deg = -360.0
q_max_deg = 360.0
torque_max_Nm = 100.0
"""
HEAD = 'title = "t"\npayload_kg = 5.0\nsource = "s"\nconvention = "modified"\n'


def craig(alpha, a, theta, d):
    """(4, 4) of a modified row, element by element (Craig, equation 3.6)."""
    ct, st, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
    y, z = [st * ca, ct * ca, -sa, -sa * d], [st * sa, ct * sa, ca, ca * d]
    return np.array([[ct, -st, 0, a], y, z, [0, 0, 0, 1]])


def test_modified_rows_are_those_of_craig(tmp_path):
    rows = [(10.0, 0.1, 20.0, 0.3), (-90.0, 0.4, 0.0, 0.1), (35.0, -0.2, -15.0, 0.2)]
    text = HEAD + "".join(
        ROW.format(name=f"j{k}", alpha=al, a=a, offset=o, d=d)
        for k, (al, a, o, d) in enumerate(rows)
    )
    (tmp_path / "m.toml").write_text(text)
    arm, q = load_arm("m.toml", tmp_path), np.array([0.3, -1.0, 0.7])
    at, coms = np.eye(4), []
    for (al, a, o, d), angle in zip(rows, q, strict=True):
        at = at @ craig(np.radians(al), a, angle + np.radians(o), d)
        coms.append((at @ [0.1, 0.2, 0.3, 1.0])[:3])
    chain = evaluate(arm, q[None])
    flange_at(chain, 0, at)
    np.testing.assert_allclose(chain.com[:, 0], coms, atol=1e-12)


def urdf(tmp_path, kind="revolute"):
    path = tmp_path / "r.urdf"
    last = {"xyz": "0.5 0 0", "axis": "0 1 0", "lower": -1, "upper": 1}
    path.write_text(serial_urdf([{"type": kind, "lower": 0, "upper": 0}, last]))
    return path


def test_a_urdf_says_what_it_lacks(tmp_path):
    arm = arm_from_urdf(urdf(tmp_path))
    assert len(arm.notes) == 2
    assert "no masses" in arm.notes[0]
    assert "j1: ±360° is assumed" in arm.notes[1]
    np.testing.assert_allclose(arm.q_max, [2 * np.pi, 1.0])


def test_a_urdf_whose_base_link_is_tilted_says_what_gravity_is(tmp_path):
    """As the one arm of two on a torso; about the vertical it may be turned."""
    mount = {"type": "fixed", "link": "left_base", "xyz": "0 0.2 1.2"}
    (tmp_path / "r.urdf").write_text(
        serial_urdf([{**mount, "rpy": "1.2 0 0.7"}, {"axis": "0 1 0"}, {"axis": "1 0 0"}])
    )
    assert not any("gravity" in note for note in arm_from_urdf(tmp_path / "r.urdf").notes)
    arm = arm_from_urdf(tmp_path / "r.urdf", base_link="left_base")
    assert arm.notes[-1] == (
        'r.urdf tilts link "left_base" by 68.8°: where z of its link "l0" is up, [robot] '
        "gravity_m_s2 = [0.0000, -9.1402, -3.5535]"
    )
    up = pin.buildModelFromXML((tmp_path / "r.urdf").read_text()).frames[2].placement.rotation[2]
    np.testing.assert_allclose(-9.80665 * up, [0.0, -9.1402, -3.5535], atol=1e-4)
    (tmp_path / "r.urdf").write_text(
        serial_urdf([{**mount, "rpy": "0 0 0.7"}, {"axis": "0 1 0"}, {"axis": "1 0 0"}])
    )
    notes = arm_from_urdf(tmp_path / "r.urdf", base_link="left_base").notes
    assert not any("gravity" in note for note in notes)


def test_a_rail_without_ends_is_refused_by_name(tmp_path):
    refusal(r'prismatic joint "j1" has no <limit', arm_from_urdf, urdf(tmp_path, "prismatic"))


NOISE = TrackerNoise(10e-6, 0.3e-6, 15e-6, 6e-6)
FIGURES = (
    ("0 0 0.3", "0 0 0", "0 0 1"),
    ("0.1 0 0.2", "0.2 0 0", "0 1 0"),
    ("0.5 0 0", "0 0.3 0", "0 1 0"),
    ("0.4 0 0.1", "0 0 0", "0 -1 0"),
    ("0.1 0 0", "0 0 0.4", "1 0 0"),
)
FOLLOWS = {3: '<mimic joint="j2" multiplier="-1" offset="0.3"/>', 4: '<mimic joint="j1"/>'}


def urdf_of_mimic(tmp_path, follows=FOLLOWS):
    path = tmp_path / "arm.urdf"
    rows = [
        {"xyz": xyz, "rpy": rpy, "axis": axis, "mass": 5.0 / k, "com": "0.1 0.02 0.05",
         "mimic": follows.get(k, "")}
        for k, (xyz, rpy, axis) in enumerate(FIGURES, start=1)
    ]  # fmt: skip
    path.write_text(serial_urdf(rows))
    return path


def own_states(count=6):
    q = np.random.default_rng(3).uniform(-1.5, 1.5, (count, 5))
    q[:, [2, 3]] = np.nan  # have no value of their own
    return q


def test_it_stands_and_is_pulled_as_pinocchio_says(tmp_path):
    path, q = urdf_of_mimic(tmp_path), own_states()
    arm = arm_from_urdf(path)
    assert arm.independent.tolist() == [True, True, False, False, True]
    full = arm.complete(q)
    np.testing.assert_allclose(full[:, 2], -q[:, 1] + 0.3)
    np.testing.assert_allclose(full[:, 3], q[:, 0])
    cell = replace(cell_from_config(CellConfig.model_validate({"robot": {"model": "ur10e"}})),
                   arm=arm, tool_mass=0.0)  # fmt: skip
    states = States(q=full, wrench=np.zeros((len(q), 6)))
    s = Model(cell, ()).predict(states, np.zeros(0)).situation
    model = pin.buildModelFromUrdf(str(path), mimic=True)
    assert model.nq == 3
    data = model.createData()
    for k in range(len(q)):
        at = q[k, [0, 1, 4]]
        pin.framesForwardKinematics(model, data, at)
        flange_at(s.chain, k, data.oMf[model.getFrameId("l5")].homogeneous)
        held = pin.computeGeneralizedGravity(model, data, at) * 9.80665 / 9.81
        np.testing.assert_allclose(-s.torque[k, [0, 1, 4]], held, atol=1e-9)
        assert not s.torque[k, [2, 3]].any()


def test_a_compliance_has_one_parameter_less_for_each(tmp_path):
    """What gives way is the motors: a joint without one cannot be told, nor does it move."""
    arm, q = arm_from_urdf(urdf_of_mimic(tmp_path)), own_states()
    cell = cell_from_config(CellConfig.model_validate({"robot": {"model": "ur10e"}}))
    cell = replace(cell, arm=arm)
    states = States(q=arm.complete(q), wrench=np.tile([0.0, 0, -50, 0, 0, 0], (len(q), 1)))
    model = Model(cell, (make("joint_compliance", cell, states),))
    soft = model.predict(states, np.full(5, 1e-5))
    jacobian = model.jacobian(soft, np.full(5, 1e-5), 3)
    moved = np.abs(jacobian).max(axis=(0, 1))
    assert not moved[[2, 3]].any()
    assert moved[[0, 1, 4]].min() > 0


def test_signs_and_zeros_of_the_controller_go_with_it(tmp_path):
    """The drawn arm at the drawn values, worked out joint by joint, stands at the same place."""
    arm, q = arm_from_urdf(urdf_of_mimic(tmp_path)), own_states()
    by = Conventions(joint_sign=(-1, 1, -1, 1, 1), joint_offset_deg=(10.0, -20.0, 5.0, 0.0, 30.0),
                     joint_coupling=(Coupling(joint=5, follows=1, factor=0.5),))  # fmt: skip
    counted = with_controller_conventions(arm, by)
    drawn = q * by.joint_sign + np.radians(by.joint_offset_deg)
    drawn[:, 4] += 0.5 * q[:, 0]
    drawn = arm.complete(drawn)
    a, b = evaluate(arm, drawn), evaluate(counted, counted.complete(q))
    same_flange(b, a)
    back = counted.complete(q) * by.joint_sign + np.radians(by.joint_offset_deg)
    np.testing.assert_allclose(back[:, [2, 3]], drawn[:, [2, 3]], atol=1e-12)


@refusals("mimics")
def test_what_follows_nothing_is_refused(case, given, tmp_path):
    rows = (line.split(maxsplit=1) for line in given.splitlines())
    path = urdf_of_mimic(tmp_path, {int(joint): follows for joint, follows in rows})
    refuses(case, lambda: arm_from_urdf(path), path)


def table(tmp_path, arm, columns, change=0.0):
    q = arm.complete(own_states())
    where = evaluate(arm, q).position[-1]
    with (tmp_path / "t.csv").open("w", newline="") as file:
        out = csv.writer(file)
        out.writerow(("pose", "load", *(f"q{k}_rad" for k in columns), "x_m", "y_m", "z_m"))
        for k, (angles, x) in enumerate(zip(q, where, strict=True)):
            given = [angles[c - 1] + (change if c == 3 else 0.0) for c in columns]
            out.writerow((f"p{k}", "none", *(f"{v:.6f}" for v in (*given, *x))))
    return tmp_path / "t.csv", q


def test_a_table_may_leave_its_column_out(tmp_path):
    arm = arm_from_urdf(urdf_of_mimic(tmp_path))
    for columns in ((1, 2, 5), (1, 2, 3, 4, 5)):
        path, q = table(tmp_path, arm, columns)
        readings = read_table(path, arm, NOISE)
        np.testing.assert_allclose(readings.states.q, q, atol=1e-6)
    path, _ = table(tmp_path, arm, (1, 2, 3, 4, 5), change=0.01)
    refusal(r"q3_rad.*by the arm's description j3 follows to", read_table, path, arm, NOISE)
    path, _ = table(tmp_path, arm, (1, 3, 4, 5))
    refusal("column 'q2_rad' is missing", read_table, path, arm, NOISE)


def test_planned_poses_are_poses_of_the_arm(tmp_path):
    urdf_of_mimic(tmp_path)
    config = CellConfig.model_validate({"robot": {"model": "arm.urdf"}})
    cell = cell_from_config(config, tmp_path)
    drawn = draw_poses(FeasibleSpace(cell), 20, np.random.default_rng(0))
    np.testing.assert_allclose(cell.arm.complete(drawn.q), drawn.q, atol=1e-12)
