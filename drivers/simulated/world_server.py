"""The process of the physical world: reads what the arm does, writes what is true.

`python -m hilcal.drivers.simulated.world_server --directory DIR --seed N`, with DIR/world.json of
`write_world`. Requests at DIR/world.sock:

    hang {name}       hang a load, null: take it off; returns the name of what truly hangs
    mistake {name}    the next hang hangs this one instead
    push {wrench}     lean on the load point, six numbers, base axes, N and N·m; zeros: let go
    swing {wrench, period, decay}  let what is hung from now on swing for a while (world time)
    state             what is true now
    log               what was hung and pushed, and when (world time)
    die               end at once, as in a crash

The world comes as a JSON file, exactly.
"""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig
from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.own_law import OwnLaw
from hilcal.drivers.simulated.truth import Truth
from hilcal.drivers.simulated.world import SimulatedNoise, World
from hilcal.drivers.simulated.world_state import WorldState
from hilcal.errors import HilcalError, InputError
from hilcal.types import Floats
from hilcal.whole_file import replace_file

FORMAT = "hilcal-world"
VERSION = 2
_CELL = ("all_targets", "load_point", "tool_mass", "tool_com", "gravity")
_ARM = ("links", "masses", "coms", "q_min", "q_max", "torque_max", "coupling", "slides")
_LATER = ("joint_coupling", "guide_error")
"""Parameters that world files may lack, since they were added later."""


def write_world(path: Path, world: World, config: CellConfig, base_dir: Path | None = None) -> None:
    """Write the world and the configuration of its cell; floats keep every bit.

    The file appears whole or not at all; `base_dir` is what a robot's path in `config` is relative
    to.

    Raises:
        InputError: the configuration describes another cell than the world's.
    """
    other = _differences(world.cell, cell_from_config(config, base_dir))
    if other:
        raise InputError(
            f"simulated world: its cell and the configuration differ in {', '.join(other)}; "
            "valid: the configuration that the world was made from"
        )
    content = {
        "format": FORMAT,
        "version": VERSION,
        "config": json.loads(config.to_json()),
        "base_dir": None if base_dir is None else str(base_dir.resolve()),
        "physics": {f.name: _listed(getattr(world.physics, f.name)) for f in fields(Truth)},
        "registration": _listed(world.registration),
        "station": _listed(world.station),
        "joint_std": _listed(world.joint_std),
        "joint_reference": world.joint_reference,
        "offsets": None if world.offsets is None else _listed(world.offsets),
        "own": None if world.own is None else world.own.to_json(),
        "noise": asdict(world.noise),
    }
    replace_file(path, json.dumps(content, indent=1))


def read_world(path: Path) -> tuple[World, CellConfig]:
    """Return the world of a file and the configuration of its cell.

    Raises:
        InputError: unreadable, not a world, or something in it that cannot be.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise InputError(f"{path}: not a world file ({error})") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(f'{path}: not a world file; it has "format": "{FORMAT}"')
    if data.get("version") != VERSION:
        raise InputError(f"{path}: version {data.get('version')!r}; this hilcal reads {VERSION}")
    try:
        config = CellConfig.from_json(json.dumps(data["config"]))
        base_dir = None if data["base_dir"] is None else Path(data["base_dir"])
        noise = data["noise"]
        along, by, across, more = map(float, (*noise["range_std"], *noise["transverse_std"]))
        cell = cell_from_config(config, base_dir)
        world = World(
            cell=cell,
            physics=_physics(cell, data["physics"]),
            registration=_array(data["registration"]),
            station=_array(data["station"]),
            noise=SimulatedNoise((along, by), (across, more), float(noise["orientation_std"])),
            joint_std=_array(data["joint_std"]),
            joint_reference=float(data["joint_reference"]),
            offsets=_array(data["offsets"]) if data.get("offsets") else None,
            own=OwnLaw.from_json(cell, data["own"]) if data.get("own") else None,
        )
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path}: damaged: {type(error).__name__} {error}") from None
    return world, config


def _physics(cell: Cell, data: dict[str, Any]) -> Truth:
    """Return the hidden parameters; zero for what no world had when the file was written."""
    rigid = Truth.rigid(cell.arm)
    later = {name: getattr(rigid, name) for name in _LATER if name not in data}
    given = {f.name: _array(data[f.name]) for f in fields(Truth) if f.name not in later}
    return Truth(**given, **later)


def _listed(array: Floats) -> dict[str, Any]:
    """Return an array as JSON; the shape apart, since one of its numbers may be 0."""
    return {"shape": list(array.shape), "values": [float(x) for x in array.ravel()]}


def _array(data: dict[str, Any]) -> Floats:
    return np.array(data["values"], dtype=np.float64).reshape(data["shape"])


def _differences(a: Cell, b: Cell) -> list[str]:
    """Return the names of what is not the same in two cells; registrations do not count."""
    out = [
        name.removeprefix("all_")
        for name in _CELL
        if not np.array_equal(getattr(a, name), getattr(b, name))
    ]
    return out + [
        f"arm.{name}"
        for name in _ARM
        if not np.array_equal(getattr(a.arm, name), getattr(b.arm, name))
    ]


_POLL = 0.0025  # s, real time between two looks at the arm


def open_board(directory: Path, scale: float, begun: float = 0.0, joints: int = 6) -> Blackboard:
    """Return the blackboard of a cell; the first who asks makes it, whole or not at all."""
    path = directory / "world.bin"
    if not path.exists():
        new = path.with_name("world.bin.new")
        board = Blackboard.create(new, scale, begun, joints)
        new.replace(path)  # the mapping goes with the file
        return board
    return Blackboard.attach(path)


def main() -> int:
    """Run until the parent ends; returns the exit code."""
    parser = admin.device_parser(__doc__)
    arguments = parser.parse_args()
    admin.end_with_parent()
    try:
        world, config = read_world(arguments.directory / "world.json")
        board = open_board(arguments.directory, config.simulation.clock, joints=world.cell.arm.n)
        living = WorldState(world, config, board, arguments.seed)
    except HilcalError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    living.step(time.monotonic_ns())
    asked: dict[str, Callable[..., Any]] = {
        "hang": living.hang,
        "mistake": living.mistake,
        "push": living.push,
        "swing": living.swing,
        "state": living.state,
        "log": living.log,
    }
    admin.serve(arguments.directory / "world.sock", admin.Operations(asked))
    while True:
        living.step(time.monotonic_ns())
        time.sleep(_POLL)


if __name__ == "__main__":
    sys.exit(main())
