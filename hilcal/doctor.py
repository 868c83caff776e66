"""Checks of this computer before a campaign: what is installed, clock, disk, ports, network."""

import ctypes
import grp
import importlib
import os
import platform
import re
import shutil
import socket
import sqlite3
import stat
import statistics
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Literal

State = Literal["ok", "warning", "problem"]


@dataclass(frozen=True, slots=True)
class Finding:
    """The result of one check."""

    topic: str  # "program", "computer", "serial ports", "network" or "cell"
    name: str  # of the checked item, e.g. "clock"
    state: State  # "ok"; "warning": a campaign may suffer; "problem": no campaign runs
    said: str  # description of the state
    mend: str = ""  # remedy; empty if none is needed


COMPUTER = partial(Finding, "computer")
PROGRAM = partial(Finding, "program")
PORT = partial(Finding, "serial ports")
NETWORK = partial(Finding, "network")
LEAST_FREE = 1e9  # bytes; the recordings of a campaign take up to 0.1 GB
SLOW_WRITE = 0.1  # duration of a durable write that slows a campaign, s; a reading takes 1 s
LEAST_MEMORY = 2e9  # bytes, for large campaigns (12,000 readings took 1.84 GB)
FIRST_DAY = datetime(2026, 1, 1).astimezone()  # a clock before this day has never been set
ON_NETWORK = ("nfs", "nfs4", "cifs", "smb3", "9p", "fuse.sshfs")
"""File systems on which SQLite's locks are unreliable (SQLite FAQ, question 5)."""
_TIME_ERROR, _WRITES = 5, 9
MIN_PYTHON = (3, 11)
DISTRIBUTION = "hilcal"
NATIVE = {"pin": "pinocchio", "ur-rtde": "rtde_control", "rerun-sdk": "rerun", "numba": "numba"}
"""Modules of packages with compiled parts, which fail on other processors."""
GROUPS = {
    "hilcal.arms": "arms",
    "hilcal.trackers": "trackers",
    "hilcal.force_sensors": "force sensors",
    "hilcal.operators": "operators",
}
NOT_FOR_USERS = ("all", "dev", "docs", "release")  # Extras that no command needs
MAX_LATENCY_MS = 1
"""Largest latency timer, for which the driver holds bytes back; default 16 (FTDI, AN232B-04)."""
INTERFERING_SERVICES = {
    "ModemManager": "it talks to serial adapters that are plugged in",
    "brltty": "it takes adapters for Braille displays",
}
"""Services that open adapters of other programs."""
SECONDS = 1.0  # Longest time for an answer; a choice: in the network of a cell it takes 1 ms
SLOW_S = 0.02  # s; a connection to a controller in the same room is faster; a choice
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_BELOW = re.compile(r"""python_version\s*<\s*["'](\d+)\.(\d+)["']""")
_EXTRA = re.compile(r"""extra\s*==\s*["']([^"']+)["']""")


def kernel_clock() -> int | None:
    """Return the kernel's clock state by adjtimex(2); None if it is not available."""
    try:
        ask = ctypes.CDLL(None).adjtimex
    except (OSError, AttributeError):
        return None
    buffer = ctypes.create_string_buffer(struct.calcsize("64q"))  # all zero: changes nothing
    status = int(ask(buffer))
    return None if status < 0 else status


def computer(folder: Path) -> tuple[Finding, ...]:
    """Return the findings on this computer and on the folder of campaigns."""
    return (clock(), *disk(folder), _memory(), load())


def clock(
    now: Callable[[], datetime] = lambda: datetime.now().astimezone(),
    state: Callable[[], int | None] = kernel_clock,
) -> Finding:
    """Return whether the clock is set and synchronised; readings and revisions have its time."""
    time_now, status = now(), state()
    text = time_now.strftime("%Y-%m-%d %H:%M:%S %Z")
    mend = "switch time synchronisation on: timedatectl set-ntp true"
    if time_now < FIRST_DAY:
        return COMPUTER("clock", "problem", f"{text}: it was never set", mend)
    if status is None:
        return COMPUTER("clock", "ok", f"{text}; whether it is synchronised is not known")
    if status == _TIME_ERROR:
        return COMPUTER("clock", "warning", f"{text}, not synchronised", mend)
    return COMPUTER("clock", "ok", f"{text}, synchronised")


def disk(folder: Path) -> Iterator[Finding]:
    """Yield the findings on durable and fast storage of campaigns in a folder."""
    name = f"disk of {folder}"
    if not folder.is_dir():
        mend = "make it, or name another with --folder"
        yield COMPUTER(name, "problem", "there is no such folder", mend)
        return
    free = shutil.disk_usage(folder).free
    little = free < LEAST_FREE
    mend = "free some space before a campaign" if little else ""
    yield COMPUTER(name, "warning" if little else "ok", f"{free / 1e9:.1f} GB free", mend)
    kind = _file_system(folder)
    if kind in ON_NETWORK:
        text = f"a file system on the network ({kind}): its locks are not reliable"
        mend = "measure into a folder of a local disk, and copy the file afterwards"
        yield COMPUTER("file system", "warning", text, mend)
    try:
        seconds = _durable_write(folder)
    except (OSError, sqlite3.Error) as error:
        mend = f"make {folder} writable, or name another with --folder"
        yield COMPUTER("writing", "problem", f"fails: {error}", mend)
    else:
        text, slow = f"a reading is stored durably in {1e3 * seconds:.1f} ms", seconds > SLOW_WRITE
        mend = "measure into a folder of a local disk" if slow else ""
        yield COMPUTER("writing", "warning" if slow else "ok", text, mend)


def _file_system(folder: Path, mounts: Path = Path("/proc/mounts")) -> str:
    """Return the type of the file system of a folder; empty if unknown."""
    try:
        lines = [line.split() for line in mounts.read_text(encoding="utf-8").splitlines()]
    except OSError:
        return ""
    path = folder.resolve()
    parents = {str(path), *map(str, path.parents)}
    matches = [fields for fields in lines if len(fields) > 2 and fields[1] in parents]
    return max(matches, key=lambda fields: len(fields[1]))[2] if matches else ""


def _durable_write(folder: Path) -> float:
    """Return the median time of a small transaction, with the settings of a campaign file, s."""
    times = []
    with tempfile.TemporaryDirectory(prefix=".hilcal-doctor-", dir=folder) as inside:
        connection = sqlite3.connect(Path(inside) / "try.sqlite", isolation_level=None)
        try:
            connection.execute("PRAGMA synchronous = EXTRA")
            connection.execute("CREATE TABLE reading (bytes BLOB)")
            for _ in range(_WRITES):
                start = time.perf_counter()
                connection.execute("INSERT INTO reading VALUES (zeroblob(1000))")
                times.append(time.perf_counter() - start)
        finally:
            connection.close()
    return statistics.median(times)


def _memory() -> Finding:
    try:
        pages = (os.sysconf(name) for name in ("SC_AVPHYS_PAGES", "SC_PHYS_PAGES"))
        free, total = (n * os.sysconf("SC_PAGE_SIZE") for n in pages)
    except (ValueError, OSError):
        return COMPUTER("memory", "ok", "not known")
    text = f"{total / 1e9:.1f} GB, of which {free / 1e9:.1f} GB unused"
    little = total < LEAST_MEMORY
    mend = "campaigns of thousands of readings need another computer" if little else ""
    return COMPUTER("memory", "warning" if little else "ok", text, mend)


def load(measured: Callable[[], tuple[float, float, float]] = os.getloadavg) -> Finding:
    """Return whether other programs occupy the processors; an arm needs commands in time."""
    cores, busy = os.cpu_count() or 1, measured()[0]
    text, mend = f"{cores}; {busy:.1f} of them were wanted on average in the last minute", ""
    if busy > cores:
        mend = "end other programs: the arm stops by itself where this program is 0.1 s late"
    return COMPUTER("processors", "warning" if mend else "ok", text, mend)


def program(version: str) -> tuple[Finding, ...]:
    """Return the findings on the installed hilcal of this version, Python, packages and drivers."""
    old = sys.version_info < MIN_PYTHON
    python = f"{platform.python_version()} at {sys.executable}, {platform.platform()}"
    mend = "install Python 3.11 or later" if old else ""
    return (
        PROGRAM("hilcal", "ok", f"version {version}"),
        PROGRAM("Python", "problem" if old else "ok", python, mend),
        *packages(metadata.requires(DISTRIBUTION) or ()),
        *_drivers(),
    )


def packages(requirements: Iterable[str]) -> tuple[Finding, ...]:
    """Return whether the packages of a distribution are installed and load.

    Requirements are those of its metadata, e.g. 'pyarrow>=17; extra == "tables"'. A requirement
    for earlier Pythons only has no wheel for this one.
    """
    installed: dict[str, str] = {}  # each once, also where several extras require it
    out = []
    lacking: dict[str, list[str]] = {}
    for requirement in requirements:
        match, extra = _NAME.match(requirement), _EXTRA.search(requirement)
        below = _BELOW.search(requirement)
        if match is None or (extra is not None and extra[1] in NOT_FOR_USERS):
            continue
        name = match[0]
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            if extra is not None:
                lacking.setdefault(extra[1], []).append(name)
            elif below is not None and sys.version_info[:2] >= tuple(map(int, below.groups())):
                python = ".".join(map(str, sys.version_info[:2]))
                text = f"has no wheel for Python {python}; the driver that needs it says so"
                mend = "use Python 3.11 or 3.12 for the computer of a cell with such a device"
                out.append(PROGRAM(name, "warning", text, mend))
            else:
                mend = f"install it: pip install '{requirement}'"
                out.append(PROGRAM(name, "problem", "is not installed", mend))
            continue
        try:
            if name in NATIVE:
                importlib.import_module(NATIVE[name])
        except Exception as error:
            why = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
            mend = f"install it again: pip install --force-reinstall {name}=={version}"
            out.append(PROGRAM(name, "problem", f"{version} does not load: {why}", mend))
        else:
            installed[name] = f"{name} {version}"
    for extra_name, names in lacking.items():
        text = f"{', '.join(names)}: not installed; what needs them says so"
        mend = f'where it is wanted: pip install "hilcal[{extra_name}]"'
        out.append(PROGRAM(f"optional: {extra_name}", "ok", text, mend))
    return (PROGRAM("packages", "ok", ", ".join(installed.values())), *out)


def _drivers() -> Iterator[Finding]:
    for group, devices in GROUPS.items():
        names = []
        for point in metadata.entry_points(group=group):
            try:
                point.load()
            except Exception as error:
                text = f"{point.value} does not load ({type(error).__name__}: {error})"
                mend = f"repair or remove the package that brings {point.name}"
                yield PROGRAM(f"driver {point.name}", "warning", text, mend)
            else:
                names.append(point.name)
        yield PROGRAM(f"drivers of {devices}", "ok", ", ".join(sorted(names)) or "none")


def adapters() -> dict[str, str]:
    """Return the descriptions of connected adapters, by path of the port."""
    from serial.tools import list_ports  # takes a while

    return {port.device: port.description for port in sorted(list_ports.comports())}


def serial_ports(
    needed: Mapping[str, str], connected: Mapping[str, str], root: Path = Path("/")
) -> tuple[Finding, ...]:
    """Return the findings on serial ports.

    `needed` has the path of the port of each device of the cell, `connected` is that of `adapters`;
    the kernel shows its devices and processes in dev, sys and proc of `root`.
    """
    names, proc = permanent_names(root), root / "proc"
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
        out.extend(_port(name, path, description, path in used, root))
    if not needed and not connected:
        out.append(PORT("adapters", "ok", "none is plugged in"))
    if connected:
        running = {_program(proc, number) for number in _numbers(proc)}
        for name, why in INTERFERING_SERVICES.items():
            if name in running:
                mend = f"sudo systemctl stop {name}"
                out.append(PORT(name, "warning", f"it runs: {why}", mend))
    return tuple(out)


def _port(name: str, path: str, about: str, needed: bool, root: Path) -> Iterator[Finding]:
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
    holder = _holder(status.st_rdev, root / "proc")
    if holder:
        mend = "end that program before a campaign"
        yield PORT(name, "warning", f"{text}; {holder} has it open", mend)
    timer, late = root / "sys/bus/usb-serial/devices" / Path(path).name / "latency_timer", 0
    with suppress(OSError, ValueError):
        late = int(timer.read_text(encoding="ascii"))
    if late > MAX_LATENCY_MS:
        slow = f"{text}; holds answers back for up to {late} ms (latency timer)"
        yield PORT(name, "warning", slow, f"echo {MAX_LATENCY_MS} | sudo tee {timer}")
    elif not holder:
        yield PORT(name, "ok", f"{text}; free, and you may use it")


def permanent_names(root: Path = Path("/")) -> dict[str, str]:
    """Return the permanent names of adapters, by path of the port."""
    try:
        links = sorted((root / "dev/serial/by-id").iterdir())
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


def reachable(host: str, services: Mapping[int, str]) -> list[Finding]:
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
            with socket.create_connection((str(address), port), SECONDS):
                took = time.monotonic() - start
        except TimeoutError:
            mend = "check cable, address and network of the cell; is the controller switched on?"
            out.append(NETWORK(name, "problem", f"no answer in {SECONDS:g} s", mend))
        except OSError as error:
            mend = "check the address, and that the service is enabled on the controller"
            out.append(NETWORK(name, "problem", f"{error.strerror or error}", mend))
        else:
            mend = "connect by cable, without other networks between" if took > SLOW_S else ""
            state: State = "warning" if mend else "ok"
            out.append(NETWORK(name, state, f"answers in {1e3 * took:.1f} ms", mend))
    return out
