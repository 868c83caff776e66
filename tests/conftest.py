"""Fixtures that several test files share."""

import os
import signal
from pathlib import Path

import hypothesis
import pytest

ROOT = Path(__file__).resolve().parents[1]

# Shared machines are slow at times: no deadlines, and the same examples on every run.
hypothesis.settings.register_profile("hilcal", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("hilcal")


def data_dir() -> Path:
    """Directory of shared data: HILCAL_DATA, or ../shared/data beside the repository."""
    return Path(os.environ.get("HILCAL_DATA", ROOT.parent / "shared" / "data"))


@pytest.fixture(scope="session")
def ipa_ur10() -> Path:
    """Directory of the IPA UR10 accuracy series (Series_B, Series_C)."""
    path = data_dir() / "ipa_ur10"
    if not path.is_dir():
        pytest.skip("data set ipa_ur10 is absent: set HILCAL_DATA to the directory that holds it")
    return path


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let the drivers' tests run on real devices."""
    parser.addoption(
        "--hardware",
        metavar="CELL.toml",
        default=None,
        help="run tests/test_devices.py on the real devices of this cell; the arm moves",
    )


def pytest_configure() -> None:
    """Take signals as at a terminal, where the caller has them ignored.

    A shell's background job ignores SIGINT, nohup SIGHUP, and programs inherit it: those that the
    tests start would not end on them.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


LONG = (
    "test_demo",
    "test_stops",
    "test_fault_matrix_arm",
    "test_fault_matrix_serial",
    "test_diagnose",
    "test_revise",
    "test_refine",
    "test_live",
    "test_p_values",
    "test_planner",
)
"""Files that take longest: they begin first, so that none of them is left over at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the long files first; each file's tests stay together, in their order."""
    place = {name: k for k, name in enumerate(LONG)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONG)))
