"""Whether what hangs is what was asked for, by the force sensor."""

import numpy as np

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
