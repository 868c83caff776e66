"""`import`, `info`, `accept`, `repair`, `fleet`: campaign files, and which revision is used."""

from contextlib import suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.campaign.campaign import estimated_noise
from hilcal.cell import Cell, cell_from_config
from hilcal.cli.options import check_new, command
from hilcal.cli.terminal import Terminal
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.noise.full_covariance import covariance_parts
from hilcal.identification.registration.misdescription import examine, other_arm
from hilcal.identification.registration.registration import register
from hilcal.identification.registration.table_preview import preview_table
from hilcal.identification.torques import check_torques
from hilcal.names import quoted
from hilcal.present import registration as words
from hilcal.present.campaign import import_preview, info_report
from hilcal.present.document import Words, heading
from hilcal.present.fit import model_name
from hilcal.present.progress import counting, working
from hilcal.readings.covariance import COVERS_KEY
from hilcal.readings.readings import Readings
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.overview import overview, to_json
from hilcal.store.repair import put_robot
from hilcal.store.repair import repair as repaired
from hilcal.store.revision import RevisionRecord
from hilcal.store.stored_texts import CALIBRATION_FILE, ROBOT_FILE, check_robot
from hilcal.whole_file import PAGE, replace_file, spare_other


@command("""
    tables | TABLE | The table of readings, one file.
    config | --config CELL.toml | The cell in which it was measured.
    output | -o --output RUN.hilcal | The campaign file to write; with --preview, the mapping file.
    kind | --format FORMAT | Format of the table: table, ipa-ur10, another mapping of the program,
        or a mapping file.
    second | --second TABLE | A second file of the same readings, e.g. with the joint values.
    preview | --preview | Propose a mapping of the columns; no campaign is written.
    """)
def import_(
    t: Terminal, tables: list[Path], config: Path | None = None, output: Path | None = None,
    kind: str = "table", second: Path | None = None, preview: bool = False, force: bool = False,
) -> None:  # fmt: skip
    """Make a campaign file from a table of readings."""
    table = _one_file(tables)
    if preview:
        if kind != "table":
            raise InputError(f"--preview proposes a mapping; leave out --format {kind}")
        show_preview(t, table, second, config, output, force)
        return
    if config is None or output is None:
        missing = "--config CELL.toml" if config is None else "-o RUN.hilcal"
        raise InputError(f"{missing} is missing; without it only --preview is possible")
    check_new(output, force)
    from hilcal.library import import_campaign  # imports the whole library

    with working(t.progress) as say:
        imported = import_campaign(table, config, output, kind, second, overwrite=force, say=say)
    readings, cell, noise = imported.readings, imported.cell, imported.noise
    model = imported.config.robot.model
    notes = (*imported.notes, words.covariance_words(imported.parts, noise), *cell.arm.notes)
    loads = [readings.load_names[k] for k in np.unique(readings.load)]
    poses = len(np.unique(readings.pose))
    kind = f"each reading is a position{'' if readings.m == 3 else ' and an orientation'}"
    kind = words.observed_words(readings) if readings.observers else kind
    t.show(heading(f"{len(readings)} readings of {poses} poses"))
    t.show(f"  robot {model}; {kind}\n  loads: {', '.join(loads)}")
    targets = _targets(cell, readings)
    if targets:
        offset = {True: "known", False: "estimated"}
        named = (
            f"{x['name']} ({x['n_readings']} readings, offset {offset[x['known']]})"
            for x in targets
        )
        t.show(f"  targets: {'; '.join(named)}")
    torques = check_torques(cell, readings)
    registered = misdescription = likely_arm = None
    lines = [*notes, *words.torque_lines(torques)]
    with suppress(CannotAnswerError):  # the readings do not determine the registration
        registered = register(cell, readings)
    if registered is not None:
        misdescription = examine(registered, readings)
        if misdescription is None or not misdescription.refused:
            lines += words.registration_lines(registered)
            likely_arm = other_arm(registered, readings)
    if likely_arm is not None:
        lines.append(f"Note: {words.other_arm_line(likely_arm)}")
    if misdescription is not None:
        begin = "No model can be fitted yet" if misdescription.refused else "Note"
        lines.append(f"{begin}: {misdescription.words(cell, readings)}.")
    t.show(Words(line, indent=2) for line in lines)
    t.document(
        campaign=str(output),
        robot=model,
        n_readings=len(readings),
        n_poses=poses,
        elements=readings.m,
        loads=loads,
        targets=targets,
        observers=[str(name) for name in readings.observers],
        covariance=imported.parts,
        noise=None if noise is None else asdict(noise),
        notes=list(notes),
        description=None if misdescription is None else misdescription.to_json(cell, readings),
        computed_positions=misdescription is not None
        and (misdescription.computed or misdescription.too_exact),
        other_arm=None if likely_arm is None else likely_arm.to_json(),
        torques=None if torques is None else torques.to_json(),
        frames=None if registered is None else registered.to_json(),
    )


def _one_file(tables: list[Path]) -> Path:
    """Return the only file; of several, or a folder of such, say how to join them."""
    if len(tables) == 1 and not tables[0].is_dir():
        return tables[0]
    if tables[0].is_dir():
        suffixes = sorted(path.suffix for path in tables[0].iterdir() if path.is_file())
        of = [f"{quoted(tables[0])}/*{suffixes[0] if suffixes else '.csv'}"]
        said = f"{tables[0]}: a folder"
    else:
        of, said = [quoted(path) for path in tables], f"{len(tables)} files"
    raise InputError(
        f"{said}; valid: one table. Files of the same columns are joined, and each row named by "
        'its file, with: awk \'FNR > 1 || NR == 1 { print (NR == 1 ? "pose" : FILENAME) '
        f'"," $0 }}\' {" ".join(of)} > all.csv'
    )


def _targets(cell: Cell, readings: Readings) -> list[dict[str, Any]]:
    """Return name, number of readings and whether the offset is known, of several targets."""
    if readings.states.target is None:
        return []
    count = np.bincount(readings.target, minlength=len(readings.target_names))
    return [
        {"name": name, "n_readings": int(count[k]), "known": cell.known_targets[k]}
        for k, name in enumerate(readings.target_names)
    ]


def show_preview(
    t: Terminal, table: Path, second: Path | None, config: Path | None, output: Path | None,
    force: bool,
) -> None:  # fmt: skip
    """Print the proposed mapping of a table; write it to the mapping file `output`."""
    if output is not None and output.suffix != ".toml":
        raise InputError(f"-o {output}: --preview writes a mapping file; name it like mapping.toml")
    if output is not None:
        check_new(output, force)
    preview = preview_table(table, None if config is None else Cell.load(config), second)
    proposal, outcome = preview.proposal, preview.outcome
    t.show(import_preview(proposal, preview.rows, table.name))
    if outcome:
        t.show(heading("with this mapping:"))
        t.show(Words(line, indent=2) for line in outcome)
    if output is not None:
        if second is not None:  # its path is relative to the mapping file
            path, folder = second.absolute(), output.absolute().parent
            path = path.relative_to(folder) if path.is_relative_to(folder) else path
            proposal.sections["second_file"]["path"] = str(path)
        replace_file(output, proposal.to_toml(table.name))
        t.notice(f"{output}: the mapping; import with --format {output}")
    else:
        t.notice("nothing was written; -o mapping.toml writes this mapping to a file")
    t.document(
        mapping=proposal.sections,
        understood=[
            {"section": u.section, "columns": u.columns, "meaning": u.meaning, "first": u.example}
            for u in proposal.quantities
        ],
        unsure=[{"section": what, "what": line} for what, line in proposal.doubts],
        unused=[{"column": name, "why": why} for name, why in proposal.unused],
        missing=proposal.missing,
        outcome=outcome,
        written=None if output is None else str(output),
    )


@command()
def info(t: Terminal, run: Path) -> None:
    """List the contents of a campaign: readings, instruments, drift, events, revisions."""
    with CampaignFile.open(run, read_only=True) as file:
        content = overview(file)
        parts = covariance_parts(file.about(COVERS_KEY), content.config)
        noise = estimated_noise(file)
        robot_texts = file.about(ROBOT_FILE), file.about(CALIBRATION_FILE)
        check_robot(run, file.config_json, *robot_texts)
        cell = cell_from_config(content.config, None, *robot_texts)
    torques = None if content.readings is None else check_torques(cell, content.readings)
    t.show(info_report(content, run.name, words.covariance_words(parts, noise)))
    t.show(words.torque_lines(torques))
    extra = {} if torques is None else {"torques": torques.to_json()}
    t.document(to_json(content, str(run), parts), **extra)


@command("""
    number | N | The revision; default: the latest one.
    release | --release | Accept no revision: commands use the latest one again.
    """)
def accept(t: Terminal, run: Path, number: int | None = None, release: bool = False) -> None:
    """Choose the revision that every command uses, even if later ones are added."""
    if release and number is not None:
        raise InputError("--release accepts no revision; leave out the number")
    with CampaignFile.open(run) as file:
        records = file.revisions()
        if not records:
            raise InputError(f"{run}: no revision yet; make one with hilcal identify or refine")
        chosen = None if release else file.revision(len(records) if number is None else number)
        file.accept(None if chosen is None else chosen.number)
    if chosen is None:
        t.show(f"No revision of {run} is accepted: the latest one is used, {_named(records[-1])}.")
    else:
        t.show(
            f"Accepted: {_named(chosen)}. Every command uses it unless --revision names "
            f"another; take it back with: hilcal accept {quoted(run)} --release"
        )
    used = records[-1] if chosen is None else chosen
    t.document(
        accepted=None if chosen is None else chosen.number,
        in_use=used.number,
        latest=records[-1].number,
    )


@command("""
    robot | --robot FILE | URDF or DH table of the robot, for a campaign that lacks it.
    """)
def repair(t: Terminal, run: Path, robot: Path | None = None) -> None:
    """Set aside a damaged revision, so that a campaign can be opened; its readings stay."""
    result = repaired(run)
    if robot is not None:
        put_robot(run, robot)
        t.show(f"The description of the robot, {robot}, is stored in {run}.")
    if result is None and robot is None:
        t.show(f"{run}: no revision is damaged; nothing was changed.")
    if result is not None:
        numbers = ", ".join(map(str, result.revisions))
        t.show(
            f"{run}: {result.defect}. Set aside: revision{'s' * (len(result.revisions) > 1)} "
            f"{numbers}. All readings are kept; {result.original} is the original file. To fit "
            "again:"
        )
        t.command(f"hilcal identify {quoted(run)}")
    t.document(
        set_aside=[] if result is None else list(result.revisions),
        original=None if result is None else str(result.original),
        robot=None if robot is None else str(robot),
    )


def _named(record: RevisionRecord) -> str:
    return f"revision {record.number} ({model_name(record.effects)})"


PRIOR = "the result of hilcal fleet"


@command("""
    directory | DIR | Folder with campaign files; its subfolders are searched, too.
    out | -o --output PRIOR.json | The prior for another arm of the type.
    report | --report F.html | Also write a report as one HTML page.
    """)
def fleet(
    t: Terminal, directory: Path, out: Path, report: Path | None = None, record: Path | None = None,
    workers: int | None = None, scheduler: str | None = None,
) -> None:  # fmt: skip
    """Pool many campaigns: a prior for other arms, arms that differ from their type, drift."""
    # these import the modules for fitting and reports
    from hilcal.cli.fitting import check_record
    from hilcal.cli.showing import open_command
    from hilcal.engine import open_engine
    from hilcal.identification.carried.posterior import FORMAT
    from hilcal.present.comparison import fleet_report
    from hilcal.store.codec import write_document
    from hilcal.transfer.fleet import fleet as pool_fleet
    from hilcal.transfer.fleet import to_json
    from hilcal.transfer.members import entries
    from hilcal.write_report import write_fleet_report

    check_record(record)
    spare_other(out, PRIOR, FORMAT)
    if report is not None:
        spare_other(report, "a page", PAGE)
    entries(directory)  # refuses a directory before workers are started
    with open_engine(workers, scheduler) as engine:
        pooled = pool_fleet(directory, engine, partial(counting, t.progress))
    t.show(fleet_report(pooled))
    written = {}
    for arm_type in pooled.types:
        path = out if len(pooled.types) == 1 else out.with_stem(f"{out.stem}-{arm_type.type}")
        spare_other(path, PRIOR, FORMAT)
        write_document(path, arm_type.prior.to_json())
        written[arm_type.type] = str(path)
        t.show(
            f"\n{path}: the prior for another {arm_type.type}; use it with --prior {quoted(path)}"
        )
    document = to_json(pooled, written)
    if report is not None:
        write_fleet_report(pooled, directory, report)
        t.show(f"{report}: the report")
        document["report"] = str(report)
    if record is not None:
        from hilcal.present.viewer.fleet import record_fleet  # loads the viewer's library

        record_fleet(pooled, record)
        t.notice(f"recorded {record}; open it with: {open_command(record)}")
        document["recording"] = str(record)
    t.document(document)
