"""Opening the devices of a configuration; comparing the kinematics of an arm's controller."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from operator import methodcaller
from threading import Thread
from typing import Any, TypeVar

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.errors import HilcalError, InputError
from hilcal.measuring import devices
from hilcal.measuring.devices import (
    ArmDevice,
    Clock,
    ForceSensorDevice,
    OperatorDevice,
    Report,
    TrackerDevice,
)
from hilcal.measuring.progress import Watcher
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import load_arm, robot_names
from hilcal.robot.factory import (
    LINEARISED_STATUS,
    OTHER_ARM_M,
    SAME_FLANGE_M,
    FactoryKinematics,
    flange_difference,
    with_factory,
)
from hilcal.toml import suggest


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Every device that a campaign uses, connected."""

    arm: ArmDevice
    tracker: TrackerDevice
    force: ForceSensorDevice | None  # None in a cell without a force sensor
    operator: OperatorDevice

    def close(self) -> None:
        """Close everything, the arm first. Never raises, may be called twice."""
        for device in (self.arm, self.tracker, self.force, self.operator):
            if device is not None:
                device.close()


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """Common resources of a session: open devices, cell, clock and watcher."""

    rig: Rig
    cell: Cell
    clock: Clock
    watcher: Watcher
    stop_requested: Callable[[], bool] = lambda: False
    """Whether a person or the system has asked for the end of the session."""


Factory = Callable[[CellConfig], Any]
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class ConnectionResult:
    """The result of opening one device."""

    device: str  # part of the cell
    driver: str  # name
    report: Report | None  # None if the device did not answer
    failure: str = ""  # why it did not answer, one line; else empty

    @property
    def problems(self) -> tuple[str, ...]:
        """Obstacles to a run, one line each, with the device."""
        if self.failure or self.report is None:
            return (self.failure,)
        return tuple(
            text if text.startswith(self.device) else f"{self.device}: {text}"
            for text in self.report.problems
        )


def driver(group: str, name: str | None, key: str) -> Factory:
    """Return the factory of a driver by its name, or by "module:function"."""
    points = {point.name: point for point in entry_points(group=group)}
    valid = ", ".join(sorted(points)) or "none is installed"
    if name is None:
        part = group.removeprefix("hilcal.").removesuffix("s").replace("_", " ")
        raise InputError(f"{key} is missing, so there is no {part}; valid: {valid}")
    if ":" in name:
        points[name] = EntryPoint(name, name, group)
    if name not in points:
        hint = suggest(name, sorted(points))
        raise InputError(f'{key} = "{name}" is unknown{hint}; valid: {valid}')
    try:
        factory: Factory = points[name].load()
    except Exception as error:  # a third-party driver may raise anything
        reason = " ".join(str(error).split())
        raise InputError(
            f'{key} = "{name}": the driver {points[name].value} cannot be loaded ({reason})'
        ) from error
    return factory


def drivers_of(config: CellConfig) -> list[tuple[str, str, Factory]]:
    """Return part, name of the driver, and factory of each device; nothing is opened.

    Raises:
        InputError: a driver is missing in the configuration, unknown, or cannot be loaded.
    """
    parts = [
        ("arm", devices.ARMS, config.robot.driver, "[robot] driver"),
        ("tracker", devices.TRACKERS, config.tracker.driver, "[tracker] driver"),
        ("operator", devices.OPERATORS, config.operator.driver, "[operator] driver"),
    ]
    if config.force_sensor is not None:
        sensor = config.force_sensor.driver
        parts.append(("force sensor", devices.FORCE_SENSORS, sensor, "[force_sensor] driver"))
    return [(part, name or "", driver(group, name, key)) for part, group, name, key in parts]


def connect(config: CellConfig) -> tuple[Rig | None, tuple[ConnectionResult, ...]]:
    """Open every device at once; nothing moves.

    Returns the rig, or None if a device did not open (the others are closed again), and the result
    of each device. InputError: a driver is missing in the configuration, or unknown.
    """
    parts = drivers_of(config)
    opened = _at_once([partial(_tried, factory, config) for _, _, factory in parts])
    answers: list[ConnectionResult] = []
    for (part, name, _), (device, error) in zip(parts, opened, strict=True):
        report, why = (None, error) if error is not None else _tried(methodcaller("report"), device)
        failure = "" if why is None else _failure(part, why)
        answers.append(ConnectionResult(part, name, report, failure))
    arm, tracker, operator, *force = (device for device, _ in opened)
    rig = Rig(arm, tracker, force[0] if force else None, operator)
    if not any(answer.failure for answer in answers):
        return rig, tuple(answers)
    rig.close()
    for _, error in opened:
        if isinstance(error, InputError):
            raise error
    return None, tuple(answers)


def _at_once(tasks: Sequence[Callable[[], Result]]) -> list[Result]:
    """Return the results of tasks that run at the same time.

    Neither an interrupt nor the end of the process waits for them: a driver may hang.
    """

    def work(task: Callable[[], Result], future: Future[Result]) -> None:
        try:
            future.set_result(task())
        except BaseException as error:
            future.set_exception(error)

    futures: list[Future[Result]] = [Future() for _ in tasks]
    for pair in zip(tasks, futures, strict=True):
        Thread(target=work, args=pair, daemon=True).start()
    return [future.result() for future in futures]


def _tried(do: Callable[..., Any], *arguments: object) -> tuple[Any, Exception | None]:
    """Return the result of a driver's function, or its error: third parties may raise anything."""
    try:
        return do(*arguments), None
    except Exception as error:
        return None, error


def _failure(device: str, why: Exception) -> str:
    text = str(why)
    if not isinstance(why, HilcalError):
        text = f"{type(why).__name__}: {' '.join(text.split())}"
    return text if text.startswith(device) else f"{device}: {text}"


def reported_kinematics(answers: tuple[ConnectionResult, ...]) -> FactoryKinematics | None:
    """Return the kinematics of the arm's controller; None where unknown."""
    return next((a.report.kinematics for a in answers if a.report and a.report.kinematics), None)


def with_kinematics(
    answers: tuple[ConnectionResult, ...], cell: Cell
) -> tuple[ConnectionResult, ...]:
    """Return the results with a comparison of the arm's kinematics with those of the cell."""
    return tuple(
        replace(a, report=_compared(a.report, a.report.kinematics, cell))
        if a.report is not None and a.report.kinematics is not None
        else a
        for a in answers
    )


def nominal_arm(cell: Cell) -> Arm:
    """Return the arm as designed, with its maker's conventions of joint values."""
    robot = cell.configured().robot
    return load_arm(robot.model, cell.base_dir, base_link=robot.base_link, tip_link=robot.tip_link)


def _compared(report: Report, kinematics: FactoryKinematics, cell: Cell) -> Report:
    """Add the difference of the kinematics in the controller from those of the cell."""
    robot, fact = cell.configured().robot, "its kinematics"
    problems = list(report.problems)
    try:
        nominal = nominal_arm(cell)
        controller_arm = with_factory(nominal, kinematics)
    except InputError as error:  # an arm with other joints, or a campaign without its file
        return replace(report, facts=(*report.facts, (fact, str(error))))
    rms, most = flange_difference(controller_arm, nominal)
    measured = "measured" if kinematics.status == LINEARISED_STATUS else "not measured"
    text = (
        f"{measured} by the factory: the flange is {1e3 * rms:.2f} mm (rms; most "
        f"{1e3 * most:.2f} mm) from nominal"
    )
    difference = 0.0
    if cell.factory is not None:
        difference = flange_difference(controller_arm, with_factory(nominal, cell.factory))[1]
    if robot.model in robot_names() and most > OTHER_ARM_M:
        problems.append(
            f"its kinematics are not those of a {robot.model}: the flange is up to "
            f"{1e3 * most:.0f} mm elsewhere; check [robot] model"
        )
    elif difference > SAME_FLANGE_M:
        problems.append(
            f"its kinematics are not those of [robot] calibration = {robot.calibration!r}: the "
            f"flange is up to {1e3 * difference:.3f} mm elsewhere; hilcal check CELL.toml "
            "--save-calibration FILE.toml writes what the controller holds"
        )
    names = ("kinematics_from_nominal_rms_m", "kinematics_from_nominal_max_m")
    return replace(
        report,
        facts=(*report.facts, (fact, text)),
        problems=tuple(problems),
        fields=(*report.fields, *zip(names, (rms, most), strict=True)),
    )
