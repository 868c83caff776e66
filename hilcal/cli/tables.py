"""`import`: tables in; with `--preview` a proposal how a table is to be read."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from hilcal.cell import Cell
from hilcal.cli.options import Force, Json, argument, check_new, option
from hilcal.cli.terminal import Terminal, terminal
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.misdescription import examine, other_arm
from hilcal.identification.registration import Registration, register
from hilcal.identification.table_preview import preview_table
from hilcal.identification.torques import check_torques
from hilcal.import_campaign import import_campaign
from hilcal.present.campaign import import_preview
from hilcal.present.document import Words, heading
from hilcal.present.fit import target_words
from hilcal.present.progress import working
from hilcal.present.registration import (
    covariance_words,
    observed_words,
    other_arm_line,
    registration_lines,
    torque_lines,
)
from hilcal.readings.readings import Readings
from hilcal.tables.guessing.proposal import Proposal
from hilcal.whole_file import replace_file


def import_(
    table: Annotated[Path, argument("TABLE", "What was measured.")],
    config: Annotated[
        Path | None, option("--config CELL.toml", "The cell it was measured in.")
    ] = None,
    output: Annotated[
        Path | None,
        option(
            "-o --output RUN.hilcal", "The campaign file to make; with --preview, the mapping file."
        ),
    ] = None,
    kind: Annotated[
        str,
        option(
            "--format FORMAT",
            "table, ipa-ur10, a mapping that comes with the program, or a mapping file.",
        ),
    ] = "table",
    second: Annotated[
        Path | None, option("--second TABLE", "The second file, e.g. of the joints.")
    ] = None,
    preview: Annotated[
        bool, option("--preview", "Show how the table could be read; make no campaign.")
    ] = False,
    force: Force = False,
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
    with working(t.progress) as say:
        found = import_campaign(table, config, output, kind, second, overwrite=force, say=say)
    readings, settings, cell, noise = found.readings, found.config, found.cell, found.noise
    notes = (*found.notes, covariance_words(found.parts, noise), *cell.arm.notes)
    loads = [readings.load_names[k] for k in np.unique(readings.load)]
    poses = len(np.unique(readings.pose))
    t.show(heading(f"{len(readings)} readings of {poses} poses"))
    t.show(f"  robot {settings.robot.model}; {_kind(readings)}\n  loads: {', '.join(loads)}")
    targets = _targets(cell, readings)
    if targets:
        t.show("  targets: " + "; ".join(target_words(**x) for x in targets))
    t.show(Words(note, indent=2) for note in notes)
    torques = check_torques(cell, readings)
    t.show(Words(line, indent=2) for line in torque_lines(torques))
    registered = _registered(cell, readings)
    wrong = None if registered is None else examine(registered, readings)
    if registered is not None and not (wrong is not None and wrong.refused):
        t.show(Words(line, indent=2) for line in registration_lines(registered))
    refused = wrong is not None and wrong.refused
    other = None if registered is None or refused else other_arm(registered, readings)
    if other is not None:
        t.show(Words(f"Note: {other_arm_line(other)}", indent=2))
    if wrong is not None:
        said = wrong.words(cell, readings)
        begin = "Nothing can be fitted yet" if wrong.refused else "Note"
        t.show(Words(f"{begin}: {said}.", indent=2))
    t.document(
        {
            "campaign": str(output),
            "robot": settings.robot.model,
            "n_readings": len(readings),
            "n_poses": poses,
            "elements": readings.m,
            "loads": loads,
            "targets": targets,
            "observers": [str(name) for name in readings.observers],
            "covariance": found.parts,
            "noise": None if noise is None else asdict(noise),
            "notes": list(notes),
            "description": None if wrong is None else wrong.to_json(cell, readings),
            "other_arm": None if other is None else other.to_json(),
            "torques": None if torques is None else torques.to_json(),
            "frames": None if registered is None else registered.to_json(),
        }
    )


def _kind(readings: Readings) -> str:
    if readings.observers:
        return observed_words(readings)
    return f"each reading is a position{'' if readings.m == 3 else ' and an orientation'}"


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


def show_preview(
    t: Terminal, table: Path, second: Path | None, config: Path | None, output: Path | None,
    force: bool,
) -> None:  # fmt: skip
    """Print what a table seems to hold; write the mapping file where one is asked for.

    Raises:
        InputError: a file that cannot be read, or an output that exists.
    """
    if output is not None and output.suffix != ".toml":
        raise InputError(f"-o {output}: --preview writes a mapping file; name it like mapping.toml")
    if output is not None:
        check_new(output, force)
    found = preview_table(table, None if config is None else Cell.load(config), second)
    proposal, outcome = found.proposal, found.outcome
    t.show(import_preview(proposal, found.rows, table.name))
    if outcome:
        t.show(heading("with this mapping:"))
        t.show(Words(words, indent=2) for words in outcome)
    if output is not None:
        if second is not None:
            _relative_second(proposal, output)
        replace_file(output, proposal.to_toml(table.name))
        t.notice(f"{output}: the mapping; import with --format {output}")
    else:
        t.notice("nothing was written; -o mapping.toml keeps this as a mapping to edit")
    t.document(
        {
            "mapping": proposal.sections,
            "understood": [
                {"section": u.what, "columns": u.columns, "meaning": u.meaning, "first": u.example}
                for u in proposal.understood
            ],
            "unsure": [{"section": what, "what": words} for what, words in proposal.unsure],
            "unused": [{"column": name, "why": why} for name, why in proposal.unused],
            "missing": proposal.lacking,
            "outcome": outcome,
            "written": None if output is None else str(output),
        }
    )


def _relative_second(proposal: Proposal, output: Path) -> None:
    """Write the second file's path relative to the mapping file."""
    section = proposal.sections["second_file"]
    section["path"] = str(Path(section["path"]).absolute())
    here = output.absolute().parent
    if Path(section["path"]).is_relative_to(here):
        section["path"] = str(Path(section["path"]).relative_to(here))
