"""`config`: every key of CELL.toml."""

from typing import Annotated

from drivers.geocom import Options as GeoComOptions
from drivers.ur_link.options import UrOptions
from hilcal.cli.options import Json, argument
from hilcal.cli.terminal import terminal
from hilcal.config import reference
from hilcal.present import text_config
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
        t.show(text_config.overview(known))
        t.document(text_config.to_json(known))
        return
    found = reference.table(section, known)
    t.show(text_config.section(found))
    t.document(text_config.to_json((found,)))


def write_page(path: str = "docs/reference/cell-configuration.md") -> None:
    """Write the page of the reference."""
    replace_file(path, text_config.page(reference.tables(DRIVERS_OWN)))
