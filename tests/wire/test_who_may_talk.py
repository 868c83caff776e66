"""Simulated devices are for this machine, and their admin lines for the user who started them."""

import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.sim_ur_cases import SimulatedUr, start


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[SimulatedUr]:
    running = start(tmp_path)
    yield running
    running.close()


def listening(pid: int) -> list[str]:
    """Addresses on which a process listens on TCP, by the kernel."""
    files = Path(f"/proc/{pid}/fd")
    held = {os.readlink(link) for link in files.iterdir() if link.is_symlink()}
    out = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and f"socket:[{words[9]}]" in held:
                raw = bytes.fromhex(words[1].split(":")[0])
                out.append(socket.inet_ntoa(raw[::-1]) if len(raw) == 4 else "IPv6")
    return out


def test_the_simulated_arm_listens_on_loopback_alone(arm: SimulatedUr) -> None:
    found = listening(arm.process.pid)
    assert len(found) == 4  # RTDE, dashboard, primary, script
    assert all(address.startswith("127.") for address in found)


def test_admin_lines_are_of_the_user_who_started_them(arm: SimulatedUr) -> None:
    line = arm.directory / "arm.sock"
    assert stat.S_IMODE(line.stat().st_mode) == 0o600
    assert line.stat().st_uid == os.getuid()
