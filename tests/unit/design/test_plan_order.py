"""The order of a plan: all readings, each load once, clear motions, little time, random time."""

from collections import Counter
from functools import cache
from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.design import tour
from hilcal.design.run_order import Ordering, PoseReadings, order_plan, pace, timeline
from hilcal.errors import CannotAnswerError
from hilcal.measuring.route import dry_run, durations, route
from hilcal.store.plan import REFERENCE, UNLOADED, Step
from tests.support.campaigns import configuration
from tests.support.refusals import refusal_of

CONFIG = configuration()
CELL = cell_from_config(CONFIG)
LOADS = tuple(load.name for load in CONFIG.loads)
MIDDLE = np.array([0.3, -1.2, 1.4, -0.5, 0.7, 0.2])


class World:
    """Poses around the middle, of which some motions are blocked, one way or both."""

    def __init__(self, count, blocked, seed):
        rng = np.random.default_rng(seed)
        self.q = MIDDLE + rng.uniform(-1.0, 1.0, (count, 6))
        self.names = [f"p{k}" for k in range(count)]
        self.index = {row.tobytes(): k for k, row in enumerate(np.vstack([self.q, MIDDLE]))}
        free = rng.random((len(LOADS) + 1, count + 1, count + 1)) >= blocked
        free[:, -1] = free[:, :, -1] = True  # the reference is reached from everywhere
        self.free = dict(zip((UNLOADED, *LOADS), free, strict=True))

    def passable(self, start, ends, load):
        at = [self.index[np.ascontiguousarray(q).tobytes()] for q in (start, *ends)]
        return np.asarray(self.free[load][at[0], at[1:]])

    def ordered(self, chosen, seed, how=None):
        rng = np.random.default_rng(seed)
        return order_plan(
            CELL.with_config(CONFIG), self.names, self.q, MIDDLE, chosen, self.passable, rng, how
        )


def everything(world):
    return [PoseReadings(name, (UNLOADED, *LOADS)) for name in world.names]


@pytest.mark.long
@settings(max_examples=20, deadline=None)
@given(
    st.integers(1, 12),
    st.floats(0.0, 0.7),
    st.sampled_from([0.0, 0.02, 0.15]),
    st.sampled_from(["around", "first"]),
    st.floats(40.0, 900.0),
    st.integers(0, 10**6),
)
def test_every_plan_keeps_its_promises(count, blocked, slack, unloaded, every, seed):
    world = World(count, blocked, seed)
    rng = np.random.default_rng(seed + 1)
    chosen = []
    for name in (str(x) for x in rng.choice(world.names, count + 2)):  # some poses several times
        some = tuple(str(x) for x in rng.permutation(LOADS)[: rng.integers(0, len(LOADS) + 1)])
        chosen.append(PoseReadings(name, (UNLOADED, *some), int(rng.integers(1, 3))))
    how = Ordering(slack, unloaded, every, repeats=1, draws=3)
    made = world.ordered(chosen, seed, how)
    plan = made.plan
    steps = [s for s in plan.steps if s.pose != REFERENCE]

    assert len(set(plan.steps)) == len(plan.steps)
    wanted = Counter((c.pose, load) for c in chosen for load in c.loads for _ in range(c.cycles))
    extra = Counter((s.pose, s.load) for s in steps) - wanted
    assert not wanted - Counter((s.pose, s.load) for s in steps)
    assert sum(extra.values()) <= 1  # the repeat
    assert all(load == UNLOADED for _, load in extra)
    assert all(Step(s.pose, UNLOADED, s.cycle) in plan.steps for s in plan.steps)
    arrivals = dict.fromkeys((s.pose, s.cycle) for s in steps)
    cycles = [tuple(sorted(s.load for s in steps if (s.pose, s.cycle) == k)) for k in arrivals]
    together = Counter(tuple(sorted(c.loads)) for c in chosen for _ in range(c.cycles))
    assert not together - Counter(cycles)  # what shares an unloaded reading is as it was chosen

    hung = [a.load for a, b in pairwise((*plan.steps, Step("", ""))) if a.load != b.load]
    loaded = [load for load in hung if load != UNLOADED]
    assert len(set(loaded)) == len(loaded)
    assert set(loaded) == {load for c in chosen for load in c.loads} - {UNLOADED}
    assert plan.steps[0] == Step(REFERENCE, UNLOADED, 0)
    assert (plan.steps[-1].pose, plan.steps[-1].load) == (REFERENCE, UNLOADED)

    for a, b in pairwise(route(plan, CELL.arm)):
        if "beside" not in a.name + b.name and not np.array_equal(a.q, b.q):
            assert world.passable(a.q, b.q[None], b.hanging)[0], (a, b)

    limit = (1.0 + slack) * made.shortest.total
    assert made.duration.total <= limit + 1e-6
    dry = dry_run(CELL.with_config(CONFIG), plan)
    assert dry.duration == pytest.approx(made.duration.total, rel=1e-9)
    assert dry.remarks == ()

    _, times = timeline(plan, CELL.arm, CONFIG.limits.joint_margin_rad, pace(CONFIG))
    at = [k for k, s in enumerate(plan.steps) if s.pose == REFERENCE]
    for k, j in pairwise(at):
        assert j - k <= 2 or times[j] - times[k] <= every + pace(CONFIG).reading_s + 1e-6 + (
            pace(CONFIG).change_s if plan.steps[k].load != plan.steps[j].load else 0.0
        )


def test_the_same_seed_gives_the_same_order_and_another_one_another():
    world = World(9, 0.2, 3)
    made = [world.ordered(everything(world), seed).plan.to_json() for seed in (1, 1, 2)]
    assert made[0] == made[1] != made[2]


def test_absolute_readings_of_a_pose_share_no_more_than_they_must():
    world = World(3, 0.0, 1)
    chosen = [
        PoseReadings("p0", (UNLOADED,), 2),
        PoseReadings("p0", (LOADS[0],), 2),
        PoseReadings("p1", (LOADS[1],)),
    ]
    plan = world.ordered(chosen, 0, Ordering(repeats=0)).plan
    steps = {(s.pose, s.load, s.cycle) for s in plan.steps if s.pose != REFERENCE}
    assert steps == {
        *(("p0", load, cycle) for load in (UNLOADED, LOADS[0]) for cycle in (0, 1)),
        ("p1", LOADS[1], 0),
    }


def test_the_pace_is_that_of_the_configuration():
    world = World(4, 0.0, 1)
    slow = {"reading_s": 20.0, "load_change_s": 300.0}
    config = CellConfig.model_validate({**CONFIG.model_dump(), "planning": slow})
    poses = (world.names, world.q, MIDDLE, everything(world))
    made = order_plan(CELL.with_config(config), *poses, world.passable, np.random.default_rng(0))
    assert made.duration.readings == pytest.approx(20.0 * len(made.plan.steps))
    assert made.duration.load_changes == pytest.approx(300.0 * (len(LOADS) + 1))
    split = made.plan.about["duration_s"]
    parts = sum(split[part] for part in ("motion", "readings", "load_changes"))
    assert split["total"] == pytest.approx(parts, abs=0.2)


def test_a_pose_behind_another_one_is_reached_by_it():
    world = World(5, 0.0, 2)
    for free in world.free.values():
        free[-1, 0] = free[0, -1] = False  # never straight between the reference and p0
        free[0, 2:] = free[2:, 0] = False  # only by p1
        free[1, 0] = free[0, 1] = True
    chosen = [PoseReadings(name, (UNLOADED,)) for name in world.names]
    with pytest.raises(CannotAnswerError, match=r"pose p\d is not reached from the reference"):
        world.ordered(chosen, 0)  # in by p1, and out by p1 again, where it is not measured again
    for free in world.free.values():
        free[0, 2] = True
    plan = world.ordered(chosen, 0, Ordering(repeats=0)).plan
    names = [s.pose for s in plan.steps]
    assert names[names.index("p0") - 1] == "p1"
    assert names[names.index("p0") + 1] == "p2"


# drift


@cache
def _large():
    world = World(24, 0.1, 8)
    return world, [world.ordered(everything(world), seed) for seed in range(5)]


@pytest.mark.long
def test_time_is_far_less_confounded_than_in_the_shortest_order():
    _, made = _large()
    for ordered in made:
        assert ordered.confounding.correlation < 0.5 * ordered.confounding_shortest.correlation
        assert abs(ordered.confounding.bias_m) < 0.2 * ordered.confounding_shortest.bias_m


@pytest.mark.long
def test_orders_under_different_loads_are_independent():
    """A covariate that no regressor knows is confounded under each load in another way.

    In the shortest order every load has nearly the same tour: what is late under one load is
    late under all. Independent orders average out, here over four loads.
    """
    together = []
    for seed in range(4):
        world = World(20, 0.0, 20 + seed)
        hidden = np.cos(world.q @ np.random.default_rng(seed).standard_normal((6, 40)))

        def shared(plan, world=world, hidden=hidden):
            _, times = timeline(plan, CELL.arm, 0.0, pace(CONFIG))
            when = {(s.pose, s.load): t for s, t in zip(plan.steps, times, strict=True)}
            out = []
            for load in LOADS:
                t = stats.zscore([when[name, load] for name in world.names])
                out.append(t @ stats.zscore(hidden) / len(t))
            return float(np.mean(np.mean(out, axis=0) ** 2))

        plain = world.ordered(everything(world), 0, Ordering(slack=0.0)).plan
        mixed = [world.ordered(everything(world), k, Ordering(draws=4)).plan for k in range(3)]
        together.append((shared(plain), float(np.mean([shared(plan) for plan in mixed]))))
    before, after = np.mean(together, axis=0)
    assert after < 0.5 * before


@pytest.mark.long
def test_correlation_is_the_information_that_a_parameter_loses_to_a_drift():
    _, made = _large()
    ordered = made[0]
    plan, confounding = ordered.plan, ordered.confounding
    _, times = timeline(plan, CELL.arm, CONFIG.limits.joint_margin_rad, pace(CONFIG))
    when = dict(zip(plan.steps, times, strict=True))
    rows = [s for s in plan.steps if s.pose != REFERENCE and s.load != UNLOADED]
    lag = np.array([when[s] - when[Step(s.pose, UNLOADED, s.cycle)] for s in rows])
    wrench = {load.name: load.wrench(CELL.gravity) for load in CONFIG.loads}
    component, *product = confounding.regressor.split()
    k = ["fx", "fy", "fz", "mx", "my", "mz"].index(component)
    column = np.array([wrench[s.load][k] for s in rows])
    if product:
        angle = np.array([plan.joints(s.pose)[int(product[1][1:]) - 1] for s in rows])
        column = column * (np.cos(angle) if product[0] == "cos" else np.sin(angle))
    both = np.stack([column, lag], axis=1)
    alone, beside = 1 / (column @ column), np.linalg.inv(both.T @ both)[0, 0]
    assert alone / beside == pytest.approx(1 - confounding.correlation**2, rel=1e-9)
    assert confounding.error_m == pytest.approx(confounding.drift * np.sqrt(np.mean(lag**2)))
    assert confounding.bias_m == pytest.approx(confounding.drift * np.mean(lag))
    assert confounding.deflections == len(rows)


@pytest.mark.long
def test_the_drift_that_returns_tell_is_that_of_a_fit_to_them():
    _, made = _large()
    plan = made[0].plan
    _, times = timeline(plan, CELL.arm, CONFIG.limits.joint_margin_rad, pace(CONFIG))
    at = [k for k, s in enumerate(plan.steps) if s.pose == REFERENCE]
    means = np.array([[plan.steps[k].load == load for load in plan.loads] for k in at], float)
    design = np.column_stack([times[at], means])
    std = 15e-6 * np.sqrt(np.linalg.inv(design.T @ design)[0, 0])
    assert made[0].confounding.drift_std == pytest.approx(std, rel=1e-6)


def test_the_heaviest_of_three_loads_comes_in_the_middle():
    """Its lags are then the shortest, as unloaded readings are taken before and after."""
    masses = {"light": 0.5, "heavy": 6.0, "medium": 1.0}
    loads = [{"name": name, "mass_kg": mass} for name, mass in masses.items()]
    data = {**CONFIG.model_dump(exclude={"loads"}), "loads": loads}
    config = CellConfig.model_validate(data)
    world = World(12, 0.0, 4)
    chosen = [PoseReadings(name, (UNLOADED, *masses)) for name in world.names]

    def free(start, ends, load):
        return np.ones(len(ends), dtype=np.bool_)

    poses, how = (world.names, world.q, MIDDLE, chosen), Ordering(slack=0.1)
    for seed in range(3):
        made = order_plan(CELL.with_config(config), *poses, free, np.random.default_rng(seed), how)
        assert made.plan.loads[2] == "heavy"


# what cannot be


def test_a_pose_that_is_not_reached_is_named():
    world = World(9, 0.0, 2)
    world.free[LOADS[1]][:, 4] = False
    message = f"pose p4 .* under {LOADS[1]}"
    refusal_of(CannotAnswerError, message, world.ordered, everything(world), 0)


def _held_karp(w):
    """Return the exact length of the shortest tour (dynamic programming over sets)."""
    count = len(w) - 1
    best = {(1 << k, k): float(w[0, k + 1]) for k in range(count)}
    for size in range(2, count + 1):
        for chosen in combinations(range(count), size):
            bits = sum(1 << k for k in chosen)
            for k in chosen:
                rest = bits ^ (1 << k)
                best[bits, k] = min(best[rest, j] + w[j + 1, k + 1] for j in chosen if j != k)
    full = (1 << count) - 1
    return min(best[full, k] + float(w[k + 1, 0]) for k in range(count))


def _seconds(count, seed, *, symmetric):
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.5, 1.5, (count + 1, 6))
    p = pace(CONFIG)
    w = durations(q[:, None], q, p.speed, p.acceleration)
    blocked = rng.random(w.shape) < 0.2
    blocked = blocked | blocked.T if symmetric else blocked
    around = w[:, :1] + 6.5 + w[:1]
    w[1:, 1:] = np.where(blocked, around, w)[1:, 1:]
    return w


@pytest.mark.parametrize("symmetric", [True, False])
def test_tours_are_the_shortest_or_nearly(symmetric):
    longer = []
    for seed in range(4):
        for count in range(1, 11):
            w = _seconds(count, seed, symmetric=symmetric)
            order = tour.short_tour(w, np.random.default_rng(seed))
            assert sorted(order) == list(range(1, count + 1))
            ratio = tour.length(w, order) / _held_karp(w)
            assert ratio >= 1 - 1e-12
            if count <= 7:
                assert ratio == pytest.approx(1, rel=1e-12)
            longer.append(ratio)
    assert max(longer) < 1.03


def test_local_search_alone_comes_near_the_shortest_tour():
    """Insertion and exchanges without luck: what large plans rest on."""
    ratio = []
    for seed in range(12):
        w = _seconds(10, 50 + seed, symmetric=seed % 2 == 0)
        rng = np.random.default_rng(seed)
        begun = [int(k) for k in rng.permutation(10) + 1]
        order = tour.improved_tour(w, begun)
        assert sorted(order) == sorted(begun)
        assert tour.length(w, order) <= tour.length(w, begun)
        ratio.append(tour.length(w, order) / _held_karp(w))
    assert np.mean(ratio) < 1.05


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 8), st.integers(0, 10**6), st.floats(15.0, 120.0))
def test_loops_are_cut_in_least_time(count, seed, limit):
    w = _seconds(count, seed, symmetric=False)
    order = [int(k) for k in np.random.default_rng(seed).permutation(count) + 1]

    def cost(parts):
        total = 0.0
        for part in parts:
            whole = tour.length(w, part) + 6.5 * len(part)
            total += whole + 6.5 if len(part) == 1 or whole <= limit else np.inf
        return total

    tries = []
    for bits in range(2 ** (count - 1)):
        cuts = [0, *(k + 1 for k in range(count - 1) if bits >> k & 1), count]
        tries.append([order[a:b] for a, b in pairwise(cuts)])
    loops = tour.loops(w, order, 6.5, limit)
    assert [k for part in loops for k in part] == order
    assert cost(loops) == pytest.approx(min(map(cost, tries)), rel=1e-12)


def test_random_orders_are_uniform_and_within_the_budget():
    rng = np.random.default_rng(5)
    w = _seconds(4, 1, symmetric=True)
    free = Counter(tuple(tour.random_tour(w, [1, 2, 3, 4], 1e6, rng, 40)) for _ in range(2400))
    assert len(free) == 24
    assert stats.chisquare(list(free.values())).pvalue > 1e-3
    for seed in range(10):
        w = _seconds(15, seed, symmetric=seed % 2 == 0)
        short = tour.short_tour(w, rng)
        budget = 1.1 * tour.length(w, short)
        order = tour.random_tour(w, short, budget, rng, 600)
        assert sorted(order) == sorted(short)
        assert order != short
        assert tour.length(w, order) <= budget + 1e-9
