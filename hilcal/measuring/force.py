"""The force sensor as a campaign uses it: its zero, the tool it carries, what hangs."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellLoad, Operator
from hilcal.config import ForceSensor as Settings
from hilcal.errors import CannotAnswerError, DeviceError
from hilcal.measuring.devices import ForceSensorDevice, WrenchSample
from hilcal.measuring.tool_load import PARAMETERS, ToolLoad, identify_tool_load, shift, tare
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.types import Floats

MOMENT_LEVER_M = 0.1
"""Lever by which a tolerance in N becomes one in N·m."""
STANDARD_GRAVITY = np.array([0.0, 0.0, -9.80665])


def compare(
    expected: Floats,
    measured: Floats,
    std: Floats,
    tolerance_N: float,
    tolerance_share: float,
    gravity: Floats = STANDARD_GRAVITY,
) -> tuple[bool, str]:
    """Return whether the load is the one asked for, and the finding in one line.

    It is, where |f - f_expected| <= max(tolerance_N, tolerance_share |f_expected|); three sigma
    of the measurement have to fit into that too. A load that is a moment alone is judged by its
    moment, with tolerance_N acting at `MOMENT_LEVER_M`.

    Args:
        expected: (6,) wrench of the load asked for, N and N·m; zero where nothing may hang.
        measured: (6,) wrench felt, same point, base axes.
        std: (6,) its standard uncertainty.
        tolerance_N: by how much the force may differ.
        tolerance_share: the same as a share of the force.
        gravity: (3,) base axes, m/s²; along it a load is given in kg.
    """
    force, moment = (float(np.linalg.norm(part)) for part in (expected[:3], expected[3:]))
    if force == 0.0 and moment > 0.0:
        part, asked, unit, limit = slice(3, 6), moment, "N·m", tolerance_N * MOMENT_LEVER_M
    else:
        part, asked, unit, limit = slice(0, 3), force, "N", tolerance_N
    e, f = np.asarray(expected)[part], np.asarray(measured)[part]
    felt, limit = float(np.linalg.norm(f)), max(limit, tolerance_share * asked)
    words = f"asked for {_asked(e, unit, gravity)}, felt {felt:.1f} {unit}"
    if not np.all(np.isfinite([*f, *std[part]])):
        return False, f"{words}: the sensor gives no number"
    noise = 3.0 * float(np.max(std[part]))
    if noise > limit:
        return False, (
            f"{words} ± {noise:.1f} {unit}: too uncertain to tell, the load may differ by "
            f"{limit:.1f} {unit}; average longer (force_window_s in [acquire])"
        )
    difference = float(np.linalg.norm(f - e))
    if difference <= limit:
        return True, words
    return False, f"{words}: {_found(e, f, limit, unit, gravity)}"


def _asked(e: Floats, unit: str, gravity: Floats) -> str:
    """What was asked for, in kg too where it is a dead weight."""
    asked, mass = float(np.linalg.norm(e)), _mass(e, gravity)
    if asked == 0.0:
        return "nothing"
    return (
        f"{asked:.1f} {unit}" if mass is None or unit != "N" else f"{mass:.4g} kg ({asked:.1f} N)"
    )


def _found(e: Floats, f: Floats, limit: float, unit: str, gravity: Floats) -> str:
    """What the measured vector f looks like where e was asked for."""
    asked, felt = float(np.linalg.norm(e)), float(np.linalg.norm(f))
    if felt <= limit:
        return "that is nothing"
    along, size = float(f @ gravity), float(np.linalg.norm(gravity))
    weighed = unit == "N" and size > 0.0 and along >= np.cos(np.radians(15.0)) * felt * size
    kilograms = f"about {along / size**2:.1f} kg"
    if asked == 0.0:
        return f"{kilograms} still hangs" if weighed else "something still pulls"
    if weighed and _mass(e, gravity) is not None:
        return f"that is {kilograms}"
    angle = np.degrees(np.arccos(np.clip(e @ f / (asked * felt), -1.0, 1.0)))
    return f"that is {100 * felt / asked:.0f} % of it, {angle:.0f}° off its direction"


def _mass(force: Floats, gravity: Floats) -> float | None:
    """The mass in kg whose weight a force is, None where it does not point along gravity."""
    size = float(np.linalg.norm(gravity))
    if size == 0.0:
        return None
    along = float(force @ gravity) / size
    return along / size if along >= 0.9999 * np.linalg.norm(force) else None


MIN_FRAMES = 20
"""Frames that a mean wrench is made of at least."""
ENOUGH_POSES = 4
"""Unloaded readings from which the tool is identified at least."""
TOOL_OFF_M = 0.01
"""A tool whose centre of mass is so far from the configured one is remarked, m; a guess."""
_FLOOR = np.diag([1e-3**2] * 3 + [1e-4**2] * 3)
"""Variance of a mean wrench at least, N² and N²·m²: a line that rounds shows no noise at all."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorFrame:
    """Where the sensor is at one pose of the arm, base axes."""

    rotation: Floats  # (3, 3) R_base_sensor
    arm: Floats  # (3,) from the sensor's origin to the load point, m


@dataclass(frozen=True, slots=True, eq=False)
class TaredWrench:
    """One mean wrench against the zero of its session, and the pose where it was felt."""

    wrench: Floats  # (6,) sensor axes, N and N·m
    covariance: Floats  # (6, 6) of this mean
    q: Floats  # (n,) joint angles, rad


class ForceMeter:
    """A force sensor with its zero.

    The zero of a session is what the sensor reads at the reference pose with nothing on the
    hook, less the tool of the configuration. Wrenches of sessions are comparable after it,
    whatever the sensor's own zero did while it was off; how the real tool differs from the
    configured one stays in them, the same in all sessions.

    Attributes:
        zero: (6,) what the sensor reads with nothing on it, N and N·m, sensor axes.
        identified: whether the tool has been weighed, else it is that of the configuration.
    """

    def __init__(
        self, sensor: ForceSensorDevice, settings: Settings, cell: Cell, window: float
    ) -> None:
        """Use an open sensor, averaged over a window in real seconds."""
        self.sensor = sensor
        self.zero = np.zeros(6)
        self._cell, self._seconds = cell, window
        self._origin = np.array(settings.origin_m)
        self._axes = se3.rotation(np.array(settings.rotvec_rad))
        self._com = self._axes.T @ (cell.tool_com - self._origin)
        self.identified = False
        self._tared_down: Floats | None = None
        nothing = np.zeros((PARAMETERS, PARAMETERS))
        moment = cell.tool_mass * self._com
        self.tool = ToolLoad(np.zeros(6), cell.tool_mass, moment, nothing, cell.gravity, 0.0, 0, 0)

    def felt(self) -> Floats:
        """Return the present wrench (6,) against the zero, sensor axes.

        Raises:
            DeviceError: the stream is dead or stale.
        """
        return np.asarray(self.sensor.latest().wrench - self.zero)

    def average(self) -> WrenchSample:
        """Return a mean of at least `MIN_FRAMES` frames, as the sensor gives it.

        Raises:
            DeviceError: the stream is dead, gives too few frames, or stands still.
        """
        sample = self.sensor.average(self._seconds)
        if sample.frames < MIN_FRAMES:  # a fast clock's window is too short for the real line
            self._seconds *= 1.2 * MIN_FRAMES / max(sample.frames, 1)
            sample = self.sensor.average(self._seconds)
        variance, rounding = np.diagonal(sample.covariance), 1e-12 * (1.0 + np.abs(sample.wrench))
        if sample.frames >= MIN_FRAMES and np.all(variance <= rounding**2):
            raise DeviceError(
                f"force sensor: {sample.frames} frames are the same to the last digit: it sends "
                "old values. Switch it off and on"
            )
        return sample

    def tared(self, sample: WrenchSample, q: Floats) -> TaredWrench:
        """Return a mean wrench against the zero, at joint angles (n,)."""
        covariance = sample.covariance / max(sample.frames, 1) + _FLOOR
        return TaredWrench(sample.wrench - self.zero, covariance, np.asarray(q))

    def frame(self, q: Floats) -> SensorFrame:
        """Return where the sensor is at joint angles (n,)."""
        chain = chains.evaluate(self._cell.arm, np.asarray(q)[None])
        arm = chain.point(self._cell.load_point) - chain.point(self._origin)
        return SensorFrame(chain.rotation[-1][0] @ self._axes, arm[0])

    def to_flange(self, point: Floats) -> Floats:
        """Return a point (3,) of the sensor's axes in flange axes, m."""
        return np.asarray(self._origin + self._axes @ point)

    def set_zero(self, sample: WrenchSample, q: Floats) -> None:
        """Take a mean wrench without load, at joint angles (n,), as the zero."""
        cell, rotation = self._cell, self.frame(q).rotation
        self._tared_down = rotation.T @ cell.gravity
        covariance = sample.covariance / max(sample.frames, 1) + _FLOOR
        zero = tare(sample.wrench, covariance, rotation, cell.gravity, cell.tool_mass, self._com)
        self.zero = zero.bias
        if not self.identified:
            self.tool = replace(zero, bias=np.zeros(6))

    def turned(self, q: Floats) -> float:
        """Return how far gravity has turned in the sensor's axes since the tare, m/s².

        At joint angles (n,); |R(q)ᵀ g - R_tareᵀ g|, by which each kg is felt that [tool] does not
        say. Before any tare it is twice gravity, the most that it can be.
        """
        gravity = self._cell.gravity
        if self._tared_down is None:
            return 2.0 * float(np.linalg.norm(gravity))
        return float(np.linalg.norm(self.frame(q).rotation.T @ gravity - self._tared_down))

    def identify(self, unloaded: list[TaredWrench], tolerance_N: float) -> tuple[int, ...] | None:
        """Find the real tool from unloaded readings.

        A reading whose force the tool does not explain to the tolerance was not unloaded, or
        somebody leaned on the tool: the worst is left out until all are explained. Returned are the
        numbers of those; None where the readings are too few.

        Raises:
            HilcalError: their poses do not determine it, or fewer than `ENOUGH_POSES` agree.
        """
        kept = list(range(len(unloaded)))
        while len(kept) >= ENOUGH_POSES:
            used = [unloaded[k] for k in kept]
            rotation = np.array([self.frame(f.q).rotation for f in used])
            wrench = np.array([f.wrench for f in used])
            covariance = np.array([f.covariance for f in used])
            tool = identify_tool_load(wrench, covariance, rotation, self._cell.gravity)
            off = np.linalg.norm((wrench - tool.tool_wrench(rotation))[:, :3], axis=1)
            if off.max() <= tolerance_N:
                self.tool, self.identified = tool, True
                return tuple(sorted(set(range(len(unloaded))) - set(kept)))
            del kept[int(np.argmax(off))]
        if len(unloaded) < ENOUGH_POSES:
            return None
        raise CannotAnswerError(
            f"no {ENOUGH_POSES} of the {len(unloaded)} unloaded readings of the force sensor agree "
            f"to {tolerance_N:g} N; does something touch the tool?"
        )

    def load_wrench(self, tared: TaredWrench) -> Floats:
        """Return the (6,) wrench of the load at the load point, base axes, N and N·m."""
        frame = self.frame(tared.q)
        return shift(self.tool.load_wrench(tared.wrench, frame.rotation), frame.arm)

    def verify(
        self, load: CellLoad | None, tared: TaredWrench, operator: Operator
    ) -> tuple[bool, str]:
        """Whether a load is what hangs, within the operator's tolerance; and the finding.

        Compared at the load point, where a dead weight and a pull have no moment.
        """
        gravity, frame = self._cell.gravity, self.frame(tared.q)
        expected = np.zeros(6) if load is None else load.wrench(gravity)
        moved = np.eye(6)
        moved[3:, :3] = -se3.skew(frame.arm)
        at_sensor = self.tool.load_covariance(tared.covariance, frame.rotation)
        std = np.sqrt(np.diagonal(moved @ at_sensor @ moved.T))
        return compare(
            expected,
            self.load_wrench(tared),
            std,
            operator.tolerance_N,
            operator.tolerance_share,
            gravity,
        )

    def tool_differs(self, tolerance_N: float) -> str | None:
        """Return in one line how the tool differs from [tool]; None where it does not.

        It differs by a weight over the tolerance or, where that much could be felt, by a centre
        of mass over `TOOL_OFF_M`; and by more than three standard deviations.
        """
        cell, tool = self._cell, self.tool
        size = float(np.linalg.norm(cell.gravity))
        std = float(np.sqrt(tool.covariance[6, 6]))
        heavier = abs(tool.mass - cell.tool_mass)
        com, com_std = self.to_flange(tool.com), float(np.linalg.norm(tool.com_std))
        off = float(np.linalg.norm(com - cell.tool_com))
        weight = heavier * size > tolerance_N and heavier > 3 * std
        place = tool.mass * size > tolerance_N and off > max(TOOL_OFF_M, 3 * com_std)
        if not weight and not place:
            return None
        return (
            f"the force sensor feels a tool of {_tool(tool.mass, com)}, flange axes; [tool] says "
            f"{_tool(cell.tool_mass, cell.tool_com)}"
        )


def _tool(mass: float, com: Floats) -> str:
    return f"{mass:.3g} kg at ({', '.join(f'{x:.3f}' for x in com)}) m"
