"""The open devices that a configuration names; all failures are reported together."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from hilcal.config import CellConfig
from hilcal.errors import HilcalError, InputError
from hilcal.measuring import devices
from hilcal.measuring.devices import (
    ArmDevice,
    ForceSensorDevice,
    OperatorDevice,
    Report,
    TrackerDevice,
)
from hilcal.toml import suggest


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Every device that a campaign uses, connected."""

    arm: ArmDevice
    tracker: TrackerDevice
    force: ForceSensorDevice | None  # the force sensor; None where the cell has none
    operator: OperatorDevice

    def close(self) -> None:
        """Close everything, the arm first. Never raises, may be called twice."""
        for device in (self.arm, self.tracker, self.force, self.operator):
            if device is not None:
                device.close()


Factory = Callable[[CellConfig], Any]


@dataclass(frozen=True, slots=True)
class ConnectionResult:
    """The result of opening one device."""

    device: str  # its part in the cell
    driver: str  # the driver's name
    report: Report | None  # its name, facts and problems; None where it did not answer
    failure: str = ""  # why it did not, one line; empty where it did

    @property
    def problems(self) -> tuple[str, ...]:
        """What hinders a run, one line each, with the device."""
        if self.failure or self.report is None:
            return (self.failure,)
        return tuple(
            text if text.startswith(self.device) else f"{self.device}: {text}"
            for text in self.report.problems
        )


@dataclass(frozen=True, slots=True)
class _Wanted:
    """One device that the configuration names."""

    device: str
    group: str
    driver: str | None
    key: str


def driver(group: str, name: str, key: str) -> Factory:
    """Return the factory of a driver by name.

    Args:
        group: the group of entry points, see `devices`.
        name: the driver's name, or its place as "module:function".
        key: where the configuration gives it, for messages.

    Raises:
        InputError: unknown name (lists the valid ones), or the driver cannot be loaded.
    """
    found = {point.name: point for point in entry_points(group=group)}
    if ":" in name:
        found[name] = EntryPoint(name, name, group)
    if name not in found:
        valid = ", ".join(sorted(found)) or "none is installed"
        raise InputError(
            f'{key} = "{name}" is unknown{suggest(name, sorted(found))}; valid: {valid}'
        )
    try:
        factory: Factory = found[name].load()
    except Exception as error:  # a driver of somebody else's may fail in any way
        words = " ".join(str(error).split())
        raise InputError(
            f'{key} = "{name}": the driver {found[name].value} cannot be loaded ({words})'
        ) from error
    return factory


def connect(config: CellConfig) -> tuple[Rig | None, tuple[ConnectionResult, ...]]:
    """Open every device at once; nothing moves.

    Returns:
        The rig, None where a device did not open (the others are closed again), and what
        became of each device.

    Raises:
        InputError: the configuration names no driver for a part, or an unknown one.
    """
    wanted = _wanted(config)
    factories = [_factory(one) for one in wanted]
    with ThreadPoolExecutor(len(wanted)) as pool:
        opened = list(pool.map(lambda factory: _open(factory, config), factories))
    answers = tuple(
        _answer(one, made, why) for one, (made, why) in zip(wanted, opened, strict=True)
    )
    made = {one.device: device for one, (device, _) in zip(wanted, opened, strict=True)}
    wrong = [why for _, why in opened if isinstance(why, InputError)]
    if wrong or any(answer.failure for answer in answers):
        for device in made.values():
            if device is not None:
                device.close()
        if wrong:
            raise wrong[0]
        return None, answers
    rig = Rig(
        arm=made["arm"],
        tracker=made["tracker"],
        force=made.get("force sensor"),
        operator=made["operator"],
    )
    return rig, answers


def _wanted(config: CellConfig) -> list[_Wanted]:
    wanted = [
        _Wanted("arm", devices.ARMS, config.robot.driver, "[robot] driver"),
        _Wanted("tracker", devices.TRACKERS, config.tracker.driver, "[tracker] driver"),
        _Wanted("operator", devices.OPERATORS, config.operator.driver, "[operator] driver"),
    ]
    if config.force_sensor is not None:
        sensor = config.force_sensor.driver
        wanted.append(
            _Wanted("force sensor", devices.FORCE_SENSORS, sensor, "[force_sensor] driver")
        )
    return wanted


def _factory(one: _Wanted) -> Factory:
    if one.driver is None:
        valid = ", ".join(sorted(point.name for point in entry_points(group=one.group)))
        raise InputError(f"{one.key} is missing, so there is no {one.device}; valid: {valid}")
    return driver(one.group, one.driver, one.key)


def _open(factory: Factory, config: CellConfig) -> tuple[Any, str | HilcalError]:
    try:
        return factory(config), ""
    except Exception as error:  # a driver of somebody else's may fail in any way
        return None, _why(error)


def _why(error: Exception) -> str | HilcalError:
    """Return an error as one line, or itself where it is a HilcalError."""
    if isinstance(error, HilcalError):
        return error
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _answer(one: _Wanted, made: Any, why: str | HilcalError) -> ConnectionResult:
    name = one.driver or ""
    try:
        if made is not None:
            return ConnectionResult(one.device, name, made.report())
    except Exception as error:  # as above
        why = _why(error)
    words = str(why)
    told = words if words.startswith(one.device) else f"{one.device}: {words}"
    return ConnectionResult(one.device, name, None, told)
