"""What `doctor` finds on computers that are as they should be, and on others."""

import os
import pty
import socket
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest

from hilcal import doctor
from hilcal.doctor import NATIVE, clock, disk, load, packages, reachable, serial_ports


def test_packages_are_told_with_their_versions_and_those_that_lack():
    there, lacking, later, optional = packages(
        [
            "numpy>=2.0",
            'numpy>=2.0; extra == "tables"',
            "no-such-package>=3,<4",
            'no-such-driver>=1; python_version < "3.11"',
            'no-such-tables>=1; extra == "tables"',
            'no-such-linter; extra == "dev"',
        ]
    )
    assert there.said.startswith("numpy 2.")
    assert "," not in there.said  # each once
    assert (lacking.name, lacking.state) == ("no-such-package", "problem")
    assert "pip install 'no-such-package>=3,<4'" in lacking.mend
    assert (later.name, later.state) == ("no-such-driver", "warning")
    assert f"no wheel for Python {sys.version_info[0]}.{sys.version_info[1]}" in later.said
    assert "Python 3.11 or 3.12" in later.mend
    assert (optional.name, optional.state) == ("optional: tables", "ok")
    assert "hilcal[tables]" in optional.mend


def test_a_package_that_does_not_load_is_a_problem(tmp_path, monkeypatch):
    (tmp_path / "numba_of_another.py").write_text("raise OSError('wrong processor')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(NATIVE, "numba", "numba_of_another")
    _, broken = packages(["numba>=0.61"])
    assert broken.state == "problem"
    assert "does not load: OSError: wrong processor" in broken.said


@pytest.mark.parametrize(
    ("year", "status", "state", "said"),
    [
        (2031, 0, "ok", "synchronised"),
        (2031, 5, "warning", "not synchronised"),
        (2031, None, "ok", "is not known"),
        (1970, 0, "problem", "never set"),
    ],
)
def test_the_clock(year, status, state, said):
    check = clock(lambda: datetime(year, 5, 1, tzinfo=UTC), lambda: status)
    assert check.state == state
    assert said in check.said


def test_a_folder_that_can_be_measured_into_and_others(tmp_path, monkeypatch):
    space, *_, writing = disk(tmp_path)
    assert "GB free" in space.said
    assert writing.state in ("ok", "warning")
    assert list(tmp_path.iterdir()) == []  # nothing is left behind
    (lacking,) = disk(tmp_path / "no")
    assert lacking.state == "problem"

    def fails(folder):
        raise PermissionError("Read-only file system")

    monkeypatch.setattr(doctor, "_durable_write", fails)
    *_, writing = disk(tmp_path)
    assert writing.state == "problem"
    assert "Read-only file system" in writing.said


def test_the_file_system_is_that_of_the_nearest_mount(tmp_path):
    mounts = tmp_path / "mounts"
    mounts.write_text(
        f"/dev/sda1 / ext4 rw 0 0\nserver:/x {tmp_path} nfs4 rw 0 0\nother /else cifs rw 0 0\n"
    )
    assert doctor._file_system(tmp_path, mounts) == "nfs4"
    assert doctor._file_system(Path("/"), mounts) == "ext4"
    assert doctor._file_system(tmp_path, tmp_path / "none") == ""


def test_a_busy_computer_is_a_warning():
    assert load(lambda: (0.0, 0.0, 0.0)).state == "ok"
    busy = load(lambda: (99.0, 0.0, 0.0))
    assert busy.state == "warning"
    assert "the arm stops by itself" in busy.mend


@pytest.fixture
def port():
    """A real character device that nobody else has open."""
    here, there = pty.openpty()
    yield os.ttyname(there)
    os.close(here)
    os.close(there)


@pytest.fixture
def system(tmp_path, port):
    """Make a kernel that shows one adapter."""

    def made(latency=None):
        by_id = tmp_path / "dev" / "serial" / "by-id"
        by_id.mkdir(parents=True)
        (by_id / "usb-FTDI_tracker").symlink_to(port)
        (tmp_path / "proc").mkdir()
        if latency is not None:
            timer = tmp_path / "sys" / "bus" / "usb-serial" / "devices" / Path(port).name
            timer.mkdir(parents=True)
            (timer / "latency_timer").write_text(f"{latency}\n")
        return tmp_path

    return made


def test_a_port_is_told_by_its_lasting_name(port, system):
    (check,) = serial_ports({"tracker": port}, {port: "USB Serial"}, system(latency=1))
    assert check.state == "ok"
    assert check.name.startswith("tracker: ")
    assert check.name.endswith("by-id/usb-FTDI_tracker")
    assert "USB Serial" in check.said


def test_a_slow_adapter_is_told_with_the_line_that_mends_it(port, system):
    (check,) = serial_ports({}, {port: "USB Serial"}, system(latency=16))
    assert check.state == "warning"
    assert "up to 16 ms" in check.said
    assert check.mend.startswith("echo 1 | sudo tee ")
    assert check.mend.endswith("/latency_timer")


def test_a_port_of_the_cell_that_is_not_there(port, system, tmp_path):
    at = system()
    checks = serial_ports({"tracker": str(tmp_path / "ttyUSB7")}, {port: "USB Serial"}, at)
    assert checks[0].state == "problem"
    assert "usb-FTDI_tracker" in checks[0].mend  # which there is instead
    (none,) = serial_ports({}, {}, at)
    assert (none.state, none.said) == ("ok", "none is plugged in")


def test_a_port_without_the_right_to_use_it_and_a_file_that_is_none(
    port, system, tmp_path, monkeypatch
):
    at, path = system(), tmp_path / "notes.txt"
    path.write_text("")
    (wrong,) = serial_ports({"tracker": str(path)}, {}, at)
    assert wrong.state == "problem"
    assert "no serial port" in wrong.said
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    (wanted,) = serial_ports({"tracker": port}, {}, at)
    assert wanted.state == "problem"
    assert "usermod -aG" in wanted.mend
    (other,) = serial_ports({}, {port: ""}, at)
    assert other.state == "warning"  # no device of the cell


def test_who_has_a_port_open_and_who_meddles(port, system):
    at = system()
    for number, name in ((4242, "minicom"), (4243, "ModemManager")):
        folder = at / "proc" / str(number) / "fd"
        folder.mkdir(parents=True)
        (folder.parent / "comm").write_text(f"{name}\n")
    (at / "proc" / "4242" / "fd" / "3").symlink_to(port)
    held, meddler = serial_ports({}, {port: "USB Serial"}, at)
    assert held.state == meddler.state == "warning"
    assert "minicom (process 4242) has it open" in held.said
    assert meddler.name == "ModemManager"


def test_services_and_hosts_that_answer_and_that_do_not():
    here = ("127.0.0.1", 0)
    with socket.create_server(here) as server, socket.create_server(here) as closed:
        open_port, closed_port = (s.getsockname()[1] for s in (server, closed))
        closed.close()
        answers, refuses = reachable("127.0.0.1", {open_port: "one", closed_port: "two"})
    assert answers.state in ("ok", "warning")  # a busy machine may be slow
    assert "answers in" in answers.said
    assert refuses.state == "problem"
    assert "refused" in refuses.said
    (unknown,) = reachable("no-such-arm.invalid", {30004: "RTDE"})
    assert unknown.state == "problem"
    assert "is not known" in unknown.said
