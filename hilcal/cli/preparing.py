"""`init`: write a CELL.toml; `doctor`: examine this computer."""

import re
import sys
from copy import deepcopy
from dataclasses import asdict, dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple

import hilcal
from hilcal import doctor as machine
from hilcal.cell import cell_from_config
from hilcal.cli.options import check_folder, check_new, command
from hilcal.cli.terminal import Terminal, confirmed, person_present
from hilcal.config import CellConfig, load_config
from hilcal.config.reference import cell_text
from hilcal.config.sections import GEOMETRY, LOADED
from hilcal.design.nominal_model import check_effects
from hilcal.drivers.ur_link.supervision import services
from hilcal.effects.catalogue import installed
from hilcal.errors import DeviceError, HilcalError, InputError, StoppedError
from hilcal.measuring import devices
from hilcal.measuring.connect import driver
from hilcal.names import quoted
from hilcal.present.campaign import doctor_report, doctor_summary
from hilcal.present.document import heading
from hilcal.present.progress import working
from hilcal.robot.catalogue import OTHER_ARMS, load_arm, robot_names
from hilcal.tables.units import METRIC
from hilcal.toml import check_section
from hilcal.whole_file import replace_file

SIMULATED = "simulated"  # Port of a device that exists in a rehearsal only
CLOCK = 20.0  # Clock rate of a rehearsal relative to real time, as in the demo's cell
UNITS: dict[str, dict[str, float]] = {
    "m": {**METRIC, "cm": 1e-2},
    "m/m": {"m/m": 1.0, "mm/m": 1e-3, "um/m": 1e-6, "µm/m": 1e-6, "μm/m": 1e-6},
    "kg": {"kg": 1.0, "g": 1e-3},
    "N": {"N": 1.0, "kN": 1e3},
}
"""Units of each kind of quantity; the first one, SI, is the default."""
_QUANTITY = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\W\d]+(?:/m)?)?")
_LOAD = re.compile(r"(?:(?P<name>[^=]+)=)?(?P<values>[^=]*?\d[^=]*?(?P<unit>kg|g|N|kN))\s*")
LOADS = 'e.g. "5 kg", or a pull in base axes: "pull x = 80, 0, 0 N"'


@dataclass(slots=True)
class Draft:
    """The draft of a cell; every answer is checked at once."""

    base_dir: Path  # directory that paths are relative to
    data: dict[str, Any] = field(default_factory=dict)  # the sections, as in TOML

    def set(self, section: str, **values: object) -> None:
        """Set keys of a section; none is set if a value is not valid."""
        data = deepcopy(self.data)
        data.setdefault(section, {}).update(values)
        self._take(data)

    def _take(self, data: dict[str, Any]) -> None:
        check_section(data, CellConfig, "the answer")
        self.data = data

    def answer(self, parameter: str, text: str) -> None:
        """Enter the answer to the question of an option's parameter."""
        match parameter:
            case "robot":
                load_arm(text, self.base_dir)
                self.set("robot", model=text)
            case "host":
                if not re.fullmatch(r"[\w.:-]+", text):
                    raise InputError(f'{text!r} is no address; valid: e.g. "192.168.56.101"')
                names = drivers(devices.ARMS)
                self.set("robot", driver="ur" if "ur" in names else names[0], host=text)
            case "repeatability":
                self.set("robot", repeatability_m=number(text, "m"))
            case "tracker":
                driver(devices.TRACKERS, text, "[tracker] driver")
                self.set("tracker", driver=text)
            case "force_sensor":
                driver(devices.FORCE_SENSORS, text, "[force_sensor] driver")
                self.set("force_sensor", driver=text, port=SIMULATED)
            case "tracker_port" | "force_port":  # a serial port, which is a path, or an address
                section = {"tracker_port": "tracker", "force_port": "force_sensor"}[parameter]
                self.data[section].pop("port", None)
                self.set(section, **{"port" if "/" in text else "host": text})
            case "tracker_accuracy":
                fixed, _, growing = text.partition("+")
                std, per_m = number(fixed, "m"), number(growing, "m/m") if growing else 0.0
                keys = ("range_std", "transverse_std")
                values = {f"{k}_m": std for k in keys} | {f"{k}_per_m": per_m for k in keys}
                self.set("tracker", **values)
            case "target" | "load_point" | "tool_com":
                key = {"target": "target_m", "load_point": "load_point_m", "tool_com": "com_m"}
                self.set("tool", **{key[parameter]: vector(text, "m")})
            case "tool_mass":
                self.set("tool", mass_kg=number(text, "kg"))
            case "load":
                self._add_load(text)
            case "readings":
                if text == "deflection" and not self.data.get("loads"):
                    raise InputError('"deflection" needs a load; valid without one: absolute')
                self.set("planning", readings=text)
            case "floor":
                reach = load_arm(self.data["robot"]["model"], self.base_dir).reach
                side = round(2.0 * reach, 1)
                self.set("limits", workspace_min_m=[-side, -side, number(text, "m")])
            case "tracker_place":
                self.set("sight", tracker_m=vector(text, "m"))

    def _add_load(self, text: str) -> None:
        match = _LOAD.fullmatch(text)
        if match is None:
            raise InputError(f"{text!r} is no load; valid: {LOADS}")
        load: dict[str, object] = {"name": (match["name"] or text.replace(" ", "")).strip()}
        if match["unit"] in UNITS["kg"]:
            load["mass_kg"] = number(match["values"], "kg")
        else:
            load["force_N"] = vector(match["values"], "N")
        self._take({**self.data, "loads": [*self.data.get("loads", ()), load]})


def number(text: str, unit: str) -> float:
    """Read a number; its unit may follow, else it is `unit`."""
    values = _quantities(text, unit)
    if len(values) != 1:
        raise InputError(f"{text.strip()!r} is no number; valid: one in {unit}")
    return values[0]


def vector(text: str, unit: str) -> list[float]:
    """Read three numbers; one unit may follow each or all, else it is `unit`."""
    values = _quantities(text, unit)
    if len(values) != 3:
        count = f"{len(values)} number{'s' * (len(values) != 1)}"
        raise InputError(f"{text.strip()!r} is {count}; valid: three in {unit}")
    return values


def _quantities(text: str, unit: str) -> list[float]:
    """Read numbers with their units; empty where the text has anything else."""
    factor_of, matches = UNITS[unit], _QUANTITY.findall(text)
    if _QUANTITY.sub("", text).strip("[](),; \t").replace(",", "").replace(";", "").strip():
        return []
    stated = [u for _, u in matches if u]
    for u in stated:
        if u not in factor_of:
            raise InputError(f"{text.strip()!r} has the unit {u}; valid: {', '.join(factor_of)}")
    if len(stated) == 1 and matches[-1][1]:
        stated *= len(matches)
    if stated and len(stated) != len(matches):
        raise InputError(f"{text.strip()!r} has units behind some numbers only; valid: all or one")
    factors = [factor_of[u] for u in stated] or [1.0] * len(matches)
    return [round(float(x) * f, 12) for (x, _), f in zip(matches, factors, strict=True)]


def drivers(group: str) -> list[str]:
    """Return the names of the installed drivers for a kind of device."""
    return sorted({point.name for point in entry_points(group=group)})


NEEDS = {"tracker_port": "tracker", "force_port": "force_sensor", "tool_com": "tool"}
"""The section without which a question does not arise."""


class CellQuestion(NamedTuple):
    """A question about the cell."""

    parameter: str  # parameter of the option that answers the question
    text: str
    default: str = ""  # meaning of an empty answer; empty where an answer is needed


def _option(parameter: str) -> str:
    return "--" + parameter.replace("_", "-")


def questions() -> list[CellQuestion]:
    """Return all questions, in order."""
    trackers, sensors = drivers(devices.TRACKERS), drivers(devices.FORCE_SENSORS)
    text = f"""
robot | Which arm? One of {", ".join(robot_names())}, or {OTHER_ARMS} |
host | Address of its controller | not connected yet
repeatability | What pose repeatability does its maker state (ISO 9283)? E.g. 0.05 mm |
    that of the arm's file, if any
tracker | Which tracker? {" or ".join(trackers)} | not connected yet
tracker_port | Its serial port, or its address in the network | not connected yet
tracker_accuracy | How accurate is the tracker? Standard deviation of a point, half of its maximum
    permissible error, e.g. 8 um + 3 um/m | as a Leica AT500
force_sensor | Which force sensor between flange and tool? {" or ".join(sensors)} | none
force_port | Its serial port, or its address in the network | the simulated one, for a rehearsal
target | Where does the target sit? x, y, z in m, flange axes | not known: it is estimated
load_point | Where do loads act? x, y, z in m, flange axes | the flange's centre
tool_mass | Mass of the tool in kg | 0
tool_com | Its centre of mass, x, y, z in m, flange axes | the flange's centre
load | Which loads are at hand? One at a time, {LOADS} | no more
readings | What is to be calibrated? absolute: where the tool is, geometry and loads; deflection:
    what loads do, and no geometry | absolute
floor | What height must arm and load stay above? In m, base axes | no limit
tracker_place | Where does the tracker stand, roughly? x, y, z in m, base axes |
    not known: sight is not checked
"""
    lines = text.replace("\n    ", " ").strip().splitlines()
    return [CellQuestion(*(part.strip() for part in line.split(" |"))) for line in lines]


@command(f"""
    cell | CELL.toml | The file to write.
    robot | --robot | Type of the arm, e.g. ur10e, or a .urdf file.
    host | --host | Network address of the arm's controller.
    repeatability | --repeatability LENGTH | Pose repeatability that the maker states (ISO 9283),
        e.g. "0.05 mm".
    tracker | --tracker | Driver of the tracker.
    tracker_port | --tracker-port | Serial port or network address of the tracker.
    tracker_accuracy | --tracker-accuracy LENGTH | Standard deviation of a measured point, e.g. "8
        um + 3 um/m".
    force_sensor | --force-sensor | Driver of the force sensor.
    force_port | --force-port | Serial port or network address of the force sensor.
    target | --target X,Y,Z | Position of the tracked target, flange axes, m.
    load_point | --load-point X,Y,Z | Point at which loads act, flange axes, m.
    tool_mass | --tool-mass KG | Mass of the tool.
    tool_com | --tool-com X,Y,Z | Centre of mass of the tool, flange axes, m.
    load | --load LOAD | A load, {LOADS}; repeatable.
    readings | --readings KIND | Kind of readings that are fitted: absolute (default) or deflection.
    floor | --floor Z | Least height of arm and load, base axes, m.
    tracker_place | --tracker-place X,Y,Z | Position of the tracker, base axes, m.
    """)
def init(
    t: Terminal, cell: Path = Path("CELL.toml"), robot: str | None = None, host: str | None = None,
    repeatability: str | None = None, tracker: str | None = None, tracker_port: str | None = None,
    tracker_accuracy: str | None = None, force_sensor: str | None = None,
    force_port: str | None = None, target: str | None = None, load_point: str | None = None,
    tool_mass: str | None = None, tool_com: str | None = None, load: list[str] | None = None,
    readings: str | None = None, floor: str | None = None, tracker_place: str | None = None,
    force: bool = False,
) -> None:  # fmt: skip
    """Write a commented CELL.toml from answers at the terminal, or from options."""
    options = dict(locals())
    asks = person_present(t) and not t.json
    check_folder(cell, str(cell))
    check_new(
        cell, force or (asks and cell.exists() and confirmed(t, f"{cell} exists. Replace it?"))
    )
    draft = Draft(cell.absolute().parent)
    if asks:
        t.notice(f"Press Enter to skip a question; Ctrl-C stops without writing {cell}.\n")
    for question in questions():
        stated = options[question.parameter]
        if stated is not None:
            for text in stated if isinstance(stated, list) else [stated]:
                _from_option(draft, question.parameter, text)
        elif asks:
            _ask(t, draft, question)
        elif question.parameter == "robot":
            raise InputError(
                f"--robot is missing, and nobody can be asked; valid: {', '.join(robot_names())}, "
                f"or {OTHER_ARMS}"
            )
    _complete(draft)
    written = cell_text(draft.data, f"The cell of a {draft.data['robot']['model']}")
    replace_file(cell, written)
    t.show(heading(f"Written: {cell}"))
    t.show(
        "Check the file: it has examples for what was not answered. Then, without any "
        f"device:\n  hilcal plan {quoted(cell)} -o plan.json\n"
        f"  hilcal run {quoted(cell)} --plan plan.json --rehearse -o rehearsal.hilcal\n"
        f"and with the devices{_lacking(draft)}:\n  hilcal check {quoted(cell)} --plan plan.json"
    )
    t.document({"cell": str(cell), "config": draft.data})


def _lacking(draft: Draft) -> str:
    connection = "host" if "host" in draft.data.get("tracker", {}) else "port"
    keys = (("robot", "driver"), ("robot", "host"), ("tracker", "driver"), ("tracker", connection))
    missing = [f"[{s}] {key}" for s, key in keys if key not in draft.data.get(s, {})]
    return f", once it has {' and '.join(missing)}" if missing else ""


def _from_option(draft: Draft, parameter: str, text: str) -> None:
    option, needed = _option(parameter), NEEDS.get(parameter)
    if needed and needed not in draft.data:
        raise InputError(f"{option} without {_option(needed)}; give both")
    try:
        draft.answer(parameter, text.strip())
    except InputError as error:
        raise InputError(f'{option} "{text}": {_shortly(error)}') from None


def _ask(t: Terminal, draft: Draft, question: CellQuestion) -> None:
    """Ask until the answer is valid, or empty where the question has a default."""
    needed = NEEDS.get(question.parameter)
    if needed and needed not in draft.data:
        return
    if question.parameter.endswith("_port"):
        names = machine.permanent_names()
        ports = [names.get(path, path) for path in machine.adapters()]
        t.notice(f"Serial ports here: {', '.join(ports) or 'none'}.")
    prompt = question.text + (f" (Enter: {question.default}):" if question.default else ":")
    while True:
        t.progress.print(prompt, markup=False, highlight=False, style="bold")
        t.progress.print("> ", end="", markup=False, highlight=False)
        answer = sys.stdin.readline()
        if not answer:
            raise StoppedError("nothing is written: the input ended")
        answer = answer.strip()
        if not answer and question.default:
            return
        try:
            draft.answer(question.parameter, answer)
        except InputError as error:
            t.notice(f"  Not so: {_shortly(error)}")
            continue
        if question.parameter != "load":
            return
        prompt = "Another one (Enter: no more):"


def _shortly(error: InputError) -> str:
    return str(error).removeprefix("the answer: ")


def _complete(draft: Draft) -> None:
    if draft.data.setdefault("planning", {}).setdefault("readings", "absolute") == "absolute":
        loaded = () if not draft.data.get("loads") else LOADED
        draft.set("planning", model=[*GEOMETRY, *loaded])
    draft.set("simulation", clock=CLOCK)
    config = check_section(draft.data, CellConfig, "the cell")
    check_effects(cell_from_config(config, draft.base_dir), installed())


@command("""
    cell | CELL.toml | Also check the ports and addresses of this cell.
    folder | --folder DIR | Folder in which campaigns are stored.
    """)
def doctor(t: Terminal, cell: Path | None = None, folder: Path = Path(".")) -> None:
    """Check packages, ports, permissions, network, clock and disk of this computer."""
    findings: list[machine.Finding] = []
    with working(t.progress) as say:
        say("looking at what is installed")
        findings += machine.program(hilcal.__version__)
        say("looking at clock and disk")
        findings += machine.computer(folder.absolute())
        config, of_cell = _cell(cell)
        findings += of_cell
        say("looking at serial ports")
        findings += machine.serial_ports(_ports(config), machine.adapters())
        if config is not None and config.robot.driver == "ur" and config.robot.host:
            say(f"connecting to {config.robot.host}")
            findings += machine.reachable(config.robot.host, services(config))
    t.show(doctor_report(findings))
    failed: HilcalError | None = None
    if any(f.state == "problem" for f in findings):
        failed = DeviceError(doctor_summary(findings))
    t.document({"ok": failed is None, "findings": [asdict(f) for f in findings]}, failed)


def _cell(path: Path | None) -> tuple[CellConfig | None, list[machine.Finding]]:
    if path is None:
        return None, []
    try:
        config = load_config(path)
        cell_from_config(config, path.absolute().parent)  # its robot's file, too
    except InputError as error:
        mend = "correct the file; hilcal config explains every key"
        return None, [machine.Finding("cell", str(path), "problem", str(error), mend)]
    return config, [machine.Finding("cell", str(path), "ok", "can be read")]


def _ports(config: CellConfig | None) -> dict[str, str]:
    if config is None:
        return {}
    ports = {"tracker": config.tracker.port}
    if config.force_sensor is not None:
        ports["force sensor"] = config.force_sensor.port
    return {device: port for device, port in ports.items() if port and port != SIMULATED}
