"""What is handed over says the same at the other end: random arms, models, loads and branches."""

import json
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import hilcal as hc
from hilcal.calibration.calibration import Calibration
from hilcal.calibration.compiled import Compiled, compiled
from hilcal.calibration.dh_table import CONVENTIONS, dh_rows, flange_poses, to_toml
from hilcal.calibration.handover import ur_kinematics, urdf
from hilcal.calibration.measured import MeasuredRanges
from hilcal.calibration.scatter import Scatter
from hilcal.calibration.storage import from_json, to_json
from hilcal.effects.protocol import Columns, Parameter
from hilcal.identification.registration.robot_frames import state_with_every_column
from hilcal.model.model import Model
from hilcal.robot import se3
from hilcal.robot.catalogue import load_arm, robot_names
from hilcal.robot.chain import evaluate, joint_jacobian
from tests.support.campaigns import cell_of
from tests.unit.calibration.other_eyes import by_pinocchio, by_ur, flanges, urdf_model

ROUND = settings(max_examples=10, deadline=None, derandomize=True)
SEEDS = st.integers(0, 2**32 - 1)
ARMS = st.sampled_from([name for name in robot_names() if name.startswith("ur")])
NM = 1e-9
EFFECTS = [e.name for e in hc.installed().effects if e.name != "guide_error"]


def moved_arm(name, seed, size):
    """An arm of the catalogue with links that are displaced and turned."""
    rng, arm = np.random.default_rng(seed), load_arm(name)
    moved = se3.matrix(*se3.exp(size * rng.standard_normal((arm.n + 1, 6))))
    return replace(arm, links=arm.links @ moved)


def joints(seed, count=10):
    return np.random.default_rng(seed).uniform(-3, 3, (count, 6))


@ROUND
@given(ARMS, SEEDS, st.sampled_from([0.0, 1e-6, 1e-3, 0.3]))
def test_pinocchio_has_the_urdf_s_flange_to_a_nanometre(name, seed, size):
    arm, q = moved_arm(name, seed, size), joints(seed)
    made = by_pinocchio(urdf_model(urdf(arm)), q)
    np.testing.assert_allclose(made, flanges(arm, q), atol=NM)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-8, np.pi / 2 - 1e-5])
def test_a_urdf_is_exact_where_roll_and_yaw_are_one(pitch):
    arm = load_arm("ur5e")
    links = arm.links.copy()
    links[2, :3, :3] = Rotation.from_euler("xyz", [0.4, pitch, -1.1]).as_matrix()
    arm, q = replace(arm, links=links), joints(1)
    with warnings.catch_warnings(action="error"):
        model = urdf_model(urdf(arm))
    np.testing.assert_allclose(by_pinocchio(model, q), flanges(arm, q), atol=NM)


@ROUND
@given(ARMS, SEEDS, st.sampled_from([0.0, 1e-9, 1e-3, 0.03]))
def test_ur_s_file_and_its_tool_are_the_arm_to_a_nanometre(name, seed, size):
    arm, q = moved_arm(name, seed, size), joints(seed)
    text, rest = ur_kinematics(load_arm(name), arm, "by a test")
    np.testing.assert_allclose(by_ur(text, q) @ rest, flanges(arm, q), atol=NM)
    assert abs(rest[2, 3]) < 1e-15  # what can be moved before the last joint is there
    assert abs(rest[1, 0] - rest[0, 1]) < 1e-12


@ROUND
@given(ARMS, SEEDS, st.sampled_from([0.0, 1e-12, 1e-7, 1e-3, 0.3]), st.sampled_from(CONVENTIONS))
def test_a_dh_table_is_the_arm_to_what_it_states(tmp_path_factory, name, seed, size, convention):
    arm, q = moved_arm(name, seed, size), joints(seed)
    rows, there = dh_rows(arm, convention), flanges(arm, q)
    assert rows.disagreement < NM
    np.testing.assert_allclose(flange_poses(rows, q), there, atol=NM)
    alone = flange_poses(rows, q, whole=False)
    off = np.linalg.norm((alone - there)[:, :3, 3], axis=1)
    assert off.max() <= 1.2 * rows.table_moves + NM
    path = tmp_path_factory.mktemp("dh") / "arm.toml"
    path.write_text(to_toml(rows, arm, "made"), encoding="utf-8")
    again = load_arm(str(path))
    np.testing.assert_allclose(flanges(again, q), there, atol=NM)
    for part in ("com", "position"):
        a, b = (getattr(evaluate(x, q), part) for x in (again, arm))
        np.testing.assert_allclose(a[-1], b[-1], atol=NM)
    np.testing.assert_allclose(evaluate(again, q).com, evaluate(arm, q).com, atol=NM)
    np.testing.assert_allclose(again.q_max, arm.q_max, rtol=1e-12)
    np.testing.assert_array_equal(again.torque_max, arm.torque_max)


@cache
def model_of(names, target_known):
    cell, known = cell_of(target_known=target_known), hc.installed()
    return Model(
        cell, tuple(known.make(name, cell, state_with_every_column(cell)) for name in names), known
    )


def random_calibration(names, seed):
    """A model with parameters of ordinary size, which nobody fitted."""
    rng = np.random.default_rng(seed)
    model = model_of(names, "target_offset" not in names)
    scale = np.array([p.scale for e in model.effects for p in e.parameters])
    theta = 0.3 * scale * rng.standard_normal(len(scale))
    soft = [p.unit.startswith("rad/(N") for e in model.effects for p in e.parameters]
    theta = np.where(soft, np.abs(theta), theta)
    return Calibration(
        model=model,
        theta=theta,
        mode="absolute",
        root=1e-2 * np.diag(scale),
        misfit=1e-12,
        scatter=Scatter(np.full(6, 1e-5), 0.0, "stated"),
        measured=MeasuredRanges((), 1.0),
        loads={"5kg": np.array([0.0, 0.0, -49.0, 0.0, 0.0, 0.0])},
        source={"campaign": "made"},
    )


def surroundings(rng, count):
    return {
        "time": rng.uniform(0, 3600, count),
        "load_time": rng.uniform(0, 600, count),
        "air_temperature": rng.uniform(18, 26, count),
        "joint_temperature": rng.uniform(20, 40, (count, 6)),
        "approach": np.sign(rng.standard_normal((count, 6))),
    }


def regular(c, q):
    """Joint values away from singular poses, in whatever branch they are."""
    chain, arm = evaluate(c.model.cell.arm, q), c.model.cell.arm
    jacobian = joint_jacobian(chain, chain.position[-1])
    jacobian[:, :3] /= arm.reach
    values = np.linalg.svd(jacobian, compute_uv=False)
    return q[values[:, -1] > 0.02 * values[:, 0]]


@pytest.mark.parametrize("effect", EFFECTS)
def test_predicting_what_was_inverted_is_the_target_to_a_nanometre(effect):
    names = tuple(dict.fromkeys(("base_frame", "joint_compliance", effect)))
    seed = EFFECTS.index(effect)
    c, rng = random_calibration(names, seed), np.random.default_rng(seed)
    q = regular(c, rng.uniform(-2.8, 2.8, (40, 6)))
    wrench = np.hstack([rng.uniform(-80, 80, (len(q), 3)), rng.uniform(-5, 5, (len(q), 3))])
    recorded = surroundings(rng, len(q))
    # The compiled form has joints that err by their own angle only.
    assert isinstance(compiled(c._tracked, "absolute"), Compiled) == (effect != "remainder")
    k = c.compensate(q, wrench, recorded=recorded, std=False)
    assert k.inverse.solved.all()
    again = c.predict(k.q, wrench, recorded=recorded, std=False)
    nominal = evaluate(c.model.cell.arm, q)
    wanted = nominal.point(c.tool_pose()[:3, 3])
    np.testing.assert_allclose(again.position, wanted, atol=NM)
    turn = nominal.rotation[-1] @ c.tool_pose()[:3, :3]
    np.testing.assert_allclose(again.rotation, turn, atol=NM)
    assert np.abs(k.q - q).max() < 0.5  # the branch is that of the given joints


@pytest.mark.parametrize("effect", ["transmission_error", "periodic_joint_compliance"])
def test_a_wrist_that_has_turned_more_than_once_is_inverted_as_exactly(effect):
    c, rng = (
        random_calibration(("base_frame", "joint_compliance", effect), 1),
        np.random.default_rng(1),
    )
    q = regular(c, rng.uniform(-2.8, 2.8, (40, 6)))
    wrench = np.hstack([rng.uniform(-80, 80, (len(q), 3)), rng.uniform(-5, 5, (len(q), 3))])
    turns = 4 * np.pi * np.eye(6)[5]  # two turns of the last joint
    near, far = (c.compensate(x, wrench, std=False).q for x in (q, q + turns))
    np.testing.assert_allclose(far - turns, near, atol=NM)


@pytest.mark.long
@ROUND
@given(SEEDS, st.lists(st.sampled_from(EFFECTS), min_size=1, max_size=4, unique=True))
def test_a_calibration_file_says_the_same_in_every_bit(seed, names):
    c, rng = random_calibration(tuple(names), seed), np.random.default_rng(seed)
    again = from_json(json.loads(json.dumps(to_json(c), allow_nan=False)))
    q = regular(c, rng.uniform(-2.8, 2.8, (12, 6)))
    wrench = np.hstack([rng.uniform(-80, 80, (len(q), 3)), np.zeros((len(q), 3))])
    recorded = surroundings(rng, len(q))
    a, b = (x.predict(q, wrench, recorded=recorded) for x in (c, again))
    np.testing.assert_array_equal(a.position, b.position)
    np.testing.assert_array_equal(a.rotation, b.rotation)
    np.testing.assert_allclose(a.std_m, b.std_m, rtol=1e-5)
    np.testing.assert_array_equal(c.loads["5kg"], again.loads["5kg"])
    a, b = (x.compensate(q, wrench, recorded=recorded, std=False) for x in (c, again))
    np.testing.assert_array_equal(a.q, b.q)


class Sagging(hc.Effect):
    """dq_2 = k cos(q_2 + q_3): an angle of two joints, which the kernel has no form for."""

    name = "sagging"
    summary = "dq_2 = k cos(q_2 + q_3)"
    plausible = 10.0

    @property
    def parameters(self):
        return (Parameter("k", "rad", 1e-4),)

    def columns(self, s):
        wave = np.cos(s.angle[:, 1] + s.angle[:, 2])
        return (Columns("dq", np.zeros(1, dtype=int), np.ones(1, dtype=int), wave[:, None]),)


def test_an_effect_without_a_compiled_form_is_named_and_inverted_all_the_same():
    c = random_calibration(("base_frame", "joint_compliance"), 3)
    model = replace(
        c.model,
        effects=(*c.model.effects, Sagging(c.model.cell, state_with_every_column(c.model.cell))),
    )
    with_sagging = replace(
        c, model=model, theta=np.append(c.theta, 2e-3), root=np.zeros((model.size, 1))
    )
    assert c.without_kernel() == ()
    assert with_sagging.without_kernel() == ("sagging",)
    q = regular(c, joints(5))
    k = with_sagging.compensate(q, std=False)
    wanted = evaluate(c.model.cell.arm, q).point(c.tool_pose()[:3, 3])
    np.testing.assert_allclose(with_sagging.predict(k.q, std=False).position, wanted, atol=NM)
