"""Draws a command while it works: readings as they come, revisions as they are found."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint import archetypes

from hilcal.measuring.progress import ArmAt, GoalMet, Phase, ReadingStored, Remark
from hilcal.present.live_viewer import Measuring, Revised
from hilcal.present.running import figures, met_words
from hilcal.present.story import Story
from hilcal.present.viewer import layout, live_digest, stream, style
from hilcal.present.viewer.arm_shapes import MovingArm, labels
from hilcal.present.viewer.digest import Digest, digest
from hilcal.present.viewer.live_digest import BALL, LIMIT, LiveDigest, arrow
from hilcal.present.viewer.markdown import document
from hilcal.robot.body import body_poses
from hilcal.types import Floats

TIMELINE = "time"
RESIDUALS = "in σ: an arrow that leaves its noise ball = model wrong"
IN_TIME = "in σ: grey noise, amber doubtful, red model wrong"


def live_blueprint(d: LiveDigest, world: str, series: str) -> rrb.Blueprint:
    """Return the blueprint.

    Args:
        d: the campaign.
        world: the entity below which its readings are drawn.
        series: the entity below which its residuals are in time.
    """
    every = archetypes.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    of = "Residual of each reading," if d.group == 1 else f"Worst of every {d.group} residuals,"
    middle, size = _live_center(d)
    scene = layout.view3d(
        "world",
        f"{of} {RESIDUALS}",
        layout.near(middle, layout.EYE * size, live_seen(d)),
        middle,
        [f"+ {world}/**"],
        overrides={f"{world}/{name}": every for name in ("arrows", "balls", "dots")},
    )
    in_time = rrb.TimeSeriesView(
        origin=series,
        name=f"{of} {IN_TIME}",
        plot_legend=rrb.PlotLegend(visible=False),
        axis_x=archetypes.TimeAxis(
            view_range=rr.TimeRange(
                start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
            )
        ),
    )
    told = rrb.Tabs(
        rrb.TextDocumentView(origin="words/measuring", name="So far"),
        rrb.TextDocumentView(origin="words/live_guide", name="How to read this"),
    )
    return layout.whole(
        rrb.Horizontal(
            rrb.Vertical(scene, in_time, row_shares=[11, 4]),
            rrb.Vertical(told, _log(), row_shares=[3, 2]),
            column_shares=[3, 2],
        ),
        TIMELINE,
        "following",
    )


def _log() -> rrb.TextLogView:
    kinds = (rrb.encodings.TextLogColumnKind.LogLevel, rrb.encodings.TextLogColumnKind.Body)
    shown = archetypes.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn(timeline=TIMELINE, visible=False)],
        text_log_columns=[rrb.encodings.TextLogColumn(kind=kind, visible=True) for kind in kinds],
    )
    return rrb.TextLogView(origin="log", name="Log", columns=shown)


def live_seen(d: LiveDigest) -> Floats:
    """(K, 3) what is to be in the picture: targets and the arm in the first pose, m."""
    return np.vstack([d.anchor.reshape(-1, 3), d.bodies[0, :, :3, 3]])


def _live_center(d: LiveDigest) -> tuple[Floats, float]:
    points = np.vstack([d.anchor.reshape(-1, 3), np.zeros((1, 3))])
    lo, hi = points.min(0), points.max(0)
    half = float(np.linalg.norm(hi - lo)) / 2
    return (lo + hi) / 2, max(half, 0.3 * d.told.arm.reach)


_ABOVE = np.array([0.0, 0.0, 1.3 * BALL])
BALLS = 60
"""Readings from which a ball is drawn only where its arrow leaves it, for legibility."""
MANY = 300
"""Readings from which only arrows are drawn, and only those that leave their balls; a choice."""


class LiveScene:
    """What has been told so far, drawn into one recording along the time of day."""

    def __init__(self, rec: rr.RecordingStream, batches: bool = False) -> None:
        """Draw into an open recording; in `batches` the arm, and words, wait for `settle`."""
        self._rec, self._batches = rec, batches
        self._arm: MovingArm | None = None
        self._passed: list[tuple[float, tuple[float, ...]]] = []
        self._since = 0  # those of them that came before the last reading
        self._now: LiveDigest | None = None
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

        Args:
            to_open: let the recording open at the first revision, as a file does; else whoever
                watches stays at the last one.
        """
        self.settle()
        self._now = None
        if self._story is None:
            return
        self._rec.reset_time()
        d = digest(replace(self._story, growing=False))
        stream.tell(self._rec, d)
        self._rec.reset_time()
        d = d if to_open else digest(self._story)
        self._rec.send_blueprint(layout.blueprint(d), make_active=True, make_default=True)

    # measuring

    @property
    def _world(self) -> str:
        return f"world/live/{self._acts}"

    @property
    def _series(self) -> str:
        return f"live/{self._acts}"

    def _measuring(self, wall: float, told: Measuring) -> None:
        rec, d = self._rec, LiveDigest.of(told)
        self._acts, self._now = self._acts + 1, d
        rec.send_recording_name(f"hilcal: {style.safe(told.name)}")
        rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._arm = MovingArm(rec, f"{self._world}/arm", told.arm, told.targets)
        rec.log("words/live_guide", document(live_digest.GUIDE), static=True)
        rec.log(
            f"{self._world}/planned",
            rr.Points3D(d.anchor.reshape(-1, 3), colors=[style.GREY], radii=[0.006]),
            static=True,
        )
        for name, color in zip(style.LEVEL_NAMES, style.LEVEL_COLORS, strict=True):
            marks = rr.SeriesPoints(
                colors=[color], markers="circle", marker_sizes=[4.0], names=[name]
            )
            rec.log(f"{self._series}/{name}", marks, static=True)
        line = rr.SeriesLines(colors=[style.NOISE], widths=[1.5], names=["99 %"])
        rec.log(f"{self._series}/limit", line, static=True)
        self._earlier(d)
        self._passed.append((wall, tuple(told.plan.q[0].tolist())))
        self._move()
        self._words(d)
        blueprint = live_blueprint(d, self._world, self._series)
        rec.send_blueprint(blueprint, make_active=True, make_default=True)

    def _earlier(self, d: LiveDigest) -> None:
        """Send what earlier sessions measured as one batch."""
        known = [(wall, d.place(step)) for wall, step in d.told.earlier]
        if not known:
            return
        places = np.array([place for _, place in known])
        self._rec.send_columns(
            f"{self._world}/dots",
            indexes=[
                rr.TimeColumn(TIMELINE, timestamp=[wall for wall, _ in known]),
            ],
            columns=rr.Points3D.columns(
                positions=places,
                colors=np.tile(np.array(style.MEASURED, dtype=np.uint8), (len(places), 1)),
                radii=np.full(len(places), 0.01),
            ),
        )

    def _move(self) -> None:
        """Send where the arm has been since the last time."""
        passed, self._passed, self._since = self._passed, [], 0
        if passed and self._arm is not None and self._now is not None:
            bodies = body_poses(self._now.told.arm, np.array([q for _, q in passed]))
            self._arm.send(TIMELINE, [wall for wall, _ in passed], bodies)

    def _event(self, d: LiveDigest, what: object) -> None:
        if isinstance(what, ReadingStored):
            if (
                self._batches and d.done > MANY
            ):  # the arm stands at each reading, and skips its ways
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

    def _reading(self, d: LiveDigest, event: ReadingStored) -> None:
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
            name = style.LEVEL_NAMES[found.level]
            rec.log(f"{self._series}/{name}", rr.Scalars(found.sigma))
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
            words += f"{', ' * bool(worst.target)}{worst.target}: {live_digest.residual(worst)}"
        rec.log(f"{self._world}/last", labels([d.place(event.step, target) + _ABOVE], [words]))

    def _words(self, d: LiveDigest) -> None:
        self._rec.log("words/measuring", document(live_digest.status(d)))

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
        d = digest(self._story)
        if not earlier:
            stream.begin(rec, d)
        rec.set_time("revision", sequence=new.revision)
        stream.tell_revision(rec, d, new)
        rec.disable_timeline("revision")
        titles = _titles(d)
        if titles != self._titles or not earlier:
            rec.send_blueprint(layout.blueprint(d), make_active=True, make_default=True)
            self._titles = titles


Drawn = tuple[Floats, Floats, int]
"""Where an arrow begins, m; the arrow, m; its level."""


def _arrows(of: Sequence[Drawn]) -> rr.Arrows3D:
    starts, vectors, levels = zip(*of, strict=True)
    return rr.Arrows3D(
        origins=starts,
        vectors=vectors,
        colors=[style.LEVEL_COLORS[level] for level in levels],
        radii=[0.0055 if level else 0.0035 for level in levels],
    )


def _balls(at: Sequence[Floats]) -> rr.Ellipsoids3D:
    return rr.Ellipsoids3D(
        centers=at,
        half_sizes=[(BALL, BALL, BALL)] * len(at),
        colors=[(*style.NOISE, 46)],
        fill_mode="solid",
    )


def _titles(d: Digest) -> tuple[str, ...]:
    return layout.residual_title(d), layout.deflection_title(d), layout.bars_title(d)
