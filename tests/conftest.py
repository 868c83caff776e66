"""Fixtures that several test files share."""

import gc
import os
import signal
import socket
from pathlib import Path

import hypothesis
import pytest

ROOT = Path(__file__).resolve().parents[1]

# Shared machines are slow at times: no deadlines, and the same examples on every run.
hypothesis.settings.register_profile("hilcal", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.register_profile("quick", deadline=None, derandomize=True, max_examples=20)


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


@pytest.fixture
def free_port():
    """A port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let the drivers' tests run on real devices."""
    parser.addoption(
        "--hardware",
        metavar="CELL.toml",
        default=None,
        help="run tests/wire/test_devices.py on the real devices of this cell; the arm moves",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Draw fewer examples for the quick tests; take signals as at a terminal.

    A shell's background job ignores SIGINT, nohup SIGHUP, and programs inherit it: those that the
    tests start would not end on them.
    """
    quick = "not long" in config.getoption("markexpr")
    hypothesis.settings.load_profile("quick" if quick else "hilcal")
    # Collecting makes millions of objects that all stay: looking for garbage among them took more
    # than a third of its time.
    gc.disable()
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


FIRST = (
    "test_stops", "test_fault_matrix",
    "test_run", "test_force_drivers", "test_library", "test_effect_jacobian", "test_run_faults",
    "test_run_watched", "test_ur_driver_faults", "test_ur_driver",
    "test_gross_errors", "test_diagnose", "test_planner", "test_geocom_driver", "test_next_cli",
    "test_simulated_cell", "test_workbench_page", "test_arm_scatter", "test_background",
    "test_natnet_driver", "test_registration", "test_network_cell",
    "test_ur_driver_parts", "test_user_effects", "test_evidence", "test_cli", "test_report_page",
    "test_procedure", "test_demo", "test_p_values", "test_study_plans", "test_docs",
    "test_run_until", "test_verdict", "test_operator",
)  # fmt: skip
"""Files that take longest: they begin first, so that none of them is left over at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the long files first; each file's tests stay together, in their order.

    Files of tests/wire wait for devices most of their time: they are spread evenly among the
    others, which compute, so that two processes seldom wait at once.
    """
    place = {name: k for k, name in enumerate(FIRST)}
    files = list(dict.fromkeys(item.path for item in items))
    files.sort(key=lambda path: place.get(path.stem, len(FIRST)))
    rank: dict[Path, float] = {}
    for wire in (True, False):
        group = [path for path in files if (path.parent.name == "wire") is wire]
        rank.update({path: (k + 0.5) / len(group) for k, path in enumerate(group)})
    items.sort(key=lambda item: rank[item.path])


def pytest_collection_finish() -> None:
    """Let the collector of garbage look only at what tests make from here on."""
    gc.freeze()
    gc.enable()
    gc.set_threshold(50_000, 20, 20)  # what tests make is numbers, hardly any of it in circles
