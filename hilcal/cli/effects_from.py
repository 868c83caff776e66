"""`--effects-from FILE.py`: effects of a user's own, and where a campaign's came from."""

from pathlib import Path
from typing import Annotated

import typer

from hilcal.effects.catalogue import Catalogue, installed

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
