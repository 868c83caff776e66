"""The process of the physical world: reads what the arm does, writes what is true.

`python -m drivers.simulated.world_server --directory DIR --seed N`, with DIR/world.json of
`write_world`. Requests at DIR/world.sock:

    hang {name}       hang a load, null: take it off; returns the name of what truly hangs
    mistake {name}    the next hang hangs this one instead
    push {wrench}     lean on the load point, six numbers, base axes, N and N·m; zeros: let go
    swing {wrench, period, decay}  let what is hung from now on swing for a while (world time)
    state             what is true now
    log               what was hung and pushed, and when (world time)
    die               end at once, as in a crash
"""

import argparse
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

from drivers.simulated import admin
from drivers.simulated.blackboard import Blackboard
from drivers.simulated.parent import end_with_parent
from drivers.simulated.world_file import read_world
from drivers.simulated.world_state import WorldState
from hilcal.errors import HilcalError

OPS = ("hang", "mistake", "push", "swing", "state", "log", "die")
_POLL = 0.0025  # s, real time between two looks at the arm


def open_board(directory: Path, scale: float, begun: float = 0.0) -> Blackboard:
    """Return the blackboard of a cell; the first who asks makes it, whole or not at all."""
    path = directory / "world.bin"
    if not path.exists():
        new = path.with_name("world.bin.new")
        board = Blackboard.create(new, scale, begun)
        new.replace(path)  # the mapping goes with the file
        return board
    return Blackboard.attach(path)


def handler(living: WorldState) -> admin.Handler:
    """Return what answers the requests."""

    def answer(op: str, given: dict[str, Any]) -> Any:
        if op == "hang":
            return living.hang(given.get("name"))
        if op == "mistake":
            return living.mistake(given.get("name"))
        if op == "push":
            return living.push(given["wrench"])
        if op == "swing":
            return living.swing(given["wrench"], float(given["period"]), float(given["decay"]))
        if op == "state":
            return living.state()
        if op == "log":
            return living.log()
        if op == "die":
            threading.Timer(0.02, os._exit, (70,)).start()
            return None
        raise ValueError(f"unknown op {op!r}; valid: {', '.join(OPS)}")

    return answer


def main() -> int:
    """Run until the parent ends; returns the exit code."""
    parser = argparse.ArgumentParser(description="The physical world of a simulated cell.")
    parser.add_argument("--directory", type=Path, required=True)
    parser.add_argument("--seed", type=int, required=True)
    arguments = parser.parse_args()
    end_with_parent()
    try:
        world, config = read_world(arguments.directory / "world.json")
        board = open_board(arguments.directory, config.simulation.clock)
        living = WorldState(world, config, board, arguments.seed)
    except HilcalError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    living.step(time.monotonic_ns())
    admin.serve(arguments.directory / "world.sock", handler(living))
    while True:
        living.step(time.monotonic_ns())
        time.sleep(_POLL)


if __name__ == "__main__":
    sys.exit(main())
