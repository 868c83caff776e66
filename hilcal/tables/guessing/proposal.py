"""A proposed mapping: what was understood of a table, what is unsure, what was not used."""

from dataclasses import dataclass, field
from typing import Any

from hilcal.names import escaped
from hilcal.tables.mapping import Mapping
from hilcal.toml import check_section


@dataclass(frozen=True, slots=True)
class Understood:
    """One thing that the table holds.

    Attributes:
        what: section of the mapping.
        columns: names of its columns.
        meaning: unit and convention.
        example: the cells of the first reading.
    """

    what: str
    columns: tuple[str, ...]
    meaning: str
    example: tuple[str, ...]


@dataclass(slots=True, eq=False)
class Proposal:
    """A mapping in the making.

    Attributes:
        sections: of the mapping, by name.
        understood: what the table holds.
        unsure: sentences on what should be checked, by section.
        unused: columns without a meaning, with the reason.
        lacking: sentences on what an import needs and was not found.
        open_convention: whether the orientation's convention is a guess.
        alternatives: columns of the position and of the joints that are as good by their values,
            the chosen ones first; empty lists where names tell.
    """

    sections: dict[str, dict[str, Any]] = field(default_factory=dict)
    understood: list[Understood] = field(default_factory=list)
    unsure: list[tuple[str, str]] = field(default_factory=list)
    unused: list[tuple[str, str]] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)
    open_convention: bool = False
    alternatives: list[tuple[list[str], list[str]]] = field(default_factory=list)

    def mapping(self) -> Mapping:
        """Return the mapping.

        Raises:
            InputError: it is not complete.
        """
        return check_section(self.sections, Mapping, "the proposed mapping")

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
