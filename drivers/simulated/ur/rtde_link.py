"""One RTDE client: negotiation, inputs, and the stream of data."""

import asyncio
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.simulated.ur.frames import (
    HEADER,
    IN_USE,
    INPUTS,
    NOT_FOUND,
    VERSION,
    Recipe,
    frame,
    outputs_since,
)
from drivers.simulated.ur.sensing import Sensors
from drivers.simulated.ur.state import ArmState

FREQUENCY = 500.0
"""Of the controller, Hz."""
_DIGITAL_OUTPUTS = {"standard": (0, 0xFF), "configurable": (8, 0xFF), "tool": (16, 3)}
"""First bit in `actual_digital_output_bits` and mask of each group; UR, "RTDE guide"."""
_INT, _DOUBLE = "input_int_register_", "input_double_register_"
_BACKLOG = 1 << 20  # bytes that a client may leave unread before it is cut off


@dataclass(slots=True, eq=False)
class Faults:
    """Switches of what goes wrong with the links."""

    rtde_mute: bool = False
    rtde_stall: bool = False
    dashboard_mute: bool = False


@dataclass(slots=True, eq=False)
class RtdeLinks:
    """All RTDE clients of one controller.

    Attributes:
        arm: the shared state.
        sensors: what is told.
        faults: what goes wrong.
        taken: called after each input package.
        links: the open connections.
        owners: which connection may write an input variable.
    """

    arm: ArmState
    sensors: Sensors
    faults: Faults
    taken: Callable[[], None]
    links: set["RtdeLink"] = field(default_factory=set)
    owners: dict[str, "RtdeLink"] = field(default_factory=dict)

    def due(self, now: float) -> float:
        """Return when the next package is due, real time in s; infinite where none is."""
        return min((link.due for link in self.links if link.started), default=float("inf"))

    def hears(self, register: int) -> bool:
        """Return whether a client that writes an integer register has an open link."""
        return not self.faults.rtde_mute and f"{_INT}{register}" in self.owners

    def send(self, now: float) -> None:
        """Send what is due."""
        ready = [link for link in self.links if link.started and link.due <= now]
        if ready:
            self.sensors.refresh()
        for link in ready:
            link.send(now)


class RtdeLink:
    """One connection."""

    def __init__(
        self, links: RtdeLinks, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Take over an accepted connection."""
        self._links, self._reader, self.writer = links, reader, writer
        self._recipes: dict[int, Recipe] = {}
        self._out: Recipe | None = None
        self._period = 1.0 / FREQUENCY
        self.started = False
        self.due = float("inf")

    async def run(self) -> None:
        """Serve the client until it goes."""
        connection = self.writer.get_extra_info("socket")
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        links = self._links
        links.links.add(self)
        links.arm.note("rtde client came")
        try:
            while True:
                size, kind = HEADER.unpack(await self._reader.readexactly(HEADER.size))
                body = await self._reader.readexactly(max(0, size - HEADER.size))
                if not links.faults.rtde_mute:
                    self._take(chr(kind), body)
        except (asyncio.IncompleteReadError, OSError):
            pass
        except (struct.error, ValueError, IndexError) as error:
            links.arm.note(f"rtde client sent nonsense: {error}")
        finally:
            self.started = False
            links.links.discard(self)
            for name in [name for name, owner in links.owners.items() if owner is self]:
                del links.owners[name]
            links.arm.note("rtde client went")
            self.writer.close()

    def send(self, now: float) -> None:
        """Send one package and say when the next is due."""
        self.due = max(self.due + self._period, now - 4 * self._period)
        if not self._links.faults.rtde_stall and not self._links.faults.rtde_mute:
            self._write(self._data())

    def half(self) -> None:
        """Send the first half of a package, and nothing more."""
        data = self._data()
        self._write(data[: len(data) // 2])
        self.started = False

    def _data(self) -> bytes:
        if self._out is None:
            return frame("U", b"\0" * 20)
        sensors = self._links.sensors
        numbers = [x for name in self._out.names for x in sensors.packed(name)]
        return frame("U", self._out.pack(numbers))

    def _write(self, data: bytes) -> None:
        if self.writer.is_closing():
            return
        self.writer.write(data)
        if self.writer.transport.get_write_buffer_size() > _BACKLOG:
            self._links.arm.note("rtde client does not read: cut off")
            self.writer.transport.abort()

    def _take(self, kind: str, body: bytes) -> None:
        match kind:
            case "V":
                (version,) = struct.unpack(">H", body)
                self._write(frame("V", bytes([version == VERSION])))
            case "v":
                self._write(frame("v", struct.pack(">4I", *self._links.arm.version)))
            case "O":
                self._write(frame("O", self._outputs(body)))
            case "I":
                self._write(frame("I", self._inputs(body)))
            case "S":
                self.started = self._out is not None
                self.due = time.monotonic()
                self._write(frame("S", b"\x01"))
            case "P":
                self.started = False
                self._write(frame("P", b"\x01"))
            case "U":
                self._input(body)
            case _:
                self._links.arm.note(f"rtde package {kind!r} ignored")

    def _outputs(self, body: bytes) -> bytes:
        (frequency,) = struct.unpack_from(">d", body)
        if not 1.0 <= frequency <= FREQUENCY:
            raise ValueError(f"output frequency {frequency} Hz; valid: 1 to 500")
        self._period = 1.0 / frequency
        names = [name for name in body[8:].decode("ascii").split(",") if name]
        table = outputs_since(self._links.arm.version)
        self._out = Recipe.of(1, (name for name in names if name in table), table)
        kinds = ",".join(table.get(name, NOT_FOUND) for name in names)
        return bytes([self._out.number]) + kinds.encode()

    def _inputs(self, body: bytes) -> bytes:
        names = [name for name in body.decode("ascii").split(",") if name]
        owners = self._links.owners
        kinds = [
            NOT_FOUND
            if name not in INPUTS
            else IN_USE
            if owners.get(name, self) is not self
            else INPUTS[name]
            for name in names
        ]
        number = 0
        if NOT_FOUND not in kinds and IN_USE not in kinds:
            number = len(self._recipes) + 1
            self._recipes[number] = Recipe.of(number, names, INPUTS)
            owners.update(dict.fromkeys(names, self))
        return bytes([number]) + ",".join(kinds).encode()

    def _input(self, body: bytes) -> None:
        arm, now = self._links.arm, time.monotonic_ns()
        recipe = self._recipes.get(body[0])
        if recipe is None:
            raise ValueError(f"input recipe {body[0]} was not agreed on")
        arm.input_ns = now
        size = recipe.layout.size
        if len(body) > size:  # as ur_rtde's forward kinematics of given joints does
            arm.note(f"input recipe {body[0]}: {len(body)} bytes, only {size} agreed on and read")
        values = dict(recipe.unpack(body[:size]))
        for name, value in values.items():
            if name.startswith(_INT):
                k = int(name.removeprefix(_INT))
                arm.registers.in_int[k] = int(value)
                arm.registers.written_ns[k] = now
            elif name.startswith(_DOUBLE):
                arm.registers.in_double[int(name.removeprefix(_DOUBLE))] = value
        if values.get("speed_slider_mask") and "speed_slider_fraction" in values:
            arm.slider = min(1.0, max(0.0, values["speed_slider_fraction"]))
        for group, (first, bits) in _DIGITAL_OUTPUTS.items():
            if f"{group}_digital_output" in values:
                given = int(values[f"{group}_digital_output"]) & bits
                mask = int(values.get(f"{group}_digital_output_mask", 0)) & bits
                kept = arm.digital_outputs & ~(mask << first)
                arm.digital_outputs = kept | (given & mask) << first
        self._links.taken()
