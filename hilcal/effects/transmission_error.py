"""`transmission_error`: gears and encoders err periodically with the joint angle."""

from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from hilcal.effects.per_joint import PerJoint
from hilcal.effects.protocol import (
    OWN_SPREAD,
    Changeable,
    Columns,
    Effect,
    JointResidual,
    Parameter,
    Situation,
)
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.regression.periodogram import significant_waves
from hilcal.types import Floats, Ints

MOST_HARMONICS = 120
FEWEST_HARMONICS = 4
POSES_PER_HARMONIC = 5  # so that data outnumber its two amplitudes; a guess
ORDINARY, ORDINARY_M = 5e-5, 1e-5  # Ordinary amplitude of a harmonic, rad; of a slide m
SCORED_HARMONICS = 40  # Bounds the cost of scoring; a guess
FINEST_WAVE = 1200
"""Most periods per turn of a further wave that is searched: gears of ratio 300 err with four
periods in a turn of the motor, encoders with one or two in a line, of which they have up to 512. A
choice: amplitudes of finer waves are below the noise of trackers."""
FIRST_OCTAVE = 4
"""Harmonic from which those of an octave share a size; a choice. With sizes of their own for the
first seven, 20 poses of a real UR10 predict no better."""
FURTHER_POOL = 16  # of further waves, above all octaves


class TransmissionError(PerJoint):
    """dq_j = Σ_k a_jk cos k q_j + b_jk sin k q_j, k = 1..K [rad].

    Of a slide with the phase 2π q_j / (length of its travel) for q_j [m].

    The evidence decides how strong each harmonic of each joint is, and drops those that the
    readings do not need; K only bounds the search. Joints that share parameters have the same phase
    at their zeros. Further waves k > K, as of the lines of an encoder or the teeth of a gear, are
    an option; a diagnosis finds those that stand out in the residual (`refined_by`).
    """

    name = "transmission_error"
    summary = "dq_j = Σ a_jk cos k q_j + b_jk sin k q_j: gear and encoder error"
    change = Changeable(
        "joint",
        words="transmission error",
        cause="another gear or encoder?",
        options={"harmonics": 4},
    )
    """Few readings resolve no more than four harmonics; finer ones act as scatter. A choice."""
    plausible = 30.0  # 1.5 mrad per harmonic; gears state 0.3 to 1 mrad. A choice.
    spread = 2.0**0.5  # Another gear errs as much, but elsewhere: the difference of two
    option_help: ClassVar = {
        **PerJoint.option_help,
        "harmonics": "K, the harmonics tried per joint, 1 to 1000; unless given, one for every "
        "five distinct poses, at least 4 and at most 120.",
        "waves": "further waves k > K, in periods per turn, as [128, 405], at most 1200; none "
        "unless given.",
    }

    def setup(self, states: States) -> None:
        """Read or choose the number of harmonics."""
        super().setup(states)
        if "harmonics" not in self.options:
            poses = len(np.unique(np.round(states.q, 3), axis=0))
            chosen = np.clip(poses // POSES_PER_HARMONIC, FEWEST_HARMONICS, MOST_HARMONICS)
            self.options["harmonics"] = int(chosen)
        count = self.options["harmonics"]
        if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= 1000:
            raise InputError(f"effect {self.name}: harmonics = {count!r}; valid: 1 to 1000")
        self._last = count
        self.harmonics: Ints = np.unique([*range(1, count + 1), *self._further()])

    def _further(self) -> list[Any]:
        """Read the further waves."""
        stated = self.options.get("waves", [])
        waves = [*stated] if isinstance(stated, list | tuple) else [stated]
        if not all(type(k) is int and 1 <= k <= FINEST_WAVE for k in waves):
            raise InputError(
                f"effect {self.name}: waves = {stated!r}; valid: whole numbers of periods per "
                f"turn, 1 to {FINEST_WAVE}, as [128, 405]"
            )
        return waves

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Cosine and sine amplitude of each harmonic of each joint."""
        kinds = {f".{w}{k}": "" for k in self.harmonics for w in ("cos", "sin")}
        return self.group_parameters("rad", self._ordinary, "", kinds)

    @cached_property
    def magnitudes(self) -> Floats:
        """(P,) ordinary magnitudes, the same for all harmonics of a joint."""
        g = self.shared
        ordinary = self._ordinary[[g.joint[g.group == k][0] for k in range(len(g.labels))]]
        return np.repeat(ordinary, 2 * len(self.harmonics))

    @property
    def _ordinary(self) -> Floats:
        return np.where(self.cell.arm.slides, ORDINARY_M, ORDINARY)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Waves: ∂dq_j/∂a_jk = cos k q_j, ∂dq_j/∂b_jk = sin k q_j."""
        count, done = int(np.sum(self.harmonics == np.arange(len(self.harmonics)) + 1)), 1
        waves = np.empty((*s.angle.shape, len(self.harmonics)), dtype=np.complex128)
        waves[:, :, count:] = np.exp(1j * s.angle[:, :, None] * self.harmonics[count:])
        # exp(i k q) up to k = count, twice as many by each product: many times as fast as sines.
        waves[:, :, :1] = np.exp(1j * s.angle[:, :, None] * self.harmonics[:1])
        while done < count:
            size = min(done, count - done)
            last = waves[:, :, done - 1 : done]
            np.multiply(waves[:, :, :size], last, out=waves[:, :, done : done + size])
            done += size
        return (self.kind_columns(waves.view(np.float64)),)

    def groups(self) -> Ints:
        """One variance per group of joints and harmonic."""
        return np.repeat(np.arange(len(self.shared.labels) * len(self.harmonics)), 2)

    def pools(self) -> Ints:
        """One pool for each of the harmonics 1, 2 and 3, and one per octave above.

        Spectra of gears fall with the order, but an eccentric wheel (k = 1) or an oval one (k = 2)
        may err many times as much as the next harmonic.
        """
        k = self.harmonics
        pool = np.where(k < FIRST_OCTAVE, k - 1, np.floor(np.log2(k)).astype(np.int64) + 1)
        pool[k > self._last] = FURTHER_POOL
        return np.tile(np.repeat(pool, 2), len(self.shared.labels))

    def log_std_prior(self, pool: int) -> tuple[float, float]:
        """Amplitudes of 0.16 mrad at the first harmonic, half of that with each octave.

        Of further waves, which were found since they stand out, 0.03 mrad.
        """
        if pool == FURTHER_POOL:
            return -0.5, OWN_SPREAD
        octave = pool - (pool > 1)  # of harmonics 2 and 3 the same
        return 1.2 - 0.7 * octave, OWN_SPREAD

    def refines(self, other: Effect) -> bool:
        """Whether this has the same waves and more, or `PerJoint.refines`."""
        if isinstance(other, TransmissionError) and self.shared.text == other.shared.text:
            return set(other.harmonics.tolist()) < set(self.harmonics.tolist())
        return super().refines(other)

    def refined_by(self, states: States, residual: JointResidual, level: float) -> Effect | None:
        """Return the effect with the further waves that stand out in the residual."""
        joints = np.unique(self.shared.joint)
        orders = np.setdiff1d(np.arange(self._last + 1, FINEST_WAVE + 1), self.harmonics)
        angle, moved = residual.angle[:, joints], residual.moved[:, :, joints]
        waves = significant_waves(angle, moved, residual.white, orders, residual.dof, level)
        if not waves:
            return None
        new = np.unique([k for _, k in waves])
        every = np.union1d(self.harmonics[self.harmonics > self._last], new)
        finer = self.with_options(states, waves=every.tolist())
        finer.harmonics = new  # the others are in the model
        finer.name, finer.coarse = f"{self.name}(waves={every.tolist()})", self.name
        return finer

    def fine(self, states: States) -> Effect | None:
        """Return the effect with `SCORED_HARMONICS` where the poses allow fewer."""
        if self.coarse or self._last >= SCORED_HARMONICS:
            return None
        return self.with_options(states, harmonics=SCORED_HARMONICS)

    def for_scoring(self, states: States) -> Effect:
        """Return the effect with at most `SCORED_HARMONICS`, fewer than a fit tries."""
        return self.with_options(states, harmonics=min(self._last, SCORED_HARMONICS))
