"""The state of the physical world that all simulated devices share: a small memory-mapped file.

Each section has one writer and any number of readers, in other processes. Its sequence number is
odd during a write, which makes readers read again (a seqlock; see Linux kernel documentation,
"Sequence counters and sequential locks").
"""

import mmap
import time
from pathlib import Path
from typing import Any

import numpy as np

MOST_TARGETS = 8  # targets that a tool can carry in the simulated cell
_SEQUENCE = 8
_TRIES = 10_000


def sections(n: int) -> dict[str, np.dtype[Any]]:
    """Return the sections for an arm of n joints; for slides read m in place of rad."""
    return {
        # written once by the world
        "world": np.dtype([("joints", "<i8"), ("start_ns", "<i8"), ("scale", "<f8")]),
        # written by the arm's controller
        "arm": np.dtype(
            [
                ("alive", "<f8"),  # 1 once the controller has written its state
                ("q", "<f8", n),  # present point of the commanded trajectory, rad
                ("qd", "<f8", n),  # its speed, rad/s
                ("side", "<f8", n),  # direction of each joint's last motion, -1 or +1
                ("arrivals", "<i8"),  # motions that have ended (also by a stop)
                ("moving", "<f8"),  # 1 while the trajectory runs
                ("payload", "<f8"),  # as set in the controller, kg
                ("payload_com", "<f8", 3),  # flange axes, m
            ]
        ),
        # written by the world: the true state
        "truth": np.dtype(
            [
                ("time", "<f8"),  # world time of this section, s
                ("load", "<i8"),  # number of the load in the cell's [[loads]] + 1, 0 is none
                ("load_since", "<f8"),  # world time of its last change, s
                ("target", "<f8", 3),  # tracked target, sensor (tracker) axes, m
                ("target_rotation", "<f8", (3, 3)),
                ("targets", "<f8", (MOST_TARGETS, 3)),  # all, if several, `target` first; else NaN
                ("flange", "<f8", (4, 4)),  # T_base_flange
                ("sensor_wrench", "<f8", 6),  # of tool and load on the force sensor, sensor axes
                ("drive_torque", "<f8", n),  # N·m
                ("encoder", "<f8", n),  # what the encoders read, rad
                ("joint_temperature", "<f8", n),  # °C
                ("air_temperature", "<f8"),  # °C
                ("arrivals", "<i8"),  # the arm's `arrivals` that this section belongs to
            ]
        ),
    }


def _offsets(n: int) -> tuple[dict[str, int], int]:
    at, out = 0, {}
    for name, kind in sections(n).items():
        out[name] = at
        at += -(-(_SEQUENCE + kind.itemsize) // 64) * 64
    return out, at


class Blackboard:
    """An open shared file; use `create` once."""

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as stream:
            self._map = mmap.mmap(stream.fileno(), 0)
        self.joints = int(np.frombuffer(self._map, "<i8", 1, _SEQUENCE)[0])
        at, size = _offsets(self.joints)
        if len(self._map) != size:
            raise ValueError(f"{path} is of {len(self._map)} bytes; expected {size}")
        self._sequence = {
            name: np.frombuffer(self._map, "<i8", 1, offset) for name, offset in at.items()
        }
        self._content = {
            name: np.frombuffer(self._map, kind, 1, at[name] + _SEQUENCE)
            for name, kind in sections(self.joints).items()
        }

    @classmethod
    def create(cls, path: Path, scale: float, start: float = 0.0, joints: int = 6) -> "Blackboard":
        """Make the file; its clock starts at `start`, s, with `scale` s per real second."""
        number = np.array([0, joints], "<i8").tobytes()
        path.write_bytes(number + bytes(_offsets(joints)[1] - len(number)))
        board = cls(path)
        start_ns = time.monotonic_ns() - round(1e9 * start / scale)
        board.write("world", start_ns=start_ns, scale=scale)
        return board

    def write(self, section: str, **fields: Any) -> None:
        """Set fields of a section, for readers all at once; for its single writer only."""
        sequence, content = self._sequence[section], self._content[section]
        odd = int(sequence[0]) | 1
        sequence[0] = odd + 2 if odd == int(sequence[0]) else odd
        for name, value in fields.items():
            content[name][0] = value
        sequence[0] = int(sequence[0]) + 1

    def read(self, section: str) -> Any:
        """Return a consistent copy of a section, a record with the fields of `sections`."""
        sequence, content = self._sequence[section], self._content[section]
        for _ in range(_TRIES):
            number = int(sequence[0])
            if number % 2 == 0:
                copy = content[0].copy()
                if int(sequence[0]) == number:
                    return copy
            time.sleep(0)
        raise RuntimeError(f"blackboard: section {section} is never at rest (its writer died?)")

    def write_count(self, section: str) -> int:
        """Return a number that every write of a section changes."""
        return int(self._sequence[section][0])

    @property
    def time(self) -> float:
        """World time, s since the world's start."""
        world = self._content["world"][0]
        return float((time.monotonic_ns() - int(world["start_ns"])) * 1e-9 * world["scale"])

    @property
    def scale(self) -> float:
        """World seconds per real second."""
        return float(self._content["world"]["scale"][0])


_LATE_S = 0.2  # longest wait of an instrument until the world shows an arm's arrival, real s


def settled_truth(board: Blackboard) -> Any:
    """Return the truth; after an arrival of the arm, wait until it belongs to the arrival.

    The world reads the arm's state some hundred times per real second; its clock may run faster.
    """
    end = time.monotonic() + _LATE_S
    while True:
        arm, truth = board.read("arm"), board.read("truth")
        late = not arm["moving"] and truth["arrivals"] != arm["arrivals"]
        if not late or time.monotonic() > end:
            return truth
        time.sleep(0.001)
