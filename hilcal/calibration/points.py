"""Points to put the tool at, as a table states them.

One row per point, with a header; separator "," and decimal point:

- `pose`: its name; numbered without.
- `q1_rad` … or `q1_deg` …: joint values. Alone, the point is where the nominal arm has the tool
  there; together with a position they say on which branch.
- `x_m`, `y_m`, `z_m` (or `x_mm` …) and `rx_rad`, `ry_rad`, `rz_rad` (or `rx_deg` …), a rotation
  vector: the pose of the tool in base axes.
- `load`: the name of a load, or `fx_N` … `mz_Nm`: force and moment at the load point, base axes, or
  `sensor_fx_N` … `sensor_mz_Nm`: the force sensor's reading with the load less that without it, at
  this point, sensor axes.
- `air_degC`, `joint1_degC` …, `load_time_s`, `time_s`, `approach1` …: where the model needs them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hilcal.calibration.compensation import Pose, invert
from hilcal.data.columns import (
    POSITION,
    ROTATION,
    WRENCH,
    approach_columns,
    joint_columns,
    temperature_columns,
)
from hilcal.data.csvfile import CsvTable, read_columns
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.chain import evaluate
from hilcal.types import Floats, Ints

NO_LOAD = "none"


LARGEST = 4.0 * np.pi
"""rad; a choice, twice what the joints of most arms turn: degrees in a column of rad are beyond."""


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """N points.

    Attributes:
        names: of the points.
        q: (N, n) joint values, rad; rows of NaN where only a pose is given.
        wanted: (N, 4, 4) T_base_tool, NaN where the joint values say where to go; None for all.
        wrench: (N, 6) force and moment at the load point, base axes; None where none are given.
        sensed: (N, 6) what the load adds to the force sensor's reading, sensor axes; None where
            it is not given.
        recorded: other columns of `States`.
    """

    names: tuple[str, ...]
    q: Floats
    wanted: Floats | None = None
    wrench: Floats | None = None
    sensed: Floats | None = None
    recorded: Mapping[str, Floats] = field(default_factory=dict)


def read_points(path: Path, arm: Arm, loads: Mapping[str, Floats]) -> Points:
    """Read a table of points.

    Args:
        path: a CSV file.
        arm: the arm.
        loads: (6,) wrench by the name of the load.

    Raises:
        InputError: no such file, an unknown column, an incomplete group, an unknown load.
    """
    groups = _groups(arm.n)
    header: list[str] = []

    def choose(given: list[str]) -> tuple[Sequence[str], Sequence[str]]:
        header.extend(given)
        return _checked(path, given, groups)

    table = read_columns(path, choose)
    found = {key: table.matrix(names) for key, names in groups.items() if names[0] in header}
    q = found.pop("q_rad", None)
    if "q_deg" in found:
        q = np.radians(found.pop("q_deg"))
    if q is not None and np.any(np.abs(q) > LARGEST):
        k = int(np.argmax(np.any(np.abs(q) > LARGEST, axis=1)))
        raise InputError(
            f"{table.at(k)}: a joint at {np.abs(q[k]).max():.4g} rad; columns q1_rad … are in rad, "
            "q1_deg … in degrees"
        )
    named = table.text.get("pose")
    names = tuple(named) if named else tuple(str(k + 1) for k in range(len(table.rows)))
    wrench, sensed = found.pop("wrench", None), found.pop("sensed", None)
    if "load" in table.text:
        wrench = np.stack([_load(table, k, loads) for k in range(len(table.rows))])
    wanted = _poses(found)
    if q is None and wanted is None:
        raise InputError(
            f"{path}: neither joint values nor poses; valid: columns q1_rad … q{arm.n}_rad, or "
            "x_m, y_m, z_m with rx_rad, ry_rad, rz_rad"
        )
    if q is None:
        q = np.full((len(names), arm.n), np.nan)
    recorded = {k: v if v.shape[1] > 1 else v[:, 0] for k, v in found.items()}
    return Points(names, q, wanted, wrench, sensed, recorded)


def on_branch(points: Points, arm: Arm, tool: Floats, near: Floats | None) -> Floats:
    """Return the joint values (N, n) at which the nominal arm has the tool at the points.

    Those of a pose are on the branch of the joint values that are given with it, else of the point
    before it.

    Args:
        points: the points.
        arm: the arm.
        tool: (4, 4) T_flange_tool.
        near: (n,) joint values that the first point is near to, rad.

    Raises:
        InputError: no joint values to begin with, or a pose that the arm does not reach.
    """
    if points.wanted is None:
        return points.q

    def poses(at: Floats, rows: Ints) -> Pose:
        chain = evaluate(arm, at)
        rotation = se3.product(chain.rotation[-1], tool[:3, :3])
        return rotation, chain.point(tool[:3, 3]), chain

    found: list[Floats] = []
    for name, q, goal in zip(points.names, points.q, points.wanted, strict=True):
        start = q if np.isfinite(q).all() else found[-1] if found else near
        if start is None:
            raise InputError(
                f"point {name} is a pose without joint values; give joint columns, or --near with "
                "the joint values that the first pose is near to"
            )
        if np.isfinite(goal).all():
            solved = invert(arm, poses, start[None], goal[None, :3, :3], goal[None, :3, 3])
            if not solved.solved[0]:
                raise InputError(
                    f"point {name}: the nominal arm does not reach it from the joint values "
                    f"before, {1e3 * solved.residual_m[0]:.3g} mm and "
                    f"{np.degrees(solved.residual_rad[0]):.3g} degrees are left"
                )
            start = solved.q[0]
        found.append(start)
    return np.stack(found)


def _groups(n: int) -> dict[str, tuple[str, ...]]:
    """Columns by what they give; those of one group come together."""
    q = joint_columns(n)
    return {
        "q_rad": q,
        "q_deg": tuple(name.replace("_rad", "_deg") for name in q),
        "position_m": POSITION,
        "position_mm": tuple(name.replace("_m", "_mm") for name in POSITION),
        "rotation_rad": ROTATION,
        "rotation_deg": tuple(name.replace("_rad", "_deg") for name in ROTATION),
        "wrench": WRENCH,
        "sensed": tuple(f"sensor_{name}" for name in WRENCH),
        "air_temperature": ("air_degC",),
        "joint_temperature": temperature_columns(n),
        "load_time": ("load_time_s",),
        "time": ("time_s",),
        "approach": approach_columns(n),
    }


def _checked(
    path: Path, header: list[str], groups: Mapping[str, tuple[str, ...]]
) -> tuple[Sequence[str], Sequence[str]]:
    """Check a header; returns its text and its number columns.

    Raises:
        InputError: an unknown or double column, an incomplete group, or one in two units.
    """
    known = [name for names in groups.values() for name in names]
    for name in header:
        if name not in (*known, "pose", "load"):
            raise InputError(f"{path}: unknown column '{name}'; valid: {', '.join(known[:8])}, …")
        if header.count(name) > 1:
            raise InputError(f"{path}: column '{name}' is there twice")
    for names in groups.values():
        missing = [name for name in names if name not in header]
        if missing and len(missing) < len(names):
            raise InputError(f"{path}: column '{missing[0]}' is missing beside its group")
    for a, b in (
        ("q_rad", "q_deg"),
        ("position_m", "position_mm"),
        ("rotation_rad", "rotation_deg"),
    ):
        if groups[a][0] in header and groups[b][0] in header:
            raise InputError(f"{path}: both {groups[a][0]} and {groups[b][0]}; give one of them")
    told = [n for n in ("load", WRENCH[0], groups["sensed"][0]) if n in header]
    if len(told) > 1:
        raise InputError(f"{path}: both {told[0]} and {told[1]}; give one of them")
    text = [name for name in ("pose", "load") if name in header]
    return text, [name for name in header if name not in text]


def _load(table: CsvTable, row: int, loads: Mapping[str, Floats]) -> Floats:
    """(6,) wrench of a named load.

    Raises:
        InputError: no such load.
    """
    name = table.text["load"][row]
    if name in (NO_LOAD, ""):
        return np.zeros(6)
    if name not in loads:
        valid = ", ".join((NO_LOAD, *loads))
        raise InputError(f"{table.at(row, 'load')}: unknown load {name!r}; valid: {valid}")
    return loads[name]


def _poses(found: dict[str, Floats]) -> Floats | None:
    """(N, 4, 4) poses, taken out of what was found; None where there are none.

    Raises:
        InputError: a position without an orientation, or the other way round.
    """
    position, rotation = found.pop("position_m", None), found.pop("rotation_rad", None)
    if "position_mm" in found:
        position = 1e-3 * found.pop("position_mm")
    if "rotation_deg" in found:
        rotation = np.radians(found.pop("rotation_deg"))
    if position is None and rotation is None:
        return None
    if position is None or rotation is None:
        raise InputError(
            "a pose is x_m, y_m, z_m together with rx_rad, ry_rad, rz_rad; one half is missing"
        )
    return se3.matrix(se3.rotation(rotation), position)
