"""A proposed mapping, checked and completed by the nominal arm of a cell.

The arm decides the convention of orientations. With its nominal flange orientations
R_i, the orientations M_i of the right convention obey

    M_i = A R_i B,      y_i = A (p_i + R_i τ) + t

with one rotation A (base to sensor) and one B (target on the flange) for all readings, up to the
arm's own errors; those of a wrong convention do not. The positions are needed: a cyclic exchange of
the axes' names turns one convention into another, which A and B absorb.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from hilcal import numbers
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.registration.misdescription import examine
from hilcal.identification.registration.placement import nearest_rotation, rotation_of_attitudes
from hilcal.identification.registration.registration import (
    Registration,
    computed_from_joints,
    register,
)
from hilcal.readings.readings import Readings
from hilcal.robot.arm import Arm
from hilcal.robot.chain import evaluate
from hilcal.shown import WIDTH, Brief
from hilcal.tables.files import table_file
from hilcal.tables.guess_values import BY_ROWS, BY_VALUES, RIVALS
from hilcal.tables.importing import import_readings
from hilcal.tables.mapping import Mapping
from hilcal.tables.proposal import (
    GUESSED,
    MAX_ANGLE_RAD,
    MAX_POSITION_M,
    RAIL,
    SIDE_BY_SIDE,
    Guesser,
    Proposal,
    ProposedQuantity,
)
from hilcal.tables.propose import GridProposal, propose
from hilcal.tables.units import ANGLES, CONVENTIONS, LENGTHS, NUMBERS, rotations
from hilcal.toml import check_section
from hilcal.types import Floats

if TYPE_CHECKING:
    import pandas as pd

# All of these are choices.
CLOSE_SHARE = 0.02  # share of the reach that a nominal arm may be off; arms are ten times better
MOST_TRIED = 8  # choices of columns that are tried; each takes a registration
AGREEMENT_RAD = 0.05
"""Rad; nominal arms are better by far (1 mrad), other conventions worse (1 rad)."""
LEAST_RATIO = 5.0  # how much worse the next choice must fit for the first to be certain
FEWEST_READINGS, MOST_READINGS = 6, 300
"""Readings below which two rotations fit too easily; readings that are tried."""
ALTERNATIONS = 20  # steps between A and B
_GENERIC = ("intrinsic-", "fixed-", "rotation-", "quaternion-")
"""Beginnings of the names of conventions that belong to no maker."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """How well a convention agrees with the arm."""

    convention: str
    angle: float  # remaining rms angle, rad
    position: float  # remaining rms distance, m
    rms: float  # both together, distances as parts of the arm's reach

    @property
    def words(self) -> str:
        """The remaining misfit."""
        angle, distance = float(np.rad2deg(self.angle)), 1e3 * self.position
        degrees = f"{angle:.{0 if angle >= 10 else 2}f}°"
        return f"{degrees} and {distance:.{0 if distance >= 10 else 2}f} mm"


@dataclass(frozen=True, slots=True, eq=False)
class Preview(Brief):
    """How a table could be read.

    Attributes:
        rows: of the table.
        proposal: the proposed mapping: understood, unsure, unused, missing.
        outcome: the outcome of an import into the cell, in sentences; None without a cell.
    """

    rows: int
    proposal: Proposal
    outcome: tuple[str, ...] | None

    def _brief(self) -> dict[str, str]:
        p, outcome = self.proposal, self.outcome or ()
        quantities = {u.section: f"{', '.join(u.columns)}: {u.meaning}" for u in p.quantities}
        texts = {
            "rows": str(self.rows),
            "missing": "; ".join(p.missing),
            "outcome": outcome[-1] if outcome else "",
            "unsure": f"{len(p.doubts)}, of {', '.join(dict(p.doubts))}" if p.doubts else "",
            "not used": ", ".join(name for name, _ in p.unused),
            **quantities,
        }
        return {name: shorten(text, WIDTH) for name, text in texts.items() if text}


def preview_table(
    path: "str | Path | pd.DataFrame", cell: Cell | None = None, second: str | Path | None = None
) -> Preview:
    """Propose a mapping for a table of any form; nothing is written.

    >>> preview = hc.preview_table(TABLE, hc.Cell.load(CELL))
    >>> preview.proposal.sections["joints"]["unit"]
    'rad'

    Args:
        path: text, XLSX, MAT or Parquet, or a pandas data frame.
        cell: its nominal arm decides the convention of orientations, and columns that their
            values leave open.
        second: a second file that holds the other columns of the same readings.

    Raises:
        InputError: a file that cannot be read, or two that do not belong together.
    """
    with table_file(path) as table:
        return _preview(table, cell, None if second is None else Path(second))


def _preview(table: Path, cell: Cell | None, second: Path | None) -> Preview:
    proposed = propose(
        table, second, cell.arm.n if cell else None, cell.arm.joint_names if cell else ()
    )
    if cell is None:
        return Preview(len(proposed.grid.rows), proposed.proposal, None)
    settings = cell.configured()
    _name_targets(proposed.proposal, [target.name for target in settings.tool.targets])
    _decide_travels(proposed, cell.arm)
    outcome = _decide_columns(table, proposed, settings, cell)
    outcome += _decide_convention(proposed, cell.arm)
    outcome += _try_import(table, proposed.proposal, settings, cell)
    return Preview(len(proposed.grid.rows), proposed.proposal, tuple(outcome))


def _name_targets(proposal: Proposal, names: list[str]) -> None:
    """Give targets that stand side by side the cell's names, in its order."""
    section = proposal.sections.get("position", {})
    if names and len(names) == sum(map(bool, section.get("targets", ()))):
        section["targets"] = names
        note = f"the targets are {', '.join(names)}, in the cell's order"
        doubts = [doubt for doubt in proposal.doubts if doubt != ("position", SIDE_BY_SIDE)]
        proposal.doubts[:] = [*doubts, ("position", note)]


def _decide_travels(proposed: GridProposal, arm: Arm) -> None:
    """Decide columns and units of joints that slide, by their names and by the arm's limits.

    External axes E1, E2, …, or a track, are the joints that slide. Travels beyond ten times the
    limits are mm.
    """
    proposal, grid = proposed.proposal, proposed.grid
    section, slides = proposal.sections.get("joints"), np.flatnonzero(arm.slides).tolist()
    if section is None or not slides:
        return
    names = list(section["columns"])
    external = _travels(proposed)
    if len(external) > len(slides):
        external = [name for name in external if np.ptp(grid.numbers(name)) > 0]
    if len(names) + len(external) == arm.n and len(external) == len(slides):
        for j, name in zip(slides, external, strict=True):
            names.insert(j, name)
        proposal.unused[:] = [(n, why) for n, why in proposal.unused if n not in external]
        counted = f"{len(names) - len(slides)} c"
        doubts = [d for d in proposal.doubts if not d[1].startswith(counted)]
        proposal.doubts[:] = [*doubts, ("joints", f"{', '.join(external)} taken for what slides")]
    if len(names) != arm.n:
        return
    q = np.abs(np.stack([grid.numbers(name) for name in names], axis=1))
    far = np.nanmax(q, axis=0)
    turning, unit = far[~arm.slides].max(initial=0.0), section["unit"]
    if unit == "deg" and turning <= MAX_ANGLE_RAD and not any("deg" in n for n in names):
        unit = "rad"
        proposal.doubts.append(("joints", f"rad, since none turns by more than {turning:.3g}"))
    mm = bool(np.any(far[slides] > 10 * arm.travels[slides]))
    section |= {"columns": names, "unit": unit, "slide_unit": "mm" if mm else "m"}
    if mm:
        note = f"what slides in mm, since it goes to {far[slides].max():.4g}"
        proposal.doubts.append(("joints", note))
    row = int(np.flatnonzero(np.isfinite(q).all(axis=1))[0])
    example = tuple(f"{grid.numbers(name)[row]:g}" for name in names)
    k = next(k for k, u in enumerate(proposal.quantities) if u.section == "joints")
    meaning = f"{unit}, {section['slide_unit']}"
    proposal.quantities[k] = ProposedQuantity("joints", tuple(names), meaning, example)


def _travels(proposed: GridProposal) -> list[str]:
    """Return the unused columns of numbers that are named as a joint that slides."""
    guesser = Guesser(proposed.grid, None)
    free = [guesser.column(name) for name, _ in proposed.proposal.unused]
    return [c.name for c in free if c.has(RAIL) and c.axis is None and guesser.number(c.name)]


def _decide_convention(proposed: GridProposal, arm: Arm) -> list[str]:
    """Decide a guessed convention by the nominal arm; return a sentence where it is decided."""
    proposal, grid = proposed.proposal, proposed.grid
    sections = [proposal.sections.get(name) for name in ("joints", "position", "orientation")]
    joints, position, section = sections
    if joints is None or position is None or section is None:
        return []
    blocks = [
        np.stack([grid.numbers(name) for name in s["columns"]], axis=1)
        for s in (joints, position, section)
    ]
    if blocks[0].shape[1] != arm.n or blocks[1].shape[1] != 3:
        return []
    complete = np.isfinite(np.hstack(blocks)).all(axis=1)
    q, y, values = (block[complete] for block in blocks)
    q, y = ANGLES[joints["unit"]] * q, LENGTHS[position["unit"]] * y
    unit = ANGLES[section.get("unit", "rad")]
    if section["convention"] == "matrix":
        return _decide_rows(proposal, arm, q, y, values)
    ranked = rank_conventions(arm, q, y, values, unit)
    if not ranked:
        return []
    guess = ("orientation", GUESSED)
    proposal.doubts[:] = [doubt for doubt in proposal.doubts if doubt != guess]
    best, second = ranked[:2]
    decided = clearly_best(ranked)
    if decided is None:
        note = (
            f"the nominal {arm.name} does not decide the convention: "
            f"{best.convention} leaves {best.words}, {second.convention} {second.words}"
        )
        proposal.doubts.append(("orientation", note))
        return []
    guessed, fitting = (rotations(name, values, unit) for name in (section["convention"], decided))
    if not np.allclose(guessed, fitting):
        section["convention"] = decided
    proposal.convention_guessed = False
    meaning = ", ".join(str(v) for key, v in section.items() if key != "columns")
    proposal.quantities[:] = [
        replace(u, meaning=meaning) if u.section == "orientation" else u
        for u in proposal.quantities
    ]
    return [
        f"orientation: {section['convention']}, since the nominal {arm.name} fits best with it: "
        f"{best.words} are left, with the next convention {second.words}"
    ]


def _decide_rows(proposal: Proposal, arm: Arm, q: Floats, y: Floats, values: Floats) -> list[str]:
    """Decide by the nominal arm whether matrices (N, 9) stand row by row."""
    doubt = ("orientation", BY_ROWS)
    if doubt not in proposal.doubts or len(q) < FEWEST_READINGS:
        return []
    across = np.arange(9).reshape(3, 3).T.ravel()
    by_rows, by_columns = (
        _agreement(arm, "matrix", q, y, rotations("matrix", v, 1.0))
        for v in (values, values[:, across])
    )
    ranked = sorted((by_rows, by_columns), key=lambda a: a.rms)
    if clearly_best(ranked) is None:
        return []
    proposal.doubts.remove(doubt)
    if ranked[0] is by_columns:
        columns = proposal.sections["orientation"]["columns"]
        proposal.sections["orientation"]["columns"] = [columns[k] for k in across]
    how = "row by row" if ranked[0] is by_rows else "column by column"
    return [f"orientation: matrices stand {how}, since the nominal {arm.name} fits best so"]


def _decide_columns(
    table: Path, proposed: GridProposal, settings: CellConfig, cell: Cell
) -> list[str]:
    """Decide columns that their values leave open by the nominal arm; a sentence if it decides."""
    proposal, grid = proposed.proposal, proposed.grid
    if len(proposal.alternatives) < 2:
        return []
    fits: list[tuple[float, dict[str, dict[str, Any]]]] = []
    computed: list[str] = []  # columns
    for position, joints in proposal.alternatives[:MOST_TRIED]:
        changed = dict(proposal.sections)
        for name, columns, limit, units in (
            ("position", position, MAX_POSITION_M, ("mm", "m")),
            ("joints", joints, MAX_ANGLE_RAD, ("deg", "rad")),
        ):
            if columns:
                size = max(np.nanmax(np.abs(grid.numbers(c))) for c in columns)
                changed[name] = {"columns": columns, "unit": units[0 if size > limit else 1]}
        if (registered := _registered_with(table, changed, settings, cell)) is None:
            continue
        if computed_from_joints(*registered):  # fits better than any set that was measured
            computed += position
        else:
            fits.append((registered[0].rms, changed))
    fits = [fit for fit in fits if not set(computed) & set(fit[1]["position"]["columns"])]
    fits.sort(key=lambda fit: fit[0])
    clear = len(fits) > 1 and fits[1][0] > LEAST_RATIO * fits[0][0]
    if not fits or fits[0][0] > CLOSE_SHARE * cell.arm.reach or not (clear or len(fits) == 1):
        return []
    first, chosen_ones = proposal.alternatives[0], fits[0][1]
    chosen_names = [n for kind in ("position", "joints") for n in chosen_ones[kind]["columns"]]
    others = [name for names in first for name in names if name not in chosen_names]
    why = {n: "computed from the joint values" if n in computed else "fits worse" for n in others}
    unused = [pair for pair in proposal.unused if pair[0] not in chosen_names]
    proposal.unused[:] = [*unused, *why.items()]
    proposal.sections = chosen_ones
    for k, u in enumerate(proposal.quantities):
        if u.section in ("position", "joints"):
            section = proposal.sections[u.section]
            chosen = tuple(section["columns"])
            example = tuple(grid.text(c)[0] for c in chosen)
            proposal.quantities[k] = ProposedQuantity(u.section, chosen, section["unit"], example)
    doubts = [d for d in proposal.doubts if RIVALS not in d[1] and BY_VALUES not in d[1]]
    proposal.doubts[:] = doubts
    second = f", others {1e3 * fits[1][0]:.0f} mm" if len(fits) > 1 else ""
    return [
        f"columns: the nominal {cell.arm.name} fits best with these: "
        f"{1e3 * fits[0][0]:.2f} mm are left{second}",
    ]


def _registered_with(
    table: Path, sections: dict[str, dict[str, Any]], settings: CellConfig, cell: Cell
) -> tuple[Registration, Readings] | None:
    """Return the registered nominal arm with a mapping, and its readings; None where refused."""
    only = {k: v for k, v in sections.items() if k in ("file", "second_file", "position", "joints")}
    try:
        mapping = check_section(only, Mapping, "the proposed mapping")
        readings = import_readings(table, mapping, settings, cell.arm).readings
        return register(cell, readings), readings
    except (InputError, CannotAnswerError):
        return None


def _try_import(table: Path, proposal: Proposal, settings: CellConfig, cell: Cell) -> list[str]:
    if proposal.missing:
        return []
    try:
        result = import_readings(table, proposal.mapping(Mapping), settings, cell.arm)
    except InputError as error:
        return [f"refused: {error}"]
    readings = result.readings
    count = f"{len(readings)} readings of {len(np.unique(readings.pose))} poses"
    sentences = [f"{count}, {_kinds(readings)}", *result.notes]
    try:
        registered = register(cell, readings)
        sentences.append(f"the nominal {cell.arm.name} leaves {numbers.length(registered.rms)} rms")
        if (wrong := examine(registered, readings)) is not None:
            sentences.append(wrong.words(cell, readings))
    except CannotAnswerError as error:
        sentences.append(str(error))
    return sentences


def _kinds(readings: Readings) -> str:
    if readings.m == 6:
        return "positions and orientations"
    names = {"station": "positions", "point": "distances", "gauge": "heights"}
    return ", ".join(dict.fromkeys(names[o.kind] for o in readings.observers)) or "positions"


def rank_conventions(
    arm: Arm, q: Floats, position: Floats, values: Floats, unit: float
) -> tuple[Agreement, ...]:
    """Rank the conventions of orientations by their agreement with the nominal arm, best first.

    `values` (N, k) are the numbers of the orientations, with angles in `unit`, read at joint angles
    `q` (N, n) and positions (N, 3), sensor axes. Returns none where there are too few readings.
    """
    step = max(1, len(q) // MOST_READINGS)
    q, y, values = q[::step], position[::step], values[::step]
    if len(q) < FEWEST_READINGS:
        return ()
    return tuple(
        sorted(
            (
                _agreement(arm, name, q, y, rotations(name, values, unit))
                for name, kind in CONVENTIONS.items()
                if name.startswith(_GENERIC) and NUMBERS.get(kind, 3) == values.shape[1]
            ),
            key=lambda a: a.rms,
        )
    )


def _agreement(arm: Arm, name: str, q: Floats, y: Floats, measured: Floats) -> Agreement:
    """Return how well orientations (N, 3, 3) at positions y (N, 3) agree with the arm."""
    chain = evaluate(arm, q)
    flange, p = chain.rotation[-1], chain.position[-1]
    base, angle = _fit_attitudes(measured, flange)
    # y_i − A p_i = A R_i τ + t with the best τ and t
    target = (y - p @ base.T).reshape(-1)
    eye = np.broadcast_to(np.eye(3), (len(p), 3, 3))
    design = np.concatenate([base @ flange, eye], axis=2).reshape(-1, 6)
    residual = target - design @ np.linalg.lstsq(design, target, rcond=1e-9)[0]
    distance = float(np.sqrt(3 * np.mean(residual**2)))
    return Agreement(name, angle, distance, float(np.hypot(angle, distance / arm.reach)))


def clearly_best(ranked: Sequence[Agreement]) -> str | None:
    """Return the best convention, where the data leave no doubt; None otherwise."""
    best, second = ranked[:2]
    clear = best.rms < AGREEMENT_RAD and second.rms > LEAST_RATIO * best.rms
    return best.convention if clear else None


def _fit_attitudes(measured: Floats, flange: Floats) -> tuple[Floats, float]:
    """A and the rms angle, rad, of the best M_i = A R_i B."""
    a = rotation_of_attitudes(measured, flange)
    for _ in range(ALTERNATIONS):
        b = nearest_rotation(np.einsum("nji,kj,nkl->il", flange, a, measured))
        a = nearest_rotation(np.einsum("nij,kj,nlk->il", measured, b, flange))
    trace = np.einsum("nij,nij->n", measured, a @ flange @ b)
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    return a, float(np.sqrt(np.mean(angle**2)))
