"""Planner, dry run and guard agree in random cells, and motions that pass touch nothing between."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig
from hilcal.design.feasible import Space
from hilcal.measuring.clearance import Clearance
from hilcal.measuring.feasibility import BETWEEN_M, STATE, Feasibility, Margins
from hilcal.measuring.motion import SLACK, SLACK_M, Guard
from hilcal.measuring.route import Stop, route_problems
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import load_arm
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats
from tests.support.arm_cases import ODD, arm_of
from tests.support.fake_bench import Bench
from tests.support.space_cases import cell, extent, frames, gap_to, hung, placed

GEOMETRY = ("joint limits", "workspace", "self-collision", "obstacle", "hanging")
URDF = "urdf"
"""Six joints, a shape that nobody knows."""


def arm(name: str) -> Arm:
    return load_arm("lab.urdf", text=_urdf()) if name == URDF else arm_of(name)


def _urdf() -> str:
    rows = [("0 0 0.2", "0 0 1"), ("0 0.1 0", "0 1 0"), ("0 -0.1 0.5", "0 1 0"),
            ("0 0 0.45", "0 1 0"), ("0 0.1 0", "0 0 1"), ("0 0 0.1", "0 1 0")]  # fmt: skip
    links = "".join(
        f'<link name="l{k}"><inertial><mass value="3"/><origin xyz="0 0 0.1"/>'
        '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for k in range(7)
    )
    joints = "".join(
        f'<joint name="j{k + 1}" type="revolute"><parent link="l{k}"/><child link="l{k + 1}"/>'
        f'<origin xyz="{at}"/><axis xyz="{axis}"/>'
        '<limit lower="-3" upper="3" effort="300" velocity="2"/></joint>'
        for k, (at, axis) in enumerate(rows)
    )
    return f'<robot name="lab">{links}{joints}</robot>'


@st.composite
def cells(draw: Any) -> tuple[Cell, CellConfig]:
    """Any arm with targets, loads, obstacles and a workspace, or without."""
    limits: dict[str, Any] = {"joint_margin_rad": draw(st.sampled_from([0.0, 0.3]))}
    if draw(st.booleans()):
        sides = [-draw(st.floats(0.2, 1.5)) for _ in range(2)]
        limits["workspace_min_m"] = [*sides, draw(st.floats(-0.6, 0.3))]
    if draw(st.booleans()):
        limits["workspace_max_m"] = [draw(st.floats(0.4, 1.5)) for _ in range(3)]
    place = st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-0.3, 1.2))
    size = st.tuples(*[st.floats(0.02, 0.4)] * 3)
    things = draw(st.lists(st.tuples(place, size), max_size=2))
    offsets = draw(st.lists(st.tuples(*[st.floats(-0.3, 0.3)] * 3), min_size=1, max_size=3))
    tool: dict[str, Any] = {
        "load_point_m": draw(st.tuples(*[st.floats(-0.15, 0.15)] * 3)),
        "mass_kg": 1.0,
    }
    if len(offsets) > 1:
        tool["targets"] = [{"name": f"t{k}", "target_m": at} for k, at in enumerate(offsets)]
    else:
        tool["target_m"] = offsets[0]
    pull = draw(st.tuples(*[st.floats(-40.0, 40.0)] * 2, st.floats(5.0, 40.0)))
    config = cell(
        tool=tool,
        limits=limits,
        obstacles=[
            {"name": f"box {k}", "center_m": at, "size_m": wide}
            for k, (at, wide) in enumerate(things)
        ],
        loads=[
            {"name": "weight", "mass_kg": 2.0, "hang_m": draw(st.floats(0.05, 0.6))},
            {"name": "pull", "force_N": pull, "cable_m": draw(st.floats(0.05, 0.8))},
        ],
        force_sensor={"driver": "x", "port": "y", "max_force_N": 300, "max_moment_Nm": 12},
    )
    name = draw(st.sampled_from(["ur3e", "ur5", "ur10", "ur10e", "ur20", URDF, ODD]))
    return replace(cell_from_config(config), arm=arm(name)), config


SAMPLE = Bench().rig.arm.sample()
SEED = st.integers(0, 10_000)
LOAD = st.sampled_from([UNLOADED, "weight", "pull"])


def states(c: Cell, seed: int, count: int) -> Floats:
    """States (N, n) about a usual pose, of which some keep all and some do not."""
    rng = np.random.default_rng(seed)
    usual = np.resize([0.0, -1.2, 1.5, -1.5, -1.5, 0.0, 0.0], c.arm.n)
    return np.asarray(usual + rng.uniform(-1.2, 1.2, (count, c.arm.n)))


def gaps(shapes: Clearance, q: Floats, load: str) -> tuple[float, float]:
    """How far a state (n,) stays within the workspace, and from obstacles, by other means, m."""
    c, config = shapes.cell, shapes.config
    parts, at = shapes.scene.parts, frames(c.arm, q)
    loose = [] if load == UNLOADED else hung(c, shapes, q, load)
    low, high = extent([p for p in parts if p.body > 2], c, q[None])
    for points, radius in loose:
        low = np.minimum(low, points.min(axis=0) - radius)
        high = np.maximum(high, points.max(axis=0) + radius)
    turns = np.zeros((25, c.arm.n))
    turns[:, 0] = np.linspace(-np.pi, np.pi, 25)
    mount, upper = (
        extent([p for p in parts if p.body < 2], c, turns),
        extent([p for p in parts if p.body == 2], c, q[None]),
    )
    least = config.limits.workspace_min_m or (-np.inf, -np.inf, 0.0)
    most = config.limits.workspace_max_m or (np.inf, np.inf, np.inf)
    low = np.where(mount[0] >= least, np.minimum(low, upper[0]), low)
    high = np.where(mount[1] <= most, np.maximum(high, upper[1]), high)
    inside = float(np.min([low - least, most - high]))
    bodies = [(placed(p, at), p.radius) for p in parts if p.body > 1] + loose
    apart = [gap_to(x, points) - radius for x in config.obstacles for points, radius in bodies]
    return inside, min(apart, default=np.inf)


def stopped(guard: Guard, q: Floats, load: str) -> str | None:
    here = replace(SAMPLE, q=q, qd=np.zeros(len(q)))
    return guard.check(here, None, load)


@pytest.mark.long
@settings(max_examples=20, deadline=None)
@given(cells(), SEED, LOAD)
def test_a_state_is_refused_by_all_or_by_none(
    made: tuple[Cell, CellConfig], seed: int, load: str
) -> None:
    c, config = made
    space, guard = Space(c, config, Margins()), Guard(c, config)
    for q in states(c, seed, 4):
        lines = route_problems(c, config, (Stop("p", q, load),))
        told = [line for line in lines if "N·m" not in line]
        assert told == [x.at("pose p") for x in space.findings(q[None], load, GEOMETRY)]
        assert bool(told) is not space.allowed(q[None], load, GEOMETRY).all()
        inside, apart = gaps(space.shapes, q, load)
        outside = [x for x in told if "workspace" in x or "mounting plane" in x]
        assert bool(outside) == (inside < 0.0) or abs(inside) < 1e-6
        assert apart >= 0.005 - 1e-9 or any("collide" in x for x in told)
        said = stopped(guard, q, load)
        assert lines or said is None
        if inside < -SLACK_M - 1e-6 or apart < -1e-9:
            assert said is not None


@settings(max_examples=20, deadline=None)
@given(cells(), SEED, LOAD)
def test_all_checks_together_find_what_each_finds_alone(
    made: tuple[Cell, CellConfig], seed: int, load: str
) -> None:
    """The checks share one evaluation of the states; it is another for every state."""
    c, config = made
    limits, q = Feasibility(c, config, SLACK), states(c, seed, 6)
    together = list(limits.findings(q, load))
    assert together == [x for kind in STATE for x in limits.findings(q, load, (kind,))]
    alone = [list(limits.findings(row[None], load)) for row in q]
    assert {x.what for x in together} == {x.what for found in alone for x in found}
    allowed = np.array([not found for found in alone])
    np.testing.assert_array_equal(limits.allowed(q, load, STATE), allowed)
    fresh = Feasibility(c, config, SLACK)
    assert list(fresh.findings(q[-1:], load)) == alone[-1]


@pytest.mark.long
@settings(max_examples=20, deadline=None)
@given(cells(), SEED, LOAD)
def test_a_motion_that_is_planned_passes_and_touches_nothing(
    made: tuple[Cell, CellConfig], seed: int, load: str
) -> None:
    """What the planner allows the dry run allows; what that allows the guard allows."""
    c, config = made
    space, guard = Space(c, config), Guard(c, config)
    q = states(c, seed, 30)
    planned = q[space.allowed(q, load, STATE)][:3]
    if len(planned):
        for end in planned[space.passable(planned[0], planned, load)]:
            assert route_problems(c, config, _way(planned[0], end, load)) == []
    loose = q[Space(c, config, Margins()).allowed(q, load, STATE)][:3]
    for end in loose[1:]:
        if route_problems(c, config, _way(loose[0], end, load)):
            continue
        for share in np.random.default_rng(seed).random(8):
            between = loose[0] + share * (end - loose[0])
            assert stopped(guard, between, load) is None
            inside, apart = gaps(space.shapes, between, load)
            assert inside >= -BETWEEN_M - 1e-9
            assert apart > 0.0
            assert space.shapes.scene.itself.distance(between) > 0.0


@pytest.mark.long
@settings(max_examples=8, deadline=None)
@given(st.sampled_from(["ur3e", "ur10e", URDF]), SEED, st.floats(0.05, 0.95), LOAD)
def test_nothing_small_is_passed_between_two_samples(
    name: str, seed: int, share: float, load: str
) -> None:
    """A cube of 4 mm where hook, elbow or what hangs comes by, and a side that they just pass."""
    free = cell(limits={"workspace_min_m": [-9.0, -9.0, -9.0], "joint_margin_rad": 0.0})
    c = replace(cell_from_config(free), arm=arm(name))
    space, q = Space(c, free), states(c, seed, 30)
    start, *ends = q[space.allowed(q, load, STATE)]
    clear = np.array(ends)[space.passable(start, np.array(ends), load)]
    for end in clear[:2]:
        between = start + share * (end - start)
        at, parts = frames(c.arm, between), space.shapes.scene.parts
        for point in (placed(parts[-1], at)[-1], at[4][:3, 3]):
            cube = {"name": "cube", "center_m": point.tolist(), "size_m": [0.004] * 3}
            found = cell(limits=free.limits.model_dump(), obstacles=[cube])
            assert not Space(c, found).passable(start, end[None], load).any()
            assert any(
                "cube collide" in x for x in route_problems(c, found, _way(start, end, load))
            )
        low, _ = extent([p for p in parts if p.body > 2], c, between[None])
        box = free.limits.model_dump() | {"workspace_min_m": [-9.0, -9.0, low[2] + 0.002]}
        assert route_problems(c, cell(limits=box), _way(start, end, load))


def _way(start: Floats, end: Floats, load: str) -> tuple[Stop, Stop]:
    return Stop("a", start, load), Stop("b", end, load)
