"""Packages that may be missing: the line that installs each."""

from collections.abc import Iterator
from contextlib import contextmanager

from hilcal.errors import MissingPackageError

EXTRAS = {
    "jinja2": "report",
    "plotly": "report",
    "rerun": "view",
    "nicegui": "workbench",
    "dask": "cluster",
    "distributed": "cluster",
    "numba": "compiled",
    "openpyxl": "tables",
    "pyarrow": "tables",
}
"""Extra of pyproject.toml that brings a package, by the name by which the package is imported."""

REQUIRED = {
    "coal": "pin",
    "geocompy": "geocompy",
    "minimalmodbus": "minimalmodbus",
    "pandas": "pandas",
    "pinocchio": "pin",
    "rtde_control": "ur-rtde",
    "rtde_receive": "ur-rtde",
    "serial": "pyserial",
    "sklearn": "scikit-learn",
}
"""Distribution by the name of its package: required, but not by every command."""


@contextmanager
def needed_by(what: str) -> Iterator[None]:
    """Import packages that may be missing: MissingPackageError, which `what` needs them begins."""
    try:
        yield
    except ImportError as error:
        raise MissingPackageError(f"{what}: {lacking(error) or error}") from error


def lacking(error: BaseException) -> str:
    """Say which package an import lacks, and the line that installs it; "" for other errors."""
    name = (error.name or "") if isinstance(error, ModuleNotFoundError) else ""
    package = name.split(".")[0]
    if package not in EXTRAS and package not in REQUIRED:
        return ""
    return f"the package {package} is not installed: {install(package)}"


def install(package: str) -> str:
    """Return the line that installs a package, given the name by which it is imported."""
    if package in EXTRAS:
        return f'pip install "hilcal[{EXTRAS[package]}]"'
    return f"pip install {REQUIRED[package]}"
