"""The columns of a wide effect that is not in the model, by their factors.

All parameters of an effect that displaces joints, as the harmonics of a transmission error, move a
reading as their joint does. Readings of one pose have the same share of it, c_g p, under all loads:
with a_j the whitened motion by joint j, deflections and noise shared within the pose included, the
column of parameter p is a_j(p) c_g p in the rows of pose g, a `Factored` matrix.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.effects.protocol import Effect, Situation
from hilcal.identification.wide_effects import WIDE, of_joints
from hilcal.readings.whitening import Whitening
from hilcal.regression.factored import Factored
from hilcal.types import Bools, Floats, Ints

LEAST_NUMBERS = 250_000
"""Numbers of an effect's columns from which on they are kept by their factors; a choice by timing:
of fewer, the products of the factors are too small to pay."""


@dataclass(frozen=True, slots=True, eq=False)
class WideColumns:
    """The columns of an effect, each parameter of which displaces one joint.

    Attributes:
        joint: (P,) the joint of each parameter.
        values: (N, P) its displacement, in ordinary magnitudes, rad.
        drives: (N, m, n) motion of the readings by displacements of the drives.
        white: (R, P) whitened columns.
    """

    joint: Ints
    values: Floats
    drives: Floats
    white: Factored

    @property
    def numbers(self) -> int:
        """How many numbers are kept."""
        return self.values.size + self.drives.size

    def readings(self, chosen: slice | Bools) -> Floats:
        """Motion (N, m, P) of the chosen readings."""
        return np.asarray(self.drives[chosen][:, :, self.joint] * self.values[chosen][:, None])


@dataclass(frozen=True, slots=True, eq=False)
class WideEffect:
    """What a wide effect displaces the joints by.

    Attributes:
        joint: (P,) the joint of each parameter.
        values: (N, P) its displacement, in ordinary magnitudes, rad.
        first: (G,) a reading of each of the groups of measurements that have the same values.
    """

    joint: Ints
    values: Floats
    first: Ints

    def columns(self, drives: Floats, white: Floats) -> WideColumns:
        """Return the columns.

        Args:
            drives: (N, m, n) motion of the readings by displacements of the drives.
            white: (R, n) the same whitened.
        """
        size = white.shape[1]
        direction = white.reshape(len(self.first), -1, size)
        none, every = np.zeros((len(white), 0)), np.arange(len(self.joint))
        at = np.zeros(0, dtype=np.int64)
        own = Factored(none, at, direction, self.values[self.first], self.joint, every)
        return WideColumns(self.joint, self.values, drives, own)


def wide_effect(effect: Effect, s: Situation, w: Whitening) -> WideEffect | None:
    """Return what a wide effect displaces the joints by; None for one that cannot be factored.

    Args:
        effect: one that is not in the model.
        s: the fitted readings.
        w: their whitening.
    """
    size = len(effect.magnitudes)
    few = len(s.angle) * w.m * size < LEAST_NUMBERS
    if size < WIDE or few or len(w.buckets) != 1:
        return None
    theta = np.zeros(size)
    if effect.compliance(theta) is not None or effect.wrench_columns(theta, s) is not None:
        return None
    c = of_joints(effect.checked_columns(s))
    if c is None or len(c.values) == 1 or not np.array_equal(c.parameter, np.arange(size)):
        return None
    first = _groups(c.values, w)
    return None if first is None else WideEffect(c.element, c.values * effect.magnitudes, first)


def _groups(values: Floats, w: Whitening) -> Ints | None:
    """Return a reading of each group of successive measurements with the same values (N, P).

    Groups are of one size, of one pose, and hold whole blocks of the whitening; None where there
    are none.
    """
    (b,) = w.buckets
    own = b.loaded[:, 0]
    others = np.concatenate([b.loaded[:, 1:], b.reference], axis=1)
    if not all(np.array_equal(values[own], values[more]) for more in others.T):
        return None
    pose = w.group[:: b.loaded.shape[1]]
    same = (pose[1:] == pose[:-1]) & (values[own[1:]] == values[own[:-1]]).all(axis=1)
    starts = np.concatenate([[0], np.flatnonzero(~same) + 1])
    size = int(starts[1]) if len(starts) > 1 else len(own)
    if not np.array_equal(starts, np.arange(0, len(own), size)) or len(own) % size:
        return np.asarray(own)
    return np.asarray(own[starts])
