"""What the columns of a table hold, guessed from their names and values."""

import numpy as np

from hilcal.tables.columns import required_columns
from hilcal.tables.grid import Grid
from hilcal.tables.guessing import column_names as words
from hilcal.tables.guessing.column_names import ColumnName, parse
from hilcal.tables.guessing.guess_axes import guess_axes
from hilcal.tables.guessing.guess_names import guess_names, guess_scalars
from hilcal.tables.guessing.guess_values import guess_by_values, is_quaternion
from hilcal.tables.guessing.guesser import FEWEST_JOINTS, GUESSED, MOST_JOINTS, Guesser, angle_unit
from hilcal.tables.guessing.proposal import Proposal


def guess(grid: Grid, joints: int | None = None) -> Proposal:
    """Propose a mapping for a table.

    Args:
        grid: the table.
        joints: number of the arm's joints, where it is known.
    """
    g = Guesser(grid, joints)
    _joints(g)
    guess_axes(g)
    if any(what not in g.proposal.sections for what in ("joints", "position")):
        guess_by_values(g)
    guess_names(g)
    guess_scalars(g)
    for name, column in list(g.free.items()):
        g.drop(name, _why_unused(g, column))
    if set(required_columns(joints or 6)) <= set(grid.names):
        g.unsure("file", "this is an exchange table: it is imported without --format")
    if g.proposal.open_convention:
        g.unsure("orientation", GUESSED)
    for what, sentence in (
        ("position", "no position: three columns x, y, z were not found"),
        (
            "joints",
            "no joint angles: where they are in a file of their own, give it with --second",
        ),
    ):
        if what not in g.proposal.sections:
            g.proposal.lacking.append(sentence)
    if "pose" not in g.proposal.sections and "joints" in g.proposal.sections:
        g.unsure("pose", "no column names the pose: rows of the same joints count as one pose")
    if not {"load", "hung_mass", "wrench"} & set(g.proposal.sections):
        g.unsure("load", "no column tells the load: all readings count as unloaded")
    return g.proposal


def _why_unused(g: Guesser, column: ColumnName) -> str:
    values = g.values[column.name]
    if values is not None and np.nanmax(values) == np.nanmin(values):
        return f"constant, {np.nanmax(values):g}"
    if column.has(words.DIFFERENCE):
        return "a difference"
    if column.has(words.NOMINAL):
        return "a commanded or nominal value"
    if values is None:
        return "no numbers" if any(g.grid.text(column.name)) else "empty"
    return "its name says nothing"


def _joints(g: Guesser) -> None:
    """Joint angles: columns of a joint's word and a number each, or with an arm's joint names."""
    groups: dict[tuple[str, ...], dict[int, str]] = {}
    for c in g.columns:
        if not c.numbers or c.axis or not c.has(words.JOINT) or not g.number(c.name):
            continue
        if not c.has(words.STD):
            groups.setdefault(c.words, {}).setdefault(c.numbers[-1], c.name)
    found: list[tuple[ColumnName, list[str]]] = []
    for by_number in groups.values():
        names = [by_number[k] for k in sorted(by_number)]
        first = parse(names[0])
        if is_quaternion(g.block(names)) and len(names) == 4:
            continue
        if sorted(by_number)[0] > 1 or not FEWEST_JOINTS <= len(names) <= MOST_JOINTS:
            continue
        if first.has(words.NO_ANGLE):
            _per_joint(g, first, names)
        else:
            found.append((first, names))
    named = [_with_words(g, w) for w in words.ARM_JOINTS]
    if all(named):
        found.append((parse("joint"), [str(name) for name in named]))
    if not found:
        return
    found.sort(key=lambda f: (f[0].has(words.MEASURED | {"qa"}), not f[0].has(words.NOMINAL)))
    first, names = found[0]
    if first.has(words.MEASURED | {"qa"}):
        g.unsure("joints", f"'{names[0]}' ... are reported angles, used as the commanded ones")
    unit = angle_unit(g, "joints", names)
    g.take("joints", names, unit, unit=unit)
    if g.joints is not None and len(names) != g.joints:
        g.unsure("joints", f"{len(names)} columns, the arm has {g.joints} joints")
    for other, rest in found[1:]:
        if other.has(words.MEASURED | {"qa"}) and len(rest) == len(names):
            same = np.nanmax(np.abs(g.block(rest) - g.block(names)))
            if same < (0.1 if unit == "rad" else 5.7):
                g.take("actual_joints", rest, unit, unit=unit)
                break


def _with_words(g: Guesser, wanted: tuple[str, ...]) -> str | None:
    for c in g.columns:
        digits = {str(k) for k in c.numbers}
        if set(wanted) <= set(c.words) | digits and g.number(c.name) and not c.has(words.NO_ANGLE):
            return c.name
    return None


def _per_joint(g: Guesser, first: ColumnName, names: list[str]) -> None:
    """Temperatures and sides of approach of the joints."""
    values = g.block(names)
    if first.has(words.TEMPERATURE) or first.unit == "degC" or first.has({"degc"}):
        unit = first.unit if first.unit in ("degC", "degF", "K") else "degC"
        g.take("joint_temperatures", names, unit, unit=unit)
    elif first.has(words.APPROACH) and np.all(np.isin(values, (-1.0, 1.0))):
        g.take("approach", names, "-1 or +1")
