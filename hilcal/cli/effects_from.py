"""`--effects-from FILE.py`: effects of a user's own, and where a campaign's came from."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from hilcal.data.revision import RevisionRecord
from hilcal.effects.added import add, file_of
from hilcal.effects.catalogue import catalogue
from hilcal.effects.from_file import read_effects
from hilcal.errors import InputError

SOURCES = "effects_from"
"""Key among the options of a revision: the files that its effects were from."""


def _take(paths: list[Path] | None) -> list[Path] | None:
    """Put the effects of files into the catalogue, before the command begins."""
    for path in paths or ():
        add(read_effects(path))
    return paths


EffectsFrom = Annotated[
    list[Path] | None,
    typer.Option(
        "--effects-from",
        metavar="FILE.py",
        callback=_take,
        help="Effects of your own, see hilcal effects new; repeatable.",
    ),
]


def sources(effects: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return file and hash of those effects that are from files, to be kept in a revision."""
    found = {name: file_of(name) for name in effects}
    return {
        name: {"file": file.path, "sha256": file.sha256}
        for name, file in found.items()
        if file is not None
    }


def check_sources(record: RevisionRecord, run: Path) -> None:
    """Refuse a revision whose effects are not at hand as they were when it was fitted.

    Raises:
        InputError: an effect is not in the catalogue, or its file has changed since.
    """
    known, stored = catalogue(), record.options.get(SOURCES, {})
    for name in record.effects:
        then, now = stored.get(name), file_of(name)
        if name not in known:
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
