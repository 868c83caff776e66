"""Vocabulary and parsing of column names, and the mapping that is being proposed."""

import re
import unicodedata
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hilcal.config.reference import inline
from hilcal.errors import InputError
from hilcal.names import escaped
from hilcal.tables.grid import Grid
from hilcal.tables.mapping import M
from hilcal.tables.units import ANGLES, LENGTHS
from hilcal.toml import check_section
from hilcal.types import Floats

UNITS = {
    "m": "m", "meter": "m", "metre": "m", "cm": "cm", "mm": "mm", "millimeter": "mm", "um": "um",
    "micron": "um", "microns": "um", "m2": "m²", "m^2": "m²", "m²": "m²", "mm2": "mm²",
    "mm^2": "mm²", "mm²": "mm²", "um2": "um²", "um^2": "um²", "um²": "um²", "in": "in",
    "inch": "in", "inches": "in",
    "rad": "rad", "mrad": "mrad", "deg": "deg", "degree": "deg", "degrees": "deg", "grad": "deg",
    "°": "deg", "arcsec": "arcsec",
    "n": "N", "newton": "N", "kn": "kN", "kgf": "kgf", "lbf": "lbf",
    "nm": "Nm", "n*m": "Nm", "n·m": "Nm", "nmm": "Nmm", "knm": "kNm",
    "kg": "kg", "g": "g", "lb": "lb", "lbs": "lb",
    "s": "s", "sec": "s", "seconds": "s", "ms": "ms", "msec": "ms", "us": "us", "usec": "us",
    "ns": "ns", "nsec": "ns", "nanoseconds": "ns", "min": "min", "h": "h",
    "c": "degC", "°c": "degC", "degc": "degC", "celsius": "degC", "k": "K", "f": "degF",
    "°f": "degF", "degf": "degF", "fahrenheit": "degF", "kelvin": "K", "℃": "degC", "℉": "degF",
    "米": "m", "毫米": "mm", "微米": "um", "度": "deg", "弧度": "rad", "千克": "kg", "公斤": "kg",
    "牛": "N", "秒": "s", "毫秒": "ms", "摄氏度": "degC",
}  # fmt: skip
"""Units as they are written, in small letters, and as a mapping calls them."""

STD = {
    "std", "stdev", "stddev", "sd", "sigma", "s", "u", "unc", "uncert", "uncertainty", "u95", "u2",
    "expanded", "unsicherheit", "standardabweichung", "stabw", "incertitude", "ecart", "incert",
    "incertidumbre", "var", "variance", "varianz", "standard",
}  # fmt: skip
EXPANDED = {"u95", "u2", "expanded"}
VARIANCE = {"var", "variance", "varianz"}
ROTATION = {
    "r", "rot", "rotation", "orientation", "ang", "angle", "euler", "winkel", "rotvec", "rv",
}  # fmt: skip
FORCE = {"f", "force", "kraft", "fuerza"}
MOMENT = {"m", "mom", "moment", "torque", "t", "drehmoment", "couple"}
QUATERNION = {"q", "quat", "quaternion"}
NOMINAL = {
    "goal", "nom", "nominal", "soll", "target", "ziel", "cmd", "command", "commanded", "ref",
    "reference", "ideal", "set", "setpoint", "programmed", "flange", "flansch", "tcp", "robot",
    "des", "desired", "theo", "theoretical", "theoretisch", "theorique", "teorico", "planned",
    "expected", "calc", "calculated", "computed", "berechnet", "calcule", "fk", "cad", "design",
}  # fmt: skip
MEASURED = {
    "meas", "measured", "measurement", "measure", "ist", "actual", "act", "track", "tracker",
    "laser", "lt", "smr", "gemessen", "mess", "messung", "mesure", "mesuree", "medido", "medida",
    "real", "reel", "reelle", "obs", "observed", "enc", "encoder", "feedback", "reported",
    "recorded",
}  # fmt: skip
JOINT = {
    "q", "j", "jt", "jnt", "joint", "joints", "axis", "axes", "achse", "achsen", "gelenk", "axe",
    "articulation", "eje", "articulacion", "a", "ax", "rax", "theta", "th", "giunto", "qa",
    "achswinkel", "gelenkwinkel", "jointangle", "jointposition", "axisangle",
}  # fmt: skip
"""Words of joint angles; with a number each."""
POSITIONS = {"position", "positions"}
"""Words of joint angles under ROS, with a number each, one per joint of the arm."""
NO_ANGLE = {
    "temp", "temperature", "temperatur", "current", "strom", "torque", "moment", "drehmoment",
    "speed", "velocity", "vel", "qd", "qdd", "acc", "acceleration", "voltage", "error", "offset",
    "approach", "richtung", "direction", "degc",
}  # fmt: skip
TORQUE = {"tau", "torque", "drehmoment", "moment", "gelenkmoment", "achsmoment", "couple"}
"""Words of measured joint torques; with a number each."""
DISTANCE = {"distance", "dist", "abstand", "entfernung", "length", "lange", "range", "ballbar"}
GAUGE = {"gauge", "messuhr", "taster", "dial", "indicator", "height", "hohe", "hauteur"}
LASERS = {"l", "laser"}
"""Words of distances side by side, with a number each."""
AZIMUTH = {"azimuth", "azimut", "az", "hz", "horizontal"}
ELEVATION = {"zenith", "zenit", "elevation", "el", "v", "vz", "vertical", "polar"}
FROM = {"from", "von", "point", "punkt", "ball", "kugel", "anchor", "bar", "plane", "ebene"}
"""Words of the point or plane of a distance or height, besides those of the quantity itself."""
STATION = {"station", "standpunkt", "stationierung", "aufstellung"}
TEMPERATURE = {"temp", "temperature", "temperatur", "temperatura"}
RAIL = {
    "track", "rail", "linear", "slide", "slider", "lift", "gantry", "carriage", "travel", "schiene",
    "linearachse", "fahrachse", "hubachse", "e", "ext", "external",
}  # fmt: skip
"""Words of the travel of a joint that slides."""
APPROACH = {"approach", "richtung", "direction", "anfahrt"}
POSE = {
    "pose", "poses", "point", "punkt", "pt", "messpunkt", "posenr", "id", "name", "nr", "no",
    "number", "index", "position", "pos", "punto", "target", "p", "pkt", "label", "repere",
}  # fmt: skip
LOAD = {"load", "last", "payload", "charge", "carga", "loadcase", "lastfall", "zuladung"}
MASS = {"mass", "masse", "weight", "gewicht", "masa", "peso"}
CYCLE = {"cycle", "zyklus", "repeat", "repetition", "wiederholung", "lauf", "ciclo"}
TIME = {"time", "zeit", "timestamp", "stamp", "date", "datum", "datetime", "zeitstempel", "temps",
        "hora", "t", "sec"}  # fmt: skip
REFLECTOR = {"target", "reflector", "reflektor", "prism", "prisma", "smr", "nest"}
AIR = {"air", "tamb", "amb", "luft", "ambient", "umgebung", "room", "raum", "aire"}
ARM_JOINTS = ("shoulder pan", "shoulder lift", "elbow", "wrist 1", "wrist 2", "wrist 3")
"""Joint names of Universal Robots arms under ROS, in order."""

DIFFERENCE = {
    "dev", "deviation", "delta", "diff", "difference", "error", "err", "residual", "abweichung",
}  # fmt: skip
"""Words of differences, which are no readings."""
CHINESE = {
    "关节": " joint ", "轴": " joint ", "坐标": " ", "位置": " ", "测量": " measured ",
    "温度": " temperature ", "负载": " load ", "编号": " point ", "点号": " point ",
    "时间": " time ", "实际": " actual ", "理论": " nominal ", "名义": " nominal ",
    "目标": " nominal ", "指令": " commanded ", "实测": " measured ", "载荷": " load ",
    "质量": " mass ", "标准差": " std ", "位姿": " pose ",
}  # fmt: skip
"""Chinese words, and the English words that replace them."""

_PREFIXES = STD | ROTATION | FORCE | MOMENT | QUATERNION | MEASURED | NOMINAL | {"p", "pos", "d"}


@dataclass(frozen=True, slots=True)
class ColumnName:
    """A parsed name of a column."""

    name: str  # as the file has it
    words: tuple[str, ...]  # in small letters, without axis and number
    axis: str | None  # "x", "y", "z" or "w", where the name ends in one
    numbers: tuple[int, ...]  # the numbers in it
    unit: str | None  # as a mapping calls it, where the name or the row of units says it

    def has(self, vocabulary: set[str]) -> bool:
        """Whether one of its words is in a vocabulary."""
        return not vocabulary.isdisjoint(self.words)


def parse(name: str, unit_cell: str = "") -> ColumnName:
    """Parse the name of a column."""
    stem, unit = _unit(name)
    stated = UNITS.get(unit_cell.strip(" []()<>").replace("µ", "u").replace("μ", "u").lower())
    for sign, word in CHINESE.items():
        stem = stem.replace(sign, word)
    stem = re.sub(r"(?<=[a-zµ])(?=[A-Z])", " ", stem)
    plain = unicodedata.normalize("NFKD", stem.replace("ß", "ss")).encode("ascii", "ignore")
    words: list[str] = []
    numbers: list[int] = []
    axis, turns = None, ROTATION | QUATERNION
    for word in re.findall(r"[a-z]+\d*|\d+", plain.decode().lower()):
        if word in STD:
            words.append(word)
            continue
        letters = word.rstrip("0123456789")
        digits = word[len(letters) :]
        if digits:
            numbers.append(int(digits))
        if not letters:
            continue
        if letters.endswith(("temperatur", "temperature")) and letters not in TEMPERATURE:
            words += [letters[: letters.index("temp")], "temperature"]
        elif letters in ("x", "y", "z") or (letters == "w" and set(words) & turns):
            axis = letters
        elif letters[-1] in "wxyz" and letters[:-1] in _PREFIXES:
            axis = letters[-1]
            words.append(letters[:-1])
        elif letters[0] in "xyz" and letters[1:] in MEASURED | NOMINAL | STD:
            axis = letters[0]
            words.append(letters[1:])
        else:
            words.append(letters)
    return ColumnName(name, tuple(words), axis, tuple(numbers), stated or unit)


def without_unit(name: str) -> str:
    """Return the name of a column in small letters, without its unit."""
    return _unit(name)[0].strip().lower()


def _unit(name: str) -> tuple[str, str | None]:
    plain = name.replace("µ", "u").replace("μ", "u").strip()
    for bracketed in re.finditer(r"[\[({<]\s*([^\])}>]+?)\s*[\])}>]", plain):
        if unit := UNITS.get(bracketed[1].lower()):
            return plain[: bracketed.start()] + plain[bracketed.end() :], unit
    ending = re.search(r"[ _/.,-]+([A-Za-z°·*]+|[mu]m2)$", plain)
    if ending and (unit := UNITS.get(ending[1].lower())):
        scale = ending[1] in ("C", "F") and "temp" in plain.lower()
        if len(ending[1]) > 1 or scale or ending[1] in ("m", "N", "K", "°", "s", "g"):
            return plain[: ending.start()], unit
    return plain, None


MAX_ANGLE_RAD = 2 * np.pi + 0.1  # rad; a larger angle is in degrees
MAX_POSITION_M = 50.0  # A larger position is in millimetres: no arm is measured from 50 m
GUESSED = "the convention is a guess; with --config CELL.toml the arm's joint values decide"
SIDE_BY_SIDE = "several targets: name them as in the cell's [[tool.targets]]"
REPORTED = 5e-3  # rad; encoders at rest in one pose differ by less, commanded poses by more
FEWEST_JOINTS, MOST_JOINTS = 4, 8
N_EXAMPLES = 3


@dataclass(frozen=True, slots=True)
class ProposedQuantity:
    """A quantity that the table holds."""

    section: str  # section of the mapping
    columns: tuple[str, ...]
    meaning: str  # unit and convention
    example: tuple[str, ...]  # the cells of the first reading


@dataclass(slots=True, eq=False)
class Proposal:
    """A mapping in the making."""

    sections: dict[str, dict[str, Any]] = field(default_factory=dict)  # of the mapping, by name
    quantities: list[ProposedQuantity] = field(default_factory=list)  # quantities of the table
    doubts: list[tuple[str, str]] = field(default_factory=list)  # by section: what to check
    unused: list[tuple[str, str]] = field(default_factory=list)  # columns, and why
    missing: list[str] = field(default_factory=list)  # sentences on quantities that an import needs
    convention_guessed: bool = False  # whether that of the orientation is a guess
    alternatives: list[tuple[list[str], list[str]]] = field(default_factory=list)
    """columns of the position and of the joints that are as good by their values, the chosen ones
    first; empty lists where names decide."""

    def mapping(self, kind: type[M]) -> M:
        """Return the mapping, `Mapping` for readings, `PointMapping` for points."""
        return check_section(self.sections, kind, "the proposed mapping")

    def to_toml(self, source: str) -> str:
        """Return the mapping file, with what is unsure as comments."""
        lines = [
            f"# How to read {source}; proposed by `hilcal import --preview`. Check what is",
            "# marked, change what is wrong, and give this file with --format.",
        ]
        lines += [f"# missing: {text}" for text in self.missing]
        absent = [(about, text) for about, text in self.doubts if about not in self.sections]
        lines += [f"# {about}: {text}" for about, text in absent]
        for name, section in self.sections.items():
            lines.append("")
            lines += [f"# check: {text}" for about, text in self.doubts if about == name]
            lines.append(f"[{name}]")
            lines += [f"{key} = {inline(_escaped(value))}" for key, value in section.items()]
        if self.unused:
            lines += ["", "# not used:"]
            lines += [f"#   {name} ({why})" for name, why in self.unused]
        return "\n".join(map(escaped, lines)) + "\n"


def _escaped(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_escaped(v) for v in value]
    return escaped(value) if isinstance(value, str) else value


class Guesser:
    """The columns that are still unused, and the mapping that is being built."""

    def __init__(self, grid: Grid, joints: int | None) -> None:
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

    def column(self, name: str) -> ColumnName:
        """Return the parsed name of a column."""
        return self.columns[self.grid.names.index(name)]

    def number(self, name: str) -> bool:
        """Whether a column holds numbers."""
        return self.values[name] is not None

    def block(self, names: Iterable[str]) -> Floats:
        """(N, k) numbers of columns."""
        nothing = np.full(len(self.grid.rows), np.nan)
        values = (self.values[name] for name in names)
        return np.stack([nothing if v is None else v for v in values], axis=1)

    def assign(self, name: str, columns: Sequence[str], meaning: str, /, **section: object) -> None:
        """Give columns a meaning."""
        key = "column" if "column" in section else "columns"
        section = {key: columns[0] if key == "column" else list(columns)} | section
        self.proposal.sections[name] = section
        examples = tuple(self.grid.text(column)[0] for column in columns)
        self.proposal.quantities.append(ProposedQuantity(name, tuple(columns), meaning, examples))
        for column in columns:
            self.free.pop(column, None)

    def doubt(self, about: str, sentence: str) -> None:
        """Note what should be checked."""
        self.proposal.doubts.append((about, sentence))

    def ignore(self, name: str, why: str) -> None:
        """Leave a column unused."""
        if self.free.pop(name, None) is not None:
            self.proposal.unused.append((name, why))

    def unit(self, names: Sequence[str], valid: Collection[str] | None = None) -> str | None:
        """Return the valid unit that the names of columns, or the row of units, agree on."""
        stated = self.units(names)
        unit = stated[0] if len(stated) == 1 else None
        return unit if valid is None or unit in valid else None

    def units(self, names: Sequence[str]) -> list[str | None]:
        """Return the different units of columns; None where one states none."""
        return list(dict.fromkeys(self.columns[self.grid.names.index(n)].unit for n in names))


def angle_unit(g: Guesser, section: str, names: Sequence[str]) -> str:
    """Return the unit of angles by name, else by size."""
    stated = g.unit(names, ANGLES)
    largest = float(np.nanmax(np.abs(g.block(names))))
    if stated is not None:
        if stated == "rad" and largest > MAX_ANGLE_RAD:
            g.doubt(section, f"named rad, but up to {largest:.4g}: read as degrees")
            return "deg"
        return stated
    unit = "deg" if largest > MAX_ANGLE_RAD else "rad"
    if different := _different_units(g, names, ANGLES):
        g.doubt(section, f"{different}; all read as {unit}")
    elif unit == "rad":
        g.doubt(section, f"no unit stated; rad, since no angle exceeds {largest:.3g}")
    return unit


def _different_units(g: Guesser, names: Sequence[str], valid: Collection[str]) -> str:
    """Return what to do where columns are in several units; nothing where they are not."""
    units = [unit for unit in g.units(names) if unit is not None and unit in valid]
    several = f"columns in {', '.join(units)}: a mapping has one unit, convert the others"
    return several if len(units) > 1 else ""


def length_unit(g: Guesser, section: str, names: Sequence[str]) -> str:
    """Return the unit of positions by name, else by size."""
    if (stated := g.unit(names, LENGTHS)) is not None:
        return stated
    largest = float(np.nanmax(np.abs(g.block(names))))
    unit = "mm" if largest > MAX_POSITION_M else "m"
    different = _different_units(g, names, LENGTHS)
    why = f"{different}; all read as {unit}" if different else ""
    g.doubt(section, why or f"no unit stated; {unit}, since the largest is {largest:.4g}")
    return unit
