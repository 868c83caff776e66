"""Opening one or two files whose form is unknown, and proposing a mapping for them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.tables.grid import Grid, joined
from hilcal.tables.guessing.guess import guess
from hilcal.tables.guessing.proposal import Proposal
from hilcal.tables.guessing.sniff import sniff


@dataclass(frozen=True, slots=True, eq=False)
class Proposed:
    """A table and a proposed mapping for it."""

    grid: Grid
    proposal: Proposal


@limits.bounded
def propose(path: Path, second: Path | None = None, joints: int | None = None) -> Proposed:
    """Look at a table and propose a mapping.

    Args:
        path: the table.
        second: a second file that holds the other columns of the same readings.
        joints: number of the arm's joints, where it is known.

    Raises:
        InputError: a file that cannot be read, or two that do not belong together.
    """
    first = sniff(path)
    grid, doubts = first.grid, [("file", words) for words in first.doubts]
    other: dict[str, Any] | None = None
    if second is not None:
        found = sniff(second)
        match = _match(grid, found.grid)
        grid, lost = joined(grid, found.grid, match)
        other = {"path": str(second), **found.how}
        doubts += [("second_file", words) for words in found.doubts]
        if match is not None:
            other["match"] = list(match)
            doubts.append(("second_file", f"rows are matched by '{match[0]}' and '{match[1]}'"))
        if lost:
            doubts.append(("second_file", f"{lost} rows of the first file have no partner"))
    proposal = guess(grid, joints)
    file = {**first.how, **proposal.sections.pop("file", {})}
    head: dict[str, dict[str, Any]] = {"file": file} if file else {}
    if other is not None:
        head["second_file"] = other
    proposal.sections = head | proposal.sections
    proposal.unsure[:0] = doubts
    return Proposed(grid, proposal)


def _match(first: Grid, second: Grid) -> tuple[str, str] | None:
    """Columns that name the rows of two tables; None where they belong together row by row.

    Raises:
        InputError: tables of different length without such columns.
    """
    best: tuple[int, str, str] | None = None
    for here in first.names:
        texts = first.text(here)
        for there in second.names:
            keys = second.text(there)
            if len(set(keys)) < len(keys) or "" in keys or not _is_key(keys):
                continue
            shared = sum(t in set(keys) for t in texts)
            if shared > 0.8 * len(texts) and (best is None or shared > best[0]):
                best = shared, here, there
    if best is not None:
        _, here, there = best
        same = first.text(here) == second.text(there)
        if same or len(first.rows) != len(second.rows) or here == there:
            return here, there
    if len(first.rows) == len(second.rows):
        return None
    raise InputError(
        f"{second.path}: {len(second.rows)} rows, {first.path} has {len(first.rows)}, and no "
        f"column of both names the row"
    )


def _is_key(keys: list[str]) -> bool:
    """Whether texts name rows: words, or whole numbers."""
    try:
        numbers = np.array([float(k) for k in keys])
    except ValueError:
        return True
    return bool(np.all(numbers == np.rint(numbers)))
