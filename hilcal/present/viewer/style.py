"""Common parts of all views: colours, shapes of the arm, labels, markdown, layouts and eyes."""

import re
from collections.abc import Iterable, Sequence
from typing import Any, Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from hilcal.config import Obstacle
from hilcal.measuring.clearance import contains
from hilcal.present import story
from hilcal.present.document import Block, Chart, Items, Table, Words, description_of
from hilcal.robot.arm import Arm
from hilcal.robot.scene import Capsule, capsules
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
# The viewer draws labels on a box: almost black in its dark theme, a medium grey in its light one.
# Only white is legible on both, so that marks next to the labels show colours.
LABEL: Color = (255, 255, 255)
LEADER: Color = (165, 168, 176)
LEVEL_NAMES = tuple(name.split()[0] for name in story.LEVEL_NAMES)  # of entities
MARKS = {"good": "✓ ", "doubt": "✗ "}
BALL_SIGMAS = float(np.sqrt(chdtri(3, 1.0 - story.LIMITS[0])))
ROD, TARGET = 0.0065, 0.012  # radii of rods and rails and of the target, shares of the reach
EYE = np.array([1.05, -1.35, 0.55])
# 3-D views use light colours and stay dark in the light theme, too.
BACKGROUND = rrb.Background(color=(22, 24, 29), kind=rrb.BackgroundKind.SolidColor)
GRID = rrb.LineGrid3D(visible=True, spacing=0.25, stroke_width=0.7, color=(120, 124, 132, 70))

FACTORS = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)  # scales of lengths, times 10^k
# Greek letters and these signs are in the viewer's fonts; a missing glyph crashes the viewer.
_SIGNS = "■●▲→µ²³±×√Δ✓✗⚠°"
_BARS = str.maketrans("", "", "▁▂▃▄▅▆▇█")  # of tables on a terminal; not in the viewer's fonts
_UNSAFE = re.compile(rf"[^\n\x20-\x7e\u00a1-\u00ac\u00ae-\u00ff\u0391-\u03a9\u03b1-\u03c9{_SIGNS}]")
_MARKDOWN = re.compile(r"([\\`*_\[\]<>|#~$])")
_TURNS = np.deg2rad(np.array([0, 15, -15, 30, -30, 45, -45, 60, -60, 90, -90, 120, -120, 150, 180]))
_HEIGHTS = (0.75, 1.2)
_SAMPLES = np.linspace(0.0, 0.98, 80)  # along a line of sight
_FOV = np.deg2rad(55.0)  # vertical field of view of the viewer's eye
_ASPECT = 1.15  # of a small window, without margins for labels at both sides
_EDGE = 0.92  # largest used share of the view
_FACTORS = np.arange(0.7, 2.51, 0.05)
_WORTH = 0.02  # least share of points that must become visible for each next place of the eye


def storable(text: str) -> str:
    """Return a text with question marks for characters that may lack a glyph."""
    return _UNSAFE.sub("?", text)


def escaped(text: str) -> str:
    """Return a safe text on one line, escaped for markdown."""
    return _MARKDOWN.sub(r"\\\1", storable(" ".join(text.translate(_BARS).split())))


def markdown(blocks: Iterable[Block]) -> str:
    """Return blocks as markdown, with all text safe and escaped."""
    return "\n\n".join(filter(None, map(_block, blocks)))


def _block(block: Block) -> str:
    if isinstance(block, Table) and not any(block.heads):
        named = ((f"**{escaped(k)}** " if k else "", escaped(v)) for k, v in block.rows)
        return "\n".join(f"- {name}{description}" for name, description in named)
    if isinstance(block, Table):
        cells = [[escaped(c) or " " for c in row] for row in (block.heads, *block.rows)]
        sides = ["---" if k in block.left else "---:" for k in range(len(block.heads))]
        return "\n".join(f"| {' | '.join(row)} |" for row in (cells[0], sides, *cells[1:]))
    if isinstance(block, Items):
        return "\n".join(f"- {escaped(row)}" for row in block.rows)
    if isinstance(block, Chart):
        return escaped(description_of(block.figure))
    paragraph = block if isinstance(block, Words) else Words(block)
    lines = [escaped(line) for line in paragraph.text.split("\n") if line.strip()]
    if lines and paragraph.tone == "heading":
        lines[0] = f"### {lines[0]}"
    elif lines and paragraph.tone in ("good", "doubt", "strong"):
        lines[0] = f"**{MARKS.get(paragraph.tone, '')}{lines[0]}**"
    return "  \n".join(lines)


def document(text: str) -> rr.TextDocument:
    """Return markdown as a document of the viewer."""
    return rr.TextDocument(text, media_type="text/markdown")


def documents(texts: list[str]) -> rr.ComponentColumnList:
    """Return documents of markdown, one per time."""
    return rr.TextDocument.columns(text=texts, media_type=["text/markdown"] * len(texts))


def series(name: str, color: Color, width: float, mark: float) -> tuple[rr.AsComponents, ...]:
    """Return the style of a series of numbers: width of its line, size of its marks."""
    names, colors = [storable(name)], [color]
    return (
        rr.SeriesLines(names=names, colors=colors, widths=[width]),
        rr.SeriesPoints(names=names, colors=colors, markers=["circle"], marker_sizes=[mark]),
    )


def shade(body: int) -> Color:
    """Return the colour of a body; it differs from those of its neighbours."""
    return (176, 180, 188) if body % 2 else (205, 208, 214)


Shapes = list[tuple[Capsule, Color]]


def shapes(parts: Sequence[Capsule], carried: Sequence[Capsule] = ()) -> Shapes:
    """Return the capsules of an arm with their colours; `carried` ones and rails are dark."""
    return [*((p, shade(p.body)) for p in parts), *((p, DARK) for p in carried)]


def rails(arm: Arm) -> list[Capsule]:
    """Return a capsule along the travel of each joint that slides, on the body that carries it."""
    size = max(arm.reach, 0.1)
    low, high = (arm.chain_angles(np.where(arm.slides, q, 0.0)) for q in (arm.q_min, arm.q_max))
    return [
        Capsule("rail", j, place + low[j] * along, place + high[j] * along, ROD * size)
        for j in np.flatnonzero(arm.slides).tolist()
        for place, along in [(arm.links[j][:3, 3], arm.links[j][:3, 2])]
    ]


def target_shapes(arm: Arm, targets: Floats) -> Shapes:
    """Return rods from the flange to the targets (T, 3), flange axes, m, with a ball on each."""
    size, flange = max(arm.reach, 0.1), arm.n + 1
    rods = [Capsule("", flange, 0 * x, x, ROD * size) for x in targets]
    balls = [Capsule("", flange, x, x, TARGET * size) for x in targets]
    return [*((p, DARK) for p in rods), *((p, MEASURED) for p in balls)]


def drawn_capsules(start: Floats, end: Floats, radius: Floats, colors: Any) -> rr.Capsules3D:
    """Return capsules between ends (K, 3); rerun's lie along z from the origin."""
    length, turn = _along(end - start)
    look: dict[str, Any] = {"radii": radius, "colors": colors, "fill_mode": "solid"}
    return rr.Capsules3D(lengths=length, translations=start, quaternions=turn, **look)


def _along(way: Floats) -> tuple[Floats, Floats]:
    """Return lengths (K,) of vectors (K, 3), and quaternions (K, 4) that rotate z onto them."""
    length = np.linalg.norm(way, axis=1)
    z = way / np.where(length > 0.0, length, 1.0)[:, None]
    # q = (e × z, 1 + e·z), normalised, rotates e = (0, 0, 1) onto z
    half = np.stack([-z[:, 1], z[:, 0], np.zeros(len(z)), 1.0 + z[:, 2]], 1)
    half[np.linalg.norm(half, axis=1) < 1e-9] = [1.0, 0.0, 0.0, 0.0]
    return length, np.asarray(half / np.linalg.norm(half, axis=1, keepdims=True))


def _arrays(parts: Shapes) -> tuple[Floats, Floats, Floats, "np.ndarray[Any, np.dtype[np.uint8]]"]:
    """Return starts (K, 3), ends (K, 3), radii (K,) and colours (K, 3) of shapes."""
    start, end = (np.array([getattr(p, k) for p, _ in parts]) for k in ("start", "end"))
    radius, colors = np.array([p.radius for p, _ in parts]), [color for _, color in parts]
    return start, end, radius, np.array(colors, dtype=np.uint8)


def residual_arrows(origins: Any, vectors: Any, level: Any) -> rr.Arrows3D:
    """Return residuals at points (K, 3) in the colours of their levels (K,); level 0 is thin."""
    index = np.asarray(level)
    colors, radii = LEVEL_COLORS[index], np.where(index > 0, 0.0055, 0.0035)
    return rr.Arrows3D(origins=origins, vectors=vectors, colors=colors, radii=radii)


def noise_balls(centers: Any, half: Any, turn: Floats | None = None) -> rr.Ellipsoids3D:
    """Return ellipsoids at points (K, 3) with half axes (K, 3), m, and quaternions (K, 4)."""
    shape = {"centers": centers, "half_sizes": half, "quaternions": turn}
    return rr.Ellipsoids3D(**shape, colors=[(*NOISE, 46)], fill_mode="solid")


class MovingArm:
    """The arm with its targets as one entity, so that a position is one small message."""

    def __init__(self, rec: rr.RecordingStream, path: str, arm: Arm, targets: Floats) -> None:
        """Log the shapes; `targets` (T, 3) in flange axes, m."""
        parts = [*shapes(capsules(arm), rails(arm)), *target_shapes(arm, targets)]
        self._rec, self._path = rec, path
        self._body = np.array([p.body for p, _ in parts], dtype=np.int64)
        self._start, self._end, radius, colors = _arrays(parts)
        lengths, _ = _along(self._end - self._start)
        look: dict[str, Any] = {"radii": radius, "colors": colors, "fill_mode": "solid"}
        rec.log(path, rr.Capsules3D.from_fields(lengths=lengths, **look), static=True)

    def send(self, timeline: str, walls: list[float], bodies: Floats) -> None:
        """Send the poses of the bodies (K, n + 2, 4, 4) at K times of day, s."""
        pose = bodies[:, self._body]
        turn, shift = pose[..., :3, :3], pose[..., :3, 3]
        start, end = (np.einsum("tkij,kj->tki", turn, x) + shift for x in (self._start, self._end))
        _, quaternions = _along((end - start).reshape(-1, 3))
        placed = rr.Capsules3D.columns(
            translations=start.reshape(-1, 3), quaternions=quaternions
        ).partition([len(self._body)] * len(walls))
        self._rec.send_columns(self._path, [rr.TimeColumn(timeline, timestamp=walls)], placed)


def log_shapes(rec: rr.RecordingStream, parts: Shapes) -> None:
    """Log the shapes of every body at `world/arm/bodyI`."""
    for i in sorted({p.body for p, _ in parts}):
        of_body = _arrays([shape for shape in parts if shape[0].body == i])
        rec.log(f"world/arm/body{i}", drawn_capsules(*of_body), static=True)


def quaternions_of(rotation: Floats) -> Floats:
    """Return quaternions (N, 4), x y z w with w >= 0, of rotations (N, 3, 3)."""
    return np.asarray(Rotation.from_matrix(rotation).as_quat(canonical=True))


def log_poses(rec: rr.RecordingStream, bodies: Floats) -> None:
    """Log the poses of the arm's bodies (n + 2, 4, 4) at the current time."""
    quaternion = quaternions_of(bodies[:, :3, :3])
    for i in range(1, len(bodies)):
        turn = rr.Quaternion(xyzw=quaternion[i])
        rec.log(f"world/arm/body{i}", rr.Transform3D(translation=bodies[i, :3, 3], quaternion=turn))


def send_poses(rec: rr.RecordingStream, time: rr.TimeColumn, bodies: Floats) -> None:
    """Send the poses of the arm's bodies (K, B, 4, 4) at K times."""
    for i in range(1, bodies.shape[1]):
        shift, turn = bodies[:, i, :3, 3], quaternions_of(bodies[:, i, :3, :3])
        placed = rr.Transform3D.columns(translation=shift, quaternion=turn)
        rec.send_columns(f"world/arm/body{i}", [time], placed)


def labels(places: Sequence[Floats] | Floats, texts: Sequence[str]) -> rr.Points3D:
    """Return labels at points (K, 3), in a colour that is legible in both themes."""
    safe_texts = [storable(t) for t in texts]
    return rr.Points3D(places, labels=safe_texts, colors=[LABEL], radii=1e-4, show_labels=True)


def label_columns(places: Floats, texts: Sequence[str]) -> rr.ComponentColumnList:
    """Return labels at points (K, 3), one per time."""
    count = len(places)
    text, colors = [storable(t) for t in texts], np.full((count, 3), LABEL, dtype=np.uint8)
    look: dict[str, Any] = {"radii": np.full(count, 1e-4), "show_labels": [True] * count}
    return rr.Points3D.columns(positions=places, labels=text, colors=colors, **look)


def hidden_points(eye: Floats, points: Floats, obstacles: tuple[Obstacle, ...]) -> Bools:
    """Return whether an obstacle hides each of the points (K, 3) from an eye (3,), m."""
    samples = eye + _SAMPLES[:, None] * (points - eye)[:, None]
    out = np.zeros(len(points), dtype=np.bool_)
    for thing in obstacles:
        out |= contains(thing, samples).any(axis=1)
    return out


def view_direction(
    turn: float, middle: Floats, size: float, points: Floats, obstacles: tuple[Obstacle, ...]
) -> Floats:
    """Return the direction (3,) of an eye near `turn`, rad, that sees most of the points."""
    angles = [(turn + a, z) for z in _HEIGHTS for a in _TURNS]
    places = [np.array([1.7 * np.cos(a), 1.7 * np.sin(a), z]) for a, z in angles]
    covered = [hidden_points(middle + size * place, points, obstacles).mean() for place in places]
    return places[int(np.argmin(covered + _WORTH * np.arange(len(places))))]


def in_view(eye: Floats, look: Floats, points: Floats) -> Bools:
    """Return whether each of the points (K, 3) is in view of an eye that looks at `look`, z up."""
    ahead = (look - eye) / np.linalg.norm(look - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    way = points - eye
    depth = way @ ahead
    half = _EDGE * np.tan(_FOV / 2) * depth
    upright = np.abs(way @ np.cross(right, ahead))
    return np.asarray((depth > 0.0) & (upright < half) & (np.abs(way @ right) < _ASPECT * half))


def center(points: Floats, least: float) -> tuple[Floats, float]:
    """Return centre and half diagonal, at least `least`, of points (K, 3) and the origin, m."""
    points = np.vstack([points, np.zeros((1, 3))])
    lo, hi = points.min(0), points.max(0)
    return (lo + hi) / 2, max(float(np.linalg.norm(hi - lo)) / 2, least)


def nearest_eye(look: Floats, direction: Floats, points: Floats) -> Floats:
    """Return the nearest eye (3,) on `look` + f `direction` that shows all points."""
    places = [look + f * direction for f in _FACTORS]
    return next((x for x in places if in_view(x, look, points).all()), places[-1])


def page_blueprint(
    left: rrb.Container,
    right: rrb.Container,
    timeline: str,
    following: bool = False,
    fps: float | None = None,
) -> rrb.Blueprint:
    """Return a blueprint of views beside each other, with a time panel and without other panels."""
    play: Literal["paused", "following"] = "following" if following else "paused"
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[3, 2]),
        rrb.TimePanel(timeline=timeline, state="collapsed", fps=fps, play_state=play),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def text(entity: str, name: str) -> rrb.TextDocumentView:
    """Return a view of the document `words/entity`."""
    return rrb.TextDocumentView(origin=f"words/{entity}", name=name)


def view3d(
    origin: str,
    name: str,
    place: Floats,
    look: Floats,
    contents: Sequence[str] = ("$origin/**",),
    **more: Any,
) -> rrb.Spatial3DView:
    """Return a 3-D view with the eye at `place`, directed at `look`, z up."""
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
