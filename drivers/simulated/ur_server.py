"""A simulated Universal Robots controller on an address of its own; admin `arm.sock`.

    python -m drivers.simulated.ur_server --directory DIR --host 127.A.B.C --robot ur10e
        [--version 5.11.6.1010327] [--seed N]

Ports as on a real one: RTDE 30004, dashboard 29999 (none from PolyScope X, version 10, on),
script 30003. Admin operations: see `ur.operations`.
"""

import argparse
import asyncio
import sys
from pathlib import Path

import numpy as np

from drivers.simulated import admin
from drivers.simulated.blackboard import Blackboard, N
from drivers.simulated.parent import end_with_parent
from drivers.simulated.ur.operations import AdminOperations
from drivers.simulated.ur.server import Server, read_version, switched_on
from hilcal.errors import DeviceError, HilcalError, InputError
from hilcal.robot.catalogue import load_arm


async def serve(options: argparse.Namespace) -> None:
    """Open everything, and run until the process ends.

    Raises:
        InputError: an arm that cannot be simulated.
        DeviceError: no shared world, or an address that cannot be had.
    """
    arm = load_arm(options.robot)
    if arm.n != N:
        raise InputError(f"--robot {options.robot}: {arm.n} joints; valid: arms of {N} joints")
    world = options.directory / "world.bin"
    try:
        board = Blackboard.attach(world)
    except (OSError, ValueError) as error:
        raise DeviceError(f"simulated arm: no shared world at {world} ({error})") from None
    rng = np.random.default_rng(options.seed)
    state = switched_on(arm, board, read_version(options.version), rng)
    server = Server(state, board, options.host, rng)
    await server.open()
    loop = asyncio.get_running_loop()
    admin.serve(options.directory / "arm.sock", AdminOperations(server, loop))
    await server.run()


def main() -> None:
    """Read the command line and serve; exit code 3 and one line where that is impossible."""
    parser = argparse.ArgumentParser(prog="ur_server", description=__doc__)
    parser.add_argument("--directory", type=Path, required=True)
    parser.add_argument("--host", required=True)
    parser.add_argument("--robot", required=True)
    parser.add_argument("--version", default="5.11.6.1010327")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    end_with_parent()
    try:
        asyncio.run(serve(options))
    except HilcalError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
