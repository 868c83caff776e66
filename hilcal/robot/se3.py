"""Batches of N states, and rigid displacements: exponential, logarithm, adjoint, Jacobian.

Arrays (N, ...) are in Fortran order: the states are the first axis, and memory runs along them.
Every elementwise operation and every `einsum` then works on long contiguous vectors, even for small
matrices. numpy preserves the order; only new arrays have to be created with it. Chunks keep
temporaries in the processor's cache.

Twists are (v, ω): translation first. All functions take arrays with any leading shape. With
θ = |ω|, all formulas use b = (1 − cos θ)/θ² and c = (θ − sin θ)/θ³, two functions of θ² without a
singularity:

    sin θ/θ = 1 − c θ²        cos θ = 1 − b θ²

Source of the closed forms: Lynch and Park, *Modern Robotics*, chapter 3; Barfoot,
*State Estimation for Robotics*, section 7.1.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import Field, fields, replace
from math import cos, factorial, sin
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np

from hilcal.types import Floats

CHUNK = 8200  # states, by timing; powers of two collide in few cache lines
BUDGET = 1 << 20  # numbers in a chunk's largest array, 8 MB; a choice by timing
LEAST_CHUNK = 256  # states, at least: Python's overhead grows with the number of chunks


class Record(Protocol):
    """A dataclass whose fields are arrays over the states, or None."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


R = TypeVar("R", bound=Record)


def empty(*shape: int) -> Floats:
    """Return a new array (N, ...) whose memory runs along the states."""
    return np.empty(shape, order="F")


def zeros(*shape: int) -> Floats:
    """Return a new array (N, ...) of zeros whose memory runs along the states."""
    return np.zeros(shape, order="F")


def along_states(x: Floats) -> Floats:
    """Return x (N, ...) with memory along the states: itself, or a copy."""
    return np.asfortranarray(x)


def chunks(count: int, numbers: int = 0) -> Iterator[slice]:
    """Yield slices that cover `count` states, at least one slice; `numbers` per state."""
    size = CHUNK if numbers == 0 else max(LEAST_CHUNK, min(CHUNK, BUDGET // numbers))
    for start in range(0, max(count, 1), size):
        yield slice(start, min(start + size, count))


def take(record: R, rows: slice, axis: int = 0) -> R:
    """Return the states `rows` of a record whose arrays have the states on `axis`."""
    index = (*(slice(None),) * axis, rows)
    return by_field([record], lambda arrays: arrays[0][index])


def by_field(records: Sequence[R], combine: Callable[[Sequence[Floats]], Floats]) -> R:
    """Combine records array by array, without None; other fields are those of the first record."""
    combined = {}
    for f in fields(records[0]):
        arrays = [a for r in records if isinstance(a := getattr(r, f.name), np.ndarray)]
        if arrays:
            combined[f.name] = combine(arrays)
    return replace(records[0], **combined)


_NEAR = 0.25  # θ² below which b and c are series: the closed forms cancel near zero
_TERMS = 8
_B = [(-1) ** k / factorial(2 * k + 2) for k in range(_TERMS)]
_C = [(-1) ** k / factorial(2 * k + 3) for k in range(_TERMS)]
_B_SLOPE, _C_SLOPE = ([k * c for k, c in enumerate(series)][1:] for series in (_B, _C))


def cross(a: Floats, b: Floats) -> Floats:
    """Return the cross product a × b over the last axis; (..., 3), broadcast."""
    out = empty(*np.broadcast_shapes(a.shape, b.shape))
    # memory runs along the states, even if a or b is the same in all states
    part = empty(*out.shape[:-1])
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        np.multiply(a[..., j], b[..., k], out=out[..., axis])
        np.multiply(a[..., k], b[..., j], out=part)
        out[..., axis] -= part
    return out


def apply(r: Floats, v: Floats) -> Floats:
    """Return matrices times vectors; (..., 3, 3), (..., 3) -> (..., 3), broadcast."""
    out = empty(*np.broadcast_shapes(r.shape[:-1], v.shape))
    return np.asarray(np.einsum("...ij,...j->...i", r, v, out=out))


def product(a: Floats, b: Floats) -> Floats:
    """Return matrices times matrices; (..., i, j), (..., j, k) -> (..., i, k), broadcast."""
    lead = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    out = empty(*lead, a.shape[-2], b.shape[-1])
    return np.asarray(np.einsum("...ij,...jk->...ik", a, b, out=out))


def skew(a: Floats) -> Floats:
    """Return [a]× with [a]× b = a × b; (..., 3) -> (..., 3, 3)."""
    s = zeros(*a.shape, 3)
    s[..., 0, 1], s[..., 0, 2] = -a[..., 2], a[..., 1]
    s[..., 1, 0], s[..., 1, 2] = a[..., 2], -a[..., 0]
    s[..., 2, 0], s[..., 2, 1] = -a[..., 1], a[..., 0]
    return s


def rotation(w: Floats) -> Floats:
    """Rotation matrix exp([ω]×) = cos θ I + sin θ/θ [ω]× + b ω ωᵀ; (..., 3) -> (..., 3, 3)."""
    t2 = _square(w)
    b, c = coefficients(t2)
    return _combine(1 - b * t2, 1 - c * t2, b, w)


def rotation_vector(r: Floats) -> Floats:
    """Return the rotation vector of a rotation matrix, angle in [0, π]; (..., 3, 3) -> (..., 3).

    From the unit quaternion (v, w), the row of 4 (v, w)(v, w)ᵀ with the largest diagonal element,
    which avoids cancellation (Shepperd 1978, J. Guidance and Control 1); θ = 2 atan2(|v|, w).
    """
    m = r.reshape(-1, 3, 3)
    square = np.empty((len(m), 4, 4))
    square[:, :3, :3] = m + np.swapaxes(m, 1, 2)
    trace = np.einsum("nii->n", m)
    square[:, 3, 3] = 1.0 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        square[:, i, i] += 1.0 - trace
        square[:, i, 3] = square[:, 3, i] = m[:, k, j] - m[:, j, k]
    largest = np.argmax(np.einsum("nii->ni", square), axis=1)
    q = square[np.arange(len(m)), largest]
    q *= (np.where(q[:, 3] < 0.0, -1.0, 1.0) / np.linalg.norm(q, axis=1))[:, None]
    sine = np.linalg.norm(q[:, :3], axis=1)
    turn = sine > np.finfo(float).tiny
    length = np.where(turn, 2.0 * np.arctan2(sine, q[:, 3]) / np.where(turn, sine, 1.0), 2.0)
    return np.asarray(length[:, None] * q[:, :3]).reshape(r.shape[:-1])


def exp(twist: Floats) -> tuple[Floats, Floats]:
    """Return rotation (..., 3, 3) and translation (..., 3) of exp of a twist (..., 6).

    R = exp([ω]×),  p = v + b ω × v + c ω × (ω × v); pure rotations cost less.
    """
    v, w = twist[..., :3], twist[..., 3:]
    t2 = _square(w)
    b, c = coefficients(t2)
    r = _combine(1 - b * t2, 1 - c * t2, b, w)
    if not v.any():
        return r, np.broadcast_to(0.0, v.shape)
    turned = cross(w, v)
    return r, v + b[..., None] * turned + c[..., None] * cross(w, turned)


def matrix(r: Floats, p: Floats) -> Floats:
    """Return the homogeneous matrix (..., 4, 4) of rotation and translation."""
    t = np.zeros((*p.shape[:-1], 4, 4))
    t[..., :3, :3], t[..., :3, 3], t[..., 3, 3] = r, p, 1.0
    return t


def inverse(t: Floats) -> Floats:
    """Return the inverse of a homogeneous rigid transform (..., 4, 4)."""
    r = np.swapaxes(t[..., :3, :3], -1, -2)
    return matrix(r, -(r @ t[..., :3, 3, None])[..., 0])


def six(t: Floats) -> list[float]:
    """Return x, y, z and rotation vector of a pose (4, 4), m and rad, as UR controllers do."""
    return [*t[:3, 3].tolist(), *rotation_vector(t[:3, :3]).tolist()]


def of_six(values: Sequence[float]) -> Floats:
    """Return the pose (4, 4) of x, y, z and a rotation vector, m and rad."""
    pose = np.asarray(values, dtype=float)
    return matrix(rotation(pose[3:]), pose[:3])


def screw(axis: int, angle: float, along: float = 0.0) -> Floats:
    """Return the transform (4, 4) of a turn, rad, about axis 0, 1 or 2, and a shift along it, m."""
    out, (j, k) = np.eye(4), ((axis + 1) % 3, (axis + 2) % 3)
    out[j, j] = out[k, k] = cos(angle)
    out[k, j] = sin(angle)
    out[j, k] = -out[k, j]
    out[axis, 3] = along
    return out


def of_rpy(rpy: Floats) -> Floats:
    """Return Rz(yaw) Ry(pitch) Rx(roll) (3, 3) of turns about fixed axes (3,), as in URDF."""
    turns = [screw(axis, angle)[:3, :3] for axis, angle in enumerate(rpy)]
    return np.asarray(turns[2] @ turns[1] @ turns[0])


def of_quaternion(q: Floats) -> Floats:
    """Return the rotation (3, 3) of a unit quaternion (4,), its real part first."""
    k = skew(q[1:])
    return np.asarray(np.eye(3) + 2 * q[0] * k + 2 * k @ k)


def quaternion(r: Floats) -> Floats:
    """Return the unit quaternion (4,) of a rotation (3, 3), its real part first, not negative."""
    w = rotation_vector(r)
    angle = float(np.linalg.norm(w))
    return np.array([cos(angle / 2), *(sin(angle / 2) * (w / angle if angle > 0 else w))])


def adjoint(r: Floats, p: Floats) -> Floats:
    """Return Ad (..., 6, 6): Ad ξ is the twist in the outer frame of ξ in the inner frame."""
    ad = np.zeros((*p.shape[:-1], 6, 6))
    ad[..., :3, :3] = r
    ad[..., 3:, 3:] = r
    ad[..., :3, 3:] = skew(p) @ r
    return ad


def right_jacobian_blocks(twist: Floats) -> tuple[Floats, Floats]:
    """Return the blocks J(ω), Q(v, ω) (..., 3, 3) of the right Jacobian J_r = [J, Q; 0, J].

    exp(ξ + δ) = exp(ξ) exp(J_r(ξ) δ) to first order.

        J = (1 − c θ²) I − b [ω]× + c ω ωᵀ
        Q = dJ(ω + ε v)/dε = −b [v]× + c (v ωᵀ + ω vᵀ) − 2 c d I
                             + 2 d (−b' [ω]× + c' (ω ωᵀ − θ² I)),   d = ω · v

    with b', c' the derivatives of b and c by θ²: a twist is the dual number ω + ε v.
    """
    v, w = twist[..., :3], twist[..., 3:]
    t2 = _square(w)
    b, c = coefficients(t2)
    j = _combine(1 - c * t2, -b, c, w)
    if not v.any():
        return j, np.broadcast_to(0.0, j.shape)
    b_slope, c_slope = _slopes(t2, b, c)
    twice = 2 * np.sum(v * w, axis=-1)
    q = _combine(-twice * (c + c_slope * t2), -twice * b_slope, twice * c_slope, w)
    q -= b[..., None, None] * skew(v)
    cv = c[..., None] * v
    q += cv[..., :, None] * w[..., None, :]
    q += w[..., :, None] * cv[..., None, :]
    return j, q


def _square(w: Floats) -> Floats:
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    return np.asarray(x * x + y * y + z * z)


def _combine(i: Floats, k: Floats, s: Floats, w: Floats) -> Floats:
    """Return i I + k [ω]× + s ω ωᵀ; coefficients (...), ω (..., 3) -> (..., 3, 3)."""
    out = empty(*w.shape, 3)
    for row in range(3):
        right, left = (row + 1) % 3, (row + 2) % 3
        skew_part, scaled = k * w[..., left], s * w[..., row]
        symmetric = scaled * w[..., right]
        np.add(i, scaled * w[..., row], out=out[..., row, row])
        np.subtract(symmetric, skew_part, out=out[..., row, right])
        np.add(symmetric, skew_part, out=out[..., right, row])
    return out


def coefficients(t2: Floats) -> tuple[Floats, Floats]:
    """Return b = (1 − cos θ)/θ² and c = (θ − sin θ)/θ³ as functions of θ²."""
    largest = float(t2.max(initial=0.0))
    if largest < _NEAR:
        return _series(_B, t2, largest), _series(_C, t2, largest)
    near = t2 < _NEAR
    far = np.where(near, 1.0, t2)
    t = np.sqrt(far)
    b, c = (1 - np.cos(t)) / far, (t - np.sin(t)) / (far * t)
    t2 = np.where(near, t2, 0.0)
    return np.where(near, _series(_B, t2), b), np.where(near, _series(_C, t2), c)


def _slopes(t2: Floats, b: Floats, c: Floats) -> tuple[Floats, Floats]:
    near = t2 < _NEAR
    far = np.where(near, 1.0, 2 * t2)
    b_slope, c_slope = (1 - c * t2 - 2 * b) / far, (b - 3 * c) / far
    t2 = np.where(near, t2, 0.0)
    return (
        np.where(near, _series(_B_SLOPE, t2), b_slope),
        np.where(near, _series(_C_SLOPE, t2), c_slope),
    )


def _series(coefficients: Sequence[float], t2: Floats, largest: float = _NEAR) -> Floats:
    """Return a power series in θ² ≤ `largest`, to double precision."""
    last, power = 0, 1.0
    for k, coefficient in enumerate(coefficients):
        if abs(coefficient) * power > 1e-18:
            last = k
        power *= largest
    out = np.full_like(t2, coefficients[last])
    for coefficient in coefficients[:last][::-1]:
        out *= t2
        out += coefficient
    return out
