"""Checks of serial adapters and of the network: presence, permissions and delays."""

import grp
import os
import re
import socket
import stat
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from serial.tools import list_ports

from hilcal.doctor.computer import Finding, State

PORT = partial(Finding, "serial ports")
NETWORK = partial(Finding, "network")
LATE_MS = 1
"""Largest latency timer for answers within a few milliseconds, ms. The timer is the time for which
the driver holds bytes back; its default is 16 (FTDI, AN232B-04)."""
MEDDLERS = {
    "ModemManager": "it talks to serial adapters that are plugged in",
    "brltty": "it takes adapters for Braille displays",
}
"""Services that open adapters of other programs."""
SECONDS = 1.0
"""Most time for an answer, s. A choice: on a cell's own network it takes a millisecond."""
SLOW = 0.02  # longer than any connection to a controller in the same room takes, s. A choice


@dataclass(frozen=True, slots=True)
class System:
    """Folders in which the kernel shows its devices and processes."""

    dev: Path = Path("/dev")
    sys: Path = Path("/sys")
    proc: Path = Path("/proc")


def adapters() -> dict[str, str]:
    """Return the descriptions of connected adapters, by path of the port."""
    return {port.device: port.description for port in sorted(list_ports.comports())}


def serial_ports(
    needed: Mapping[str, str], connected: Mapping[str, str], system: System | None = None
) -> tuple[Finding, ...]:
    """Return the findings on serial ports.

    `needed` has the path of the port of each device of the cell, `connected` is that of `adapters`.
    """
    system = system or System()
    names = _by_id(system.dev)
    used = {str(Path(path).resolve()): device for device, path in needed.items()}
    out = []
    for device, path in needed.items():
        if not Path(path).exists():
            ports = ", ".join(names.get(p, p) for p in connected) or "none"
            mend = f"plug its adapter in, or name another port in the cell; ports now: {ports}"
            out.append(PORT(device, "problem", f"there is no {path}", mend))
    every = {str(Path(p).resolve()): about for p, about in connected.items()}
    every.update({p: every.get(p, "") for p in used if Path(p).exists()})
    for path, description in sorted(every.items()):
        name = ": ".join(filter(None, (used.get(path), names.get(path, path))))
        out.extend(_port(name, path, description, path in used, system))
    if not needed and not connected:
        out.append(PORT("adapters", "ok", "none is plugged in"))
    if connected:
        running = {_program(system.proc, number) for number in _numbers(system.proc)}
        for name, why in MEDDLERS.items():
            if name in running:
                mend = f"sudo systemctl stop {name}"
                out.append(PORT(name, "warning", f"it runs: {why}", mend))
    return tuple(out)


def _port(name: str, path: str, about: str, needed: bool, system: System) -> Iterator[Finding]:
    worse: State = "problem" if needed else "warning"
    text = " ".join(filter(None, (path if path not in name else "", about))) or "there"
    status = os.stat(path)
    if not stat.S_ISCHR(status.st_mode):
        yield PORT(name, worse, f"{path} is no serial port", "name another in the cell")
        return
    if not os.access(path, os.R_OK | os.W_OK):
        group = str(status.st_gid)
        with suppress(KeyError):
            group = grp.getgrgid(status.st_gid).gr_name
        mend = f"sudo usermod -aG {group} $USER, then log in again"
        yield PORT(name, worse, f"{text}; you have no right to use it", mend)
        return
    holder = _holder(status.st_rdev, system.proc)
    if holder:
        mend = "end that program before a campaign"
        yield PORT(name, "warning", f"{text}; {holder} has it open", mend)
    timer, late = system.sys / "bus/usb-serial/devices" / Path(path).name / "latency_timer", 0
    with suppress(OSError, ValueError):
        late = int(timer.read_text(encoding="ascii"))
    if late > LATE_MS:
        slow = f"{text}; holds answers back for up to {late} ms (latency timer)"
        yield PORT(name, "warning", slow, f"echo {LATE_MS} | sudo tee {timer}")
    elif not holder:
        yield PORT(name, "ok", f"{text}; free, and you may use it")


def _by_id(dev: Path) -> dict[str, str]:
    """Return the permanent names of adapters, by path of the port."""
    try:
        links = sorted((dev / "serial" / "by-id").iterdir())
        return {str(link.resolve()): str(link) for link in links}
    except OSError:
        return {}


def _holder(device: int, proc: Path) -> str:
    """Return the other process that has a device open, if this user may see it; else empty."""
    for number in _numbers(proc):
        if number == os.getpid():
            continue
        with suppress(OSError):
            for file in list((proc / str(number) / "fd").iterdir()):
                with suppress(OSError):
                    in_dev = str(file.readlink()).startswith("/dev/")
                    if in_dev and file.stat().st_rdev == device:
                        return f"{_program(proc, number)} (process {number})"
    return ""


def _numbers(proc: Path) -> list[int]:
    try:
        return sorted(int(p.name) for p in proc.iterdir() if re.fullmatch(r"\d+", p.name))
    except OSError:
        return []


def _program(proc: Path, number: int) -> str:
    try:
        return (proc / str(number) / "comm").read_text(encoding="utf-8").strip()
    except OSError:
        return "a program"


def reachable(host: str, services: Mapping[int, str], seconds: float = SECONDS) -> list[Finding]:
    """Return whether each service, by TCP port, accepts a connection in time; nothing is sent."""
    try:
        address = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][4][0]
    except (OSError, UnicodeError) as error:
        mend = "check the address in the cell, or name the host in /etc/hosts"
        text = f"its name is not known ({getattr(error, 'strerror', None) or error})"
        return [NETWORK(host, "problem", text, mend)]
    out = []
    for port, service in services.items():
        name, start = f"{service}, {host} port {port}", time.monotonic()
        try:
            with socket.create_connection((str(address), port), seconds):
                took = time.monotonic() - start
        except TimeoutError:
            mend = "check cable, address and network of the cell; is the controller switched on?"
            out.append(NETWORK(name, "problem", f"no answer in {seconds:g} s", mend))
        except OSError as error:
            mend = "check the address, and that the service is enabled on the controller"
            out.append(NETWORK(name, "problem", f"{error.strerror or error}", mend))
        else:
            mend = "connect by cable, without other networks between" if took > SLOW else ""
            state: State = "warning" if mend else "ok"
            out.append(NETWORK(name, state, f"answers in {1e3 * took:.1f} ms", mend))
    return out
