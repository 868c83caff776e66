"""The model's equilibrium: that it is one, what its Jacobian is, and that batches are states."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize as so

from hilcal.effects.catalogue import installed
from hilcal.errors import CannotAnswerError
from hilcal.model.model import Model
from hilcal.readings.readings import States
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.chain import Deviation
from hilcal.robot.statics import Load, slot_wrenches
from tests.support.arm_cases import ODD, arm_of, cell_of, displacement

COUNT = 10
ALL = (
    *("base_frame", "target_offset", "encoder_offset", "link_geometry", "tracker_drift"),
    *("joint_compliance", "joint_stiffening", "joint_tilt_compliance", "base_compliance"),
    "load_point",
)


def states_of(arm, count=COUNT, load=1.0):
    rng = np.random.default_rng(11)
    return States(
        q=rng.uniform(-np.pi, np.pi, (count, arm.n)),
        wrench=load * rng.normal(size=(count, 6)) * [50, 50, 50, 5, 5, 5],
        time=np.arange(float(count)),
    )


def model_of(cell, states, names=ALL):
    return Model(cell, tuple(installed().make(name, cell, states) for name in names))


def ordinary(model, seed=12):
    """Parameters of ordinary magnitude; compliances are positive."""
    rng = np.random.default_rng(seed)
    values = []
    for e in model.effects:
        draw = rng.normal(size=len(e.parameters))
        size = np.array([p.scale for p in e.parameters])
        values.append(size * (np.abs(draw) if e.elastic else draw))
    return np.concatenate(values)


def case(name="ur10e", count=COUNT):
    arm = arm_of(name)
    states = states_of(arm, count)
    model = model_of(cell_of(arm), states)
    return model, states, ordinary(model)


def deviation_at(model, p, states, theta):
    """The effects evaluated anew at the configuration of a prediction."""
    cell, s = model.cell, p.situation
    shift = sum(
        (c.point for e, at in zip(model.effects, model.slices(), strict=True)
         if (c := e.load_change(theta[at])) is not None),
        np.zeros(3),
    )  # fmt: skip
    load = Load(states.wrench, cell.load_point + shift, cell.tool_mass, cell.tool_com, cell.gravity)
    s = replace(s, wrench=slot_wrenches(cell.arm, s.chain, load))
    parts = zip(model.effects, model.slices(), strict=True)
    return sum((e.deviation(theta[at], s) for e, at in parts), Deviation())


@pytest.mark.parametrize("name", ["ur10e", "ur3", ODD])
def test_effects_at_the_equilibrium_give_its_deviation(name):
    model, states, theta = case(name)
    p = model.predict(states, theta)
    again = deviation_at(model, p, states, theta)
    for field in ("dq", "twist", "base", "station", "target"):
        actual, expected = getattr(p.deviation, field), getattr(again, field)
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12)
    assert p.deviation.scale is None
    largest = np.abs(p.deviation.dq).max()
    assert largest > 1e-3  # the case is worth converging


def test_elastic_pendulum_hangs_where_its_torques_balance():
    # One horizontal joint of compliance c carries m g at a lever l: dq = c m g l cos(q + dq).
    turned, lever = [0, 0, 0, -np.pi / 2, 0, 0], [0.8, 0, 0, 0, 0, 0]
    arm = Arm(
        name="pendulum",
        links=np.array([displacement(t) for t in (turned, lever)]),
        masses=np.array([0.0]),
        coms=np.zeros((1, 3)),
        q_min=np.array([-np.pi]),
        q_max=np.array([np.pi]),
        torque_max=np.array([100.0]),
        payload=1.0,
        joint_names=("j1",),
        source="made up",
    )  # fmt: skip
    cell = replace(
        cell_of(arm, (0, 0, -10.0)), tool_mass=7.0, tool_com=np.zeros(3), registration=np.eye(4)
    )
    q = np.linspace(-2, 2, 9)
    states = States(q=q[:, None], wrench=np.zeros((9, 6)))
    model = model_of(cell, states, ("joint_compliance",))
    compliance = 1e-3
    p = model.predict(states, np.array([compliance]))
    for i in range(9):
        gap = lambda x, i=i: x - compliance * 7.0 * 10.0 * 0.8 * np.cos(q[i] + x)  # noqa: E731
        expected = so.brentq(gap, -1, 1, xtol=1e-15, rtol=1e-15)
        assert abs(p.deviation.dq[i, 0] - expected) < 1e-13
        height = -0.8 * np.sin(q[i] + expected)
        assert abs(p.situation.chain.position[-1, i, 2] - height) < 1e-12


def test_laws_see_the_joints_that_the_encoders_report():
    model, states, theta = case()
    off = 1e-2 * np.random.default_rng(13).normal(size=states.q.shape)
    reported = model.predict(replace(states, q=states.q + 1.0, q_actual=states.q + off), theta)
    meant = model.predict(replace(states, q=states.q + off), theta)
    np.testing.assert_array_equal(reported.observation.position, meant.observation.position)


@pytest.mark.parametrize("times", [3e3, 1e5, 1e8, 1e12])
def test_no_equilibrium_is_said_in_words(times):
    """Also where numbers would overflow: no effect is blamed for values that are not finite."""
    model, states, theta = case()
    with pytest.raises(CannotAnswerError, match=r"no static equilibrium.*joint_compliance"):
        model.predict(states, times * theta)


def everything(model, states, theta):
    """All that a prediction says, states first."""
    p = model.predict(states, theta)
    s = p.situation
    ordinary_size = [x.scale for e in model.effects for x in e.parameters]
    return {
        "position": p.observation.position,
        "rotation": p.observation.rotation,
        "axes": p.observation.axes,
        "dq": np.asarray(p.deviation.dq),
        "twist": np.asarray(p.deviation.twist),
        "elastic angle": 2e-5 * s.wrench,  # by an ordinary compliance
        "slots": np.swapaxes(s.chain.position, 0, 1),
        "slot_axes": np.swapaxes(s.chain.rotation, 0, 1),
        "jacobian": model.jacobian(p, theta, 6) * ordinary_size,
    }


def assert_all_close(a, b):
    for key, value in a.items():
        np.testing.assert_allclose(value, b[key], rtol=0, atol=1e-12, err_msg=key)


def test_one_state_at_a_time_gives_the_same_numbers():
    model, states, theta = case()
    together = everything(model, states, theta)
    for i in range(COUNT):
        alone = everything(model, states[i : i + 1], theta)
        assert_all_close(alone, {k: v[i : i + 1] for k, v in together.items()})


@pytest.mark.parametrize("size", [1, 3, COUNT])
def test_chunks_give_the_same_numbers(size, monkeypatch):
    model, states, theta = case()
    together = everything(model, states, theta)
    monkeypatch.setattr(se3, "CHUNK", size)
    assert_all_close(everything(model, states, theta), together)


def test_no_states():
    model, states, theta = case()
    p = model.predict(states[:0], theta)
    assert p.observation.position.shape == (0, 3)
    assert model.jacobian(p, theta, 3).shape == (0, 3, model.size)
