"""A command drawn while it works: readings as they come, revisions as they are found."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint import archetypes
from scipy import stats

from hilcal import numbers
from hilcal.measuring.progress import ArmAt, GoalMet, LiveResidual, Phase, ReadingStored, Remark
from hilcal.present.document import Block, Items, heading, table
from hilcal.present.live_viewer import Measuring, Revised
from hilcal.present.running import figures, met_words, spoken, status_words
from hilcal.present.story import LIMITS, Story, levels
from hilcal.present.viewer import campaign, style
from hilcal.present.viewer.arm_shapes import MovingArm, labels
from hilcal.present.viewer.recording import along, fixed
from hilcal.robot.body import body_poses
from hilcal.store.plan import Step
from hilcal.types import Floats

SIGMA_LENGTH, ARROW_CAP = 0.02, 0.4
"""One σ of a residual is drawn this long, and no arrow longer than that, m; choices."""
BALL = SIGMA_LENGTH * style.BALL_SIGMAS
"""Radius of the ball that holds 99 % of the readings where the model is right, m."""
LIMIT = style.BALL_SIGMAS / 3**0.5
"""The same in the σ of a reading."""
ALARM = 0.001
"""Chance that noise alone leaves as many readings outside their balls as is called wrong."""
WORST, REMARKS = 3, 3
"""Readings, and remarks, that are listed."""
BALLS, MANY = 60, 300
"""Readings from which a ball, and an arrow, is drawn only where the arrow leaves its ball; choices,
for legibility."""
FLUENT = 1000
"""Residuals that a viewer draws one by one. Of 10,000 each of its pictures took 3.5 times the
processor time of 100 (tests/benchmarks/test_viewer_speed.py); of this many some 1.2 times."""
GROUPS = 150
"""Groups that more of them are divided into: as many as a finished recording has bars."""
TIMELINE = "time"
RESIDUALS = "in σ: an arrow that leaves its noise ball = model wrong"
IN_TIME = "in σ: grey noise, amber doubtful, red model wrong"
_ABOVE = np.array([0.0, 0.0, 1.3 * BALL])


@dataclass(frozen=True, slots=True)
class LiveJudgement:
    """A reading against the model.

    Attributes:
        step: its step.
        target: name of the target; empty where there is one.
        length: of the residual r, m.
        norm2: rᵀ V⁻¹ r, V the covariance of reading and prediction; 3 degrees of freedom.
        stands_out: whether it is the worst of its group so far, see `LiveTally.group`.
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
        return int(levels(np.array([self.norm2]))[0])

    def __str__(self) -> str:
        """Return the residual for people, with its size in σ."""
        return f"{numbers.length(self.length)} ({self.sigma:.1f} σ)"


def judged(step: Step, live: LiveResidual, target: str = "") -> LiveJudgement | None:
    """Return a reading as `LiveJudgement`; None where it was not compared."""
    if live.vector is None or live.covariance is None:
        return None
    r, v = np.array(live.vector), np.array(live.covariance).reshape(3, 3)
    return LiveJudgement(step, target, float(np.linalg.norm(r)), float(r @ np.linalg.solve(v, r)))


@dataclass(slots=True, eq=False)
class LiveTally:
    """A campaign that is being measured.

    Attributes:
        told: what is measured.
        bodies: (P, n + 2, 4, 4) poses of the arm's bodies at each pose of the plan.
        anchor: (T, 3) nominal position of each target by the name of the pose, base axes, m.
        done: readings that are stored.
        left: real seconds that the rest takes.
        phase: what is being done.
        last: the last reading.
        judged: how many readings were compared with a model.
        outside: of these how many are outside their ball.
        loads: both by load.
        worst: those that are farthest from the model.
        remarks: that people should look at, newest last.
        group_worst: largest `LiveJudgement.norm2` of the group that is being measured.
    """

    told: Measuring
    bodies: Floats
    anchor: dict[str, Floats]
    done: int = 0
    left: float = 0.0
    phase: str = ""
    last: ReadingStored | None = None
    judged: int = 0
    outside: int = 0
    loads: dict[str, list[int]] = field(default_factory=dict)
    worst: list[LiveJudgement] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    group_worst: float = 0.0

    @classmethod
    def of(cls, told: Measuring) -> "LiveTally":
        """Return that of a campaign that begins, or goes on."""
        bodies = body_poses(told.arm, told.plan.q)
        flange = bodies[:, -1]
        at = flange[:, None, :3, 3] + np.einsum("pij,tj->pti", flange[:, :3, :3], told.targets)
        anchor = dict(zip(told.plan.pose_names, at, strict=True))
        return cls(told, bodies, anchor, len({step for _, step in told.earlier}))

    @property
    def total(self) -> int:
        """Readings that are planned."""
        return len(self.told.plan.steps)

    @property
    def group(self) -> int:
        """Residuals, one after the other, of which a viewer keeps those that stand out; 1: all."""
        planned = self.total * len(self.told.targets)
        return 1 if planned <= FLUENT else math.ceil(planned / GROUPS)

    @property
    def targets(self) -> Floats:
        """(K, 3) nominal positions of the targets in all poses, m."""
        return np.concatenate(list(self.anchor.values()))

    def place(self, step: Step, target: int = 0) -> Floats:
        """(3,) where the nominal arm holds a target, m."""
        return np.asarray(self.anchor[step.pose][target])

    def add(self, event: ReadingStored) -> list[tuple[int, LiveResidual, LiveJudgement | None]]:
        """Take note of a reading.

        Returns:
            Each target that was read, with its residual; judged, or None without a model yet.
        """
        self.last, self.done, self.left = event, event.done, event.left_real
        read = ((event.target, event.live), *event.others)
        return [(k, live, self._judge(event.step, k, live)) for k, live in read]

    def _judge(self, step: Step, target: int, live: LiveResidual) -> LiveJudgement | None:
        found = judged(step, live, self.told.names[target] if self.told.names else "")
        if found is None:
            return None
        begins = self.judged % self.group == 0
        outside = int(found.level > 0)
        self.judged, self.outside = self.judged + 1, self.outside + outside
        compared, beyond = self.loads.get(step.load, (0, 0))
        self.loads[step.load] = [compared + 1, beyond + outside]
        self.worst = sorted([*self.worst, found], key=lambda j: -j.norm2)[:WORST]
        found = replace(found, stands_out=begins or found.norm2 > self.group_worst)
        self.group_worst = max(found.norm2, 0.0 if begins else self.group_worst)
        return found

    @property
    def wrong(self) -> bool:
        """Whether more readings are outside than noise leaves there, see `ALARM`."""
        chance = stats.binom.sf(self.outside - 1, self.judged, 1.0 - LIMITS[0])
        return self.outside > 0 and bool(chance < ALARM)


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


def status(d: LiveTally) -> str:
    """Return how far the campaign is, and what the readings say so far."""
    return style.markdown(_status(d))


def _status(d: LiveTally) -> Iterator[Block]:
    if d.judged == 0:
        yield heading("Measuring: no judgement yet")
        yield "The first readings tell where tracker and target are; then each one is compared."
    else:
        title = "✓ So far noise explains the readings"
        told = (
            f"{d.outside} of {d.judged} ({numbers.percent(d.outside / d.judged)}) compared "
            "readings are outside their 99 % noise ball (noise alone: 1 %)."
        )
        if d.wrong:
            title = "✗ The simple model fails: look at the red arrows"
            told += " Something is missing in it: hilcal refine says what, after measuring."
        yield from (heading(title), told)
    left = f", {spoken(d.left)} left" if d.left > 0 else ""
    yield f"{d.done} of {d.total} readings{left}. {d.phase}"
    goal = None if d.last is None else d.last.goal
    if goal is not None and (told := status_words(goal)):
        yield f"Goal: {told}."
    if len(d.loads) > 1 and d.outside:
        rows = ((n, str(a), str(b), numbers.percent(b / a)) for n, (a, b) in d.loads.items())
        yield table("load", "compared", "outside", "", rows=rows)
    if d.worst and d.worst[0].level > 0:
        worst = (
            (f"{j.step.pose} {j.target}".rstrip(), j.step.load, numbers.length(j.length),
             f"{j.sigma:.1f}")
            for j in d.worst
            if j.level > 0
        )  # fmt: skip
        yield table("worst so far", "load", "residual", "in σ", rows=worst, left=(0, 1))
    yield Items(tuple(f"note: {text}" for text in d.remarks[-REMARKS:]))


def live_blueprint(d: LiveTally, world: str, series: str) -> rrb.Blueprint:
    """Return the blueprint, of readings below `world` and residuals in time below `series`."""
    ever, now = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    every = archetypes.VisibleTimeRanges(timeline=TIMELINE, start=ever, end=now)
    of = "Residual of each reading," if d.group == 1 else f"Worst of every {d.group} residuals,"
    middle, size = style.center(d.targets, d.told.arm.reach)
    seen = np.vstack([d.targets, d.bodies[0, :, :3, 3]])
    scene = style.view3d(
        "world",
        f"{of} {RESIDUALS}",
        style.near(middle, style.EYE * size, seen),
        middle,
        [f"+ {world}/**"],
        overrides={f"{world}/{name}": every for name in ("arrows", "balls", "dots")},
    )
    in_time = rrb.TimeSeriesView(
        origin=series,
        name=f"{of} {IN_TIME}",
        plot_legend=rrb.PlotLegend(visible=False),
        axis_x=archetypes.TimeAxis(view_range=rr.TimeRange(start=ever, end=ever)),
    )
    words = rrb.Tabs(
        style.text("measuring", "So far"), style.text("live_guide", "How to read this")
    )
    left = rrb.Vertical(scene, in_time, row_shares=[11, 4])
    right = rrb.Vertical(words, _log(), row_shares=[3, 2])
    return style.whole(rrb.Horizontal(left, right, column_shares=[3, 2]), TIMELINE, "following")


def _log() -> rrb.TextLogView:
    kinds = (rrb.encodings.TextLogColumnKind.LogLevel, rrb.encodings.TextLogColumnKind.Body)
    shown = archetypes.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn(timeline=TIMELINE, visible=False)],
        text_log_columns=[rrb.encodings.TextLogColumn(kind=kind, visible=True) for kind in kinds],
    )
    return rrb.TextLogView(origin="log", name="Log", columns=shown)


class LiveScene:
    """What has been told so far, drawn into one recording along the time of day."""

    def __init__(self, rec: rr.RecordingStream, batches: bool = False) -> None:
        """Draw into an open recording; in `batches` the arm, and words, wait for `settle`."""
        self._rec, self._batches = rec, batches
        self._arm: MovingArm | None = None
        self._passed: list[tuple[float, tuple[float, ...]]] = []
        self._since = 0  # those of them that came before the last reading
        self._now: LiveTally | None = None
        self._acts = 0
        self._story: Story | None = None
        self._titles: tuple[str, ...] = ()

    def tell(self, wall: float, what: object) -> None:
        """Draw what happened at a time of day, s."""
        self._rec.set_time(TIMELINE, timestamp=wall)
        if isinstance(what, ArmAt):
            self._passed.append((wall, what.q))
        if not self._batches:
            self._move()
        if isinstance(what, Measuring):
            self.settle()
            self._measuring(wall, what)
        elif isinstance(what, Revised):
            self._revised(what.story)
        elif self._now is not None:
            self._event(self._now, what)

    def settle(self) -> None:
        """Tell what waits for a batch to be handed on: where the arm has been, words, the limit."""
        self._move()
        if self._batches and self._now is not None and self._now.last is not None:
            self._words(self._now)
            self._rec.log(f"{self._series}/limit", rr.Scalars(LIMIT))

    def end(self, to_open: bool) -> None:
        """Tell the story once more, whole: its words know now which revision is the last.

        `to_open`: let it open at the first revision, as a file does; else it stays at the last one.
        """
        self.settle()
        self._now = None
        if self._story is None:
            return
        self._rec.reset_time()
        story = replace(self._story, growing=False)
        campaign.tell(self._rec, story)
        self._rec.reset_time()
        views = campaign.blueprint(story if to_open else self._story)
        self._rec.send_blueprint(views, make_active=True, make_default=True)

    # measuring

    @property
    def _world(self) -> str:
        return f"world/live/{self._acts}"

    @property
    def _series(self) -> str:
        return f"live/{self._acts}"

    def _measuring(self, wall: float, told: Measuring) -> None:
        rec, d = self._rec, LiveTally.of(told)
        self._acts, self._now = self._acts + 1, d
        rec.send_recording_name(f"hilcal: {style.safe(told.name)}")
        fixed(rec, "world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._arm = MovingArm(rec, f"{self._world}/arm", told.arm, told.targets)
        fixed(rec, "words/live_guide", style.document(GUIDE))
        planned = rr.Points3D(d.targets, colors=[style.GREY], radii=[0.006])
        fixed(rec, f"{self._world}/planned", planned)
        for name, color in zip(style.LEVEL_NAMES, style.LEVEL_COLORS, strict=True):
            fixed(rec, f"{self._series}/{name}", style.series(name, color, 0.0, 4.0)[1])
        line = rr.SeriesLines(colors=[style.NOISE], widths=[1.5], names=["99 %"])
        fixed(rec, f"{self._series}/limit", line)
        if told.earlier:  # what earlier sessions measured, as one batch
            walls, steps = zip(*told.earlier, strict=True)
            dots = rr.Points3D.columns(
                positions=[d.place(step) for step in steps],
                colors=np.tile(np.array(style.MEASURED, dtype=np.uint8), (len(steps), 1)),
                radii=np.full(len(steps), 0.01),
            )
            time = rr.TimeColumn(TIMELINE, timestamp=list(walls))
            along(rec, f"{self._world}/dots", time, dots)
        self._passed.append((wall, tuple(told.plan.q[0].tolist())))
        self._move()
        self._words(d)
        blueprint = live_blueprint(d, self._world, self._series)
        rec.send_blueprint(blueprint, make_active=True, make_default=True)

    def _move(self) -> None:
        """Send where the arm has been since the last time."""
        passed, self._passed, self._since = self._passed, [], 0
        if passed and self._arm is not None and self._now is not None:
            bodies = body_poses(self._now.told.arm, np.array([q for _, q in passed]))
            self._arm.send(TIMELINE, [wall for wall, _ in passed], bodies)

    def _event(self, d: LiveTally, what: object) -> None:
        if isinstance(what, ReadingStored):
            if self._batches and d.done > MANY:
                # the arm stands at each reading, and skips its ways
                del self._passed[self._since : -1]
            self._since = len(self._passed)
            self._reading(d, what)
            self._log(f"{what.done}/{what.total} {what.step}{figures(what)}")
        elif isinstance(what, Phase):
            d.phase = what.text
        elif isinstance(what, Remark | GoalMet):
            text = what.text if isinstance(what, Remark) else met_words(what)
            d.remarks.append(text)
            self._log(text, "WARN" if isinstance(what, Remark) else "INFO")
        else:
            return
        if not self._batches:
            self._words(d)

    def _reading(self, d: LiveTally, event: ReadingStored) -> None:
        """Draw a reading: each target's arrow in its ball and place in time, and a label."""
        rec, before = self._rec, d.judged
        dots, arrows, balls, now = [], [], [], []
        read = d.add(event)
        for target, live, found in read:
            at = d.place(event.step, target)
            if found is None:
                dots.append(at)
                continue
            drawn = (at, arrow(live, found), found.level)
            now.append(drawn)
            if not found.stands_out:
                continue
            if found.level or d.judged <= MANY:
                arrows.append(drawn)
            if d.judged <= (MANY if found.level else BALLS):
                balls.append(at)
            rec.log(f"{self._series}/{style.LEVEL_NAMES[found.level]}", rr.Scalars(found.sigma))
        if dots:
            dot = rr.Points3D(dots, colors=[style.MEASURED], radii=[0.01])
            rec.log(f"{self._world}/dots", dot)
        if arrows:
            rec.log(f"{self._world}/arrows", _arrows(arrows))
        if balls:
            rec.log(f"{self._world}/balls", _balls(balls))
        if now and d.group > 1:  # the last reading, drawn until the next one comes
            rec.log(f"{self._world}/now/arrow", _arrows(now))
            rec.log(f"{self._world}/now/ball", _balls([at for at, *_ in now]))
        if d.judged > before and not (self._batches and before):
            rec.log(f"{self._series}/limit", rr.Scalars(LIMIT))
        target, _, worst = max(read, key=lambda r: -1.0 if r[2] is None else r[2].norm2)
        words = f"{event.step.pose}, {event.step.load}"
        if worst is not None:
            words += f"{', ' * bool(worst.target)}{worst.target}: {worst}"
        rec.log(f"{self._world}/last", labels([d.place(event.step, target) + _ABOVE], [words]))

    def _words(self, d: LiveTally) -> None:
        self._rec.log("words/measuring", style.document(status(d)))

    def _log(self, text: str, level: str = "INFO") -> None:
        self._rec.log("log", rr.TextLog(style.safe(text), level=level))

    # revisions

    def _revised(self, story: Story) -> None:
        """Draw a revision with those before it, of the same readings."""
        rec, before = self._rec, self._story
        new = story.revisions[0]
        earlier = (
            ()
            if before is None or len(before) != len(story)
            else tuple(r for r in before.revisions if r.revision < new.revision)
        )
        self._story = replace(story, revisions=(*earlier, *story.revisions), growing=True)
        if not earlier:
            campaign.begin(rec, self._story)
        rec.set_time("revision", sequence=new.revision)
        campaign.tell_revision(rec, self._story, new)
        rec.disable_timeline("revision")
        titles = campaign.titles(self._story)
        if titles != self._titles or not earlier:
            views = campaign.blueprint(self._story)
            rec.send_blueprint(views, make_active=True, make_default=True)
            self._titles = titles


Drawn = tuple[Floats, Floats, int]
"""Where an arrow begins, m; the arrow, m; its level."""


def arrow(live: LiveResidual, found: LiveJudgement) -> Floats:
    """(3,) a residual as drawn: its direction, and as long as sqrt(rᵀ V⁻¹ r) says, m."""
    length = min(SIGMA_LENGTH * float(np.sqrt(found.norm2)), ARROW_CAP)
    return np.asarray(length / (found.length or 1.0) * np.array(live.vector))


def _arrows(of: Sequence[Drawn]) -> rr.Arrows3D:
    starts, vectors, levels = zip(*of, strict=True)
    colors = [style.LEVEL_COLORS[level] for level in levels]
    radii = [0.0055 if level else 0.0035 for level in levels]
    return rr.Arrows3D(origins=starts, vectors=vectors, colors=colors, radii=radii)


def _balls(at: Sequence[Floats]) -> rr.Ellipsoids3D:
    size, color = [(BALL, BALL, BALL)] * len(at), [(*style.NOISE, 46)]
    return rr.Ellipsoids3D(centers=at, half_sizes=size, colors=color, fill_mode="solid")
