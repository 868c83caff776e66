"""Which convention a table's orientations are written in, decided by the nominal arm.

With the nominal flange orientations R_i, the orientations M_i of the right convention obey

    M_i = A R_i B,      y_i = A (p_i + R_i τ) + t

with one rotation A (base to sensor) and one B (target on the flange) for all readings, up to the
arm's own errors; those of a wrong convention do not. The positions are needed: a cyclic exchange of
the axes' names turns one convention into another, and A and B take it up.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.robot import chain as chains
from hilcal.robot.arm import Arm
from hilcal.tables.orientation import CONVENTIONS, NUMBERS, rotations
from hilcal.types import Floats

AGREES = 0.05
"""rad; nominal arms are better by far (1 mrad), other conventions worse (1 rad); a choice."""
CLEARER = 5.0
"""How much worse the next convention must fit for the first to be certain; a choice."""
FEWEST = 6
"""Readings below which two free rotations fit too easily; a choice."""
_ROUNDS = 20
_MOST = 300


@dataclass(frozen=True, slots=True)
class Fit:
    """How well a convention agrees with the arm.

    Attributes:
        convention: its name.
        angle: rms angle left, rad.
        position: rms distance left, m.
        rms: both together, distances as parts of the arm's reach.
    """

    convention: str
    angle: float
    position: float
    rms: float


@dataclass(frozen=True, slots=True)
class Choice:
    """Conventions from the best to the worst.

    Attributes:
        ranked: every convention of as many numbers.
    """

    ranked: tuple[Fit, ...]

    @property
    def decided(self) -> str | None:
        """The convention, where the data leave no doubt; None otherwise."""
        best, second = self.ranked[:2]
        clear = best.rms < AGREES and second.rms > CLEARER * best.rms
        return best.convention if clear else None


def choose_convention(
    arm: Arm, q: Floats, position: Floats, numbers: Floats, unit: float
) -> Choice | None:
    """Rank the conventions of orientations (N, k) by their agreement with the nominal arm.

    Args:
        arm: the arm.
        q: (N, n) joint angles, rad.
        position: (N, 3) m, sensor axes.
        numbers: (N, 3) angles or rotation vectors, or (N, 4) quaternions.
        unit: radians in the unit of angles.

    Returns:
        None where the readings are too few to tell.
    """
    step = max(1, len(q) // _MOST)
    q, position, numbers = q[::step], position[::step], numbers[::step]
    if len(q) < FEWEST:
        return None
    chain = chains.evaluate(arm, q)
    flange, p = chain.rotation[-1], chain.position[-1]
    fits = []
    for name, kind in CONVENTIONS.items():
        if NUMBERS.get(kind, 3) != numbers.shape[1] or not _plain(name):
            continue
        base, angle = _attitudes(rotations(name, numbers, unit), flange)
        distance = _distance(base, flange, p, position)
        fits.append(Fit(name, angle, distance, float(np.hypot(angle, distance / arm.reach))))
    return Choice(tuple(sorted(fits, key=lambda f: f.rms)))


def _plain(name: str) -> bool:
    """Whether a name is the convention's own, not a maker's."""
    return name.startswith(("intrinsic-", "fixed-", "rotation-", "quaternion-"))


def _attitudes(measured: Floats, flange: Floats) -> tuple[Floats, float]:
    """A and the rms angle, rad, of the best M_i = A R_i B."""
    # vec by rows: (M_i ⊗ I) vec(Bᵀ) = (I ⊗ R_iᵀ) vec(A)
    eye = np.eye(3)
    left = np.einsum("nij,kl->nikjl", measured, eye).reshape(-1, 9)
    right = np.einsum("ij,nlk->nikjl", eye, flange).reshape(-1, 9)
    gram = np.concatenate([left, -right], axis=1)
    vector = np.linalg.eigh(gram.T @ gram)[1][:, 0]
    a = vector[9:].reshape(3, 3)
    a = _nearest(a * (np.sign(np.linalg.det(a)) or 1.0))
    for _ in range(_ROUNDS):
        b = _nearest(np.einsum("nji,kj,nkl->il", flange, a, measured))
        a = _nearest(np.einsum("nij,kj,nlk->il", measured, b, flange))
    trace = np.einsum("nij,nij->n", measured, a @ flange @ b)
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    return a, float(np.sqrt(np.mean(angle**2)))


def _distance(base: Floats, flange: Floats, p: Floats, y: Floats) -> float:
    """Rms distance, m, of y_i − A p_i = A R_i τ + t with the best τ and t."""
    rest = y - p @ base.T
    eye = np.broadcast_to(np.eye(3), (len(p), 3, 3))
    design = np.concatenate([base @ flange, eye], axis=2).reshape(-1, 6)
    solution = np.linalg.lstsq(design, rest.reshape(-1), rcond=1e-9)[0]
    left = rest.reshape(-1) - design @ solution
    return float(np.sqrt(3 * np.mean(left**2)))


def _nearest(m: Floats) -> Floats:
    u, _, vt = np.linalg.svd(m)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt)
