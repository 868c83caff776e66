"""A simulated Universal Robots controller on a separate address; admin `arm.sock`.

    python -m hilcal.drivers.simulated.ur_server --directory DIR --host 127.A.B.C --robot ur10e
        [--version 5.11.6.1010327] [--api-port 8080] [--calibration FILE] [--seed N]

Ports as on a real controller: RTDE 30004, primary 30001, dashboard 29999 and script 30003.
PolyScope X (version 10 and later) has a Robot API in place of the last two (port 80 on a real
controller, which needs an administrator here). With a calibration the kinematics are those of the
file.

Admin operations: `state`, `protective_stop`, `safeguard_stop`, `release_safeguard`,
`reduced_mode {on}`, `emergency_stop`, `release_emergency_stop`, `local_mode`, `remote_mode`,
`kill_script`; `rtde_drop`, `rtde_stall {on}`, `rtde_mute {on}`, `rtde_half_frame`,
`dashboard_mute {on}`, `dashboard_drop`, `refuse {on}` new RTDE clients, `refuse_motion {on}`,
`freeze {on}` the reported joint angles only, `jog {q}` as if the arm is moved by hand; `set
{version, slider, speed_scaling, unlock_s}`, `die`, `log`
"""

import asyncio
import inspect
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated import ur_controller as control
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.ur_rtde import RtdeLink, RtdeLinks, Sensors
from hilcal.drivers.simulated.ur_state import ArmState, Kinematics, Trajectory, WorldClock
from hilcal.errors import DeviceError, InputError
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import load_arm
from hilcal.robot.factory import FactoryKinematics, read_factory, with_factory
from hilcal.types import Floats

DASHBOARD, PRIMARY, SCRIPT, RTDE = 29999, 30001, 30003, 30004
API = 8080
HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
"""Joint angles at the first power-on, rad."""

_MOVING, _STILL = 0.004, 0.01  # s of real time between steps
POLYSCOPE_X = 10  # first version with a Robot API
_LINE = 1 << 16  # bytes; longest line
Version = tuple[int, int, int, int]


def powered_on(arm: Arm, board: Blackboard, version: Version, rng: np.random.Generator) -> ArmState:
    """Return the state of a controller after power-on; the arm is where it stood before."""
    last, clock = board.read("arm"), WorldClock(board)
    alive = bool(last["alive"])
    arrivals = int(last["arrivals"]) + bool(last["moving"])
    q, side = (last["q"], last["side"]) if alive else (HOME, rng.choice([-1.0, 1.0], arm.n))
    state = ArmState(clock, Kinematics(arm), Trajectory(q, side, arrivals, clock.now), version)
    if alive:
        state.payload, state.payload_com = float(last["payload"]), last["payload_com"].copy()
    state.note("switched on")
    return state


class UrServer:
    """All servers of a controller."""

    def __init__(
        self,
        state: ArmState,
        board: Blackboard,
        host: str,
        rng: np.random.Generator,
        api_port: int,
        factory: FactoryKinematics | None,
    ) -> None:
        self.arm = state
        self.controller = control.Controller(state, board)
        sensors = Sensors(state, board, rng)
        self.rtde = RtdeLinks(state, sensors, self.controller.step)
        self.controller.has_client = self.rtde.has_writer
        arm = state.kinematics.arm
        self.is_polyscope_x = state.version[0] >= POLYSCOPE_X
        supervision = control.RobotApiServer if self.is_polyscope_x else control.DashboardServer
        self.dashboard = supervision(self.controller)
        status = control.NOT_INITIALISED if factory is None else factory.status
        rows = None if factory is None else factory.rows
        self.primary = control.PrimaryPort(
            self.controller, _rows(arm) if rows is None else rows, status
        )
        self._host, self._supervised = host, api_port if self.is_polyscope_x else DASHBOARD
        self._rtde_server: asyncio.Server | None = None
        self._servers: list[asyncio.Server] = []

    async def open(self) -> None:
        """Listen."""
        self._servers = [
            await self._listen(self.primary.run, PRIMARY),
            await self._listen(self.dashboard.run, self._supervised),
        ]
        if not self.is_polyscope_x:
            self._servers.append(await self._listen(self._run_script, SCRIPT))
        await self.accept(True)

    async def accept(self, on: bool) -> None:
        """Accept new RTDE clients, or refuse them; connected ones stay."""
        if on and self._rtde_server is None:
            self._rtde_server = await self._listen(
                lambda reader, writer: RtdeLink(self.rtde, reader, writer).run(), RTDE
            )
        elif not on and self._rtde_server is not None:
            closing, self._rtde_server = self._rtde_server, None
            loop = asyncio.get_running_loop()
            for door in closing.sockets:
                loop.remove_reader(door)
            # A client just accepted gets its link first: asyncio drops it with the server.
            await asyncio.sleep(0)
            closing.close()

    async def run(self) -> None:
        """Run the controller for ever."""
        motion = self.arm.trajectory
        while True:
            self.controller.step()
            self.rtde.send(time.monotonic())
            wait = min(_MOVING, self.arm.clock.real(motion.remaining)) if motion.moving else _STILL
            await asyncio.sleep(max(0.0, min(wait, self.rtde.due() - time.monotonic())))

    async def _listen(self, client: Any, port: int) -> asyncio.Server:
        try:
            return await asyncio.start_server(client, self._host, port, limit=_LINE)
        except OSError as error:
            raise DeviceError(
                f"simulated arm: {self._host}:{port} is in use or not available "
                f"({error.strerror}); each simulated arm needs an address 127.x.y.z of its own"
            ) from None

    async def _run_script(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await self.controller.take_programs(reader)
        finally:
            writer.close()


def _rows(arm: Arm) -> Floats:
    """(4, 6) θ, a, d, α of an arm, as its controller reports them."""
    from hilcal.calibration.dh_table import dh_rows  # slow to import

    rows = dh_rows(arm)
    return np.stack([rows.offset, rows.a, rows.d, rows.alpha])


def read_version(text: str) -> Version:
    """Return the four numbers of a PolyScope version such as 5.11.6.1010327."""
    parts = text.split(".")
    if len(parts) == 4 and all(part.isascii() and part.isdigit() for part in parts):
        a, b, c, d = map(int, parts)
        return a, b, c, d
    raise InputError(f"version {text!r}; valid: four numbers, e.g. 5.11.6.1010327")


_QUIET = ("state", "log", "set", "release_emergency_stop", "release_safeguard", "remote_mode")
"""Operations that are not faults."""


def operations(server: UrServer, loop: asyncio.AbstractEventLoop) -> admin.Handler:
    """Return the admin operations, which other threads than the loop's may call."""
    arm, controller, links = server.arm, server.controller, server.rtde.links

    def for_all(do: Callable[[RtdeLink], None]) -> Callable[[], None]:
        def all_links() -> None:
            for link in list(links):
                do(link)

        return all_links

    def freeze(on: bool = True) -> None:
        arm.frozen_q = arm.trajectory.q.copy() if on else None

    requests = admin.Operations(
        {
            "protective_stop": lambda: controller.protective_stop("admin"),
            "safeguard_stop": controller.safeguard_stop,
            "release_safeguard": controller.release_safeguard,
            "reduced_mode": controller.reduce,
            "emergency_stop": controller.emergency_stop,
            "release_emergency_stop": controller.release_emergency_stop,
            "local_mode": lambda: controller.set_remote(False),
            "remote_mode": lambda: controller.set_remote(True),
            "kill_script": lambda: controller.stop_program("killed"),
            "rtde_drop": for_all(lambda link: link.writer.transport.abort()),
            **{name: admin.setter(arm, name) for name in ("rtde_stall", "rtde_mute")},
            "rtde_half_frame": for_all(RtdeLink.half),
            "dashboard_mute": admin.setter(arm, "dashboard_mute"),
            "dashboard_drop": server.dashboard.drop,
            "refuse": lambda on=True: server.accept(not on),
            "refuse_motion": admin.setter(arm, "refuses_motion"),
            "freeze": freeze,
            "jog": lambda q: arm.trajectory.place(_joints(q)),
            "set": lambda **settings: _set(server, settings),
            "log": lambda: list(arm.log),
        },
        partial(_state, server),
    )

    async def do(op: str, arguments: dict[str, Any]) -> Any:
        if op in requests.functions and op not in _QUIET:
            if arguments.get("on", True):
                arm.fault_ns = time.monotonic_ns()
            arm.note(f"admin: {op} {arguments or ''}".strip())
        result = requests(op, arguments)
        if inspect.isawaitable(result):
            await result
            return _state(server)
        return result

    def handler(op: str, arguments: dict[str, Any]) -> Any:
        if op == "die":
            os._exit(1)
        return asyncio.run_coroutine_threadsafe(do(op, arguments), loop).result(5.0)

    return handler


def _set(server: UrServer, settings: dict[str, Any]) -> None:
    arm = server.arm
    for key, value in settings.items():
        match key:
            case "version":
                arm.version = read_version(str(value))
            case "slider":
                arm.slider = _share(key, value)
            case "speed_scaling":
                arm.scaling = _share(key, value)
            case "unlock_s":
                server.controller.unlock_after = float(value)
            case _:
                raise InputError(
                    f"no setting {key!r}; valid: version, slider, speed_scaling, unlock_s"
                )


def _state(server: UrServer) -> dict[str, Any]:
    arm, controller, motion = server.arm, server.controller, server.arm.trajectory
    controller.step()
    return {
        **{name: getattr(motion, name).tolist() for name in ("q", "qd", "side")},
        **{name: getattr(arm, name).tolist() for name in ("payload_com", "tcp")},
        **{name: getattr(motion, name) for name in ("moving", "arrivals")},
        **{name: getattr(arm, name) for name in ("remote", "payload", "fault_ns", "input_ns")},
        "runtime": int(arm.runtime),
        "safety": arm.safety_bits,
        "robot_mode": int(arm.robot_mode),
        "scripts": controller.scripts,
        "script_running": controller.program_runs,
        "watchdog_hz": controller.watchdog,
        "rtde_clients": len(server.rtde.links),
        "dashboard_clients": server.dashboard.clients,
        "rest_ns": arm.clock.real_ns(motion.rest_time),
        "now_ns": time.monotonic_ns(),
    }


def _joints(q: Any) -> Floats:
    angles = np.asarray(q, dtype=np.float64)
    if angles.shape != (6,) or not np.all(np.abs(angles) <= 2.0 * np.pi):
        raise InputError(f"q = {q!r}; valid: 6 numbers within a turn, rad")
    return angles


def _share(key: str, value: Any) -> float:
    if not isinstance(value, int | float) or not 0 <= value <= 1:
        raise InputError(f"{key} = {value!r}; valid: 0 to 1")
    return float(value)


def start(options: admin.Arguments) -> admin.Device:
    """Return the controller, listening."""
    arm, factory = load_arm(options.robot), None
    if arm.n != len(HOME):
        raise InputError(f"--robot {options.robot}: {arm.n} joints; an arm of UR has {len(HOME)}")
    if options.calibration is not None:
        factory = read_factory(options.calibration, arm)
        arm = with_factory(arm, factory)
    world = options.directory / "world.bin"
    try:
        board = Blackboard(world)
    except (OSError, ValueError) as error:
        raise DeviceError(f"simulated arm: no shared world at {world} ({error})") from None
    rng = np.random.default_rng(options.seed)
    state = powered_on(arm, board, read_version(options.version), rng)
    server = UrServer(state, board, options.host, rng, options.api_port, factory)
    loop = asyncio.new_event_loop()
    loop.run_until_complete(server.open())
    return operations(server, loop), lambda: loop.run_until_complete(server.run())


OPTIONS: dict[str, dict[str, Any]] = {
    "--host": {"required": True},
    "--robot": {"required": True},
    "--version": {"default": "5.11.6.1010327"},
    "--api-port": {"type": int, "default": API},
    "--calibration": {"type": Path},
}

if __name__ == "__main__":
    admin.run(__doc__, "arm", start, OPTIONS)
