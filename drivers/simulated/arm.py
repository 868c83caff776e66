"""The simulated arm of any make: driver `hilcal.drivers.simulated.arm:open_arm`.

For rehearsals: the controller is `hilcal.drivers.simulated.arm_server`, which moves
the commanded arm of a simulated cell, of any number of joints, in real time. Arms of
Universal Robots have a simulated controller of their own, which speaks their protocols.
"""

import contextlib
import time
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.config import CellConfig
from hilcal.drivers.simulated import admin
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.devices import ArmSample, Report
from hilcal.types import Floats

_STOPPED_S = 5.0
"""In which a stopped arm has to stand, real s."""


class SimulatedArm:
    """See `hilcal.measuring.devices.ArmDevice`."""

    def __init__(self, socket: Path) -> None:
        """Use the admin line of the simulated controller; `open_arm` makes one."""
        self._socket, self._ours = socket, False

    def report(self) -> Report:
        """Say which arm answers; moves nothing."""
        now = self._ask("sample")
        problems = () if now["safety"] == "normal" else (f"it is in a {now['safety']}",)
        facts = (("joints", str(len(now["q"]))), ("payload", f"{now['payload']:g} kg"))
        return Report("arm", "simulated arm", facts, problems, (("joints", len(now["q"])),))

    def sample(self) -> ArmSample:
        """Return what the controller knows now; currents and tool forces are zero."""
        now = self._ask("sample")
        still = np.zeros(len(now["q"]))
        return ArmSample(
            host_ns=time.monotonic_ns(),
            timestamp=float(now["timestamp"]),
            q=np.array(now["q"]),
            q_target=np.array(now["q_target"]),
            qd=np.array(now["qd"]),
            target_moment=np.array(now["torque"]),
            current=still,
            target_current=still,
            joint_temperature=np.array(now["joint_temperature"]),
            tcp_pose=np.array(now["flange"]),
            tcp_force=np.zeros(6),
            ft_raw_wrench=None,
            payload=float(now["payload"]),
            payload_com=np.array(now["payload_com"]),
            speed_scaling=1.0,
            safety=str(now["safety"]),
        )

    def take_control(self, mass: float, com: Floats) -> None:
        """Become the one who commands the arm, and set its payload, kg and m."""
        self._ours = True
        self.set_payload(mass, com)

    def set_payload(self, mass: float, com: Floats) -> None:
        """Set the payload, kg and m (flange axes)."""
        self._ask("payload", mass=float(mass), com=np.asarray(com, dtype=float).tolist())

    def start_move(self, q: Floats, speed: float, acceleration: float) -> None:
        """Start a straight line in joint space; `speed` is that of the leading joint."""
        if not self._ours:
            raise DeviceError("arm: a motion without control; call take_control first")
        self._ask("move", q=q.tolist(), speed=float(speed), acceleration=float(acceleration))

    def moving(self) -> bool:
        """Whether the motion goes on.

        Raises:
            DeviceError: the arm was stopped by its safety system.
        """
        now = self._ask("sample")
        if now["safety"] != "normal":
            raise DeviceError(f"arm: {now['safety']}; release it, then go on with --resume")
        return bool(now["moving"])

    def stop(self) -> None:
        """Stop the arm and wait until it stands.

        Raises:
            DeviceError: it does not stand in time.
        """
        self._ask("stop")
        end = time.monotonic() + _STOPPED_S
        while self._ask("sample")["moving"]:
            if time.monotonic() > end:
                raise DeviceError(f"arm: it has not stopped within {_STOPPED_S:g} s")
            time.sleep(0.01)

    def close(self) -> None:
        """Stop the arm where it was under control."""
        if self._ours:
            with contextlib.suppress(DeviceError):
                self._ask("stop")
        self._ours = False

    def _ask(self, op: str, **arguments: Any) -> Any:
        try:
            return admin.ask(self._socket, op, **arguments)
        except DeviceError as error:
            raise DeviceError(f"arm: {error}") from None


def open_arm(config: CellConfig) -> SimulatedArm:
    """Return the simulated arm of a configuration, whose [robot] options have its `socket`.

    Raises:
        InputError: the option is missing: the arm exists in a simulated cell alone.
        DeviceError: it does not answer.
    """
    socket = config.robot.options.get("socket")
    if not isinstance(socket, str) or not socket:
        raise InputError(
            "[robot] options lacks socket: the simulated arm lives in a simulated cell "
            "(hilcal run --rehearse, hilcal simulate); a real arm needs the driver of its maker"
        )
    arm = SimulatedArm(Path(socket))
    arm.sample()
    return arm
