"""Live drawing of a running command, for connected viewers and into a recording."""

import contextlib
import math
import pickle
import threading
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import BinaryIO

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import scipy
from rerun.blueprint import archetypes

from hilcal import numbers
from hilcal.errors import HilcalError, InputError
from hilcal.measuring.progress import (
    ArmPosition,
    GoalMet,
    LiveResidual,
    Phase,
    ReadingStored,
    Remark,
)
from hilcal.present.document import Block, Items, heading, table
from hilcal.present.live_viewer import MeasuringStart
from hilcal.present.progress import duration_text, met_words, reading_text, status_words
from hilcal.present.story import LIMITS, Story, levels
from hilcal.present.viewer import campaign, recording, style
from hilcal.robot.scene import body_poses
from hilcal.store.plan import Step
from hilcal.types import Floats

PORTS = 20  # number of ports that are tried; a choice
MEMORY = "256MiB"  # of the server for viewers that join late; a choice, some 5000 readings
SHARE = 0.02  # growth at which the file is flushed, in large pieces; a killed process loses that
_FLUSH_S, _END_S = 5.0, 8.0
BALL = campaign.SIGMA_LENGTH * style.BALL_SIGMAS
"""Radius of the ball that holds 99 % of the readings if the model is right, m."""
LIMIT = style.BALL_SIGMAS / 3**0.5  # the same in the σ of a reading
ALARM = 0.001  # chance of so many readings outside their balls that calls the model wrong
WORST, REMARKS = 3, 3  # listed readings and remarks
BALLS, MANY = 60, 300
"""Number of readings above which balls, and above which arrows, are drawn only for arrows that
leave their balls; choices, for legibility."""
MAX_SINGLE_RESIDUALS = 1000
"""Most residuals that a viewer draws one by one; 10,000 take it 3.5 times the time of 100, 1000
some 1.2 times (tests/benchmarks/test_viewer_speed.py)."""
GROUPS = 150  # number of groups of more residuals; the number of bars of a finished recording
TIMELINE = "time"
RESIDUALS = "in σ: an arrow that leaves its noise ball = model wrong"
IN_TIME = "in σ: grey noise, amber doubtful, red model wrong"
_ABOVE = np.array([0.0, 0.0, 1.3 * BALL])
GUIDE = """### How to read this
Each reading is compared with a simple model, that of frames and joint compliance, fitted to the
readings **before** it.

**Residuals** (3-D): a small grey dot is a pose of the plan. A green ball is where noise and what
the model does not know yet would leave 99 % of the readings; an arrow that leaves its ball = the
model is wrong there. All arrows are in units of that noise. Grey: noise. Amber: beyond 99 %.
Red: beyond 99.99 %. Blue dots were measured before there was a model, or in an earlier session.
After 300 readings only arrows that leave their balls are drawn; all are drawn below.

A campaign of more than 1000 readings is divided into 150 groups, one after the other. The last
reading is always drawn; of the earlier ones only those stay that were the worst of their group so
far, here and below. The words count all readings, and the log lists them.

**Residual of each reading** (below): the same along the time of day, in σ as on the
terminal (rms of the three axes): 1 is noise, the green line 99 %.

Missing effects are not searched for while measuring; `hilcal refine` does that afterwards.
"""


@dataclass(frozen=True, slots=True)
class LiveJudgement:
    """The residual r of a reading against its prediction."""

    step: Step
    target: str  # its name; empty if there is only one
    length: float  # |r|, m
    norm2: float  # rᵀ V⁻¹ r, V the covariance of reading and prediction; 3 degrees of freedom
    stands_out: bool = True  # whether it is the worst of its group so far, see `LiveTally.group`

    @property
    def sigma(self) -> float:
        """sqrt(rᵀ V⁻¹ r / 3), as on the terminal: 1 on average if the model is right."""
        return math.sqrt(self.norm2 / 3)

    @property
    def level(self) -> int:
        """0 inside the noise, 1 beyond 99 %, 2 beyond 99.99 %."""
        return int(levels(np.array([self.norm2]))[0])


def judgement_of(step: Step, live: LiveResidual, target: str = "") -> LiveJudgement | None:
    """Return the judgement of a reading; None if the reading was not compared with a model."""
    if live.vector is None or live.covariance is None:
        return None
    r, v = np.array(live.vector), np.array(live.covariance).reshape(3, 3)
    return LiveJudgement(step, target, float(np.linalg.norm(r)), float(r @ np.linalg.solve(v, r)))


class LiveTally:
    """Running totals of a campaign that is being measured."""

    def __init__(self, measured: MeasuringStart) -> None:
        plan, self.measured = measured.plan, measured
        # (P, n + 2, 4, 4) poses of the arm's bodies at each pose of the plan
        self.bodies = body_poses(measured.arm, plan.q)
        flange = self.bodies[:, -1]
        offset = np.einsum("pij,tj->pti", flange[:, :3, :3], measured.targets)
        position = flange[:, None, :3, 3] + offset
        # nominal positions of the targets, base axes, m: (K, 3) in all poses, (T, 3) by pose
        self.targets = position.reshape(-1, 3)
        self._anchor = dict(zip(plan.pose_names, position, strict=True))
        # numbers of planned and of stored readings; remaining real time, s
        self.total, self.done = len(plan.steps), len({step for _, step in measured.earlier_steps})
        self.left, self.phase = 0.0, ""
        self.last: ReadingStored | None = None
        # numbers of readings that were compared with a model, and of those outside their ball
        self.judged, self.outside = 0, 0
        self.loads: dict[str, list[int]] = {}  # both by load
        self.worst: list[LiveJudgement] = []  # worst first
        self.remarks: list[str] = []  # newest last
        # number of successive residuals of which a viewer keeps those that stand out; 1: keeps all
        planned = self.total * len(measured.targets)
        self.group = 1 if planned <= MAX_SINGLE_RESIDUALS else math.ceil(planned / GROUPS)
        self._group_worst = 0.0  # largest `LiveJudgement.norm2` of the present group

    def target_position(self, step: Step, target: int = 0) -> Floats:
        """Return the nominal position (3,) of a target, m."""
        return np.asarray(self._anchor[step.pose][target])

    def add(self, event: ReadingStored) -> list[tuple[int, LiveResidual, LiveJudgement | None]]:
        """Count a reading; return each target's residual and its judgement, None without model."""
        self.last, self.done, self.left = event, event.stored, event.remaining_s
        residuals = ((event.target, event.live), *event.other_targets)
        return [(k, live, self._judge(event.step, k, live)) for k, live in residuals]

    def _judge(self, step: Step, target: int, live: LiveResidual) -> LiveJudgement | None:
        j = judgement_of(step, live, self.measured.names[target] if self.measured.names else "")
        if j is None:
            return None
        begins, outside = self.judged % self.group == 0, int(j.level > 0)
        self.judged, self.outside = self.judged + 1, self.outside + outside
        compared, beyond = self.loads.get(step.load, (0, 0))
        self.loads[step.load] = [compared + 1, beyond + outside]
        self.worst = sorted([*self.worst, j], key=lambda x: -x.norm2)[:WORST]
        j = replace(j, stands_out=begins or j.norm2 > self._group_worst)
        self._group_worst = max(j.norm2, 0.0 if begins else self._group_worst)
        return j

    def report(self) -> Iterator[Block]:
        """Yield the progress of the campaign and the verdict so far."""
        if self.judged == 0:
            yield heading("Measuring: no judgement yet")
            yield "The first readings determine tracker and target; then each one is compared."
        else:
            title, advice = "✓ So far noise explains the readings", ""
            if scipy.stats.binom.sf(self.outside - 1, self.judged, 1.0 - LIMITS[0]) < ALARM:
                title = "✗ The simple model fails: look at the red arrows"
                advice = " An effect is missing in it: hilcal refine names it after measuring."
            yield heading(title)
            yield (
                f"{self.outside} of {self.judged} ({numbers.percent(self.outside / self.judged)}) "
                "compared readings are outside their 99 % noise ball (noise alone: 1 %)." + advice
            )
        remaining = f", {duration_text(self.left)} left" if self.left > 0 else ""
        yield f"{self.done} of {self.total} readings{remaining}. {self.phase}"
        goal = None if self.last is None else self.last.goal
        if goal is not None and (value := status_words(goal)):
            yield f"Goal: {value}."
        if len(self.loads) > 1 and self.outside:
            shares = ((n, a, b, numbers.percent(b / a)) for n, (a, b) in self.loads.items())
            yield table(
                "load", "compared", "outside", "", rows=(tuple(map(str, x)) for x in shares)
            )
        if worst := [j for j in self.worst if j.level > 0]:
            rows = table("worst so far", "load", "residual", "in σ", left=(0, 1))
            for j in worst:
                name, size = f"{j.step.pose} {j.target}".rstrip(), numbers.length(j.length)
                rows.add(name, j.step.load, size, f"{j.sigma:.1f}")
            yield rows
        yield Items(tuple(f"note: {text}" for text in self.remarks[-REMARKS:]))


def live_blueprint(d: LiveTally, world: str, series: str) -> rrb.Blueprint:
    """Return the blueprint; `world`, `series`: entities of the readings and of the time series."""
    infinite, cursor = rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.cursor_relative()
    so_far = archetypes.VisibleTimeRanges(timeline=TIMELINE, start=infinite, end=cursor)
    drawn = "Residual of each reading," if d.group == 1 else f"Worst of every {d.group} residuals,"
    middle, size = style.center(d.targets, 0.3 * d.measured.arm.reach)
    points = np.vstack([d.targets, d.bodies[0, :, :3, 3]])
    place, more = style.nearest_eye(middle, style.EYE * size, points), ("arrows", "balls", "dots")
    overrides = {f"{world}/{name}": so_far for name in more}
    name = f"{drawn} {RESIDUALS}"
    scene = style.view3d("world", name, place, middle, [f"+ {world}/**"], overrides=overrides)
    in_time = rrb.TimeSeriesView(
        origin=series,
        name=f"{drawn} {IN_TIME}",
        plot_legend=rrb.PlotLegend(visible=False),
        axis_x=archetypes.TimeAxis(view_range=rr.TimeRange(start=infinite, end=infinite)),
    )
    kinds = (rrb.encodings.TextLogColumnKind.LogLevel, rrb.encodings.TextLogColumnKind.Body)
    columns = archetypes.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn(timeline=TIMELINE, visible=False)],
        text_log_columns=[rrb.encodings.TextLogColumn(kind=kind, visible=True) for kind in kinds],
    )
    log = rrb.TextLogView(origin="log", name="Log", columns=columns)
    texts = (("measuring", "So far"), ("live_guide", "How to read this"))
    left = rrb.Vertical(scene, in_time, row_shares=[11, 4])
    right = rrb.Vertical(rrb.Tabs(*(style.text(*w) for w in texts)), log, row_shares=[3, 2])
    return style.page_blueprint(left, right, TIMELINE, following=True)


class LiveScene:
    """Draws events into one recording along the time of day."""

    def __init__(self, rec: rr.RecordingStream, batches: bool = False) -> None:
        """Draw into an open recording; with `batches`, arm and texts wait for `settle`."""
        self._rec, self._batches = rec, batches
        self._arm: style.MovingArm | None = None
        self._passed: list[tuple[float, tuple[float, ...]]] = []  # (time, joint values), not sent
        self._since = 0  # number of these before the last reading
        self._tally: LiveTally | None = None
        # number of campaigns so far, entities of the last one
        self._campaigns, self._world, self._series = 0, "", ""
        self._story: Story | None = None
        self._titles: tuple[str, ...] = ()

    def draw(self, wall: float, event: object) -> None:
        """Draw an event at a time of day, s."""
        self._rec.set_time(TIMELINE, timestamp=wall)
        if isinstance(event, ArmPosition):
            self._passed.append((wall, event.q))
        if not self._batches:
            self._move()
        if isinstance(event, MeasuringStart):
            self.settle()
            self._measuring(wall, event)
        elif isinstance(event, Story):
            self._revised(event)
        elif self._tally is not None:
            self._event(self._tally, event)

    def settle(self) -> None:
        """Draw what waits for the end of a batch: motion of the arm, texts, the limit."""
        self._move()
        if self._batches and self._tally is not None and self._tally.last is not None:
            self._send_summary(self._tally)
            self._rec.log(f"{self._series}/limit", rr.Scalars(LIMIT))

    def end(self, to_open: bool) -> None:
        """Draw the complete story again; `to_open`: a file, which opens at its first revision."""
        self.settle()
        self._tally = None
        if self._story is None:
            return
        self._rec.reset_time()
        story = replace(self._story, growing=False)
        campaign.log_story(self._rec, story)
        self._rec.reset_time()
        self._show(campaign.blueprint(story if to_open else self._story))

    def _show(self, views: rrb.Blueprint) -> None:
        self._rec.send_blueprint(views, make_active=True, make_default=True)

    def _measuring(self, wall: float, start: MeasuringStart) -> None:
        rec, d = self._rec, LiveTally(start)
        self._campaigns, self._tally = self._campaigns + 1, d
        self._series = f"live/{self._campaigns}"
        self._world = f"world/{self._series}"
        rec.send_recording_name(f"hilcal: {style.storable(start.name)}")
        rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._arm = style.MovingArm(rec, f"{self._world}/arm", start.arm, start.targets)
        rec.log("words/live_guide", style.document(GUIDE), static=True)
        planned = rr.Points3D(d.targets, colors=[style.GREY], radii=[0.006])
        rec.log(f"{self._world}/planned", planned, static=True)
        for name, color in zip(style.LEVEL_NAMES, style.LEVEL_COLORS, strict=True):
            rec.log(f"{self._series}/{name}", style.series(name, color, 0.0, 4.0)[1], static=True)
        line = rr.SeriesLines(colors=[style.NOISE], widths=[1.5], names=["99 %"])
        rec.log(f"{self._series}/limit", line, static=True)
        if start.earlier_steps:  # readings of earlier sessions, as one batch
            walls, steps = zip(*start.earlier_steps, strict=True)
            dots = rr.Points3D.columns(
                positions=[d.target_position(step) for step in steps],
                colors=np.tile(np.array(style.MEASURED, dtype=np.uint8), (len(steps), 1)),
                radii=np.full(len(steps), 0.01),
            )
            rec.send_columns(
                f"{self._world}/dots", [rr.TimeColumn(TIMELINE, timestamp=list(walls))], dots
            )
        self._passed.append((wall, tuple(start.plan.q[0].tolist())))
        self._move()
        self._send_summary(d)
        self._show(live_blueprint(d, self._world, self._series))

    def _move(self) -> None:
        passed, self._passed, self._since = self._passed, [], 0
        if passed and self._arm is not None and self._tally is not None:
            bodies = body_poses(self._tally.measured.arm, np.array([q for _, q in passed]))
            self._arm.send(TIMELINE, [wall for wall, _ in passed], bodies)

    def _event(self, d: LiveTally, event: object) -> None:
        if isinstance(event, ReadingStored):
            if self._batches and d.done > MANY:
                # only the arm's position at each reading is drawn, not its motion
                del self._passed[self._since : -1]
            self._since = len(self._passed)
            self._reading(d, event)
            self._log(f"{event.stored}/{event.total} {event.step}{reading_text(event)}")
        elif isinstance(event, Phase):
            d.phase = event.text
        elif isinstance(event, Remark | GoalMet):
            text = event.text if isinstance(event, Remark) else met_words(event)
            d.remarks.append(text)
            self._log(text, "WARN" if isinstance(event, Remark) else "INFO")
        else:
            return
        if not self._batches:
            self._send_summary(d)

    def _reading(self, d: LiveTally, event: ReadingStored) -> None:
        rec, count = self._rec, d.judged
        dots, arrows, balls, last = [], [], [], []
        judgements = d.add(event)
        for target, live, j in judgements:
            place = d.target_position(event.step, target)
            if j is None:
                dots.append(place)
                continue
            # along r, of length sqrt(rᵀ V⁻¹ r) in σ
            length = min(campaign.SIGMA_LENGTH * math.sqrt(j.norm2), campaign.ARROW_CAP)
            arrow = (place, length / (j.length or 1.0) * np.array(live.vector), j.level)
            last.append(arrow)
            if not j.stands_out:
                continue
            if j.level or d.judged <= MANY:
                arrows.append(arrow)
            if d.judged <= (MANY if j.level else BALLS):
                balls.append(place)
            rec.log(f"{self._series}/{style.LEVEL_NAMES[j.level]}", rr.Scalars(j.sigma))
        if dots:
            rec.log(f"{self._world}/dots", rr.Points3D(dots, colors=[style.MEASURED], radii=[0.01]))
        if arrows:
            rec.log(f"{self._world}/arrows", style.residual_arrows(*zip(*arrows, strict=True)))
        if balls:
            rec.log(f"{self._world}/balls", style.noise_balls(balls, [[BALL] * 3] * len(balls)))
        if last and d.group > 1:  # the last reading, until the next one replaces it
            ball = style.noise_balls([place for place, *_ in last], [[BALL] * 3] * len(last))
            rec.log(f"{self._world}/now/arrow", style.residual_arrows(*zip(*last, strict=True)))
            rec.log(f"{self._world}/now/ball", ball)
        if d.judged > count and not (self._batches and count):
            rec.log(f"{self._series}/limit", rr.Scalars(LIMIT))
        target, _, worst = max(judgements, key=lambda r: -1.0 if r[2] is None else r[2].norm2)
        label = f"{event.step.pose}, {event.step.load}"
        if worst is not None:
            size = f"{numbers.length(worst.length)} ({worst.sigma:.1f} σ)"
            label += f"{', ' * bool(worst.target)}{worst.target}: {size}"
        above = d.target_position(event.step, target) + _ABOVE
        rec.log(f"{self._world}/last", style.labels([above], [label]))

    def _send_summary(self, d: LiveTally) -> None:
        self._rec.log("words/measuring", style.document(style.markdown(d.report())))

    def _log(self, text: str, level: str = "INFO") -> None:
        self._rec.log("log", rr.TextLog(style.storable(text), level=level))

    def _revised(self, story: Story) -> None:
        """Draw a revision after the previous ones of the same readings."""
        rec, last, new = self._rec, self._story, story.revisions[0]
        drawn = last.revisions if last is not None and len(last) == len(story) else ()
        previous = tuple(r for r in drawn if r.revision < new.revision)
        self._story = story = replace(story, revisions=(*previous, *story.revisions), growing=True)
        if not previous:
            campaign.log_static_entities(rec, story)
        rec.set_time("revision", sequence=new.revision)
        campaign.log_revision(rec, story, new)
        rec.disable_timeline("revision")
        titles = campaign.titles(story)
        if titles != self._titles or not previous:
            self._show(campaign.blueprint(story))
            self._titles = titles


def follow(messages: BinaryIO, reply: Callable[..., None], record: Path, port: int) -> None:
    """Draw pickled messages (time of day in s, event) into a file, and at a port from `port` on."""
    identifier = str(uuid.uuid4())
    outlets = [_Outlet(identifier, reply, file=record)]
    with contextlib.suppress(OSError):
        recording.disable_analytics()
    ports = range(port, port + PORTS)
    free = next((p for p in ports if recording.bind_error(p) is None), None)
    if free is None:
        reply(problem=f"no free port from {port} to {ports[-1]}: no live viewer is served")
        reply(url=None)
    else:
        outlets.append(_Outlet(identifier, reply, port=free))
        reply(url=f"rerun+http://{recording.LOOPBACK}:{free}/proxy")
    with contextlib.suppress(EOFError, pickle.UnpicklingError):
        while True:
            wall, event = pickle.load(messages)  # noqa: S301 - of the command that started us
            for outlet in outlets:
                outlet.draw(wall, event)
    guard = threading.Thread(target=lambda: list(map(_Outlet.end, outlets)), daemon=True)
    guard.start()
    guard.join(_END_S)


class _Outlet:
    """A file or a port that gets the drawing; a failure is reported once, other outlets go on."""

    def __init__(
        self, identifier: str, reply: Callable[..., None], file: Path | None = None, port: int = 0
    ) -> None:
        self._reply, self._file = reply, file
        self._name = f"recording {file}" if file else f"live viewer at port {port}"
        self._scene: LiveScene | None = None
        self._drawn, self._written = 0, 0
        config = rr.ChunkBatcherConfig(flush_tick=timedelta(days=1)) if file else None
        self._rec = recording.stream(identifier, config)
        try:
            self._rec.set_sinks(
                rr.FileSink(str(file))
                if file
                else rr.GrpcServerSink(recording.LOOPBACK, port, server_memory_limit=MEMORY)
            )
            self._scene = LiveScene(self._rec, batches=file is not None)
        except (OSError, RuntimeError, ValueError) as error:
            self._fail(error)

    def draw(self, wall: float, event: object) -> None:
        """Draw an event, and flush at once or with a later event."""
        complete = not isinstance(event, ArmPosition)  # positions of the arm are sent in batches
        at_once = isinstance(event, MeasuringStart | Story)
        self._draw(lambda scene: scene.draw(wall, event), complete, at_once)

    def _draw(self, draw: Callable[[LiveScene], None], complete: bool, at_once: bool) -> None:
        if self._scene is None:
            return
        try:
            draw(self._scene)
            self._drawn += complete
            little = self._drawn - self._written < max(1.0, SHARE * self._drawn)
            if not complete or (self._file and little and not at_once):
                return
            self._written = self._drawn
            self._scene.settle()
        except (InputError, ValueError, IndexError, KeyError) as error:
            self._reply(problem=f"{self._name}: not drawn: {error}")
        size = self._size()
        try:
            self._rec.flush(timeout_sec=_FLUSH_S)
        except (OSError, RuntimeError, ValueError, HilcalError) as error:
            if not recording.is_timeout(error):
                self._fail(error)
            elif self._file and self._size() == size:  # rerun does not report a failed write
                self._fail(f"nothing was written for {_FLUSH_S:.0f} s; is the disk full?")
            # else slow: the command drops messages that its queue cannot hold

    def end(self) -> None:
        """Draw the complete story and close the outlet."""
        self._draw(lambda scene: scene.end(self._file is not None), complete=True, at_once=True)
        if self._scene is not None:  # after a failure `disconnect` would wait forever
            self._rec.disconnect()

    def _size(self) -> int:
        return self._file.stat().st_size if self._file and self._file.exists() else 0

    def _fail(self, error: Exception | str) -> None:
        self._scene = None
        self._reply(problem=f"{self._name}: cannot be written ({error}); everything else goes on")
