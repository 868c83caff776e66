"""Target points for the tool, read from a table.

The table has one row per point and a header; kind of file, separator and decimal mark may be those
that `import` reads. A table of readings, of the exchange format or by a mapping, is a table of
points, too: columns that are not listed here (covariances, cycles, actual joints, `x_…`) are
ignored. Where no column has a name of this list or of the exchange format, a mapping is guessed as
by `import --preview`, and used if nothing in it is unsure.

- `pose`: name of the point; points without names are numbered.
- `q1_rad` … or `q1_deg` …: joint values, of slides `q1_m` or `q1_mm`. Alone, they state the target
  as the pose of the tool on the nominal arm; together with a position they select the branch.
- `x_m`, `y_m`, `z_m` (or `x_mm` …) and `rx_rad`, `ry_rad`, `rz_rad` (or `rx_deg` …), a rotation
  vector: the pose of the tool in base axes. A position with joint values and without a rotation has
  the orientation of the nominal arm.
- `load`: the name of a load, or `fx_N` … `mz_Nm`: force and moment at the load point, base axes, or
  `sensor_fx_N` … `sensor_mz_Nm`: the force sensor's reading with the load minus the one without, at
  this point, sensor axes.
- `air_degC`, `joint1_degC` …, `load_time_s`, `time_s`, `approach1` …: where the model needs them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hilcal import limits
from hilcal.calibration.compensation import invert_nominal, nominal_pose
from hilcal.errors import InputError
from hilcal.names import quoted
from hilcal.robot import se3
from hilcal.robot.arm import LARGEST_RAD, Arm
from hilcal.tables import columns as exchange
from hilcal.tables.files import open_grid
from hilcal.tables.grid import ColumnTable
from hilcal.tables.mapped import mapped_table
from hilcal.tables.mapping import FileFormat, PointMapping
from hilcal.tables.proposal import GUESSED
from hilcal.tables.propose import GridProposal, propose
from hilcal.tables.sniff import sniff
from hilcal.tables.units import LENGTHS
from hilcal.types import Floats

NO_LOAD = "none"
NEAREST_RAD = 0.5  # a solution within this distance of the start counts as the nearest; a choice
N_STARTS = 300  # random starts that find all branches, up to 16 with six joints; a choice
LIMIT_PENALTY = 1e3  # rad; added to the distance of a solution beyond the joints' limits
LEAST_REACH, LONGEST_TOOL = 0.05, 0.5
"""The farthest point is at least this share of the reach from the base, and at most this length, m,
beyond the reach."""


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """N points."""

    names: tuple[str, ...]
    q: Floats  # (N, n) joint values, rad; rows of NaN where only a pose is stated
    target_poses: Floats | None = None
    """(N, 4, 4) T_base_tool, NaN where joint values state the target; None if they do for all."""
    wrench: Floats | None = None  # (N, 6) at the load point, base axes; None if not stated
    sensor_wrench: Floats | None = None  # (N, 6) change of the sensor's reading, sensor axes
    recorded: Mapping[str, Floats] = field(default_factory=dict)  # other columns of `States`
    loads: tuple[str, ...] = ()  # (N,) names of the loads; empty if not stated
    guess: str = ""  # meaning of guessed columns, for people


class _OtherNamesError(InputError):
    """No column has a name that a table of points has."""


def read_points(
    path: Path, arm: Arm, loads: Mapping[str, Floats], mapping: PointMapping | None = None
) -> Points:
    """Read a table of points; `loads` are wrenches (6,) by name of the load."""
    groups, guess = _groups(arm), ""
    table = None if mapping is not None else _plain(path, arm, groups)
    if table is None:
        if mapping is None:
            mapping, guess = _guessed(path, arm)
        table = _mapped(path, arm, mapping)
    nothing = np.full(len(table.rows), np.nan)  # of mimic joints, which need no column
    columns = {
        quantity: factor * np.stack([table.number.get(name, nothing) for name in names], axis=1)
        for quantity, names, factor in groups
        if names[0] in table.number
    }
    q = columns.pop("q", None)
    q = None if q is None else arm.complete(q)
    if q is not None and np.any(large := (np.abs(q) > LARGEST_RAD) & ~arm.slides):
        k = int(np.argmax(np.any(large, axis=1)))
        raise InputError(
            f"{table.at(k)}: a joint at {np.abs(q[k]).max():.4g} rad; columns q1_rad … are in rad, "
            "q1_deg … in degrees"
        )
    if exchange.ROTATION[0] in table.number:
        exchange.check_rotations(table, columns["rotation"])
    pose_names = table.text.get("pose")
    names = tuple(pose_names) if pose_names else tuple(str(k + 1) for k in range(len(table.rows)))
    wrench, sensed = columns.pop("wrench", None), columns.pop("sensed", None)
    load_names = tuple(name or NO_LOAD for name in table.text.get("load", ()))
    if load_names:
        wrench = np.stack([_load(table, k, name, loads) for k, name in enumerate(load_names)])
    poses = _poses(columns, q, arm)
    if q is None and poses is None:
        raise InputError(
            f"{path}: neither joint values nor poses; valid: columns {groups[0][1][0]} … "
            f"{groups[0][1][-1]}, or x_m, y_m, z_m with rx_rad, ry_rad, rz_rad"
        )
    if q is None:
        q = np.full((len(names), arm.n), np.nan)
    recorded = {k: v if v.shape[1] > 1 else v[:, 0] for k, v in columns.items()}
    return Points(names, q, poses, wrench, sensed, recorded, load_names, guess)


def _plain(path: Path, arm: Arm, groups: "_Groups") -> ColumnTable | None:
    """Return a table with the columns listed above; None if it has none of them."""
    chosen: list[Sequence[str]] = []

    def check(header: Sequence[str]) -> None:
        chosen.extend(_checked(path, header, groups, arm))

    try:
        table = ColumnTable.of(open_grid(path, _form(path), check), *chosen)
        return exchange.with_mimic_joints(table, arm)
    except _OtherNamesError:
        return None


def on_branch(points: Points, arm: Arm, tool: Floats, near: Floats | None) -> Floats:
    """Return the joint values (N, n) at which the nominal arm has the tool (4, 4) at the points.

    Of all solutions of a pose, the one nearest to the point's own joint values is returned; without
    these the one nearest to the previous point, for the first point to `near` (n,), rad.
    """
    if points.target_poses is None:
        return points.q
    out: list[Floats] = []
    for name, q, goal in zip(points.names, points.q, points.target_poses, strict=True):
        start = q if np.isfinite(q).all() else out[-1] if out else near
        if start is None:
            raise InputError(
                f"point {name} is a pose without joint values; give joint columns, or --near with "
                "the joint values that the first pose is near to"
            )
        if np.isfinite(goal[:3, 3]).all():
            if not np.isfinite(goal).all():  # orientation of the nominal arm
                goal = se3.matrix(nominal_pose(arm, tool, start[None])[0][0], goal[:3, 3])
            start = _nearest(arm, tool, name, start, goal)
        out.append(start)
    return np.stack(out)


def solutions(arm: Arm, tool: Floats, near: Floats | None, goal: Floats) -> Floats:
    """Return joint values (K, n) at which the nominal arm has the tool (4, 4) at a pose (4, 4).

    They are searched from `near` (K, n), rad, or from the whole range of the joints if None.
    """
    starts = _everywhere(arm) if near is None else near
    solved = invert_nominal(arm, tool, starts, goal[:3, :3], goal[:3, 3])
    q = solved.q[solved.solved]
    if near is not None:
        return q
    distinct: list[Floats] = []
    for solution in (q + np.pi) % (2 * np.pi) - np.pi:
        if all(np.abs(np.sin((solution - previous) / 2)).max() > 1e-6 for previous in distinct):
            distinct.append(solution)
    return np.array(distinct).reshape(-1, arm.n)


def _everywhere(arm: Arm) -> Floats:
    low, high = arm.usual_range
    spread = np.random.default_rng(0).random((N_STARTS, arm.n))
    return arm.complete(low + spread * (high - low))


def _nearest(arm: Arm, tool: Floats, name: str, near: Floats, goal: Floats) -> Floats:
    """Return the joint values (n,) of a pose that are nearest to `near` (n,)."""
    starts = near[None]
    for _ in range(2):
        solved = invert_nominal(arm, tool, starts, goal[:3, :3], goal[:3, 3])
        q = solved.q
        if arm.coupling is None and arm.mimic is None:  # whole turns do not change the pose
            q = q + 2 * np.pi * np.round((near - q) / (2 * np.pi)) * ~arm.slides
            q = np.where((q < arm.q_min) | (q > arm.q_max), solved.q, q)
        inside = ((q >= arm.q_min) & (q <= arm.q_max)).all(axis=1)
        distance = np.linalg.norm(q - near, axis=1) + np.where(inside, 0.0, LIMIT_PENALTY)
        distance = np.where(solved.solved, distance, np.inf)
        if distance.min() < NEAREST_RAD:
            break
        if len(starts) == 1:
            starts = np.concatenate([near[None], _everywhere(arm)])
    if not np.isfinite(distance).any():
        k = int(np.argmin(solved.residual_m / arm.reach + solved.residual_rad))
        raise InputError(
            f"point {name}: the nominal arm does not reach it from anywhere; "
            f"{1e3 * solved.residual_m[k]:.3g} mm and "
            f"{np.degrees(solved.residual_rad[k]):.3g} degrees are left; valid: poses of the tool "
            "in base axes, within its reach"
        )
    return np.asarray(q[int(np.argmin(distance))])


def _form(path: Path) -> FileFormat:
    try:
        with path.open(encoding="utf-8", errors="replace") as stream:
            header = stream.readline(limits.LINE)
    except OSError:
        return FileFormat()  # the reader reports it
    if not any(mark in header for mark in (";", "\t", "|")):
        return FileFormat()
    how = sniff(path).file_keys
    return FileFormat(**{key: how[key] for key in ("separator", "decimal") if key in how})


def _guessed(path: Path, arm: Arm) -> tuple[PointMapping, str]:
    """Return the guessed mapping of a table, and its description for people."""
    proposed = propose(path, joints=arm.n, joint_names=arm.joint_names)
    proposal = proposed.proposal
    understood = [
        f"{u.section} = {', '.join(u.columns)}" + f" ({u.meaning})" * bool(u.meaning)
        for u in proposal.quantities
    ]
    # names of loads are checked against the campaign, and names of poses are arbitrary
    certain = ["pose", "load", *["position"] * _certain_unit(proposed, arm)]
    doubts = [
        f"{about}: {'no convention stated' if doubt == GUESSED else doubt}"
        for about, doubt in proposal.doubts
        if about not in certain
    ]
    doubts += [f"{name} is not understood" for name, _ in proposal.unused]
    if not {"joints", "position"} & proposal.sections.keys():
        doubts = proposal.missing
    if doubts:
        raise InputError(
            f"{path}: its columns are not those of a table of points, and cannot be guessed: "
            f"{'; '.join(doubts)}. Write it down: hilcal import {quoted(path)} --preview -o "
            "M.toml, correct M.toml, and give --format M.toml; or use the columns pose, load, "
            f"q1_rad … q{arm.n}_rad or q1_deg …, x_m, y_m, z_m or x_mm …, rx_rad, ry_rad, rz_rad "
            "or rx_deg …"
        )
    return proposal.mapping(PointMapping), f"understood, in base axes: {'; '.join(understood)}"


def _certain_unit(proposed: GridProposal, arm: Arm) -> bool:
    """Whether positions lie within the arm's reach in the guessed unit alone."""
    section = proposed.proposal.sections.get("position")
    if section is None or section["unit"] not in ("m", "mm"):
        return False
    position = np.stack([proposed.grid.numbers(c) for c in section["columns"][:3]], axis=1)
    far = float(np.nanmax(np.linalg.norm(position, axis=1))) * LENGTHS[section["unit"]]
    return LEAST_REACH * arm.reach < far < arm.reach + LONGEST_TOOL


def _mapped(path: Path, arm: Arm, mapping: PointMapping) -> ColumnTable:
    mapped = mapped_table(path, mapping, arm)
    table = exchange.with_mimic_joints(mapped.table, arm)
    text = {"pose": table.text["pose"]}
    if mapping.load is not None:
        text["load"] = table.text["load"]
        text["pose"] = [f"{p} {k}" for p, k in zip(text["pose"], text["load"], strict=True)]
    return replace(table, text=text)


_Groups = list[tuple[str, tuple[str, ...], Floats | float]]


def _groups(arm: Arm) -> _Groups:
    """Groups of columns that come together: their quantity, their names, and the factor to SI."""
    q, n, degree = exchange.joint_columns(arm.units), arm.n, np.pi / 180
    q_other = tuple(f"{c}m" if c.endswith("_m") else c.replace("_rad", "_deg") for c in q)
    return [
        ("q", q, 1.0),
        ("q", q_other, np.where(arm.slides, 1e-3, degree)),
        ("position", exchange.POSITION, 1.0),
        ("position", tuple(name.replace("_m", "_mm") for name in exchange.POSITION), 1e-3),
        ("rotation", exchange.ROTATION, 1.0),
        ("rotation", tuple(name.replace("_rad", "_deg") for name in exchange.ROTATION), degree),
        ("wrench", exchange.WRENCH, 1.0),
        ("sensed", tuple(f"sensor_{name}" for name in exchange.WRENCH), 1.0),
        ("air_temperature", ("air_degC",), 1.0),
        ("joint_temperature", exchange.temperature_columns(n), 1.0),
        ("load_time", ("load_time_s",), 1.0),
        ("time", ("time_s",), 1.0),
        ("approach", exchange.approach_columns(n), 1.0),
    ]


def _checked(
    path: Path, header: Sequence[str], groups: _Groups, arm: Arm
) -> tuple[Sequence[str], Sequence[str]]:
    listed = [name for _, names, _ in groups for name in names]
    exchanged = set(exchange.known_columns(arm.units))
    specific = {*listed, *exchanged} - {"pose", "load", "target"}
    for name in header:
        if name not in (*listed, "pose", "load", *exchanged) and not name.startswith(
            exchange.USER_PREFIX
        ):
            if not specific & set(header):
                raise _OtherNamesError(f"{path}: no column of a table of points")
            valid = ", ".join(("pose", "load", *listed))
            raise InputError(
                f"{path}: unknown column '{name}'; valid: {valid}, columns of the exchange table, "
                "and x_…; other tables: --format MAPPING, as for import"
            )
        if header.count(name) > 1:
            raise InputError(f"{path}: column '{name}' is there twice")
    first: dict[str, list[str]] = {"load": ["load"] * ("load" in header)}
    for quantity, names, _ in groups:
        missing = [name for name in names if name not in header]
        needed = names if quantity != "q" else exchange.independent_columns(names, 0, arm)
        lacks = [name for name in missing if name in needed]
        if lacks and len(missing) < len(names):
            raise InputError(f"{path}: column '{lacks[0]}' is missing from its group")
        if not lacks:
            key = "load" if quantity in ("wrench", "sensed") else quantity
            first.setdefault(key, []).append(names[0])
    for options in first.values():
        if len(options) > 1:
            raise InputError(f"{path}: both {options[0]} and {options[1]}; give one of them")
    text = [name for name in ("pose", "load") if name in header]
    return text, [name for name in header if name in listed]


def _load(table: ColumnTable, row: int, name: str, loads: Mapping[str, Floats]) -> Floats:
    if name == NO_LOAD:
        return np.zeros(6)
    if name not in loads:
        valid = ", ".join((NO_LOAD, *loads))
        raise InputError(f"{table.at(row, 'load')}: unknown load {name!r}; valid: {valid}")
    return loads[name]


def _poses(columns: dict[str, Floats], q: Floats | None, arm: Arm) -> Floats | None:
    """Remove position and rotation from `columns`; return poses (N, 4, 4), None if absent."""
    position, rotation = columns.pop("position", None), columns.pop("rotation", None)
    if position is None and rotation is None:
        return None
    if position is None or (rotation is None and q is None):
        raise InputError(
            "a pose is x_m, y_m, z_m together with rx_rad, ry_rad, rz_rad, or with joint values "
            "that determine the orientation of the tool; one half is missing"
        )
    if rotation is None:
        return se3.matrix(np.full((len(position), 3, 3), np.nan), position)
    return se3.matrix(se3.rotation(rotation), position)
