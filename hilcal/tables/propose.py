"""What the columns of a table of unknown form hold: a proposed mapping (`propose`)."""

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby, product
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.readings.readings import SAME_POSE
from hilcal.tables import proposal as words
from hilcal.tables.columns import required_columns
from hilcal.tables.grid import Cell, Grid, joined
from hilcal.tables.guess_values import guess_axes, guess_by_values, is_quaternion, time_unit
from hilcal.tables.mapping import UNLOADED
from hilcal.tables.sniff import sniff
from hilcal.tables.units import ANGLES, FORCES, LENGTHS, MASSES, MOMENTS, TIMES
from hilcal.types import Floats

EXCHANGE_NAMES = (
    "its columns are named as an exchange table's, which (commas, header in row 1, SI units, "
    "rotation vectors) is imported without --format"
)

DEGREES = ("degC", "degF", "K")
WARMEST = 45.0  # °C of a room in which arms are measured; a choice
_CLOCK = re.compile(r"\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?( ?[AP]M)?", re.IGNORECASE)

LEAST_COUNTS = 3600.0
"""Size that whole numbers of encoder counts exceed, and no joint's angle: ten turns; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class GridProposal:
    """A table and a proposed mapping for it."""

    grid: Grid
    proposal: words.Proposal


@limits.bounded
def propose(
    path: Path,
    second: Path | None = None,
    joints: int | None = None,
    joint_names: Sequence[str] = (),
) -> GridProposal:
    """Look at a table, or two that hold columns of the same readings, and propose a mapping.

    Columns that have the names of the arm's joints are these joints, in whatever order they stand.
    """
    first = sniff(path)
    grid, doubts = first.grid, [("file", sentence) for sentence in first.doubts]
    second_file: dict[str, Any] | None = None
    if second is not None:
        sniffed = sniff(second)
        match = _match(grid, sniffed.grid)
        grid, lost = joined(grid, sniffed.grid, match)
        second_file = {"path": str(second), **sniffed.file_keys}
        doubts += [("second_file", sentence) for sentence in sniffed.doubts]
        if match is not None:
            second_file["match"] = list(match)
            doubts.append(("second_file", f"rows are matched by '{match[0]}' and '{match[1]}'"))
        if lost:
            doubts.append(("second_file", f"{lost} rows of the first file have no partner"))
    proposal = guess(grid, joints, joint_names)
    file = {**first.file_keys, **proposal.sections.pop("file", {})}
    head: dict[str, dict[str, Any]] = {"file": file} if file else {}
    if second_file is not None:
        head["second_file"] = second_file
    proposal.sections = head | proposal.sections
    proposal.doubts[:0] = doubts
    return GridProposal(grid, proposal)


def _match(first: Grid, second: Grid) -> tuple[str, str] | None:
    """Return the columns that match the rows of two tables; None where row numbers match them."""
    best: tuple[int, str, str] | None = None
    for first_key in first.names:
        texts = first.text(first_key)
        for second_key in second.names:
            keys = second.text(second_key)
            if len(set(keys)) < len(keys) or "" in keys or not _is_key(keys):
                continue
            shared = sum(t in set(keys) for t in texts)
            if shared > 0.8 * len(texts) and (best is None or shared > best[0]):
                best = shared, first_key, second_key
    if best is not None:
        _, first_key, second_key = best
        same = first.text(first_key) == second.text(second_key)
        if same or len(first.rows) != len(second.rows) or first_key == second_key:
            return first_key, second_key
    if len(first.rows) == len(second.rows):
        return None
    raise InputError(
        f"{second.path}: {len(second.rows)} rows, {first.path} has {len(first.rows)}, and no "
        f"column of both names the row"
    )


def _is_key(keys: list[str]) -> bool:
    try:
        numbers = np.array([float(k) for k in keys])
    except ValueError:
        return True
    return bool(np.all(numbers == np.rint(numbers)))


def guess(grid: Grid, joints: int | None = None, joint_names: Sequence[str] = ()) -> words.Proposal:
    """Propose a mapping for a table."""
    g = words.Guesser(grid, joints)
    counts = _encoder_counts(g)
    _joints(g, joint_names)
    guess_axes(g)
    _polar(g)
    _distances(g)
    readings = {"position", "distance", "gauge"}
    if not readings & set(g.proposal.sections) or "joints" not in g.proposal.sections:
        guess_by_values(g)
    _names(g)
    _times(g)
    for name, column in list(g.free.items()):
        g.ignore(name, _why_unused(g, column))
    if set(required_columns(joints or 6)) <= set(grid.names):
        g.doubt("file", EXCHANGE_NAMES)
    if g.proposal.convention_guessed:
        g.doubt("orientation", words.GUESSED)
    if not readings & set(g.proposal.sections) and not g.proposal.missing:
        g.proposal.missing.append(f"no position: three columns x, y, z were not found{_by_axis(g)}")
    if "joints" not in g.proposal.sections:
        second = "no joint angles: where they are in a file of their own, give it with --second"
        g.proposal.missing.append(counts or second)
    said = any(about == "pose" for about, _ in g.proposal.doubts)
    if "pose" not in g.proposal.sections and "joints" in g.proposal.sections and not said:
        g.doubt("pose", "no column names the pose: rows of the same joints count as one pose")
    if not {"load", "hung_mass", "wrench"} & set(g.proposal.sections):
        g.doubt("load", "no column tells the load: all readings count as unloaded")
    return g.proposal


def _by_axis(g: words.Guesser) -> str:
    """Say which column names the axis of a row, where a table has a row for each coordinate."""
    for name in g.grid.names:
        if {text.strip().lower() for text in g.grid.text(name)} == {"x", "y", "z"}:
            return f"; '{name}' names one axis per row: write x, y, z of a point in one row"
    return ""


def _why_unused(g: words.Guesser, column: words.ColumnName) -> str:
    values = g.values[column.name]
    if values is not None and np.nanmax(values) == np.nanmin(values):
        return f"constant, {np.nanmax(values):g}"
    if column.has(words.DIFFERENCE):
        return "a difference"
    if column.has(words.NOMINAL):
        return "a commanded or nominal value"
    if values is None and column.has(words.TIME) and any(g.grid.text(column.name)):
        return "no form of time that is known; [time] has unit and format"
    if column.unit in FORCES or (column.has(words.FORCE) and column.axis):
        return "a force; [wrench] takes fx, fy, fz or fz alone, [hung_mass] a weight"
    if values is None:
        return "no numbers" if any(g.grid.text(column.name)) else "empty"
    return "its name is not recognised"


def _encoder_counts(g: words.Guesser) -> str:
    """Leave out neighbouring columns of encoder counts; say what is needed of them, or nothing."""

    def counts(c: words.ColumnName) -> bool:
        values = g.values[c.name]
        if values is None or c.axis or c.unit or c.has(words.TIME | words.TORQUE):
            return False
        return bool(np.nanmax(np.abs(values)) > LEAST_COUNTS and _whole_numbers(g, c.name))

    runs = [[c.name for c in run] for counted, run in groupby(g.columns, counts) if counted]
    for names in runs:
        if not words.FEWEST_JOINTS <= len(names) <= words.MOST_JOINTS:
            continue
        for name in names:
            g.ignore(name, "looks like encoder counts")
        largest = np.nanmax(np.abs(g.block(names)))
        return (
            f"no joint angles; '{names[0]}' ... '{names[-1]}' look like encoder counts (whole "
            f"numbers up to {largest:.0f}): write columns of angles instead, (counts - counts at "
            "the joint's zero) * 360 / (counts per turn of the joint, gear and sign included), in "
            "degrees"
        )
    return ""


def _joints(g: words.Guesser, joint_names: Sequence[str]) -> None:
    """Find joint angles by the arm's names of joints, a joint's word and number, or UR's names."""
    groups: dict[tuple[str, ...], dict[int, str]] = {}
    for c in g.columns:
        torque = c.has(words.TORQUE) or c.unit in MOMENTS
        joint = c.has(words.JOINT | words.POSITIONS) or torque
        if not c.numbers or c.axis or not joint or not g.number(c.name) or c.name not in g.free:
            continue
        if not c.has(words.STD):
            groups.setdefault(c.words, {}).setdefault(c.numbers[-1], c.name)
    candidates: list[tuple[words.ColumnName, list[str]]] = []
    for by_number in groups.values():
        names = [by_number[k] for k in sorted(by_number)]
        first = words.parse(names[0])
        if is_quaternion(g.block(names)) and len(names) == 4:
            continue
        if sorted(by_number)[0] > 1 or not words.FEWEST_JOINTS <= len(names) <= words.MOST_JOINTS:
            continue
        if first.has(words.NO_ANGLE | words.TORQUE) or first.unit in MOMENTS:
            _per_joint(g, first, names)
        elif first.has(words.JOINT) or len(names) == g.joints:
            candidates.append((first, names))
    by_name = {words.without_unit(name): name for name in g.free if g.number(name)}
    of_arm = [by_name[name.lower()] for name in joint_names if name.lower() in by_name]
    if of_arm and len(of_arm) == len(joint_names):
        candidates.insert(0, (words.parse("joint"), of_arm))
    named = [_with_words(g, joint.split()) for joint in words.ARM_JOINTS]
    if all(named):
        candidates.append((words.parse("joint"), [str(name) for name in named]))
    if not candidates:
        return
    measured = words.MEASURED | {"qa"}
    candidates.sort(
        key=lambda f: (
            not f[0].has(words.JOINT), f[0].has(measured), not f[0].has(words.NOMINAL)
        )
    )  # fmt: skip
    first, names = candidates[0]
    if first.has(measured):
        g.doubt("joints", f"'{names[0]}' ... are reported angles, used as the commanded ones")
    unit = words.angle_unit(g, "joints", names)
    from_zero = {"from_zero": True} if _from_zero(g.block(names) * ANGLES[unit]) else {}
    if from_zero:
        g.doubt("joints", "counted from 0 to 360°, by their values: those over 180° are negative")
    g.assign("joints", names, unit, unit=unit, **from_zero)
    if g.joints is not None and len(names) != g.joints:
        g.doubt("joints", f"{len(names)} columns, the arm has {g.joints} joints")
    for parsed, reported in candidates[1:]:
        if parsed.has(measured) and len(reported) == len(names):
            same = np.nanmax(np.abs(g.block(reported) - g.block(names)))
            if same < (0.1 if unit == "rad" else 5.7):
                g.assign("actual_joints", reported, unit, unit=unit)
                break


def _from_zero(q: Floats) -> bool:
    """Whether angles (N, k), rad, are counted from 0 to a turn: several go round, none is below 0.

    A joint goes round whose values lie in the first quarter of the turn and in the last.
    """
    least, most = np.nanmin(q, axis=0), np.nanmax(q, axis=0)
    within = bool(np.all(least >= 0.0) and np.all(most <= 2 * np.pi))
    return within and int(np.sum((least < np.pi / 2) & (most > 1.5 * np.pi))) > 1


def _with_words(g: words.Guesser, parts: Sequence[str]) -> str | None:
    for c in g.columns:
        digits = {str(k) for k in c.numbers}
        if set(parts) <= set(c.words) | digits and g.number(c.name) and not c.has(words.NO_ANGLE):
            return c.name
    return None


def _per_joint(g: words.Guesser, first: words.ColumnName, names: list[str]) -> None:
    values = g.block(names)
    if (first.has(words.TORQUE) or first.unit in MOMENTS) and not first.has(words.NOMINAL):
        unit = g.unit(names, MOMENTS)
        if unit is None:
            g.doubt("torques", "no unit stated; read as Nm")
            unit = "Nm"
        g.assign("torques", names, unit, unit=unit)
        g.doubt("torques", 'are they of the drives, against the load? If not: of = "load"')
        return
    if first.has(words.TEMPERATURE) or first.unit == "degC" or first.has({"degc"}):
        unit = first.unit if first.unit in ("degC", "degF", "K") else "degC"
        g.assign("joint_temperatures", names, unit, unit=unit)
    elif first.has(words.APPROACH) and np.all(np.isin(values, (-1.0, 1.0))):
        g.assign("approach", names, "-1 or +1")


def _polar(g: words.Guesser) -> None:
    """Leave out angles and a range of a position in spherical coordinates, and say so."""
    if "position" in g.proposal.sections:
        return
    free = [c for c in g.free.values() if g.number(c.name) and not c.axis and not c.has(words.STD)]
    terms = (words.AZIMUTH, words.ELEVATION, words.DISTANCE | {"d", "r", "s"})
    columns = [next((c.name for c in free if c.has(t)), "") for t in terms]
    if all(columns) and len(set(columns)) == 3:
        for name in columns:
            g.ignore(name, "a spherical coordinate")
        a, z, d = columns
        g.proposal.missing.append(
            f"'{a}', '{z}', '{d}' are spherical coordinates: write x = d sin z cos a, "
            "y = d sin z sin a, z = d cos z in columns of their own (z from the zenith; of an "
            "elevation, cos and sin are exchanged)"
        )


def _distances(g: words.Guesser) -> None:
    """Find distances from points and heights over planes, in rows that have no position."""
    position = g.proposal.sections.get("position", {}).get("columns", [])
    positioned = np.isfinite(g.block(position)).any(axis=1) if position else np.zeros(1, dtype=bool)
    for kind, terms in (("distance", words.DISTANCE), ("gauge", words.GAUGE)):
        beside = words.LASERS if kind == "distance" and not position else set[str]()
        named = [
            c
            for c in g.free.values()
            if not c.axis and (c.has(terms) or (c.has(beside) and c.numbers))
        ]
        plain = [c.name for c in named if g.number(c.name) and not c.has(words.STD | words.NOMINAL)]
        plain = [n for n in plain if not np.any(positioned & np.isfinite(g.block([n])[:, 0]))]
        if not plain:
            continue
        filled = np.isfinite(g.block(plain[:1])[:, 0])
        unit = words.length_unit(g, kind, plain[:1])
        section: dict[str, Any] = {"unit": unit}
        for c in named:
            if g.number(c.name) and c.has(words.STD) and "std_column" not in section:
                section["std_column"] = c.name
                if c.unit in LENGTHS and c.unit != unit:
                    section["std_unit"] = c.unit
        for c in g.free.values():
            texts = np.array(g.grid.text(c.name)) != ""
            if not g.number(c.name) and c.has(words.FROM | terms) and np.array_equal(texts, filled):
                section["name_column"] = c.name
                break
        else:
            section["name"] = "A" if kind == "distance" else "G"
            g.doubt(kind, f"no column names what it is of: all count as of {section['name']}")
        g.assign(kind, plain[:1], unit, column=plain[0], **section)
        if plain[1:]:
            listed = ", ".join(f"'{name}'" for name in plain[1:])
            g.doubt(kind, f"a row has one, not {listed}: write each in a row of its own")
        for key in ("std_column", "name_column"):
            g.free.pop(section.get(key, ""), None)


def _names(g: words.Guesser) -> None:
    """Find poses, loads, stations, cycles and reflectors."""
    q = g.proposal.sections.get("joints")
    _pick(g, "pose", words.POSE, lambda n: q is None or _names_poses(g, n, q))
    for c in list(g.free.values()):
        if c.has(words.MASS | words.LOAD) and g.number(c.name) and "load" not in g.free:
            stated = c.unit if c.unit in MASSES | FORCES else None
            if (stated or c.has(words.MASS)) and "hung_mass" not in g.proposal.sections:
                unit = stated or "kg"
                if "wrench" in g.proposal.sections:
                    continue
                if unit in FORCES:
                    g.doubt("hung_mass", "taken as a weight, which pulls down")
                g.assign("hung_mass", [c.name], unit, column=c.name, unit=unit)
    if "hung_mass" not in g.proposal.sections:
        _pick(g, "load", words.LOAD, lambda n: True)
    if not {"load", "hung_mass"} & set(g.proposal.sections):
        for c in list(g.free.values()):
            texts = [t.lower() for t in g.grid.text(c.name)]
            few = 1 < len(set(texts)) <= 20
            if not g.number(c.name) and few and set(texts) & (set(UNLOADED) - {"0", "-", "no"}):
                g.assign("load", [c.name], "name", column=c.name)
                g.doubt("load", f"'{c.name}' has a value that means no load")
                break
    if (load := g.proposal.sections.get("load")) is not None:
        values = {t.lower() for t in g.grid.text(load["column"])}
        if "" in values and values & set(UNLOADED):
            empty = sum(not t for t in g.grid.text(load["column"]))
            g.doubt("load", f"{empty} empty cells count as no load, beside others that say so")
        elif not values & {*UNLOADED, ""}:
            shown = ", ".join(sorted(values)[: words.N_EXAMPLES])
            g.doubt("load", f"which of its values means no load? Set none = [...] ({shown})")
    _pick(g, "station", words.STATION, lambda n: not g.number(n) and _few_values(g, n))
    _pick(g, "cycle", words.CYCLE, lambda n: g.number(n) and _whole_numbers(g, n))
    _pick(g, "target", words.REFLECTOR, lambda n: not g.number(n) and _few_values(g, n))
    if "target" not in g.proposal.sections:
        _pick(g, "target", words.POSE, lambda n: _in_each_state(g, n))


def _pick(
    g: words.Guesser, section: str, vocabulary: set[str], fits: Callable[[str], bool]
) -> None:
    for c in list(g.free.values()):
        named = not g.number(c.name) or _whole_numbers(g, c.name)
        usable = named and c.has(vocabulary) and not c.axis and not c.has(words.STD)
        if usable and fits(c.name):
            g.assign(section, [c.name], "name", column=c.name)
            return


def _whole_numbers(g: words.Guesser, name: str) -> bool:
    values = g.block([name])[:, 0]
    finite = values[np.isfinite(values)]
    return bool(np.all(finite == np.rint(finite)))


def _few_values(g: words.Guesser, name: str) -> bool:
    count = len(set(g.grid.text(name)))
    return 1 < count <= min(20, len(g.grid.rows) // 2)


def _in_each_state(g: words.Guesser, name: str) -> bool:
    """Whether each pose has every name equally often under each load, as those of reflectors."""
    q = g.proposal.sections.get("joints")
    if q is None or g.number(name) or not _few_values(g, name):
        return False
    of_load = [g.proposal.sections.get(kind) for kind in ("load", "hung_mass")]
    loads = [g.grid.text(section["column"]) for section in of_load if section is not None]
    states = zip(map(tuple, g.block(q["columns"]).tolist()), *loads, strict=True)
    names: dict[tuple[object, ...], Counter[str]] = {}
    for state, text in zip(states, g.grid.text(name), strict=True):
        names.setdefault(state, Counter())[text] += 1
    count = len(set(g.grid.text(name)))
    alike = all(len(c) == count and len(set(c.values())) == 1 for c in names.values())
    if alike:
        g.doubt("target", f"'{name}' has each of its names in every pose: taken for reflectors")
    return alike


def _names_poses(g: words.Guesser, name: str, joints: dict[str, Any]) -> bool:
    """Whether rows of one name have the same joint angles, or nearly so (then: reported angles)."""
    texts = g.grid.text(name)
    if "" in texts or len(set(texts)) == 1:
        return False
    q = g.block(joints["columns"]) * ANGLES[joints["unit"]]
    if len(set(texts)) == len(texts) > len(np.unique(q, axis=0)):
        g.doubt(
            "pose", f"'{name}' names rows, not poses: rows of the same joints count as one pose"
        )
        return False
    first: dict[str, int] = {}
    rows = [first.setdefault(text, k) for k, text in enumerate(texts)]
    off = np.nan_to_num(np.abs(q - q[rows]))
    if off.max() > words.REPORTED:
        k = int(np.argmax(off.max(axis=1)))
        g.doubt("joints", f"'{name}' names no poses: '{texts[k]}' has different joint values")
        return False
    if off.max() > SAME_POSE and "actual_joints" not in g.proposal.sections:
        joints["reported"] = True
        g.doubt("joints", f"they differ by up to {off.max():.2g} rad in a pose: reported angles")
    return True


def _times(g: words.Guesser) -> None:
    """Find times and the temperature of the air."""
    read = np.ones(len(g.grid.rows), dtype=bool)  # rows that have what a reading needs
    for needed in ("joints", "position"):
        if needed in g.proposal.sections:
            read &= np.isfinite(g.block(g.proposal.sections[needed]["columns"])).any(axis=1)
    measured = g.grid.rows_with(read)
    timed = [c for c in g.free.values() if _timed(g, c)]
    days = [c for c in timed if all(map(_is_day, measured.cells(c.name)))]
    clocks = [c for c in timed if all(map(_is_clock, measured.cells(c.name)))]
    choices: list[tuple[words.ColumnName, words.ColumnName | None]] = [
        *product(clocks, days),
        *((c, None) for c in sorted(timed, key=lambda c: c in days)),
    ]
    for c, day in choices:
        cells = measured.times(c.name, None if day is None else day.name)
        guessed = time_unit(cells, c.unit, g.values[c.name])
        if guessed is not None and len(set(cells)) > 1:
            section, doubt = guessed
            if doubt:
                g.doubt("time", doubt)
            names = [c.name]
            if day is not None:
                section["date_column"] = day.name
                names.append(day.name)
            g.assign("time", names, str(section["unit"]), column=c.name, **section)
            break
    for c in list(g.free.values()):
        if (
            "air" not in g.proposal.sections
            and (c.has(words.TEMPERATURE) or (c.has(words.AIR | {"t"}) and c.unit in DEGREES))
            and g.number(c.name)
            and not c.numbers
        ):
            coldest = np.nanmin(g.block([c.name]))
            unit = c.unit or ("K" if coldest > 200 else "degF" if coldest > WARMEST else "degC")
            if c.unit is None and unit != "degC":
                g.doubt("air", f"no unit stated; {unit}, since the least is {coldest:.4g}")
            if unit in DEGREES:
                g.assign("air", [c.name], unit, column=c.name, unit=unit)


def _timed(g: words.Guesser, c: words.ColumnName) -> bool:
    """Whether a column may hold times; "t" alone, which may be a temperature, if they rise."""
    if all(isinstance(cell, datetime) for cell in g.grid.cells(c.name)):
        return True
    named = c.has(words.TIME) and not c.axis and c.unit in (None, *TIMES)
    values = g.values[c.name]
    return named and (c.words != ("t",) or values is None or not np.any(np.diff(values) < 0))


def _is_clock(cell: Cell) -> bool:
    """Whether a cell holds a time of day without a date."""
    if isinstance(cell, datetime):
        return cell.year == 1900
    return bool(_CLOCK.fullmatch(str(cell)))


def _is_day(cell: Cell) -> bool:
    """Whether a cell holds a date without a time of day."""
    if isinstance(cell, datetime):
        return cell == cell.replace(hour=0, minute=0, second=0, microsecond=0)
    return isinstance(cell, str) and ":" not in cell and len(re.findall("[0-9]+", cell)) > 1
