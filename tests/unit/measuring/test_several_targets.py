"""Several reflectors at each stop: pointed to, read one after the other, stored together."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from hilcal.config import Tool
from hilcal.config.cell import Target
from hilcal.errors import DeviceError
from hilcal.measuring.connect import Rig
from hilcal.measuring.devices import TargetLostError, TrackerSample
from hilcal.measuring.progress import ReadingStored
from hilcal.measuring.run import run
from hilcal.present.campaign import event_words
from hilcal.robot import chain as chains
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.run_log import RunLog, create_run
from tests.support.fake_bench import (
    FEW_POSES,
    REGISTRATION,
    SAG,
    STD,
    Bench,
    FakeTracker,
    Killed,
    call_before,
    change_result,
    usual_plan,
)
from tests.support.reflector_cases import NAMES, OFFSETS
from tests.support.refusals import refusal
from tests.support.rows import first

TOOL = Tool(
    targets=tuple(
        Target(name=n, target_m=tuple(at)) for n, at in zip(NAMES, OFFSETS.tolist(), strict=True)
    ),
    load_point_m=(0.05, 0.0, 0.15),
    mass_kg=0.8,
    com_m=(0.01, 0.0, 0.06),
)
BOOTSTRAP = 3
"""Stops at which only the first target is read: with the positions beside the reference and at it,
these readings tell where the tracker stands."""


def places(world):
    """(3, 3) where the reflectors are, sensor axes."""
    chain = chains.evaluate(world.cell.arm, world.joints()[None])
    at = np.array([chain.point(offset)[0] for offset in OFFSETS]) + SAG * world.pull()[:3]
    return at @ REGISTRATION[:3, :3].T + REGISTRATION[:3, 3]


@dataclass
class PointedTracker(FakeTracker):
    """A tracker that holds the reflector it was last pointed to."""

    held: int = 0
    hidden: set[tuple[float, int]] = field(default_factory=set)  # first joint's angle, number
    misled: bool = False

    def _seen(self, k):
        q = float(self.world.joints()[0])
        return not any(abs(q - at) < 1e-6 and k == number for at, number in self.hidden)

    def aim(self, position, radius):
        self.world.call("tracker.aim")
        away = np.linalg.norm(places(self.world) - position, axis=1)
        k = int(np.argmin(away))
        if not self._seen(k):
            raise TargetLostError("tracker: no target in sight")
        assert away[k] < radius
        self.held = 0 if self.misled and k == 1 else k

    def measure(self):
        self.world.call("tracker.measure")
        self.world.time += 0.1
        if not self._seen(self.held):
            raise TargetLostError("tracker: the beam is broken")
        value = places(self.world)[self.held] + STD * self.world.rng.standard_normal(3)
        return TrackerSample(int(self.world.time * 1e9), value, STD**2 * np.eye(3))


def bench():
    b = Bench(tool=TOOL)
    tracker = PointedTracker(b.world)
    b.rig = Rig(b.rig.arm, tracker, b.rig.force, b.rig.operator)
    return b, tracker


def measure(b, path, plan=FEW_POSES):
    made = CampaignFile.open(path) if path.exists() else create_run(path, b.config, Path(), plan)
    with made as file:
        run(b.rig, b.cell, plan, RunLog(file), b.clock, b.notes)
        return file.readings()


def by_key(r):
    return {
        (r.pose_names[p], r.load_names[load], int(c), r.target_names[t]): value
        for p, load, c, t, value in zip(r.pose, r.load, r.cycle, r.target, r.value, strict=True)
    }


def test_each_target_is_read_at_each_stop(tmp_path):
    b, _ = bench()
    r = measure(b, tmp_path / "r.hilcal")
    plan = FEW_POSES
    stops = len(plan.steps)
    assert r.target.tolist() == [0] * BOOTSTRAP + [0, 1, 2] * (stops - BOOTSTRAP)
    assert len(np.unique(r.arrivals)) == stops
    assert len(b.remarks("only target R1")) == 1
    assert [e.stored for e in b.notes.of_kind(ReadingStored)] == list(range(1, stops + 1))
    chain = chains.evaluate(b.cell.arm, r.states.q)
    held = chain.point(OFFSETS[r.target]) + SAG * r.states.wrench[:, :3]
    in_tracker = held @ REGISTRATION[:3, :3].T + REGISTRATION[:3, 3]
    assert np.abs(r.value - in_tracker).max() < 6 * STD
    assert np.all(np.diff(r.states.time) > 0)


def test_a_tracker_that_is_moved_is_asked_about_with_several_targets_too(tmp_path):
    b, tracker = bench()

    def kicked(sample):
        moved = 0.02 * (len(b.notes.of_kind(ReadingStored)) >= 6)
        return replace(sample, value=sample.value + moved * np.array([1.0, 0.0, 0.0]))

    change_result(tracker, "measure", kicked)
    measure(b, tmp_path / "r.hilcal")
    assert [q[:38] for n, q in b.operator.requests if n == "confirm"] == [
        "the target at the reference pose is 20"
    ]
    with CampaignFile.open(tmp_path / "r.hilcal") as campaign:
        events = RunLog(campaign).events()
    doubted = [e["reading"]["target"] for e in events if e["kind"] == "doubted"]
    assert doubted == list(NAMES)


@pytest.mark.long
def test_a_hidden_reflector_is_a_missing_reading_with_a_word(tmp_path):
    b, tracker = bench()
    angle = float(usual_plan().joints("p4")[0])
    tracker.hidden = {(angle, 1)}
    r = measure(b, tmp_path / "some.hilcal", usual_plan())
    steps = usual_plan().steps[BOOTSTRAP:]
    wanted = {(s.pose, s.load, s.cycle, n) for s in steps for n in NAMES}
    lost = {key for key in wanted if key[0] == "p4" and key[3] == "R2"}
    assert lost
    later = {key for key in by_key(r) if key[:3] in {(s.pose, s.load, s.cycle) for s in steps}}
    assert later == wanted - lost
    assert b.remarks("R2 is not read") == [
        "p4: target R2 is not read: tracker: no target in sight"
    ] * len(lost)
    b, tracker = bench()
    tracker.hidden = {(angle, k) for k in range(3)}
    with pytest.raises(DeviceError, match=r"p4: .*all others.* run again with --resume"):
        measure(b, tmp_path / "none.hilcal", usual_plan())


def test_a_neighbour_is_not_taken_for_a_target(tmp_path):
    b, tracker = bench()
    tracker.misled = True
    r = measure(b, tmp_path / "r.hilcal")
    assert set(r.target.tolist()) == {0, 2}
    assert b.remarks("R2 is not read: tracker: it sees R1 in its place")


@pytest.mark.long
def test_all_targets_of_an_arrival_that_was_leaned_on_are_kept_as_doubted(tmp_path):
    b, _ = bench()
    leaned = []

    def leans(seconds):
        wanted = len(b.notes.of_kind(ReadingStored)) == BOOTSTRAP and not leaned
        leaned.extend([seconds] * wanted)
        b.world.extra = np.array([0, 60.0 * wanted, 0, 0, 0, 0])

    def lets_go(sample):
        b.world.extra = np.zeros(6)
        return sample

    call_before(b.rig.force, "average", leans)
    change_result(b.rig.force, "average", lets_go)
    r = measure(b, tmp_path / "r.hilcal", usual_plan())
    assert len(by_key(r)) == len(r) == BOOTSTRAP + 3 * (len(usual_plan().steps) - BOOTSTRAP)
    with CampaignFile.open(tmp_path / "r.hilcal") as file:
        doubted = [e for e in RunLog(file).events() if e["kind"] == "doubted"]
    assert [e["reading"]["target"] for e in doubted] == list(NAMES)
    words = event_words(doubted[0])
    assert "reading of p3, none, R1 kept as doubted: the force sensor measures" in words


@pytest.mark.parametrize(("name", "count"), first(0, [("tracker.measure", 60), ("tracker.aim", 8)]))
def test_a_killed_run_goes_on_with_whole_arrivals(tmp_path, name, count):
    b, _ = bench()
    b.world.kill_after = name, count
    with pytest.raises(Killed):
        measure(b, tmp_path / "r.hilcal")
    with CampaignFile.open(tmp_path / "r.hilcal") as file:
        stored = file.readings()
        done = RunLog(file).done()
        assert len(done) == len(np.unique(stored.arrivals))
        # After the start all targets of a stored arrival are there.
        assert stored.target.tolist()[BOOTSTRAP:] == [0, 1, 2] * (len(done) - BOOTSTRAP)
    b.world.restart()
    r = measure(b, tmp_path / "r.hilcal")
    assert len(by_key(r)) == len(r) == BOOTSTRAP + 3 * (len(FEW_POSES.steps) - BOOTSTRAP)


def test_what_cannot_be_pointed_is_refused(tmp_path):
    b = Bench(tool=TOOL)
    refusal(r"driver cannot select one .* no method `aim`", measure, b, tmp_path / "r.hilcal")
    rough = TOOL.targets[1].model_copy(update={"target_m": None})
    tool = TOOL.model_copy(update={"targets": (TOOL.targets[0], rough)})
    b = Bench(tool=tool)
    refusal(r'target "R2" has no target_m: .* estimate = true', measure, b, tmp_path / "s.hilcal")
