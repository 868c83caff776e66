"""`import` and `export`: tables in, tables out."""

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.padding import Padding

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.corrected import corrected
from hilcal.calibration.handover import frames as frames_file
from hilcal.calibration.handover import ur_kinematics as ur_kinematics_file
from hilcal.calibration.handover import urdf as urdf_file
from hilcal.campaign import Campaign
from hilcal.cell import Cell, cell_from_config
from hilcal.cli.effects_from import EffectsFrom, catalogue_with
from hilcal.cli.previewing import show_preview
from hilcal.cli.terminal import Json, Revision, Run, terminal
from hilcal.config import load_config
from hilcal.data.campaign_file import CampaignFile
from hilcal.data.covariance import COVERS
from hilcal.data.importing import import_readings
from hilcal.data.readings import Readings
from hilcal.data.table import write_table
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identify import description_words, frames_document
from hilcal.identify.full_covariance import covariance_parts
from hilcal.identify.gate import examine
from hilcal.identify.other_arm import other_arm
from hilcal.identify.registration import Registration, register
from hilcal.report import text
from hilcal.report.covariance_words import covariance_words
from hilcal.report.progress import working
from hilcal.report.text_registration import other_arm_line, registration_lines


def import_(
    table: Annotated[Path, typer.Argument(metavar="TABLE", help="What was measured.")],
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="CELL.toml", help="The cell it was measured in."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="RUN.hilcal",
            help="The campaign file to make; with --preview, the mapping file.",
        ),
    ] = None,
    kind: Annotated[
        str,
        typer.Option(
            "--format",
            metavar="FORMAT",
            help="table, ipa-ur10, a mapping that comes with the program, or a mapping file.",
        ),
    ] = "table",
    second: Annotated[
        Path | None,
        typer.Option("--second", metavar="TABLE", help="The second file, e.g. of the joints."),
    ] = None,
    preview: Annotated[
        bool,
        typer.Option("--preview", help="Show how the table could be read; make no campaign."),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: Json = False,
) -> None:
    """Make a campaign file from a table of readings."""
    t = terminal(as_json)
    if preview:
        if kind != "table":
            raise InputError(f"--preview proposes a mapping; leave out --format {kind}")
        show_preview(t, table, second, config, output, force)
        return
    if config is None or output is None:
        what = "--config CELL.toml" if config is None else "-o RUN.hilcal"
        raise InputError(f"{what} is missing; without it only --preview is possible")
    settings = load_config(config)
    base_dir = config.absolute().parent
    cell = cell_from_config(settings, base_dir)
    with working(t.progress) as say:
        say(f"reading {table}")
        found = import_readings(table, kind, settings, cell.arm, second)
        readings, parts = found.readings, covariance_parts(found.covers, settings)
        notes = (*found.notes, covariance_words(parts), *cell.arm.notes)
        say(f"writing {output}")
        source = f"{table.name} ({Path(kind).name})"
        with CampaignFile.create(
            output,
            settings.to_json(),
            str(base_dir),
            source,
            overwrite=force,
            more={COVERS: found.covers},
        ) as campaign:
            campaign.append_readings(readings)
    loads = [readings.load_names[k] for k in np.unique(readings.load)]
    poses = len(np.unique(readings.pose))
    t.show(text.heading(f"{len(readings)} readings of {poses} poses"))
    t.show(
        f"  robot {settings.robot.model}; each reading is a "
        f"{'position' if readings.m == 3 else 'position and an orientation'}\n"
        f"  loads: {', '.join(loads)}"
    )
    targets = _targets(cell, readings)
    if targets:
        t.show("  targets: " + "; ".join(text.target_words(**x) for x in targets))
    t.show(Padding(note, (0, 0, 0, 2)) for note in notes)
    registered = _registered(cell, readings)
    wrong = None if registered is None else examine(registered, readings)
    if registered is not None and not (wrong is not None and wrong.refused):
        t.show(Padding(line, (0, 0, 0, 2)) for line in registration_lines(registered))
    refused = wrong is not None and wrong.refused
    other = None if registered is None or refused else other_arm(registered, readings)
    if other is not None:
        t.show(Padding(f"Note: {other_arm_line(other)}", (0, 0, 0, 2)))
    if wrong is not None:
        said = description_words.words(wrong, cell, readings)
        begin = "Nothing can be fitted yet" if wrong.refused else "Note"
        t.show(Padding(f"{begin}: {said}.", (0, 0, 0, 2)))
    t.document(
        {
            "campaign": str(output),
            "robot": settings.robot.model,
            "n_readings": len(readings),
            "n_poses": poses,
            "elements": readings.m,
            "loads": loads,
            "targets": targets,
            "covariance": parts,
            "notes": list(notes),
            "description": None
            if wrong is None
            else description_words.document(wrong, cell, readings),
            "other_arm": None if other is None else other.to_json(),
            "frames": None if registered is None else frames_document.document(registered),
        }
    )


def _registered(cell: Cell, readings: Readings) -> Registration | None:
    """Return the registration; None where the readings do not determine it."""
    try:
        return register(cell, readings)
    except CannotAnswerError:
        return None


def _targets(cell: Cell, readings: Readings) -> list[dict[str, Any]]:
    """Name, number of readings and whether the offset is known, of several targets."""
    if readings.states.target is None:
        return []
    count = np.bincount(readings.target, minlength=len(readings.target_names))
    known = cell.known_targets
    return [
        {"name": name, "n_readings": int(count[k]), "known": known[k]}
        for k, name in enumerate(readings.target_names)
    ]


def export(
    run: Run,
    table: Annotated[
        Path | None, typer.Option("--table", metavar="F.csv", help="The readings, SI units.")
    ] = None,
    parameters: Annotated[
        Path | None,
        typer.Option("--parameters", metavar="F.csv", help="Parameters of the model."),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            metavar="F.json",
            help="The identified arm, ready for compensate on any machine.",
        ),
    ] = None,
    urdf: Annotated[
        Path | None,
        typer.Option("--urdf", metavar="F.urdf", help="The arm with its corrected geometry."),
    ] = None,
    ur_kinematics: Annotated[
        Path | None,
        typer.Option("--ur-kinematics", metavar="F.yaml", help="The same for UR's ROS driver."),
    ] = None,
    frames: Annotated[
        Path | None,
        typer.Option("--frames", metavar="F.json", help="Tool and base as fitted, m and rad."),
    ] = None,
    revision: Revision = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing files.")] = False,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Write readings and parameters as CSV, the calibration as JSON."""
    t = terminal(as_json)
    geometry = {"urdf": urdf, "ur-kinematics": ur_kinematics, "frames": frames}
    of_model = [parameters, calibration, *geometry.values()]
    wanted = [path for path in (table, *of_model) if path is not None]
    if not wanted:
        raise InputError(
            "nothing to export; give --table F.csv, --parameters F.csv, --calibration F.json, "
            "--urdf F.urdf, --ur-kinematics F.yaml or --frames F.json"
        )
    for path in wanted:
        if path.exists() and not force:
            raise InputError(f"{path}: the file exists; choose another name or give --force")
    if revision is not None and not any(of_model):
        raise InputError("--revision is about the model; give --parameters or --calibration, too")
    with Campaign.open(run, catalogue_with(effects_from), read_only=True) as opened_run:
        record = opened_run.in_use(revision)
        if parameters is not None and record is None:
            raise InputError(f"{run}: no revision yet, so no parameters; run hilcal identify first")
        if table is not None:
            write_table(opened_run.readings, table, opened_run.covers)
            t.show(f"{table}: {len(opened_run.readings)} readings")
        if parameters is not None and record is not None:
            rows = record.result_json["identify"]["parameters"]
            _write_parameters(parameters, rows)
            t.show(f"{parameters}: {len(rows)} parameters of revision {record.number}")
        if calibration is not None or any(geometry.values()):
            with working(t.progress) as say:
                say("restoring the fit, and what it knows of other readings")
                found = opened_run.calibration(revision)
            if calibration is not None:
                found.save(calibration)
                t.show(f"{calibration}: the calibration of revision {found.source['revision']}")
            t.show(_write_geometry(found, geometry))
    t.document({"written": [str(path) for path in wanted]})


def _write_geometry(found: Calibration, wanted: Mapping[str, Path | None]) -> Iterator[str]:
    """Write the corrected geometry in the forms that are wanted; yields what was written."""
    paths = {form: path for form, path in wanted.items() if path is not None}
    if not paths:
        return
    arm = corrected(found)
    nominal, beyond = found.model.cell.arm, None
    note = f"{nominal.name} as calibrated with hilcal, {found.source['campaign']}"
    texts = {}
    if "ur-kinematics" in paths:
        texts["ur-kinematics"], beyond = ur_kinematics_file(nominal, arm.arm)
    if "urdf" in paths:
        texts["urdf"] = urdf_file(arm.arm, note)
    if "frames" in paths:
        texts["frames"] = frames_file(found, arm, beyond)
    for form, path in paths.items():
        try:
            path.write_text(texts[form], encoding="utf-8")
        except OSError as e:
            raise InputError(f"{path}: cannot be written ({e.strerror})") from None
        yield f"{path}: {form} with {', '.join(arm.within) or 'the nominal geometry'}"
    if arm.beyond:
        yield f"Not in it, since not constant: {', '.join(arm.beyond)}; hilcal compensate has it"


def _write_parameters(path: Path, rows: Sequence[dict[str, object]]) -> None:
    names = ("name", "value", "std", "unit", "identifiable")
    try:
        with path.open("w", encoding="utf-8", newline="") as stream:
            out = csv.writer(stream, lineterminator="\n")
            out.writerow(names)
            for row in rows:
                out.writerow("" if row[k] is None else row[k] for k in names)
    except OSError as e:
        raise InputError(f"{path}: cannot be written ({e.strerror})") from e
