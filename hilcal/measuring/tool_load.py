"""What a force sensor weighs: its own zero, the tool beyond it, and the load that hangs there.

The sensor reads what tool and load exert on it, in its own axes at its origin, plus its zero:

    f = b_f + m u + f_load,   u = R_base_sensorᵀ g
    M = b_M + m c × u + M_load

Without a load this is linear in the ten parameters x = (b_f, b_M, m, m c). Turning the sensor
in gravity tells them apart (J. Swevers et al., Dynamic model identification for industrial
robots, IEEE Control Systems 27 (2007) 58, for payloads alike).
"""

from dataclasses import dataclass

import numpy as np

from hilcal.errors import CannotAnswerError, InputError
from hilcal.robot import se3
from hilcal.types import Floats

PARAMETERS = 10
MIN_SPREAD = 0.02
"""Root mean square by which directions of gravity have to differ, rad: about one degree."""


@dataclass(frozen=True, slots=True, eq=False)
class ToolLoad:
    """A sensor's zero and the tool it carries."""

    bias: Floats  # (6,) what the sensor reads with nothing on it, N and N·m, sensor axes
    mass: float  # of the tool beyond the sensor, kg
    moment: Floats  # (3,) mass times centre of mass, kg·m, sensor axes from its origin
    covariance: Floats  # (10, 10) of (bias, mass, moment); zero for what was not estimated
    gravity: Floats  # (3,) base axes, m/s²
    chi2: float  # sum of squared whitened residuals
    dof: int  # its degrees of freedom; 0 after a tare
    poses: int  # number of readings used

    @property
    def com(self) -> Floats:
        """(3,) centre of mass, m, sensor axes; zero while the mass is not above 3 sigma."""
        if self.mass <= 3.0 * np.sqrt(self.covariance[6, 6]) or self.mass <= 0.0:
            return np.zeros(3)
        return self.moment / self.mass

    @property
    def com_std(self) -> Floats:
        """(3,) standard uncertainty of `com`, m, to first order; infinite where it is unknown."""
        if not np.any(self.com) and self.mass <= 3.0 * np.sqrt(self.covariance[6, 6]):
            return np.full(3, np.inf)
        J = np.hstack([-self.com[:, None], np.eye(3)]) / self.mass
        return np.asarray(np.sqrt(np.diagonal(J @ self.covariance[6:, 6:] @ J.T)))

    @property
    def variance_factor(self) -> float:
        """chi2 / dof: 1 where the model and the stated noise explain the readings."""
        return self.chi2 / self.dof if self.dof else float("nan")

    def tool_wrench(self, rotation: Floats) -> Floats:
        """Return what the sensor reads without a load, for R_base_sensor (..., 3, 3): (..., 6)."""
        x = np.concatenate([self.bias, [self.mass], self.moment])
        return np.asarray(design(np.asarray(rotation), self.gravity) @ x)

    def load_wrench(self, wrench: Floats, rotation: Floats) -> Floats:
        """Return the load's wrench (..., 6) at the sensor's origin, base axes, N and N·m.

        Readings (..., 6) are in sensor axes; `rotation` (..., 3, 3) is R_base_sensor.
        """
        own = np.asarray(wrench) - self.tool_wrench(rotation)
        parts = own.reshape(*own.shape[:-1], 2, 3)
        return np.asarray((parts @ np.swapaxes(rotation, -1, -2)).reshape(own.shape))

    def load_covariance(self, covariance: Floats, rotation: Floats) -> Floats:
        """Return the covariance (6, 6) of `load_wrench`, from reading and parameters.

        Cov = B (Cov_reading + D Cov_x Dᵀ) Bᵀ with B = diag(R, R), R = R_base_sensor, and D the
        design matrix; that of the reading (a mean's, if a mean) is in sensor axes.
        """
        D = design(np.asarray(rotation), self.gravity)
        B = np.kron(np.eye(2), rotation)
        return np.asarray(B @ (covariance + D @ self.covariance @ D.T) @ B.T)


def design(rotation: Floats, gravity: Floats) -> Floats:
    """Return D (..., 6, 10) with reading = D x for x = (b_f, b_M, m, m c) and no load.

    `rotation` (..., 3, 3) is R_base_sensor, gravity (3,) in base axes, m/s².
    """
    u = np.swapaxes(rotation, -1, -2) @ np.asarray(gravity, dtype=np.float64)
    out = np.zeros((*u.shape[:-1], 6, PARAMETERS))
    out[..., :6] = np.eye(6)
    out[..., :3, 6] = u
    out[..., 3:, 7:] = -se3.skew(u)  # m c × u = -u × m c
    return out


def identify_tool_load(
    wrench: Floats, covariance: Floats, rotation: Floats, gravity: Floats
) -> ToolLoad:
    """Estimate zero, mass and centre of mass from readings without a load.

    Whitened least squares: x = argmin sum_k |S_k⁻¹ (w_k - D_k x)|² with S_k S_kᵀ = Cov_k.

    Args:
        wrench: (K, 6) mean readings, sensor axes, N and N·m.
        covariance: (K, 6, 6) of these means.
        rotation: (K, 3, 3) R_base_sensor.
        gravity: (3,) base axes, m/s².

    Raises:
        CannotAnswerError: the orientations do not determine all parameters, or the readings
            give a negative mass.
        InputError: shapes that do not fit, values that are no numbers, a covariance that is not
            positive definite.
    """
    wrench, rotation, gravity = (np.asarray(a, np.float64) for a in (wrench, rotation, gravity))
    _check(wrench, np.asarray(covariance), rotation, gravity)
    _check_orientations(rotation, gravity)
    white = np.linalg.inv(_root(np.asarray(covariance, np.float64)))
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
    return ToolLoad(
        bias=x[:6],
        mass=mass,
        moment=x[7:],
        covariance=cov,
        gravity=gravity,
        chi2=float(residual @ residual),
        dof=len(y) - PARAMETERS,
        poses=len(wrench),
    )


def tare(
    wrench: Floats, covariance: Floats, rotation: Floats, gravity: Floats, mass: float, com: Floats
) -> ToolLoad:
    """Return the sensor's zero from one reading without a load; the tool is known.

    Args:
        wrench: (6,) mean reading, sensor axes, N and N·m.
        covariance: (6, 6) of this mean.
        rotation: (3, 3) R_base_sensor.
        gravity: (3,) base axes, m/s².
        mass: of the tool beyond the sensor, kg.
        com: (3,) its centre of mass, sensor axes from its origin, m.

    Raises:
        InputError: shapes that do not fit, or values that are no numbers.
    """
    wrench, rotation, gravity = (np.asarray(a, np.float64) for a in (wrench, rotation, gravity))
    _check(wrench[None], np.asarray(covariance)[None], rotation[None], gravity)
    moment = mass * np.asarray(com, dtype=np.float64)
    tool = design(rotation, gravity)[:, 6:] @ np.concatenate([[mass], moment])
    if not np.all(np.isfinite(tool)):
        raise InputError("tool load: mass and centre of mass must be finite")
    cov = np.zeros((PARAMETERS, PARAMETERS))
    cov[:6, :6] = covariance
    return ToolLoad(wrench - tool, float(mass), moment, cov, gravity, chi2=0.0, dof=0, poses=1)


def shift(wrench: Floats, arm: Floats) -> Floats:
    """Return a wrench (..., 6) taken at a point that lies `arm` (..., 3) further, same axes, SI.

    f' = f,  M' = M - arm × f
    """
    wrench = np.asarray(wrench, dtype=np.float64)
    force, moment = wrench[..., :3], wrench[..., 3:]
    return np.concatenate([force, moment - np.cross(arm, force)], axis=-1)


def _check(wrench: Floats, covariance: Floats, rotation: Floats, gravity: Floats) -> None:
    K = len(wrench)
    wanted = {"wrench": (K, 6), "covariance": (K, 6, 6), "rotation": (K, 3, 3), "gravity": (3,)}
    given = {
        "wrench": wrench, "covariance": covariance, "rotation": rotation, "gravity": gravity,
    }  # fmt: skip
    for name, shape in wanted.items():
        if given[name].shape != shape:
            raise InputError(f"tool load: {name} has shape {given[name].shape}, not {shape}")
        if not np.all(np.isfinite(given[name])):
            raise InputError(f"tool load: {name} has values that are no finite numbers")


def _root(covariance: Floats) -> Floats:
    """Cholesky factors (K, 6, 6), after units of one standard deviation each."""
    std = np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0.0))
    try:
        with np.errstate(divide="raise", invalid="raise"):
            correlation = covariance / (std[..., :, None] * std[..., None, :])
        return np.asarray(std[..., None] * np.linalg.cholesky(correlation))
    except (np.linalg.LinAlgError, FloatingPointError):
        raise InputError(
            "tool load: the covariance of a mean wrench is not positive definite; average over "
            "more frames (force_window_s in [acquire])"
        ) from None


def _check_orientations(rotation: Floats, gravity: Floats) -> None:
    """Refuse orientations whose directions of gravity are too much alike.

    Differences of u along one direction only: they tell the mass, and the centre of mass but
    for its part along that direction.
    """
    size = float(np.linalg.norm(gravity))
    K = len(rotation)
    spread = np.zeros(2)
    if size > 0.0 and K > 1:
        u = np.swapaxes(rotation, -1, -2) @ (gravity / size)
        values = np.linalg.svd(u - u.mean(axis=0), compute_uv=False) / np.sqrt(K)
        spread[: len(values[:2])] = values[:2]
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
