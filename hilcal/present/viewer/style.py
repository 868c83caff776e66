"""What all views share: colours, shapes of the arm, labels, words as markdown, frames and eyes."""

import re
from collections.abc import Iterable, Sequence
from typing import Any, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy import stats
from scipy.spatial.transform import Rotation

from hilcal.config import Obstacle
from hilcal.measuring.clearance import holds
from hilcal.present import story
from hilcal.present.document import Block, Chart, Items, Table, Words, says
from hilcal.present.viewer.recording import along, fixed
from hilcal.robot.arm import Arm
from hilcal.robot.body import Capsule, capsules
from hilcal.types import Bools, Floats

Color = tuple[int, int, int]

GREY: Color = (150, 152, 160)
AMBER: Color = (255, 176, 0)
RED: Color = (220, 38, 80)
MEASURED: Color = (86, 180, 233)
PREDICTED: Color = (240, 240, 240)
NOISE: Color = (0, 158, 115)
HOLDOUT: Color = (204, 121, 167)
DARK: Color = (92, 98, 110)
LEVEL_COLORS = np.array([GREY, AMBER, RED], dtype=np.uint8)
# Words in a picture stand in a box that the viewer makes: almost black in its dark theme, a middle
# grey in its light one. Only white is legible in both, so colours are told by marks beside words.
LABEL: Color = (255, 255, 255)
LEADER: Color = (165, 168, 176)
LEVEL_NAMES = tuple(name.split()[0] for name in story.LEVEL_NAMES)  # of entities
MARKS = {"good": "✓ ", "doubt": "✗ "}
BALL_SIGMAS = float(np.sqrt(stats.chi2.ppf(story.LIMITS[0], 3)))
ROD, TARGET = 0.0065, 0.012  # radii of the tool's rod and of the target, shares of the reach
EYE = np.array([1.05, -1.35, 0.55])
# Views that draw with light colours stay dark in the light theme too.
BACKGROUND = rrb.Background(color=(22, 24, 29), kind=rrb.BackgroundKind.SolidColor)
GRID = rrb.LineGrid3D(visible=True, spacing=0.25, stroke_width=0.7, color=(120, 124, 132, 70))

FACTORS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)  # by which lengths are enlarged, times 10^k
# Greek letters and these signs are in the viewer's fonts; a missing glyph ends the viewer.
_SIGNS = "■●▲→µ²³±×√Δ✓✗⚠°"
_BARS = str.maketrans("", "", "▁▂▃▄▅▆▇█")  # of tables on a terminal; not in the viewer's fonts
_UNSAFE = re.compile(rf"[^\n\x20-\x7e\u00a1-\u00ac\u00ae-\u00ff\u0391-\u03a9\u03b1-\u03c9{_SIGNS}]")
_MARKDOWN = re.compile(r"([\\`*_\[\]<>|#~$])")
_TURNS = np.deg2rad(np.array([0, 15, -15, 30, -30, 45, -45, 60, -60, 90, -90, 120, -120, 150, 180]))
_HEIGHTS = (0.75, 1.2)
_SAMPLES = np.linspace(0.0, 0.98, 80)  # of a line of sight
_FOV = np.deg2rad(55.0)  # of the viewer's eye, upright
_ASPECT = 1.15  # of a small window, without the room for labels at both sides
_EDGE = 0.92  # of the view is used at most
_FACTORS = np.arange(0.7, 2.51, 0.05)
_WORTH = 0.02  # share of points that must come into sight for the eye to go one place further


def safe(text: str) -> str:
    """Text in which every character without a sure glyph is a question mark."""
    return _UNSAFE.sub("?", text)


def escaped(text: str) -> str:
    """Text made safe, on one line, and without any meaning in markdown."""
    return _MARKDOWN.sub(r"\\\1", safe(" ".join(text.translate(_BARS).split())))


def markdown(blocks: Iterable[Block]) -> str:
    """Return blocks as markdown in which no text has a meaning, nor lacks a glyph."""
    return "\n\n".join(filter(None, map(_block, blocks)))


def _block(block: Block) -> str:
    if isinstance(block, Table) and not any(block.heads):
        named = ((f"**{escaped(k)}** " if k else "", escaped(v)) for k, v in block.rows)
        return "\n".join(f"- {name}{said}" for name, said in named)
    if isinstance(block, Table):
        cells = [[escaped(c) or " " for c in row] for row in (block.heads, *block.rows)]
        sides = ["---" if k in block.left else "---:" for k in range(len(block.heads))]
        return "\n".join(f"| {' | '.join(row)} |" for row in (cells[0], sides, *cells[1:]))
    if isinstance(block, Items):
        return "\n".join(f"- {escaped(row)}" for row in block.rows)
    if isinstance(block, Chart):
        return escaped(says(block.figure))
    words = block if isinstance(block, Words) else Words(block)
    lines = [escaped(line) for line in words.text.split("\n") if line.strip()]
    if lines and words.tone == "heading":
        lines[0] = f"### {lines[0]}"
    elif lines and words.tone in ("good", "doubt", "strong"):
        lines[0] = f"**{MARKS.get(words.tone, '')}{lines[0]}**"
    return "  \n".join(lines)


def document(text: str) -> rr.TextDocument:
    """Return markdown as the viewer takes it."""
    return rr.TextDocument(text, media_type="text/markdown")


def documents(texts: list[str]) -> rr.ComponentColumnList:
    """Return one such document for each of some times."""
    return rr.TextDocument.columns(text=texts, media_type=["text/markdown"] * len(texts))


def series(name: str, color: Color, width: float, mark: float) -> tuple[rr.AsComponents, ...]:
    """Return how a series of numbers is drawn: a line of some width with marks of some size."""
    names, colors = [safe(name)], [color]
    return (
        rr.SeriesLines(names=names, colors=colors, widths=[width]),
        rr.SeriesPoints(names=names, colors=colors, markers=["circle"], marker_sizes=[mark]),
    )


def shade(body: int) -> Color:
    """Return the colour of a body: neighbours differ."""
    return (176, 180, 188) if body % 2 else (205, 208, 214)


Shapes = list[tuple[Capsule, Color]]


def shapes(parts: Sequence[Capsule], carried: Sequence[Capsule] = ()) -> Shapes:
    """Return the capsules of an arm with their colours; what it carries is dark."""
    return [*((p, shade(p.body)) for p in parts), *((p, DARK) for p in carried)]


def target_shapes(arm: Arm, targets: Floats) -> Shapes:
    """Return the rods from the flange to targets (T, 3), flange axes, m, and a ball on each."""
    size, flange = max(arm.reach, 0.1), arm.n + 1
    rods = [Capsule("", flange, 0 * x, x, ROD * size) for x in targets]
    balls = [Capsule("", flange, x, x, TARGET * size) for x in targets]
    return [*((p, DARK) for p in rods), *((p, MEASURED) for p in balls)]


def drawn_capsules(start: Floats, end: Floats, radius: Floats, colors: object) -> rr.Capsules3D:
    """Return capsules between ends (K, 3); rerun's lie along z from the origin."""
    length, quaternions = _along(end - start)
    return rr.Capsules3D(
        lengths=length,
        radii=radius,
        translations=start,
        quaternions=quaternions,
        colors=colors,  # type: ignore[arg-type]
        fill_mode="solid",
    )


def _along(way: Floats) -> tuple[Floats, Floats]:
    """(K,) lengths, and (K, 4) quaternions that lead z to the way (K, 3)."""
    length = np.linalg.norm(way, axis=1)
    z = way / np.where(length > 0.0, length, 1.0)[:, None]
    # half-way turn that leads z to the way: q = (1 + z·way, z × way) normalised
    half = np.stack([-z[:, 1], z[:, 0], np.zeros(len(z)), 1.0 + z[:, 2]], 1)
    half[np.linalg.norm(half, axis=1) < 1e-9] = [1.0, 0.0, 0.0, 0.0]
    return length, np.asarray(half / np.linalg.norm(half, axis=1, keepdims=True))


def _arrays(of: Shapes) -> tuple[Floats, Floats, Floats, "np.ndarray[Any, np.dtype[np.uint8]]"]:
    """Return starts (K, 3), ends (K, 3), radii and colours of shapes."""
    start, end = (np.array([getattr(p, k) for p, _ in of]) for k in ("start", "end"))
    radius, colors = np.array([p.radius for p, _ in of]), [color for _, color in of]
    return start, end, radius, np.array(colors, dtype=np.uint8)


def residual_arrows(at: Any, vectors: Any, level: Any) -> rr.Arrows3D:
    """Return residuals at places (K, 3) in the colours of their levels (K,), outside ones bold."""
    of = np.asarray(level)
    colors, radii = LEVEL_COLORS[of], np.where(of > 0, 0.0055, 0.0035)
    return rr.Arrows3D(origins=at, vectors=vectors, colors=colors, radii=radii)


def noise_balls(at: Any, half: Any, turn: Floats | None = None) -> rr.Ellipsoids3D:
    """Return balls at places (K, 3) with half axes (K, 3), m, turned by quaternions (K, 4)."""
    shape = {"centers": at, "half_sizes": half, "quaternions": turn}
    return rr.Ellipsoids3D(**shape, colors=[(*NOISE, 46)], fill_mode="solid")


class MovingArm:
    """The arm with its targets as one entity, so that a place of it is one small message."""

    def __init__(self, rec: rr.RecordingStream, path: str, arm: Arm, targets: Floats) -> None:
        """Log what does not move; `targets` (T, 3) in flange axes, m."""
        of = [*shapes(capsules(arm)), *target_shapes(arm, targets)]
        self._rec, self._path = rec, path
        self._body = np.array([p.body for p, _ in of], dtype=np.int64)
        self._start, self._end, radius, colors = _arrays(of)
        lengths = np.linalg.norm(self._end - self._start, axis=1)
        look = rr.Capsules3D.from_fields(
            lengths=lengths, radii=radius, colors=colors, fill_mode="solid"
        )
        fixed(rec, path, look)

    def send(self, timeline: str, walls: list[float], bodies: Floats) -> None:
        """Send where the bodies (K, n + 2, 4, 4) are at times of day, s."""
        at = bodies[:, self._body]
        turn, shift = at[..., :3, :3], at[..., :3, 3]
        start, end = (np.einsum("tkij,kj->tki", turn, x) + shift for x in (self._start, self._end))
        _, quaternions = _along((end - start).reshape(-1, 3))
        placed = rr.Capsules3D.columns(
            translations=start.reshape(-1, 3), quaternions=quaternions
        ).partition([len(self._body)] * len(walls))
        along(self._rec, self._path, rr.TimeColumn(timeline, timestamp=walls), placed)


def log_shapes(rec: rr.RecordingStream, of: Shapes) -> None:
    """Log the shapes of every body at `world/arm/bodyI`."""
    for i in sorted({p.body for p, _ in of}):
        of_body = _arrays([shape for shape in of if shape[0].body == i])
        fixed(rec, f"world/arm/body{i}", drawn_capsules(*of_body))


def quaternions_of(rotation: Floats) -> Floats:
    """(N, 4) quaternions x y z w of (N, 3, 3) rotations, w >= 0."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True))


def stand(rec: rr.RecordingStream, bodies: Floats) -> None:
    """Log where the arm's bodies (n + 2, 4, 4) are at the recording's current time."""
    quaternion = quaternions_of(bodies[:, :3, :3])
    for i in range(1, len(bodies)):
        turn = rr.Quaternion(xyzw=quaternion[i])
        rec.log(f"world/arm/body{i}", rr.Transform3D(translation=bodies[i, :3, 3], quaternion=turn))


def send_stands(rec: rr.RecordingStream, time: rr.TimeColumn, bodies: Floats) -> None:
    """Send where the arm's bodies (K, B, 4, 4) are at K times."""
    for i in range(1, bodies.shape[1]):
        at, turn = bodies[:, i, :3, 3], quaternions_of(bodies[:, i, :3, :3])
        placed = rr.Transform3D.columns(translation=at, quaternion=turn)
        along(rec, f"world/arm/body{i}", time, placed)


def labels(places: Sequence[Floats] | Floats, texts: Sequence[str]) -> rr.Points3D:
    """Return words at places (K, 3), in the colour that is legible in both themes."""
    words = [safe(t) for t in texts]
    return rr.Points3D(places, labels=words, colors=[LABEL], radii=1e-4, show_labels=True)


def label_columns(places: Floats, texts: Sequence[str]) -> rr.ComponentColumnList:
    """Return one such text for each of K times."""
    count = len(places)
    return rr.Points3D.columns(
        positions=places,
        labels=[safe(t) for t in texts],
        colors=np.tile(np.array(LABEL, dtype=np.uint8), (count, 1)),
        radii=np.full(count, 1e-4),
        show_labels=[True] * count,
    )


def hidden(eye: Floats, points: Floats, things: tuple[Obstacle, ...]) -> Bools:
    """Return (K,) which of the points (K, 3) an obstacle hides from an eye (3,), m."""
    at = eye + _SAMPLES[:, None] * (points - eye)[:, None]
    out = np.zeros(len(points), dtype=np.bool_)
    for thing in things:
        out |= holds(thing, at).any(axis=1)
    return out


def direction(
    turn: float, middle: Floats, size: float, points: Floats, things: tuple[Obstacle, ...]
) -> Floats:
    """Return the direction (3,) to an eye near `turn`, rad, from where fewest points are hidden."""
    angles = [(turn + a, z) for z in _HEIGHTS for a in _TURNS]
    places = [np.array([1.7 * np.cos(a), 1.7 * np.sin(a), z]) for a, z in angles]
    covered = [hidden(middle + size * place, points, things).mean() for place in places]
    return places[int(np.argmin(covered + _WORTH * np.arange(len(places))))]


def in_view(eye: Floats, look: Floats, points: Floats) -> Bools:
    """Return (K,) which of the points (K, 3) an eye sees that looks at a place, z upwards."""
    ahead = (look - eye) / np.linalg.norm(look - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    way = points - eye
    depth = way @ ahead
    half = _EDGE * np.tan(_FOV / 2) * depth
    upright = np.abs(way @ np.cross(right, ahead))
    return np.asarray((depth > 0.0) & (upright < half) & (np.abs(way @ right) < _ASPECT * half))


def center(points: Floats, least: float) -> tuple[Floats, float]:
    """Middle of points (K, 3) and the origin, and half their size, at least so much, m."""
    points = np.vstack([points, np.zeros((1, 3))])
    lo, hi = points.min(0), points.max(0)
    return (lo + hi) / 2, max(float(np.linalg.norm(hi - lo)) / 2, least)


def near(look: Floats, way: Floats, points: Floats) -> Floats:
    """Return the place (3,) of the eye, as near along `way` from `look` as shows all points."""
    places = [look + f * way for f in _FACTORS]
    return next((x for x in places if in_view(x, look, points).all()), places[-1])


def whole(
    contents: rrb.Container,
    timeline: str,
    play: Literal["paused", "following"] = "paused",
    fps: float | None = None,
) -> rrb.Blueprint:
    """Return a blueprint of these views alone, over a line for the time."""
    return rrb.Blueprint(
        contents,
        rrb.TimePanel(timeline=timeline, state="collapsed", fps=fps, play_state=play),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def text(of: str, name: str) -> rrb.TextDocumentView:
    """Return a view of words."""
    return rrb.TextDocumentView(origin=f"words/{of}", name=name)


def view3d(
    origin: str,
    name: str,
    place: Floats,
    look: Floats,
    contents: Sequence[str] = ("$origin/**",),
    **more: Any,
) -> rrb.Spatial3DView:
    """Return a 3-D view whose eye stands at a place and looks at another, z upwards."""
    return rrb.Spatial3DView(
        origin=origin,
        contents=list(contents),
        name=name,
        background=BACKGROUND,
        line_grid=GRID,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=place, look_target=look, eye_up=(0.0, 0.0, 1.0)
        ),
        **more,
    )
