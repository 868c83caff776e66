"""A campaign while it is measured: places of its readings, a tally, and what it says in words."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import stats

from hilcal import numbers
from hilcal.measuring.progress import LiveResidual, ReadingStored
from hilcal.present.document import Block, Items, heading, table
from hilcal.present.live_viewer import Measuring
from hilcal.present.running import spoken, status_words
from hilcal.present.story import LIMITS
from hilcal.present.viewer import style
from hilcal.present.viewer.markdown import markdown
from hilcal.robot.body import body_poses
from hilcal.store.plan import UNLOADED, Step
from hilcal.types import Floats

SIGMA_LENGTH = 0.02
"""One σ of a residual is drawn this long, m; a choice."""
ARROW_CAP = 0.4
"""Longest arrow, m; a choice."""
BALL = SIGMA_LENGTH * style.BALL_SIGMAS
"""Radius of the ball that holds 99 % of the readings where the model is right, m."""
LIMIT = style.BALL_SIGMAS / 3**0.5
"""The same in the σ of a reading."""
ALARM = 0.001
"""Chance that noise alone leaves as many readings outside their balls as is called wrong."""
WORST = 3
FLUENT = 1000
"""Residuals that a viewer draws one by one. Of 10,000 each of its pictures took 3.5 times the
processor time of 100 (tests/benchmarks/test_viewer_speed.py); of this many some 1.2 times."""
GROUPS = 150
"""Groups that more of them are divided into: as many as a finished recording has bars."""


@dataclass(frozen=True, slots=True)
class Judged:
    """A reading against the model.

    Attributes:
        step: its step.
        target: name of the target; empty where there is one.
        length: of the residual r, m.
        norm2: rᵀ V⁻¹ r, V the covariance of reading and prediction; 3 degrees of freedom.
        stands_out: whether it is the worst of its group so far, see `LiveDigest.group`.
    """

    step: Step
    target: str
    length: float
    norm2: float
    stands_out: bool = True

    @property
    def sigma(self) -> float:
        """sqrt(rᵀ V⁻¹ r / 3), as the terminal has it: 1 where the model is right."""
        return float(np.sqrt(self.norm2 / 3))

    @property
    def level(self) -> int:
        """0 inside the noise, 1 beyond 99 %, 2 beyond 99.99 %."""
        return int(style.levels(np.array([self.norm2]))[0])


@dataclass(slots=True, eq=False)
class LiveDigest:
    """A campaign that is being measured.

    Attributes:
        told: what is measured.
        bodies: (P, n + 2, 4, 4) poses of the arm's bodies at each pose of the plan.
        anchor: (P, T, 3) nominal position of each target at each pose, base axes, m.
        done: readings that are stored.
        left: real seconds that the rest takes.
        phase: what is being done.
        last: the last reading.
        judged: how many readings were compared with a model.
        outside: of these how many are outside their ball, by load; and all of them.
        worst: those that are farthest from the model.
        remarks: that people should look at, newest last.
        places: index of each pose by its name; filled when it is first asked for.
        group_worst: largest `Judged.norm2` of the group that is being measured.
    """

    told: Measuring
    bodies: Floats
    anchor: Floats
    done: int = 0
    left: float = 0.0
    phase: str = ""
    last: ReadingStored | None = None
    judged: int = 0
    outside: int = 0
    loads: dict[str, list[int]] = field(default_factory=dict)
    worst: list[Judged] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    places: dict[str, int] = field(default_factory=dict)
    group_worst: float = 0.0

    @classmethod
    def of(cls, told: Measuring) -> "LiveDigest":
        """Return that of a campaign that begins, or goes on."""
        bodies = body_poses(told.arm, told.plan.q)
        flange = bodies[:, None, -1]
        anchor = flange[..., :3, 3] + np.einsum("pkij,tj->pti", flange[..., :3, :3], told.targets)
        done = len({step for _, step in told.earlier})
        return cls(told, bodies, anchor, done)

    @property
    def total(self) -> int:
        """Readings that are planned."""
        return len(self.told.plan.steps)

    @property
    def group(self) -> int:
        """Residuals, one after the other, of which a viewer keeps those that stand out; 1: all."""
        planned = self.total * len(self.told.targets)
        return 1 if planned <= FLUENT else math.ceil(planned / GROUPS)

    def place(self, step: Step, target: int = 0) -> Floats:
        """(3,) where the nominal arm holds a target, m."""
        if not self.places:
            self.places.update({name: k for k, name in enumerate(self.told.plan.pose_names)})
        return np.asarray(self.anchor[self.places[step.pose], target])

    def add(self, event: ReadingStored) -> list[tuple[int, LiveResidual, Judged | None]]:
        """Take note of a reading.

        Returns:
            Each target that was read, with its residual; judged, or None without a model yet.
        """
        self.last, self.done, self.left = event, event.done, event.left_real
        read = ((event.target, event.live), *event.others)
        return [(k, live, self._judge(event.step, k, live)) for k, live in read]

    def _judge(self, step: Step, target: int, live: LiveResidual) -> Judged | None:
        found = judged(step, live, self.told.names[target] if self.told.names else "")
        if found is None:
            return None
        self.judged += 1
        of_load = self.loads.setdefault(step.load, [0, 0])
        of_load[0] += 1
        if found.level > 0:
            self.outside += 1
            of_load[1] += 1
        self.worst = sorted([*self.worst, found], key=lambda j: -j.norm2)[:WORST]
        begins = (self.judged - 1) % self.group == 0
        found = replace(found, stands_out=begins or found.norm2 > self.group_worst)
        self.group_worst = max(found.norm2, 0.0 if begins else self.group_worst)
        return found

    @property
    def wrong(self) -> bool:
        """Whether more readings are outside than noise leaves there, see `ALARM`."""
        chance = stats.binom.sf(self.outside - 1, self.judged, 1.0 - LIMITS[0])
        return self.outside > 0 and bool(chance < ALARM)

    @property
    def loaded(self) -> bool:
        """Whether any load is planned."""
        return any(step.load != UNLOADED for step in self.told.plan.steps)


def judged(step: Step, live: LiveResidual, target: str = "") -> Judged | None:
    """Return a reading as `Judged`; None where it was not compared."""
    if live.vector is None or live.covariance is None:
        return None
    r, v = np.array(live.vector), np.array(live.covariance).reshape(3, 3)
    return Judged(step, target, float(np.linalg.norm(r)), float(r @ np.linalg.solve(v, r)))


def arrow(live: LiveResidual, found: Judged) -> Floats:
    """(3,) a residual as drawn: its direction, and as long as sqrt(rᵀ V⁻¹ r) says, m."""
    length = min(SIGMA_LENGTH * float(np.sqrt(found.norm2)), ARROW_CAP)
    return np.asarray(length / (found.length or 1.0) * np.array(live.vector))


_REMARKS = 3

GUIDE = """### How to read this
Each reading is compared with a simple model, that of frames and joint compliance, fitted to the
readings **before** it.

**Residuals** (3-D): a small grey dot is a pose of the plan. A green ball is where noise and what
the model does not know yet would leave 99 % of the readings; an arrow that leaves its ball = the
model is wrong there. All arrows are in units of that noise. Grey: noise. Amber: beyond 99 %.
Red: beyond 99.99 %. Blue dots were measured before there was a model, or in an earlier session.
After 300 readings only arrows that leave their balls are drawn; below stand all.

A campaign of more than 1000 readings is divided into 150 groups, one after the other. The last
reading is always drawn; of the earlier ones only those stay that were the worst of their group so
far, here and below. The words count all readings, and the log lists them.

**Residual of each reading** (below): the same along the time of day, in σ as on the
terminal (rms of the three axes): 1 is noise, the green line 99 %.

What is missing in the model is not asked while measuring: `hilcal refine` does, afterwards.
"""


def status(d: LiveDigest) -> str:
    """Return how far the campaign is, and what the readings say so far."""
    return markdown(_status(d))


def _status(d: LiveDigest) -> Iterator[Block]:
    left = f", {spoken(d.left)} left" if d.left > 0 else ""
    yield from (heading(_heading(d)), _sentence(d))
    yield f"{d.done} of {d.total} readings{left}. {d.phase}"
    goal = None if d.last is None else d.last.goal
    if goal is not None and (told := status_words(goal)):
        yield f"Goal: {told}."
    if len(d.loads) > 1 and d.outside:
        rows = ((n, str(a), str(b), numbers.percent(b / a)) for n, (a, b) in d.loads.items())
        yield table("load", "compared", "outside", "", rows=rows)
    if d.worst and d.worst[0].level > 0:
        worst = (
            (
                f"{j.step.pose} {j.target}".rstrip(),
                j.step.load,
                numbers.length(j.length),
                f"{j.sigma:.1f}",
            )
            for j in d.worst
            if j.level > 0
        )
        yield table("worst so far", "load", "residual", "in σ", rows=worst, left=(0, 1))
    yield Items(tuple(f"note: {text}" for text in d.remarks[-_REMARKS:]))


def residual(found: Judged) -> str:
    """Return a residual for people, with its size in σ."""
    return f"{numbers.length(found.length)} ({found.sigma:.1f} σ)"


def _heading(d: LiveDigest) -> str:
    if d.judged == 0:
        return "Measuring: no judgement yet"
    if d.wrong:
        return "✗ The simple model fails: look at the red arrows"
    return "✓ So far noise explains the readings"


def _sentence(d: LiveDigest) -> str:
    if d.judged == 0:
        return "The first readings tell where tracker and target are; then each one is compared."
    share = numbers.percent(d.outside / d.judged)
    told = (
        f"{d.outside} of {d.judged} ({share}) compared readings are outside their 99 % noise "
        "ball (noise alone: 1 %)."
    )
    if d.wrong:
        told += " Something is missing in it: hilcal refine says what, after measuring."
    return told
