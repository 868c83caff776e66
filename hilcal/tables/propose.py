"""How a file of unknown form is written (`sniff`), and what its columns hold (`guess`)."""

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
from hilcal.tables import files
from hilcal.tables import proposal as words
from hilcal.tables.columns import required_columns
from hilcal.tables.grid import Cell, Grid, joined, number
from hilcal.tables.guess_values import guess_axes, guess_by_values, is_quaternion, time_unit
from hilcal.tables.mapping import UNLOADED, FileFormat
from hilcal.tables.units import ANGLES, FORCES, LENGTHS, MASSES, MOMENTS, TIMES
from hilcal.types import Floats

EXCHANGE_NAMES = (
    "its columns are named as an exchange table's, which (commas, header in row 1, SI units, "
    "rotation vectors) is imported without --format"
)

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
    found = [next((c.name for c in free if c.has(t)), "") for t in terms]
    if all(found) and len(set(found)) == 3:
        for name in found:
            g.ignore(name, "a spherical coordinate")
        a, z, d = found
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


DEGREES = ("degC", "degF", "K")
WARMEST = 45.0  # °C of a room in which arms are measured; a choice
_CLOCK = re.compile(r"\d{1,2}:\d{2}(:\d{2}([.,]\d+)?)?( ?[AP]M)?", re.IGNORECASE)
_POINT = re.compile(r"\[\[\s*[-+.\d]|\{\s*(A1|X)\s+[-+.\d]")
HEAD = 400  # Lines that the dialect is guessed from
MANY_NUMBERS = 0.5  # of those of the sheet that is read: other readings; a choice
COMMENTS = ("//", "#", "%", "!")
_UNIT = re.compile(
    r"[\[(<]?\s*(|-|1|m|mm|[uµμ]m|in(ch)?|\"|deg|degrees?|°|rad|mrad|n|kn|nm|n[*·]m|kg|g|s|sec|ms|"
    r"°c|degc|c|k|string|text|name)\s*[\])>]?",
    re.IGNORECASE,
)

Rows = Sequence[tuple[int, Sequence[Cell]]]


@dataclass(frozen=True, slots=True, eq=False)
class SniffedFile:
    """A file, opened as it seems to be written."""

    file_keys: dict[str, Any]  # keys of [file] that differ from a plain CSV file
    grid: Grid
    doubts: tuple[str, ...]  # sentences on what is unsure


def sniff(path: str | Path) -> SniffedFile:
    """Guess how a file is written, and open it."""
    content = limits.read_bytes(Path(path), limits.TABLE)
    name = str(path)
    kind = files.kind_of(name, content)
    if kind == "XLSX":
        return _spreadsheet(name, content)
    if kind != "text":
        return SniffedFile({}, files.open_grid(path, FileFormat()), ())
    how: dict[str, Any] = {}
    text = files.decoded(name, content, None)
    if not content.startswith(tuple(files.BYTE_ORDER_MARKS)):
        guessed = files.guessed_encoding(content)
        how |= {"encoding": guessed} if guessed != "utf-8" else {}
    lines = [line for line in text.splitlines() if line.strip()][:HEAD]
    for mark in COMMENTS:
        count = sum(line.lstrip().startswith(mark) for line in lines)
        if 0 < count < 0.5 * len(lines):
            how["comment"] = mark
            break
    if sum(map(bool, map(_POINT.search, lines))) > 0.5 * len(lines):
        raise InputError(
            f"{name}: its rows hold points of a robot's program, [[...], ...] or {{A1 ..., A2 "
            "...}; write each number in a column of its own: joint angles, then x, y, z as measured"
        )
    how |= _dialect(name, lines, how.get("comment"))
    how["header_row"] = 0
    rows = list(files.records(name, text, FileFormat(**how)))
    layout, doubts = _layout(rows, FileFormat(**how))
    how |= layout
    if how["header_row"] == 0 and "comment" in how:
        how |= _commented_header(text, how, rows)
    if how["separator"] == ",":
        del how["separator"]
    file_format = FileFormat(**how)
    return SniffedFile(_stated(file_format), files.open_grid(path, file_format), doubts)


def _stated(file_format: FileFormat) -> dict[str, Any]:
    """Return the keys of [file] that are not as in a plain CSV file."""
    return file_format.model_dump(mode="json", exclude_defaults=True)


def _dialect(path: str, lines: list[str], comment: str | None) -> dict[str, Any]:
    best, score = dict[str, Any](), 0.0
    body = "\n".join(lines)
    choices = product((None, "'", ".", ",", " "), ("tab", ";", "|", ",", "blanks"), (".", ","))
    for thousands, separator, decimal in choices:
        blank = separator == "blanks" and thousands == " "
        if decimal == separator or thousands in (decimal, separator) or blank:
            continue
        keys = {"separator": separator, "decimal": decimal, "thousands": thousands}
        form = FileFormat(**keys, comment=comment, header_row=0)
        try:
            rows = [cells for _, cells in files.records(path, body, form)]
        except InputError:
            continue
        length, _ = Counter(map(len, rows)).most_common(1)[0] if rows else (0, 0)
        usual = [cells for cells in rows if len(cells) == length >= 3]
        mean = sum(_is_number(c, form) for cells in usual for c in cells) / max(len(rows), 1)
        if mean > score + 1e-9:
            best, score = keys, mean
    if not best:
        raise InputError(
            f"{path}: no columns of numbers; expected a table, one row per reading, or XLSX, MAT "
            f"or Parquet"
        )
    return best


def _is_number(cell: Cell, how: FileFormat) -> bool:
    return bool(np.isfinite(number(cell, how)))


def _layout(rows: Rows, how: FileFormat) -> tuple[dict[str, Any], tuple[str, ...]]:
    length, _ = Counter(len(cells) for _, cells in rows).most_common(1)[0]
    share = []
    for _, cells in rows:
        some = list(filter(files.filled, cells))
        share.append(sum(_is_number(c, how) for c in some) / max(len(some), 1))
    usual = float(np.median([s for s, (_, c) in zip(share, rows, strict=True) if len(c) == length]))
    complete = [len(cells) >= length - 1 for _, cells in rows]
    first = next((k for k in range(len(rows)) if share[k] >= 0.5 * usual and complete[k]), 0)
    titled = [k for k in range(first) if complete[k] and sum(map(files.filled, rows[k][1])) > 1]
    above = [k for k in titled if files.length_of(rows[k][1]) <= length]
    out: dict[str, Any] = {"header_row": 0}
    doubts: list[str] = []
    if titled and not above:
        row, cells = rows[titled[-1]]
        named = f"row {row} names {files.length_of(cells)} columns, the readings have {length}"
        doubts.append(f"{named}: the columns are numbered")
    header: Sequence[Cell] = ()
    if above:
        title = above[-1]
        if len(above) > 1 and all(_UNIT.fullmatch(str(c or "")) for c in rows[title][1]):
            out["units_row"] = rows[title][0]
            title = above[-2]
        out["header_row"], header = rows[title]
        names = [cell for cell in header if files.filled(cell)]
        over = rows[title - 1] if title > 0 else (0, ())
        groups = {cell for cell in over[1] if files.filled(cell)}
        texts = not any(_is_number(cell, how) for cell in groups)
        if len(set(names)) < len(names) and len(groups) > 1 and texts:
            out["group_row"] = over[0]
    width = len(header) or length
    trimmed = files.length_of(header) if header else width
    odd = []
    for k, (row, cells) in enumerate(rows):
        preamble = k < first and row > out["header_row"] and row != out.get("units_row")
        short = bool(header) and len(cells) < trimmed
        if preamble or (
            k >= first and (short or files.length_of(cells) > width or cells == header)
        ):
            odd.append(row)
    if odd and len(odd) <= 0.1 * len(rows) + 10:
        out["skip_rows"] = odd
        late = [row for row in odd if row > rows[first][0]]
        if late:
            listed = ", ".join(map(str, late[:5])) + ", ..." * (len(late) > 5)
            why = "they repeat the header or are not of the table's length"
            doubts.append(f"rows {listed} are left out: {why}")
    return out, tuple(doubts)


def _commented_header(text: str, how: dict[str, Any], rows: Rows) -> dict[str, Any]:
    """Header in the last comment line above the readings, as numpy.savetxt writes it."""
    lines = [line.lstrip() for line in text.splitlines()[: rows[0][0] - 1]]
    marked = [row for row, line in enumerate(lines, start=1) if line.startswith(how["comment"])]
    if not marked:
        return {}
    plain = FileFormat(**{**how, "comment": None, "header_row": 0})
    line = lines[marked[-1] - 1][len(how["comment"]) :]
    cells = [c for _, c in files.records("", line, plain)]
    same = bool(cells) and len(cells[0]) == len(rows[0][1])
    return {"header_row": marked[-1]} if same else {}


def _decimal(rows: Rows) -> str:
    """Return the decimal mark of the numbers that a spreadsheet holds as texts."""
    texts = [c for _, cells in rows for c in cells if isinstance(c, str) and ("," in c or "." in c)]
    comma, point = (
        sum(_is_number(c, FileFormat(decimal=mark, separator=";")) for c in texts) for mark in ",."
    )
    return "," if comma > point else "."


def _spreadsheet(path: str, content: bytes) -> SniffedFile:
    best: tuple[int, str, Rows] = (0, "", [])
    counts: dict[str, int] = {}
    book = files.workbook(path, content)
    names = book.sheetnames
    for sheet in names:
        rows = files.sheet_rows(path, book, sheet, None)
        written = FileFormat(decimal=_decimal(rows))
        numbers = (np.isfinite(number(c, written)) for _, cells in rows for c in cells)
        count = counts[sheet] = sum(numbers)
        if count > best[0]:
            best = count, sheet, rows
    if not best[0]:
        raise InputError(f"{path}: no sheet with numbers; it has {', '.join(names)}")
    decimal = {"decimal": _decimal(best[2])}
    how, doubts = _layout(best[2], FileFormat(header_row=0, **decimal))
    how |= decimal
    if len(names) > 1:
        how["sheet"] = best[1]
    if others := [s for s in names if s != best[1] and counts[s] > MANY_NUMBERS * best[0]]:
        doubts = (*doubts, f"only this sheet is read, and not {', '.join(others)}")
    form = FileFormat(**how)
    return SniffedFile(_stated(form), files.grid_of_rows(path, best[2], form), doubts)
