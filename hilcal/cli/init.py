"""`init`: a CELL.toml to begin with, from questions or from options."""

import re
import sys
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from hilcal.cell import cell_from_config
from hilcal.cli.options import check_folder, check_new, command
from hilcal.cli.terminal import Terminal, agreed, somebody_there, terminal
from hilcal.config import CellConfig
from hilcal.config.planning import GEOMETRY, LOADED
from hilcal.config.template import cell_text
from hilcal.design.nominal_model import check_effects
from hilcal.effects.catalogue import installed
from hilcal.errors import InputError, StoppedError
from hilcal.measuring import devices
from hilcal.measuring.connect import driver
from hilcal.names import quoted
from hilcal.present.document import heading
from hilcal.robot.catalogue import OTHER_ARMS, load_arm, robot_names
from hilcal.tables.units import METRIC
from hilcal.toml import check_section
from hilcal.whole_file import replace_file

SIMULATED = "simulated"
"""Port of a force sensor that exists in the rehearsal only."""
CLOCK = 20.0
"""How much faster than real time a rehearsal goes, as in the demo's cell."""
UNITS: dict[str, dict[str, float]] = {
    "m": {**METRIC, "cm": 1e-2},
    "m/m": {"m/m": 1.0, "mm/m": 1e-3, "um/m": 1e-6, "µm/m": 1e-6, "μm/m": 1e-6},
    "kg": {"kg": 1.0, "g": 1e-3},
    "N": {"N": 1.0, "kN": 1e3},
}
"""Units that a quantity may be given in; it is in the first of them, SI, where none is given."""
_QUANTITY = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\W\d]+(?:/m)?)?")
_LOAD = re.compile(r"(?:(?P<name>[^=]+)=)?(?P<values>[^=]*?\d[^=]*?(?P<unit>kg|g|N|kN))\s*")
LOADS = 'e.g. "5 kg", or a pull in base axes: "pull x = 80, 0, 0 N"'


@dataclass(slots=True)
class Draft:
    """A cell in the making; every answer is checked as it comes."""

    base_dir: Path  # to which paths in it refer
    data: dict[str, Any] = field(default_factory=dict)  # the sections so far, as TOML has them

    def set(self, section: str, **values: object) -> None:
        """Set keys of a section."""
        data = deepcopy(self.data)
        data.setdefault(section, {}).update(values)
        self._take(data)

    def add_load(self, words: str) -> None:
        """Add a load from words, see `LOADS`; raises as `set` does."""
        match = _LOAD.fullmatch(words)
        if match is None:
            raise InputError(f"{words!r} is no load; valid: {LOADS}")
        one: dict[str, object] = {"name": (match["name"] or words.replace(" ", "")).strip()}
        if match["unit"] in UNITS["kg"]:
            one["mass_kg"] = number(match["values"], "kg")
        else:
            one["force_N"] = vector(match["values"], "N")
        data = deepcopy(self.data)
        data.setdefault("loads", []).append(one)
        self._take(data)

    def _take(self, data: dict[str, Any]) -> None:
        check_section(data, CellConfig, "the answer")
        self.data = data

    def robot(self, words: str) -> None:
        """Set the arm."""
        load_arm(words, self.base_dir)
        self.set("robot", model=words)

    def host(self, words: str) -> None:
        """Set the address of the arm's controller, and its driver."""
        if not re.fullmatch(r"[\w.:-]+", words):
            raise InputError(f'{words!r} is no address; valid: e.g. "192.168.56.101"')
        names = drivers(devices.ARMS)
        self.set("robot", driver="ur" if "ur" in names else names[0], host=words)

    def tracker(self, words: str) -> None:
        """Set the tracker's driver."""
        driver(devices.TRACKERS, words, "[tracker] driver")
        self.set("tracker", driver=words)

    def accuracy(self, words: str) -> None:
        """Set the standard deviation of a point that the tracker measures."""
        fixed, _, growing = words.partition("+")
        std = number(fixed, "m")
        per_m = number(growing, "m/m") if growing else 0.0
        keys = ("range_std", "transverse_std")
        self.set("tracker", **{f"{k}_m": std for k in keys}, **{f"{k}_per_m": per_m for k in keys})

    def readings(self, words: str) -> None:
        """Set what will be fitted."""
        if words == "deflection" and not self.data.get("loads"):
            raise InputError('"deflection" needs a load; valid without one: absolute')
        self.set("planning", readings=words)

    def force_sensor(self, words: str) -> None:
        """Set the force sensor's driver."""
        driver(devices.FORCE_SENSORS, words, "[force_sensor] driver")
        self.set("force_sensor", driver=words, port=SIMULATED)

    def floor(self, words: str) -> None:
        """Set the height that the arm stays above."""
        height = number(words, "m")
        reach = load_arm(self.data["robot"]["model"], self.base_dir).reach
        side = round(2.0 * reach, 1)
        self.set("limits", workspace_min_m=[-side, -side, height])


def number(words: str, unit: str) -> float:
    """Read a number, in `unit` or in the one that is behind it.

    Raises:
        InputError: it is none.
    """
    found = _quantities(words, unit)
    if len(found) != 1:
        raise InputError(f"{words.strip()!r} is no number; valid: one in {unit}")
    return found[0]


def vector(words: str, unit: str) -> list[float]:
    """Read three numbers, in `unit`, or each or all with the one behind it or them."""
    found = _quantities(words, unit)
    if len(found) != 3:
        many = f"{len(found)} number{'s' * (len(found) != 1)}"
        raise InputError(f"{words.strip()!r} is {many}; valid: three in {unit}")
    return found


def _quantities(words: str, unit: str) -> list[float]:
    """Read numbers with their units; empty where anything else is among them."""
    known, found = UNITS[unit], _QUANTITY.findall(words)
    if _QUANTITY.sub("", words).strip("[](),; \t").replace(",", "").replace(";", "").strip():
        return []
    given = [u for _, u in found if u]
    for u in given:
        if u not in known:
            raise InputError(f"{words.strip()!r} has the unit {u}; valid: {', '.join(known)}")
    if len(given) == 1 and found[-1][1]:
        given *= len(found)
    if given and len(given) != len(found):
        raise InputError(f"{words.strip()!r} has units behind some numbers only; valid: all or one")
    factors = [known[u] for u in given] or [1.0] * len(found)
    return [round(float(x) * f, 12) for (x, _), f in zip(found, factors, strict=True)]


def drivers(group: str) -> list[str]:
    """Names of the drivers that are installed for one kind of device."""
    return sorted({point.name for point in entry_points(group=group)})


def ports() -> list[str]:
    """Serial ports of this computer, by names that stay the same where there are such."""
    from serial.tools import list_ports  # takes a while

    there = [p.device for p in list_ports.comports()]
    folder = Path("/dev/serial/by-id")
    steady = sorted(folder.iterdir()) if folder.is_dir() else []
    named = {str(p.resolve()): str(p) for p in steady}
    return [named.get(device, device) for device in there]


@dataclass(frozen=True, slots=True)
class Item:
    """One thing that is asked for."""

    option: str  # that gives it without a question
    question: str  # in words
    take: Callable[[Draft, str], None]  # puts the answer into a draft
    needs: str = ""  # section that must be there for it to be asked
    again: bool = False  # whether there may be several
    without: str = ""  # what an empty answer means


def _set(section: str, key: str, read: Callable[[str], object]) -> Callable[[Draft, str], None]:
    return lambda draft, words: draft.set(section, **{key: read(words)})


def _connection(section: str) -> Callable[[Draft, str], None]:
    """Take a serial port, which is a path, or an address."""

    def take(draft: Draft, words: str) -> None:
        draft.data[section].pop("port", None)
        draft.set(section, **{"port" if "/" in words else "host": words})

    return take


def _metres(words: str) -> list[float]:
    return vector(words, "m")


def items() -> tuple[Item, ...]:
    """Return all that is asked for, in order."""
    trackers, sensors = drivers(devices.TRACKERS), drivers(devices.FORCE_SENSORS)
    return (
        Item(
            "--robot",
            f"Which arm? One of {', '.join(robot_names())}, or {OTHER_ARMS}",
            Draft.robot,
        ),
        Item("--host", "Address of its controller", Draft.host, without="not connected yet"),
        Item(
            "--repeatability",
            "What pose repeatability does its maker state (ISO 9283)? E.g. 0.05 mm",
            _set("robot", "repeatability_m", lambda words: number(words, "m")),
            without="that of the arm's file, if any",
        ),
        Item(
            "--tracker",
            f"Which tracker? {' or '.join(trackers)}",
            Draft.tracker,
            without="not connected yet",
        ),
        Item(
            "--tracker-port",
            "Its serial port, or its address in the network",
            _connection("tracker"),
            needs="tracker",
            without="not connected yet",
        ),
        Item(
            "--tracker-accuracy",
            "How accurate is the tracker? Standard deviation of a point, half of its maximum "
            "permissible error, e.g. 8 um + 3 um/m",
            Draft.accuracy,
            without="as a Leica AT500",
        ),
        Item(
            "--force-sensor",
            f"Which force sensor between flange and tool? {' or '.join(sensors)}",
            Draft.force_sensor,
            without="none",
        ),
        Item(
            "--force-port",
            "Its serial port, or its address in the network",
            _connection("force_sensor"),
            needs="force_sensor",
            without="the simulated one, for a rehearsal",
        ),
        Item(
            "--target",
            "Where does the target sit? x, y, z in m, flange axes",
            _set("tool", "target_m", _metres),
            without="not known: it is estimated",
        ),
        Item(
            "--load-point",
            "Where do loads act? x, y, z in m, flange axes",
            _set("tool", "load_point_m", _metres),
            without="the flange's centre",
        ),
        Item(
            "--tool-mass",
            "Mass of the tool in kg",
            _set("tool", "mass_kg", lambda words: number(words, "kg")),
            without="0",
        ),
        Item(
            "--tool-com",
            "Its centre of mass, x, y, z in m, flange axes",
            _set("tool", "com_m", _metres),
            needs="tool",
            without="the flange's centre",
        ),
        Item(
            "--load",
            f"Which loads are at hand? One at a time, {LOADS}",
            Draft.add_load,
            again=True,
            without="no more",
        ),
        Item(
            "--readings",
            "What is to be calibrated? absolute: where the tool is, geometry and loads; "
            "deflection: what loads do, and no geometry",
            Draft.readings,
            without="absolute",
        ),
        Item(
            "--floor",
            "What height must arm and load stay above? In m, base axes",
            Draft.floor,
            without="no limit",
        ),
        Item(
            "--tracker-place",
            "Where does the tracker stand, roughly? x, y, z in m, base axes",
            _set("sight", "tracker_m", _metres),
            without="not known: sight is not checked",
        ),
    )


@command(
    f"""
    cell | CELL.toml | The file to write.
    robot | --robot | The arm, e.g. ur10e, or a .urdf.
    host | --host | Address of its controller.
    repeatability | --repeatability LENGTH | As the maker states it (ISO 9283), e.g. "0.05 mm".
    tracker | --tracker | The tracker's driver.
    tracker_port | --tracker-port | Its serial port, or its address in the network.
    tracker_accuracy | --tracker-accuracy LENGTH | Standard deviation of a point, e.g. "8 um + 3
        um/m".
    force_sensor | --force-sensor | The force sensor's driver.
    force_port | --force-port | Its serial port, or its address in the network.
    target | --target X,Y,Z | The target in flange axes, m.
    load_point | --load-point X,Y,Z | Where loads act, flange axes, m.
    tool_mass | --tool-mass KG | Of the tool.
    tool_com | --tool-com X,Y,Z | The tool's centre of mass, m.
    load | --load LOAD | A load, {LOADS}; repeatable.
    readings | --readings KIND | absolute (unless given) or deflection: what is fitted.
    floor | --floor Z | Height that the arm stays above, m.
    tracker_place | --tracker-place X,Y,Z | Of the tracker in base axes, m.
    """
)
def init(
    cell: Path = Path("CELL.toml"),
    robot: str | None = None,
    host: str | None = None,
    repeatability: str | None = None,
    tracker: str | None = None,
    tracker_port: str | None = None,
    tracker_accuracy: str | None = None,
    force_sensor: str | None = None,
    force_port: str | None = None,
    target: str | None = None,
    load_point: str | None = None,
    tool_mass: str | None = None,
    tool_com: str | None = None,
    load: list[str] | None = None,
    readings: str | None = None,
    floor: str | None = None,
    tracker_place: str | None = None,
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Write a commented CELL.toml: asks at a terminal, else takes the options."""
    t = terminal(as_json)
    options = {f"--{name.replace('_', '-')}": value for name, value in locals().items()}
    there = somebody_there(t) and not as_json
    check_folder(cell, str(cell))
    check_new(cell, force or (there and cell.exists() and agreed(t, f"{cell} exists. Replace it?")))
    draft = Draft(cell.absolute().parent)
    if there:
        t.notice(f"Enter alone leaves a thing open; Ctrl-C ends, and {cell} is not written.\n")
    for item in items():
        given = options[item.option]
        if given is not None:
            for words in given if isinstance(given, list) else [given]:
                _from_option(draft, item, words)
        elif there:
            _ask(t, draft, item)
        elif item.option == "--robot":
            raise InputError(
                f"--robot is missing, and nobody can be asked; valid: {', '.join(robot_names())}, "
                f"or {OTHER_ARMS}"
            )
    _complete(draft)
    written = cell_text(draft.data, f"The cell of a {draft.data['robot']['model']}")
    replace_file(cell, written)
    t.show(heading(f"Written: {cell}"))
    t.show(
        "Look it over: what was not answered stands there as an example. Then, without any "
        f"device:\n  hilcal plan {quoted(cell)} -o plan.json\n"
        f"  hilcal run {quoted(cell)} --plan plan.json --rehearse -o rehearsal.hilcal\n"
        f"and with the devices{_lacking(draft)}:\n  hilcal check {quoted(cell)} --plan plan.json"
    )
    t.document({"cell": str(cell), "config": draft.data})


def _lacking(draft: Draft) -> str:
    """Say which keys the cell still needs before it can be measured."""
    connection = "host" if "host" in draft.data.get("tracker", {}) else "port"
    keys = (("robot", "driver"), ("robot", "host"), ("tracker", "driver"), ("tracker", connection))
    wanted = [f"[{s}] {key}" for s, key in keys if key not in draft.data.get(s, {})]
    return f", once it has {' and '.join(wanted)}" if wanted else ""


def _from_option(draft: Draft, item: Item, words: str) -> None:
    if item.needs and item.needs not in draft.data:
        raise InputError(f"{item.option} without --{item.needs.replace('_', '-')}; give both")
    try:
        item.take(draft, words.strip())
    except InputError as error:
        raise InputError(f'{item.option} "{words}": {_shortly(error)}') from None


def _ask(t: Terminal, draft: Draft, item: Item) -> None:
    """Ask until the answer is valid, or empty where that means something."""
    if item.needs and item.needs not in draft.data:
        return
    if item.option.endswith("-port"):
        found = ports()
        t.notice("Serial ports here: " + (", ".join(found) if found else "none") + ".")
    hint = f" (Enter: {item.without})" if item.without else ""
    question = f"{item.question}{hint}:"
    while True:
        t.progress.print(question, markup=False, highlight=False, style="bold")
        t.progress.print("> ", end="", markup=False, highlight=False)
        answer = sys.stdin.readline()
        if not answer:
            raise StoppedError("nothing is written: the input ended")
        answer = answer.strip()
        if not answer and item.without:
            return
        try:
            item.take(draft, answer)
        except InputError as error:
            t.notice(f"  Not so: {_shortly(error)}")
            continue
        if not item.again:
            return
        question = "Another one (Enter: no more):"


def _shortly(error: InputError) -> str:
    return str(error).removeprefix("the answer: ")


def _complete(draft: Draft) -> None:
    """Add what a plan and a rehearsal need, and check the whole."""
    if draft.data.setdefault("planning", {}).setdefault("readings", "absolute") == "absolute":
        loaded = () if not draft.data.get("loads") else LOADED
        draft.set("planning", model=[*GEOMETRY, *loaded])
    draft.set("simulation", clock=CLOCK)
    config = check_section(draft.data, CellConfig, "the cell")
    check_effects(cell_from_config(config, draft.base_dir), config, installed())
