"""Plausible hidden parameters: how large each effect is in a real arm, and how it varies."""

from dataclasses import dataclass

import numpy as np

from drivers.simulated.elastic_tree import long_links
from hilcal.robot.arm import Arm
from hilcal.types import Floats

_BY_LOAD = (
    "tool_compliance",
    "periodic_joint_compliance",
    "backlash",
    "creep",
    "wrench_bias",
    "wrench_gain",
    "sensor_misalignment",
)
_GIVE = np.array([2.0e-3, 2.6e-3, 1.35e-3, 1.7e-3, 2.0e-3, 2.2e-3])


def joint_compliance(arm: Arm, rng: np.random.Generator) -> Floats:
    """Draw the (n,) compliances of the drives, rad/(N·m), ±30 % per joint.

    A drive gives about 2 mrad at its torque limit, whatever its size: 6 to 40 µrad/(N·m) on
    an arm of the UR10e's size (order of magnitude of harmonic drives, e.g. the stiffnesses
    K1..K3 against rated torque in the Harmonic Drive CSD/SHD catalogue).
    """
    return typical_compliance(arm) * rng.uniform(0.7, 1.3, arm.n)


def typical_compliance(arm: Arm) -> Floats:
    """Return the (n,) middle of the compliances that are drawn, rad/(N·m)."""
    give = _GIVE if arm.n == len(_GIVE) else np.full(arm.n, 1.9e-3)
    return np.asarray(give / typical_torque(arm))


def typical_torque(arm: Arm) -> Floats:
    """Return the (n,) torque limits of the drives; 100 N·m where none is known."""
    limit = np.asarray(arm.torque_max, dtype=float)
    return np.asarray(np.where(np.isfinite(limit) & (limit > 0.0), limit, 100.0))


@dataclass(frozen=True, slots=True)
class Draw:
    """Draws one effect's parameters in a plausible direction and of a plausible size.

    Attributes:
        arm: the arm.
        compliance: (n,) the drives' compliances, which stiffening belongs to, rad/(N·m).
        torque: (n,) the largest torque at each drive in the states at hand, N·m.
        harmonics: number of harmonics of the transmission error.
    """

    arm: Arm
    compliance: Floats
    torque: Floats
    harmonics: int = 6

    def effect(self, name: str, rng: np.random.Generator) -> Floats:
        """Return the parameters of the named effect, shaped as in `Truth`."""
        n = self.arm.n
        typical = typical_compliance(self.arm)
        if name == "joint_compliance":
            return joint_compliance(self.arm, rng)
        if name == "joint_stiffening":
            share = rng.uniform(0.7, 1.0, n) / 3.0
            return np.asarray(-share * self.compliance / self.torque**2)
        if name == "joint_tilt_compliance":
            return 0.5 * typical * rng.uniform(0.3, 1.0, n)
        if name == "base_compliance":
            return 0.5 * float(typical[0]) * rng.uniform(0.3, 1.0, 3)
        if name == "link_compliance":
            return self._beams(rng)
        if name == "hysteresis":
            return 5e-5 * rng.uniform(0.3, 1.0, n)
        if name == "encoder_offset":
            return 2e-4 * rng.standard_normal(n)
        if name == "joint_coupling":
            return self._couplings(rng)
        if name == "transmission_error":
            decay = 1.0 / np.arange(1, self.harmonics + 1)[:, None]
            return 1e-4 * decay * rng.standard_normal((n, self.harmonics, 2))
        if name == "link_geometry":
            return 3e-4 * rng.standard_normal((n + 1, 6))
        if name in ("load_point", "target_offset"):
            return 5e-3 * rng.standard_normal(3)
        if name == "base_frame":
            return 1e-3 * rng.standard_normal(6)
        if name == "tracker_drift":
            return np.repeat([1e-8, 3e-9], 3) * rng.standard_normal(6)
        return self._by_load(name, rng) if name in _BY_LOAD else self._by_heat(name, rng)

    def _couplings(self, rng: np.random.Generator) -> Floats:
        """Draw k (n, n) of joints that the one before, or the last but two, takes along."""
        n = self.arm.n
        out = np.diag(rng.standard_normal(n - 1), -1) if n > 1 else np.zeros((n, n))
        if n > 2:
            out[n - 1, n - 3] = rng.standard_normal()
        return np.asarray(2e-4 * out)

    def _by_load(self, name: str, rng: np.random.Generator) -> Floats:
        """Draw what depends on the load: further elasticity, and what its sensor misreads."""
        n = self.arm.n
        typical = typical_compliance(self.arm)
        if name == "tool_compliance":  # a flange plate and its bolts: stiffer about its own axis
            plate = 0.3 * float(typical[-1]) * np.array([0.5, 1.0])
            return np.asarray(plate * rng.uniform(0.5, 1.0, 2))
        if name == "periodic_joint_compliance":
            return np.asarray(0.1 * typical[:, None] * rng.standard_normal((n, 2)))
        if name == "backlash":
            return 5e-5 * rng.uniform(0.3, 1.0, n)
        if name == "creep":
            return 0.03 * rng.uniform(0.5, 1.5, 1)
        if name == "wrench_bias":
            return np.repeat([1.0, 0.1], 3) * rng.standard_normal(6)
        if name == "wrench_gain":
            return 1e-2 * rng.standard_normal(6)
        return 1e-2 * rng.standard_normal(3)  # sensor_misalignment

    def _by_heat(self, name: str, rng: np.random.Generator) -> Floats:
        """Draw what comes from temperature, from wrong masses, or from the instrument."""
        n = self.arm.n
        if name == "thermal_growth":  # steel to aluminium
            return rng.uniform(11e-6, 24e-6, 1)
        if name == "thermal_joint_drift":
            return 5e-6 * rng.standard_normal(n)
        if name == "link_mass":  # centres of mass some centimetres off
            heavy = np.maximum(self.arm.masses, 0.1)
            return np.asarray(0.03 * heavy[:, None] * rng.standard_normal((n, 3)))
        side = rng.choice(np.array([-1.0, 1.0]), 1)
        return np.asarray(5e-6 * side * rng.uniform(0.5, 1.5, 1))  # tracker_scale

    def _beams(self, rng: np.random.Generator) -> Floats:
        """Draw 1/EI and 1/GJ (b, 2): a tube that gives as much as half a drive over its length."""
        which = long_links(self.arm)
        length = np.linalg.norm(self.arm.links[which, :3, 3], axis=1)
        size = 0.5 * typical_compliance(self.arm)[:3].mean() / length
        return np.asarray(size[:, None] * [1.0, 1.3] * rng.uniform(0.5, 1.5, (len(which), 2)))
