"""Shapes of arms, and what they touch: against known distances and another way to count."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilcal.config import Obstacle
from hilcal.measuring.clearance import segment_distance
from hilcal.robot.catalogue import load_arm, robot_names
from hilcal.robot.chain import evaluate
from hilcal.robot.scene import Scene, Segment, capsules, is_known
from tests.support.arm_cases import ODD, arm_of
from tests.support.fake_bench import POSES
from tests.support.space_cases import frames, gap, gap_to, least_distance, placed, self_gap

POINT = st.tuples(*[st.floats(-2.0, 2.0, width=32)] * 3)
UPRIGHT = np.array([0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0])
TABLE = Obstacle(name="table", center_m=(0.0, 0.0, -0.1), size_m=(3.0, 3.0, 0.1))


@given(POINT, POINT, POINT, POINT)
def test_distance_of_segments(a, b, c, d):
    ends = [np.array(p) for p in (a, b, c, d)]
    share = np.linspace(0.0, 1.0, 81)[:, None]
    first = ends[0] + share * (ends[1] - ends[0])
    second = ends[2] + share * (ends[3] - ends[2])
    nearest = np.linalg.norm(first[:, None] - second[None], axis=2).min()
    coarse = (np.linalg.norm(ends[1] - ends[0]) + np.linalg.norm(ends[3] - ends[2])) / 160
    distance = float(segment_distance(*ends))
    assert nearest - coarse - 1e-9 <= distance <= nearest + 1e-9


@pytest.mark.parametrize("name", [n for n in robot_names() if n.startswith("ur")])
def test_usual_poses_are_free_and_folded_ones_are_not(name):
    scene = Scene(load_arm(name), obstacles=(TABLE,))
    usual = np.array([UPRIGHT, [0.0, -1.5, 1.5, -1.5, -1.5, 0.0], *POSES.values()])
    assert is_known(load_arm(name)) == (name not in ("ur8long", "ur15", "ur18"))  # guessed
    assert scene.self_pairs.close_pairs(usual, 0.01) == {}
    assert scene.obstacle_pairs.close_pairs(usual, 0.01) == {}
    folded = np.array([[0.0, -1.5, 3.0, -1.5, -1.5, 0.0]])
    hit = {name for pair in scene.self_pairs.close_pairs(folded) for name in pair}
    assert {"upper arm", "wrist 1"} <= hit
    assert scene.self_pairs.touching(folded).all()
    down = np.array([[0.0, 0.4, 0.3, -1.5, -1.5, 0.0]])  # through the table
    assert ("forearm", "table") in scene.obstacle_pairs.close_pairs(down)
    assert scene.obstacle_pairs.touching(down).all()


FOOT = {"ur3": 128, "ur3e": 128, "ur5": 149, "ur5e": 149, "ur20": 245, "ur30": 245}


@pytest.mark.parametrize("name", robot_names())
def test_shapes_hold_the_crossings_of_axes_and_are_no_wider_than_the_foot(name):
    """Feet: data sheets, mm; the tool's flange of a UR3e measures 63 mm."""
    arm = load_arm(name)
    assert all(0.03 <= part.radius <= FOOT.get(name, 190) / 2000 for part in capsules(arm))
    for q in np.random.default_rng(1).uniform(-np.pi, np.pi, (5, 6)):
        at = frames(arm, q)
        for k in (2, 5, 6, 7):  # shoulder, wrists and flange; elsewhere the axes do not cross
            centre = at[k][:3, 3][None]
            near = [p.body for p in capsules(arm) if gap(placed(p, at), centre) <= p.radius]
            assert {k - 1, k} & set(near)


def test_known_distances_to_a_ball_a_box_and_a_cylinder():
    """Upright, the UR10e's upper arm stands 176.2 mm beside the base's axis, 60 mm thick."""
    arm = load_arm("ur10e")
    height = 0.1807 + 0.3
    side = np.array([0.0, -1.0, 0.0])  # of the upper arm, at joint 1 = 0
    at = 0.5 * side + [0.0, 0.0, height]
    ball = Segment("ball", at, at, 0.05)
    scene = Scene(arm)
    distance = least_distance(scene.segment_pairs, UPRIGHT, ball)
    assert distance == pytest.approx(0.5 - 0.1762 - 0.06 - 0.05, abs=1e-6)
    turned = np.array([np.pi, *UPRIGHT[1:]])
    assert least_distance(scene.segment_pairs, turned, ball) > 0.4
    box = Obstacle(name="wall", center_m=(0.0, -0.5, height), size_m=(0.1, 0.2, 0.1))
    tube = 0.5 - 0.1 - 0.1762 - 0.06
    for thing in (box, Obstacle(name="x", bottom_m=(0, -0.5, 0.45), radius_m=0.1, height_m=0.06)):
        for margin, touches in ((tube - 1e-3, False), (tube + 1e-3, True)):
            hit = Scene(arm, obstacles=(thing,)).obstacle_pairs.touching(UPRIGHT[None], margin)
            assert hit.all() == touches


things = st.one_of(
    st.builds(
        lambda c, s: Obstacle(name="box", center_m=c, size_m=s),
        POINT,
        st.tuples(*[st.floats(0.05, 1.0)] * 3),
    ),
    st.builds(
        lambda c, r, h: Obstacle(name="tripod", bottom_m=c, radius_m=r, height_m=h),
        POINT,
        st.floats(0.05, 0.5),
        st.floats(0.05, 2.0),
    ),
)


@pytest.mark.long
@settings(max_examples=25, deadline=None)
@given(st.sampled_from(["ur3e", "ur5", "ur10e", "ur20"]), things, st.integers(0, 999))
def test_whatever_is_free_is_free_by_another_way_to_count(name, thing, seed):
    """Both ways: what is counted free keeps the margin, what is not comes closer than that."""
    arm = load_arm(name)
    scene = Scene(arm, obstacles=(thing,))
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (20, 6))
    itself, around = scene.self_pairs.touching(q, 0.01), scene.obstacle_pairs.touching(q, 0.02)
    coarse = 0.04 * arm.reach / 2  # the ends of the points' spacing
    for k, state in enumerate(q):
        at = frames(arm, state)
        gap_of_arm = self_gap(capsules(arm), at)
        far = min(gap_to(thing, placed(p, at)) - p.radius for p in capsules(arm) if p.body > 1)
        assert gap_of_arm >= 0.01 - 1e-9 or itself[k]
        assert far >= 0.02 - 1e-9 or around[k]
        assert gap_of_arm <= 0.01 + coarse or not itself[k]
        assert far <= 0.02 + coarse or not around[k]


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(["ur3e", "ur10e", ODD]), things, st.integers(0, 999))
def test_no_gap_closes_faster_than_its_rate(name, thing, seed):
    """What is nearest after turns of the joints was no farther before than the bound says."""
    arm, rng = arm_of(name), np.random.default_rng(seed)
    scene, point = Scene(arm, obstacles=(thing,)), rng.normal(0.0, 0.1, 3)
    towards = scene.load_rates(point)
    q = rng.uniform(-2.0, 2.0, (20, arm.n))
    turns = rng.uniform(-1.0, 1.0, q.shape) * np.eye(arm.n)[rng.integers(0, arm.n, len(q))]
    places = [evaluate(arm, states).point(point) for states in (q, q + turns)]
    for k, turn in enumerate(np.abs(turns)):
        old, new = q[k : k + 1], (q + turns)[k : k + 1]
        was, here = (Segment("hung", at[k], at[k] - [0.0, 0.0, 0.2], 0.02) for at in places)
        for pairs in (scene.self_pairs, scene.obstacle_pairs):
            near = least_distance(pairs, new[0]) + pairs.rates @ turn + 1e-4
            assert pairs.touching(old, near).all()
        near = least_distance(scene.segment_pairs, new[0], here) + towards @ turn + 1e-4
        assert scene.segment_pairs.touching(old, near, was).all()


def test_an_arm_of_unknown_shape_gets_links_and_can_move():
    arm = arm_of(ODD)
    assert not is_known(arm)
    parts = capsules(arm)
    assert {p.body for p in parts} <= set(range(arm.n + 1))
    for part in parts:  # each spans its link
        length = np.linalg.norm(arm.links[part.body][:3, 3])
        assert np.linalg.norm(part.end - part.start) == pytest.approx(length)
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (200, arm.n))
    share = Scene(arm).self_pairs.touching(q, 0.0).mean()
    assert 0.0 < share < 0.9


def test_an_arm_of_a_known_name_and_another_build_is_unknown():
    assert not is_known(replace(arm_of(ODD), name="ur10e"))
    assert is_known(replace(load_arm("ur10e"), q_max=np.full(6, 1.0)))
