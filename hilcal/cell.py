"""The cell as numbers: arm, target, load point, tool, registration."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilcal.config import STANDARD_GRAVITY_M_S2, CellConfig, load_config
from hilcal.errors import InputError
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import load_arm
from hilcal.robot.se3 import rotation
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """What a prediction needs beside states and effects; SI units.

    Attributes:
        arm: the arm.
        target: (4, 4) T_flange_target, the tracked target in flange axes.
        load_point: (3,) where the wrench acts, flange axes, m.
        tool_mass: mass of what the flange carries permanently, kg.
        tool_com: (3,) its centre of mass, flange axes, m.
        gravity: (3,) acceleration of gravity, base axes, m/s².
        registration: (4, 4) T_sensor_base: maps base into sensor (tracker) coordinates.
        registration_known: False where it has to be estimated.
        target_known: False where the target's offset has to be estimated.
        config: the configuration that the cell was made from: instruments, loads, limits; None
            for a cell that was made from numbers alone.
    """

    arm: Arm
    target: Floats
    load_point: Floats
    tool_mass: float
    tool_com: Floats
    gravity: Floats
    registration: Floats
    registration_known: bool
    target_known: bool
    config: CellConfig | None = None

    @classmethod
    def load(cls, path: str | Path) -> "Cell":
        """Read a cell from its TOML file; paths in it are relative to the file.

        >>> hc.Cell.load(CELL).arm.name
        'ur10e'

        Raises:
            InputError: no such file, an unknown key, a bad value, or an unusable robot.
        """
        path = Path(path)
        return cell_from_config(load_config(path), path.absolute().parent)

    def configured(self) -> CellConfig:
        """Return the configuration.

        Raises:
            InputError: the cell was made from numbers alone.
        """
        if self.config is None:
            raise InputError("the cell has no configuration; make it with Cell.load(CELL.toml)")
        return self.config


STANDARD_GRAVITY = np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])


def cell_from_config(config: CellConfig, base_dir: Path | None = None) -> Cell:
    """Return the cell that a configuration describes.

    Unknown is what the configuration leaves out: the target where `target_m` is absent, the
    registration where `frame = "tracker"` comes without a pose of the base; both start as
    identities.

    Args:
        config: the checked configuration.
        base_dir: directory that a robot's file path is relative to.

    Raises:
        InputError: unknown robot, unusable robot file, or a number of joint values that does
            not fit the arm.
    """
    robot, tool, tracker = config.robot, config.tool, config.tracker
    arm = load_arm(robot.model, base_dir, base_link=robot.base_link, tip_link=robot.tip_link)
    config.repeatability.per_joint(arm.n)
    return Cell(
        arm=arm,
        target=_pose(tool.target_m, tool.target_rotvec_rad),
        load_point=np.array(tool.load_point_m),
        tool_mass=tool.mass_kg,
        tool_com=np.array(tool.com_m),
        gravity=np.array(robot.gravity_m_s2),
        registration=_pose(tracker.base_xyz_m, tracker.base_rotvec_rad),
        registration_known=tracker.frame == "base" or tracker.base_xyz_m is not None,
        target_known=tool.target_m is not None,
        config=config,
    )


def tracker_place(cell: Cell, config: CellConfig) -> Floats | None:
    """Return (3,) where the tracker stands, base axes, m; None where it is not known.

    From a known registration T_sensor_base it is −Rᵀ p; else `[tracker] station_m` (positions in
    base axes), else `[sight] tracker_m`.
    """
    if config.tracker.frame == "tracker" and cell.registration_known:
        return np.asarray(-cell.registration[:3, :3].T @ cell.registration[:3, 3])
    told = config.tracker.station_m or config.sight.tracker_m
    return None if told is None else np.array(told)


def _pose(xyz: tuple[float, ...] | None, rotvec: tuple[float, ...] | None) -> Floats:
    """(4, 4) pose; identity for what is not given."""
    pose = np.eye(4)
    if rotvec is not None:
        pose[:3, :3] = rotation(np.array(rotvec))
    if xyz is not None:
        pose[:3, 3] = xyz
    return pose
