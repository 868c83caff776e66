"""`export`: a campaign and what was identified, for other programs, controllers and people."""

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tomli_w

from hilcal.calibration import dh_table, handover
from hilcal.calibration.calibration import Calibration
from hilcal.calibration.handover import Corrected, corrected
from hilcal.calibration.own_files.correct import KINDS, correct_file
from hilcal.campaign.campaign import Campaign
from hilcal.cli.options import EffectsFrom, Json, Revision, Run, catalogue_with, check_new, option
from hilcal.cli.terminal import Terminal, terminal
from hilcal.errors import InputError
from hilcal.identification import parameters_document
from hilcal.identification.full_prediction import residual_table
from hilcal.numbers import length
from hilcal.present.progress import Say, working
from hilcal.present.registration import base_line
from hilcal.readings.covariance import INSTRUMENT
from hilcal.store.robot_file import ROBOT_FILE
from hilcal.tables.write import check_suffix, revision_table, write_columns
from hilcal.whole_file import replace_file

MANY = 10.0
"""m; a distance along a joint's axis beyond which it is said that it cancels with others."""


def export(
    run: Run,
    readings: Annotated[
        Path | None, option("F.csv|F.parquet", "The readings as stored, to be imported again.")
    ] = None,
    table: Annotated[
        Path | None,
        option("F.csv|F.parquet", "The same with the arm's scatter in their covariance."),
    ] = None,
    cell: Annotated[
        Path | None, option("CELL.toml", "The cell's configuration, for --readings.")
    ] = None,
    residuals: Annotated[
        Path | None,
        option("F.csv|F.parquet", "Residuals of the fit and on poses left out, one row a reading."),
    ] = None,
    revisions: Annotated[
        Path | None, option("F.csv|F.parquet", "All revisions: model, errors, verdict.")
    ] = None,
    parameters: Annotated[
        Path | None,
        option("F.json|F.csv", "Parameters of the model; in JSON with their covariance."),
    ] = None,
    calibration: Annotated[
        Path | None, option("F.json", "The identified arm, ready for compensate on any machine.")
    ] = None,
    urdf: Annotated[Path | None, option("F.urdf", "The arm with its corrected geometry.")] = None,
    dh: Annotated[Path | None, option("F.toml|F.csv", "The same as a DH table.")] = None,
    modified: Annotated[
        bool, option("--dh-modified", "Rows of --dh as Craig writes them.")
    ] = False,
    ur_kinematics: Annotated[
        Path | None, option("F.yaml", "The same for UR's ROS driver: kinematics_params_file.")
    ] = None,
    ur_hash: Annotated[
        str | None,
        option(
            "calib_N", "The connected arm's hash, so that the driver takes the file for its own."
        ),
    ] = None,
    frames: Annotated[
        Path | None, option("F.json", "Tool and base as fitted, and as a controller takes them.")
    ] = None,
    matlab: Annotated[
        Path | None, option("F.m", "A MATLAB function that builds it as a rigidBodyTree.")
    ] = None,
    into: Annotated[
        list[Path] | None,
        option(
            "F",
            "A description of yours whose numbers are replaced: URDF, xacro, MJCF, SDF, UR's "
            "calibration.conf; needs --force, repeatable.",
        ),
    ] = None,
    base_link: Annotated[
        str | None, option("NAME", "Link or body of --into that the arm begins at.")
    ] = None,
    tip_link: Annotated[
        str | None, option("NAME", "Link, body or site of --into that is its flange.")
    ] = None,
    revision: Revision = None,
    force: Annotated[bool, option("--force", "Replace existing files.")] = False,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Hand over: readings, parameters, calibration, URDF, DH, frames."""
    t = terminal(as_json)
    ends = (base_link, tip_link)
    geometry = Geometry(
        urdf, dh, modified, ur_kinematics, ur_hash, frames, matlab, tuple(into or ()), ends
    )
    data = [path for path in (readings, table, cell, revisions) if path is not None]
    of_model = [residuals, parameters, calibration, *geometry.paths]
    wanted = [*data, *(path for path in of_model if path is not None)]
    _check(wanted, (readings, table, residuals, revisions), parameters, geometry, force)
    if revision is not None and not any(of_model):
        raise InputError("--revision is about the model; give --parameters or --calibration, too")
    with Campaign.open(run, catalogue_with(effects_from), read_only=True) as opened:
        record = opened.in_use(revision)
        if record is None and (any(of_model) or revisions is not None):
            raise InputError(f"{run}: no revision yet, so nothing of it; run hilcal identify first")
        _write_data(t, opened, readings, table, cell, force)
        if revisions is not None and record is not None:
            records = opened.file.revisions()
            about = {"table": "revisions", "campaign": run.name}
            write_columns(revisions, revision_table(records, record.number), about)
            t.show(f"{revisions}: revisions 1 to {len(records)}; {record.number} is in use")
        if record is not None and any(of_model):
            with working(t.progress) as say:
                _write_model(t, say, opened, revision, residuals, parameters, calibration, geometry)
    t.document({"written": [str(path) for path in wanted]})


@dataclass(frozen=True, slots=True)
class Geometry:
    """Forms of the corrected geometry that are wanted."""

    urdf: Path | None
    dh: Path | None
    modified: bool
    ur_kinematics: Path | None
    ur_hash: str | None
    frames: Path | None
    matlab: Path | None
    into: tuple[Path, ...]
    ends: tuple[str | None, str | None]

    @property
    def paths(self) -> list[Path]:
        """Files that are wanted."""
        new = (self.urdf, self.dh, self.ur_kinematics, self.frames, self.matlab)
        every = (*new, *self.into)
        return [path for path in every if path is not None]


def _check(
    wanted: Sequence[Path],
    tables: Sequence[Path | None],
    parameters: Path | None,
    geometry: Geometry,
    force: bool,
) -> None:
    """Refuse what cannot be written, before anything is computed."""
    if not wanted:
        raise InputError(
            "nothing to export; give --readings, --table, --residuals or --revisions F.csv or "
            "F.parquet, --cell CELL.toml, --parameters F.json, --calibration F.json, "
            "--urdf F.urdf, --dh F.toml, --ur-kinematics F.yaml, --frames F.json, --matlab F.m, or "
            "--into F of your own"
        )
    for path in tables:
        if path is not None:
            check_suffix(path)
    for given, name, valid in (
        (parameters, "--parameters", (".json", ".csv")),
        (geometry.dh, "--dh", (".toml", ".csv")),
        (geometry.matlab, "--matlab", (".m",)),
    ):
        if given is not None and given.suffix.lower() not in valid:
            raise InputError(f"{name} {given}: unknown kind of file; valid: {' or '.join(valid)}")
    for what, name, needs in (
        (geometry.modified and geometry.dh is None, "--dh-modified", "--dh"),
        (geometry.ur_hash and geometry.ur_kinematics is None, "--ur-hash", "--ur-kinematics"),
        (geometry.ends[0] is not None and not geometry.into, "--base-link", "--into"),
        (geometry.ends[1] is not None and not geometry.into, "--tip-link", "--into"),
    ):
        if what:
            raise InputError(f"{name} is about {needs}; give it, too")
    twice = [path for path in wanted if wanted.count(path) > 1]
    if twice:
        raise InputError(f"{twice[0]}: two things cannot be written to one file")
    if geometry.matlab is not None and not re.fullmatch(r"[A-Za-z]\w{0,62}", geometry.matlab.stem):
        raise InputError(
            f"--matlab {geometry.matlab}; valid: a name that MATLAB calls, such as arm.m"
        )
    for path in geometry.into:
        if not path.is_file():
            raise InputError(f"--into {path}: no such file; valid: {KINDS}")
    for path in wanted:
        check_new(path, force)


def _write_data(
    t: Terminal,
    run: Campaign,
    readings: Path | None,
    table: Path | None,
    cell: Path | None,
    force: bool,
) -> None:
    if readings is not None:
        run.save_table(readings, as_stored=True)
        with_arm = (
            "" if run.stored_covers == INSTRUMENT else ", the arm's scatter in their covariance"
        )
        t.show(f"{readings}: {len(run.readings)} readings as stored{with_arm}")
    if table is not None:
        run.save_table(table)
        t.show(f"{table}: {len(run.readings)} readings, covariance: {run.covariance_parts}")
    if cell is not None:
        kept = run.file.about(ROBOT_FILE)
        if kept is not None:
            robot = cell.parent / Path(run.config.robot.model).name
            _beside(robot, kept, force)
            t.show(f"{robot}: the robot, as the campaign keeps it")
        replace_file(cell, cell_toml(run))
        t.show(f"{cell}: the cell's configuration")


def _beside(path: Path, text: str, force: bool) -> None:
    """Write a robot's file; one of another content is replaced with --force only."""
    if path.exists() and not force and path.read_bytes() != text.encode():
        raise InputError(f"{path}: another file is there; choose another folder or give --force")
    replace_file(path, text)


def cell_toml(run: Campaign) -> str:
    """Return the configuration that a campaign was measured with, as CELL.toml.

    The file of a robot that is not of the catalogue stands beside it; that of a campaign which does
    not keep it is named by its whole path.
    """
    content = run.config.model_dump(mode="json", exclude_none=True)
    robot = Path(run.file.base_dir) / run.config.robot.model
    if robot.suffix:
        kept = run.file.about(ROBOT_FILE) is not None
        content["robot"]["model"] = robot.name if kept else str(robot)
    return f"# The cell of {run.path.name}, every key written out.\n{tomli_w.dumps(content)}"


def _write_model(
    t: Terminal,
    say: Say,
    run: Campaign,
    revision: int | None,
    residuals: Path | None,
    parameters: Path | None,
    calibration: Path | None,
    geometry: Geometry,
) -> None:
    record = run.in_use(revision)
    number = 0 if record is None else record.number
    source: dict[str, object] = {"campaign": run.path.name, "revision": number}
    if record is not None:
        source["readings_sha256"] = record.data_hash
    if parameters is not None and parameters.suffix.lower() == ".csv" and record is not None:
        rows = record.result_json["identify"]["parameters"]
        _write_parameters(parameters, rows)
        t.show(f"{parameters}: {len(rows)} parameters of revision {number}")
        parameters = None
    if residuals is not None or parameters is not None:
        say("restoring the fit")
        fitted = run.fit(revision)
        if parameters is not None:
            say("computing uncertainties")
            found = parameters_document.to_json(fitted, source)
            replace_file(parameters, json.dumps(found, indent=1, allow_nan=False) + "\n")
            known, every = found["covariance_of"], found["parameters"]
            t.show(
                f"{parameters}: {_count(every)} parameters of revision {number}, covariance of the "
                f"{_count(known)} that the readings determine"
            )
        if residuals is not None:
            say("predicting poses left out")
            write_columns(residuals, residual_table(fitted), {"table": "residuals", **source})
            kind = "deflections" if fitted.mode == "deflection" else "readings"
            t.show(
                f"{residuals}: measured − predicted of {len(fitted.raw)} fitted {kind}, revision "
                f"{number}"
            )
    if calibration is None and not geometry.paths:
        return
    say("restoring the fit, and what it knows of other readings")
    identified = run.calibration(revision)
    if calibration is not None:
        identified.save(calibration)
        t.show(f"{calibration}: the calibration of revision {number}")
    t.show(_write_geometry(identified, geometry))


def _count(rows: object) -> int:
    return len(rows) if isinstance(rows, list) else 0


def _write_geometry(found: Calibration, wanted: Geometry) -> Iterator[str]:
    """Write the corrected geometry in the forms that are wanted; yields what was written."""
    if not wanted.paths:
        return
    arm = corrected(found)
    cell, beyond = found.model.cell, None
    nominal = cell.arm
    note = f"{nominal.name} as calibrated with hilcal, {found.source['campaign']}"
    base = base_line(cell, found.frames, found.mode)
    holds = ", ".join(arm.within) or "the nominal geometry"
    said: list[str] = []
    write: list[Callable[[], object]] = []

    def later(path: Path, text: str) -> None:
        write.append(lambda: replace_file(path, text))

    if wanted.ur_kinematics is not None:
        words = _ur_note(note, base, arm, wanted.ur_hash)
        text, beyond = handover.ur_kinematics(nominal, arm.arm, words, wanted.ur_hash)
        later(wanted.ur_kinematics, text)
        shift, tilt = np.linalg.norm(beyond[:3, 3]), np.linalg.norm(beyond[:3, :3] - np.eye(3))
        said.append(
            f"{wanted.ur_kinematics}: kinematics_params_file of UR's ROS driver with {holds}; it "
            f"has no place for the flange's own shift ({length(float(shift))}) and tilt "
            f"({1e3 * float(tilt) / np.sqrt(2):.2g} mrad): tcp_for_ur_kinematics of --frames does"
        )
    if wanted.urdf is not None:
        later(wanted.urdf, handover.urdf(arm.arm, f"{note}. {base}"))
        said.append(f"{wanted.urdf}: URDF, base_link to tool0, with {holds}")
    if wanted.dh is not None:
        rows = dh_table.dh_rows(arm.arm, "modified" if wanted.modified else "standard")
        csv_rows = wanted.dh.suffix.lower() == ".csv"
        text = (
            dh_table.to_csv(rows, arm.arm)
            if csv_rows
            else dh_table.to_toml(rows, arm.arm, f"{note}, revision {found.source['revision']}")
        )
        later(wanted.dh, text)
        said += _dh_words(wanted.dh, rows, holds, csv_rows)
    if wanted.frames is not None:
        later(wanted.frames, handover.frames(found, arm, beyond))
        said.append(f"{wanted.frames}: tool and base, as fitted and as a controller takes them")
    if wanted.matlab is not None:
        later(wanted.matlab, handover.matlab(arm.arm, wanted.matlab.stem, f"{note}. {base}"))
        said.append(f"{wanted.matlab}: a rigidBodyTree, base to tool0, with {holds}")
    for path in wanted.into:
        made = correct_file(path, nominal, arm, *_ends(found, wanted, path))
        write.append(lambda path=path, made=made: replace_file(path, made.content))  # type: ignore[misc]
        said.append(made.said)
    for each in write:
        each()
    yield from said
    yield base
    if arm.beyond:
        yield f"Not in it, since not constant: {', '.join(arm.beyond)}; hilcal compensate has it"


def _ends(found: Calibration, wanted: Geometry, path: Path) -> tuple[str | None, str | None]:
    """Base and tip in a file: as given, else as the cell has them for its own file."""
    config = found.model.cell.config
    if any(wanted.ends) or config is None or Path(config.robot.model).name != path.name:
        return wanted.ends
    return config.robot.base_link, config.robot.tip_link


def _ur_note(note: str, base: str, arm: Corrected, digest: str | None) -> str:
    lines = [f"{note}; for kinematics_params_file of ur_robot_driver.", base]
    if arm.beyond:
        lines.append(f"Not in it, since not constant: {', '.join(arm.beyond)}.")
    if digest is None:
        lines += [
            "The hash is of this file. The driver logs that it is not that of the connected arm's",
            "factory calibration, and goes on; --ur-hash takes the arm's.",
        ]
    return "\n".join(lines)


def _dh_words(path: Path, rows: dh_table.DhRows, holds: str, alone: bool) -> Iterator[str]:
    """Yield what a table holds, and what it does not."""
    yield f"{path}: {rows.convention} DH rows with {holds}"
    if max(rows.base_moves, rows.flange_moves) > dh_table.EXACT:
        parts = (
            f"where joint 1's axis lies in the base (up to {length(rows.base_moves)} at the flange)"
            f" and how the flange sits on the last axis (up to {length(rows.flange_moves)})"
        )
        where = "they are left out" if alone else "base_m_rad and flange_m_rad of the file hold it"
        yield f"A DH table has no place for {parts}; {where}."
    elif rows.disagreement <= dh_table.EXACT:
        yield "Forward kinematics of the rows is that of the corrected arm, to 1 nm."
    far = abs(rows.d).max()
    if far > MANY:
        yield (
            f"Nearly parallel axes have distant common normals: d up to {far:.0f} m, which cancel; "
            "compute in double precision."
        )


def _write_parameters(path: Path, rows: Sequence[dict[str, object]]) -> None:
    names = ("name", "value", "std", "unit", "identifiable")
    columns = {name: [row[name] for row in rows] for name in names}
    write_columns(path, columns, {})
