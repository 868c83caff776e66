"""RTDE v2: frames and recipes, the output variables, and the connections of clients.

Source: Universal Robots, article "Real-Time Data Exchange (RTDE) guide".
"""

import asyncio
import re
import socket
import struct
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from hilcal.drivers.simulated import ur_state as ur
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.robot.se3 import of_six, six
from hilcal.types import Floats

VERSION = 2
NOT_FOUND = "NOT_FOUND"
IN_USE = "IN_USE"
HEADER = struct.Struct(">HB")  # size of the frame with header, bytes; type

FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}

_OUTPUTS = {
    "DOUBLE": (
        "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum "
        "joint_position_deviation_ratio "
        "actual_main_voltage actual_robot_voltage actual_robot_current payload "
        "standard_analog_input0 standard_analog_input1 standard_analog_output0 "
        "standard_analog_output1"
    ),
    "VECTOR6D": (
        "target_q target_qd target_qdd target_current target_moment actual_q actual_qd "
        "actual_current joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force "
        "target_TCP_pose target_TCP_speed joint_temperatures actual_joint_voltage "
        "ft_raw_wrench tcp_offset payload_inertia actual_current_as_torque"
    ),
    "VECTOR3D": "actual_tool_accelerometer payload_cog",
    "VECTOR6INT32": "joint_mode",
    "INT32": "robot_mode safety_mode safety_status",
    "UINT32": (
        "runtime_state robot_status_bits safety_status_bits "
        "output_bit_registers0_to_31 output_bit_registers32_to_63"
    ),
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
}
_INPUTS = {
    "UINT32": ("speed_slider_mask input_bit_registers0_to_31 input_bit_registers32_to_63 "),
    "DOUBLE": "speed_slider_fraction standard_analog_output_0 standard_analog_output_1",
    "UINT8": (
        "standard_digital_output_mask configurable_digital_output_mask "
        "standard_digital_output configurable_digital_output tool_digital_output_mask "
        "tool_digital_output standard_analog_output_mask standard_analog_output_type"
    ),
    "VECTOR6D": "external_force_torque",
}


def _table(groups: dict[str, str], side: str) -> dict[str, str]:
    table = {name: kind for kind, names in groups.items() for name in names.split()}
    for k in range(ur.REGISTERS):
        table[f"{side}_int_register_{k}"] = "INT32"
        table[f"{side}_double_register_{k}"] = "DOUBLE"
    return table


OUTPUTS = _table(_OUTPUTS, "output")
INPUTS = _table(_INPUTS, "input")


def frame(kind: str, payload: bytes = b"") -> bytes:
    """Return a frame: size (u16, with the header), type (u8), payload; big-endian."""
    return HEADER.pack(HEADER.size + len(payload), ord(kind)) + payload


def outputs_since(version: tuple[int, int, int, int]) -> dict[str, str]:
    """Return the types, by name, of the outputs that a controller of this version has."""
    table = dict(OUTPUTS)
    if version < (5, 9, 0, 0):
        del table["ft_raw_wrench"]
    if version < (5, 5, 1, 0):
        del table["payload_cog"]
    if version < (5, 23, 0, 0) or (10, 0, 0, 0) <= version < (10, 11, 0, 0):
        del table["actual_current_as_torque"]
    return table


@dataclass(frozen=True, slots=True)
class Recipe:
    """The variables of a data frame."""

    number: int  # id on the connection, 1 or more
    names: tuple[str, ...]
    kinds: tuple[str, ...]
    layout: struct.Struct

    @classmethod
    def of(cls, number: int, names: Iterable[str], table: dict[str, str]) -> "Recipe":
        """Return the recipe of variables, all of which are in `table`."""
        names = tuple(names)
        kinds = tuple(table[name] for name in names)
        return cls(number, names, kinds, struct.Struct(">B" + "".join(FORMATS[k] for k in kinds)))

    def unpack(self, payload: bytes) -> Iterator[tuple[str, float]]:
        """Yield (name, first number) of each variable in the payload of a data frame."""
        numbers, at = self.layout.unpack(payload), 1
        for name, kind in zip(self.names, self.kinds, strict=True):
            yield name, numbers[at]
            at += int(FORMATS[kind][:-1] or 1)


Numbers = tuple[float, ...]

_ENCODER_STD = 3e-6  # rad, while the arm moves
_SPEED_STD = 2e-4  # rad/s
_CURRENT_STD = 0.02  # A
# Torque per motor current at the joint, N·m/A: plausible for gear ratios of about 100.
_TORQUE_PER_AMPERE = np.array([13.0, 13.0, 11.0, 9.0, 9.0, 9.0])
_DEVIATION_STOP = 0.1  # rad, deviation at which a controller stops the arm (C153); a guess
_FRICTION = np.array([6.0, 6.0, 4.0, 1.2, 1.2, 1.2])  # N·m, friction of the gears at rest; a guess
_TEMPERATURES = np.array([29.0, 30.0, 30.5, 33.0, 34.0, 33.5])  # °C; a guess
_FORCE_OFFSET = np.array([3.1, -2.4, 4.2, 0.12, -0.21, 0.08])  # N and N·m, flange axes
_FORCE_STD = np.array([0.4, 0.4, 0.5, 0.02, 0.02, 0.01])
_REGISTER = re.compile(r"output_(int|double)_register_(\d+)")
_POWERED, _UNPOWERED = (253.0,) * 6, (239.0,) * 6  # joint modes "running" and "power off"
_FIXED = {
    "actual_joint_voltage": (47.5,) * 6,
    "actual_main_voltage": (48.0,),
    "actual_robot_voltage": (48.0,),
    "actual_robot_current": (0.5,),
}


class Sensors:
    """Values of the output variables at one instant; `refresh` starts the next.

    Without a truth on the blackboard, the arm is rigid and carries the payload that was set.
    """

    def __init__(self, arm: ur.ArmState, board: Blackboard, rng: np.random.Generator) -> None:
        self._arm, self._board, self._rng = arm, board, rng
        self._readers = self._table()
        self.refresh()

    def refresh(self) -> None:
        """Start a new instant."""
        self._now = self._arm.clock.now
        self._cache: dict[str, Numbers] = {}
        self._truth = self._board.read("truth")

    def value(self, name: str) -> Numbers:
        """Return the numbers of an output variable at this instant."""
        if name not in self._cache:
            self._cache[name] = tuple(np.asarray(self._read(name), dtype=float).tolist())
        return self._cache[name]

    def packed(self, name: str) -> tuple[float, ...]:
        """Return the numbers with the types for `struct`."""
        values = self.value(name)
        return values if FORMATS[OUTPUTS[name]].endswith("d") else tuple(map(int, values))

    def _read(self, name: str) -> Floats | Numbers:
        if name in self._readers:
            return self._readers[name]()
        register = _REGISTER.fullmatch(name)
        if register:
            values = self._arm.out_int if register[1] == "int" else self._arm.out_double
            return (values[int(register[2])],)
        return _FIXED.get(name) or (0.0,) * int(FORMATS[OUTPUTS[name]][:-1] or 1)

    def _array(self, name: str) -> Floats:
        return np.array(self.value(name))

    def _table(self) -> dict[str, Callable[[], Floats | Numbers]]:
        arm, motion = self._arm, self._arm.trajectory
        return {
            "timestamp": lambda: (self._now,),
            "actual_q": self._q,
            "target_q": lambda: motion.q,
            "actual_qd": lambda: motion.qd + motion.moving * self._noise(_SPEED_STD),
            "target_qd": lambda: motion.qd,
            "target_moment": self._torque,
            "target_current": self._target_current,
            "actual_current": lambda: self._array("target_current") + self._noise(_CURRENT_STD),
            "actual_current_as_torque": self._measured_torque,
            "joint_control_output": self._target_current,
            "joint_temperatures": lambda: (
                self._truth["joint_temperature"] if self._has_truth else _TEMPERATURES
            ),
            "joint_mode": lambda: _POWERED if self._powered else _UNPOWERED,
            "actual_TCP_pose": lambda: self._tool_pose(self._array("actual_q")),
            "target_TCP_pose": lambda: self._tool_pose(motion.q),
            "actual_TCP_speed": lambda: self._tool_speed(self._array("actual_qd")),
            "target_TCP_speed": lambda: self._tool_speed(motion.qd),
            "actual_TCP_force": self._tool_force,
            "ft_raw_wrench": self._wrench,
            "tcp_offset": lambda: arm.tcp,
            "payload": lambda: (arm.payload,),
            "payload_cog": lambda: arm.payload_com,
            "robot_mode": lambda: (arm.robot_mode,),
            "safety_mode": lambda: (arm.safety_mode,),
            "safety_status": lambda: (arm.safety_mode,),
            "safety_status_bits": lambda: (arm.safety_bits,),
            "robot_status_bits": lambda: (
                (arm.robot_mode is not ur.RobotMode.POWER_OFF)
                | (arm.runtime is ur.Runtime.PLAYING) << 1,
            ),
            "runtime_state": lambda: (arm.runtime,),
            "joint_position_deviation_ratio": self._deviation,
            "actual_digital_output_bits": lambda: (arm.digital_outputs,),
            "speed_scaling": lambda: (arm.scaling,),
            "target_speed_fraction": lambda: (arm.slider,),
        }

    @property
    def _powered(self) -> bool:
        return self._arm.robot_mode is ur.RobotMode.RUNNING

    @property
    def _has_truth(self) -> bool:
        return bool(self._truth["flange"][3, 3] == 1.0)

    def _q(self) -> Floats:
        motion = self._arm.trajectory
        if self._arm.frozen_q is not None:
            return self._arm.frozen_q
        rests = int(self._truth["arrivals"]) == motion.arrivals and not motion.moving
        if self._has_truth and rests:
            return np.asarray(self._truth["encoder"])
        return motion.q + self._noise(_ENCODER_STD)

    def _deviation(self) -> Numbers:
        """Largest deviation of a joint from its command, as a share of the limit."""
        deviation = np.abs(self._array("actual_q") - self._array("target_q"))
        return (float(deviation.max() / _DEVIATION_STOP),)

    def _torque(self) -> Floats:
        if self._has_truth:
            return np.asarray(self._truth["drive_torque"])
        arm = self._arm
        return arm.kinematics.weight_torque(arm.trajectory.q, arm.payload, arm.payload_com)

    def _target_current(self) -> Floats:
        return np.asarray(self._powered * self._array("target_moment") / _TORQUE_PER_AMPERE)

    def _measured_torque(self) -> Floats:
        """Torque against load, weight and friction, whose sign is that of the last motion."""
        torque = _FRICTION[: len(self._torque())] * self._arm.trajectory.side - self._torque()
        return np.asarray(torque + _TORQUE_PER_AMPERE * self._noise(_CURRENT_STD))

    def _tool_pose(self, q: Floats) -> Numbers:
        return tuple(six(self._arm.kinematics.flange(q) @ of_six(self._arm.tcp.tolist())))

    def _tool_speed(self, qd: Floats) -> Floats:
        if not qd.any():
            return qd
        q = self._arm.trajectory.q
        flange = self._arm.kinematics.flange(q)
        point = flange[:3, 3] + flange[:3, :3] @ self._arm.tcp[:3]
        return np.asarray(self._arm.kinematics.jacobian(q, point) @ qd)

    def _weight(self) -> Floats:
        """Wrench of the payload as set, at the flange, flange axes."""
        arm = self._arm
        force = arm.payload * (self._arm.kinematics.flange(arm.trajectory.q)[:3, :3].T @ ur.GRAVITY)
        return np.concatenate([force, np.cross(arm.payload_com, force)])

    def _wrench(self) -> Floats:
        """Reading of the sensor in the flange, flange axes, with offset and noise."""
        wrench = self._truth["sensor_wrench"] if self._has_truth else self._weight()
        return np.asarray(wrench + _FORCE_OFFSET + _FORCE_STD * self._rng.standard_normal(6))

    def _tool_force(self) -> Floats:
        """Reading minus the payload's wrench, at the tool point, base axes."""
        excess = self._array("ft_raw_wrench") - self._weight()
        turn = self._arm.kinematics.flange(self._arm.trajectory.q)[:3, :3]
        moment = excess[3:] - np.cross(self._arm.tcp[:3], excess[:3])
        return np.concatenate([turn @ excess[:3], turn @ moment])

    def _noise(self, std: float) -> Floats:
        return np.asarray(std * self._rng.standard_normal(6))


FREQUENCY = 500.0  # of the controller, Hz
_DIGITAL_OUTPUTS = {"standard": (0, 0xFF), "configurable": (8, 0xFF), "tool": (16, 3)}
"""By group: first bit in `actual_digital_output_bits`, and mask; UR, "RTDE guide"."""
_INT, _DOUBLE = "input_int_register_", "input_double_register_"
_BACKLOG = 1 << 20  # bytes unread by a client, above which it is disconnected


@dataclass(slots=True, eq=False)
class RtdeLinks:
    """All RTDE clients of one controller."""

    arm: ur.ArmState
    sensors: Sensors
    after_input: Callable[[], None]  # called after each input package
    links: set["RtdeLink"] = field(default_factory=set)
    owners: dict[str, "RtdeLink"] = field(default_factory=dict)
    """By input variable: the connection that may write it."""

    def due(self) -> float:
        """Return when the next package is due, `time.monotonic`, s; infinite if none is."""
        return min((link.due for link in self.links if link.started), default=float("inf"))

    def has_writer(self, register: int) -> bool:
        """Return whether a client that writes an integer register is connected."""
        return not self.arm.rtde_mute and f"{_INT}{register}" in self.owners

    def send(self, now: float) -> None:
        """Send the packages that are due."""
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
        self._links, self._reader, self.writer = links, reader, writer
        self._recipes: dict[int, Recipe] = {}
        self._out: Recipe | None = None
        self._period = 1.0 / FREQUENCY
        self.started, self.due = False, float("inf")

    async def run(self) -> None:
        """Serve the client until it disconnects."""
        connection = self.writer.get_extra_info("socket")
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        links = self._links
        links.links.add(self)
        links.arm.note("rtde client connected")
        try:
            while True:
                size, kind = HEADER.unpack(await self._reader.readexactly(HEADER.size))
                body = await self._reader.readexactly(max(0, size - HEADER.size))
                if not links.arm.rtde_mute:
                    self._handle(chr(kind), body)
        except (asyncio.IncompleteReadError, OSError):
            pass
        except (struct.error, ValueError, IndexError) as error:
            links.arm.note(f"rtde client sent invalid data: {error}")
        finally:
            self.started = False
            links.links.discard(self)
            for name in [name for name, owner in links.owners.items() if owner is self]:
                del links.owners[name]
            links.arm.note("rtde client disconnected")
            self.writer.close()

    def send(self, now: float) -> None:
        """Send a package and set when the next is due."""
        self.due = max(self.due + self._period, now - 4 * self._period)
        if not self._links.arm.rtde_stall and not self._links.arm.rtde_mute:
            self._write(self._data())

    def half(self) -> None:
        """Send the first half of a package, then nothing more."""
        data = self._data()
        self._write(data[: len(data) // 2])
        self.started = False

    def _data(self) -> bytes:
        if self._out is None:
            return frame("U", b"\0" * 20)
        numbers = [x for name in self._out.names for x in self._links.sensors.packed(name)]
        return frame("U", self._out.layout.pack(self._out.number, *numbers))

    def _write(self, data: bytes) -> None:
        if self.writer.is_closing():
            return
        self.writer.write(data)
        if self.writer.transport.get_write_buffer_size() > _BACKLOG:
            self._links.arm.note("rtde client does not read: cut off")
            self.writer.transport.abort()

    def _handle(self, kind: str, body: bytes) -> None:
        arm = self._links.arm
        if kind == "U":
            self._input(body)
        elif kind == "S":
            self.started, self.due = self._out is not None, time.monotonic()
            self._write(frame("S", b"\x01"))
        elif kind == "P":
            self.started = False
            self._write(frame("P", b"\x01"))
        elif kind == "V":
            self._write(frame("V", bytes([struct.unpack(">H", body)[0] == VERSION])))
        elif kind == "v":
            self._write(frame("v", struct.pack(">4I", *arm.version)))
        elif kind in "OI":
            self._write(frame(kind, (self._outputs if kind == "O" else self._inputs)(body)))
        else:
            arm.note(f"rtde package {kind!r} ignored")

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
        in_use = {name: IN_USE for name in names if owners.get(name, self) is not self}
        kinds = [(INPUTS | in_use).get(name, NOT_FOUND) for name in names]
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
                arm.in_int[k], arm.written_ns[k] = int(value), now
            elif name.startswith(_DOUBLE):
                arm.in_double[int(name.removeprefix(_DOUBLE))] = value
        if values.get("speed_slider_mask") and "speed_slider_fraction" in values:
            arm.slider = min(1.0, max(0.0, values["speed_slider_fraction"]))
        for group, (first, bits) in _DIGITAL_OUTPUTS.items():
            if f"{group}_digital_output" in values:
                output = int(values[f"{group}_digital_output"]) & bits
                mask = int(values.get(f"{group}_digital_output_mask", 0)) & bits
                unchanged = arm.digital_outputs & ~(mask << first)
                arm.digital_outputs = unchanged | (output & mask) << first
        self._links.after_input()
