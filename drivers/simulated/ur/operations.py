"""The admin operations of the simulated controller."""

import asyncio
import math
import os
import time
from typing import Any

import numpy as np

from drivers.simulated.ur.server import Server, read_version
from hilcal.errors import InputError
from hilcal.types import Floats

OPERATIONS = (
    "state, protective_stop, emergency_stop, release_emergency_stop, local_mode, remote_mode, "
    "kill_script, rtde_drop, rtde_stall {on}, rtde_mute {on}, rtde_half_frame, "
    "dashboard_mute {on}, dashboard_drop, refuse {on}, refuse_motion {on}, freeze {on}, jog {q}, "
    "set {version, slider, speed_scaling, unlock_s}, die, log"
)


class AdminOperations:
    """What may be asked and switched, see `OPERATIONS`; answers with the state, or the log."""

    def __init__(self, server: Server, loop: asyncio.AbstractEventLoop) -> None:
        """Serve from other threads than that of the loop."""
        self._server, self._loop = server, loop

    def __call__(self, op: str, arguments: dict[str, Any]) -> Any:
        """Carry out an operation in the controller's own thread."""
        if op == "die":
            os._exit(1)
        work = asyncio.run_coroutine_threadsafe(self._do(op, arguments), self._loop)
        return work.result(5.0)

    async def _do(self, op: str, arguments: dict[str, Any]) -> Any:
        server, arm = self._server, self._server.arm
        if op not in ("state", "log", "set", "release_emergency_stop", "remote_mode"):
            if arguments.get("on", True):
                arm.fault_ns = time.monotonic_ns()
            arm.note(f"admin: {op} {arguments or ''}".strip())
        if op == "log":
            return list(arm.log)
        if op == "set":
            self._set(arguments)
        else:
            await self._switch(op, arguments)
        server.controller.step()
        return self._state()

    async def _switch(self, op: str, arguments: dict[str, Any]) -> None:
        server, controller = self._server, self._server.controller
        match op:
            case "state":
                pass
            case "protective_stop":
                controller.protective_stop("admin")
            case "emergency_stop":
                controller.emergency_stop()
            case "release_emergency_stop":
                controller.release_emergency_stop()
            case "local_mode" | "remote_mode":
                controller.set_remote(op == "remote_mode")
            case "kill_script":
                controller.stop_program("killed")
            case "rtde_drop":
                for link in list(server.rtde.links):
                    link.writer.transport.abort()
            case "rtde_half_frame":
                for link in list(server.rtde.links):
                    link.half()
            case "rtde_stall" | "rtde_mute" | "dashboard_mute":
                setattr(server.faults, op, bool(arguments.get("on", True)))
            case "dashboard_drop":
                server.dashboard.drop()
            case "refuse":
                await server.accept(not arguments.get("on", True))
            case "refuse_motion":
                server.arm.refuses_motion = bool(arguments.get("on", True))
            case "freeze":  # the joint angles that are told stand still, all else goes on
                on = bool(arguments.get("on", True))
                server.arm.frozen_q = server.arm.trajectory.q.copy() if on else None
            case "jog":  # somebody moves the arm by hand
                server.arm.trajectory.place(_joints(arguments["q"]))
            case _:
                raise InputError(f"no operation {op!r}; valid: {OPERATIONS}")

    def _set(self, arguments: dict[str, Any]) -> None:
        arm = self._server.arm
        for key, value in arguments.items():
            match key:
                case "version":
                    arm.version = read_version(str(value))
                case "slider":
                    arm.slider = _share(key, value)
                case "speed_scaling":
                    arm.scaling = _share(key, value)
                case "unlock_s":
                    self._server.controller.unlock_after = float(value)
                case _:
                    raise InputError(
                        f"no setting {key!r}; valid: version, slider, speed_scaling, unlock_s"
                    )

    def _state(self) -> dict[str, Any]:
        server, arm = self._server, self._server.arm
        motion = arm.trajectory
        return {
            "q": motion.q.tolist(),
            "qd": motion.qd.tolist(),
            "side": motion.side.tolist(),
            "moving": motion.moving,
            "arrivals": motion.arrivals,
            "runtime": int(arm.runtime),
            "safety": int(arm.safety_bits),
            "robot_mode": int(arm.robot_mode),
            "remote": arm.remote,
            "payload": arm.payload,
            "payload_com": arm.payload_com.tolist(),
            "tcp": arm.tcp.tolist(),
            "scripts": server.controller.scripts,
            "script_running": server.controller.program_runs,
            "watchdog_hz": server.controller.watchdog,
            "rtde_clients": len(server.rtde.links),
            "dashboard_clients": server.dashboard.clients,
            "rest_ns": arm.clock.real_ns(motion.rest_time),
            "fault_ns": arm.fault_ns,
            "input_ns": arm.input_ns,
            "now_ns": time.monotonic_ns(),
        }


def _joints(q: Any) -> Floats:
    place = np.asarray(q, dtype=np.float64)
    if place.shape != (6,) or not np.all(np.abs(place) <= 2.0 * np.pi):
        raise InputError(f"q = {q!r}; valid: 6 numbers within a turn, rad")
    return place


def _share(key: str, value: Any) -> float:
    if not isinstance(value, int | float) or not (math.isfinite(value) and 0 <= value <= 1):
        raise InputError(f"{key} = {value!r}; valid: 0 to 1")
    return float(value)
