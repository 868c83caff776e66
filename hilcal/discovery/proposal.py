"""Laws that a refinement may add where no effect explains the rest, each an effect file of its own.

A proposed law is an effect like one that a user wrote: it is in the catalogue of the models that
come after it, by a file that later commands are given again (`--effects-from`). The files are
written at the end, those of laws that stayed; a file that exists is never replaced.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from hilcal.discovery.discovery import Discovery, discover
from hilcal.effects.from_file import effects_of
from hilcal.errors import InputError
from hilcal.identification.fit import Fit, fit
from hilcal.whole_file import replace_file

MOST_SEARCHES = 3  # Searches of one refinement at most; a choice, by time
NAME = "found"


class LawSearch:
    """Searches laws for one refinement, and keeps what it found.

    Attributes:
        found: the searches, in order.
        files: of laws that stayed, by name; see `write`.
    """

    def __init__(self, folder: Path, name: str = NAME, replacing: bool = False) -> None:
        """Laws are named after the files that they will be: found.py, found_2.py, ….

        replacing: whether files of these names are removed first, as those of a rehearsal that is
        repeated; else other names are taken.
        """
        if replacing:
            for k in range(1, MOST_SEARCHES + 1):
                (folder / f"{_numbered(name, k)}.py").unlink(missing_ok=True)
        self.found: list[Discovery] = []
        self.files: dict[str, Path] = {}
        self._folder, self._name = folder, name
        self._sources: dict[str, str] = {}

    def propose(self, of: Fit, say: Callable[[str], None]) -> tuple[Fit, str] | None:
        """Return the fit with a law, and the law's name; None where no law is proposed.

        A fit is searched once, and so many of a refinement at most.
        """
        if any(d.fit is of for d in self.found) or len(self.found) == MOST_SEARCHES:
            return None
        name = self._free(of)
        d = discover(of, say, name)
        self.found.append(d)
        if d.after is None:
            return None
        model, after = of.model, d.after
        where = self.path(name)
        file = effects_of(d.source.encode(), where)
        catalogue = model.catalogue.with_effects(*file.effects)
        catalogue = replace(catalogue, files=(*catalogue.files, file))
        made = catalogue.make(name, model.cell, of.readings.states, m=of.readings.m)
        grown = replace(model, effects=(*model.effects, made), catalogue=catalogue)
        self._sources[name] = d.source
        return fit(grown, of.readings, of.mode, of.scaling, after.theta), name

    def path(self, name: str) -> Path:
        """Return the file of a law."""
        return self._folder.absolute() / f"{name}.py"

    def write(self, names: tuple[str, ...]) -> None:
        """Write the files of those effects that are proposed laws."""
        for name in names:
            if name not in self._sources:
                continue
            where = self.path(name)
            replace_file(where, self._sources[name], must_be_new=True)
            self.files[name] = where

    def _free(self, of: Fit) -> str:
        taken = {*of.model.catalogue.names, *of.model.names, *self._sources}
        names = (_numbered(self._name, k) for k in range(1, 10_000))
        free = (n for n in names if n not in taken and not self.path(n).exists())
        try:
            return next(free)
        except StopIteration:
            raise InputError(f"{self._folder}: no free name for a law's file") from None


def _numbered(name: str, k: int) -> str:
    return name if k == 1 else f"{name}_{k}"
