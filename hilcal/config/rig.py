"""Sections of CELL.toml that tell how a campaign is measured: devices, motion, acquisition."""

from typing import Annotated, Any, Literal

from pydantic import Field, Strict, model_validator

from hilcal.toml import NonNegative, Positive, Section, Vector3

Whole = Annotated[int, Strict(), Field(ge=1)]
OPTIONS = "a table of the driver's own keys"
VECTOR_M = "three finite numbers in m, e.g. [0.0, 0.0, 0.1]"
ROTVEC = "a rotation vector: three finite numbers in rad, e.g. [0.0, 0.0, 1.57]"
HOST = 'the address in the network, e.g. "192.168.0.1"; another port as "192.168.0.1:7000"'
"""Of an instrument that is connected by Ethernet."""
PORT = 'the serial port, e.g. "/dev/serial/by-id/usb-FTDI_..."'


class Motion(Section):
    """[motion]: how the arm moves from pose to pose; calibration is slow on purpose."""

    speed_rad_s: Positive = Field(0.5, description="the leading joint's speed in rad/s, over 0")
    acceleration_rad_s2: Positive = Field(
        0.5, description="the leading joint's acceleration in rad/s², over 0"
    )
    arrival_rad: Positive = Field(
        5e-4, description="the largest joint error at arrival in rad, over 0, e.g. 5e-4"
    )

    @model_validator(mode="after")
    def _slow(self) -> "Motion":
        if self.speed_rad_s > 2.0:
            raise ValueError(f"speed_rad_s = {self.speed_rad_s}; a calibration moves at 2 or less")
        if self.acceleration_rad_s2 > 10.0:
            raise ValueError(f"acceleration_rad_s2 = {self.acceleration_rad_s2}; valid: up to 10")
        return self


class ForceSensor(Section):
    """[force_sensor]: the wrench sensor between flange and tool."""

    driver: str = Field(
        min_length=1,
        description='the name of a driver, e.g. "ft300", "bota" or "netft"',
        examples=["ft300"],
    )
    port: str | None = Field(
        None, min_length=1, description=PORT, examples=["/dev/serial/by-id/usb-Silicon_Labs_..."]
    )
    host: str | None = Field(None, min_length=1, description=HOST, examples=["192.168.1.1"])
    baud: Whole | None = Field(
        None, description="the line's rate in Bd; the driver's own if absent", examples=[19200]
    )
    origin_m: Vector3 = Field(
        (0.0, 0.0, 0.0),
        description=VECTOR_M + ": the sensor's origin, flange axes",
        examples=[[0.0, 0.0, 0.02]],
    )
    rotvec_rad: Vector3 = Field(
        (0.0, 0.0, 0.0),
        description=ROTVEC + ": the sensor's axes in flange axes",
        examples=[[0.0, 0.0, 1.57]],
    )
    max_force_N: Positive = Field(250.0, description="a force in N that stops the arm, over 0")
    max_moment_Nm: Positive = Field(25.0, description="a moment in N·m that stops the arm, over 0")
    use: Literal["pulls", "all", "verify"] = Field(
        "pulls",
        description='"pulls" (measured wrench for loads with force_N or moment_Nm, mass times '
        'gravity for dead weights), "all" (always the measured one) or "verify" (never)',
        examples=["all"],
    )
    options: dict[str, Any] = Field(default_factory=dict, description=OPTIONS, examples=[{}])

    @model_validator(mode="after")
    def _connected(self) -> "ForceSensor":
        if self.port is None and self.host is None:
            raise ValueError(f'lacks "port": it must be {PORT}; or "host": {HOST}')
        return self


class Operator(Section):
    """[operator]: the person who hangs the loads."""

    driver: str = Field(
        "terminal", min_length=1, description='the name of a driver, e.g. "terminal"'
    )
    tolerance_N: Positive = Field(
        3.0, description="by how much a hung load may differ in N before it is refused, over 0"
    )
    tolerance_share: NonNegative = Field(
        0.05, description="the same as a share of the load, 0 or more"
    )
    options: dict[str, Any] = Field(default_factory=dict, description=OPTIONS, examples=[{}])


class Acquire(Section):
    """[acquire]: settling, averaging, repeats and drift checks; durations in s."""

    samples: Annotated[int, Strict(), Field(ge=3, le=1000)] = Field(
        5, description="tracker measurements averaged into one reading, 3 to 1000"
    )
    settle_s: NonNegative = Field(
        0.5, description="the least time at rest before a reading in s, 0 or more"
    )
    settle_timeout_s: Positive = Field(
        60.0, description="the longest wait for arm and readings to settle in s, over 0"
    )
    force_window_s: Positive = Field(
        1.0, description="over how long the force sensor is averaged in s, over 0"
    )
    systematic_share: Annotated[float, Strict(), Field(ge=0, le=1)] = Field(
        0.0,
        description="the share of the tracker's variance that averaging does not reduce, 0 to 1",
        examples=[0.1],
    )
    drift_limit_sigma: Positive = Field(
        6.0, description="a reference pose that moved more than so many sigma is reported, over 0"
    )
