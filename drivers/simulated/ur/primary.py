"""The primary port: the robot's state in packages, and programs.

A package is its size (i32), its type (u8) and a body; the body of a robot state is a row of parts,
each with size (i32), type (u8) and body. All big-endian. Part 5, of the kinematics, and part 6, of
the configuration, come with the first state after a client has connected, and when they change.
Source: Universal Robots, "Remote Control via TCP/IP" (client interfaces), and the parsers of the
Universal Robots Client Library for the layouts.
"""

import asyncio
import contextlib
import struct
import time

from hilcal.drivers.simulated.ur.controller import Controller
from hilcal.drivers.simulated.ur.state import Runtime
from hilcal.types import Floats

STATE, MESSAGE = 16, 20
MODE, KINEMATICS = 0, 5
LINEARISED, NOT_INITIALISED = 2, 0
_VERSION_MESSAGE = 3
_PERIOD = 0.1  # s between states


class PrimaryPort:
    """Sends states to every client, and takes programs from them."""

    def __init__(self, controller: Controller, rows: Floats, status: int) -> None:
        """Serve a controller whose kinematics are `rows` (4, 6): theta, a, d, alpha, rad and m.

        `status` is that of its calibration, `LINEARISED` or `NOT_INITIALISED`.
        """
        self._controller, self._rows, self._status = controller, rows, status

    async def run(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a client until it goes."""
        telling = asyncio.create_task(self._tell(writer))
        try:
            await self._controller.take_programs(reader)
        finally:
            telling.cancel()
            writer.close()

    async def _tell(self, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            writer.write(self._version())
            parts = self._kinematics()
            while not writer.is_closing():
                writer.write(_package(STATE, self._mode() + parts))
                await writer.drain()
                parts = b""
                await asyncio.sleep(_PERIOD)

    def _version(self) -> bytes:
        major, minor, bugfix, build = self._controller.arm.version
        name = b"URControl"
        body = struct.pack(">QbBB", time.monotonic_ns() // 1000, -2, _VERSION_MESSAGE, len(name))
        body += name + struct.pack(">BBii", major, minor, bugfix, build) + b"01-01-2025, 00:00:00"
        return _package(MESSAGE, body)

    def _mode(self) -> bytes:
        arm = self._controller.arm
        program = arm.runtime in (Runtime.PLAYING, Runtime.PAUSED, Runtime.PAUSING)
        flags = (
            *(True, True, arm.robot_mode.value >= 4, arm.safety_bits & 0b11000000 > 0),
            *(arm.safety_bits & 4 > 0, program, arm.runtime is Runtime.PAUSED),
        )
        body = struct.pack(
            ">Q7?BBdddB", time.monotonic_ns() // 1000, *flags, arm.robot_mode.value, 0,
            arm.slider, arm.scaling, 1.0, 0,
        )  # fmt: skip
        return _package(MODE, body)

    def _kinematics(self) -> bytes:
        valid = 0 if self._status == LINEARISED else 0xFFFFFFFF
        body = struct.pack(">6I", *([valid] * 6))
        body += struct.pack(">24d", *self._rows.ravel()) + struct.pack(">I", self._status)
        return _package(KINEMATICS, body)


def _package(kind: int, body: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(body), kind) + body
