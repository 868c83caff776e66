"""The child processes of the driver: `python -m hilcal.drivers.ur_link.children LIFE PARENT KIND`.

`receive` holds the receive interface of ur_rtde. A reading is returned only if it is new: the
controller's timestamp has to change within the `stale` seconds of the request. A connection that
the library reports proves nothing, because its getters repeat the last values of a lost one; a
disconnection that it reports is real.

`control` holds the control interface and serves the robot's watchdog. During a motion the
controller stops its program, and so the arm, after 0.1 s without a sign of life: when this process
ends or hangs, or when the link breaks. At rest it waits for 1 s, so that a busy computer does not
lose control needlessly. This process stops the arm when its parent has not renewed the `lease` of a
motion in time. Only asynchronous motions are used: a synchronous one returns from a broken link
after 301 s.

`torques` receives the output `actual_current_as_torque` (PolyScope 5.23, PolyScope X 10.11 and
later), for which the library has no getter, on a separate RTDE connection, which commands nothing,
and answers with the mean since the last request.

The library can hold the interpreter's lock for ever, so that no thread and no signal handler in
Python can notice the end of the parent. The kernel therefore ends the child: the parent holds the
writing end of a pipe on which nothing is sent; when the parent ends, in any way, the pipe closes
and SIGIO ends the child (fcntl(2), O_ASYNC; signal(7)). Unlike PR_SET_PDEATHSIG this does not
depend on the thread that started the child.
"""

import contextlib
import fcntl
import json
import os
import select
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

from hilcal.drivers.ur_link import probe, relay

_NICE = -10
Request = dict[str, Any]


def end_with_parent(life: int, parent: int) -> None:
    """End this process with the parent, whose end closes the pipe `life`; ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGIO, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGIO})
    fcntl.fcntl(life, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(life, fcntl.F_SETFL, fcntl.fcntl(life, fcntl.F_GETFL) | os.O_ASYNC)
    if select.select([life], [], [], 0)[0] or os.getppid() != parent:
        os._exit(0)  # the parent has ended meanwhile


@contextlib.contextmanager
def outliving(seconds: float) -> Iterator[None]:
    """Finish an indivisible task although the parent ends meanwhile.

    The end of this process is postponed by at most `seconds`; then SIGALRM, which no lock delays,
    ends the process, finished or not.
    """
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGIO})
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGIO})


class Line:
    """Requests from the parent and answers, over the socket at standard input."""

    def __init__(self, parent: int) -> None:
        self._parent = parent
        self._socket = socket.socket(fileno=os.dup(sys.stdin.fileno()))
        self._buffer = b""

    def next(self, seconds: float) -> Request | None:
        """Return the next request, None if none comes in time; at the end of the line, exit."""
        while b"\n" not in self._buffer:
            if os.getppid() != self._parent:
                os._exit(0)
            if not select.select([self._socket], [], [], max(0.0, seconds))[0]:
                return None
            try:
                data = self._socket.recv(65536)
            except ConnectionError:
                data = b""
            if not data:
                os._exit(0)
            self._buffer += data
        request, _, self._buffer = self._buffer.partition(b"\n")
        out: Request = json.loads(request)
        return out

    def answer(self, number: int, **content: Any) -> None:
        """Answer the request with this number; 0 reports the start."""
        try:
            self._socket.sendall(json.dumps({"number": number, **content}).encode() + b"\n")
        except OSError:
            os._exit(0)

    def fail(self, number: int, error: Exception) -> None:
        """Answer that the request failed, in one line."""
        self.answer(number, error=" ".join(str(error).split()) or type(error).__name__)

    def carry_out(self, request: Request, do: Callable[[Request], dict[str, Any]]) -> bool:
        """Answer with the result or the exception of `do`; return whether it succeeded."""
        try:
            result = do(request)
        except Exception as error:
            self.fail(request["number"], error)
            return False
        self.answer(request["number"], **result)
        return True


Serve = Callable[[Line], None]

_NAMES = (
    "timestamp actual_q target_q actual_qd target_moment actual_current target_current "
    "joint_temperatures actual_TCP_pose actual_TCP_force robot_mode runtime_state "
    "safety_status_bits speed_scaling target_speed_fraction payload payload_cog ft_raw_wrench"
)
OUTPUTS = tuple(_NAMES.split())
"""The recorded outputs. The client library has a getter for each, e.g. `getActualTCPPose` for
`actual_TCP_pose`; a name unknown to it would shift the fields that follow."""
_POLL = 0.0005  # s
_TRIES = 20
_FIRST_S = 2.0  # longest wait for the first data, s


def _next_stamp(link: Any, seconds: float) -> float:
    """Wait until the controller's timestamp changes, and return it."""
    first, end = link.getTimestamp(), time.monotonic() + seconds
    while True:
        stamp = link.getTimestamp()
        if stamp != first:
            return float(stamp)
        if not link.isConnected():
            raise probe.LinkError("the RTDE connection is closed")
        if time.monotonic() > end:
            raise probe.LinkError(f"no new data over RTDE for {seconds:g} s")
        time.sleep(_POLL)


def _sample(link: Any, names: list[str], stale: float) -> dict[str, Any]:
    """Return all fields, read from a single packet."""
    getters = {
        name: "get" + "".join(part[0].upper() + part[1:] for part in name.split("_"))
        for name in names
    }
    stamp = _next_stamp(link, stale)
    for _ in range(_TRIES):
        fields = {name: getattr(link, getter)() for name, getter in getters.items()}
        host_ns = time.monotonic_ns()
        newest = link.getTimestamp()
        if newest == stamp == fields["timestamp"]:
            return {"host_ns": host_ns, "fields": fields}
        stamp = newest
    raise probe.LinkError("the RTDE data change faster than they can be read")


def _rate(link: Any, seconds: float, stale: float) -> dict[str, Any]:
    count, began = 0, time.monotonic()
    while time.monotonic() - began < seconds:
        _next_stamp(link, stale)
        count += 1
    return {"rate": count / (time.monotonic() - began)}


def receive(host: str, hz: str, outputs: str) -> Serve:
    """Connect to receive; then serve `sample` and `rate`."""
    import rtde_receive

    names = outputs.split(",")
    link = rtde_receive.RTDEReceiveInterface(host, float(hz), names, False, False)
    if not link.isConnected():
        raise probe.LinkError("the controller negotiates RTDE but sends no data")
    _next_stamp(link, _FIRST_S)

    def do(request: Request) -> dict[str, Any]:
        if request["op"] == "sample":
            return _sample(link, names, request["stale"])
        return _rate(link, request["window"], request["stale"])

    def serve(line: Line) -> None:
        while True:
            request = line.next(1.0)
            if request is not None:
                line.carry_out(request, do)

    return serve


WATCHDOG_HZ = 10.0
REST_HZ = 1.0
KICK_S = 0.02
TAKING_S = 8.0  # longest taking of control after the end of the parent, s
LATE_S = 0.8 / WATCHDOG_HZ  # a longer pause between two kicks may trigger the watchdog, s


class ControlInterface:
    """The control interface, its watchdog and the lease of a motion."""

    def __init__(self, link: Any, lease: float, relay: object) -> None:
        """Arm the watchdog of an open interface; `relay`: kept, so that its input stays open."""
        self._link, self._lease, self._relay = link, lease, relay
        self._until: float | None = None
        self._deceleration = 2.0
        self._expired = False
        self._late = 0.0
        self._kicked = time.monotonic()
        self._guard(REST_HZ)

    def serve(self, line: Line) -> None:
        """Answer requests and kick the watchdog, until `bye` or the end of the parent."""
        while True:
            request = line.next(self._kicked + KICK_S - time.monotonic())
            if request is not None and line.carry_out(request, self._do) and request["op"] == "bye":
                os._exit(0)  # the library's own end takes another 0.5 s
            self._kick()

    def _kick(self) -> None:
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

    def _do(self, request: Request) -> dict[str, Any]:
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


def control(host: str, hz: str, lease: str, relayed: str, upper_registers: str) -> Serve:
    """Take control; `relayed`, `upper_registers`: 1 or 0, see `supervision.UrController`."""
    from rtde_control import RTDEControlInterface as Interface

    flags = int(Interface.FLAG_UPLOAD_SCRIPT) | int(Interface.FLAG_NO_EXT_FT)
    if int(upper_registers):
        flags |= int(Interface.FLAG_UPPER_RANGE_REGISTERS)
    process = None
    if int(relayed):
        process, host = relay.start(host)
    # Between upload and watchdog only this process can end the robot's program.
    with outliving(TAKING_S):
        link = Interface(host, float(hz), flags)
        return ControlInterface(link, float(lease), process).serve


TORQUE = "actual_current_as_torque"
_CONNECT_S, _STALE_S = 4.0, 0.8
_MEMORY_S = 1.0
"""Between requests only the packets of the last second are kept; a choice."""
_PACKET = struct.Struct(">B7d")


def torques(host: str, hz: str) -> Serve:
    """Connect to a controller that has the output; then serve `mean`, until it ends the line."""
    stream = probe.stream(host, float(hz), ("timestamp", TORQUE), _CONNECT_S)

    def serve(line: Line) -> None:
        last, recent = -1.0, list[tuple[float, ...]]()
        pending: int | None = None
        with contextlib.suppress(probe.LinkError, struct.error):  # the parent notices the end
            while True:
                stream.extend(_STALE_S)
                _, stamp, *torque = _PACKET.unpack(probe.packet(stream))
                if stamp != last:
                    last = stamp
                    recent.append(tuple(torque))
                    del recent[: -round(_MEMORY_S * float(hz))]
                request = line.next(0.0) if pending is None else None
                pending = request["number"] if request is not None else pending
                if pending is not None and recent:
                    mean = [sum(values) / len(recent) for values in zip(*recent, strict=True)]
                    line.answer(pending, torque=mean)
                    pending = None
                    recent.clear()

    return serve


_KINDS: dict[str, Callable[..., Serve]]
_KINDS = {"receive": receive, "control": control, "torques": torques}


def main() -> None:
    """Connect, report it, then answer requests until the parent closes the line."""
    life, parent = int(sys.argv[1]), int(sys.argv[2])
    end_with_parent(life, parent)
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
    line, (kind, *arguments) = Line(parent), sys.argv[3:]
    connect = _KINDS[kind]
    try:
        serve = connect(*arguments)
    except Exception as error:  # any failure is reported to the parent
        line.fail(0, error)
        return
    line.answer(0)
    serve(line)


if __name__ == "__main__":
    main()
