"""`config`: every key of CELL.toml."""

from typing import Annotated

from drivers.geocom import Options as GeoComOptions
from drivers.ur_link.options import UrOptions
from hilcal.cli.options import Json, argument
from hilcal.cli.terminal import terminal
from hilcal.config import reference
from hilcal.present.preparing import (
    reference_page,
    section_report,
    sections_json,
    sections_overview,
)
from hilcal.toml import Section
from hilcal.whole_file import replace_file

DRIVERS_OWN: dict[str, type[Section]] = {
    "robot.options": UrOptions,
    "tracker.options": GeoComOptions,
}
"""Keys of the drivers that come with the program, by section."""


def config(
    section: Annotated[str | None, argument("SECTION", "One of them, e.g. tracker.")] = None,
    as_json: Json = False,
) -> None:
    """Explain the sections and keys of CELL.toml: unit, default, example."""
    t, known = terminal(as_json), reference.tables(DRIVERS_OWN)
    if section is None:
        t.show(sections_overview(known))
        t.document(sections_json(known))
        return
    found = reference.table(section, known)
    t.show(section_report(found))
    t.document(sections_json((found,)))


def write_page(path: str = "docs/reference/cell-configuration.md") -> None:
    """Write the page of the reference."""
    replace_file(path, reference_page(reference.tables(DRIVERS_OWN)))
