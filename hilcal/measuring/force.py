"""The force sensor in a campaign: its zero, the tool that it carries, and the load.

The sensor reads the wrench of tool and load, in its axes at its origin, plus its zero:

    f = b_f + m u + f_load,   u = R_base_sensorᵀ g
    M = b_M + m c × u + M_load

Without a load this is linear in the ten parameters x = (b_f, b_M, m, m c). Rotations of the sensor
against gravity separate them (J. Swevers et al., Dynamic model identification for industrial
robots, IEEE Control Systems 27 (2007) 58, for payloads).
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellLoad, Operator
from hilcal.config import ForceSensor as Settings
from hilcal.errors import CannotAnswerError, DeviceError, InputError
from hilcal.measuring.devices import ForceSensorDevice, WrenchSample
from hilcal.readings.whitening import whitening_matrix
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.types import Floats

PARAMETERS = 10
MIN_SPREAD = 0.02
"""Least RMS difference of the directions of gravity, rad: about one degree."""


@dataclass(frozen=True, slots=True, eq=False)
class ToolLoad:
    """A sensor's zero and its tool."""

    bias: Floats  # (6,) zero, N and N·m, sensor axes
    mass: float  # of the tool beyond the sensor, kg
    moment: Floats  # (3,) mass times centre of mass, kg·m, sensor axes from its origin
    covariance: Floats  # (10, 10) of (bias, mass, moment); zero for fixed parameters
    gravity: Floats  # (3,) base axes, m/s²
    chi2: float  # sum of squared whitened residuals
    dof: int  # degrees of freedom; 0 after a tare

    @property
    def weighed(self) -> bool:
        """Whether the mass exceeds three standard uncertainties."""
        return bool(self.mass > 3.0 * np.sqrt(self.covariance[6, 6]))

    @property
    def com(self) -> Floats:
        """(3,) centre of mass, m, sensor axes; zero unless weighed."""
        return self.moment / self.mass if self.weighed else np.zeros(3)

    @property
    def com_std(self) -> Floats:
        """(3,) standard uncertainty of `com`, m, to first order; infinite unless weighed."""
        if not self.weighed:
            return np.full(3, np.inf)
        J = np.hstack([-self.com[:, None], np.eye(3)]) / self.mass
        return np.asarray(np.sqrt(np.diagonal(J @ self.covariance[6:, 6:] @ J.T)))

    @property
    def variance_factor(self) -> float:
        """chi2 / dof: 1 if the model and the stated noise explain the readings."""
        return self.chi2 / self.dof if self.dof else float("nan")

    def tool_wrench(self, rotation: Floats) -> Floats:
        """Return the reading (..., 6) without a load, for R_base_sensor (..., 3, 3)."""
        x = np.concatenate([self.bias, [self.mass], self.moment])
        return np.asarray(design(np.asarray(rotation), self.gravity) @ x)

    def load_wrench(self, wrench: Floats, rotation: Floats) -> Floats:
        """Return the load's wrench (..., 6) at the sensor, base axes, of a reading."""
        of_load = np.asarray(wrench) - self.tool_wrench(rotation)
        parts = of_load.reshape(*of_load.shape[:-1], 2, 3)
        return np.asarray((parts @ np.swapaxes(rotation, -1, -2)).reshape(of_load.shape))

    def load_covariance(self, covariance: Floats, rotation: Floats) -> Floats:
        """Return the covariance (6, 6) of `load_wrench`, from reading and parameters.

        Cov = B (Cov_reading + D Cov_x Dᵀ) Bᵀ with B = diag(R, R), D the design matrix.
        """
        D = design(np.asarray(rotation), self.gravity)
        B = np.kron(np.eye(2), rotation)
        return np.asarray(B @ (covariance + D @ self.covariance @ D.T) @ B.T)


def design(rotation: Floats, gravity: Floats) -> Floats:
    """Return D (..., 6, 10): unloaded reading = D x, x = (b_f, b_M, m, m c), at R_base_sensor."""
    u = np.swapaxes(rotation, -1, -2) @ np.asarray(gravity, dtype=np.float64)
    out = np.zeros((*u.shape[:-1], 6, PARAMETERS))
    out[..., :6] = np.eye(6)
    out[..., :3, 6] = u
    out[..., 3:, 7:] = -se3.skew(u)  # m c × u = -u × m c
    return out


def identify_tool_load(
    wrench: Floats, covariance: Floats, rotation: Floats, gravity: Floats
) -> ToolLoad:
    """Estimate zero, mass and centre of mass from K mean readings without a load, sensor axes.

    Whitened least squares: x = argmin sum_k |S_k⁻¹ (w_k - D_k x)|² with S_k S_kᵀ = Cov_k.
    """
    _check_finite(wrench, covariance, rotation)
    _check_orientations(rotation, gravity)
    white = whitening_matrix(covariance)
    A = (white @ design(rotation, gravity)).reshape(-1, PARAMETERS)
    y = (white @ wrench[..., None]).reshape(-1)
    scale = np.linalg.norm(A, axis=0)
    Q, R = np.linalg.qr(A / scale)
    x = np.linalg.solve(R, Q.T @ y) / scale
    root = np.linalg.inv(R) / scale[:, None]
    cov = root @ root.T
    residual = y - A @ x
    mass = float(x[6])
    if mass < -5.0 * np.sqrt(cov[6, 6]):
        raise CannotAnswerError(
            f"force sensor: its readings give a tool of {mass:.3g} kg; its axes or its sign are "
            "wrong: check rotvec_rad in [force_sensor]"
        )
    chi2, dof = float(residual @ residual), len(y) - PARAMETERS
    return ToolLoad(x[:6], mass, x[7:], cov, gravity, chi2, dof)


def tare(
    wrench: Floats, covariance: Floats, rotation: Floats, gravity: Floats, mass: float, com: Floats
) -> ToolLoad:
    """Return the sensor's zero from one mean reading (6,) without a load, with a known tool.

    The tool's centre of mass (3,) is in sensor axes from the sensor's origin, m.
    """
    _check_finite(wrench, covariance, rotation)
    moment = mass * com
    tool = design(rotation, gravity)[:, 6:] @ np.concatenate([[mass], moment])
    cov = np.zeros((PARAMETERS, PARAMETERS))
    cov[:6, :6] = covariance
    return ToolLoad(wrench - tool, float(mass), moment, cov, gravity, chi2=0.0, dof=0)


def shift(wrench: Floats, lever: Floats) -> Floats:
    """Return a wrench (..., 6) at a point displaced by l (..., 3), the lever: M' = M - l × f."""
    force, moment = wrench[..., :3], wrench[..., 3:]
    return np.concatenate([force, moment - np.cross(lever, force)], axis=-1)


def _check_finite(*readings: Floats) -> None:
    if not all(np.isfinite(values).all() for values in readings):
        raise InputError("tool load: a reading has values that are not finite")


def _check_orientations(rotation: Floats, gravity: Floats) -> None:
    """Refuse orientations whose directions of gravity are too similar.

    If u varies in one direction only, the readings determine the mass, and the centre of mass
    except its component in that direction.
    """
    K, size = len(rotation), max(float(np.linalg.norm(gravity)), 1e-30)
    u = np.swapaxes(rotation, -1, -2) @ (gravity / size)
    spread = np.append(np.linalg.svd(u - u.mean(axis=0), compute_uv=False) / np.sqrt(K), 0.0)
    if spread[0] < MIN_SPREAD:
        along, missing = "one direction", "mass and centre of mass"
    elif spread[1] < MIN_SPREAD:
        along, missing = "two directions", "centre of mass in one direction"
    else:
        return
    raise CannotAnswerError(
        f"force sensor: {K} unloaded reading{'s' * (K != 1)} with gravity along "
        f"{along} of the sensor do not determine the tool's {missing}; measure "
        "unloaded at 3 or more poses that turn the flange about two different horizontal axes, "
        "30° or more"
    )


MOMENT_LEVER_M = 0.1  # lever that converts a tolerance in N to N·m


def judged_part(expected: Floats) -> tuple[slice, str, float]:
    """Return the elements of a load's wrench (6,) to compare, their unit, and its ratio to N.

    The force; for a load that is a moment alone the moment, with `MOMENT_LEVER_M`.
    """
    if expected[3:].any() and not expected[:3].any():
        return slice(3, 6), "N·m", MOMENT_LEVER_M
    return slice(0, 3), "N", 1.0


def compare(
    expected: Floats,
    measured: Floats,
    std: Floats,
    tolerance_N: float,
    tolerance_share: float,
    gravity: Floats,
) -> tuple[bool, str]:
    """Return whether the load is the requested one, and the finding in one line.

    It is, if |f - f_expected| <= max(tolerance_N, tolerance_share |f_expected|), which three sigma
    of the measurement must not exceed either; for a moment see `judged_part`. Wrenches are at one
    point, base axes.
    """
    part, unit, lever = judged_part(expected)
    e, f = expected[part], measured[part]
    expected_size, measured_size = float(np.linalg.norm(e)), float(np.linalg.norm(f))
    limit = max(tolerance_N * lever, tolerance_share * expected_size)
    text = f"asked for {_expected_text(e, unit, gravity)}, measured {measured_size:.1f} {unit}"
    noise = 3.0 * float(np.max(std[part]))
    if noise > limit:
        return False, (
            f"{text} ± {noise:.1f} {unit}: too uncertain, as the load may differ by "
            f"{limit:.1f} {unit}; average longer (force_window_s in [acquire])"
        )
    difference = float(np.linalg.norm(f - e))
    if difference <= limit:
        return True, text
    return False, f"{text}: {_measured_text(e, f, limit, unit, gravity)}"


def _expected_text(e: Floats, unit: str, gravity: Floats) -> str:
    """Return the requested load, in kg too if it is a weight."""
    size, mass = float(np.linalg.norm(e)), _mass(e, gravity)
    if size == 0.0:
        return "nothing"
    return f"{size:.1f} {unit}" if mass is None or unit != "N" else f"{mass:.4g} kg ({size:.1f} N)"


def _measured_text(e: Floats, f: Floats, limit: float, unit: str, gravity: Floats) -> str:
    expected_size, measured_size = float(np.linalg.norm(e)), float(np.linalg.norm(f))
    if measured_size <= limit:
        return "that is nothing"
    along, g = float(f @ gravity), float(np.linalg.norm(gravity))
    is_weight = unit == "N" and g > 0.0 and along >= np.cos(np.radians(15.0)) * measured_size * g
    kilograms = f"about {along / g**2:.1f} kg"
    if expected_size == 0.0:
        return f"{kilograms} still hangs" if is_weight else "something still pulls"
    sideways = float(np.sqrt(max(measured_size**2 - (along / g) ** 2, 0.0))) if g > 0.0 else 0.0
    if is_weight and _mass(e, gravity) is not None and sideways <= limit:
        return f"that is {kilograms}"
    angle = np.degrees(np.arccos(np.clip(e @ f / (expected_size * measured_size), -1.0, 1.0)))
    return (
        f"that is {100 * measured_size / expected_size:.0f} % of it, {angle:.0f}° off its direction"
    )


def _mass(force: Floats, gravity: Floats) -> float | None:
    """Return the mass, kg, whose weight a force is; None if it does not point along gravity."""
    size = float(np.linalg.norm(gravity))
    if size == 0.0:
        return None
    along = float(force @ gravity) / size
    return along / size if along >= 0.9999 * np.linalg.norm(force) else None


MIN_FRAMES = 20  # frames of a mean wrench, at least
ENOUGH_POSES = 4  # unloaded readings to identify the tool, at least
TOOL_OFF_M = 0.01
"""Distance of the centre of mass from the configured one that causes a remark, m; a guess."""
_FLOOR = np.diag([1e-3**2] * 3 + [1e-4**2] * 3)
"""Least variance of a mean wrench, N² and N²·m²: rounding can hide all noise."""


@dataclass(frozen=True, slots=True, eq=False)
class TaredWrench:
    """A mean wrench, tared by the zero of its session, with its pose."""

    wrench: Floats  # (6,) sensor axes, N and N·m
    covariance: Floats  # (6, 6) of the mean
    q: Floats  # (n,) joint angles, rad


class ForceMeter:
    """A force sensor with its zero.

    The zero of a session is the unloaded reading at the reference pose, less the wrench of the
    configured tool. It makes the wrenches of sessions comparable if the sensor's zero drifts while
    it is off; they contain the difference of the real tool from the configured one. Once
    `identified`, the tool is the estimated one.
    """

    def __init__(
        self, sensor: ForceSensorDevice, settings: Settings, cell: Cell, window: float
    ) -> None:
        """Use an open sensor, averaged over a window, real s."""
        self.sensor, self.zero, self.identified = sensor, np.zeros(6), False
        self._cell, self._seconds = cell, window
        self.mounting = settings.mounting
        self._origin = np.array(settings.origin_m)
        self._axes = se3.rotation(np.array(settings.rotvec_rad))
        self._com = self._axes.T @ (cell.tool_com - self._origin)
        self._gravity_at_tare: Floats | None = None  # (3,) sensor axes
        exact = np.zeros((PARAMETERS, PARAMETERS))
        moment = cell.tool_mass * self._com
        self.tool = ToolLoad(np.zeros(6), cell.tool_mass, moment, exact, cell.gravity, 0.0, 0)

    def average(self) -> WrenchSample:
        """Return a mean of at least `MIN_FRAMES` frames, not tared."""
        sample = self.sensor.average(self._seconds)
        if (
            sample.frames < MIN_FRAMES
        ):  # in a fast simulated cell the window is too short for the real data rate
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
        """Return a tared mean wrench, at joint angles (n,)."""
        covariance = sample.covariance / max(sample.frames, 1) + _FLOOR
        return TaredWrench(sample.wrench - self.zero, covariance, np.asarray(q))

    def frame(self, q: Floats) -> tuple[Floats, Floats]:
        """Return R_base_sensor and the vector (3,) from sensor to load point, base axes, m."""
        chain = chains.evaluate(self._cell.arm, np.asarray(q)[None])
        lever = chain.point(self._cell.load_point) - chain.point(self._origin)
        return chain.rotation[-1][0] @ self._axes, lever[0]

    def to_flange(self, point: Floats) -> Floats:
        """Convert a point (3,) from sensor axes to flange axes, m."""
        return np.asarray(self._origin + self._axes @ point)

    def set_zero(self, sample: WrenchSample, q: Floats) -> None:
        """Set the zero by an unloaded mean wrench at joint angles (n,)."""
        cell, rotation = self._cell, self.frame(q)[0]
        self._gravity_at_tare = rotation.T @ cell.gravity
        covariance = self.tared(sample, q).covariance
        zero = tare(sample.wrench, covariance, rotation, cell.gravity, cell.tool_mass, self._com)
        self.zero = zero.bias
        if not self.identified:
            self.tool = replace(zero, bias=np.zeros(6))

    def gravity_change(self, q: Floats) -> float:
        """Return the change of gravity in sensor axes since the tare, m/s², at q (n,).

        |R(q)ᵀ g - R_tareᵀ g| is the force of each kg that [tool] lacks; before any tare it is twice
        gravity, its maximum.
        """
        gravity = self._cell.gravity
        if self._gravity_at_tare is None:
            return 2.0 * float(np.linalg.norm(gravity))
        return float(np.linalg.norm(self.frame(q)[0].T @ gravity - self._gravity_at_tare))

    def identify(self, unloaded: list[TaredWrench], tolerance_N: float) -> tuple[int, ...] | None:
        """Identify the tool from unloaded readings; return indices of outliers, None if too few.

        A reading whose force the tool does not explain to the tolerance was not unloaded, or a
        person touched the tool: the worst one is removed until all are explained.
        """
        retained = list(range(len(unloaded)))
        while len(retained) >= ENOUGH_POSES:
            used = [unloaded[k] for k in retained]
            rotation = np.array([self.frame(f.q)[0] for f in used])
            wrench = np.array([f.wrench for f in used])
            covariance = np.array([f.covariance for f in used])
            tool = identify_tool_load(wrench, covariance, rotation, self._cell.gravity)
            residual = np.linalg.norm((wrench - tool.tool_wrench(rotation))[:, :3], axis=1)
            if residual.max() <= tolerance_N:
                self.tool, self.identified = tool, True
                return tuple(sorted(set(range(len(unloaded))) - set(retained)))
            del retained[int(np.argmax(residual))]
        if len(unloaded) < ENOUGH_POSES:
            return None
        raise CannotAnswerError(
            f"no {ENOUGH_POSES} of the {len(unloaded)} unloaded readings of the force sensor agree "
            f"to {tolerance_N:g} N; does something touch the tool, "
            "or is rotvec_rad in [force_sensor] wrong?"
        )

    def load_wrench(self, tared: TaredWrench) -> Floats:
        """Return the wrench (6,) of the load at the load point, base axes, N and N·m."""
        rotation, lever = self.frame(tared.q)
        return shift(self.tool.load_wrench(tared.wrench, rotation), lever)

    def verify(
        self, load: CellLoad | None, tared: TaredWrench, operator: Operator
    ) -> tuple[bool, str]:
        """Return whether a load hangs, within the operator's tolerance, and the finding."""
        gravity, (rotation, lever) = self._cell.gravity, self.frame(tared.q)
        expected = np.zeros(6) if load is None else load.wrench(gravity)
        moved = np.eye(6)
        moved[3:, :3] = -se3.skew(lever)
        at_sensor = self.tool.load_covariance(tared.covariance, rotation)
        std = np.sqrt(np.diagonal(moved @ at_sensor @ moved.T))
        limits = operator.tolerance_N, operator.tolerance_share
        return compare(expected, self.load_wrench(tared), std, *limits, gravity)

    def tool_differs(self, tolerance_N: float) -> str | None:
        """Return the difference of the tool from [tool] in one line; None without a difference.

        A difference of weight exceeds the tolerance. A difference of the centre of mass exceeds
        `TOOL_OFF_M`, for a tool whose weight exceeds the tolerance. Both exceed three standard
        deviations.
        """
        cell, tool = self._cell, self.tool
        size = float(np.linalg.norm(cell.gravity))
        std = float(np.sqrt(tool.covariance[6, 6]))
        heavier = abs(tool.mass - cell.tool_mass)
        com, com_std = self.to_flange(tool.com), float(np.linalg.norm(tool.com_std))
        displacement = float(np.linalg.norm(com - cell.tool_com))
        weight = heavier * size > tolerance_N and heavier > 3 * std
        place = tool.mass * size > tolerance_N and displacement > max(TOOL_OFF_M, 3 * com_std)
        if not weight and not place:
            return None
        return (
            f"the force sensor measures a tool of {body_text(tool.mass, com)}, flange axes; [tool] "
            f"says {body_text(cell.tool_mass, cell.tool_com)}"
        )


def body_text(mass: float, com: Floats) -> str:
    """Return a mass, kg, and its centre (3,), m, for people."""
    return f"{mass:.3g} kg at ({', '.join(f'{x:.3f}' for x in com)}) m"
