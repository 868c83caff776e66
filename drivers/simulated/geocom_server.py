"""A simulated GeoCOM laser station on a pseudo-terminal: `DIR/tracker`, admin `tracker.sock`.

    python -m drivers.simulated.geocom_server --directory DIR --range-std A B
        --transverse-std C E --seed N [--baud 115200]

Admin operations besides those of the line (`pty_port.FAULTS`): `beam {on}` blocks it, `hide
{targets}` covers reflectors by number, `lock_lost`, `freeze {on}` repeats the last measurement,
`stray {on}` follows a reflector at rest 0.2 m behind the target,
`dist_error {on}`, `warn {code}` (1283 or 1284, 0 is none), `busy {on}`, `delay {rpc, seconds,
count}` in real time, `wrong_trid {count}`, `meas_s {seconds}` of world time, `log`, `state`.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drivers.simulated import admin
from drivers.simulated.blackboard import Blackboard
from drivers.simulated.geocom import protocol, rpc
from drivers.simulated.geocom.optics import Beam
from drivers.simulated.geocom.station import Station
from drivers.simulated.parent import end_with_parent
from drivers.simulated.pty_port import PtyPort

LONGEST_LINE = 1024
WARNINGS = (0, 1283, 1284)
BEHIND_M = 0.2
"""Two reflectors are at two places."""


def respond(station: Station, line: str) -> bytes:
    """Return the answer to one line, empty where it is none of the protocol's."""
    if line == "c":  # abort: there is never anything left to abort
        return b"?\r\n"
    request = protocol.parse(line)
    if request is None:
        return b""
    station.requests.append((request.rpc, request.parameters))
    transaction = request.transaction
    if station.wrong_transactions > 0:
        station.wrong_transactions -= 1
        transaction = (transaction + 1) % 2**15
    if request.error != protocol.OK:
        return protocol.reply(request.error, transaction, 0, [], checked=request.checked)
    code, values = rpc.answer(station, request.rpc, request.parameters)
    pause, count = station.delays.pop(request.rpc, (0.0, 0))
    if count > 1:
        station.delays[request.rpc] = pause, count - 1
    time.sleep(pause)
    return protocol.reply(protocol.OK, transaction, code, values, checked=request.checked)


def operate(station: Station, port: PtyPort, op: str, arguments: dict[str, Any]) -> Any:
    """Carry out an admin operation and return the state (`log`: the last requests)."""
    match op:
        case "beam":
            station.broken = bool(arguments["on"])
        case "hide":
            station.hidden = {int(k) for k in arguments["targets"]}
            station.locked = station.locked and station.number not in station.hidden
        case "lock_lost":
            station.locked = False
        case "freeze":
            station.stuck = station.seen if arguments["on"] else None
        case "stray":
            seen = station.target() if arguments["on"] else None
            station.stray = seen and replace(seen, distance=seen.distance + BEHIND_M)
        case "dist_error":
            station.dist_error = bool(arguments["on"])
        case "warn":
            if arguments["code"] not in WARNINGS:
                raise ValueError(f"code = {arguments['code']}; valid: {WARNINGS}")
            station.warning = int(arguments["code"])
        case "busy":
            station.busy = bool(arguments["on"])
        case "delay":
            count = int(arguments.get("count", 1))
            station.delays[int(arguments["rpc"])] = float(arguments["seconds"]), count
        case "wrong_trid":
            station.wrong_transactions = int(arguments.get("count", 1))
        case "meas_s":
            station.meas_s = float(arguments["seconds"])
        case "log":
            return [[number, *values] for number, values in list(station.requests)]
        case "state":
            pass
        case _:
            port.admin(op, arguments)
    return port.state() | {
        "locked": station.locked,
        "beam": station.broken,
        "measured": station.measured,
        "requests": len(station.requests),
        "meas_s": station.meas_s,
    }


def serve(station: Station, port: PtyPort) -> None:
    """Answer for ever."""
    buffer = bytearray()
    while True:
        buffer += port.read(0.02)
        station.tick()
        while (end := min((i for i in map(buffer.find, b"\r\n") if i >= 0), default=-1)) >= 0:
            line = buffer[:end].decode("ascii", "replace").strip()
            del buffer[: end + 1]
            data = respond(station, line) if line else b""
            if data:
                port.send(data)
                port.drain()
        if len(buffer) > LONGEST_LINE:
            buffer.clear()
        port.pump()


def main() -> None:
    """Run until the parent ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--directory", type=Path, required=True)
    parser.add_argument("--range-std", type=float, nargs=2, required=True)
    parser.add_argument("--transverse-std", type=float, nargs=2, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--baud", type=int, default=115200)
    options = parser.parse_args()
    end_with_parent()
    measuring, faults = np.random.default_rng(options.seed).spawn(2)
    station = Station(
        Blackboard.attach(options.directory / "world.bin"),
        Beam(tuple(options.range_std), tuple(options.transverse_std)),
        measuring,
    )
    port = PtyPort(options.directory / "tracker", options.baud, faults)
    admin.serve(
        options.directory / "tracker.sock",
        lambda op, arguments: operate(station, port, op, arguments),
    )
    serve(station, port)


if __name__ == "__main__":
    main()
