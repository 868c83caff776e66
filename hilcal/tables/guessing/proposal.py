"""A proposed mapping: what was understood of a table, what is unsure, what was not used."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.tables.grid import Grid
from hilcal.tables.guessing.column_names import parse
from hilcal.tables.mapping import M
from hilcal.toml import check_section
from hilcal.types import Floats

TURN = 2 * np.pi + 0.1
"""rad; a larger angle is in degrees."""
FAR = 50.0
"""A position beyond this number is in millimetres: no arm is measured from 50 m."""
GUESSED = "the convention is a guess; --config CELL.toml lets the arm decide"
SIDE_BY_SIDE = "several targets: name them as in the cell's [[tool.targets]]"
REPORTED = 5e-3
"""rad; encoders at rest in one pose differ by less, commanded poses by more; a choice."""
FEWEST_JOINTS, MOST_JOINTS = 4, 8
SHOWN = 3


@dataclass(frozen=True, slots=True)
class UnderstoodColumn:
    """One thing that the table holds."""

    what: str  # section of the mapping
    columns: tuple[str, ...]
    meaning: str  # unit and convention
    example: tuple[str, ...]  # the cells of the first reading


@dataclass(slots=True, eq=False)
class Proposal:
    """A mapping in the making.

    Attributes:
        unsure: sentences on what should be checked, by section.
        unused: columns without a meaning, with the reason.
        lacking: sentences on what an import needs and was not found.
        alternatives: columns of the position and of the joints that are as good by their values,
            the chosen ones first; empty lists where names tell.
    """

    sections: dict[str, dict[str, Any]] = field(default_factory=dict)  # of the mapping, by name
    understood: list[UnderstoodColumn] = field(default_factory=list)  # what the table holds
    unsure: list[tuple[str, str]] = field(default_factory=list)
    unused: list[tuple[str, str]] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)
    open_convention: bool = False  # whether the orientation's convention is a guess
    alternatives: list[tuple[list[str], list[str]]] = field(default_factory=list)

    def mapping(self, kind: type[M]) -> M:
        """Return the mapping, `Mapping` for readings, `PointMapping` for points."""
        return check_section(self.sections, kind, "the proposed mapping")

    def to_toml(self, source: str) -> str:
        """Return the mapping file, with what is unsure as comments."""
        lines = [
            f"# How to read {source}; proposed by `hilcal import --preview`. Check what is",
            "# marked, change what is wrong, and give this file with --format.",
        ]
        lines += [f"# missing: {what}" for what in self.lacking]
        absent = [(about, words) for about, words in self.unsure if about not in self.sections]
        lines += [f"# {about}: {words}" for about, words in absent]
        for name, section in self.sections.items():
            lines.append("")
            lines += [f"# check: {words}" for about, words in self.unsure if about == name]
            lines.append(f"[{name}]")
            lines += [f"{key} = {_value(value)}" for key, value in section.items()]
        if self.unused:
            lines += ["", "# not used:"]
            lines += [f"#   {name} ({why})" for name, why in self.unused]
        return "\n".join(map(escaped, lines)) + "\n"


def _value(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + escaped(value).replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    return repr(value)


class Guesser:
    """Columns that are not yet used, and the mapping that grows."""

    def __init__(self, grid: Grid, joints: int | None) -> None:
        """Take the table apart."""
        self.grid = grid
        self.joints = joints
        self.columns = [parse(name, grid.units.get(name, "")) for name in grid.names]
        self.proposal = Proposal()
        self.free = dict(zip(grid.names, self.columns, strict=True))
        self.values: dict[str, Floats | None] = {name: self._numbers(name) for name in grid.names}

    def _numbers(self, name: str) -> Floats | None:
        try:
            values = self.grid.numbers(name)
        except InputError:
            return None
        return values if np.isfinite(values).any() else None

    def number(self, name: str) -> bool:
        """Whether a column holds numbers."""
        return self.values[name] is not None

    def block(self, names: Iterable[str]) -> Floats:
        """(N, k) numbers of columns."""
        nothing = np.full(len(self.grid.rows), np.nan)
        given = (self.values[name] for name in names)
        return np.stack([nothing if v is None else v for v in given], axis=1)

    def take(self, what: str, names: Sequence[str], meaning: str, **section: object) -> None:
        """Give columns a meaning."""
        key = "column" if "column" in section else "columns"
        section = {key: names[0] if key == "column" else list(names)} | section
        self.proposal.sections[what] = section
        examples = tuple(self.grid.text(name)[0] for name in names)
        self.proposal.understood.append(UnderstoodColumn(what, tuple(names), meaning, examples))
        for name in names:
            self.free.pop(name, None)

    def unsure(self, about: str, sentence: str) -> None:
        """Note what should be checked."""
        self.proposal.unsure.append((about, sentence))

    def drop(self, name: str, why: str) -> None:
        """Leave a column unused."""
        if self.free.pop(name, None) is not None:
            self.proposal.unused.append((name, why))

    def unit(self, names: Sequence[str]) -> str | None:
        """Return the unit that the names of columns, or the row of units, state."""
        found = {self.columns[self.grid.names.index(name)].unit for name in names}
        return found.pop() if len(found) == 1 else None


def angle_unit(g: Guesser, what: str, names: Sequence[str]) -> str:
    """Return the unit of angles by name, else by size."""
    stated = g.unit(names)
    largest = float(np.nanmax(np.abs(g.block(names))))
    if stated in ("rad", "mrad", "deg", "arcsec"):
        if stated == "rad" and largest > TURN:
            g.unsure(what, f"named rad, but up to {largest:.4g}: read as degrees")
            return "deg"
        return stated
    if largest > TURN:
        return "deg"
    g.unsure(what, f"no unit stated; rad, since no angle exceeds {largest:.3g}")
    return "rad"


def length_unit(g: Guesser, what: str, names: Sequence[str]) -> str:
    """Return the unit of positions by name, else by size."""
    stated = g.unit(names)
    if stated in ("m", "mm", "um", "in"):
        return stated
    largest = float(np.nanmax(np.abs(g.block(names))))
    unit = "mm" if largest > FAR else "m"
    g.unsure(what, f"no unit stated; {unit}, since the largest is {largest:.4g}")
    return unit
