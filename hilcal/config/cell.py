"""CELL.toml as a whole, and the sections that say what the cell is."""

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, Strict, model_validator

from hilcal.config.sections import (
    HOST,
    OPTIONS,
    PORT,
    ROTVEC,
    VECTOR_M,
    Acquire,
    CellLoad,
    Conventions,
    ForceSensor,
    Gauge,
    Limits,
    Motion,
    Obstacle,
    Operator,
    Planning,
    Point,
    Sight,
    Whole,
)
from hilcal.errors import InputError
from hilcal.toml import NonNegative, Positive, Section, Vector3, check_json, load_section, suggest
from hilcal.types import Floats

STANDARD_GRAVITY_M_S2 = 9.80665


def _std(what: str) -> str:
    return f"the standard deviation {what}"


class Robot(Conventions):
    """[robot]: which arm, how its controller counts the joints, and how it stands in gravity."""

    model: str = Field(
        min_length=1,
        description='a catalogue name, e.g. "ur10e", or the path of a .urdf file or of a .toml '
        "file with DH rows",
        examples=["ur10e"],
    )
    gravity_m_s2: Vector3 = Field(
        (0.0, 0.0, -STANDARD_GRAVITY_M_S2),
        description="gravity in base axes: three finite numbers in m/s², e.g. [0.0, 0.0, -9.80665]",
    )
    repeatability_m: Positive | None = Field(
        None,
        description="the pose repeatability of ISO 9283 that the maker states, in m, more than 0; "
        "that of the arm's file if absent",
        examples=[5e-5],
    )
    driver: str | None = Field(
        None, min_length=1, description='the name of an arm\'s driver, e.g. "ur"', examples=["ur"]
    )
    host: str | None = Field(
        None,
        min_length=1,
        description='the controller\'s address, e.g. "192.168.56.101"',
        examples=["192.168.56.101"],
    )
    options: dict[str, Any] = Field(default_factory=dict, description=OPTIONS, examples=[{}])
    torques: Literal["modelled", "measured"] = Field(
        "modelled",
        description='"modelled" or "measured": the joint torques that twist the drives, those of '
        "the described masses and loads, or the columns tau1_Nm, ... of the readings",
    )
    kinematics: Literal["nominal", "factory"] = Field(
        "nominal",
        description='"nominal" (the arm as its maker designed it) or "factory" (as calibration has '
        "it): what corrections are counted from",
        examples=["factory"],
    )
    calibration: str | None = Field(
        None,
        min_length=1,
        description="the path of a file with the factory's kinematics of this one arm of Universal "
        "Robots: calibration.conf, a .yaml of ur_calibration, or a .toml of "
        "check --save-calibration",
        examples=["calibration.conf"],
    )
    base_link: str | None = Field(
        None, description="the name of a link of the URDF", examples=["base_link"]
    )
    tip_link: str | None = Field(
        None, description="the name of a link of the URDF", examples=["tool0"]
    )

    @model_validator(mode="after")
    def _has_calibration(self) -> "Robot":
        if self.kinematics == "factory" and self.calibration is None:
            raise ValueError(
                'kinematics = "factory" needs calibration = FILE; hilcal check CELL.toml '
                "--save-calibration FILE writes what the controller holds"
            )
        return self

    @model_validator(mode="after")
    def _plausible_gravity(self) -> "Robot":
        size = float(np.linalg.norm(self.gravity_m_s2))
        if size > 30.0:
            raise ValueError(
                f"gravity_m_s2 has the length {size:.4g} m/s²; on Earth it is 9.76 to 9.84"
            )
        return self


class Target(Section):
    """[[tool.targets]]: one of several targets that the tool carries (flange axes)."""

    name: str = Field(min_length=1, description='the name of a target, e.g. "R1"', examples=["R1"])
    target_m: Vector3 | None = Field(
        None,
        description=VECTOR_M + ": the target, flange axes; leave it out to have it estimated",
        examples=[[0.06, 0.02, 0.12]],
    )
    target_rotvec_rad: Vector3 | None = Field(
        None, description=ROTVEC + ": the target's axes in flange axes", examples=[[0.0, 0.0, 1.57]]
    )
    estimate: bool = Field(
        False,
        description="true or false: whether target_m is rough, and the offset estimated",
        examples=[True],
    )

    @model_validator(mode="after")
    def _sound(self) -> "Target":
        if self.name != self.name.strip():
            raise ValueError(f"name = {self.name!r}: a name must not be padded")
        _check_target(self.target_m, self.target_rotvec_rad)
        return self


def _check_target(xyz: tuple[float, ...] | None, rotvec: tuple[float, ...] | None) -> None:
    if xyz is not None and max(map(abs, xyz)) > 5.0:
        raise ValueError(f"target_m = {list(xyz)} lies over 5 m off the flange; is it in m?")
    if rotvec is not None and xyz is None:
        raise ValueError("target_rotvec_rad without target_m; give both or neither")


class Tool(Section):
    """[tool]: what the flange carries, where the target sits and the load acts (flange axes)."""

    target_m: Vector3 | None = Field(
        None,
        description=VECTOR_M + ": the target, flange axes; leave it out to have it estimated",
        examples=[[0.06, 0.02, 0.12]],
    )
    target_rotvec_rad: Vector3 | None = Field(
        None, description=ROTVEC + ": the target's axes in flange axes", examples=[[0.0, 0.0, 1.57]]
    )
    targets: tuple[Target, ...] = Field(
        (),
        description="sections [[tool.targets]], one per target, in the order of measurement",
        examples=[[{"name": "R1", "target_m": [0.06, 0.02, 0.12]}]],
    )
    load_point_m: Vector3 = Field(
        (0.0, 0.0, 0.0),
        description=VECTOR_M + ": where loads act, flange axes",
        examples=[[0.1, 0.0, 0.15]],
    )
    mass_kg: NonNegative = Field(0.0, description="a mass in kg, 0 or more", examples=[0.8])
    com_m: Vector3 = Field(
        (0.0, 0.0, 0.0),
        description=VECTOR_M + ": the tool's centre of mass, flange axes",
        examples=[[0.01, 0.0, 0.06]],
    )

    @model_validator(mode="after")
    def _metres(self) -> "Tool":
        for key in ("load_point_m", "com_m"):
            value = getattr(self, key)
            if max(map(abs, value)) > 5.0:
                raise ValueError(f"{key} = {list(value)} lies over 5 m off the flange; is it in m?")
        _check_target(self.target_m, self.target_rotvec_rad)
        return self

    @model_validator(mode="after")
    def _one_description(self) -> "Tool":
        if self.targets and (self.target_m or self.target_rotvec_rad):
            raise ValueError(
                "target_m together with [[tool.targets]]; give the offset of each target in its "
                "own section"
            )
        names = [t.name for t in self.targets]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f'two [[tool.targets]] have the name "{name}"; names must differ')
        return self


class Tracker(Section):
    """[tracker]: the frame of the readings, its registration, and the tracker's noise.

    The noise of a point at the distance d is sqrt(range² + transverse²) with standard
    deviations `std + std_per_m * d` along and across the beam. Defaults: half of the maximum
    permissible errors of a Leica AT500 (range 10 µm + 0.3 µm/m, transverse 15 µm + 6 µm/m),
    and half of 0.01° for orientations.
    """

    driver: str | None = Field(
        None,
        min_length=1,
        description='the name of a tracker\'s driver, e.g. "geocom" or "emscon"',
        examples=["geocom"],
    )
    port: str | None = Field(
        None, min_length=1, description=PORT, examples=["/dev/serial/by-id/usb-FTDI_..."]
    )
    baud: Whole | None = Field(
        None, description="the line's rate in Bd; the driver's own if absent", examples=[115200]
    )
    host: str | None = Field(None, min_length=1, description=HOST, examples=["192.168.0.1"])
    options: dict[str, Any] = Field(default_factory=dict, description=OPTIONS, examples=[{}])
    frame: Literal["tracker", "base"] = Field(
        "tracker", description='"tracker" or "base": the axes in which positions are given'
    )
    observes: Literal["position", "distance", "height"] = Field(
        "position",
        description='"position", "distance" (from all [points.NAME]) or "height" (of all '
        "[gauges.NAME]): what readings are planned; devices read positions",
    )
    base_xyz_m: Vector3 | None = Field(
        None,
        description=VECTOR_M + ": the arm's base in the tracker frame",
        examples=[[3.0, 0.5, -0.9]],
    )
    base_rotvec_rad: Vector3 | None = Field(None, description=ROTVEC, examples=[[0.0, 0.0, 1.57]])
    station_m: Vector3 | None = Field(
        None,
        description=VECTOR_M + ": the tracker's position in base axes",
        examples=[[3.0, 0.5, 0.9]],
    )
    range_std_m: Positive = Field(
        5e-6, description=_std("along the beam in m, more than 0, e.g. 5e-6")
    )
    range_std_per_m: NonNegative = Field(
        0.15e-6, description=_std("along the beam per metre of distance, 0 or more, e.g. 0.15e-6")
    )
    transverse_std_m: Positive = Field(
        7.5e-6, description=_std("across the beam in m, more than 0, e.g. 7.5e-6")
    )
    transverse_std_per_m: NonNegative = Field(
        3e-6, description=_std("across the beam per metre of distance, 0 or more, e.g. 3e-6")
    )
    orientation_std_rad: Positive = Field(
        8.7e-5, description=_std("of a target's orientation in rad, more than 0, e.g. 8.7e-5")
    )

    @property
    def states_noise(self) -> bool:
        """Whether any figure of the noise is stated, and not a default."""
        return any("_std_" in key for key in self.model_fields_set)

    @model_validator(mode="after")
    def _registration(self) -> "Tracker":
        given = [k for k in ("base_xyz_m", "base_rotvec_rad") if getattr(self, k) is not None]
        if self.frame == "base" and given:
            raise ValueError(
                f'{given[0]} together with frame = "base"; a registration is given only with '
                'frame = "tracker"'
            )
        if len(given) == 1:
            raise ValueError(
                f"{given[0]} alone; a known registration needs base_xyz_m and base_rotvec_rad "
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
        for key in ("range_std_m", "transverse_std_m"):
            if getattr(self, key) > 0.1:
                raise ValueError(f"{key} = {getattr(self, key)} is over 0.1 m; is it in m?")
        return self


class Repeatability(Section):
    """[repeatability]: scatter of the joints from one arrival to the next."""

    joint_std_rad: NonNegative | Annotated[tuple[NonNegative, ...], Field(min_length=1)] = Field(
        0.0,
        description="one standard deviation in rad, 0 or more, or one per joint",
        examples=[1e-5],
    )
    in_tables: bool = Field(
        False,
        description="true where the covariances of imported tables include the arm's scatter",
        examples=[True],
    )

    def per_joint(self, n: int) -> Floats:
        """Return (n,) standard deviations, rad."""
        values = np.asarray(self.joint_std_rad, dtype=np.float64)
        if values.ndim == 1 and len(values) != n:
            raise InputError(
                f"[repeatability] joint_std_rad has {len(values)} values; "
                f"it must be one number or {n}, one per joint"
            )
        return np.broadcast_to(values, n).copy()


class Simulation(Section):
    """[simulation]: what a simulated cell hides."""

    seed: Annotated[int, Strict(), Field(ge=0)] = Field(
        0, description="the seed of the random numbers, a whole number, 0 or more", examples=[4]
    )
    hide: str | None = Field(
        None, description='the name of an effect to hide, or "random"', examples=["creep"]
    )
    strength_sigma: Positive = Field(
        3.0, description="the RMS strength of the hidden effect in sigmas of a reading, more than 0"
    )
    clock: Annotated[float, Strict(), Field(ge=1, le=200)] = Field(
        1.0,
        description="how much faster than real time the simulated world goes, 1 to 200",
        examples=[20.0],
    )
    controller_version: str = Field(
        "5.11.6.1010327",
        pattern=r"^\d+\.\d+\.\d+\.\d+$",
        description="the software of the simulated arm's controller, four numbers with dots "
        "between; from 10 on it is PolyScope X",
        examples=["10.14.0.0"],
    )


class CellConfig(Section):
    """The whole of CELL.toml."""

    robot: Robot = Field(description='a section [robot] with model = "ur10e" or the like')
    tool: Tool = Field(default_factory=Tool, description="a section [tool]")
    tracker: Tracker = Field(default_factory=Tracker, description="a section [tracker]")
    repeatability: Repeatability = Field(
        default_factory=Repeatability, description="a section [repeatability]"
    )
    loads: tuple[CellLoad, ...] = Field((), description="sections [[loads]], one per load")
    force_sensor: ForceSensor | None = Field(
        None, description='a section [force_sensor] with driver = "ft300" and port or the like'
    )
    operator: Operator = Field(default_factory=Operator, description="a section [operator]")
    motion: Motion = Field(default_factory=Motion, description="a section [motion]")
    acquire: Acquire = Field(default_factory=Acquire, description="a section [acquire]")
    limits: Limits = Field(default_factory=Limits, description="a section [limits]")
    planning: Planning = Field(default_factory=Planning, description="a section [planning]")
    obstacles: tuple[Obstacle, ...] = Field(
        (), description="sections [[obstacles]], one per thing that stands in the arm's way"
    )
    sight: Sight = Field(default_factory=Sight, description="a section [sight]")
    points: dict[str, Point] = Field(
        default_factory=dict,
        description="sections [points.NAME], one per point that distances are measured from",
        examples=[{"P1": {"position_m": [1.2, 0.4, 0.0]}}],
    )
    gauges: dict[str, Gauge] = Field(
        default_factory=dict,
        description="sections [gauges.NAME], one per dial gauge or plane that is touched",
        examples=[{"G1": {"direction": [0.0, 0.0, 1.0]}}],
    )
    simulation: Simulation = Field(default_factory=Simulation, description="a section [simulation]")
    ordinary: dict[str, Positive] = Field(
        default_factory=dict,
        description="a section [ordinary]: how many times as large as on other arms an effect is "
        "expected, by its name, e.g. transmission_error = 0.1 of precise gears",
        examples=[{"transmission_error": 0.1}],
    )
    plausible: dict[str, Positive] = Field(
        default_factory=dict,
        description="a section [plausible]: how many times as large as stated an effect may be, "
        "by its name, e.g. link_geometry = 4.0",
        examples=[{"link_geometry": 4.0}],
    )

    @model_validator(mode="after")
    def _distinct_names(self) -> "CellConfig":
        for section, things in (("loads", self.loads), ("obstacles", self.obstacles)):
            names = [thing.name for thing in things]
            for name in names:
                if names.count(name) > 1:
                    raise ValueError(f'two [[{section}]] have the name "{name}"; names must differ')
        return self

    @model_validator(mode="after")
    def _known_work_load(self) -> "CellConfig":
        names = ["none", *(load.name for load in self.loads)]
        load = self.planning.work_load
        if load not in names:
            raise ValueError(
                f'[planning] work_load = "{load}" is not in [[loads]]{suggest(load, names)}; '
                f"valid: {', '.join(names)}"
            )
        return self

    @model_validator(mode="after")
    def _one_place_of_the_tracker(self) -> "CellConfig":
        if self.sight.tracker_m is None:
            return self
        for key in ("station_m", "base_xyz_m"):
            if getattr(self.tracker, key) is not None:
                raise ValueError(
                    f"[sight] tracker_m together with [tracker] {key}, which tells the tracker's "
                    "place already; leave tracker_m out"
                )
        return self

    @property
    def fitted(self) -> Literal["deflection", "absolute"]:
        """What will be fitted: `[planning] readings`; without loads, absolute readings."""
        return self.planning.readings if self.loads else "absolute"

    def to_json(self) -> str:
        """Return the configuration as JSON, defaults included; `from_json` reads it back."""
        return self.model_dump_json()

    @classmethod
    def from_json(cls, text: str) -> "CellConfig":
        """Read what `to_json` wrote.

        Raises:
            InputError: not JSON, unknown key, missing key or bad value.
        """
        return check_json(text, cls, "stored cell configuration")


def load_config(path: Path) -> CellConfig:
    """Read CELL.toml; paths in it are relative to its directory.

    Raises:
        InputError: unreadable file, syntax error (names the line), unknown key (lists the
            valid ones of its section), missing key or bad value.
    """
    return load_section(path, CellConfig)
