"""`import --preview`: propose how a table is to be read."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.padding import Padding

from hilcal.cell import Cell, cell_from_config
from hilcal.cli.terminal import Terminal
from hilcal.config import CellConfig, load_config
from hilcal.data.guess_values import BY_VALUES, RIVALS
from hilcal.data.guesser import FAR, GUESSED, SIDE_BY_SIDE, TURN
from hilcal.data.importing import import_readings
from hilcal.data.mapping import ANGLES, LENGTHS, Mapping
from hilcal.data.proposal import Understood
from hilcal.data.propose import Proposed, propose
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identify.conventions import CLEARER, Fit, choose_convention
from hilcal.identify.registration import register
from hilcal.report import text
from hilcal.report.text_import import preview
from hilcal.robot.arm import Arm
from hilcal.toml import check_section

CLOSE = 0.02
"""Part of the reach that a nominal arm may be off; arms are better by ten times; a choice."""
MOST_TRIED = 8
"""Choices of columns that are tried; each takes a registration."""


def show_preview(
    t: Terminal, table: Path, second: Path | None, config: Path | None, output: Path | None,
    force: bool,
) -> None:  # fmt: skip
    """Print what a table seems to hold; write the mapping file where one is asked for.

    Raises:
        InputError: a file that cannot be read, or an output that exists.
    """
    if output is not None and output.suffix != ".toml":
        raise InputError(f"-o {output}: --preview writes a mapping file; name it like mapping.toml")
    if output is not None and output.exists() and not force:
        raise InputError(f"{output}: the file exists; choose another name or give --force")
    settings = None if config is None else load_config(config)
    cell = None
    if settings is not None and config is not None:
        cell = cell_from_config(settings, config.absolute().parent)
    found = propose(table, second, None if cell is None else cell.arm.n)
    proposal, outcome = found.proposal, None
    if cell is not None and settings is not None:
        _name_targets(found, [target.name for target in settings.tool.targets])
        outcome = _decide_columns(table, found, settings, cell)
        outcome += _decide_convention(found, cell.arm)
        outcome += _try(table, found, settings, cell)
    t.show(preview(proposal, len(found.grid.rows), table.name))
    if outcome:
        t.show(text.heading("with this mapping:"))
        t.show(Padding(words, (0, 0, 0, 2)) for words in outcome)
    if output is not None:
        if second is not None:
            _relative_second(found, output)
        try:
            output.write_text(proposal.to_toml(table.name), encoding="utf-8")
        except OSError as e:
            raise InputError(f"{output}: cannot be written ({e.strerror})") from e
        t.notice(f"{output}: the mapping; import with --format {output}")
    else:
        t.notice("nothing was written; -o mapping.toml keeps this as a mapping to edit")
    t.document(
        {
            "mapping": proposal.sections,
            "understood": [
                {"section": u.what, "columns": u.columns, "meaning": u.meaning, "first": u.example}
                for u in proposal.understood
            ],
            "unsure": [{"section": what, "what": words} for what, words in proposal.unsure],
            "unused": [{"column": name, "why": why} for name, why in proposal.unused],
            "missing": proposal.lacking,
            "outcome": outcome,
            "written": None if output is None else str(output),
        }
    )


def _relative_second(found: Proposed, output: Path) -> None:
    """Write the second file's path relative to the mapping file."""
    section = found.proposal.sections["second_file"]
    section["path"] = str(Path(section["path"]).absolute())
    here = output.absolute().parent
    if Path(section["path"]).is_relative_to(here):
        section["path"] = str(Path(section["path"]).relative_to(here))


def _name_targets(found: Proposed, names: list[str]) -> None:
    """Give targets that stand side by side the cell's names, in its order."""
    section = found.proposal.sections.get("position", {})
    if names and len(names) == len(section.get("targets", ())):
        section["targets"] = names
        words = f"the targets are {', '.join(names)}, in the cell's order"
        kept = [doubt for doubt in found.proposal.unsure if doubt != ("position", SIDE_BY_SIDE)]
        found.proposal.unsure[:] = [*kept, ("position", words)]


def _decide_convention(found: Proposed, arm: Arm) -> list[str]:
    """Settle a guessed convention by the nominal arm; a sentence that says so, where it does."""
    proposal, grid = found.proposal, found.grid
    sections = [proposal.sections.get(name) for name in ("joints", "position", "orientation")]
    joints, position, section = sections
    if joints is None or position is None or section is None or section["convention"] == "matrix":
        return []
    blocks = [
        np.stack([grid.numbers(name) for name in s["columns"]], axis=1)
        for s in (joints, position, section)
    ]
    if blocks[0].shape[1] != arm.n:
        return []
    whole = np.isfinite(np.hstack(blocks)).all(axis=1)
    q, y, numbers = (block[whole] for block in blocks)
    unit = ANGLES[section.get("unit", "rad")]
    choice = choose_convention(
        arm, ANGLES[joints["unit"]] * q, LENGTHS[position["unit"]] * y, numbers, unit
    )
    if choice is None:
        return []
    guess = ("orientation", GUESSED)
    proposal.unsure[:] = [doubt for doubt in proposal.unsure if doubt != guess]
    best, second = choice.ranked[:2]
    if choice.decided is None:
        words = (
            f"{arm.name} does not tell the convention: {best.convention} leaves {_left(best)}, "
            f"{second.convention} {_left(second)}"
        )
        proposal.unsure.append(("orientation", words))
        return []
    if not _same(section["convention"], choice.decided, numbers, unit):
        section["convention"] = choice.decided
    proposal.open_convention = False
    for k, u in enumerate(proposal.understood):
        if u.what == "orientation":
            meaning = ", ".join(str(v) for key, v in section.items() if key != "columns")
            proposal.understood[k] = Understood(u.what, u.columns, meaning, u.example)
    return [
        f"orientation: {section['convention']}, as {arm.name} tells: {_left(best)} are left, with "
        f"the next convention {_left(second)}"
    ]


def _left(fit: Fit) -> str:
    angle, distance = float(np.rad2deg(fit.angle)), 1e3 * fit.position
    return f"{angle:.{0 if angle >= 10 else 2}f}° and {distance:.{0 if distance >= 10 else 2}f} mm"


def _same(one: str, other: str, numbers: np.ndarray, unit: float) -> bool:
    from hilcal.data.orientation import rotations

    return bool(np.allclose(rotations(one, numbers, unit), rotations(other, numbers, unit)))


def _decide_columns(table: Path, found: Proposed, settings: CellConfig, cell: Cell) -> list[str]:
    """Choose columns that their values leave open by the nominal arm; a sentence where it tells."""
    proposal, grid = found.proposal, found.grid
    if len(proposal.alternatives) < 2:
        return []
    fits: list[tuple[float, dict[str, dict[str, Any]]]] = []
    for position, joints in proposal.alternatives[:MOST_TRIED]:
        changed = dict(proposal.sections)
        for name, columns, limit, units in (
            ("position", position, FAR, ("mm", "m")),
            ("joints", joints, TURN, ("deg", "rad")),
        ):
            if columns:
                size = max(np.nanmax(np.abs(grid.numbers(c))) for c in columns)
                changed[name] = {"columns": columns, "unit": units[0 if size > limit else 1]}
        rms = _left_by_the_arm(table, changed, settings, cell)
        if rms is not None:
            fits.append((rms, changed))
    fits.sort(key=lambda fit: fit[0])
    clear = len(fits) > 1 and fits[1][0] > CLEARER * fits[0][0]
    if not fits or fits[0][0] > CLOSE * cell.arm.reach or not (clear or len(fits) == 1):
        return []
    proposal.sections = fits[0][1]
    for k, u in enumerate(proposal.understood):
        if u.what in ("position", "joints"):
            section = proposal.sections[u.what]
            chosen = tuple(section["columns"])
            example = tuple(grid.text(c)[0] for c in chosen)
            proposal.understood[k] = Understood(u.what, chosen, section["unit"], example)
    doubts = [d for d in proposal.unsure if RIVALS not in d[1] and BY_VALUES not in d[1]]
    proposal.unsure[:] = doubts
    others = f", others {1e3 * fits[1][0]:.0f} mm" if len(fits) > 1 else ""
    return [f"columns: as {cell.arm.name} tells: {1e3 * fits[0][0]:.2f} mm are left{others}"]


def _left_by_the_arm(
    table: Path, sections: dict[str, dict[str, Any]], settings: CellConfig, cell: Cell
) -> float | None:
    """Rms distance, m, that the nominal arm leaves with a mapping; None where it cannot be."""
    only = {k: v for k, v in sections.items() if k in ("file", "second_file", "position", "joints")}
    try:
        mapping = check_section(only, Mapping, "the proposed mapping")
        return register(cell, import_readings(table, mapping, settings, cell.arm).readings).rms
    except (InputError, CannotAnswerError):
        return None


def _try(table: Path, found: Proposed, settings: CellConfig, cell: Cell) -> list[str]:
    """Import with the proposed mapping; what comes of it, in sentences."""
    if found.proposal.lacking:
        return []
    try:
        result = import_readings(table, found.proposal.mapping(), settings, cell.arm)
    except InputError as error:
        return [f"refused: {error}"]
    readings = result.readings
    try:
        rms = f"the nominal {cell.arm.name} leaves {1e3 * register(cell, readings).rms:.3g} mm rms"
    except CannotAnswerError as error:
        rms = str(error)
    return [
        f"{len(readings)} readings of {len(np.unique(readings.pose))} poses, "
        f"{'positions' if readings.m == 3 else 'positions and orientations'}",
        *result.notes,
        rms,
    ]
