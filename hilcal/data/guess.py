"""What the columns of a table hold, guessed from their names and values."""

from collections.abc import Callable, Iterable, Sequence
from datetime import datetime
from typing import Any

import numpy as np

from hilcal.data import column_names as words
from hilcal.data.checks import SAME_POSE
from hilcal.data.column_names import ColumnName, parse
from hilcal.data.grid import Grid
from hilcal.data.guess_values import (
    guess_by_values,
    is_quaternion,
    sentinels,
    time_unit,
)
from hilcal.data.mapping import ANGLES, UNLOADED
from hilcal.data.proposal import Proposal, Understood
from hilcal.errors import InputError
from hilcal.types import Floats

TURN = 2 * np.pi + 0.1
"""rad; a larger angle is in degrees."""
FAR = 50.0
"""A position beyond this number is in millimetres: no arm is measured from 50 m."""
GUESSED = "the convention is a guess; --config CELL.toml lets the arm tell"
SIDE_BY_SIDE = "several targets: name them as in the cell's [[tool.targets]]"
REPORTED = 5e-3
"""rad; encoders at rest in one pose differ by less, commanded poses by more; a choice."""
FEWEST_JOINTS, MOST_JOINTS = 4, 8
SHOWN = 3


class Guesser:
    """Columns that are not yet used, and the mapping that grows."""

    def __init__(self, grid: Grid, joints: int | None) -> None:
        """Take the table apart.

        Args:
            grid: the table.
            joints: of the arm, where the cell is known.
        """
        self.grid = grid
        self.joints = joints
        self.columns = [parse(name, grid.units.get(name, "")) for name in grid.names]
        self.proposal = Proposal()
        self.free = dict(zip(grid.names, self.columns, strict=True))
        self.values: dict[str, Floats | None] = {name: self._numbers(name) for name in grid.names}

    def _numbers(self, name: str) -> Floats | None:
        try:
            values = self.grid.numbers(name)
        except InputError:
            return None
        return values if np.isfinite(values).any() else None

    def number(self, name: str) -> bool:
        """Whether a column holds numbers."""
        return self.values[name] is not None

    def block(self, names: Iterable[str]) -> Floats:
        """(N, k) numbers of columns."""
        return np.stack([self._known(name) for name in names], axis=1)

    def _known(self, name: str) -> Floats:
        values = self.values[name]
        return np.full(len(self.grid.rows), np.nan) if values is None else values

    def take(self, what: str, names: Sequence[str], meaning: str, **section: object) -> None:
        """Give columns a meaning."""
        key = "column" if "column" in section else "columns"
        section = {key: names[0] if key == "column" else list(names)} | section
        self.proposal.sections[what] = section
        examples = tuple(self.grid.text(name)[0] for name in names)
        self.proposal.understood.append(Understood(what, tuple(names), meaning, examples))
        for name in names:
            self.free.pop(name, None)

    def unsure(self, about: str, sentence: str) -> None:
        """Note what should be checked."""
        self.proposal.unsure.append((about, sentence))

    def drop(self, name: str, why: str) -> None:
        """Leave a column unused."""
        if self.free.pop(name, None) is not None:
            self.proposal.unused.append((name, why))

    def unit(self, names: Sequence[str]) -> str | None:
        """Return the unit that the names of columns, or the row of units, state."""
        found = {self.columns[self.grid.names.index(name)].unit for name in names}
        return found.pop() if len(found) == 1 else None


def guess(grid: Grid, joints: int | None = None) -> Proposal:
    """Propose a mapping for a table.

    Args:
        grid: the table.
        joints: number of the arm's joints, where it is known.
    """
    g = Guesser(grid, joints)
    _joints(g)
    _triples(g)
    if any(what not in g.proposal.sections for what in ("joints", "position")):
        guess_by_values(g)
    _names(g)
    _scalars(g)
    for name, column in list(g.free.items()):
        g.drop(name, _why_unused(g, column))
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
    if column.has(words.NOMINAL):
        return "a commanded or nominal value"
    if values is None:
        return "no numbers" if any(g.grid.text(column.name)) else "empty"
    return "its name says nothing"


def angle_unit(g: Guesser, what: str, names: Sequence[str]) -> str:
    """Return the unit of angles by name, else by size."""
    stated = g.unit(names)
    largest = float(np.nanmax(np.abs(g.block(names))))
    if stated in ("rad", "mrad", "deg", "arcsec"):
        if stated == "rad" and largest > TURN:
            g.unsure(what, f"named rad, but up to {largest:.4g}: read as degrees")
            return "deg"
        return stated
    if largest > TURN:
        return "deg"
    g.unsure(what, f"no unit stated; rad, since no angle exceeds {largest:.3g}")
    return "rad"


def length_unit(g: Guesser, what: str, names: Sequence[str]) -> str:
    """Return the unit of positions by name, else by size."""
    stated = g.unit(names)
    if stated in ("m", "mm", "um", "in"):
        return stated
    largest = float(np.nanmax(np.abs(g.block(names))))
    unit = "mm" if largest > FAR else "m"
    g.unsure(what, f"no unit stated; {unit}, since the largest is {largest:.4g}")
    return unit


def _joints(g: Guesser) -> None:
    """Joint angles: columns of a joint's word and a number each, or with an arm's joint names."""
    groups: dict[tuple[str, ...], dict[int, str]] = {}
    for c in g.columns:
        if not c.numbers or c.axis or not c.has(words.JOINT) or not g.number(c.name):
            continue
        if not c.has(words.STD):
            groups.setdefault(c.words, {})[c.numbers[-1]] = c.name
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


def _kind(c: ColumnName) -> str:
    if c.has(words.STD):
        return "std_angle" if c.has(words.ROTATION) else "std"
    for kind, known in (
        ("quaternion", words.QUATERNION),
        ("angle", words.ROTATION),
        ("force", words.FORCE),
        ("moment", words.MOMENT),
    ):
        if c.has(known):
            return kind
    return "position"


_KINDS = words.STD | words.ROTATION | words.QUATERNION | words.FORCE | words.MOMENT


def _triples(g: Guesser) -> None:
    """Positions, orientations, forces and standard deviations, which come by axes."""
    sets: dict[str, dict[tuple[object, ...], dict[str, str]]] = {}
    for c in g.columns:
        if c.axis and c.name in g.free and g.number(c.name):
            stem = (*(w for w in c.words if w not in _KINDS | {"pos", "position", "p"}), *c.numbers)
            sets.setdefault(_kind(c), {}).setdefault(stem, {})[c.axis] = c.name
    if "force" not in sets and "moment" in sets:  # tx, ty, tz are then translations
        for stem, axes in sets.pop("moment").items():
            sets.setdefault("position", {}).setdefault(stem, axes)
    whole = {
        kind: {stem: axes for stem, axes in found.items() if set("xyz") <= set(axes)}
        for kind, found in sets.items()
    }
    _covariance(g)
    positions = whole.get("position", {})
    if not positions:
        return
    ranked = sorted(positions, key=lambda stem: _rank(stem))
    stem = ranked[0]
    names = [positions[stem][axis] for axis in "xyz"]
    side_by_side = _several(positions, stem)
    if side_by_side:
        names = [positions[s][axis] for s in side_by_side for axis in "xyz"]
        unit = length_unit(g, "position", names)
        targets = [str(s[-1]) for s in side_by_side]
        meaning = f"{unit}, {len(targets)} targets"
        g.take("position", names, meaning, unit=unit, targets=targets)
        g.unsure("position", SIDE_BY_SIDE)
    else:
        unit = length_unit(g, "position", names)
        g.take("position", names, unit, unit=unit)
    ranked = [s for s in ranked if s not in side_by_side]
    others = [
        positions[s]["x"] for s in ranked if s != stem and not set(map(str, s)) & words.NOMINAL
    ]
    if others:
        listed = ", ".join(f"'{name}' ..." for name in others[:SHOWN])
        g.unsure("position", f"'{names[0]}' ... are used, not {listed}")
    marks = sentinels(g.block(names))
    if marks:
        g.proposal.sections["file"] = {"missing": marks}
        g.unsure("file", f"{', '.join(map('{:g}'.format, marks))} stands for a missing point")
    _orientation(g, whole, stem)
    _forces(g, whole)
    _std(g, whole, stem, unit)


def _several(
    positions: dict[tuple[object, ...], dict[str, str]], stem: tuple[object, ...]
) -> list[tuple[object, ...]]:
    """Positions whose names differ by a number alone, which are those of several targets."""
    if not stem or not isinstance(stem[-1], int):
        return []
    alike = [s for s in positions if s[:-1] == stem[:-1] and s and isinstance(s[-1], int)]
    return sorted(alike, key=str) if len(alike) > 1 else []


def _rank(stem: tuple[object, ...]) -> tuple[int, int]:
    names = {str(w) for w in stem}
    order = 2 if names & words.NOMINAL else (0 if names & words.MEASURED else 1)
    return order, len(stem)


def _covariance(g: Guesser) -> None:
    """Covariances "cov_x_y" ...: the upper triangle or all nine."""
    by_axes: dict[str, str] = {}
    for name in g.grid.names:
        plain = "".join(ch for ch in name.lower().split("[")[0] if ch.isalpha())
        if plain.startswith(("cov", "kov")) and plain[3:5].strip("xyz") == "":
            by_axes[plain[3:5]] = name
    upper = ["xx", "xy", "xz", "yy", "yz", "zz"]
    if all(axes in by_axes for axes in upper):
        names = [by_axes[axes] for axes in upper]
        g.unsure("covariance", "the unit is that of the position, squared")
        g.take("covariance", names, "upper triangle", unit="m")


Group = dict[str, dict[tuple[object, ...], dict[str, str]]]


def _orientation(g: Guesser, whole: Group, stem: tuple[object, ...]) -> None:
    quaternions = {s: a for s, a in whole.get("quaternion", {}).items() if "w" in a}
    best = _like(quaternions, stem)
    if best is not None:
        names = [best[axis] for axis in "wxyz"]
        g.take("orientation", names, "quaternion, w first", convention="quaternion-wxyz")
        return
    if _four_numbers(g) or _matrix(g):
        return
    angles = whole.get("angle", {})
    if stem in angles:
        _by_axes(g, [angles[stem][axis] for axis in "xyz"])
        return
    for letters, convention in (
        ("wpr", "fanuc"),
        ("abc", "kuka"),
        ("oat", "kawasaki"),
    ):
        by_letter = {c.name.strip().lower(): c.name for c in g.columns if c.name in g.free}
        plain = {key.split("[")[0].split("(")[0].strip(): name for key, name in by_letter.items()}
        if all(letter in plain and g.number(plain[letter]) for letter in letters):
            names = [plain[letter] for letter in letters]
            _angles(g, names, convention, sure=False)
            return
    usable = [c for c in g.columns if c.name in g.free and not c.has(words.NOMINAL)]
    turns = {c.words[-1]: c.name for c in usable if c.words}
    if {"roll", "pitch", "yaw"} <= set(turns):
        _angles(g, [turns[w] for w in ("roll", "pitch", "yaw")], "roll-pitch-yaw", sure=False)
        return
    axes = _like(angles, stem)
    if axes is not None:
        _by_axes(g, [axes[axis] for axis in "xyz"])


def _by_axes(g: Guesser, names: list[str]) -> None:
    """Angles named by axes: a rotation vector where none is longer than π, else fixed angles."""
    length = np.linalg.norm(g.block(names), axis=1)
    vector = np.nanmax(length) <= np.pi + 1e-3
    _angles(g, names, "rotation-vector" if vector else "fixed-xyz", sure=False)


def _like(
    found: dict[tuple[object, ...], dict[str, str]], stem: tuple[object, ...]
) -> dict[str, str] | None:
    """Return the columns whose name agrees with that of the position, else measured ones."""
    if stem in found:
        return found[stem]
    usable = [s for s in found if not {str(w) for w in s} & words.NOMINAL]
    return found[min(usable, key=_rank)] if usable else None


def _angles(g: Guesser, names: list[str], convention: str, *, sure: bool) -> None:
    unit = angle_unit(g, "orientation", names)
    g.take("orientation", names, f"{convention}, {unit}", convention=convention, unit=unit)
    g.proposal.open_convention = not sure


def _four_numbers(g: Guesser) -> bool:
    """Quaternions q1 ... q4 (ABB) or q0 ... q3, told from joints by their length."""
    groups: dict[tuple[str, ...], dict[int, str]] = {}
    for c in g.columns:
        if c.numbers and not c.axis and c.has(words.QUATERNION | {"e"}) and c.name in g.free:
            groups.setdefault(c.words, {})[c.numbers[-1]] = c.name
    for by_number in groups.values():
        names = [by_number[k] for k in sorted(by_number)]
        if len(names) == 4 and is_quaternion(g.block(names)):
            g.take("orientation", names, "quaternion, w first", convention="quaternion-wxyz")
            g.proposal.open_convention = True
            return True
    return False


def _matrix(g: Guesser) -> bool:
    """Rotation matrices r11 ... r33, R(1,1) ..., and poses T(1,1) ... T(4,4)."""
    for word in ("r", "rot", "t", "m"):
        by_place: dict[tuple[int, int], str] = {}
        for c in g.columns:
            if c.words[:1] == (word,) and c.axis is None and c.name in g.free:
                at = c.numbers if len(c.numbers) == 2 else tuple(divmod(sum(c.numbers), 10))
                by_place[int(at[0]), int(at[1])] = c.name
        for base in (0, 1):
            places = [(i + base, j + base) for i in range(3) for j in range(3)]
            if all(place in by_place for place in places):
                names = [by_place[place] for place in places]
                g.take("orientation", names, "rotation matrix", convention="matrix")
                return True
    return False


def _forces(g: Guesser, whole: Group) -> None:
    force = next(iter(whole.get("force", {}).values()), None)
    if force is None:
        return
    names = [force[axis] for axis in "xyz"]
    unit = g.unit(names)
    section: dict[str, object] = {"unit": unit if unit in ("N", "kN", "kgf", "lbf") else "N"}
    moment = next(iter(whole.get("moment", {}).values()), None)
    if moment is not None:
        turning = [moment[axis] for axis in "xyz"]
        stated = g.unit(turning)
        section["moment_unit"] = stated if stated in ("Nm", "Nmm", "kNm") else "Nm"
        names += turning
    g.unsure("wrench", 'base axes, and of = "load" (exerted on the tool), or "reaction"?')
    g.take("wrench", names, ", ".join(map(str, section.values())), **section)


def _std(g: Guesser, whole: Group, stem: tuple[object, ...], position_unit: str) -> None:
    axes = _like(whole.get("std", {}), stem)
    one = [c for c in g.columns if c.name in g.free and c.has(words.STD) and not c.axis]
    single = [c.name for c in one if g.number(c.name) and not c.numbers]
    if axes is None and not single:
        return
    names = [axes[axis] for axis in "xyz"] if axes is not None else single[:1]
    first = parse(names[0])
    stated = g.unit(names)
    section: dict[str, object] = {
        "unit": stated if stated in ("m", "mm", "um", "in") else position_unit
    }
    turned = _like(whole.get("std_angle", {}), stem)
    orientation = g.proposal.sections.get("orientation")
    if axes is not None and turned is not None and orientation is not None:
        names += [turned[axis] for axis in "xyz"]
        stated = g.unit(names[3:])
        section["angle_unit"] = stated or orientation.get("unit", "rad")
    kind = "std"
    if first.has(words.EXPANDED):
        kind, section["k"] = "expanded", 2.0
        g.unsure("std", "expanded uncertainty: is k = 2 right?")
    elif first.has(words.VARIANCE):
        kind = "variance"
    elif first.has({"u", "unc", "uncertainty", "unsicherheit", "incertitude"}):
        g.unsure("std", 'a standard deviation, or kind = "expanded" with its k?')
    section["kind"] = kind
    if axes is None:
        g.unsure("std", 'one figure: of = "axis", or "point" (3-D length)?')
    g.unsure("std", "scatter of samples only? Then set add_instrument = true")
    g.take("std", names, f"{kind}, {', '.join(str(v) for v in section.values() if v != kind)}",
           **section)  # fmt: skip


def _names(g: Guesser) -> None:
    """Poses, loads, cycles and reflectors."""
    q = g.proposal.sections.get("joints")
    _pick(g, "pose", words.POSE, lambda n: q is None or _one_pose_each(g, n, q))
    for c in list(g.free.values()):
        if c.has(words.MASS | words.LOAD) and g.number(c.name) and "load" not in g.free:
            mass = c.unit in ("kg", "g", "lb") or c.has(words.MASS)
            if mass and "hung_mass" not in g.proposal.sections:
                unit = c.unit if c.unit in ("kg", "g", "lb") else "kg"
                if "wrench" in g.proposal.sections:
                    continue
                g.take("hung_mass", [c.name], unit, column=c.name, unit=unit)
    if "hung_mass" not in g.proposal.sections:
        _pick(g, "load", words.LOAD, lambda n: True)
    if not {"load", "hung_mass"} & set(g.proposal.sections):
        for c in list(g.free.values()):
            texts = [t.lower() for t in g.grid.text(c.name)]
            few = 1 < len(set(texts)) <= 20
            if not g.number(c.name) and few and set(texts) & (set(UNLOADED) - {"0", "-", "no"}):
                g.take("load", [c.name], "name", column=c.name)
                g.unsure("load", f"'{c.name}' has a value that means no load")
                break
    _pick(g, "cycle", words.CYCLE, lambda n: g.number(n) and _whole(g, n))
    _pick(g, "target", words.REFLECTOR, lambda n: not g.number(n) and _few(g, n))


def _pick(
    g: Guesser, what: str, known: set[str], fits: Callable[[str], bool], meaning: str = "name"
) -> None:
    for c in list(g.free.values()):
        if c.has(known) and not c.axis and not c.has(words.STD) and _is_name(g, c.name):
            if not fits(c.name):
                continue
            g.take(what, [c.name], meaning, column=c.name)
            return


def _is_name(g: Guesser, name: str) -> bool:
    """Whether a column holds text or whole numbers."""
    return not g.number(name) or _whole(g, name)


def _whole(g: Guesser, name: str) -> bool:
    values = g.block([name])[:, 0]
    known = values[np.isfinite(values)]
    return bool(np.all(known == np.rint(known)))


def _few(g: Guesser, name: str) -> bool:
    return 1 < len(set(g.grid.text(name))) <= 20


def _one_pose_each(g: Guesser, name: str, joints: dict[str, Any]) -> bool:
    """Whether all rows of a name command the same joints, or reported nearly the same."""
    texts = g.grid.text(name)
    if "" in texts:
        return False
    q = g.block(joints["columns"]) * ANGLES[joints["unit"]]
    first: dict[str, int] = {}
    rows = [first.setdefault(text, k) for k, text in enumerate(texts)]
    off = np.nan_to_num(np.abs(q - q[rows]))
    if off.max() > REPORTED:
        k = int(np.argmax(off.max(axis=1)))
        g.unsure("joints", f"'{name}' is no pose: '{texts[k]}' stands at different joints")
        return False
    if off.max() > SAME_POSE and "actual_joints" not in g.proposal.sections:
        joints["reported"] = True
        g.unsure("joints", f"they differ by up to {off.max():.2g} rad in a pose: reported angles")
    return True


def _scalars(g: Guesser) -> None:
    """Times and the temperature of the air."""
    for c in list(g.free.values()):
        dated = all(isinstance(cell, datetime) for cell in g.grid.cells(c.name))
        timed = dated or (c.has(words.TIME) and not c.axis)
        if "time" not in g.proposal.sections and timed:
            found = time_unit(g.grid, c.name, c.unit, g.values[c.name])
            if found is not None:
                section, doubt = found
                if doubt:
                    g.unsure("time", doubt)
                g.take("time", [c.name], str(section["unit"]), column=c.name, **section)
        elif (
            "air" not in g.proposal.sections
            and (c.has(words.TEMPERATURE) or (c.has(words.AIR) and c.unit in ("degC", "K", "degF")))
            and g.number(c.name)
            and not c.numbers
        ):
            values = g.block([c.name])
            unit = c.unit or ("K" if np.nanmin(values) > 200 else "degC")
            if unit in ("degC", "degF", "K"):
                g.take("air", [c.name], unit, column=c.name, unit=unit)
