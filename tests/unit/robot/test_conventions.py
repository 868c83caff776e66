"""Signs, zeros and couplings of a controller; modified DH tables; URDFs that lack something."""

import numpy as np
import pinocchio as pin
import pytest

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.errors import InputError
from hilcal.robot.catalogue import load_arm
from hilcal.robot.chain import drive_jacobian, evaluate
from hilcal.robot.scene import pinocchio_model
from hilcal.robot.urdf import arm_from_urdf

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
    np.testing.assert_allclose(b.position[-1], a.position[-1], atol=1e-12)
    np.testing.assert_allclose(b.rotation[-1], a.rotation[-1], atol=1e-12)
    np.testing.assert_allclose(b.com, a.com, atol=1e-12)


def test_jacobian_by_the_controllers_values_agrees_with_differences():
    arm, q, step = described(**KEYS), np.random.default_rng(1).uniform(-2, 2, (3, 6)), 1e-6
    chain = evaluate(arm, q)
    found = drive_jacobian(arm, chain, chain.position[-1])[:, :3]
    for j in range(6):
        ahead, back = (evaluate(arm, q + s * np.eye(6)[j]).position[-1] for s in (step, -step))
        np.testing.assert_allclose(found[:, :, j], (ahead - back) / (2 * step), atol=1e-8)


def test_pinocchio_agrees_with_signs_and_zeros():
    arm, q = described(joint_sign=SIGN, joint_offset_deg=OFFSET), np.array([0.1, 1, 0.3, 2, 1, -1])
    assert arm.coupling is None
    model = pinocchio_model(arm)
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    np.testing.assert_allclose(
        data.oMf[model.nframes - 1].translation, evaluate(arm, q[None]).position[-1][0], atol=1e-12
    )


def test_an_arm_without_these_keys_is_the_catalogues():
    np.testing.assert_array_equal(described().links, load_arm("ur10e").links)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"joint_sign": [1, 1, 1]}, "joint_sign has 3 values; ur10e has 6 joints"),
        ({"joint_sign": [1, 1, 1, 2, 1, 1]}, "valid: 1 and −1"),
        ({"joint_offset_deg": [0.0]}, "joint_offset_deg has 1 values"),
        ({"joint_coupling": [{"joint": 7, "follows": 2}]}, "names joint 7; ur10e has joints 1"),
        ({"joint_coupling": [{"joint": 2, "follows": 2}]}, "follows itself"),
    ],
)
def test_bad_conventions_are_refused(keys, words):
    with pytest.raises((InputError, ValueError), match=words):
        described(**keys)


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
    return np.array(
        [
            [ct, -st, 0, a],
            [st * ca, ct * ca, -sa, -sa * d],
            [st * sa, ct * sa, ca, ca * d],
            [0, 0, 0, 1],
        ]
    )


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
    np.testing.assert_allclose(chain.position[-1][0], at[:3, 3], atol=1e-12)
    np.testing.assert_allclose(chain.rotation[-1][0], at[:3, :3], atol=1e-12)
    np.testing.assert_allclose(chain.com[:, 0], coms, atol=1e-12)


URDF = """<robot name="r"><link name="base"/><link name="a"/><link name="b"/>
<joint name="j1" type="{kind}"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="0" upper="0" effort="1" velocity="1"/></joint>
<joint name="j2" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.5 0 0"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def urdf(tmp_path, kind="revolute"):
    path = tmp_path / "r.urdf"
    path.write_text(URDF.format(kind=kind))
    return path


def test_a_urdf_says_what_it_lacks(tmp_path):
    arm = arm_from_urdf(urdf(tmp_path))
    assert len(arm.notes) == 2
    assert "no masses" in arm.notes[0]
    assert "j1: ±360° is assumed" in arm.notes[1]
    np.testing.assert_allclose(arm.q_max, [2 * np.pi, 1.0])


def test_a_rail_without_ends_is_refused_by_name(tmp_path):
    with pytest.raises(InputError, match=r'prismatic joint "j1" has no <limit'):
        arm_from_urdf(urdf(tmp_path, "prismatic"))
