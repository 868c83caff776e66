"""Tables with several targets side by side, as one row per target."""

import numpy as np

from hilcal.tables.grid import Cell, Grid
from hilcal.tables.mapping import Mapping
from hilcal.tables.mapping_sections import Column, Name, Position

TARGET = "target of [position]"


def one_target_per_row(grid: Grid, mapping: Mapping) -> tuple[Grid, Mapping]:
    """Return the table with a row for each target, and the mapping that reads it.

    Row i with the columns x1 y1 z1 x2 y2 z2 becomes two rows, in this order; all other cells are
    repeated. Nothing changes where the mapping has no `targets`.

    Raises:
        InputError: no such column.
    """
    names = mapping.position.targets
    if not names:
        return grid, mapping
    count = len(names)
    blocks: list[tuple[Column, ...]] = [mapping.position.columns]
    wide_std = mapping.std is not None and len(mapping.std.columns) == 3 * count
    if mapping.std is not None and wide_std:
        blocks.append(mapping.std.columns)
    rows = np.repeat(grid.rows, count)
    columns: list[list[Cell]] = [[cell for cell in cells for _ in names] for cells in grid.columns]
    titles, formats = list(grid.names), list(grid.formats)
    new: list[tuple[str, str, str]] = []
    for block in blocks:
        axes: list[str] = []
        for axis in range(3):
            sources = [grid.name(block[3 * k + axis]) for k in range(count)]
            cells = [grid.cells(name) for name in sources]
            columns.append([c[i] for i in range(len(grid.rows)) for c in cells])
            axes.append("/".join(sources))
            titles.append(axes[-1])
            formats.append(grid.formats[grid.names.index(sources[0])])
        new.append((axes[0], axes[1], axes[2]))
    columns.append([*names] * len(grid.rows))
    titles.append(TARGET)
    formats.append(mapping.file)
    tall = Grid(grid.path, tuple(titles), rows, tuple(columns), tuple(formats), grid.units)
    update: dict[str, object] = {
        "position": Position(columns=new[0], unit=mapping.position.unit),
        "target": Name(column=TARGET),
    }
    if mapping.std is not None and wide_std:
        update["std"] = mapping.std.model_copy(update={"columns": new[1]})
    return tall, mapping.model_copy(update=update)
