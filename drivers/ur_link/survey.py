"""Identity and state of the arm, and everything that hinders a run."""

import math
import re
from collections.abc import Callable

from hilcal.drivers.ur_link import primary, states
from hilcal.drivers.ur_link.dashboard import RobotFacts
from hilcal.drivers.ur_link.lines import LinkError
from hilcal.drivers.ur_link.probe import ControllerFacts
from hilcal.drivers.ur_link.reading import Reading, Receiver
from hilcal.drivers.ur_link.supervision import Supervision
from hilcal.measuring.devices import Report

_RATE_S = (0.4, 2.0)
"""How long packets are counted, and again where they were too few; choices."""
_SHARE = 0.5
"""Of the packets that were asked for: with fewer the line is not fit for a run; a choice."""
_ASK_S = 1.5


def survey(
    host: str,
    model: str,
    hz: float,
    controller: ControllerFacts,
    receiver: Receiver,
    supervision: Supervision,
    silent: str,
    needs_primary: bool,
) -> Report:
    """Ask everything that can be asked without moving.

    `silent` is why the supervision does not answer, empty where it does; `needs_primary` tells
    whether programs go by the primary port.
    """
    version = states.version_word(controller.version)
    facts = [("address", host), ("controller version", version)]
    fields: list[tuple[str, object]] = [("address", host), ("controller_version", version)]
    problems: list[str] = []
    name = "Universal Robots arm"
    kinematics = None
    try:
        kinematics = primary.kinematics(host, _ASK_S)
    except LinkError as error:
        facts.append(("its kinematics", f"not told: {error}"))
        if needs_primary:
            problems.append(
                f"{error}; programs go by it, so that the arm cannot be controlled without it: "
                "enable the primary client interface in the controller's settings, under services"
            )
    else:
        fields.append(("kinematics", kinematics.to_dict()))
    if silent:
        facts.append((supervision.name, silent))
        problems.append(f"{silent}; the arm cannot be controlled without it")
    else:
        try:
            robot = supervision.describe(_ASK_S)
        except LinkError as error:
            problems.append(f"{error}; the arm cannot be controlled without it")
        else:
            serial = f", serial number {robot.serial}" if robot.serial else ""
            name = f"Universal Robots {robot.model or 'arm'}{serial}"
            facts += _facts(robot)
            fields += [
                ("model", robot.model),
                ("serial_number", robot.serial),
                ("software_version", robot.version),
                ("remote_control", robot.remote),
                ("program", robot.program),
            ]
            problems += _problems(robot, model)
    try:
        reading = receiver.read()
        rate = settled_rate(receiver.rate, hz)
    except LinkError as error:
        problems.append(str(error))
    else:
        facts += [*_state(reading), ("RTDE rate", f"{rate:.0f} Hz of {hz:g} Hz")]
        fields += [*_state_fields(reading), ("rtde_rate_Hz", rate), ("rtde_rate_asked_Hz", hz)]
        problems += _hindrances(reading)
        if rate < _SHARE * hz:
            problems.append(f"RTDE comes at {rate:.0f} Hz instead of {hz:g} Hz; check the network")
    return Report("arm", name, tuple(facts), tuple(problems), tuple(fields), kinematics)


def settled_rate(count: Callable[[float], float], hz: float) -> float:
    """Packets per second of the `hz` that were asked for; counted again for longer where few.

    A computer that was busy for some tenths of a second is no broken network.
    """
    rate = count(_RATE_S[0])
    return rate if rate >= _SHARE * hz else count(_RATE_S[1])


def _facts(robot: RobotFacts) -> list[tuple[str, str]]:
    remote = {True: "yes", False: "no (local mode)", None: "not known to this controller"}
    return [
        ("model", robot.model),
        ("serial number", robot.serial),
        ("PolyScope", robot.version),
        ("remote control", remote[robot.remote]),
        ("program", robot.program),
    ]


def _problems(robot: RobotFacts, model: str) -> list[str]:
    out = []
    if robot.remote is False:
        out.append("it is in local mode; switch it to remote control on the pendant")
    # "UR10" may stand for an UR10e or UR12e as well: only the size decides
    size, told = _size(robot.model), _size(model)
    if size and told and told != size:
        out.append(f'it is a {robot.model}; the configuration says model = "{model}"')
    return out


def _size(model: str) -> str:
    """Return the number in the name of an arm of this maker; UR7e and UR12e have their old one."""
    found = re.match(r"ur(\d+)", model.lower())
    return "" if found is None else {"7": "5", "12": "10"}.get(found[1], found[1])


def _state(reading: Reading) -> list[tuple[str, str]]:
    sample = reading.sample
    com = "" if sample.payload_com is None else f" at {_list(1e3 * sample.payload_com, 1)} mm"
    payload = "not reported" if math.isnan(sample.payload) else f"{sample.payload:.3f} kg{com}"
    return [
        ("robot mode", states.mode_word(reading.mode)),
        ("safety", sample.safety),
        ("payload", payload),
        ("joint temperatures", f"{_list(sample.joint_temperature, 1)} °C"),
    ]


def _state_fields(reading: Reading) -> list[tuple[str, object]]:
    sample = reading.sample
    return [
        ("robot_mode", states.mode_word(reading.mode)),
        ("safety", sample.safety),
        ("payload_kg", None if math.isnan(sample.payload) else sample.payload),
        ("payload_com_m", None if sample.payload_com is None else sample.payload_com.tolist()),
        ("joint_temperature_degC", sample.joint_temperature.tolist()),
    ]


def _hindrances(reading: Reading) -> list[str]:
    out = []
    sample = reading.sample
    if sample.safety != states.NORMAL:
        out.append(f"{sample.safety}: {states.safety_advice(reading.safety_bits)}")
    if reading.mode != states.RUNNING:
        word = states.mode_word(reading.mode)
        out.append(f"it is not running ({word}); switch it on and release the brakes")
    if reading.runtime in (states.PLAYING, states.RESUMING):
        out.append("a program runs on the robot; stop it on the pendant")
    if math.isnan(sample.payload) or sample.payload_com is None:
        out.append("it does not report its payload; that needs PolyScope 5.5.1 or newer")
    return out


def _list(values: object, digits: int) -> str:
    return ", ".join(f"{v:.{digits}f}" for v in values)  # type: ignore[attr-defined]
