"""`transmission_error`: gears and encoders err periodically with the joint angle."""

from functools import cached_property
from typing import ClassVar

import numpy as np

from hilcal.effects.per_joint import PerJoint
from hilcal.effects.protocol import OWN_SPREAD, Changeable, Columns, Effect, Parameter, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Floats, Ints

MOST_HARMONICS = 120
FEWEST_HARMONICS = 4
POSES_PER_HARMONIC = 5  # so that data outnumber its two amplitudes; a guess
ORDINARY, ORDINARY_M = 5e-5, 1e-5  # Ordinary amplitude of a harmonic, rad; of a slide m
SCORED_HARMONICS = 40  # Bounds the cost of scoring; a guess


class TransmissionError(PerJoint):
    """dq_j = Σ_k a_jk cos k q_j + b_jk sin k q_j, k = 1..K [rad].

    Of a slide with the phase 2π q_j / (length of its travel) for q_j [m].

    The evidence decides how strong each harmonic of each joint is, and drops those that the
    readings do not need; K only bounds the search. Joints that share parameters have the same phase
    at their zeros.
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
        self.harmonics = np.arange(1, count + 1)

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
        # exp(i k q), twice as many harmonics by each product: many times as fast as sines.
        count, done = len(self.harmonics), 1
        waves = np.empty((*s.angle.shape, count), dtype=np.complex128)
        waves[:, :, 0] = np.exp(1j * s.angle)
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
        """One pool per octave of the harmonics: spectra of gears fall with the order."""
        octave = np.floor(np.log2(self.harmonics)).astype(np.int64)
        return np.tile(np.repeat(octave, 2), len(self.shared.labels))

    def log_std_prior(self, pool: int) -> tuple[float, float]:
        """Amplitudes of 0.16 mrad at the first harmonic, half of that with each octave."""
        return 1.2 - 0.7 * pool, OWN_SPREAD

    def fine(self, states: States) -> Effect | None:
        """Return the effect with `SCORED_HARMONICS` where the poses allow fewer."""
        if len(self.harmonics) >= SCORED_HARMONICS:
            return None
        return self.with_options(states, harmonics=SCORED_HARMONICS)

    def for_scoring(self, states: States) -> Effect:
        """Return the effect with at most `SCORED_HARMONICS`, fewer than a fit tries."""
        return self.with_options(states, harmonics=min(len(self.harmonics), SCORED_HARMONICS))
