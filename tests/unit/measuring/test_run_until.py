"""A campaign that ends as soon as its goal is met: home, nothing hangs, and the rest waits."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from hilcal.config import Limits, Obstacle
from hilcal.errors import DeviceError
from hilcal.measuring.feasibility import Feasibility
from hilcal.measuring.progress import GoalMet, GoalStatus, ReadingStored
from hilcal.measuring.route import Stop, route_problems, way_home
from hilcal.present.progress import met_words
from hilcal.robot.chain import evaluate
from hilcal.store.plan import Step
from tests.support.fake_bench import POSES, Bench, Killed, plan_of, usual_plan
from tests.support.rows import first

HOME = POSES["reference"]


@dataclass
class Enough:
    """A goal that is met by so many readings; 0 is never."""

    count: int
    asked: list[tuple[int, bool]] = field(default_factory=list)

    def __call__(self, readings, last):
        self.asked.append((len(readings), last))
        met = 0 < self.count <= len(readings)
        return GoalStatus("j2 std < 5 %", met, "j2", float(len(readings)), unit="%")


def steps(b):
    return [step for step, _, _ in b.store.rows]


def is_home(b):
    return b.world.load == "none" and np.allclose(b.world.q, HOME) and not b.world.is_moving


def test_a_goal_that_is_met_under_a_load():
    """The load is taken off at the reference pose, and the drift of so far is read."""
    b, plan = Bench(), usual_plan()
    b.measure(plan, goal=Enough(7))
    assert steps(b) == [*plan.steps[:7], Step("reference", "none", 1)]
    assert is_home(b)
    assert b.requested_loads == ["none", "3kg", "none"]
    assert b.world.payload[0] == b.cell.tool_mass
    kinds = b.store.kinds()
    assert kinds[kinds.index("goal") :] == [
        "goal", "load", "tare", "drift", "repeatability", "finished",
    ]  # fmt: skip
    goal = b.store.last("goal")
    assert (goal["met"], goal["readings"], goal["planned"]) == (True, 7, len(plan.steps))
    assert [t.goal.std for t in b.notes.of_kind(ReadingStored)[:3]] == [1.0, 2.0, 3.0]
    (event,) = b.notes.of_kind(GoalMet)
    assert (event.status.std, event.readings, event.planned) == (7.0, 7, 15)
    assert met_words(event) == "goal met after 7 of 15 readings: j2 std 7.0 %"


@pytest.mark.parametrize(
    ("count", "more"),
    first(
        2,
        [
            (3, [Step("reference", "none", 1)]),  # unloaded, somewhere
            (10, []),  # unloaded, at the reference pose, which has just been read
            (14, [Step("reference", "none", 2)]),
            (15, []),  # with the last reading of the plan
        ],
    ),
)
def test_a_goal_that_is_met_elsewhere(count, more):
    b, plan = Bench(), usual_plan()
    b.measure(plan, goal=Enough(count))
    assert steps(b) == [*plan.steps[:count], *more]
    assert is_home(b)
    assert b.store.kinds().count("goal") == 1
    assert b.store.kinds()[-1] == "finished"


def test_a_plan_without_returns_ends_at_the_reference_too(b):
    plan = plan_of(("p1", "none", 0), ("p1", "3kg", 0), ("p2", "3kg", 0), ("p2", "none", 0))
    b.measure(plan, goal=Enough(2))
    assert steps(b) == list(plan.steps[:2])
    assert is_home(b)


def test_the_way_home_is_clear(b):
    """A post stands between p2 and the reference pose: the arm goes back by where it came."""
    q = {"reference": HOME, "via": np.add(POSES["p2"], [0.0, -0.5, 0.3, 0.0, 0.0, 0.0]),
         "p2": POSES["p2"]}  # fmt: skip
    half = (np.array(q["p2"]) + np.array(HOME)) / 2
    place = evaluate(b.cell.arm, half[None]).position[-1][0]
    post = Obstacle(name="post", center_m=tuple(place), size_m=(0.04, 0.04, 0.04))
    config = b.config.model_copy(update={"obstacles": (post,)})
    home, via, p2 = (Stop(name, np.array(q[name]), "3kg") for name in q)
    assert "post" in route_problems(Feasibility(b.cell.with_config(config)), (p2, home))[0]
    assert route_problems(Feasibility(b.cell.with_config(config)), (home, via, p2)) == []
    plan = plan_of(("p2", "none", 0), ("p2", "3kg", 0), poses=q)
    way = way_home(b.cell.with_config(config), plan, [home, via, p2], frozenset())
    assert [(s.name, s.hanging, s.change_to) for s in way] == [
        ("via", "3kg", None), ("reference", "3kg", "none"),
    ]  # fmt: skip
    assert route_problems(Feasibility(b.cell.with_config(config)), (p2, *way)) == []
    free = way_home(b.cell, plan, [home, via, p2], frozenset())
    assert [s.name for s in free] == ["reference"]


@pytest.mark.long
def test_resuming_towards_a_farther_goal():
    b, plan = Bench(), usual_plan()
    b.measure(plan, goal=Enough(7))
    b.world.restart()
    b.measure(plan, goal=Enough(11))
    assert len(steps(b)) == 12
    assert set(steps(b)) < set(plan.steps)
    assert is_home(b)
    b.world.restart()
    b.operator.requests.clear()
    b.measure(plan, goal=Enough(12))  # is met already
    assert len(steps(b)) == 12
    assert b.requested_loads == ["none"]
    assert is_home(b)


def test_a_goal_that_is_never_met():
    b, plan = Bench(), usual_plan()
    rule = Enough(0)
    b.measure(plan, goal=rule)
    assert steps(b) == list(plan.steps)
    assert rule.asked == [(k, k == 15) for k in range(1, 16)]
    assert b.store.kinds().count("goal") == 1
    last_goal = b.store.last("goal")
    assert (last_goal["met"], last_goal["readings"], last_goal["planned"]) == (False, 15, 15)
    assert not b.notes.of_kind(GoalMet)


def short():
    b = Bench(limits=Limits())
    return b, plan_of(
        ("reference", "none", 0),
        ("p1", "none", 0),
        ("p1", "3kg", 0),
        ("p2", "3kg", 0),
        ("reference", "none", 1),
        ("p2", "none", 0),
    )


@pytest.mark.parametrize(
    "fault", first(1, [DeviceError("arm: the line is dead"), KeyboardInterrupt(), Killed()])
)
def test_interrupted_on_the_way_home(fault):
    """At some calls after the goal: the arm stands, and resuming brings it home, once."""
    b, plan = short()
    b.measure(plan, goal=Enough(3))
    wanted = [*plan.steps[:3], plan.steps[4]]
    assert steps(b) == wanted
    calls = b.world.calls
    third = [k for k, name in enumerate(calls) if name == "store.recorded"][2]
    for k in np.linspace(third + 2, len(calls), 2).round().astype(int).tolist():
        b, plan = short()
        if isinstance(fault, Killed):
            b.world.kill_at = k
        else:
            b.world.fail[k] = fault
        with pytest.raises(type(fault)):
            b.measure(plan, goal=Enough(3))
        if not b.world.killed:
            assert b.world.calls[k:] == ["arm.stop", "store.event"]
        assert steps(b) in (wanted[:3], wanted)
        b.world.restart()
        b.measure(plan, goal=Enough(3))
        assert steps(b) == wanted, k
        assert is_home(b), k
        assert b.store.kinds()[-1] == "finished"
