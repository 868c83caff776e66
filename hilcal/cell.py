"""The cell in numbers: arm, target, load point, tool, registration."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.config import STANDARD_GRAVITY_M_S2, CellConfig, load_config
from hilcal.config.sections import Gauge, Point
from hilcal.errors import InputError, expect
from hilcal.readings.readings import ObserverName
from hilcal.robot import se3
from hilcal.robot.arm import Arm, with_controller_conventions
from hilcal.robot.catalogue import load_arm
from hilcal.robot.factory import FactoryKinematics, read_factory, with_factory
from hilcal.shown import Brief
from hilcal.toml import check_section
from hilcal.types import Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class Observer:
    """An observer of the target, with the target's position p in the observer's axes."""

    name: ObserverName  # a station reads p, a point |p| + offset, a gauge p_x
    frame: Floats  # (4, 4) T_observer_sensor
    # estimated elements of the twist of the frame, observer's axes; of a point, whose rotation has
    # no meaning, 3 is the offset (see `Deviation.observer`)
    free: tuple[int, ...]
    offset: float = 0.0  # of a distance, m

    @property
    def tied(self) -> bool:
        """Whether its place is described, in axes that other observers share."""
        return (
            not self.free or self.free == (3,) or (self.name.kind == "gauge" and self.free == (0,))
        )


def plane_frame(direction: Floats, origin: Floats) -> Floats:
    """Return the frame (4, 4) with origin (3,) and x axis along `direction` (3,), of any length."""
    x = direction / np.linalg.norm(direction)
    y = np.cross(np.eye(3)[int(np.argmin(np.abs(x)))], x)
    y /= np.linalg.norm(y)
    frame = np.eye(4)
    frame[:3, :3] = np.stack([x, y, np.cross(x, y)])
    frame[:3, 3] = -frame[:3, :3] @ origin
    return frame


@dataclass(frozen=True, slots=True, eq=False)
class Cell(Brief):
    """The data that a prediction needs besides states and effects; SI units."""

    arm: Arm
    target: Floats  # (4, 4) T_flange_target, the tracked target in flange axes
    load_point: Floats  # (3,) where the wrench acts, flange axes, m
    tool_mass: float  # of what the flange carries permanently, kg
    tool_com: Floats  # (3,) centre of that mass, flange axes, m
    gravity: Floats  # (3,) acceleration, base axes, m/s²
    registration: Floats  # (4, 4) T_sensor_base: maps base into sensor (tracker) coordinates
    registration_known: bool  # False where it has to be estimated
    target_known: bool  # False where the offset of a target has to be estimated
    config: CellConfig | None = None  # its source; None if it was made from numbers alone
    base_dir: Path = Path()  # reference of relative paths in `config`
    # whether effects use measured joint torques, where readings have them, instead of those
    # computed from the described masses and loads
    measured_torques: bool = False
    # the factory's kinematics, from a file; `arm` has them where the configuration says so
    factory: FactoryKinematics | None = None
    # (T, 4, 4) T_flange_target of several targets, `target` the first; None where there is one
    targets: Floats | None = None
    target_names: tuple[str, ...] = ()  # of several targets
    targets_known: tuple[bool, ...] = ()  # whether the offset of each is known
    # in the order of `Readings.observers`; empty where one tracker reads all
    observers: tuple[Observer, ...] = ()

    @property
    def all_targets(self) -> Floats:
        """(T, 4, 4) T_flange_target of all targets."""
        return self.target[None] if self.targets is None else self.targets

    @property
    def known_targets(self) -> tuple[bool, ...]:
        """Whether the offset is known, for each of the T targets."""
        return (self.target_known,) if self.targets is None else self.targets_known

    def target_of(self, number: Ints | None) -> Floats:
        """Return targets (N, 4, 4) by number (N,), see `States.target`; (4, 4) for None."""
        return self.target if number is None else self.all_targets[number]

    def with_targets(self, poses: Floats, known: Sequence[bool] | None = None) -> "Cell":
        """Return the cell with other T_flange_target (T, 4, 4), and whether each is known."""
        flags = tuple(self.known_targets if known is None else known)
        several = self.targets is not None
        targets, known = (poses, flags) if several else (None, ())
        return replace(
            self, target=poses[0], target_known=all(flags), targets=targets, targets_known=known
        )

    def observed_by(self, names: Sequence[ObserverName]) -> "Cell":
        """Return the cell with the observers of readings, by its configuration.

        The first station's axes are those of the positions. Without a station and without a stated
        place of any point or gauge, the axes of the positions are those of the base.
        """
        if not names or tuple(o.name for o in self.observers) == tuple(names):
            return self
        stations = [name for name in names if name.kind == "station"]
        observers = tuple(self._observer(name, name in stations[:1]) for name in names)
        observed = replace(self, observers=observers)
        return replace(observed, registration_known=self.registration_known or not observed.tied)

    @property
    def tied(self) -> bool:
        """Whether the observers define axes of the positions other than those of the base."""
        return not self.observers or any(o.tied for o in self.observers)

    def _observer(self, name: ObserverName, first: bool) -> Observer:
        """Return an observer by its description; `first`: whether it is the first station."""
        frame = np.eye(4)
        if name.kind == "station":
            return Observer(name, frame, () if first else tuple(range(6)))
        if name.kind == "point":
            point = (self.config.points if self.config else {}).get(name.name, Point())
            free = (0, 1, 2) if point.position_m is None else ()
            if point.position_m is not None:
                frame[:3, 3] = np.negative(point.position_m)
            return Observer(name, frame, free + (3,) * point.estimate_offset, point.offset_m)
        gauge = (self.config.gauges if self.config else {}).get(name.name, Gauge())
        if gauge.direction is None:
            return Observer(name, frame, (0, 4, 5))
        frame = plane_frame(np.array(gauge.direction), np.array(gauge.origin_m or (0.0, 0.0, 0.0)))
        return Observer(name, frame, (0,) if gauge.origin_m is None else ())

    @classmethod
    def load(cls, path: str | Path | Mapping[str, Any]) -> "Cell":
        """Read a cell from its TOML file, or from a dictionary of sections with the same keys.

        Paths in it are relative to the file, those in a dictionary to the working directory.

        >>> hc.Cell.load(CELL).arm.name
        'ur10e'
        >>> hc.Cell.load({"robot": {"model": "ur5e"}, "tool": {"target_m": [0.0, 0.0, 0.1]}}).target
        array([[1. , 0. , 0. , 0. ],
               [0. , 1. , 0. , 0. ],
               [0. , 0. , 1. , 0.1],
               [0. , 0. , 0. , 1. ]])

        An InputError says what cannot be used: the file, a key, a value, or the robot.
        """
        expect(path, (str, Path, Mapping), "path", "the path of a CELL.toml, or its sections")
        if isinstance(path, Mapping):
            return cell_from_config(check_section(dict(path), CellConfig, "the cell"), Path.cwd())
        path = Path(path)
        return cell_from_config(load_config(path), path.absolute().parent)

    def configured(self) -> CellConfig:
        """Return the configuration; an InputError if the cell was made from numbers alone."""
        if self.config is None:
            raise InputError("the cell has no configuration; make it with Cell.load(CELL.toml)")
        return self.config

    def with_config(self, config: CellConfig) -> "Cell":
        """Return the cell with another configuration; its numbers stay as they are."""
        return replace(self, config=config)


STANDARD_GRAVITY = np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])


def cell_from_config(
    config: CellConfig,
    base_dir: Path | None = None,  # reference of relative paths of the robot's files
    robot_file: str | None = None,  # its text, as a campaign stores it; then no file is read
    calibration_file: str | None = None,  # the same of the factory's kinematics
) -> Cell:
    """Return the cell that a configuration describes.

    The target is unknown without `target_m`, the registration where `frame = "tracker"` comes
    without a pose of the base. Both are the identity then. An InputError for an unknown robot, an
    unusable file, or a number of joint values that does not fit the arm.
    """
    robot, tool, tracker = config.robot, config.tool, config.tracker
    arm = load_arm(
        robot.model, base_dir, base_link=robot.base_link, tip_link=robot.tip_link, text=robot_file
    )
    factory = None
    if robot.calibration is not None:
        path = (base_dir or Path()) / robot.calibration
        factory = read_factory(path, arm, calibration_file)
        arm = with_factory(arm, factory) if robot.kinematics == "factory" else arm
    try:
        arm = with_controller_conventions(arm, robot)
    except InputError as error:
        raise InputError(f"[robot] {error}") from None
    if robot.repeatability_m is not None:
        arm = replace(arm, repeatability=robot.repeatability_m)
    config.repeatability.per_joint(arm.n)
    described = tool.targets or (tool,)
    poses = np.stack([_pose(t.target_m, t.target_rotvec_rad) for t in described])
    known = tuple(t.target_m is not None and not getattr(t, "estimate", False) for t in described)
    return Cell(
        arm=arm,
        target=poses[0],
        load_point=np.array(tool.load_point_m),
        tool_mass=tool.mass_kg,
        tool_com=np.array(tool.com_m),
        gravity=np.array(robot.gravity_m_s2),
        registration=_pose(tracker.base_xyz_m, tracker.base_rotvec_rad),
        registration_known=tracker.frame == "base" or tracker.base_xyz_m is not None,
        target_known=all(known),
        config=config,
        base_dir=base_dir or Path(),
        measured_torques=robot.torques == "measured",
        targets=poses if len(poses) > 1 else None,
        factory=factory,
        target_names=tuple(t.name for t in tool.targets),
        targets_known=known if len(poses) > 1 else (),
    )


def tracker_place(cell: Cell) -> Floats | None:
    """Return the tracker's position (3,), base axes, m; None where it is unknown.

    It is −Rᵀ p of a known registration T_sensor_base; else `[tracker] station_m` (positions in base
    axes), else `[sight] tracker_m`.
    """
    config = cell.configured()
    if config.tracker.frame == "tracker" and cell.registration_known:
        return np.asarray(-cell.registration[:3, :3].T @ cell.registration[:3, 3])
    position = config.tracker.station_m or config.sight.tracker_m
    return None if position is None else np.array(position)


def _pose(xyz: tuple[float, ...] | None, rotvec: tuple[float, ...] | None) -> Floats:
    """Return a pose (4, 4), without the translation or the rotation that is None."""
    zero = (0.0, 0.0, 0.0)
    return se3.of_six([*(xyz or zero), *(rotvec or zero)])
