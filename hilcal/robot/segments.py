"""Distances of segments and boxes in space, batched."""

import numpy as np

from hilcal.types import Floats

_TINY = 1e-18  # m², below which a segment is a point


def segment_distance(a: Floats, b: Floats, c: Floats, d: Floats) -> Floats:
    """Return (N,) least distances of the segments ab and cd, points (N, 3) or (3,), m.

    |a + s u − c − t v| is least at the stationary s, kept within [0, 1], with the t that is
    best for it, kept within [0, 1], and then the s that is best for that t (Ericson 2005,
    Real-Time Collision Detection, section 5.1.9).
    """
    u, v, r = b - a, d - c, a - c
    uu, vv, uv = _dot(u, u), _dot(v, v), _dot(u, v)
    ur, vr = _dot(u, r), _dot(v, r)
    det = uu * vv - uv * uv
    far = det > 1e-12 * uu * vv  # not parallel
    s = np.where(far, (uv * vr - ur * vv) / np.where(far, det, 1.0), 0.0)
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((uv * s + vr) / np.where(vv > _TINY, vv, 1.0), 0.0, 1.0)
    s = np.clip((uv * t - ur) / np.where(uu > _TINY, uu, 1.0), 0.0, 1.0)
    gap = r + s[..., None] * u - t[..., None] * v
    return np.asarray(np.linalg.norm(gap, axis=-1))


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.sum(a * b, axis=-1))
