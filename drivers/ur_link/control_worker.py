"""Child process that holds the control interface of ur_rtde and serves the robot's watchdog.

During a motion the controller stops its program, and so the arm, after 0.1 s without a sign of
life: when this process ends or hangs, or when the link breaks. At rest it waits for 1 s, so that a
busy computer does not lose control needlessly. This process stops the arm when its parent has not
renewed the `lease` of a motion in time. Only asynchronous motions are used: a synchronous one
returns from a broken link after 301 s.
"""

import os
import time
from typing import Any

from hilcal.drivers.ur_link import relay
from hilcal.drivers.ur_link.worker import Line, answered, outliving, start, words

WATCHDOG_HZ = 10.0
REST_HZ = 1.0
KICK_S = 0.02
TAKING_S = 8.0  # longest taking of control after the end of the parent, s
LATE_S = 0.8 / WATCHDOG_HZ  # a longer pause between two kicks may trigger the watchdog, s


class ControlInterface:
    """The control interface, its watchdog and the lease of a motion."""

    def __init__(self, link: Any, lease: float) -> None:
        """Arm the watchdog of an open interface."""
        self._link, self._lease = link, lease
        self._until: float | None = None
        self._deceleration = 2.0
        self._expired = False
        self._late = 0.0
        self._kicked = time.monotonic()
        self._guard(REST_HZ)

    def kick(self) -> None:
        """Kick the robot's watchdog; stop the arm if the lease of its motion has expired."""
        now = time.monotonic()
        if now - self._kicked >= KICK_S:
            if now - self._kicked > LATE_S:
                self._late = max(self._late, now - self._kicked)
            self._kicked = now
            self._link.kickWatchdog()
        if self._until is not None and now > self._until:
            self._until, self._expired = None, True
            self._link.stopJ(self._deceleration, True)

    @property
    def due(self) -> float:
        """Time until the next kick, s."""
        return self._kicked + KICK_S - time.monotonic()

    def do(self, request: dict[str, Any]) -> dict[str, Any]:
        """Carry out a request."""
        op = request["op"]
        if op == "alive":
            if self._until is not None:
                self._until = time.monotonic() + self._lease
        elif op == "move":
            self._deceleration = request["deceleration"]
            self._expired, self._late = False, 0.0
            self._guard(WATCHDOG_HZ)
            done = self._link.moveJ(request["q"], request["speed"], request["acceleration"], True)
            self._until = time.monotonic() + self._lease if done else None
            return {"done": bool(done)}
        elif op == "rest":
            self._until = None
            self._guard(REST_HZ)
        elif op == "stop":
            self._until = None
            self._link.stopJ(request["deceleration"], True)
        elif op == "payload":
            return {"done": bool(self._link.setPayload(request["mass"], request["com"]))}
        elif op == "bye":
            self._link.stopScript()
        return {"expired": self._expired, "late": self._late}

    def _guard(self, hz: float) -> None:
        """Set the rate of signs of life below which the controller stops its program."""
        if not self._link.setWatchdog(hz):
            raise RuntimeError("the controller takes no watchdog")


def serve(line: Line, control: ControlInterface) -> None:
    """Answer requests and kick the watchdog, until `bye` or the end of the parent."""
    while True:
        request = line.next(control.due)
        if request is not None and answered(line, request, control.do) and request["op"] == "bye":
            os._exit(0)  # the library's own end takes another 0.5 s
        control.kick()


def main() -> None:
    """Take control, report it, then answer requests."""
    line, (host, hz, lease, relayed, upper) = start()
    try:
        from rtde_control import RTDEControlInterface as Interface

        flags = (
            int(Interface.FLAG_UPLOAD_SCRIPT)
            | int(Interface.FLAG_NO_EXT_FT)
            | (int(Interface.FLAG_UPPER_RANGE_REGISTERS) if int(upper) else 0)
        )
        if int(relayed):
            _relay, host = relay.start(host)  # referenced, so that its input stays open
        # Between upload and watchdog only this process can end the robot's program.
        with outliving(TAKING_S):
            control = ControlInterface(Interface(host, float(hz), flags), float(lease))
    except Exception as error:  # any failure is reported to the parent
        line.answer(0, error=words(error))
        return
    line.answer(0)
    serve(line, control)


if __name__ == "__main__":
    main()
