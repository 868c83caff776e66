"""`export`: a campaign and its identified model, for other programs and controllers."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from hilcal.calibration import dh_table, handover
from hilcal.calibration.calibration import Calibration
from hilcal.calibration.handover import CorrectedArm, corrected_arm
from hilcal.calibration.robot_files.descriptions import KINDS, correct_file
from hilcal.campaign.campaign import Campaign
from hilcal.cli.options import check_new, command
from hilcal.cli.terminal import Terminal
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import InputError
from hilcal.identification import parameters_document
from hilcal.identification.prediction.full_prediction import residual_table
from hilcal.numbers import length
from hilcal.present.calibration import refuted_line
from hilcal.present.progress import Say, working
from hilcal.present.registration import base_line
from hilcal.procedure.state import Files
from hilcal.readings.covariance import INSTRUMENT
from hilcal.store.revision import RevisionRecord
from hilcal.store.stored_texts import ROBOT_FILE
from hilcal.tables.write import check_suffix, revision_table, write_columns
from hilcal.whole_file import replace_file

LARGE_OFFSET_M = 10.0  # distance along a joint's axis above which d of two joints may cancel, m


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """The files to write, and how."""

    readings: Path | None = None
    table: Path | None = None
    cell: Path | None = None
    residuals: Path | None = None
    revisions: Path | None = None
    parameters: Path | None = None
    calibration: Path | None = None
    urdf: Path | None = None
    dh: Path | None = None
    modified: bool = False
    ur_kinematics: Path | None = None
    ur_hash: str | None = None
    frames: Path | None = None
    matlab: Path | None = None
    into: list[Path] | None = None
    base_link: str | None = None
    tip_link: str | None = None

    @property
    def geometry(self) -> list[Path]:
        """Files of the corrected geometry."""
        new = (self.urdf, self.dh, self.ur_kinematics, self.frames, self.matlab)
        return [path for path in (*new, *(self.into or ())) if path is not None]

    @property
    def of_model(self) -> list[Path]:
        """Files of the identified model."""
        fitted = (self.residuals, self.parameters, self.calibration, *self.geometry)
        return [path for path in fitted if path is not None]

    @property
    def paths(self) -> list[Path]:
        """All files."""
        data = (self.readings, self.table, self.cell, self.revisions)
        return [*(path for path in data if path is not None), *self.of_model]

    def check(self, force: bool) -> None:
        """Refuse a file that cannot be written, before anything is computed."""
        if not self.paths:
            raise InputError(
                "nothing to export; give --readings, --table, --residuals or --revisions F.csv or "
                "F.parquet, --cell CELL.toml, --parameters F.json, --calibration F.json, "
                "--urdf F.urdf, --dh F.toml, --ur-kinematics F.yaml, --frames F.json, "
                "--matlab F.m, or --into F of your own"
            )
        for path in (self.readings, self.table, self.residuals, self.revisions):
            if path is not None:
                check_suffix(path)
        for file, name, valid in (
            (self.parameters, "--parameters", (".json", ".csv")),
            (self.dh, "--dh", (".toml", ".csv")),
            (self.matlab, "--matlab", (".m",)),
        ):
            if file is not None and file.suffix.lower() not in valid:
                raise InputError(
                    f"{name} {file}: unknown kind of file; valid: {' or '.join(valid)}"
                )
        for value, name, target, needs in (
            (self.modified, "--dh-modified", self.dh, "--dh"),
            (self.ur_hash, "--ur-hash", self.ur_kinematics, "--ur-kinematics"),
            (self.base_link is not None, "--base-link", self.into, "--into"),
            (self.tip_link is not None, "--tip-link", self.into, "--into"),
        ):
            if value and not target:
                raise InputError(f"{name} needs {needs}; give it, too")
        if twice := [path for path in self.paths if self.paths.count(path) > 1]:
            raise InputError(f"{twice[0]}: two things cannot be written to one file")
        if self.matlab is not None and not re.fullmatch(r"[A-Za-z]\w{0,62}", self.matlab.stem):
            raise InputError(
                f"--matlab {self.matlab}; valid: a name that MATLAB calls, such as arm.m"
            )
        for path in self.into or ():
            if not path.is_file():
                raise InputError(f"--into {path}: no such file; valid: {KINDS}")
        for path in self.paths:
            check_new(path, force)


@command("""
    readings | --readings F.csv|F.parquet | The readings as stored; hilcal import reads them.
    table | --table F.csv|F.parquet | The readings with the arm's scatter in their covariance.
    cell | --cell CELL.toml | Configuration of the cell, to import --readings.
    residuals | --residuals F.csv|F.parquet | Residuals of the fit and on poses left out, one row
        per reading.
    revisions | --revisions F.csv|F.parquet | All revisions with model, errors and verdict.
    parameters | --parameters F.json|F.csv | Parameters of the model; JSON: with their covariance.
    calibration | --calibration F.json | The identified arm, for hilcal compensate on any machine.
    urdf | --urdf F.urdf | The arm with its corrected geometry.
    dh | --dh F.toml|F.csv | The corrected geometry as a DH table.
    modified | --dh-modified | Rows of --dh in the modified convention (Craig).
    ur_kinematics | --ur-kinematics F.yaml | The corrected geometry for UR's ROS driver:
        kinematics_params_file.
    ur_hash | --ur-hash calib_N | Hash of the connected arm, which the driver compares with that of
        the file.
    frames | --frames F.json | Poses of tool and base as fitted, and in the controller's format.
    matlab | --matlab F.m | A MATLAB function that builds the corrected arm as a rigidBodyTree.
    into | --into F | Correct the numbers in an existing description: URDF, xacro, MJCF, SDF,
        UR's calibration.conf; needs --force; repeatable.
    base_link | --base-link NAME | Link or body of --into that is the arm's base.
    tip_link | --tip-link NAME | Link, body or site of --into that is its flange.
    force | --force | Replace existing files.
    """)
def export(
    t: Terminal, catalogue: Catalogue, run: Path, options: ExportOptions,
    revision: int | None = None, force: bool = False,
) -> None:  # fmt: skip
    """Write readings, parameters, calibration, URDF, DH table or frames to files."""
    options.check(force)
    if revision is not None and not options.of_model:
        raise InputError("--revision selects a model; give --parameters or --calibration, too")
    with Campaign.open(run, catalogue, read_only=True) as campaign:
        record = campaign.in_use(revision)
        if record is None and (options.of_model or options.revisions is not None):
            raise InputError(f"{run}: no revision to export yet; run hilcal identify first")
        t.show(_write_data(campaign, options, force))
        if options.revisions is not None and record is not None:
            records = campaign.file.revisions()
            about = {"table": "revisions", "campaign": run.name}
            write_columns(options.revisions, revision_table(records, record.number), about)
            t.show(f"{options.revisions}: revisions 1 to {len(records)}; {record.number} is in use")
        if record is not None and options.of_model:
            with working(t.progress) as say:
                t.show(_write_model(t, say, campaign, revision, record, options))
    t.document({"written": [str(path) for path in options.paths]})


def _write_data(run: Campaign, options: ExportOptions, force: bool) -> Iterator[str]:
    """Write readings and cell; yield a line on each file."""
    count = len(run.readings)
    if options.readings is not None:
        run.save_table(options.readings, as_stored=True)
        scatter = run.stored_covers != INSTRUMENT
        note = ", the arm's scatter in their covariance" if scatter else ""
        yield f"{options.readings}: {count} readings as stored{note}"
    if options.table is not None:
        run.save_table(options.table)
        yield f"{options.table}: {count} readings, covariance: {run.covariance_parts}"
    if (cell := options.cell) is not None:
        robot_text = run.file.about(ROBOT_FILE)
        if robot_text is not None:
            robot = cell.parent / Path(run.config.robot.model).name
            if robot.exists() and not force and robot.read_bytes() != robot_text.encode():
                raise InputError(
                    f"{robot}: another file is there; choose another folder or give --force"
                )
            replace_file(robot, robot_text)
            yield f"{robot}: the robot, as the campaign keeps it"
        replace_file(cell, cell_toml(run))
        yield f"{cell}: the cell's configuration"


def cell_toml(run: Campaign) -> str:
    """Return the cell of a campaign as CELL.toml; a robot that it stores goes by its name."""
    content = run.config.model_dump(mode="json", exclude_none=True)
    robot = Path(run.file.base_dir) / run.config.robot.model
    if robot.suffix:
        stored = run.file.about(ROBOT_FILE) is not None
        content["robot"]["model"] = robot.name if stored else str(robot)
    return f"# The cell of {run.path.name}, every key written out.\n{tomli_w.dumps(content)}"


def _write_model(
    t: Terminal,
    say: Say,
    run: Campaign,
    revision: int | None,
    record: RevisionRecord,
    options: ExportOptions,
) -> Iterator[str]:
    number, parameters = record.number, options.parameters
    source: dict[str, object] = {"campaign": run.path.name, "revision": number}
    source["readings_sha256"] = record.data_hash
    if parameters is not None and parameters.suffix.lower() == ".csv":
        rows = record.result_json["identify"]["parameters"]
        names = ("name", "value", "std", "unit", "identifiable")
        write_columns(parameters, {name: [row[name] for row in rows] for name in names}, {})
        yield f"{parameters}: {len(rows)} parameters of revision {number}"
        parameters = None
    if options.residuals is not None or parameters is not None:
        say("restoring the fit")
        fitted = run.fit(revision)
        if parameters is not None:
            say("computing uncertainties")
            document: dict[str, Any] = parameters_document.to_json(fitted, source)
            replace_file(parameters, json.dumps(document, indent=1, allow_nan=False) + "\n")
            yield (
                f"{parameters}: {len(document['parameters'])} parameters of revision {number}, "
                f"covariance of the {len(document['covariance_of'])} that the readings determine"
            )
        if options.residuals is not None:
            say("predicting poses left out")
            about = {"table": "residuals", **source}
            write_columns(options.residuals, residual_table(fitted), about)
            kind = "deflections" if fitted.mode == "deflection" else "readings"
            yield (
                f"{options.residuals}: measured − predicted of {len(fitted.raw)} fitted {kind}, "
                f"revision {number}"
            )
    if options.calibration is None and not options.geometry:
        return
    say("restoring the fit, and what it knows of other readings")
    identified = run.calibration(revision)
    if doubt := refuted_line(identified, run.path, run.path, Files(run.path).validation):
        t.notice(f"warning: {doubt}")
    if options.calibration is not None:
        identified.save(options.calibration)
        yield f"{options.calibration}: the calibration of revision {number}"
    if options.geometry:
        yield from _write_geometry(identified, options)


def _write_geometry(calibration: Calibration, options: ExportOptions) -> Iterator[str]:
    """Write the files of the corrected geometry; yield a line on each."""
    arm = corrected_arm(calibration)
    cell, beyond = calibration.model.cell, None
    nominal = cell.arm
    note = f"{nominal.name} as calibrated with hilcal, {calibration.source['campaign']}"
    base = base_line(cell, calibration.frames, calibration.mode)
    holds = ", ".join(arm.included) or "the nominal geometry"
    messages: list[str] = []
    files: dict[Path, str | bytes] = {}
    if options.ur_kinematics is not None:
        comment = _ur_note(note, base, arm, options.ur_hash)
        text, beyond = handover.ur_kinematics(nominal, arm.arm, comment, options.ur_hash)
        files[options.ur_kinematics] = text
        shift, tilt = np.linalg.norm(beyond[:3, 3]), np.linalg.norm(beyond[:3, :3] - np.eye(3))
        messages.append(
            f"{options.ur_kinematics}: kinematics_params_file of UR's ROS driver with {holds}; it "
            f"has no place for the flange's own shift ({length(float(shift))}) and tilt "
            f"({1e3 * float(tilt) / np.sqrt(2):.2g} mrad): tcp_for_ur_kinematics of --frames does"
        )
    if options.urdf is not None:
        files[options.urdf] = handover.urdf(arm.arm, f"{note}. {base}")
        messages.append(f"{options.urdf}: URDF, base_link to tool0, with {holds}")
    if options.dh is not None:
        rows = dh_table.dh_rows(arm.arm, "modified" if options.modified else "standard")
        alone = options.dh.suffix.lower() == ".csv"
        about = f"{note}, revision {calibration.source['revision']}"
        files[options.dh] = (
            dh_table.to_csv(rows, arm.arm) if alone else dh_table.to_toml(rows, arm.arm, about)
        )
        messages += _dh_words(options.dh, rows, holds, alone)
    if options.frames is not None:
        files[options.frames] = handover.frames(calibration, arm, beyond)
        messages.append(
            f"{options.frames}: tool and base as fitted, and in the controller's format"
        )
    if options.matlab is not None:
        files[options.matlab] = handover.matlab(arm.arm, options.matlab.stem, f"{note}. {base}")
        messages.append(f"{options.matlab}: a rigidBodyTree, base to tool0, with {holds}")
    for path in options.into or ():
        description = correct_file(path, nominal, arm, *_ends(calibration, options, path))
        files[path] = description.content
        messages.append(description.note)
    for path, content in files.items():
        replace_file(path, content)
    yield from (*messages, base)
    if arm.not_included:
        effects = ", ".join(arm.not_included)
        yield f"Not included, as not constant: {effects}; hilcal compensate corrects it"


def _ends(
    calibration: Calibration, options: ExportOptions, path: Path
) -> tuple[str | None, str | None]:
    """Return base and tip in a file: the options, or those of the cell in the cell's own file."""
    config = calibration.model.cell.config
    stated = options.base_link, options.tip_link
    if any(stated) or config is None or Path(config.robot.model).name != path.name:
        return stated
    return config.robot.base_link, config.robot.tip_link


def _ur_note(note: str, base: str, arm: CorrectedArm, digest: str | None) -> str:
    lines = [f"{note}; for kinematics_params_file of ur_robot_driver.", base]
    if arm.not_included:
        lines.append(f"Not in it, since not constant: {', '.join(arm.not_included)}.")
    if digest is None:
        lines += [
            "The hash is of this file. The driver logs that it is not that of the connected arm's",
            "factory calibration, and goes on; --ur-hash takes the arm's.",
        ]
    return "\n".join(lines)


def _dh_words(path: Path, rows: dh_table.DhRows, holds: str, alone: bool) -> Iterator[str]:
    yield f"{path}: {rows.convention} DH rows with {holds}"
    if max(rows.base_moves, rows.flange_moves) > dh_table.EXACT:
        parts = (
            f"where joint 1's axis lies in the base (up to {length(rows.base_moves)} at the flange)"
            f" and how the flange sits on the last axis (up to {length(rows.flange_moves)})"
        )
        place = "they are left out" if alone else "base_m_rad and flange_m_rad of the file hold it"
        yield f"A DH table has no place for {parts}; {place}."
    elif rows.disagreement <= dh_table.EXACT:
        yield "Forward kinematics of the rows is that of the corrected arm, to 1 nm."
    far = abs(rows.d).max()
    if far > LARGE_OFFSET_M:
        yield (
            f"Nearly parallel axes have distant common normals: d up to {far:.0f} m, which cancel; "
            "compute in double precision."
        )
