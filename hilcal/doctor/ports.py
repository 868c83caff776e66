"""What was found: serial adapters and the network, who may use them, how late they answer."""

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
"""Latency timer that answers within a few milliseconds need, ms. The driver's default is 16: it
holds bytes back for so long (FTDI, AN232B-04)."""
MEDDLERS = {
    "ModemManager": "it talks to serial adapters that are plugged in",
    "brltty": "it takes adapters for Braille displays",
}
"""Services that open adapters of others."""
SECONDS = 1.0
"""How long an answer may take, s. A choice: on a cell's own network it takes a millisecond."""
SLOW = 0.02  # time of connecting that a controller in the same room never needs, s. A choice


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
            out.append(PORT(what, "problem", f"there is no {path}", mend))
    every = {str(Path(p).resolve()): about for p, about in found.items()}
    every.update({p: every.get(p, "") for p in used if Path(p).exists()})
    for path, description in sorted(every.items()):
        name = ": ".join(filter(None, (used.get(path), names.get(path, path))))
        out.extend(_port(name, path, description, path in used, at))
    if not wanted and not found:
        out.append(PORT("adapters", "ok", "none is plugged in"))
    if found:
        running = {_program(at.proc, number) for number in _numbers(at.proc)}
        for name, why in MEDDLERS.items():
            if name in running:
                mend = f"sudo systemctl stop {name}"
                out.append(PORT(name, "warning", f"it runs: {why}", mend))
    return tuple(out)


def _port(name: str, path: str, about: str, wanted: bool, at: System) -> Iterator[Finding]:
    worse: State = "problem" if wanted else "warning"
    said = " ".join(filter(None, (path if path not in name else "", about))) or "there"
    of = os.stat(path)
    if not stat.S_ISCHR(of.st_mode):
        yield PORT(name, worse, f"{path} is no serial port", "name another in the cell")
        return
    if not os.access(path, os.R_OK | os.W_OK):
        group = str(of.st_gid)
        with suppress(KeyError):
            group = grp.getgrgid(of.st_gid).gr_name
        mend = f"sudo usermod -aG {group} $USER, then log in again"
        yield PORT(name, worse, f"{said}; you have no right to use it", mend)
        return
    holder = _holder(of.st_rdev, at.proc)
    if holder:
        mend = "end that program before a campaign"
        yield PORT(name, "warning", f"{said}; {holder} has it open", mend)
    timer, late = at.sys / "bus/usb-serial/devices" / Path(path).name / "latency_timer", 0
    with suppress(OSError, ValueError):
        late = int(timer.read_text(encoding="ascii"))
    if late > LATE_MS:
        slow = f"{said}; holds answers back for up to {late} ms (latency timer)"
        yield PORT(name, "warning", slow, f"echo {LATE_MS} | sudo tee {timer}")
    elif not holder:
        yield PORT(name, "ok", f"{said}; free, and you may use it")


def _by_id(dev: Path) -> dict[str, str]:
    """Return the names that do not change when an adapter is replugged, by path of the port."""
    try:
        links = sorted((dev / "serial" / "by-id").iterdir())
        return {str(link.resolve()): str(link) for link in links}
    except OSError:
        return {}


def _holder(wanted: int, proc: Path) -> str:
    """Return which other process has a device open, as far as this user may see; else empty."""
    for number in _numbers(proc):
        if number == os.getpid():
            continue
        with suppress(OSError):
            for file in list((proc / str(number) / "fd").iterdir()):
                with suppress(OSError):
                    device = str(file.readlink()).startswith("/dev/")
                    if device and file.stat().st_rdev == wanted:
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
        said = f"its name is not known ({getattr(error, 'strerror', None) or error})"
        return [NETWORK(host, "problem", said, mend)]
    out = []
    for port, what in services.items():
        name, begun = f"{what}, {host} port {port}", time.monotonic()
        try:
            with socket.create_connection((str(address), port), seconds):
                took = time.monotonic() - begun
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
