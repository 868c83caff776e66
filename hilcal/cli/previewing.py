"""`import --preview`: propose how a table is to be read."""

from pathlib import Path

from hilcal.cell import Cell
from hilcal.cli.terminal import Terminal
from hilcal.errors import InputError
from hilcal.identification.table_preview import preview_table
from hilcal.present.document import Words, heading
from hilcal.present.preparing import import_preview
from hilcal.tables.guessing.proposal import Proposal
from hilcal.whole_file import replace_file


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
    if output is not None and output.exists() and not force:
        raise InputError(f"{output}: the file exists; choose another name or give --force")
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
