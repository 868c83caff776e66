"""The controller's process: its ports, and the loop that paces it."""

import asyncio
import time
from typing import Any

import numpy as np

from drivers.simulated.blackboard import Blackboard
from drivers.simulated.ur.controller import Controller
from drivers.simulated.ur.dashboard import Dashboard
from drivers.simulated.ur.kinematics import Kinematics
from drivers.simulated.ur.motion import Trajectory
from drivers.simulated.ur.rtde_link import Faults, RtdeLink, RtdeLinks
from drivers.simulated.ur.script import ScriptStream
from drivers.simulated.ur.sensing import Sensors
from drivers.simulated.ur.state import ArmState, WorldClock
from hilcal.errors import DeviceError, InputError
from hilcal.robot.arm import Arm

DASHBOARD, SCRIPT, RTDE = 29999, 30003, 30004
HOME = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
"""Where a controller that is switched on for the first time finds its arm, rad."""

_MOVING, _STILL = 0.004, 0.01  # s of real time between steps
_POLYSCOPE_X = 10  # from this version on there is no dashboard
_LINE = 1 << 16  # bytes of the longest line
Version = tuple[int, int, int, int]


def switched_on(
    arm: Arm, board: Blackboard, version: Version, rng: np.random.Generator
) -> ArmState:
    """Return the state of a controller right after power-up; the arm stands where it stood."""
    kept = board.read("arm")
    clock = WorldClock(board)
    known = bool(kept["alive"])
    arrivals = int(kept["arrivals"]) + bool(kept["moving"])
    q, side = (kept["q"], kept["side"]) if known else (HOME, rng.choice([-1.0, 1.0], arm.n))
    trajectory = Trajectory(q, side, arrivals, clock.now)
    state = ArmState(clock, Kinematics(arm), trajectory, version)
    if known:
        state.payload, state.payload_com = float(kept["payload"]), kept["payload_com"].copy()
    state.note("switched on")
    return state


class Server:
    """Everything that answers on one address."""

    def __init__(
        self, state: ArmState, board: Blackboard, host: str, rng: np.random.Generator
    ) -> None:
        """Put the parts together; nothing is opened."""
        self.arm = state
        self.faults = Faults()
        self.controller = Controller(state, board)
        sensors = Sensors(state, board, rng)
        self.rtde = RtdeLinks(state, sensors, self.faults, self.controller.step)
        self.controller.hears = self.rtde.hears
        model = state.kinematics.arm.name
        self.dashboard = Dashboard(self.controller, self.faults, model)
        self._host = host
        self._listening: asyncio.Server | None = None
        self._others: list[asyncio.Server] = []

    async def open(self) -> None:
        """Listen.

        Raises:
            DeviceError: an address is in use, or is none of this computer's.
        """
        self._others = [await self._listen(self._run_script, SCRIPT)]
        if self.arm.version[0] < _POLYSCOPE_X:
            self._others.append(await self._listen(self.dashboard.run, DASHBOARD))
        await self.accept(True)

    async def accept(self, on: bool) -> None:
        """Take new RTDE clients, or refuse them; those that are connected stay."""
        if on and self._listening is None:
            self._listening = await self._listen(self._run_rtde, RTDE)
        elif not on and self._listening is not None:
            closing, self._listening = self._listening, None
            loop = asyncio.get_running_loop()
            for door in closing.sockets:
                loop.remove_reader(door)
            # Who has just been let in gets a link first: asyncio forgets him with the server.
            await asyncio.sleep(0)
            closing.close()

    async def run(self) -> None:
        """Keep the controller going, for ever."""
        motion = self.arm.trajectory
        while True:
            self.controller.step()
            now = time.monotonic()
            self.rtde.send(now)
            wait = _STILL
            if motion.moving:
                wait = min(_MOVING, self.arm.clock.real(motion.left))
            wait = min(wait, self.rtde.due(now) - time.monotonic())
            await asyncio.sleep(max(0.0, wait))

    async def _listen(self, client: Any, port: int) -> asyncio.Server:
        try:
            return await asyncio.start_server(client, self._host, port, limit=_LINE)
        except OSError as error:
            raise DeviceError(
                f"simulated arm: {self._host}:{port} is in use or cannot be had "
                f"({error.strerror}); each simulated arm needs an address 127.x.y.z of its own"
            ) from None

    async def _run_rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await RtdeLink(self.rtde, reader, writer).run()

    async def _run_script(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        stream = ScriptStream()
        try:
            while data := await reader.read(_LINE):
                for text in stream.feed(data):
                    self.controller.run(text)
                self.controller.step()
        except OSError:
            pass
        finally:
            writer.close()


def read_version(text: str) -> Version:
    """Return the four numbers of a PolyScope version such as 5.11.6.1010327.

    Raises:
        InputError: it is something else.
    """
    parts = text.split(".")
    if len(parts) == 4 and all(part.isascii() and part.isdigit() for part in parts):
        a, b, c, d = map(int, parts)
        return a, b, c, d
    raise InputError(f"version {text!r}; valid: four numbers, e.g. 5.11.6.1010327")
