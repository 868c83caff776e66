"""A campaign in rerun: a recording in a file, or served to viewers."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hilcal import numbers
from hilcal.errors import HilcalError, InputError
from hilcal.present.document import Block, heading, table
from hilcal.present.live_viewer import PORT
from hilcal.present.story import (
    LEVEL_NAMES,
    REVISION_HEADS,
    DependenceCurve,
    Story,
    StoryRevision,
    levels,
    round_factor,
    worst_and_even,
)
from hilcal.present.viewer import recording, style
from hilcal.present.viewer.recording import LOOPBACK
from hilcal.robot.scene import capsules
from hilcal.types import Floats, Ints

FOLLOWS = "What the residual follows"
LAW = "Law beyond the catalogue: blue readings, green law"
ERRORS = "Error of each revision [µm]: blue fitted, pink left out, red largest, green noise"
SERIES = {
    "fit": style.MEASURED,
    "holdout": style.HOLDOUT,
    "largest": style.RED,
    "noise": style.NOISE,
}
"""Entities and colours of the errors of revisions, see `ERRORS`."""
BARS = 150  # most bars of poses
_BINS = 12  # most bins for the means of single readings
SIGMA_LENGTH, ARROW_CAP = 0.02, 0.40  # drawn length of one σ, and largest length of an arrow, m
DEFLECTION_LENGTH, DEFLECTION_CAP = 0.25, 0.6  # the same for a large measured deflection, m
ARROWS, BALLS, PAIRS = 150, 60, 150
"""Most drawn residuals, balls and pairs of deflections, for legible pictures and small files."""
_LABEL_ABOVE = np.array([0.0, 0.0, 0.3])
_DOT = 0.012  # m, half the pitch of the dots of a leader
_MARKS = {"adequate": "✓ ", "missing_effect": "✗ ", "unknown_effect": "✗ "}
_POSE_LOADS = 12
GUIDE = """### How to read this
**Timelines** (bottom left): *revision* goes through the models, the first one first: drag the
slider, or press Space to play. *pose* moves the arm through all poses, with the last model; the
bright ball is the present pose.

**Residuals** (3-D): each green ball is where noise alone would leave 99 % of the readings.
An arrow that leaves its ball = the model is wrong there. Grey: noise. Amber: beyond 99 %.
Red: beyond 99.99 %. The arm stands in the pose of the worst reading; a dotted line leads from it
to its label and is no residual.

**Deflection** (3-D): blue is measured, white is predicted, both enlarged; one pair per pose, of
its largest deflection. The line between their tips is what the model misses. Where only blue is
seen, the model is right.

**Worst reading of each pose**: the length of its residual in σ of its own noise. The tallest bar
is the worst reading; the order in µm can be another, where some readings are noisier.

**Error of each revision**: rms over fitted poses, over poses left out, and the longest residual
in µm, against the noise. Left-out error far above the fitted one = too many parameters.

**What the residual follows**: its mean over the leading suspect, or, where that explains little of
it, over the recorded variable that carries most of it; the line above names both axes.
"""


def save(story: Story, path: Path) -> None:
    """Write a story as a recording file; see `recording.write`."""
    rec = _opened(story)
    recording.write(rec, blueprint(story), lambda: log_story(rec, story), Path(path))


@contextlib.contextmanager
def serve(story: Story, port: int = PORT) -> Iterator[str]:
    """Serve a story at the yielded address until the block ends.

    Viewers (`rerun ADDRESS`) may join late and rejoin; their analytics are disabled for this user.
    Raises InputError if the port is occupied, HilcalError if it cannot be served.
    """
    server = f"viewer server {LOOPBACK}:{port}"
    recording.disable_analytics()
    if (why := recording.bind_error(port)) is not None:
        raise InputError(f"{server}: {why}; choose a free port of this machine")
    try:
        rec = _opened(story)
        rec.set_sinks(rr.GrpcServerSink(bind_ip=LOOPBACK, port=port))
        # Active, too: a viewer that showed another recording would keep its layout.
        rec.send_blueprint(blueprint(story), make_active=True, make_default=True)
        log_story(rec, story)
    except (OSError, RuntimeError) as error:
        raise HilcalError(f"{server}: {error}") from error
    try:
        yield f"rerun+http://{LOOPBACK}:{port}/proxy"
    finally:
        rec.disconnect()


def _opened(story: Story) -> rr.RecordingStream:
    arrays = (story.q, story.pose, story.anchor, story.measured, story.covariance)
    names = (story.arm.name, story.mode, story.load_names, story.pose_names)
    texts = [(r.revision, r.change, r.verdict, r.cells, r.panels) for r in story.revisions]
    return recording.content_stream(names, *arrays, texts, *(r.residual for r in story.revisions))


def log_story(rec: rr.RecordingStream, story: Story) -> None:
    """Log the complete story, flushed after each revision."""
    rec.send_recording_name(f"hilcal: {style.storable(story.arm.name)}, {len(story)} readings")
    log_static_entities(rec, story)
    for r in story.revisions:
        rec.set_time("revision", sequence=r.revision)
        log_revision(rec, story, r)
        recording.flush(rec)
    rec.reset_time()
    _poses(rec, story)
    recording.flush(rec)


def log_static_entities(rec: rr.RecordingStream, story: Story) -> None:
    """Log the static entities: shapes of the arm, axes of the world, the guide."""
    rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    parts = style.shapes(capsules(story.arm), style.rails(story.arm))
    style.log_shapes(rec, [*parts, *style.target_shapes(story.arm, story.targets)])
    if story.target is not None:
        names = [story.target_names[k] for k in np.unique(story.target)]
        rec.log(
            f"world/arm/body{story.arm.n + 1}/names",
            style.labels(story.targets, names),
            static=True,
        )
    rec.log("words/guide", style.document(GUIDE), static=True)


def log_revision(rec: rr.RecordingStream, story: Story, r: StoryRevision) -> None:
    """Log one revision at the recording's current time."""
    _scene(rec, story, r)
    _error_bars(rec, story)
    _pose_bars(rec, story, r)
    _curve_bars(rec, "follows", r.dependence)
    if any(x.laws for x in story.revisions):
        _curve_bars(rec, "law", r.laws[0] if r.laws else None)
    for name, text in (
        ("verdict", verdict(story, r)),
        ("parameters", style.markdown(r.panels.get("parameters", ()))),
        ("revisions", revisions(story, r.revision)),
        ("details", details(story, r)),
    ):
        rec.log(f"words/{name}", style.document(text))
    line = (
        f"revision {r.revision} ({r.name}): {numbers.length(r.error.rms_m)} rms, "
        f"poses left out {numbers.length(r.holdout.rms_m)}, "
        f"noise {numbers.length(story.noise_floor_m)}: {r.verdict.replace('_', ' ')}"
    )
    rec.log("log", rr.TextLog(style.storable(line), level="INFO"))


def _poses(rec: rr.RecordingStream, story: Story) -> None:
    """Log the last revision on the timeline `pose`, and move the arm along it."""
    r, time = story.revisions[-1], rr.TimeColumn("pose", sequence=story.poses)
    rec.set_time("pose", sequence=int(story.poses[0]))
    log_revision(rec, story, r)
    rec.reset_time()
    style.send_poses(rec, time, story.bodies)
    far = story.last_of_poses(r.whitened_norm2)
    place, (half, quaternions) = story.anchor[far], noise_balls(story, far)
    current = rr.Arrows3D.columns(
        origins=place,
        vectors=arrows(story, r, far),
        colors=style.LEVEL_COLORS[r.level[far]],
        radii=np.full(len(far), 0.012),
    )
    rec.send_columns("world/residual/current", [time], current)
    bright = np.tile(np.array(style.PREDICTED, dtype=np.uint8), (len(far), 1))
    ball = rr.Ellipsoids3D.columns(
        centers=place, half_sizes=half, quaternions=quaternions, colors=bright
    )
    rec.send_columns("world/residual/ball", [time], ball)
    dots = [leader(p, h) for p, h in zip(place, half, strict=True)]
    strips = rr.LineStrips3D.columns(strips=np.concatenate(dots))
    rec.send_columns("world/residual/leader", [time], strips.partition([len(x) for x in dots]))
    labels = [f"pose {story.pose_name(i)}: {_size(story, r, i)}" for i in far.tolist()]
    rec.send_columns(
        "world/residual/worst", [time], style.label_columns(place + _LABEL_ABOVE, labels)
    )
    rec.send_columns("words/verdict", [time], style.documents(pose_cards(story)))
    # the bar of the current pose; its entity's name, last in order, puts it in front
    for pose, left, width, height in zip(*_bar_places(story, r), strict=True):
        rec.set_time("pose", sequence=int(pose))
        bar = rr.BarChart([height], abscissa=[left], widths=[width], color=style.MEASURED)
        rec.log("bars/zcurrent", bar)
    rec.reset_time()


def blueprint(story: Story) -> rrb.Blueprint:
    """Return the blueprint: left 3-D over errors, right the verdict over details."""
    residual, deflection, bars = titles(story)
    left = rrb.Vertical(
        rrb.Tabs(_view3d(story, residual, "deflection"), _view3d(story, deflection, "residual")),
        rrb.Tabs(_bars("errors", ERRORS), _bars("bars", bars)),
        row_shares=[11, 4],
    )
    laws = [_curve_view("law", LAW)] if any(r.laws for r in story.revisions) else []
    texts = (("verdict", "Verdict"), ("details", "Details"), ("guide", "How to read this"))
    right = rrb.Vertical(
        rrb.Tabs(*(style.text(*t) for t in texts)),
        rrb.Tabs(
            _curve_view("follows", FOLLOWS),
            *laws,
            style.text("parameters", "Parameters ± σ"),
            style.text("revisions", "Table"),
            rrb.TextLogView(origin="log", name="Log"),
        ),
        row_shares=[5, 4],
    )
    return style.page_blueprint(left, right, "revision", following=story.growing, fps=1.0)


def titles(story: Story) -> tuple[str, str, str]:
    """Return the titles of residuals, deflections and bars, with their scales and counts."""
    some, n = len(arrow_readings(story, story.revisions[0])), len(story)
    part = f" (about {some} of {n} readings)" if some < n else ""
    quantity = "Deflection" if story.mode == "deflection" else "Deviation from nominal"
    several = poses_per_bar(story)
    poses = f" ({several} poses per bar)" if several > 1 else ""
    return (
        f"Residual ×{residual_scale(story):g}{part}: an arrow that leaves its "
        "noise ball = model wrong",
        f"{quantity} ×{deflection_scale(story):g}: blue measured, white predicted, red missed",
        f"Worst reading of each pose, in σ{poses}: grey noise, amber doubtful, red model wrong",
    )


def _view3d(story: Story, name: str, without: str) -> rrb.Spatial3DView:
    """Return a 3-D view that shows the targets, the arm in its worst poses and the labels."""
    far = [worst(r) for r in story.revisions]
    stands = story.bodies[story.row[far], :, :3, 3].reshape(-1, 3)
    points = np.vstack([story.anchor, stands, story.anchor[far] + _LABEL_ABOVE])
    middle, size = style.center(story.anchor, 0.3 * story.arm.reach)
    place = style.nearest_eye(middle, style.EYE * size, points)
    contents = ["+ $origin/**", f"- $origin/{without}/**", "- $origin/live/**"]
    return style.view3d("world", name, place, middle, contents)


def _bars(origin: str, name: str, titlebar: bool = True) -> rrb.BarChartView:
    quiet = rrb.PlotLegend(visible=False)
    return rrb.BarChartView(origin=origin, name=name, plot_legend=quiet, titlebar=titlebar)


def _curve_view(entity: str, name: str) -> rrb.Vertical:
    """Return the bars of a curve below a description of its axes, which a bar chart lacks."""
    axes = rrb.TextDocumentView(origin=f"words/{entity}", name=f"{name}: axes", titlebar=False)
    return rrb.Vertical(axes, _bars(entity, name, titlebar=False), row_shares=[1, 6], name=name)


def _error_bars(rec: rr.RecordingStream, story: Story) -> None:
    """Log the errors of all revisions, µm, as four adjacent bars per revision."""
    rows, floor = story.revisions, story.noise_floor_m
    sizes = np.array([(r.error.rms_m, r.holdout.rms_m, r.error.max_m, floor) for r in rows])
    number, width = np.array([float(r.revision) for r in rows]), 0.8 / len(SERIES)
    for k, (name, color) in enumerate(SERIES.items()):
        left, widths = number - 0.4 + k * width, np.full(len(number), width)
        bars = rr.BarChart(1e6 * sizes[:, k], abscissa=left, widths=widths, color=color)
        rec.log(f"errors/{name}", bars)


def _curve_bars(rec: rr.RecordingStream, entity: str, c: DependenceCurve | None) -> None:
    """Log a curve as bars, single readings as means of bins, each next to the bar of the law."""
    bars: dict[str, Floats] = {}
    edges, axes = np.zeros(0), "Nothing is drawn of this revision."
    if c is not None and len(c.x):
        x, y, axes = c.x, c.y, f"Horizontal: {c.x_label}; vertical: {c.y_label}."
        if c.error is None:
            order = np.argsort(x, kind="stable")
            bins = np.array_split(order, min(_BINS, max(1, len(order) // 4)))
            x, y = (np.array([v[b].mean() for b in bins]) for v in (x, y))
        order = np.arange(len(x)) if c.names else np.argsort(x, kind="stable")
        bars["mean"] = y[order]
        if c.line is not None:
            bars["law"] = np.interp(x[order], *c.line)
        center = order.astype(float) if c.names else x[order]
        gaps = np.diff(center) if len(center) > 1 else np.ones(1)
        padded = np.concatenate([center[:1] - gaps[:1], center, center[-1:] + gaps[-1:]])
        edges = 0.5 * (padded[1:] + padded[:-1])
    rec.log(f"words/{entity}", style.document(style.markdown([axes])))
    for k, (part, color) in enumerate((("mean", style.MEASURED), ("law", style.NOISE))):
        if part not in bars:
            rec.log(f"{entity}/{part}", rr.Clear(recursive=False))
            continue
        width = np.diff(edges) / len(bars)
        bar = rr.BarChart(bars[part], abscissa=edges[:-1] + k * width, widths=width, color=color)
        rec.log(f"{entity}/{part}", bar)


def _pose_bars(rec: rr.RecordingStream, story: Story, r: StoryRevision) -> None:
    """Log the worst reading of each bar's poses, in σ, one series per level."""
    _, left, width, height = _bar_places(story, r)
    for i, name in enumerate(style.LEVEL_NAMES):
        members = levels(height**2, int(np.max(r.elements))) == i
        # a level without members gets a bar of height 0
        some = members if members.any() else np.arange(len(height)) == 0
        color, tall = style.LEVEL_COLORS[i].tolist(), np.where(members, height, 0.0)[some]
        bar = rr.BarChart(tall, abscissa=left[some], widths=width[some], color=color)
        rec.log(f"bars/{name}", bar)


def poses_per_bar(story: Story) -> int:
    """Return the number of consecutive poses that share one bar, so that bars stay legible."""
    return -(-len(story.poses) // BARS)


def _bar_places(story: Story, r: StoryRevision) -> tuple[Ints, Floats, Floats, Floats]:
    """Return number of the first pose, left edge, width, and height in σ of every bar."""
    starts = np.arange(0, len(story.poses), poses_per_bar(story))
    edges = np.append(story.poses[starts], story.poses[-1] + 1) - 0.5
    height = np.maximum.reduceat(r.sigma[story.last_of_poses(r.whitened_norm2)], starts)
    return story.poses[starts], edges[:-1], np.diff(edges), height


def verdict(story: Story, r: StoryRevision) -> str:
    """Return the verdict of a revision with its suspects; short, to fit a small window."""
    order = [o.revision for o in story.revisions]
    k, count = order.index(r.revision) + 1, len(order)
    position = f" of {count}" if order == [*range(1, count + 1)] else f" ({k} of {count})"
    place = "" if story.growing else f"{position}{', the last' * (k == count > 1)}"
    says = f"{_MARKS.get(r.verdict, '')}{r.verdict.replace('_', ' ')}"
    head = heading(f"Revision {r.revision}{place}: {says}")
    return style.markdown([head, *r.panels.get("verdict", ())])


def details(story: Story, r: StoryRevision) -> str:
    """Return the worst reading of a revision, and the diagnosis as on the terminal."""
    outside, i = float(np.mean(r.level > 0)), worst(r)
    summary = (
        f"{numbers.percent(outside)} of readings are outside their 99 % noise ball (noise alone: "
        f"1 %). Worst: pose {story.pose_name(i)}, load {story.load_names[i]}, "
        f"{numbers.length(float(r.size_m[i]))} ({r.sigma[i]:.1f} σ)."
    )
    head = heading(f"Revision {r.revision}: {r.name}")
    return style.markdown([head, summary, *r.panels.get("details", ())])


def pose_cards(story: Story) -> list[str]:
    """Return a description of each pose in the last revision: residual per load, and joints."""
    r, size = story.revisions[-1], story.revisions[-1].size_m
    sigma, level, out = r.sigma, r.level, []
    order = np.argsort(story.row, kind="stable")
    ends = np.cumsum(np.bincount(story.row, minlength=len(story.poses)))
    for k, rows in enumerate(np.split(order, ends[:-1])):
        rms = numbers.length(float(np.sqrt(np.mean(size[rows] ** 2))))
        cells = [
            (story.load_names[i], numbers.length(size[i]), f"{sigma[i]:.1f}", LEVEL_NAMES[level[i]])
            for i in rows[:_POSE_LOADS].tolist()
        ]
        joints = map(numbers.joint_value, story.q[story.first[k]].tolist(), story.arm.units)
        card: list[Block] = [
            heading(f"Pose {story.pose_name(int(rows[0]))}: {rms} rms"),
            f"With the model of revision {r.revision}: {r.name}.",
            table("load", "residual", "in σ", "", rows=cells, left=(0, 3)),
            f"Joints {', '.join(joints)}.",
        ]
        out.append(style.markdown(card))
    return out


def revisions(story: Story, upto: int) -> str:
    """Return the table of the revisions up to number `upto`."""
    rows = [r.cells for r in story.revisions if r.revision <= upto and r.cells]
    floor = f"Noise alone would leave {numbers.length(story.noise_floor_m)} rms."
    return style.markdown([table(*REVISION_HEADS, rows=rows, left=(0, 1, 7)), floor])


def residual_scale(story: Story) -> float:
    """Return the drawn length per length of a residual."""
    sigma = float(np.sqrt(np.median(np.trace(story.covariance, axis1=1, axis2=2)) / 3))
    return round_factor(SIGMA_LENGTH / sigma, style.FACTORS) if sigma > 0 else 1.0


def deflection_scale(story: Story) -> float:
    """Return the drawn length per length of a deflection."""
    moved = np.linalg.norm(story.deviation(story.measured), axis=1)
    typical = float(np.quantile(moved, 0.95))
    return round_factor(DEFLECTION_LENGTH / typical, style.FACTORS) if typical > 0 else 1.0


def noise_balls(story: Story, rows: Ints) -> tuple[Floats, Floats]:
    """Return half axes (K, 3) in m, to scale, and quaternions (K, 4) of readings' noise balls.

    C = V diag(w) Vᵀ, V a proper rotation, has half axes sqrt(w) at one σ.
    """
    w, v = np.linalg.eigh(story.covariance[rows])
    v[:, :, 0] *= np.sign(np.linalg.det(v))[:, None]
    half = style.BALL_SIGMAS * residual_scale(story) * np.sqrt(np.maximum(w, 0.0))
    return np.maximum(half, 1e-3), style.quaternions_of(v)


def worst(r: StoryRevision) -> int:
    """Return the reading with the largest Mahalanobis distance."""
    return int(np.argmax(r.whitened_norm2))


def ball_readings(story: Story, r: StoryRevision) -> Ints:
    """Return the readings whose balls are drawn: the worst reading of each chosen pose."""
    of_pose = story.last_of_poses(r.whitened_norm2)
    return np.asarray(of_pose[worst_and_even(r.whitened_norm2[of_pose], BALLS)])


def arrow_readings(story: Story, r: StoryRevision) -> Ints:
    """Return the readings whose arrows are drawn: with balls, the worst, and evenly chosen ones."""
    return np.union1d(worst_and_even(r.whitened_norm2, ARROWS), ball_readings(story, r))


def _scene(rec: rr.RecordingStream, story: Story, r: StoryRevision) -> None:
    """Log one revision at the current time: arrows, balls, the arm in the worst pose."""
    far, drawn, balls = worst(r), arrow_readings(story, r), ball_readings(story, r)
    style.log_poses(rec, story.bodies[story.row[far]])
    residuals = story.anchor[drawn], arrows(story, r, drawn), r.level[drawn]
    rec.log("world/residual/arrows", style.residual_arrows(*residuals))
    noise = style.noise_balls(story.anchor[balls], *noise_balls(story, balls))
    rec.log("world/residual/noise", noise)
    place, label = story.anchor[far], f"worst: pose {story.pose_name(far)}, {_size(story, r, far)}"
    rec.log("world/residual/worst", style.labels([place + _LABEL_ABOVE], [label]))
    dots = list(leader(place, noise_balls(story, np.array([far]))[0]))
    lines = rr.LineStrips3D(dots, colors=[style.LEADER], radii=rr.Radius.ui_points(0.5))
    rec.log("world/residual/leader", lines)
    # per chosen pose: measured and predicted arrow of its largest deflection, and their difference
    of_pose = story.last_of_poses(np.linalg.norm(story.deviation(story.measured), axis=1))
    some = of_pose[worst_and_even(r.whitened_norm2[of_pose], PAIRS)]
    feet, scale, tips = story.anchor[some], deflection_scale(story), []
    for name, value, color, radius in (
        ("measured", story.measured, style.MEASURED, 0.0055),
        ("predicted", r.predicted, style.PREDICTED, 0.0045),
    ):
        moved = capped(story.deviation(value)[some] * scale, DEFLECTION_CAP)
        tips.append(feet + moved)
        pair = rr.Arrows3D(origins=feet, vectors=moved, colors=[color], radii=[radius])
        rec.log(f"world/deflection/{name}", pair)
    colors, thin = style.LEVEL_COLORS[r.level[some]], rr.Radius.ui_points(1.6)
    missed = rr.LineStrips3D(np.stack(tips, 1), colors=colors, radii=thin)
    rec.log("world/deflection/missed", missed)


def _size(story: Story, r: StoryRevision, i: int) -> str:
    name = "" if story.target is None else f"{story.target_names[story.target[i]]} "
    return f"{name}{numbers.length(float(r.size_m[i]))} ({r.sigma[i]:.1f} σ)"


def leader(center: Floats, ball: Floats) -> Floats:
    """Return dots (K, 2, 3) from above a noise ball to its label, m; unlike an arrow."""
    top = float(_LABEL_ABOVE[2])
    z = np.arange(min(1.1 * float(ball.max()), top - _DOT), top, 2.0 * _DOT)
    ends = np.stack([z, np.minimum(z + 0.5 * _DOT, top)], 1)
    return np.asarray(center + ends[:, :, None] * np.array([0.0, 0.0, 1.0]))


def arrows(story: Story, r: StoryRevision, rows: Ints) -> Floats:
    """Return the residuals (K, 3) of readings to scale, with limited length, m."""
    return capped(r.residual[rows] * residual_scale(story), ARROW_CAP)


def capped(vectors: Floats, length: float) -> Floats:
    """Return vectors (K, 3), shortened to `length` if they are longer."""
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors * np.minimum(1.0, length / np.maximum(norm, 1e-300)))
