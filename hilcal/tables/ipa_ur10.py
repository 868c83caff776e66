"""Import of the public UR10 accuracy data measured at Fraunhofer IPA.

Source: Landgraf et al., IEEE CASE 2021, data set `christianlandgraf/ipa-robot-accuracy`.
One row per pose: commanded joints in rad, a 6-D tracker reading of a T-Mac on the flange in
mm and as intrinsic X-Y'-Z'' angles in deg, and in most series the standard deviation of each
averaged element and the temperature of the air.
"""

from pathlib import Path

import numpy as np

from hilcal.errors import InputError
from hilcal.readings.covariance import TrackerNoise, tracker_covariance
from hilcal.readings.readings import Readings, States
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.tables import checks
from hilcal.tables.csvfile import CsvTable, Dialect, read_columns
from hilcal.tables.imported import ImportResult
from hilcal.types import Bools, Floats, Ints

JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
_ELEMENTS = ("x", "y", "z", "rx", "ry", "rz")
MEASURED = tuple(f"measurement_{e}" for e in _ELEMENTS)
SPREAD = tuple(f"measurement_std_{e}" for e in _ELEMENTS)
AIR = "measurement_temperature"
NEEDED = (*JOINTS, *MEASURED)
COLUMNS = (*NEEDED, AIR, *SPREAD)

TRACKER = TrackerNoise(
    range_std=5e-6,
    range_std_per_m=0.15e-6,
    transverse_std=7.5e-6,
    transverse_std_per_m=3e-6,
    orientation_std=float(np.deg2rad(0.005)),
)
"""Systematic part: half of the maximum permissible errors of an AT500-class tracker,
10 µm + 0.3 µm/m along and 15 µm + 6 µm/m across the beam, and of a T-Mac, 0.01°."""

POSITION_FLOOR = 2e-6
"""m; least random part of a mean: an air path and an arm at rest are not steadier. The mean of
few samples can agree by chance (the files hold 0.4 µm), and its weight would be absurd."""

ORIENTATION_FLOOR = float(np.deg2rad(0.0005))
"""rad; the same for an angle of a T-Mac: a twentieth of its maximum permissible error."""

STILL = 1e-4
"""rad; a joint commanded by less did not move far enough to arrive from another side."""

_MAX_LOST = 0.1
_FOLLOW = 0.01
_SIGMAS = 4.0
_REPEAT = 2e-4
_TOOL = 0.5


def read_ipa_ur10(path: str | Path, arm: Arm) -> ImportResult:
    """Read `measurements_*.csv`; poses are named by their rows, the load is `none`.

    The covariance is that of the mean plus that of the instrument,

        V = blockdiag(diag(s_p²), E diag(s_a²) Eᵀ) + V_tracker

    with s_p, s_a the standard deviations of the file, not less than the floors, and E the
    axes about which the three angles turn: e_x, R_x e_y, R_x R_y e_z. A series without columns of
    standard deviations has the floors in their place.

    Rows are left out where a cell is empty; where the reading is the previous row's within
    noise though the joints were commanded elsewhere (the arm did not follow, or the tracker did
    not measure again); and where two rows repeat a pose but their positions disagree by more than
    the noise and the joints' difference can explain (which one is wrong cannot be known).

    Raises:
        InputError: not this format, or figures that cannot be right.
    """
    table = read_columns(
        path, lambda h: _choose(str(path), h, arm), Dialect(delimiter=";", decimal=",", blank=True)
    )
    q, value, spread = table.matrix(JOINTS), table.matrix(MEASURED), _spread(table)
    everything = np.hstack([q, value, spread])
    if AIR in table.number:
        everything = np.hstack([everything, table.matrix((AIR,))])
    whole: Bools = np.asarray(np.isfinite(everything).all(axis=1))
    if np.mean(~whole) > _MAX_LOST:
        raise InputError(
            f"{table.path}: {int(np.sum(~whole))} of {len(whole)} rows have empty cells, the first "
            f"is row {table.rows[np.argmin(whole)]}; expected a complete file"
        )
    _check(table, whole, arm)
    spread = np.maximum(spread, 0.0)
    floor = np.repeat([1e3 * POSITION_FLOOR, np.rad2deg(ORIENTATION_FLOOR)], 3)
    spread = np.maximum(spread, floor)
    approach = _approach(q)
    stale = _stale(q, value, spread) & whole
    odd = _disagreeing(q, value, whole & ~stale, arm.reach + _TOOL)
    keep = np.flatnonzero(whole & ~stale & ~odd)
    if len(keep) == 0:
        raise InputError(f"{table.path}: no row can be used; expected one measured pose per row")
    readings = _readings(table, keep, q, value[keep], spread[keep], approach)
    return ImportResult(readings, _notes(table, whole, stale, odd))


def _choose(path: str, header: list[str], arm: Arm) -> tuple[tuple[str, ...], tuple[str, ...]]:
    if arm.n != len(JOINTS):
        raise InputError(f"{path}: the data are of a UR10 with 6 joints, {arm.name} has {arm.n}")
    missing = [c for c in COLUMNS if c not in header]
    if set(JOINTS) <= set(missing):
        raise InputError(
            f"{path}: not a measurement file of the ipa-ur10 format; expected columns separated "
            f"by ';' with the names {JOINTS[0]} ... {SPREAD[-1]} in row 1"
        )
    if lacking := [c for c in NEEDED if c in missing]:
        raise InputError(f"{path}: column '{lacking[0]}' is missing; needed: {', '.join(NEEDED)}")
    if 0 < len(lacking := [c for c in SPREAD if c in missing]) < len(SPREAD):
        raise InputError(
            f"{path}: column '{lacking[0]}' is missing; give all of {', '.join(SPREAD)}, or none"
        )
    present = tuple(c for c in COLUMNS if c not in missing)
    for name in present:
        if header.count(name) > 1:
            raise InputError(f"{path}: column '{name}' appears {header.count(name)} times")
    return (), present


def _spread(table: CsvTable) -> Floats:
    """(N, 6) standard deviations in mm and deg; zero, to be raised to the floors, where absent."""
    if SPREAD[0] not in table.number:
        return np.zeros((len(table.rows), len(SPREAD)))
    return table.matrix(SPREAD)


def _check(table: CsvTable, whole: Bools, arm: Arm) -> None:
    """Refuse what cannot be in the units of this format."""
    good = CsvTable(
        table.path,
        table.header,
        table.rows[whole],
        {},
        {name: column[whole] for name, column in table.number.items()},
    )
    q, value, spread = good.matrix(JOINTS), good.matrix(MEASURED), _spread(good)
    checks.check_joints(good, JOINTS, q, arm)
    metres = np.linalg.norm(value[:, :3], axis=1) > 1e3 * checks.MAX_DISTANCE
    good.refuse(
        metres[:, None] & np.ones(3, dtype=bool), MEASURED[:3], lambda v: f"{v:g} is not in mm"
    )
    if np.ptp(value[:, :3], axis=0).max() < 5.0 and np.ptp(q, axis=0).max() > 0.5:
        raise InputError(
            f"{good.path}: columns {', '.join(MEASURED[:3])}: all positions lie within "
            f"{np.ptp(value[:, :3], axis=0).max():.3g} mm (looks like metres); expected mm"
        )
    good.refuse(np.abs(value[:, 3:]) > 360, MEASURED[3:], lambda v: f"{v:g} is not in deg")
    if SPREAD[0] not in good.number:
        return
    good.refuse(spread < 0, SPREAD, lambda v: f"{v:g}: a standard deviation is >= 0")
    limit = np.repeat([1e3 * checks.MAX_STD, 1.0], 3)
    good.refuse(spread > limit, SPREAD, lambda v: f"{v:g}: not at rest; expected mm and deg")


def _approach(q: Floats) -> Floats:
    """Side from which each joint arrived: sign(q_i - q_{i-1}), the last one where it kept still.

    The first row, and joints that have not moved yet, count as +1. Rows with empty cells are
    passed over.
    """
    known = np.where(np.isfinite(q), q, np.nan)
    last = _fill(known)
    step = np.diff(last, axis=0, prepend=last[:1])
    side = np.where(np.abs(step) > STILL, np.sign(step), np.nan)
    side[0] = 1.0
    return _fill(side)


def _fill(a: Floats) -> Floats:
    """Replace NaN by the last value above it in the column (by the first one at the top)."""
    row = np.where(np.isfinite(a), np.arange(len(a))[:, None], -1)
    row = np.maximum.accumulate(row, axis=0)
    first = np.argmax(np.isfinite(a), axis=0)
    row = np.where(row < 0, first, row)
    return np.asarray(np.take_along_axis(a, row, axis=0), dtype=float)


def _stale(q: Floats, value: Floats, spread: Floats) -> Bools:
    """Rows that read the same as the row before though the joints were sent elsewhere."""
    stale = np.zeros(len(q), dtype=bool)
    sent = np.abs(np.diff(q, axis=0)).max(axis=1) > _FOLLOW
    sigma = np.hypot(spread[1:], spread[:-1])
    same = np.all(np.abs(np.diff(value, axis=0)) <= _SIGMAS * sigma, axis=1)
    stale[1:] = sent & same
    return stale


def _disagreeing(q: Floats, value: Floats, usable: Bools, lever: float) -> Bools:
    """Rows that repeat a pose but whose positions cannot both be right.

    Joints that differ by dq move the target by less than lever · Σ|dq|; beside that, and beside
    ten times the 0.04 mm to which such an arm repeats, positions must agree.
    """
    from scipy.spatial import cKDTree

    rows = np.flatnonzero(usable)
    pairs = cKDTree(q[rows]).query_pairs(_REPEAT, p=np.inf, output_type="ndarray")
    i, j = rows[pairs[:, 0]], rows[pairs[:, 1]]
    apart = np.linalg.norm(value[i, :3] - value[j, :3], axis=1)
    allowed = 0.4 + 1e3 * lever * np.abs(q[i] - q[j]).sum(axis=1)
    wrong = apart > allowed
    odd = np.zeros(len(q), dtype=bool)
    odd[i[wrong]] = odd[j[wrong]] = True
    return odd


def _readings(
    table: CsvTable, keep: Ints, q: Floats, value: Floats, spread: Floats, approach: Floats
) -> Readings:
    position = 1e-3 * value[:, :3]
    angles = np.deg2rad(value[:, 3:])
    rx, ry, rz = (se3.rotation(angles[:, k, None] * np.eye(3)[k]) for k in range(3))
    rxy = rx @ ry
    axes = np.stack([np.broadcast_to([1.0, 0.0, 0.0], position.shape), rx[..., 1], rxy[..., 2]], 2)
    cov = tracker_covariance(position, TRACKER, m=6)
    cov[:, :3, :3] += (1e-3 * spread[:, None, :3]) ** 2 * np.eye(3)
    turned = axes * np.deg2rad(spread[:, None, 3:])
    cov[:, 3:, 3:] += turned @ np.swapaxes(turned, 1, 2)
    n = len(keep)
    zero = np.zeros(n, dtype=np.int64)
    states = States(
        q=q[keep],
        wrench=np.zeros((n, 6)),
        air_temperature=table.number[AIR][keep] if AIR in table.number else None,
        approach=approach[keep],
    )
    return Readings(
        states=states,
        pose=np.arange(n),
        load=zero,
        cycle=zero.copy(),
        value=np.hstack([position, se3.rotation_vector(rxy @ rz)]),
        covariance=0.5 * (cov + np.swapaxes(cov, 1, 2)),
        load_names=("none",),
        pose_names=tuple(f"row {row}" for row in table.rows[keep].tolist()),
    )


def _notes(table: CsvTable, whole: Bools, stale: Bools, odd: Bools) -> tuple[str, ...]:
    rows = table.rows

    def left_out(bad: Bools, why: str) -> list[str]:
        if not bad.any():
            return []
        named = ", ".join(map(str, rows[bad][:10].tolist()))
        more = ", ..." if bad.sum() > 10 else ""
        return [f"{int(bad.sum())} of {len(rows)} rows left out ({named}{more}): {why}"]

    floors = f"{1e6 * POSITION_FLOOR:g} µm, {np.rad2deg(ORIENTATION_FLOOR):g}°"
    instrument = "an AT500-class tracker's typical errors and 0.005° for the T-Mac"
    stated = SPREAD[0] in table.number
    return (
        *left_out(~whole, "empty cells"),
        *left_out(stale, "the same reading as the row before, though the joints were sent on"),
        *left_out(odd, "they repeat a pose but disagree by more than noise can explain"),
        "timestamps are not used: they are ruined by rounding in the file",
        f"approach: side of the move from the row before; moves below {STILL:g} rad keep the last "
        f"side, the first row counts as +1",
        f"covariance: the file's standard deviations (at least {floors}) plus {instrument}"
        if stated
        else f"covariance: the file has no standard deviations ({SPREAD[0]} ...); {instrument}, "
        f"and {floors} for the scatter of a mean",
        *([] if AIR in table.number else [f"no air temperature: the file has no column {AIR}"]),
    )
