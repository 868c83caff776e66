"""CELL.toml as a whole, the sections that describe the cell, and changes after its readings.

A change is a new value of a key of CELL.toml, and is checked like CELL.toml. Keys that determine
the stored readings and wrenches (the robot, the loads, the frame of the positions, ...) cannot be
changed: they need a new import or measurement.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, Strict, model_validator

from hilcal.config import sections
from hilcal.errors import InputError
from hilcal.toml import (
    NonNegative,
    Positive,
    Vector3,
    check_json,
    check_section,
    load_section,
    section_of,
    suggest,
)
from hilcal.types import Floats

SIMULATED = "simulated"  # driver of the operator of every simulated cell
STANDARD_GRAVITY_M_S2 = 9.80665


class Robot(sections.Conventions):
    """[robot]: which arm, how its controller counts the joints, and how it stands in gravity.

    model: a catalogue name, e.g. "ur10e", or the path of a .urdf file or of a .toml file with DH
        rows | "ur10e"
    gravity_m_s2: gravity in base axes: three finite numbers in m/s², e.g. [0.0, 0.0, -9.80665]
    repeatability_m: the pose repeatability of ISO 9283 that the maker states, in m, more than 0;
        that of the arm's file if absent | 5e-05
    driver: the name of an arm's driver, e.g. "ur" | "ur"
    host: the controller's address, e.g. "192.168.56.101" | "192.168.56.101"
    options: $OPTIONS | {}
    torques: "modelled" or "measured": the joint torques that twist the drives, those of the
        described masses and loads, or the columns tau1_Nm, ... of the readings
    kinematics: "nominal" (the arm as its maker designed it) or "factory" (as calibration has it):
        what corrections are counted from | "factory"
    calibration: the path of a file with the factory's kinematics of this one arm of Universal
        Robots: calibration.conf, a .yaml of ur_calibration, or a .toml of check --save-calibration
        | "calibration.conf"
    base_link: the name of a link of the URDF | "base_link"
    tip_link: the name of a link of the URDF | "tool0"
    """

    model: str = Field(min_length=1)
    gravity_m_s2: Vector3 = (0.0, 0.0, -STANDARD_GRAVITY_M_S2)
    repeatability_m: sections.Accuracy | None = None
    driver: str | None = Field(None, min_length=1)
    host: str | None = Field(None, min_length=1)
    options: dict[str, Any] = Field(default_factory=dict)
    torques: Literal["modelled", "measured"] = "modelled"
    kinematics: Literal["nominal", "factory"] = "nominal"
    calibration: str | None = Field(None, min_length=1)
    base_link: str | None = None
    tip_link: str | None = None

    @model_validator(mode="after")
    def _sound(self) -> "Robot":
        if self.kinematics == "factory" and self.calibration is None:
            raise ValueError(
                'kinematics = "factory" needs calibration = FILE; hilcal check CELL.toml '
                "--save-calibration FILE writes what the controller holds"
            )
        size = float(np.linalg.norm(self.gravity_m_s2))
        if size > 30.0:
            raise ValueError(
                f"gravity_m_s2 has the length {size:.4g} m/s²; on Earth it is 9.76 to 9.84"
            )
        return self


class Target(sections.CellSection):
    """[[tool.targets]]: one of several targets that the tool carries (flange axes).

    name: the name of a target, e.g. "R1" | "R1"
    target_m: $VECTOR_M: the target, flange axes; leave it out to have it estimated | [0.06, 0.02,
        0.12]
    target_rotvec_rad: $ROTVEC: the target's axes in flange axes | [0.0, 0.0, 1.57]
    estimate: true or false: whether target_m is rough, and the offset estimated | true
    """

    name: str = Field(min_length=1)
    target_m: sections.OnFlange | None = None
    target_rotvec_rad: sections.RotationVector | None = None
    estimate: bool = False

    @model_validator(mode="after")
    def _sound(self) -> "Target":
        if self.name != self.name.strip():
            raise ValueError(f"name = {self.name!r}: a name must not be padded")
        _check_target(self.target_m, self.target_rotvec_rad)
        return self


def _check_target(xyz: tuple[float, ...] | None, rotvec: tuple[float, ...] | None) -> None:
    if rotvec is not None and xyz is None:
        raise ValueError("target_rotvec_rad without target_m; give both or neither")


class Tool(sections.CellSection):
    """[tool]: what the flange carries, where the target sits and the load acts (flange axes).

    target_m: $VECTOR_M: the target, flange axes; leave it out to have it estimated | [0.06, 0.02,
        0.12]
    target_rotvec_rad: $ROTVEC: the target's axes in flange axes | [0.0, 0.0, 1.57]
    targets: sections [[tool.targets]], one per target, in the order of measurement | [{ name =
        "R1", target_m = [0.06, 0.02, 0.12] }]
    load_point_m: $VECTOR_M: where loads act, flange axes | [0.1, 0.0, 0.15]
    mass_kg: a mass in kg, 0 or more | 0.8
    com_m: $VECTOR_M: the tool's centre of mass, flange axes | [0.01, 0.0, 0.06]
    """

    target_m: sections.OnFlange | None = None
    target_rotvec_rad: sections.RotationVector | None = None
    targets: tuple[Target, ...] = ()
    load_point_m: sections.OnFlange = (0.0, 0.0, 0.0)
    mass_kg: sections.Mass = 0.0
    com_m: sections.OnFlange = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _sound(self) -> "Tool":
        _check_target(self.target_m, self.target_rotvec_rad)
        if self.targets and (self.target_m or self.target_rotvec_rad):
            raise ValueError(
                "target_m together with [[tool.targets]]; give the offset of each target in its "
                "own section"
            )
        sections.check_distinct("tool.targets", self.targets)
        return self


class Tracker(sections.CellSection):
    """[tracker]: the frame of the readings, its registration, and the tracker's noise.

    The noise of a point at the distance d is sqrt(range² + transverse²) with standard
    deviations `std + std_per_m * d` along and across the beam. Defaults: half of the maximum
    permissible errors of a Leica AT500 (range 10 µm + 0.3 µm/m, transverse 15 µm + 6 µm/m),
    and half of 0.01° for orientations.

    driver: the name of a tracker's driver, e.g. "geocom" or "emscon" | "geocom"
    port: $PORT | "/dev/serial/by-id/usb-FTDI_..."
    baud: the line's rate in Bd; the driver's own if absent | 115200
    host: $HOST | "192.168.0.1"
    options: $OPTIONS | {}
    frame: "tracker" or "base": the axes in which positions are given
    observes: "position", "distance" (from all [points.NAME]) or "height" (of all [gauges.NAME]):
        what readings are planned; devices read positions
    base_xyz_m: $VECTOR_M: the arm's base in the tracker frame | [3.0, 0.5, -0.9]
    base_rotvec_rad: $ROTVEC | [0.0, 0.0, 1.57]
    station_m: $VECTOR_M: the tracker's position in base axes | [3.0, 0.5, 0.9]
    range_std_m: the standard deviation along the beam in m, more than 0, e.g. 5e-6
    range_std_per_m: the standard deviation along the beam per metre of distance, 0 or more, e.g.
        0.15e-6
    transverse_std_m: the standard deviation across the beam in m, more than 0, e.g. 7.5e-6
    transverse_std_per_m: the standard deviation across the beam per metre of distance, 0 or more,
        e.g. 3e-6
    orientation_std_rad: the standard deviation of a target's orientation in rad, more than 0, e.g.
        8.7e-5
    """

    driver: str | None = Field(None, min_length=1)
    port: str | None = Field(None, min_length=1)
    baud: sections.Whole | None = None
    host: str | None = Field(None, min_length=1)
    options: dict[str, Any] = Field(default_factory=dict)
    frame: Literal["tracker", "base"] = "tracker"
    observes: Literal["position", "distance", "height"] = "position"
    base_xyz_m: sections.Place | None = None
    base_rotvec_rad: sections.RotationVector | None = None
    station_m: sections.Place | None = None
    range_std_m: sections.InstrumentStd = 5e-6
    range_std_per_m: sections.InstrumentStdPerMetre = 0.15e-6
    transverse_std_m: sections.InstrumentStd = 7.5e-6
    transverse_std_per_m: sections.InstrumentStdPerMetre = 3e-6
    orientation_std_rad: Positive = 8.7e-5

    @property
    def states_noise(self) -> bool:
        """Whether any figure of the noise is stated, and not a default."""
        return any("_std_" in key for key in self.model_fields_set)

    @model_validator(mode="after")
    def _registration(self) -> "Tracker":
        stated = [k for k in ("base_xyz_m", "base_rotvec_rad") if getattr(self, k) is not None]
        if self.frame == "base" and stated:
            raise ValueError(
                f'{stated[0]} together with frame = "base"; a registration is given only with '
                'frame = "tracker"'
            )
        if len(stated) == 1:
            raise ValueError(
                f"{stated[0]} alone; a known registration needs base_xyz_m and base_rotvec_rad "
                "(leave both out to have it estimated)"
            )
        if self.frame == "tracker" and self.station_m is not None:
            raise ValueError(
                'station_m together with frame = "tracker"; there the tracker is the origin, '
                'and station_m is given only with frame = "base"'
            )
        if self.observes != "position" and self.driver is not None:
            raise ValueError(
                f'observes = "{self.observes}" together with driver = "{self.driver}", which reads '
                "positions; leave one of them out"
            )
        return self


class Repeatability(sections.CellSection):
    """[repeatability]: scatter of the joints from one arrival to the next.

    joint_std_rad: one standard deviation in rad, 0 or more, or one per joint | 1e-05
    in_tables: true where the covariances of imported tables include the arm's scatter | true
    """

    joint_std_rad: NonNegative | Annotated[tuple[NonNegative, ...], Field(min_length=1)] = 0.0
    in_tables: bool = False

    def per_joint(self, n: int) -> Floats:
        """Return (n,) standard deviations, rad."""
        values = np.asarray(self.joint_std_rad, dtype=np.float64)
        if values.ndim == 1 and len(values) != n:
            raise InputError(
                f"[repeatability] joint_std_rad has {len(values)} values; "
                f"it must be one number or {n}, one per joint"
            )
        return np.broadcast_to(values, n).copy()


class Simulation(sections.CellSection):
    """[simulation]: what a simulated cell hides.

    seed: the seed of the random numbers, a whole number, 0 or more | 4
    hide: the name of an effect to hide, or "random" | "creep"
    strength_sigma: the RMS strength of the hidden effect in sigmas of a reading, more than 0
    clock: how much faster than real time the simulated world goes, 1 to 200; real devices go at 1 |
        20.0
    controller_version: the software of the simulated arm's controller, four numbers with dots
        between; from 10 on it is PolyScope X | "10.14.0.0"
    """

    seed: Annotated[int, Strict(), Field(ge=0)] = 0
    hide: str | None = None
    strength_sigma: Positive = 3.0
    clock: Annotated[float, Strict(), Field(ge=1, le=200)] = 1.0
    controller_version: str = Field("5.11.6.1010327", pattern=r"^\d+\.\d+\.\d+\.\d+$")


class CellConfig(sections.CellSection):
    """The whole of CELL.toml.

    robot: a section [robot] with model = "ur10e" or the like
    loads: sections [[loads]], one per load
    force_sensor: a section [force_sensor] with driver = "ft300" and port or the like
    obstacles: sections [[obstacles]], one per thing that stands in the arm's way
    points: sections [points.NAME], one per point that distances are measured from | { P1 = {
        position_m = [1.2, 0.4, 0.0] } }
    gauges: sections [gauges.NAME], one per dial gauge or plane that is touched | { G1 = { direction
        = [0.0, 0.0, 1.0] } }
    ordinary: a section [ordinary]: how many times as large as on other arms an effect is expected,
        by its name, e.g. transmission_error = 0.1 of precise gears | { transmission_error = 0.1 }
    plausible: a section [plausible]: how many times as large as stated an effect may be, by its
        name, e.g. link_geometry = 4.0 | { link_geometry = 4.0 }
    """

    robot: Robot
    tool: Tool = Field(default_factory=Tool)
    tracker: Tracker = Field(default_factory=Tracker)
    repeatability: Repeatability = Field(default_factory=Repeatability)
    loads: tuple[sections.CellLoad, ...] = ()
    force_sensor: sections.ForceSensor | None = None
    operator: sections.Operator = Field(default_factory=sections.Operator)
    motion: sections.Motion = Field(default_factory=sections.Motion)
    acquire: sections.Acquire = Field(default_factory=sections.Acquire)
    limits: sections.Limits = Field(default_factory=sections.Limits)
    planning: sections.Planning = Field(default_factory=sections.Planning)
    obstacles: tuple[sections.Obstacle, ...] = ()
    sight: sections.Sight = Field(default_factory=sections.Sight)
    points: dict[str, sections.Point] = Field(default_factory=dict)
    gauges: dict[str, sections.Gauge] = Field(default_factory=dict)
    simulation: Simulation = Field(default_factory=Simulation)
    ordinary: dict[str, Positive] = Field(default_factory=dict)
    plausible: dict[str, Positive] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> "CellConfig":
        sections.check_distinct("loads", self.loads)
        sections.check_distinct("obstacles", self.obstacles)
        names = ["none", *(load.name for load in self.loads)]
        load = self.planning.work_load
        if load not in names:
            raise ValueError(
                f'[planning] work_load = "{load}" is not in [[loads]]{suggest(load, names)}; '
                f"valid: {', '.join(names)}"
            )
        for key in ("station_m", "base_xyz_m"):
            if self.sight.tracker_m is not None and getattr(self.tracker, key) is not None:
                raise ValueError(
                    f"[sight] tracker_m together with [tracker] {key}, which tells the tracker's "
                    "place already; leave tracker_m out"
                )
        return self

    @property
    def clock(self) -> float:
        """Cell seconds per real second: `[simulation] clock` of simulated devices, else 1."""
        return self.simulation.clock if self.operator.driver == SIMULATED else 1.0

    @property
    def readings_mode(self) -> Literal["deflection", "absolute"]:
        """Kind of readings that will be fitted: `[planning] readings`; "absolute" without loads."""
        return self.planning.readings if self.loads else "absolute"

    @property
    def planned_mode(self) -> Literal["deflection", "absolute"]:
        """Kind of readings that a plan is made for; an InputError for deflections without loads."""
        if self.planning.readings == "deflection" and not self.loads:
            raise InputError(
                '[planning] readings = "deflection" needs [[loads]]; give one, or '
                'readings = "absolute"'
            )
        return self.planning.readings

    def with_keys(self, section: str, **values: object) -> "CellConfig":
        """Return the configuration with other values of a section's keys, which are not checked."""
        return self.model_copy(update={section: getattr(self, section).model_copy(update=values)})

    def to_json(self) -> str:
        """Return the configuration as JSON, defaults included; `from_json` reads it back."""
        return self.model_dump_json()

    @classmethod
    def from_json(cls, text: str) -> "CellConfig":
        """Read what `to_json` wrote; raises as `check_json` does."""
        return check_json(text, cls, "stored cell configuration")


def load_config(path: Path) -> CellConfig:
    """Read CELL.toml, whose paths are relative to its directory; raises as `load_section` does."""
    return load_section(path, CellConfig)


Changes = Mapping[str, Mapping[str, Any]]  # Values by key, by section

INSTRUMENT_NOISE = (
    "range_std_m", "range_std_per_m", "transverse_std_m", "transverse_std_per_m",
    "orientation_std_rad",
)  # fmt: skip
"""Keys of [tracker]: the noise of a tracker."""
CHANGEABLE: Mapping[str, tuple[str, ...]] = {
    "tracker": (*INSTRUMENT_NOISE, "base_xyz_m", "base_rotvec_rad", "station_m"),
    "repeatability": ("joint_std_rad",),
    "tool": ("target_m", "target_rotvec_rad", "targets", "load_point_m", "mass_kg", "com_m"),
}
"""Keys that can be changed, by section."""
_WHERE = "the cell"


def changed(config: CellConfig, changes: Changes) -> CellConfig:
    """Return a configuration with changes of keys of `CHANGEABLE`; None removes a key."""
    if not changes:
        return config
    content = config.model_dump(mode="json")
    for section, keys in changes.items():
        valid = CHANGEABLE.get(section, ())
        for key, value in keys.items():
            if key not in valid:
                valid_keys = [f"[{s}] {k}" for s, names in CHANGEABLE.items() for k in names]
                raise InputError(
                    f"{_WHERE}: [{section}] {key} cannot be changed once there are readings"
                    f"{suggest(f'[{section}] {key}', valid_keys)}; valid: {', '.join(valid_keys)}"
                )
            content[section][key] = value
    merged = check_section(content, CellConfig, _WHERE)
    names = [[t.name for t in c.tool.targets] for c in (config, merged)]
    if names[0] != names[1]:
        raise InputError(
            f"{_WHERE}: [tool] targets has other names than the readings; valid: "
            f"{', '.join(names[0]) or 'no targets'}"
        )
    return merged


def read_value(section: str, key: str, text: str) -> Any:
    """Return a value from its text in CELL.toml; an empty text is None."""
    if not text.strip():
        return None
    try:
        parsed = tomllib.loads(f"{key} = {text}")
    except (tomllib.TOMLDecodeError, RecursionError, ValueError):
        parsed = {}
    if list(parsed) != [key]:
        raise InputError(
            f"{_WHERE}: [{section}] {key} = {' '.join(text.split())[:60]} is not valid: it must be "
            f"{described(section, key)}"
        )
    return parsed[key]


def described(section: str, key: str) -> str:
    """Return the description of a key's valid values."""
    fields = getattr(section_of(CellConfig.model_fields[section]), "model_fields", {})
    return str(fields[key].description)


def write_value(value: Any) -> str:
    """Return a value as text in CELL.toml; None is "not given"."""
    if value is None:
        return "not given"
    if isinstance(value, Mapping):
        stated = {k: v for k, v in value.items() if v is not None}
        return "{" + ", ".join(f"{k} = {write_value(v)}" for k, v in stated.items()) + "}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(write_value(v) for v in value)}]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else f"{value:.12g}"
