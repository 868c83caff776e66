"""`compensate`: joint values that put the tool where it was asked to be."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.compensation import Compensation
from hilcal.calibration.points import Points, on_branch, read_points
from hilcal.calibration.programs.languages import READERS, UnderstoodProgram, understood
from hilcal.calibration.urscript import (
    JOINTS,
    Waypoint,
    doubts,
    movej_program,
    program_points,
    with_joints,
)
from hilcal.campaign.campaign import Campaign
from hilcal.cli.options import (
    EffectsFrom,
    Json,
    Revision,
    argument,
    catalogue_with,
    check_new,
    option,
)
from hilcal.cli.terminal import Terminal, terminal
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit_document import plain
from hilcal.names import csv_text
from hilcal.present.calibration import (
    compensation_report,
    fates,
    refusals,
    waypoints_table,
)
from hilcal.present.progress import working
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.tables.columns import joint_columns
from hilcal.tables.mapping import PointMapping, find_mapping
from hilcal.types import Bools, Floats
from hilcal.whole_file import replace_file

PROGRAMS = (".script", ".urscript")
WRITTEN = (".csv", ".json", *PROGRAMS)
NAMED = 5
"""Refused points that an error names."""


@dataclass(frozen=True, slots=True, eq=False)
class _Task:
    """What is to be compensated."""

    points: Points  # the points
    tool: Floats | None  # (4, 4) T_flange_tool; the tracked target where None
    program: str | None = None  # text of the program that the points are of
    waypoints: tuple[Waypoint, ...] = ()  # of that program, those that are left too
    other: UnderstoodProgram | None = None
    """A program of another maker than UR, in place of the two."""


def compensate(
    model: Annotated[
        Path, argument("RUN.hilcal", "A campaign with a revision, or a calibration (JSON).")
    ],
    points: Annotated[
        Path,
        argument(
            "POINTS",
            "Where to go: a table (CSV, XLSX …) or a program: UR .script, KUKA .src, ABB .mod, "
            "FANUC .ls, Yaskawa .jbi.",
        ),
    ],
    output: Annotated[
        list[Path] | None, option("-o --output F", "Write CSV, JSON or a program; repeatable.")
    ] = None,
    load: Annotated[
        str | None, option("--load NAME", "The load at every point, of [[loads]].")
    ] = None,
    wrench: Annotated[
        str | None,
        option(
            '--wrench "FX FY FZ MX MY MZ"',
            "Force and moment at the load point, base axes, N and N·m.",
        ),
    ] = None,
    tool: Annotated[
        str | None,
        option(
            '--tool "X Y Z RX RY RZ"',
            "The tool on the flange, m and rad; the tracked target unless given.",
        ),
    ] = None,
    near: Annotated[
        str | None,
        option('--near "Q1 Q2 .. QN"', "Joint values near the first pose, degrees; m of slides."),
    ] = None,
    frames: Annotated[
        Path | None,
        option(
            "--frames F",
            "The controller's tools and bases, for programs of other makers than UR: TOML, "
            "$config.dat or a RAPID module.",
        ),
    ] = None,
    outside: Annotated[
        bool, option("--allow-outside", "Also points outside of what was measured.")
    ] = False,
    leave: Annotated[
        bool, option("--leave", "Keep waypoints of a program that cannot be corrected as they are.")
    ] = False,
    revision: Revision = None,
    effects_from: EffectsFrom = None,
    kind: Annotated[
        str, option("--format FORMAT", "table, or a mapping, as for import.")
    ] = "table",
    force: Annotated[bool, option("--force", "Replace existing files.")] = False,
    as_json: Json = False,
) -> None:
    """Find the joint values that put the tool where it was asked to be, under a load."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    for path in output or ():
        _check_output(path, points, force)
    with working(t.progress) as say:
        say(f"reading {model}")
        calibration = _calibration(model, catalogue, revision)
        arm = calibration.model.cell.arm
        start = None if near is None else _numbers(near, arm.n, "--near")
        start = None if start is None else np.where(arm.slides, start, np.radians(start))
        task = _task(points, calibration, tool, frames, start, leave, kind)
        arm = calibration.controller if task.program else arm
        for said in filter(None, (task.points.taken, *(task.other.said if task.other else ()))):
            t.notice(f"{points}: {said}")
        given = _wrench(task.points, calibration, load, wrench)
        say(f"compensating {len(task.points.names)} points")
        on_flange = calibration.tool_pose(task.tool)
        begin = calibration.measured.middle(arm.n) if start is None and not task.program else start
        q = on_branch(task.points, arm, on_flange, begin)
        understood = [w for w in task.waypoints if not w.left]
        uncertain = doubts(arm, on_flange, understood, q, start) or [""] * len(q)
        sensed = task.points.sensed
        acting = given if sensed is None else calibration.load_wrench(q, sensed)
        wanted = _wanted(task, calibration, q, arm)
        found = calibration.compensate(
            q, acting, tool=task.tool, wanted=wanted, recorded=task.points.recorded
        )
    slow = calibration.without_kernel(task.tool)
    if slow:
        t.notice(
            f"note: {', '.join(slow)} has no compiled form: a point takes 25 to 60 ms, not 0.1 ms"
        )
    refused = refusals(found, outside)
    refused = ["; ".join(filter(None, both)) for both in zip(uncertain, refused, strict=True)]
    become = fates(task.other.program.points if task.other else task.waypoints, refused)
    kept = [k for k, why in enumerate(refused) if not why]
    if not leave or not kept:
        _refuse(points, task.points.names, refused, _unreachable(found) | np.array(uncertain, bool))
    elif any(refused):
        q, task = q[kept], _only(task, kept, refused)
        wanted = None if wanted is None else wanted[kept]
        found = calibration.compensate(q, acting, tool=task.tool, wanted=wanted)
    document = found.to_dict(task.points.names)
    if become:
        document["waypoints"] = [asdict(fate) for fate in become]
    written = [
        made for path in output or () for made in _write(path, task, found, document, arm.units)
    ]
    t.show(compensation_report(calibration, task.points.names, q, found))
    t.show(waypoints_table(become))
    _say_written(t, written)
    t.document({**document, "written": [str(path) for path in written]})


def _wanted(task: _Task, calibration: Calibration, q: Floats, arm: Arm) -> Floats | None:
    """Return where a program asks for the tool (N, 4, 4), None where the nominal arm has it there.

    The controller takes a pose by its own kinematics, so that the nominal arm is elsewhere at the
    joint values `q` that it goes to; joint values are those of the nominal arm. A calibration of
    deflections knows no geometry: its unloaded arm is where the controller has it.
    """
    poses = task.points.wanted
    if poses is None or arm is calibration.model.cell.arm or calibration.mode == "deflection":
        return None
    there = calibration.predict(q, tool=task.tool, std=False)
    nominal = se3.matrix(there.nominal_rotation, there.nominal_position)
    told = np.isfinite(poses).all(axis=(1, 2), keepdims=True)
    return np.where(told, poses, nominal)


def _say_written(t: Terminal, paths: list[Path]) -> None:
    if paths:
        t.show(f"\nWritten: {', '.join(str(path) for path in paths)}.")
    else:
        t.show("\nNothing is written; -o F.csv, F.json or F.script keeps the joint values.")


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
    tool: str | None,
    frames: Path | None,
    near: Floats | None,
    leave: bool,
    kind: str,
) -> _Task:
    arm = calibration.model.cell.arm
    given = None
    if tool is not None:
        six = _numbers(tool, 6, "--tool")
        given = se3.matrix(se3.rotation(six[3:]), six[:3])
    if path.suffix.lower() in READERS:
        found = understood(path, arm, frames=frames, tool=given, near=near, leave=leave)
        return _Task(found.points, found.tool, other=found)
    if frames is not None:
        raise InputError(f"{path}: --frames is for programs: {', '.join(READERS)}")
    if path.suffix in PROGRAMS:
        if arm.n != JOINTS:
            raise InputError(f"{path}: a UR program, and {arm.name} has {arm.n} joints")
        program, every, points, own = program_points(path, leave)
        if own is None and given is None and points.wanted is not None:
            poses = np.isfinite(points.wanted[:, 0, 0])
            if poses.any():
                name = points.names[int(np.argmax(poses))]
                raise InputError(
                    f"{path}: {name} is a pose of a tool centre point that the program does not "
                    'set; give --tool "X Y Z RX RY RZ" as the installation has it'
                )
        if own is not None and given is not None and not np.allclose(own, given, atol=1e-9):
            raise InputError(f"{path}: set_tcp is another tool than --tool; leave out one of them")
        return _Task(points, given if own is None else own, program, every)
    if leave:
        raise InputError(f"{path}: --leave is for waypoints of a program; valid: without it")
    mapping = None if kind == "table" else find_mapping(kind, PointMapping)
    return _Task(read_points(path, arm, calibration.loads, mapping), given)


def _only(task: _Task, kept: list[int], refused: list[str]) -> _Task:
    """Return the task of a program without the waypoints that are refused."""
    if task.other is not None:
        other = task.other.without(refused)
        return replace(task, points=other.points, other=other)
    wanted = task.points.wanted
    points = Points(
        tuple(task.points.names[k] for k in kept),
        task.points.q[kept],
        None if wanted is None else wanted[kept],
    )
    why = iter(refused)
    waypoints = tuple(w if w.left else replace(w, left=next(why)) for w in task.waypoints)
    return replace(task, points=points, waypoints=waypoints)


def _wrench(
    points: Points, calibration: Calibration, load: str | None, wrench: str | None
) -> Floats | None:
    """(6,) or (N, 6) wrench at the points."""
    given = [x for x in (load, wrench, points.wrench, points.sensed) if x is not None]
    if len(given) > 1:
        raise InputError("the load is given twice; valid: one of --load, --wrench, columns")
    if wrench is not None:
        return _numbers(wrench, 6, "--wrench")
    if load is not None and load != "none":
        if load not in calibration.loads:
            valid = ", ".join(("none", *calibration.loads))
            raise InputError(f"--load {load}: no such load; valid: {valid}")
        return calibration.loads[load]
    return points.wrench


def _numbers(written: str, count: int, option: str) -> Floats:
    try:
        values = np.array([float(word) for word in written.replace(",", " ").split()])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{option} {written!r}; valid: {count} numbers")
    return values


def _unreachable(found: Compensation) -> Bools:
    return np.asarray(~found.inverse.solved | found.singular | found.limits.any(axis=1))


def _refuse(path: Path, names: tuple[str, ...], refused: list[str], wrong: Bools) -> None:
    """Refuse the whole table where points are refused."""
    bad = [k for k, why in enumerate(refused) if why]
    if not bad:
        return
    named = "; ".join(f"{names[k]}: {refused[k]}" for k in bad[:NAMED])
    more = f"; and {len(bad) - NAMED} more" if len(bad) > NAMED else ""
    words = f"{path}: {len(bad)} of {len(names)} points are refused: {named}{more}"
    if wrong[bad].any():
        raise InputError(words)
    raise CannotAnswerError(f"{words}; measure there, or give --allow-outside")


def _check_output(path: Path, points: Path, force: bool) -> None:
    kind = points.suffix.lower()
    valid = (".csv", ".json", points.suffix) if kind in READERS else WRITTEN
    if path.suffix not in valid:
        raise InputError(f"{path}: unknown kind of file; valid: {', '.join(valid)}")
    check_new(path, force)
    if kind == ".src" and path.suffix == points.suffix:
        for beside in path.parent.glob(f"{path.stem}.*"):
            if beside.suffix.lower() == ".dat":
                check_new(beside, force)


def _write(
    path: Path,
    task: _Task,
    found: Compensation,
    document: dict[str, object],
    units: Sequence[str],
) -> list[Path]:
    """Write the joint values as the file's name asks; returns the files."""
    names, n = task.points.names, found.q.shape[1]
    if task.other is not None and path.suffix.lower() in READERS:
        files = {path.with_suffix(k): v for k, v in task.other.corrected(found.q).items()}
        for each, file in files.items():
            replace_file(each, file)
        return list(files)
    content: str
    if path.suffix == ".json":
        content = json.dumps(plain(document), allow_nan=False, indent=2) + "\n"
    elif path.suffix == ".csv":
        content = _csv(names, found, units)
    elif n != JOINTS:
        raise InputError(f"{path}: a UR program has {JOINTS} joints, this arm has {n}")
    elif task.program is None:
        content = movej_program(names, found.q)
    else:
        content = with_joints(task.program, [w for w in task.waypoints if not w.left], found.q)
    replace_file(path, content)
    return [path]


def _csv(names: tuple[str, ...], found: Compensation, units: Sequence[str]) -> str:
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(["pose", *joint_columns(units), "before_m", "std_m", "band_m"])
    for k, name in enumerate(names):
        numbers = (found.before.error_m[k], found.after.std_m[k], found.after.band_m[k])
        values = [f"{v:.9f}" for v in found.q[k]]
        rows.writerow([csv_text(name), *values, *(f"{x:.4g}" for x in numbers)])
    return out.getvalue()
