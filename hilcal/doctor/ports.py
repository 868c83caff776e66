"""What was found: serial adapters and the network, who may use them, how late they answer."""

import grp
import os
import re
import socket
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from serial.tools import list_ports

from hilcal.doctor.computer import Finding, State

PORTS = "serial ports"
LATE_MS = 1
"""Latency timer that answers within a few milliseconds need, ms. The driver's default is 16: it
holds bytes back for so long (FTDI, AN232B-04)."""
MEDDLERS = {
    "ModemManager": "it talks to serial adapters that are plugged in",
    "brltty": "it takes adapters for Braille displays",
}
"""Services that open adapters of others."""
NETWORK = "network"
SECONDS = 1.0
"""How long an answer may take, s. A choice: on a cell's own network it takes a millisecond."""
SLOW = 0.02
"""Time of connecting that a controller in the same room never needs, s. A choice."""


@dataclass(frozen=True, slots=True)
class System:
    """Where the kernel shows its devices and processes."""

    dev: Path = Path("/dev")
    sys: Path = Path("/sys")
    proc: Path = Path("/proc")


def adapters() -> dict[str, str]:
    """Return what is plugged in, by the path of its port."""
    return {port.device: port.description for port in sorted(list_ports.comports())}


def serial_ports(
    wanted: Mapping[str, str], found: Mapping[str, str], system: System | None = None
) -> tuple[Finding, ...]:
    """Return the findings on serial ports.

    `wanted` is the path of the port by device of the cell, `found` what is plugged in, by port.
    """
    at = system or System()
    names, used = _by_id(at.dev), {str(Path(p).resolve()): what for what, p in wanted.items()}
    out = []
    for what, path in wanted.items():
        if not Path(path).exists():
            there = ", ".join(names.get(p, p) for p in found) or "none"
            mend = f"plug its adapter in, or name another port in the cell; ports now: {there}"
            said = f"there is no {path}"
            out.append(Finding(PORTS, what, "problem", said, mend))
    every = {str(Path(p).resolve()): about for p, about in found.items()}
    every.update({p: every.get(p, "") for p in used if Path(p).exists()})
    for path, description in sorted(every.items()):
        name = ": ".join(filter(None, (used.get(path), names.get(path, path))))
        out.extend(_port(name, path, description, path in used, at))
    if not wanted and not found:
        out.append(Finding(PORTS, "adapters", "ok", "none is plugged in"))
    if found:
        out.extend(_meddlers(at.proc))
    return tuple(out)


def _port(name: str, path: str, about: str, wanted: bool, at: System) -> Iterator[Finding]:
    worse: State = "problem" if wanted else "warning"
    said = " ".join(filter(None, (path if path not in name else "", about))) or "there"
    if not stat.S_ISCHR(os.stat(path).st_mode):
        yield Finding(PORTS, name, worse, f"{path} is no serial port", "name another in the cell")
        return
    if not os.access(path, os.R_OK | os.W_OK):
        group = _group(path)
        mend = f"sudo usermod -aG {group} $USER, then log in again"
        yield Finding(PORTS, name, worse, f"{said}; you have no right to use it", mend)
        return
    holder = _holder(path, at.proc)
    if holder:
        mend = "end that program before a campaign"
        yield Finding(PORTS, name, "warning", f"{said}; {holder} has it open", mend)
    timer = at.sys / "bus" / "usb-serial" / "devices" / Path(path).name / "latency_timer"
    try:
        late = int(timer.read_text(encoding="ascii"))
    except (OSError, ValueError):
        late = 0
    if late > LATE_MS:
        late_said = f"{said}; holds answers back for up to {late} ms (latency timer)"
        mend = f"echo {LATE_MS} | sudo tee {timer}"
        yield Finding(PORTS, name, "warning", late_said, mend)
    elif not holder:
        yield Finding(PORTS, name, "ok", f"{said}; free, and you may use it")


def _by_id(dev: Path) -> dict[str, str]:
    """Return the names that do not change when an adapter is replugged, by path of the port."""
    folder = dev / "serial" / "by-id"
    try:
        return {str(link.resolve()): str(link) for link in sorted(folder.iterdir())}
    except OSError:
        return {}


def _group(path: str) -> str:
    number = os.stat(path).st_gid
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def _holder(path: str, proc: Path) -> str:
    """Return which other process has a port open, as far as this user may see; else empty."""
    wanted = os.stat(path).st_rdev
    for number in _numbers(proc):
        if number == os.getpid():
            continue
        try:
            files: Iterable[Path] = list((proc / str(number) / "fd").iterdir())
        except OSError:
            continue
        for file in files:
            try:
                if str(file.readlink()).startswith("/dev/") and file.stat().st_rdev == wanted:
                    return f"{_program(proc, number)} (process {number})"
            except OSError:
                continue
    return ""


def _meddlers(proc: Path) -> Iterator[Finding]:
    running = {_program(proc, number) for number in _numbers(proc)}
    for name, why in MEDDLERS.items():
        if name in running:
            mend = f"sudo systemctl stop {name}"
            yield Finding(PORTS, name, "warning", f"it runs: {why}", mend)


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
        said = f"its name is not known ({getattr(error, 'strerror', None) or error})"
        return [Finding(NETWORK, host, "problem", said, mend)]
    out = []
    for port, what in services.items():
        name, begun = f"{what}, {host} port {port}", time.monotonic()
        try:
            with socket.create_connection((str(address), port), seconds):
                took = time.monotonic() - begun
        except TimeoutError:
            mend = "check cable, address and network of the cell; is the controller switched on?"
            out.append(Finding(NETWORK, name, "problem", f"no answer in {seconds:g} s", mend))
        except OSError as error:
            mend = "check the address, and that the service is enabled on the controller"
            out.append(Finding(NETWORK, name, "problem", f"{error.strerror or error}", mend))
        else:
            said = f"answers in {1e3 * took:.1f} ms"
            if took > SLOW:
                mend = "connect by cable, without other networks between"
                out.append(Finding(NETWORK, name, "warning", said, mend))
            else:
                out.append(Finding(NETWORK, name, "ok", said))
    return out
