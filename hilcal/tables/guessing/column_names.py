"""What the name of a column says: its words, its axis or number, its unit.

Names in several styles and languages are taken apart into words: "measurement_std_rx",
"Joint Angle 3 [deg]", "MessX (mm)", "actual_q_0", "T(1,4)".
"""

import re
import unicodedata
from dataclasses import dataclass

UNITS = {
    "m": "m", "meter": "m", "metre": "m", "mm": "mm", "millimeter": "mm", "um": "um",
    "micron": "um", "in": "in", "inch": "in", "inches": "in",
    "rad": "rad", "mrad": "mrad", "deg": "deg", "degree": "deg", "degrees": "deg", "grad": "deg",
    "°": "deg", "arcsec": "arcsec",
    "n": "N", "newton": "N", "kn": "kN", "kgf": "kgf", "lbf": "lbf",
    "nm": "Nm", "n*m": "Nm", "n·m": "Nm", "nmm": "Nmm", "knm": "kNm",
    "kg": "kg", "g": "g", "lb": "lb", "lbs": "lb",
    "s": "s", "sec": "s", "seconds": "s", "ms": "ms", "min": "min", "h": "h",
    "c": "degC", "°c": "degC", "degc": "degC", "celsius": "degC", "k": "K", "f": "degF",
    "°f": "degF", "degf": "degF",
}  # fmt: skip
"""Units as they are written, in small letters, and as a mapping calls them."""

STD = {
    "std", "stdev", "stddev", "sd", "sigma", "s", "u", "unc", "uncert", "uncertainty", "u95", "u2",
    "expanded", "unsicherheit", "standardabweichung", "stabw", "incertitude", "ecart", "incert",
    "incertidumbre", "var", "variance", "varianz", "deviation",
}  # fmt: skip
EXPANDED = {"u95", "u2", "expanded"}
VARIANCE = {"var", "variance", "varianz"}
ROTATION = {"r", "rot", "rotation", "ang", "angle", "euler", "winkel", "rotvec", "rv"}
FORCE = {"f", "force", "kraft", "fuerza"}
MOMENT = {"m", "mom", "moment", "torque", "t", "drehmoment", "couple"}
QUATERNION = {"q", "quat", "quaternion"}
NOMINAL = {
    "goal", "nom", "nominal", "soll", "target", "ziel", "cmd", "command", "commanded", "ref",
    "reference", "ideal", "set", "setpoint", "programmed", "flange", "flansch", "tcp", "robot",
}  # fmt: skip
MEASURED = {
    "meas", "measured", "measurement", "measure", "ist", "actual", "act", "track", "tracker",
    "laser", "lt", "smr", "gemessen", "mess", "messung", "mesure", "mesuree", "medido", "medida",
    "obs", "observed", "enc", "encoder", "feedback", "reported", "recorded",
}  # fmt: skip
JOINT = {
    "q", "j", "jt", "jnt", "joint", "joints", "axis", "axes", "achse", "achsen", "gelenk", "axe",
    "articulation", "eje", "articulacion", "a", "ax", "rax", "theta", "th", "giunto", "qa",
    "achswinkel", "gelenkwinkel", "jointangle", "jointposition", "axisangle",
}  # fmt: skip
"""Words of joint angles; with a number each."""
NO_ANGLE = {
    "temp", "temperature", "temperatur", "current", "strom", "torque", "moment", "drehmoment",
    "speed", "velocity", "vel", "qd", "qdd", "acc", "acceleration", "voltage", "error", "offset",
    "approach", "richtung", "direction", "degc",
}  # fmt: skip
TORQUE = {"tau", "torque", "drehmoment", "moment", "gelenkmoment", "achsmoment", "couple"}
"""Words of measured joint torques; with a number each."""
DISTANCE = {"distance", "dist", "abstand", "entfernung", "length", "lange", "range", "ballbar"}
GAUGE = {"gauge", "messuhr", "taster", "dial", "indicator", "height", "hohe", "hauteur"}
FROM = {"from", "von", "point", "punkt", "ball", "kugel", "anchor", "bar", "plane", "ebene"}
"""Words of what a distance or a height is of, beside those of the quantity itself."""
STATION = {"station", "standpunkt", "stationierung", "aufstellung"}
TEMPERATURE = {"temp", "temperature", "temperatur", "temperatura"}
APPROACH = {"approach", "richtung", "direction", "anfahrt"}
POSE = {
    "pose", "poses", "point", "punkt", "pt", "messpunkt", "posenr", "id", "name", "nr", "no",
    "number", "index", "position", "punto", "target", "p", "pkt", "label", "repere",
}  # fmt: skip
LOAD = {"load", "last", "payload", "charge", "carga", "loadcase", "lastfall", "zuladung"}
MASS = {"mass", "masse", "weight", "gewicht", "masa", "peso"}
CYCLE = {"cycle", "zyklus", "repeat", "repetition", "wiederholung", "lauf", "ciclo"}
TIME = {"time", "zeit", "timestamp", "date", "datum", "datetime", "zeitstempel", "temps", "hora",
        "t"}  # fmt: skip
REFLECTOR = {"target", "reflector", "reflektor", "prism", "prisma", "smr", "nest"}
AIR = {"air", "luft", "ambient", "umgebung", "room", "raum", "aire"}
ARM_JOINTS = (
    ("shoulder", "pan"),
    ("shoulder", "lift"),
    ("elbow",),
    ("wrist", "1"),
    ("wrist", "2"),
    ("wrist", "3"),
)
"""Joint names of Universal Robots arms under ROS, in order."""

DIFFERENCE = {"dev", "delta", "diff", "difference", "error", "err", "residual", "abweichung"}
"""Words of what is no reading but compared with one."""
CHINESE = {
    "关节": " joint ", "轴": " joint ", "坐标": " ", "位置": " ", "测量": " measured ",
    "温度": " temperature ", "负载": " load ", "编号": " point ", "点号": " point ",
    "时间": " time ", "实际": " actual ", "理论": " nominal ",
}  # fmt: skip
"""Words without letters, as those with."""

_PREFIXES = STD | ROTATION | FORCE | MOMENT | QUATERNION | MEASURED | NOMINAL | {"p", "pos", "d"}


@dataclass(frozen=True, slots=True)
class ColumnName:
    """A column's name, taken apart."""

    name: str  # as the file has it
    words: tuple[str, ...]  # in small letters, without axis and number
    axis: str | None  # "x", "y", "z" or "w", where the name ends in one
    numbers: tuple[int, ...]  # the numbers in it
    unit: str | None  # as a mapping calls it, where the name or the row of units says it

    def has(self, words: set[str]) -> bool:
        """Whether one of its words is among these."""
        return not words.isdisjoint(self.words)


def parse(name: str, unit_cell: str = "") -> ColumnName:
    """Take a column's name apart."""
    rest, unit = _unit(name)
    told = UNITS.get(unit_cell.strip(" []()<>").replace("µ", "u").replace("μ", "u").lower())
    for sign, word in CHINESE.items():
        rest = rest.replace(sign, word)
    rest = re.sub(r"(?<=[a-zµ])(?=[A-Z])", " ", rest)
    plain = unicodedata.normalize("NFKD", rest.replace("ß", "ss")).encode("ascii", "ignore")
    words: list[str] = []
    numbers: list[int] = []
    axis = None
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
        elif letters in ("x", "y", "z"):
            axis = letters
        elif letters[-1] in "wxyz" and letters[:-1] in _PREFIXES:
            axis = letters[-1]
            words.append(letters[:-1])
        elif letters[0] in "xyz" and letters[1:] in MEASURED | NOMINAL | STD:
            axis = letters[0]
            words.append(letters[1:])
        else:
            words.append(letters)
    return ColumnName(name, tuple(words), axis, tuple(numbers), told or unit)


def _unit(name: str) -> tuple[str, str | None]:
    """Name without its unit, and the unit."""
    plain = name.replace("µ", "u").replace("μ", "u").strip()
    for found in re.finditer(r"[\[({<]\s*([^\])}>]+?)\s*[\])}>]", plain):
        if unit := UNITS.get(found[1].lower()):
            return plain[: found.start()] + plain[found.end() :], unit
    ending = re.search(r"[ _/.,-]+([A-Za-z°·*]+)$", plain)
    if ending and (unit := UNITS.get(ending[1].lower())):
        single = len(ending[1]) == 1
        if not single or ending[1] in ("m", "N", "K", "°", "s"):
            return plain[: ending.start()], unit
    return plain, None
