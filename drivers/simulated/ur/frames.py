"""RTDE v2 on the wire: frames, variables and their types, recipes.

Source: Universal Robots, article "Real-Time Data Exchange (RTDE) guide".
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

VERSION = 2
NOT_FOUND = "NOT_FOUND"
IN_USE = "IN_USE"
HEADER = struct.Struct(">HB")
"""Size of the whole frame in bytes, and its type."""

REGISTERS = 48

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
        "ft_raw_wrench tcp_offset payload_inertia"
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
    for k in range(REGISTERS):
        table[f"{side}_int_register_{k}"] = "INT32"
        table[f"{side}_double_register_{k}"] = "DOUBLE"
    return table


OUTPUTS = _table(_OUTPUTS, "output")
INPUTS = _table(_INPUTS, "input")


def frame(kind: str, payload: bytes = b"") -> bytes:
    """Return a frame: size (u16, with the header), type (u8), payload; big-endian."""
    return HEADER.pack(HEADER.size + len(payload), ord(kind)) + payload


def outputs_since(version: tuple[int, int, int, int]) -> dict[str, str]:
    """Return name -> type of the outputs that a controller of this version knows."""
    table = dict(OUTPUTS)
    if version < (5, 9, 0, 0):
        del table["ft_raw_wrench"]
    if version < (5, 5, 1, 0):
        del table["payload_cog"]
    return table


@dataclass(frozen=True, slots=True)
class Recipe:
    """Variables that travel together in one data frame.

    Attributes:
        number: its id on the connection, 1 or more.
        names: the variables in order.
        kinds: their types.
        layout: of id and variables.
    """

    number: int
    names: tuple[str, ...]
    kinds: tuple[str, ...]
    layout: struct.Struct

    @classmethod
    def of(cls, number: int, names: Iterable[str], table: dict[str, str]) -> "Recipe":
        """Return the recipe of variables of which each is in `table`."""
        names = tuple(names)
        kinds = tuple(table[name] for name in names)
        layout = struct.Struct(">B" + "".join(FORMATS[kind] for kind in kinds))
        return cls(number, names, kinds, layout)

    def pack(self, values: Iterable[float]) -> bytes:
        """Return the payload of a data frame; `values` are all numbers in order, flat."""
        return self.layout.pack(self.number, *values)

    def unpack(self, payload: bytes) -> Iterator[tuple[str, float]]:
        """Yield (name, first number) of each variable in the payload of a data frame.

        Raises:
            struct.error: the payload has another size.
        """
        numbers = iter(self.layout.unpack(payload)[1:])
        for name, kind in zip(self.names, self.kinds, strict=True):
            count = 3 if "3D" in kind else 6 if kind.startswith("VECTOR6") else 1
            group = [next(numbers) for _ in range(count)]
            yield name, group[0]
