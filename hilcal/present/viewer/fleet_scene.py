"""The pictures of a fleet: arms of a type side by side, and their parameters in σ of the type."""

import math

import numpy as np
import numpy.typing as npt
import rerun as rr

from hilcal.present.fleet import unlike_words
from hilcal.present.viewer import arm_shapes, style
from hilcal.present.viewer.fleet_digest import FAR, TypeDigest
from hilcal.robot.body import body_poses, capsules
from hilcal.types import Floats

_STANDS = (0.0, -1.4, 1.0, -1.2, -1.57, 0.0)
"""Joint values of the drawn arms, rad: upright, so that many stand side by side; a choice."""
_APART = (0.62, 0.95)
"""Distances of arms and of their rows, shares of the reach; a choice."""
_NAMED = 40
"""Arms up to which each has its name beside it; a choice."""
_ROWS = 12
"""Parameters that are drawn at most; a choice."""


def places(d: TypeDigest) -> Floats:
    """(A, 3) where the arms stand, m: in rows, the first in front."""
    count, reach = len(d.pooled.arms), max(d.arm.reach, 0.1)
    wide = max(math.ceil(math.sqrt(2.0 * count)), 1)
    index = np.arange(count)
    at = np.zeros((count, 3))
    at[:, 0] = -_APART[1] * reach * (index // wide)
    at[:, 1] = _APART[0] * reach * (index % wide - (min(wide, count) - 1) / 2)
    return at


def arms(rec: rr.RecordingStream, path: str, d: TypeDigest) -> None:
    """Log the arms; a joint that is unlike the type is red, one beyond `FAR` σ amber."""
    rec.log(path, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    n, shapes = d.arm.n, capsules(d.arm)
    q = np.resize(np.array(_STANDS), n)[None]
    poses = body_poses(d.arm, q)[0]
    body = np.array([s.body for s in shapes])
    start, end = (
        np.einsum("kij,kj->ki", poses[body, :3, :3], x) + poses[body, :3, 3]
        for x in (np.array([s.start for s in shapes]), np.array([s.end for s in shapes]))
    )
    radius = np.array([s.radius for s in shapes])
    top = np.array([0.0, 0.0, 1.06 * float((np.maximum(start, end)[:, 2] + radius).max())])
    at = places(d)
    marked = np.asarray(d.odd.any(axis=1))
    colors = np.concatenate([_colors(d, a)[body] for a in range(len(at))])
    rec.log(
        f"{path}/arms",
        arm_shapes.capsules(
            np.concatenate([start + p for p in at]),
            np.concatenate([end + p for p in at]),
            np.tile(radius, len(at)),
            colors,
        ),
        static=True,
    )
    named = np.flatnonzero(marked | (len(at) <= _NAMED))
    # Long words stand above the names of the neighbours, each arm's on a line of its own.
    step = np.cumsum(marked)[named] * marked[named]
    above = np.outer(np.where(step > 0, 0.25 + 0.12 * step, 0.0) * max(d.arm.reach, 0.1), [0, 0, 1])
    rec.log(
        f"{path}/names/leader",
        rr.LineStrips3D(
            [np.stack([p, p + a]) for p, a in zip(at[named] + top, above, strict=True)],
            colors=[style.RED],
            radii=rr.Radius.ui_points(1.0),
        ),
        static=True,
    )
    rec.log(
        f"{path}/names",
        rr.Points3D(
            at[named] + top + above,
            labels=[style.safe(_label(d, int(a))) for a in named],
            colors=[style.LABEL],
            radii=1e-4,
            show_labels=True,
        ),
        static=True,
    )
    if marked.any():
        half = np.array([0.27, 0.27, 0.5 * top[2] / max(d.arm.reach, 0.1)])
        half *= max(d.arm.reach, 0.1)
        rec.log(
            f"{path}/unlike",
            rr.Boxes3D(
                centers=at[marked] + 0.5 * top,
                half_sizes=[half] * int(marked.sum()),
                colors=[style.RED],
                radii=rr.Radius.ui_points(2.0),
                fill_mode="majorwireframe",
            ),
            static=True,
        )


def _colors(d: TypeDigest, a: int) -> npt.NDArray[np.uint8]:
    """(n + 1, 3) colours of the bodies of an arm."""
    shades = [arm_shapes.METAL if i % 2 else arm_shapes.LIGHT for i in range(d.arm.n + 1)]
    out = np.array(shades, dtype=np.uint8)
    far = np.abs(np.nan_to_num(d.units[a])) > FAR
    for chosen, color in ((far, style.AMBER), (d.odd[a], style.RED)):
        for k in np.flatnonzero(chosen):
            out[d.joints[k]] = color
    return out


def _label(d: TypeDigest, a: int) -> str:
    lines = [unlike_words(o) for o in d.told(a)]
    return "\n".join(lines[:3]) or d.pooled.arms[a]


def rows(d: TypeDigest) -> list[int]:
    """Return the parameters that are drawn: those with the farthest arms, in their order."""
    far = np.nanmax(np.abs(np.where(np.isfinite(d.units), d.units, 0.0)), axis=0)
    return sorted(np.argsort(-far, kind="stable")[:_ROWS].tolist())


def drift(rec: rr.RecordingStream, path: str, d: TypeDigest) -> None:
    """Send each arm's campaigns along `date`, a view per parameter."""
    for k in rows(d):
        for a, arm in enumerate(d.pooled.arms):
            mine = [c for c in range(len(d.owner)) if d.owner[c] == a]
            mine = [c for c in mine if np.isfinite(d.campaigns[c, k])]
            if not mine:
                continue
            odd = bool(d.odd[a, k])
            entity = f"{path}/{k}/{'zunlike' if odd else 'like'}/{a}"
            color, width = (style.RED, 3.0) if odd else (style.GREY, 1.2)
            name = style.safe(arm)
            rec.log(
                entity,
                rr.SeriesLines(names=[name], colors=[color], widths=[width]),
                rr.SeriesPoints(
                    names=[name], colors=[color], markers=["circle"], marker_sizes=[2 * width]
                ),
                static=True,
            )
            rec.send_columns(
                entity,
                indexes=[rr.TimeColumn("date", timestamp=d.seconds[mine])],
                columns=rr.Scalars.columns(scalars=d.campaigns[mine, k]),
            )
