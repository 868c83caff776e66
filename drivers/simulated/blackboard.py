"""The one physical world, as all simulated devices see it: a small shared file.

Each section has one writer and any number of readers, in other processes. A sequence number
that is odd while the section is being written makes readers read again (a seqlock; see
Linux kernel documentation, "Sequence counters and sequential locks").
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
    """Return the sections of the world of an arm of n joints; angles of a slide are in m."""
    return {
        # written once by the world
        "world": np.dtype([("joints", "<i8"), ("start_ns", "<i8"), ("scale", "<f8")]),
        # written by the arm's controller
        "arm": np.dtype(
            [
                ("alive", "<f8"),  # 1 once the controller has written its state
                ("q", "<f8", n),  # where the commanded trajectory is, rad
                ("qd", "<f8", n),  # its speed, rad/s
                ("side", "<f8", n),  # direction of each joint's last motion, -1 or +1
                ("arrivals", "<i8"),  # motions that have ended (also by a stop)
                ("moving", "<f8"),  # 1 while the trajectory runs
                ("payload", "<f8"),  # as set in the controller, kg
                ("payload_com", "<f8", 3),  # flange axes, m
            ]
        ),
        # written by the world: what is true
        "truth": np.dtype(
            [
                ("time", "<f8"),  # world time of the content, s
                ("load", "<i8"),  # number of the load in the cell's [[loads]] + 1, 0 is none
                ("load_since", "<f8"),  # world time of its last change, s
                ("target", "<f8", 3),  # tracked target, sensor (tracker) axes, m
                ("target_rotation", "<f8", (3, 3)),
                ("targets", "<f8", (MOST_TARGETS, 3)),  # of several all, `target` first; else NaN
                ("flange", "<f8", (4, 4)),  # T_base_flange
                ("sensor_wrench", "<f8", 6),  # on the force sensor by tool and load, sensor axes
                ("drive_torque", "<f8", n),  # N·m
                ("encoder", "<f8", n),  # what the encoders read, rad
                ("joint_temperature", "<f8", n),  # °C
                ("air_temperature", "<f8"),  # °C
                ("arrivals", "<i8"),  # the arm's `arrivals` that the content belongs to
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
    def create(cls, path: Path, scale: float, begun: float = 0.0, joints: int = 6) -> "Blackboard":
        """Make the file; the clock begins at `begun`, s, and goes `scale` s per real second."""
        number = np.array([0, joints], "<i8").tobytes()
        path.write_bytes(number + bytes(_offsets(joints)[1] - len(number)))
        board = cls(path)
        start = time.monotonic_ns() - round(1e9 * begun / scale)
        board.write("world", start_ns=start, scale=scale)
        return board

    def write(self, section: str, **fields: Any) -> None:
        """Set fields of a section, all at once for readers; only its one writer may."""
        sequence, content = self._sequence[section], self._content[section]
        begun = int(sequence[0]) | 1
        sequence[0] = begun + 2 if begun == int(sequence[0]) else begun
        for name, value in fields.items():
            content[name][0] = value
        sequence[0] = int(sequence[0]) + 1

    def read(self, section: str) -> Any:
        """Return a consistent copy of a section, a record with the fields of `sections`."""
        sequence, content = self._sequence[section], self._content[section]
        for _ in range(_TRIES):
            before = int(sequence[0])
            if before % 2 == 0:
                copy = content[0].copy()
                if int(sequence[0]) == before:
                    return copy
            time.sleep(0)
        raise RuntimeError(f"blackboard: section {section} is never at rest (its writer died?)")

    def written(self, section: str) -> int:
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


_LATE_S = 0.2  # how long an instrument waits for the world to catch up with an arm that has arrived


def settled_truth(board: Blackboard) -> Any:
    """Return the truth; where the arm has just arrived, that of its arrival.

    The world looks at the arm some hundred times a second of real time; its clock may be faster.
    """
    end = time.monotonic() + _LATE_S
    while True:
        arm, truth = board.read("arm"), board.read("truth")
        late = not arm["moving"] and truth["arrivals"] != arm["arrivals"]
        if not late or time.monotonic() > end:
            return truth
        time.sleep(0.001)
