"""The interpreter, the packages that hilcal needs, and the drivers that are installed."""

import importlib
import platform
import re
import sys
from collections.abc import Iterable
from importlib import metadata

from hilcal.doctor.finding import Finding

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
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_BELOW = re.compile(r"""python_version\s*<\s*["'](\d+)\.(\d+)["']""")
_EXTRA = re.compile(r"""extra\s*==\s*["']([^"']+)["']""")


def program(version: str) -> tuple[Finding, ...]:
    """Return the findings on what is installed.

    Args:
        version: of hilcal.
    """
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

    Args:
        requirements: as its metadata list them, e.g. 'pyarrow>=17; extra == "tables"'.
            One for earlier Pythons alone has no wheel for this one.
    """
    there, out = [], []
    lacking: dict[str, list[str]] = {}
    for requirement in requirements:
        match, extra = _NAME.match(requirement), _EXTRA.search(requirement)
        below = _BELOW.search(requirement)
        if match is None or (extra is not None and extra[1] == "dev"):
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
        mend = f"where it is wanted: pip install 'hilcal[{extra_name}]'"
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
