"""This computer: clock, disk, memory, load, interpreter, packages and installed drivers."""

import ctypes
import importlib
import os
import platform
import re
import shutil
import sqlite3
import statistics
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Literal

State = Literal["ok", "warning", "problem"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at."""

    topic: str  # "program", "computer", "serial ports", "network" or "cell"
    name: str  # of the thing, e.g. "clock"
    state: State
    """"ok"; "warning" where a campaign runs but may suffer; "problem" where it does not."""
    said: str  # how it is, in words
    mend: str = ""  # what to do about it; empty where nothing is to be done


COMPUTER = "computer"
LEAST_FREE = 1e9
"""Free space below which a campaign may fill the disk, bytes: its recordings take up to 0.1 GB."""
SLOW_WRITE = 0.1
"""Durable write that makes a campaign slow, s: a reading takes about a second."""
LEAST_MEMORY = 2e9
"""Memory below which large campaigns do not fit, bytes (12,000 readings took 1.84 GB)."""
FIRST_DAY = datetime(2026, 1, 1).astimezone()
"""A clock before this day has never been set."""
ON_NETWORK = ("nfs", "nfs4", "cifs", "smb3", "9p", "fuse.sshfs")
"""File systems on which SQLite's locks are not to be relied on (SQLite FAQ, question 5)."""
_TIME_ERROR = 5
_WRITES = 9
PROGRAM = "program"
LOWEST = (3, 11)
DISTRIBUTION = "hilcal"
NATIVE = {"pin": "pinocchio", "ur-rtde": "rtde_control", "rerun-sdk": "rerun", "numba": "numba"}
"""Packages with compiled parts, by the module that loads them: these fail on other processors."""
GROUPS = {
    "hilcal.arms": "arms",
    "hilcal.trackers": "trackers",
    "hilcal.force_sensors": "force sensors",
    "hilcal.operators": "operators",
}
NOT_FOR_USERS = ("all", "dev", "docs", "release")
"""Extras that no command needs: `all` repeats the others."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_BELOW = re.compile(r"""python_version\s*<\s*["'](\d+)\.(\d+)["']""")
_EXTRA = re.compile(r"""extra\s*==\s*["']([^"']+)["']""")


def computer(folder: Path) -> tuple[Finding, ...]:
    """Return the findings on this computer, and on the folder where campaigns are stored."""
    return (clock(), *disk(folder), memory(), load())


def clock(
    now: Callable[[], datetime] = lambda: datetime.now().astimezone(),
    state: Callable[[], int | None] = lambda: _kernel_clock(),
) -> Finding:
    """Return whether the clock is set and kept right: readings and revisions bear its time."""
    is_now = now()
    said = is_now.strftime("%Y-%m-%d %H:%M:%S %Z")
    mend = "switch time synchronisation on: timedatectl set-ntp true"
    if is_now < FIRST_DAY:
        return Finding(COMPUTER, "clock", "problem", f"{said}: it was never set", mend)
    status = state()
    if status is None:
        return Finding(COMPUTER, "clock", "ok", f"{said}; whether it is synchronised is not known")
    if status == _TIME_ERROR:
        return Finding(COMPUTER, "clock", "warning", f"{said}, not synchronised", mend)
    return Finding(COMPUTER, "clock", "ok", f"{said}, synchronised")


def _kernel_clock() -> int | None:
    """Return the kernel's clock state by adjtimex(2); None where it has none."""
    try:
        ask = ctypes.CDLL(None).adjtimex
    except (OSError, AttributeError):
        return None
    buffer = ctypes.create_string_buffer(struct.calcsize("64q"))  # all zero: it only asks
    status = int(ask(buffer))
    return None if status < 0 else status


def disk(folder: Path) -> tuple[Finding, ...]:
    """Return whether campaigns can be stored in a folder, durably and fast."""
    name = f"disk of {folder}"
    if not folder.is_dir():
        mend = "make it, or name another with --folder"
        return (Finding(COMPUTER, name, "problem", "there is no such folder", mend),)
    out = []
    free = shutil.disk_usage(folder).free
    said = f"{free / 1e9:.1f} GB free"
    if free < LEAST_FREE:
        out.append(Finding(COMPUTER, name, "warning", said, "free some space before a campaign"))
    else:
        out.append(Finding(COMPUTER, name, "ok", said))
    kind = _file_system(folder)
    if kind in ON_NETWORK:
        said = f"a file system on the network ({kind}): its locks are not to be relied on"
        mend = "measure into a folder of a local disk, and copy the file afterwards"
        out.append(Finding(COMPUTER, "file system", "warning", said, mend))
    try:
        seconds = _durable_write(folder)
    except (OSError, sqlite3.Error) as error:
        mend = f"make {folder} writable, or name another with --folder"
        out.append(Finding(COMPUTER, "writing", "problem", f"fails: {error}", mend))
    else:
        said = f"a reading is stored durably in {1e3 * seconds:.1f} ms"
        slow = seconds > SLOW_WRITE
        mend = "measure into a folder of a local disk" if slow else ""
        out.append(Finding(COMPUTER, "writing", "warning" if slow else "ok", said, mend))
    return tuple(out)


def _file_system(folder: Path, mounts: Path = Path("/proc/mounts")) -> str:
    """Return the kind of file system of a folder; empty where it is not known."""
    try:
        lines = [line.split() for line in mounts.read_text(encoding="utf-8").splitlines()]
    except OSError:
        return ""
    at = folder.resolve()
    parents = {str(at), *map(str, at.parents)}
    found = [fields for fields in lines if len(fields) > 2 and fields[1] in parents]
    return max(found, key=lambda fields: len(fields[1]))[2] if found else ""


def _durable_write(folder: Path) -> float:
    """Return the median time of a small transaction as a campaign file makes it, s."""
    times = []
    with tempfile.TemporaryDirectory(prefix=".hilcal-doctor-", dir=folder) as inside:
        connection = sqlite3.connect(Path(inside) / "try.sqlite", isolation_level=None)
        try:
            connection.execute("PRAGMA synchronous = EXTRA")
            connection.execute("CREATE TABLE reading (bytes BLOB)")
            for _ in range(_WRITES):
                begun = time.perf_counter()
                connection.execute("INSERT INTO reading VALUES (zeroblob(1000))")
                times.append(time.perf_counter() - begun)
        finally:
            connection.close()
    return statistics.median(times)


def memory() -> Finding:
    """Return whether there is memory for large campaigns."""
    try:
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        whole = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError):
        return Finding(COMPUTER, "memory", "ok", "not known")
    said = f"{whole / 1e9:.1f} GB, of which {free / 1e9:.1f} GB unused"
    if whole < LEAST_MEMORY:
        mend = "campaigns of thousands of readings need another computer"
        return Finding(COMPUTER, "memory", "warning", said, mend)
    return Finding(COMPUTER, "memory", "ok", said)


def load(measured: Callable[[], tuple[float, float, float]] = os.getloadavg) -> Finding:
    """Return whether other programs keep the processors busy: an arm must hear from us in time."""
    cores, busy = os.cpu_count() or 1, measured()[0]
    said = f"{cores}; in the last minute {busy:.1f} programs wanted one at a time"
    if busy > cores:
        mend = "end other programs: the arm stops by itself where this program is 0.1 s late"
        return Finding(COMPUTER, "processors", "warning", said, mend)
    return Finding(COMPUTER, "processors", "ok", said)


def program(version: str) -> tuple[Finding, ...]:
    """Return the findings on what is installed, of hilcal in this version."""
    return (
        Finding(PROGRAM, "hilcal", "ok", f"version {version}"),
        _python(),
        *packages(metadata.requires(DISTRIBUTION) or ()),
        *_drivers(),
    )


def _python() -> Finding:
    said = f"{platform.python_version()} at {sys.executable}, {platform.platform()}"
    if sys.version_info < LOWEST:
        return Finding(PROGRAM, "Python", "problem", said, "install Python 3.11 or later")
    return Finding(PROGRAM, "Python", "ok", said)


def packages(requirements: Iterable[str]) -> tuple[Finding, ...]:
    """Return whether the packages of a distribution are there and load.

    Requirements are as its metadata list them, e.g. 'pyarrow>=17; extra == "tables"'. One for
    earlier Pythons alone has no wheel for this one.
    """
    there, out = [], []
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
                version = ".".join(map(str, sys.version_info[:2]))
                said = f"has no wheel for Python {version}; the driver that needs it says so"
                mend = "use Python 3.11 or 3.12 for the computer of a cell with such a device"
                out.append(Finding(PROGRAM, name, "warning", said, mend))
            else:
                mend = f"install it: pip install '{requirement}'"
                out.append(Finding(PROGRAM, name, "problem", "is not installed", mend))
            continue
        why = _loads(NATIVE[name]) if name in NATIVE else ""
        if why:
            mend = f"install it anew: pip install --force-reinstall {name}=={version}"
            out.append(Finding(PROGRAM, name, "problem", f"{version} does not load: {why}", mend))
        else:
            there.append(f"{name} {version}")
    for extra_name, names in lacking.items():
        said = f"{', '.join(names)}: not installed; what needs them says so"
        mend = f'where it is wanted: pip install "hilcal[{extra_name}]"'
        out.append(Finding(PROGRAM, f"optional: {extra_name}", "ok", said, mend))
    return (Finding(PROGRAM, "packages", "ok", ", ".join(there)), *out)


def _loads(module: str) -> str:
    """Return why a module does not load; empty where it does."""
    try:
        importlib.import_module(module)
    except Exception as error:
        return f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
    return ""


def _drivers() -> tuple[Finding, ...]:
    out = []
    for group, what in GROUPS.items():
        names = []
        for point in metadata.entry_points(group=group):
            try:
                point.load()
            except Exception as error:
                said = f"{point.value} does not load ({type(error).__name__}: {error})"
                mend = f"repair or remove the package that brings {point.name}"
                out.append(Finding(PROGRAM, f"driver {point.name}", "warning", said, mend))
            else:
                names.append(point.name)
        out.append(Finding(PROGRAM, f"drivers of {what}", "ok", ", ".join(sorted(names)) or "none"))
    return tuple(out)
