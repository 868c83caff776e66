"""Sections of CELL.toml: devices, motion, joints, loads, limits, observers, planning."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, Strict, ValidationInfo, model_validator

from hilcal.toml import STORED, NonNegative, Number, Positive, Section, Vector3
from hilcal.types import Floats

Whole = Annotated[int, Strict(), Field(ge=1)]
HOST = 'the address in the network, e.g. "192.168.0.1"; another port as "192.168.0.1:7000"'
"""Description of the key `host` of an instrument that is connected by Ethernet."""
PORT = 'the serial port, e.g. "/dev/serial/by-id/usb-FTDI_..."'


def _within_a_turn(vector: tuple[float, ...], about: ValidationInfo) -> tuple[float, ...]:
    """Refuse a rotation vector in degrees."""
    if np.linalg.norm(vector) > 2 * np.pi + 1e-6 and not (about.context or {}).get(STORED):
        raise ValueError(f"{about.field_name} = {list(vector)} is over a turn; is it in rad?")
    return vector


def _within(most: float, unit: str = "m") -> AfterValidator:
    """Refuse what no cell has, e.g. a place in millimetres."""

    def check(value: Any, about: ValidationInfo) -> Any:
        if np.max(np.abs(value)) > most and not (about.context or {}).get(STORED):
            shown = value if isinstance(value, float) else list(value)
            raise ValueError(
                f"{about.field_name} = {shown} is over {most:g} {unit}; is it in {unit}?"
            )
        return value

    return AfterValidator(check)


RotationVector = Annotated[Vector3, AfterValidator(_within_a_turn)]
Place = Annotated[Vector3, _within(50.0)]
"""A place in base or tracker axes. In millimetres, an obstacle or a limit would be far away."""
OnFlange = Annotated[Vector3, _within(5.0)]
Length = Annotated[NonNegative, _within(50.0)]
Accuracy = Annotated[Positive, _within(0.02)]
"""An allowed error, or a repeatability: arms are off by less before any calibration."""
Mass = Annotated[NonNegative, _within(5000.0, "kg")]
"""The strongest arms carry 2300 kg."""
Force = Annotated[Vector3, _within(50_000.0, "N")]
Moment = Annotated[Vector3, _within(50_000.0, "N·m")]
InstrumentStd = Annotated[Positive, _within(0.1)]
InstrumentStdPerMetre = Annotated[NonNegative, _within(0.1, "m/m")]


class CellSection(Section):
    """A section of CELL.toml."""

    WORDS: ClassVar[Mapping[str, str]] = {
        "$VECTOR_M": "three finite numbers in m, e.g. [0.0, 0.0, 0.1]",
        "$ROTVEC": "a rotation vector: three finite numbers in rad, e.g. [0.0, 0.0, 1.57]",
        "$OPTIONS": "a table of the driver's own keys",
        "$HOST": HOST,
        "$PORT": PORT,
    }


def check_distinct(section: str, named: Sequence[Any]) -> None:
    """Refuse two sections of the same name."""
    names = [entry.name for entry in named]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f'two [[{section}]] have the name "{name}"; names must differ')


def _check_box(section: Section, low: str, high: str) -> None:
    a, b = getattr(section, low), getattr(section, high)
    if a is not None and b is not None and not np.all(np.less(a, b)):
        raise ValueError(f"{low} = {list(a)} is not below {high} = {list(b)}")


class Motion(CellSection):
    """[motion]: how the arm moves from pose to pose; calibration is slow on purpose.

    speed_rad_s: the leading joint's speed in rad/s, over 0
    acceleration_rad_s2: the leading joint's acceleration in rad/s², over 0
    arrival_rad: the largest joint error at arrival in rad, over 0, e.g. 5e-4
    """

    speed_rad_s: Positive = 0.5
    acceleration_rad_s2: Positive = 0.5
    arrival_rad: Positive = 5e-4

    @model_validator(mode="after")
    def _slow(self) -> "Motion":
        if self.speed_rad_s > 2.0:
            raise ValueError(f"speed_rad_s = {self.speed_rad_s}; a calibration moves at 2 or less")
        if self.acceleration_rad_s2 > 10.0:
            raise ValueError(f"acceleration_rad_s2 = {self.acceleration_rad_s2}; valid: up to 10")
        return self


class ForceSensor(CellSection):
    """[force_sensor]: the wrench sensor between flange and tool.

    driver: the name of a driver, e.g. "ft300", "bota" or "netft" | "ft300"
    port: $PORT | "/dev/serial/by-id/usb-Silicon_Labs_..."
    host: $HOST | "192.168.1.1"
    baud: the line's rate in Bd; the driver's own if absent | 19200
    origin_m: $VECTOR_M: the sensor's origin, flange axes | [0.0, 0.0, 0.02]
    rotvec_rad: $ROTVEC: the sensor's axes in flange axes | [0.0, 0.0, 1.57]
    max_force_N: a force in N that stops the arm, over 0
    max_moment_Nm: a moment in N·m that stops the arm, over 0
    use: "pulls" (measured wrench for loads with force_N or moment_Nm, mass times gravity for dead
        weights), "all" (always the measured one) or "verify" (never) | "all"
    options: $OPTIONS | {}
    """

    driver: str = Field(min_length=1)
    port: str | None = Field(None, min_length=1)
    host: str | None = Field(None, min_length=1)
    baud: Whole | None = None
    origin_m: OnFlange = (0.0, 0.0, 0.0)
    rotvec_rad: RotationVector = (0.0, 0.0, 0.0)
    max_force_N: Positive = 250.0
    max_moment_Nm: Positive = 25.0
    use: Literal["pulls", "all", "verify"] = "pulls"
    options: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _connected(self) -> "ForceSensor":
        if self.port is None and self.host is None:
            raise ValueError(f'lacks "port": it must be {PORT}; or "host": {HOST}')
        return self

    @property
    def mounting(self) -> dict[str, list[float]]:
        """Origin and axes on the flange, as JSON."""
        return {"origin_m": list(self.origin_m), "rotvec_rad": list(self.rotvec_rad)}


class Operator(CellSection):
    """[operator]: the person who hangs the loads.

    driver: the name of a driver, e.g. "terminal"
    tolerance_N: by how much a hung load may differ in N before it is refused, over 0
    tolerance_share: the same as a share of the load, 0 or more
    options: $OPTIONS | {}
    """

    driver: str = Field("terminal", min_length=1)
    tolerance_N: Positive = 3.0
    tolerance_share: NonNegative = 0.05
    options: dict[str, Any] = Field(default_factory=dict)


class Acquire(CellSection):
    """[acquire]: settling, averaging, repeats and drift checks; durations in s.

    samples: tracker measurements averaged into one reading, 3 to 1000
    settle_s: the least time at rest before a reading in s, 0 or more
    settle_timeout_s: the longest wait for arm and readings to settle in s, over 0
    force_window_s: over how long the force sensor is averaged in s, over 0
    systematic_share: the share of the tracker's variance that averaging does not reduce, 0 to 1 |
        0.1
    drift_limit_sigma: a reference pose that moved more than so many sigma is reported, over 0
    """

    samples: Annotated[int, Strict(), Field(ge=3, le=1000)] = 5
    settle_s: NonNegative = 0.5
    settle_timeout_s: Positive = 60.0
    force_window_s: Positive = 1.0
    systematic_share: Annotated[float, Strict(), Field(ge=0, le=1)] = 0.0
    drift_limit_sigma: Positive = 6.0


class Coupling(CellSection):
    """One entry of `joint_coupling`: a joint that another one takes along.

    joint: the number of the joint that follows, from 1 | 3
    follows: the number of the joint that it follows, from 1 | 2
    factor: turns of the joint per turn of the one it follows
    mechanical: true where the motor of the one turns the other along; false where the controller
        only counts so
    """

    joint: int = Field(ge=1)
    follows: int = Field(ge=1)
    factor: Number = 1.0
    mechanical: bool = True

    @model_validator(mode="after")
    def _another(self) -> "Coupling":
        if self.joint == self.follows:
            raise ValueError(f"joint = {self.joint} follows itself; name two joints")
        return self


class Conventions(CellSection):
    """Keys of [robot] and of a DH file that say how the controller counts the joints.

    joint_sign: 1 or −1 per joint, e.g. [1, 1, 1, -1, 1, 1] | [1, 1, 1, -1, 1, 1]
    joint_offset_deg: an angle in degrees per joint, e.g. [0, -90, 0, 0, 0, 0] | [0.0, -90.0, 0.0,
        0.0, 0.0, 0.0]
    joint_coupling: a list such as [{ joint = 3, follows = 2, factor = 1.0 }] | [{ joint = 3,
        follows = 2, factor = 1.0 }]
    """

    joint_sign: tuple[int, ...] | None = None
    joint_offset_deg: tuple[Number, ...] | None = None
    joint_coupling: tuple[Coupling, ...] = ()

    @model_validator(mode="after")
    def _signs(self) -> "Conventions":
        if any(s not in (1, -1) for s in self.joint_sign or ()):
            raise ValueError(f"joint_sign = {list(self.joint_sign or ())}; valid: 1 and −1")
        return self


HANG_M = 0.3  # Default of hang_m of a load with a mass, m


class CellLoad(CellSection):
    """[[loads]]: a load at hand: a dead weight, a pull in base axes, or both.

    name: a name other than "none" | "5kg"
    mass_kg: a mass in kg, 0 or more | 5.0
    force_N: three finite numbers in N, base axes, e.g. [50.0, 0.0, 0.0] | [80.0, 0.0, 0.0]
    moment_Nm: three finite numbers in N·m, base axes | [0.0, 6.0, 6.0]
    hang_m: the length in m of what hangs below the load point, 0 or more; if absent 0.3 for a load
        with a mass, else 0 | 0.3
    radius_m: the radius in m of what hangs below the load point, over 0
    cable_m: the length in m of the cable of a pull, kept clear along force_N, 0 or more | 2.0
    """

    name: str = Field(min_length=1)
    mass_kg: Mass = 0.0
    force_N: Force = (0.0, 0.0, 0.0)
    moment_Nm: Moment = (0.0, 0.0, 0.0)
    hang_m: Length | None = None
    radius_m: Annotated[Positive, _within(50.0)] = 0.06
    cable_m: Length = 0.0

    @model_validator(mode="after")
    def _some_load(self) -> "CellLoad":
        if self.name == "none":
            raise ValueError('the name "none" is kept for the unloaded state; choose another')
        if self.mass_kg == 0.0 and not any((*self.force_N, *self.moment_Nm)):
            raise ValueError(
                f'load "{self.name}" is zero; give mass_kg, force_N or moment_Nm '
                "(the unloaded state is always there)"
            )
        if self.cable_m > 0.0 and not any(self.force_N):
            raise ValueError(f'load "{self.name}" has cable_m without force_N; it has no direction')
        return self

    @property
    def hanging_m(self) -> float:
        """Length of the load below the load point, m: `hang_m`, or its default."""
        if self.hang_m is not None:
            return self.hang_m
        return HANG_M if self.mass_kg > 0.0 else 0.0

    def wrench(self, gravity: Floats) -> Floats:
        """Return (6,) force and moment at the load point, base axes, N and N·m.

        force = mass * gravity + force_N; a dead weight hangs from the load point.
        """
        force = self.mass_kg * gravity + np.asarray(self.force_N)
        return np.concatenate([force, np.asarray(self.moment_Nm)])


class Limits(CellSection):
    """[limits]: what a plan keeps clear of, and the error that is allowed.

    joint_margin_rad: the distance kept from every joint limit in rad, 0 or more
    torque_share: the usable share of the joint torques, more than 0, at most 1
    workspace_min_m: $VECTOR_M: a corner that forearm, wrists, tool and what hangs stay above; if
        absent, the mounting plane z = 0 is the floor | [-1.2, -1.2, 0.05]
    workspace_max_m: $VECTOR_M: a corner that forearm, wrists, tool and what hangs stay below |
        [1.2, 1.2, 1.5]
    joint_speed_rad_s: a measured joint speed in rad/s that stops the arm, over 0
    accuracy_m: the largest 3-D position error that is allowed in m, over 0: calibrate, validate and
        report judge by it where --limit is not given | 0.0001
    """

    joint_margin_rad: NonNegative = 0.05
    torque_share: Annotated[float, Strict(), Field(gt=0, le=1)] = 0.9
    workspace_min_m: Place | None = None
    workspace_max_m: Place | None = None
    joint_speed_rad_s: Positive = 2.0
    accuracy_m: Accuracy | None = None

    @model_validator(mode="after")
    def _box(self) -> "Limits":
        _check_box(self, "workspace_min_m", "workspace_max_m")
        return self


class Point(CellSection):
    """[points.NAME]: a point from which distances are measured: a ball bar, a cable, a range.

    In the axes of the positions. reading = |target − position| + offset.

    position_m: $VECTOR_M: the point; leave it out to have it estimated | [1.2, 0.4, 0.0]
    offset_m: what the reading is beyond the distance, in m; see estimate_offset | 0.0
    estimate_offset: true or false: whether offset_m is rough, and estimated, as the length of a bar
        whose change alone is read | true
    std_m: the standard deviation of a reading in m, more than 0, where the table has no column
        cov_d_d | 1e-05
    """

    position_m: Place | None = None
    offset_m: Number = 0.0
    estimate_offset: bool = False
    std_m: Positive | None = None


class Gauge(CellSection):
    """[gauges.NAME]: a dial gauge, or a plane that is touched: one direction of the position.

    In the axes of the positions. reading = direction · (target − origin).

    direction: three numbers, the direction in which the reading grows; leave it out to have it
        estimated | [0.0, 0.0, 1.0]
    origin_m: $VECTOR_M: where the reading is 0; leave it out to have it estimated | [0.6, 0.2, 0.1]
    std_m: the standard deviation of a reading in m, more than 0, where the table has no column
        cov_g_g | 1e-06
    """

    direction: Vector3 | None = None
    origin_m: Place | None = None
    std_m: Positive | None = None

    @model_validator(mode="after")
    def _sound(self) -> "Gauge":
        if self.direction is not None and not np.linalg.norm(self.direction) > 1e-6:
            raise ValueError(f"direction = {list(self.direction)} has no length")
        if self.origin_m is not None and self.direction is None:
            raise ValueError("origin_m without direction; give both, the direction, or neither")
        return self


_Name = Annotated[str, Field(min_length=1)]
_Joints = Annotated[tuple[Number, ...], Field(min_length=1)]
_BOX = ("center_m", "size_m")
_CYLINDER = ("bottom_m", "radius_m", "height_m")
LOADED = ("joint_compliance",)  # Effects under load; the default of `[planning] model`
GEOMETRY = ("encoder_offset",)  # Effects that a first plan of absolute readings is for, too


class Planning(CellSection):
    """[planning]: what the measurements are for, and what is known of them.

    model: the effects that are assumed, a list of names, e.g. ["joint_compliance"], with options as
        in ["joint_compliance(joints=2-6)"] | ["joint_compliance", "creep(joints=each)"]
    readings: "deflection" or "absolute": what will be fitted
    against: "catalogue", or a list of effects (may be empty), which the plan could still find
        although the model lacks them | ["creep", "hysteresis"]
    criterion: "D", "A", "E", "K", "I" or "separate"; if absent "I" for absolute readings, "D" for
        deflections | "I"
    work_q_rad: a list of joint vectors in rad where the robot will work | [[0.0, -1.57, 1.57, 0.0,
        1.57, 0.0]]
    work_min_m: $VECTOR_M: the lowest corner of the target's work, base axes | [0.3, -0.4, 0.2]
    work_max_m: $VECTOR_M: the highest corner of the target's work, base axes | [0.9, 0.4, 0.8]
    work_load: the name of one of [[loads]], or "none", under which it will work | "5kg"
    reading_s: how long a reading takes in s, over 0; from [acquire] if absent | 8.0
    load_change_s: how long a person needs for a change of the load in s, over 0
    candidates: how many poses to choose from, a whole number, 2 to 1000000
    singularity: the least ratio of the smallest to the largest singular value of the flange's
        Jacobian, lengths in units of the reach, 0 or more, below 1
    """

    model: tuple[_Name, ...] = Field(LOADED, min_length=1)
    readings: Literal["deflection", "absolute"] = "deflection"
    against: Literal["catalogue"] | tuple[_Name, ...] = "catalogue"
    criterion: Annotated[
        Literal["D", "A", "E", "K", "I", "separate"] | None,
        BeforeValidator(lambda name: "I" if name == "test" else name),  # its name before 1.0
    ] = None
    work_q_rad: tuple[_Joints, ...] = ()
    work_min_m: Place | None = None
    work_max_m: Place | None = None
    work_load: _Name = "none"
    reading_s: Positive | None = None
    load_change_s: Positive = 60.0
    candidates: Annotated[Whole, Field(ge=2, le=1_000_000)] = 2000
    singularity: Annotated[float, Strict(), Field(ge=0, lt=1)] = 0.05

    @model_validator(mode="after")
    def _work(self) -> "Planning":
        if (self.work_min_m is None) != (self.work_max_m is None):
            raise ValueError("work_min_m or work_max_m alone; a box needs both")
        if self.work_min_m is not None and self.work_q_rad:
            raise ValueError("work_q_rad together with work_min_m; give one of them")
        _check_box(self, "work_min_m", "work_max_m")
        if len({len(q) for q in self.work_q_rad}) > 1:
            raise ValueError("work_q_rad has joint vectors of different lengths")
        return self


class Obstacle(CellSection):
    """[[obstacles]]: a box along the base axes, or a cylinder that stands along base z.

    name: a name, e.g. "tripod" | "tripod"
    center_m: $VECTOR_M: the box's centre, base axes | [0.0, 0.9, 0.4]
    size_m: three lengths in m, over 0: the box along x, y and z of the base | [1.2, 0.6, 0.8]
    bottom_m: $VECTOR_M: the centre of the cylinder's lower face, base axes | [0.9, -0.9, 0.0]
    radius_m: the cylinder's radius in m, over 0 | 0.3
    height_m: the cylinder's height in m, over 0 | 1.2
    """

    name: str = Field(min_length=1)
    center_m: Place | None = None
    size_m: tuple[Positive, Positive, Positive] | None = None
    bottom_m: Place | None = None
    radius_m: Positive | None = None
    height_m: Positive | None = None

    @model_validator(mode="after")
    def _one_shape(self) -> "Obstacle":
        box = [key for key in _BOX if getattr(self, key) is not None]
        cylinder = [key for key in _CYLINDER if getattr(self, key) is not None]
        complete = (len(box), len(cylinder)) in ((len(_BOX), 0), (0, len(_CYLINDER)))
        if not complete:
            shapes = ", ".join((*box, *cylinder)) or "no shape"
            raise ValueError(
                f'obstacle "{self.name}" has {shapes}; give {" and ".join(_BOX)} for a box, or '
                f"{', '.join(_CYLINDER[:-1])} and {_CYLINDER[-1]} for an upright cylinder"
            )
        lengths = (*(self.size_m or ()), self.radius_m or 0.0, self.height_m or 0.0)
        if max(lengths) > 100.0:
            raise ValueError(f'obstacle "{self.name}" measures {max(lengths):g} m; is it in m?')
        return self


class Sight(CellSection):
    """[sight]: what the tracker sees of the target.

    tracker_m: $VECTOR_M: the tracker's approximate position in base axes | [3.0, 0.5, 0.9]
    target_normal: three numbers, not all 0: where the reflector looks, flange axes | [0.0, 0.0,
        1.0]
    incidence_max_rad: the largest angle between the reflector's normal and the beam in rad, over 0,
        at most 1.5707
    clearance_m: the distance between the beam and the arm in m, 0 or more
    """

    tracker_m: Place | None = None
    target_normal: Vector3 | None = None
    incidence_max_rad: Annotated[float, Strict(), Field(gt=0, le=np.pi / 2)] = 0.5
    clearance_m: Annotated[NonNegative, _within(1.0)] = 0.03

    @model_validator(mode="after")
    def _plausible(self) -> "Sight":
        if self.target_normal is not None and not any(self.target_normal):
            raise ValueError("target_normal = [0.0, 0.0, 0.0] points nowhere; e.g. [0, 0, 1]")
        return self
