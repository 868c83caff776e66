"""`compensate`: joint values that put the tool where it was asked to be."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.compensation import Compensation, nominal_pose
from hilcal.calibration.points import Points, on_branch, read_points
from hilcal.calibration.programs import urscript
from hilcal.calibration.programs.languages import READERS, ResolvedProgram, read_program
from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell
from hilcal.cli.options import check_new, command
from hilcal.cli.terminal import Terminal
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit_document import with_nulls
from hilcal.measuring.feasibility import MOTION_CHECKS, PAYLOAD, Feasibility
from hilcal.measuring.motion import PAYLOAD_KG
from hilcal.names import csv_text
from hilcal.numbers import length
from hilcal.present.calibration import (
    compensation_report,
    far_turned,
    refusals,
    refuted_line,
    waypoint_outcomes,
    waypoints_table,
)
from hilcal.present.progress import working
from hilcal.procedure.state import Files
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.store.plan import UNLOADED
from hilcal.tables.columns import joint_columns
from hilcal.tables.mapping import PointMapping, find_mapping
from hilcal.types import Bools, Floats
from hilcal.whole_file import replace_file

PROGRAMS = (".script", ".urscript")
TABLE_SUFFIXES = (".csv", ".json", *PROGRAMS)
MAX_NAMED = 5  # Most refused points that an error names
SAME_MOUNTING_DEG = 1.0  # largest angle between a program's gravity and the cell's; a choice
_NO_LOAD = (
    "no point has a load, and a calibration of deflections corrects nothing else: give --load, or "
    "calibrate by absolute readings"
)
_UNCHECKED = (
    "a calibration does not have the cell's workspace, obstacles and masses of loads: whether the "
    "cell allows the points was not checked"
)


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    points: Points
    tool: Floats | None  # (4, 4) T_flange_tool; the tracked target where None
    program: str | None = None  # text of a UR program
    waypoints: tuple[urscript.Waypoint, ...] = ()  # all waypoints of a UR program
    foreign: ResolvedProgram | None = None  # a program of another maker than UR

    @property
    def corrected(self) -> list[urscript.Waypoint]:
        """The waypoints that are corrected."""
        return [w for w in self.waypoints if not w.not_corrected]


@dataclass(frozen=True, slots=True)
class CompensationOptions:
    """Options of the load at the points, and of how the points are reached."""

    load: str | None = None
    wrench: str | None = None
    tool: str | None = None
    near: str | None = None
    frames: Path | None = None
    outside: bool = False
    leave: bool = False


DEFAULT_OPTIONS = CompensationOptions()


@command("""
    model | RUN.hilcal | A campaign with a revision, or an exported calibration (JSON).
    points | POINTS | Target points: a table (CSV, XLSX …) or a program: UR .script, KUKA .src,
        ABB .mod, FANUC .ls, Yaskawa .jbi.
    output | -o --output F | Write the joint values as CSV, JSON or program; repeatable.
    load | --load NAME | Load at every point, one of [[loads]] of the cell.
    wrench | --wrench "FX FY FZ MX MY MZ" | Force and moment at the load point, base axes, N and
        N·m.
    tool | --tool "X Y Z RX RY RZ" | Pose of the tool on the flange, m and rad; default: the tracked
        target.
    near | --near "Q1 Q2 .. QN" | Joint values near the first point, in degrees, for slides in
        m.
    frames | --frames F | The controller's tools and bases, for programs of other makers than UR:
        TOML, $config.dat or a RAPID module.
    outside | --allow-outside | Accept points outside of the measured range, too.
    leave | --leave | Leave waypoints of a program unchanged if they cannot be corrected.
    kind | --format FORMAT | Format of a table of points: table, or a mapping as of import.
    force | --force | Replace existing files.
    """)
def compensate(
    t: Terminal, catalogue: Catalogue, model: Path, points: Path, output: list[Path] | None = None,
    options: CompensationOptions = DEFAULT_OPTIONS, revision: int | None = None,
    kind: str = "table", force: bool = False,
) -> None:  # fmt: skip
    """Compute the joint values that bring the tool to given poses under a load."""
    for path in output or ():
        _check_output(path, points, force)
    with working(t.progress) as say:
        say(f"reading {model}")
        calibration = _calibration(model, catalogue, revision)
        arm = calibration.model.cell.arm
        start = None if options.near is None else _numbers(options.near, arm.n, "--near")
        start = None if start is None else np.where(arm.slides, start, np.radians(start))
        task = _task(points, calibration, options, start, kind)
        targets, foreign = task.points, task.foreign
        arm = calibration.controller if task.program else arm
        for remark in filter(None, (targets.guess, *(foreign.remarks if foreign else ()))):
            t.notice(f"{points}: {remark}")
        wrench = _wrench(targets, calibration, options)
        say(f"compensating {len(targets.names)} points")
        on_flange = calibration.tool_pose(task.tool)
        begin = (
            calibration.measured.mid_range_q(arm.n) if start is None and not task.program else start
        )
        q = on_branch(targets, arm, on_flange, begin)
        unclear = urscript.doubts(arm, on_flange, task.corrected, q, start) or [""] * len(q)
        acting = (
            wrench
            if targets.sensor_wrench is None
            else calibration.load_wrench(q, targets.sensor_wrench)
        )
        poses = _program_poses(task, calibration, q, arm)
        result = calibration.compensate(
            q, acting, tool=task.tool, wanted=poses, recorded=targets.recorded
        )
    if slow := calibration.without_kernel(task.tool):
        t.notice(
            f"note: no compiled form of {', '.join(slow)}: a point takes 25 to 60 ms, not 0.1 ms"
        )
    pairs = zip(unclear, refusals(result, options.outside), strict=True)
    refused = ["; ".join(filter(None, pair)) for pair in pairs]
    outcomes = waypoint_outcomes(foreign.program.points if foreign else task.waypoints, refused)
    retained = [k for k, why in enumerate(refused) if not why]
    if not options.leave or not retained:
        wrong = ~result.inverse.solved | result.singular | result.limits.any(axis=1)
        wrong |= result.other_branch
        _refuse(points, targets.names, refused, wrong | np.array(unclear, bool))
    elif any(refused):
        q, task = q[retained], _only(task, retained, refused)
        poses = None if poses is None else poses[retained]
        result = calibration.compensate(q, acting, tool=task.tool, wanted=poses)
    document = result.to_dict(task.points.names)
    if outcomes:
        document["waypoints"] = outcomes
    files = [f for path in output or () for f in _write(path, task, result, document, arm.units)]
    written = [str(path) for path in files]
    t.show(compensation_report(calibration, task.points.names, q, result))
    t.show(waypoints_table(outcomes))
    cell = calibration.model.cell
    run = model.parent / str(calibration.source.get("campaign", "RUN.hilcal"))
    if doubt := refuted_line(calibration, model, run, Files(run).validation):
        t.notice(f"warning: {doubt}")
    if remark := "" if task.program else _two_targets(targets, arm, on_flange):
        t.notice(f"note: {points}: {remark}")
    names = task.points.names
    loads = task.points.loads or (options.load or UNLOADED,) * len(names)
    cautions = (
        _other_payload(task, wrench, cell),
        _other_gravity(task, cell),
        _not_allowed(cell, names, result.q, loads),
        far_turned(names, q, result),
    )
    for caution in filter(None, cautions):
        t.notice(f"warning: {points}: {caution}")
    if calibration.mode == "deflection" and not np.any(acting if acting is not None else 0.0):
        t.notice(f"note: {points}: {_NO_LOAD}")
    if cell.config is None:
        t.notice(f"note: {model}: {_UNCHECKED}")
    hint = "Nothing was written; -o F.csv, F.json or F.script writes the joint values."
    t.show(f"\nWritten: {', '.join(written)}." if written else f"\n{hint}")
    for path in files if task.program is None and task.foreign is None else ():
        if path.suffix in PROGRAMS:
            t.notice(f"note: {path}: {urscript.UNCHECKED}")
    t.document({**document, "written": written})


def _two_targets(points: Points, arm: Arm, tool: Floats) -> str:
    """Return how far stated poses are from the tool at stated joint values; "" without both."""
    if points.target_poses is None:
        return ""
    at_joints = nominal_pose(arm, tool, points.q)[1]  # NaN where joint values are lacking
    far = np.linalg.norm(points.target_poses[:, :3, 3] - at_joints, axis=1)
    if not np.isfinite(far).any():
        return ""
    k = int(np.nanargmax(far))
    return (
        f"{points.names[k]} has joint values and a pose, {length(float(far[k]))} from where the "
        "nominal arm has the tool there (largest of all): the pose in base axes is the target, "
        "joint values only select the branch"
    )


def _other_payload(task: _Task, wrench: Floats | None, cell: Cell) -> str:
    """Return that a program states another mass than the points are corrected for, or ""."""
    stated = [("it", w.payload_kg) for w in task.waypoints if w.payload_kg is not None]
    if task.foreign is not None:
        stated = [(f"line {line}", kg) for line, kg in task.foreign.program.payloads]
    if not stated:
        return ""
    force, g = np.zeros(3) if wrench is None else wrench[:3], cell.gravity
    mass = cell.tool_mass + float(force @ g) / max(float(g @ g), 1e-9)
    for where, kg in stated:
        if abs(kg - mass) > PAYLOAD_KG:
            return (
                f"{where} sets a payload of {kg:.4g} kg, and is corrected for {mass:.4g} kg, the "
                "tool of the cell with what --load or --wrench adds: where the arm carries more, "
                "say so by them"
            )
    return ""


def _other_gravity(task: _Task, cell: Cell) -> str:
    """Return that a UR program is of an arm that is mounted otherwise, or ""."""
    stated = next((w.gravity for w in task.waypoints if w.gravity is not None), None)
    if stated is None or not stated.any():
        return ""
    across = np.linalg.norm(np.cross(stated, cell.gravity))
    angle = float(np.degrees(np.arctan2(across, stated @ cell.gravity)))
    if angle <= SAME_MOUNTING_DEG:
        return ""
    return (
        f"its set_gravity is {angle:.3g}° from [robot] gravity_m_s2 of the cell, with which it is "
        "corrected: the arm that was measured is mounted otherwise"
    )


def _not_allowed(cell: Cell, names: Sequence[str], q: Floats, loads: Sequence[str]) -> str:
    """Return why the campaign's cell does not allow some joint values (N, n), or "".

    `loads` (N,) are names. The joints' own limits are those of the arm, beyond which a point is
    refused.
    """
    if cell.config is None:
        return ""
    limits, kinds, bad = Feasibility(cell), (*MOTION_CHECKS, PAYLOAD), np.zeros(len(q), bool)
    for load in dict.fromkeys(loads):
        under = np.array([name == load for name in loads])
        bad[under] = ~limits.allowed(q[under], load, kinds)
    if not bad.any():
        return ""
    k = int(np.argmax(bad))
    findings = (v.line(names[k]) for v in limits.findings(q[k][None], loads[k], kinds))
    why = next(iter((*findings, *limits.unbearable(loads[k]).values())))
    more = f" (and {bad.sum() - 1} more points)" if bad.sum() > 1 else ""
    return f"the cell of the campaign does not allow {why}{more}"


def _program_poses(task: _Task, calibration: Calibration, q: Floats, arm: Arm) -> Floats | None:
    """Return the tool poses that a program states (N, 4, 4); None where they are the nominal ones.

    The controller reaches a stated pose by its own kinematics, so the nominal arm has another pose
    at the same joint values `q`. Points stated as joint values have the pose of the nominal arm.
    A calibration of deflections has no geometry: its unloaded arm is that of the controller.
    """
    targets = task.points.target_poses
    if targets is None or arm is calibration.model.cell.arm or calibration.mode == "deflection":
        return None
    prediction = calibration.predict(q, tool=task.tool, std=False)
    nominal = se3.matrix(prediction.nominal_rotation, prediction.nominal_position)
    stated = np.isfinite(targets).all(axis=(1, 2), keepdims=True)
    return np.where(stated, targets, nominal)


def _calibration(path: Path, catalogue: Catalogue, revision: int | None) -> Calibration:
    if path.suffix == ".json":
        if revision is not None:
            raise InputError(f"{path}: a calibration has no revisions; leave out --revision")
        return Calibration.load(path, catalogue)
    with Campaign.open(path, catalogue, read_only=True) as run:
        return run.calibration(revision)


def _task(
    path: Path,
    calibration: Calibration,
    options: CompensationOptions,
    near: Floats | None,
    kind: str,
) -> _Task:
    arm, tool = calibration.model.cell.arm, None
    if options.tool is not None:
        six = _numbers(options.tool, 6, "--tool")
        if np.abs(six[:3]).max() > 5.0:
            raise InputError(
                f"--tool {options.tool!r} lies over 5 m from the flange; valid: metres"
            )
        if np.linalg.norm(six[3:]) > 2 * np.pi + 1e-6:
            raise InputError(f"--tool {options.tool!r} is rotated by over a turn; valid: radians")
        tool = se3.matrix(se3.rotation(six[3:]), six[:3])
    if path.suffix.lower() in READERS:
        foreign = read_program(
            path, arm, frames=options.frames, tool=tool, near=near, leave=options.leave
        )
        return _Task(foreign.points, foreign.tool, foreign=foreign)
    if options.frames is not None:
        raise InputError(f"{path}: --frames is for programs: {', '.join(READERS)}")
    if path.suffix not in PROGRAMS:
        if options.leave:
            raise InputError(f"{path}: --leave is for waypoints of a program; valid: without it")
        mapping = None if kind == "table" else find_mapping(kind, PointMapping)
        return _Task(read_points(path, arm, calibration.loads, mapping), tool)
    if arm.n != urscript.JOINTS:
        raise InputError(f"{path}: a UR program, and {arm.name} has {arm.n} joints")
    program, waypoints, points, tcp = urscript.program_points(path, options.leave)
    if tcp is None and tool is None and points.target_poses is not None:
        for k in np.flatnonzero(np.isfinite(points.target_poses[:, 0, 0]))[:1].tolist():
            raise InputError(
                f"{path}: {points.names[k]} is a pose of a tool centre point that the program does "
                'not set; give --tool "X Y Z RX RY RZ" as the installation has it'
            )
    if tcp is not None and tool is not None and not np.allclose(tcp, tool, atol=1e-9):
        raise InputError(f"{path}: set_tcp is another tool than --tool; leave out one of them")
    return _Task(points, tool if tcp is None else tcp, program, waypoints)


def _only(task: _Task, retained: list[int], refused: list[str]) -> _Task:
    if task.foreign is not None:
        foreign = task.foreign.without(refused)
        return replace(task, points=foreign.points, foreign=foreign)
    poses = task.points.target_poses
    points = Points(
        tuple(task.points.names[k] for k in retained),
        task.points.q[retained],
        None if poses is None else poses[retained],
    )
    reasons = iter(refused)
    waypoints = tuple(
        w if w.not_corrected else replace(w, not_corrected=next(reasons)) for w in task.waypoints
    )
    return replace(task, points=points, waypoints=waypoints)


def _wrench(
    points: Points, calibration: Calibration, options: CompensationOptions
) -> Floats | None:
    load, wrench = options.load, options.wrench
    if sum(x is not None for x in (load, wrench, points.wrench, points.sensor_wrench)) > 1:
        raise InputError("more than one load is given; valid: one of --load, --wrench, columns")
    if wrench is not None:
        return _numbers(wrench, 6, "--wrench")
    if load is None or load == "none":
        return points.wrench
    if load not in calibration.loads:
        valid = ", ".join(("none", *calibration.loads))
        raise InputError(f"--load {load}: no such load; valid: {valid}")
    return calibration.loads[load]


def _numbers(text: str, count: int, option: str) -> Floats:
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{option} {text!r}; valid: {count} numbers")
    return values


def _refuse(path: Path, names: tuple[str, ...], refused: list[str], wrong: Bools) -> None:
    """Refuse all points where any is refused; `wrong` are those that no option allows."""
    bad = [k for k, why in enumerate(refused) if why]
    if not bad:
        return
    named = "; ".join(f"{names[k]}: {refused[k]}" for k in bad[:MAX_NAMED])
    ending = f"; and {len(bad) - MAX_NAMED} more" if len(bad) > MAX_NAMED else ""
    message = f"{path}: {len(bad)} of {len(names)} points are refused: {named}{ending}"
    if wrong[bad].any():
        raise InputError(message)
    raise CannotAnswerError(f"{message}; measure there, or give --allow-outside")


def _check_output(path: Path, points: Path, force: bool) -> None:
    kind = points.suffix.lower()
    valid = (".csv", ".json", points.suffix) if kind in READERS else TABLE_SUFFIXES
    if path.suffix not in valid:
        raise InputError(f"{path}: unknown kind of file; valid: {', '.join(valid)}")
    check_new(path, force)
    if kind == ".src" and path.suffix == points.suffix:
        for companion in path.parent.glob(f"{path.stem}.*"):
            if companion.suffix.lower() == ".dat":
                check_new(companion, force)


def _write(
    path: Path, task: _Task, result: Compensation, document: dict[str, object], units: Sequence[str]
) -> list[Path]:
    names, n = task.points.names, result.q.shape[1]
    if task.foreign is not None and path.suffix.lower() in READERS:
        files = {path.with_suffix(k): v for k, v in task.foreign.corrected(result.q).items()}
        for file_path, text in files.items():
            replace_file(file_path, text)
        return list(files)
    content: str
    if path.suffix == ".json":
        content = json.dumps(with_nulls(document), allow_nan=False, indent=2) + "\n"
    elif path.suffix == ".csv":
        content = _csv(names, result, units)
    elif n != urscript.JOINTS:
        raise InputError(f"{path}: a UR program has {urscript.JOINTS} joints, this arm has {n}")
    elif task.program is None:
        content = urscript.movej_program(names, result.q)
    else:
        content = urscript.with_joints(task.program, task.corrected, result.q)
    replace_file(path, content)
    return [path]


def _csv(names: tuple[str, ...], result: Compensation, units: Sequence[str]) -> str:
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(["pose", *joint_columns(units), "before_m", "std_m", "band_m"])
    for k, name in enumerate(names):
        numbers = (result.before.error_m[k], result.after.std_m[k], result.after.band_m[k])
        values = [f"{v:.9f}" for v in result.q[k]]
        rows.writerow([csv_text(name), *values, *(f"{x:.4g}" for x in numbers)])
    return out.getvalue()
