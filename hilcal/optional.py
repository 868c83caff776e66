"""Packages that may be missing, and the line that installs each."""

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
"""Extra of pyproject.toml that installs a package, by the package's import name."""

REQUIRED = {
    "coal": "pin",
    "geocompy": "geocompy",
    "minimalmodbus": "minimalmodbus",
    "pandas": "pandas",
    "pinocchio": "pin",
    "rtde_control": "ur-rtde",
    "rtde_receive": "ur-rtde",
    "serial": "pyserial",
}
"""Distribution by the import name of its package: required, but not by every command."""


@contextmanager
def needed_by(user: str) -> Iterator[None]:
    """Raise a MissingPackageError where an import in the block fails; `user` needs the package."""
    try:
        yield
    except ImportError as error:
        raise MissingPackageError(f"{user}: {missing_package(error) or error}") from error


def missing_package(error: BaseException) -> str:
    """Return which package an import lacks, and how to install it; "" for other errors."""
    name = (error.name or "") if isinstance(error, ModuleNotFoundError) else ""
    package = name.split(".")[0]
    if package not in EXTRAS and package not in REQUIRED:
        return ""
    return f"the package {package} is not installed: {install(package)}"


def install(package: str) -> str:
    """Return the line that installs a package, by its import name."""
    if package in EXTRAS:
        return f'pip install "hilcal[{EXTRAS[package]}]"'
    return f"pip install {REQUIRED[package]}"
