"""A joint of a URDF that follows another: a coupling of the arm, against Pinocchio's own mimic."""

import csv
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.config.sections import Conventions, Coupling
from hilcal.design.feasible import Space, draw
from hilcal.errors import InputError
from hilcal.model.model import Model
from hilcal.readings.covariance import TrackerNoise
from hilcal.readings.readings import States
from hilcal.robot.chain import evaluate
from hilcal.robot.conventions import as_counted
from hilcal.robot.urdf import arm_from_urdf
from hilcal.tables.table import read_table
from tests.support.effect_cases import make

JOINT = """<joint name="j{k}" type="revolute"><parent link="l{k}"/><child link="l{next}"/>
<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>
<limit lower="-3.1" upper="3.1" effort="100" velocity="1"/>{mimic}</joint>
<link name="l{next}"><inertial><origin xyz="0.1 0.02 0.05"/><mass value="{mass}"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
NOISE = TrackerNoise(10e-6, 0.3e-6, 15e-6, 6e-6)
FIGURES = (
    ("0 0 0.3", "0 0 0", "0 0 1"),
    ("0.1 0 0.2", "0.2 0 0", "0 1 0"),
    ("0.5 0 0", "0 0.3 0", "0 1 0"),
    ("0.4 0 0.1", "0 0 0", "0 -1 0"),
    ("0.1 0 0", "0 0 0.4", "1 0 0"),
)
FOLLOWS = {3: '<mimic joint="j2" multiplier="-1" offset="0.3"/>', 4: '<mimic joint="j1"/>'}


def urdf(tmp_path, follows=FOLLOWS):
    body = "".join(
        JOINT.format(k=k, next=k + 1, xyz=xyz, rpy=rpy, axis=axis, mass=5.0 / k,
                     mimic=follows.get(k, ""))
        for k, (xyz, rpy, axis) in enumerate(FIGURES, start=1)
    )  # fmt: skip
    path = tmp_path / "arm.urdf"
    path.write_text(f'<robot name="arm"><link name="l1"/>{body}</robot>')
    return path


def own_states(count=6):
    q = np.random.default_rng(3).uniform(-1.5, 1.5, (count, 5))
    q[:, [2, 3]] = np.nan  # have no value of their own
    return q


def test_it_stands_and_is_pulled_as_pinocchio_says(tmp_path):
    path, q = urdf(tmp_path), own_states()
    arm = arm_from_urdf(path)
    assert arm.own.tolist() == [True, True, False, False, True]
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
        place = data.oMf[model.getFrameId("l6")]
        np.testing.assert_allclose(s.chain.position[-1][k], place.translation, atol=1e-12)
        np.testing.assert_allclose(s.chain.rotation[-1][k], place.rotation, atol=1e-12)
        held = pin.computeGeneralizedGravity(model, data, at) * 9.80665 / 9.81
        np.testing.assert_allclose(-s.torque[k, [0, 1, 4]], held, atol=1e-9)
        assert not s.torque[k, [2, 3]].any()


def test_a_compliance_has_one_parameter_less_for_each(tmp_path):
    """What gives way is the motors: a joint without one cannot be told, nor does it move."""
    arm, q = arm_from_urdf(urdf(tmp_path)), own_states()
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
    arm, q = arm_from_urdf(urdf(tmp_path)), own_states()
    by = Conventions(joint_sign=(-1, 1, -1, 1, 1), joint_offset_deg=(10.0, -20.0, 5.0, 0.0, 30.0),
                     joint_coupling=(Coupling(joint=5, follows=1, factor=0.5),))  # fmt: skip
    counted = as_counted(arm, by)
    drawn = q * by.joint_sign + np.radians(by.joint_offset_deg)
    drawn[:, 4] += 0.5 * q[:, 0]
    drawn = arm.complete(drawn)
    a, b = evaluate(arm, drawn), evaluate(counted, counted.complete(q))
    np.testing.assert_allclose(b.position[-1], a.position[-1], atol=1e-12)
    np.testing.assert_allclose(b.rotation[-1], a.rotation[-1], atol=1e-12)
    back = counted.complete(q) * by.joint_sign + np.radians(by.joint_offset_deg)
    np.testing.assert_allclose(back[:, [2, 3]], drawn[:, [2, 3]], atol=1e-12)


@pytest.mark.parametrize(
    ("follows", "words"),
    [
        ({3: '<mimic joint="j9"/>'}, 'mimics joint "j9", which is not there.*valid: .*j1, j2, j4'),
        ({3: '<mimic joint="j2"/>', 4: '<mimic joint="j3"/>'}, '"j3", which follows another'),
        ({3: '<mimic joint="j3"/>'}, '"j3" of the arm mimics joint "j3", which follows another'),
        ({3: '<mimic joint="j2" multiplier="x"/>'}, "multiplier value .x. is not a valid float"),
        ({3: '<mimic joint="j2" offset="inf"/>'}, "offset value .inf. is not"),
    ],
)
def test_what_follows_nothing_is_refused(tmp_path, follows, words):
    with pytest.raises(InputError, match=words) as caught:
        arm_from_urdf(urdf(tmp_path, follows))
    assert "\n" not in str(caught.value)


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
    arm = arm_from_urdf(urdf(tmp_path))
    for columns in ((1, 2, 5), (1, 2, 3, 4, 5)):
        path, q = table(tmp_path, arm, columns)
        found = read_table(path, arm, NOISE)
        np.testing.assert_allclose(found.states.q, q, atol=1e-6)
    path, _ = table(tmp_path, arm, (1, 2, 3, 4, 5), change=0.01)
    with pytest.raises(InputError, match=r"q3_rad.*by the arm's description j3 follows to"):
        read_table(path, arm, NOISE)
    path, _ = table(tmp_path, arm, (1, 3, 4, 5))
    with pytest.raises(InputError, match="column 'q2_rad' is missing"):
        read_table(path, arm, NOISE)


def test_planned_poses_are_poses_of_the_arm(tmp_path):
    urdf(tmp_path)
    config = CellConfig.model_validate({"robot": {"model": "arm.urdf"}})
    cell = cell_from_config(config, tmp_path)
    drawn = draw(Space(cell, config), 20, np.random.default_rng(0))
    np.testing.assert_allclose(cell.arm.complete(drawn.q), drawn.q, atol=1e-12)
