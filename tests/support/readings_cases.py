"""An arm and readings for the tests of what goes in and out."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hilcal.readings.readings import Readings, States
from hilcal.robot.arm import Arm
from hilcal.tables.table import import_table


def read_table(*given, **more):
    """The readings of an exchange table, without the decisions of their import."""
    return import_table(*given, **more).readings


def make_arm(n=6):
    """An arm of n joints with a reach of n times 0.25 m and limits of ±2π."""
    links = np.tile(np.eye(4), (n + 1, 1, 1))
    links[1:, 0, 3] = 0.25
    return Arm(
        name="test-arm",
        links=links,
        masses=np.ones(n),
        coms=np.zeros((n, 3)),
        q_min=np.full(n, -2 * np.pi),
        q_max=np.full(n, 2 * np.pi),
        torque_max=np.full(n, 100.0),
        payload=10.0,
        joint_names=tuple(f"joint{i}" for i in range(1, n + 1)),
        source="made up",
    )


def floats(shape, size):
    return arrays(np.float64, shape, elements=st.floats(-size, size, allow_nan=False))


names = st.text(st.characters(codec="utf-8"), min_size=1, max_size=8).filter(
    lambda s: s == s.strip() and s.isprintable() and s.lower() != "none"
)


@st.composite
def readings(draw, n=6):
    """Readings that a table and a campaign can hold, numbered in order of first appearance."""
    count = draw(st.integers(1, 5))
    m = draw(st.sampled_from([3, 6]))
    pose_names = draw(st.lists(names, min_size=count, max_size=count, unique=True))
    load_names = ["none", draw(names)]
    pose = first_seen(draw(st.lists(st.integers(0, count - 1), min_size=count, max_size=count)))
    load_raw = draw(st.lists(st.integers(0, 1), min_size=count, max_size=count))
    load = first_seen(load_raw)
    used = [load_names[k] for k in dict.fromkeys(load_raw)]
    loaded = np.array(load_raw, dtype=float)[:, None]
    q = draw(floats((count, n), 6.0))[pose]
    value = draw(floats((count, m), 1.5))
    value[:, 0] = draw(st.permutations(range(count)))  # m: joints that move move the target
    root = draw(floats((count, m, m), 1.0))
    cov = 1e-8 * (root @ np.swapaxes(root, 1, 2) + np.eye(m))
    cov = np.triu(cov) + np.swapaxes(np.triu(cov, 1), 1, 2)

    def maybe(values):
        return draw(st.none() | values)

    return Readings(
        states=States(
            q=q,
            wrench=draw(floats((count, 6), 100.0)) * loaded,
            time=maybe(floats((count,), 1e6)),
            load_time=maybe(floats((count,), 1e4).map(np.abs)),
            air_temperature=maybe(floats((count,), 40.0)),
            joint_temperature=maybe(floats((count, n), 40.0)),
            approach=maybe(floats((count, n), 1.0).map(lambda a: np.where(a < 0, -1.0, 1.0))),
            q_actual=maybe(floats((count, n), 0.05).map(lambda a: q + a)),
        ),
        pose=pose,
        load=load,
        cycle=np.array(draw(st.lists(st.integers(-9, 2**53), min_size=count, max_size=count))),
        value=value,
        covariance=cov,
        load_names=tuple(used),
        pose_names=tuple(pose_names[: pose.max() + 1]),
    )


def first_seen(numbers):
    order = {k: i for i, k in enumerate(dict.fromkeys(numbers))}
    return np.array([order[k] for k in numbers], dtype=np.int64)


def readings_at(q, value, **more):
    """Readings of joint values (N, n), each of a pose of its own and unloaded unless more is said.

    `more` are fields of readings and of states, or `std` of every element for a covariance.
    """
    count, m = value.shape
    columns = {"wrench": np.zeros((count, 6))} | more
    states = {name: columns.pop(name) for name in States.__dataclass_fields__ if name in columns}
    pose = columns.pop("pose", np.arange(count))
    load = np.broadcast_to(columns.pop("load", 0), count).astype(np.int64)
    usual = {
        "cycle": np.zeros(count, dtype=np.int64),
        "covariance": np.tile(columns.pop("std", 1e-5) ** 2 * np.eye(m), (count, 1, 1)),
        "load_names": ("none", *(f"load {k}" for k in range(1, load.max(initial=0) + 1))),
        "pose_names": tuple(f"p{k}" for k in range(pose.max(initial=-1) + 1)),
    }
    return Readings(States(q, **states), pose=pose, load=load, value=value, **usual | columns)


def simple_readings(count, m=3, seed=0):
    rng = np.random.default_rng(seed)
    q, time = rng.uniform(-3, 3, (count, 6)), np.arange(count, dtype=float)
    return readings_at(q, rng.uniform(-1, 1, (count, m)), time=time, std=1e-9**0.5)


def assert_same(a, b):
    """Every array equal to the last bit, every name equal."""
    for name in States.__dataclass_fields__:
        left, right = getattr(a.states, name), getattr(b.states, name)
        assert (left is None) == (right is None), name
        if left is not None:
            np.testing.assert_array_equal(left, right, err_msg=name)
    for name in ("pose", "load", "cycle", "value", "covariance"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert a.load_names == b.load_names
    assert a.pose_names == b.pose_names
