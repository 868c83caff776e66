"""`--effects-from FILE.py`: effects of a user's own, and where a campaign's came from."""

from pathlib import Path
from typing import Annotated

import typer

from hilcal.data.revision import RevisionRecord
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError
from hilcal.model import Model

SOURCES = "effects_from"
"""Key among the options of a revision: the files that its effects were from."""

EffectsFrom = Annotated[
    list[Path] | None,
    typer.Option(
        "--effects-from",
        metavar="FILE.py",
        help="Effects of your own, see hilcal effects new; repeatable.",
    ),
]


def catalogue_with(paths: list[Path] | None) -> Catalogue:
    """Return the installed effects and those of files.

    Raises:
        InputError: a file, or an effect in it, that cannot be used.
    """
    found = installed()
    for path in paths or ():
        found = found.with_file(path)
    return found


def sources(model: Model) -> dict[str, dict[str, str]]:
    """Return file and hash of those effects that are from files, to be kept in a revision."""
    found = {name: model.catalogue.file_of(name) for name in model.names}
    return {
        name: {"file": file.path, "sha256": file.sha256}
        for name, file in found.items()
        if file is not None
    }


def check_sources(record: RevisionRecord, run: Path, catalogue: Catalogue) -> None:
    """Refuse a revision whose effects are not at hand as they were when it was fitted.

    Raises:
        InputError: an effect is not in the catalogue, or its file has changed since.
    """
    stored = record.options.get(SOURCES, {})
    for name in record.effects:
        then, now = stored.get(name), catalogue.file_of(name)
        if name not in catalogue.names:
            where = f"--effects-from {then['file']}" if then else "--effects-from FILE.py"
            raise InputError(
                f"{run}: revision {record.number} has the effect {name}, which is not in the "
                f"catalogue; give the file that defines it: {where}"
            )
        if then and now and then["sha256"] != now.sha256:
            raise InputError(
                f"{run}: revision {record.number} was fitted with another {name}: {now.path} is "
                "not what it was then; fit again: hilcal identify or refine"
            )
