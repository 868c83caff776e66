"""A simulated cell: one process per device, all sharing one physical world."""

import contextlib
import secrets
import socket
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Self

import numpy as np

from hilcal.config import SIMULATED, CellConfig
from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.world import World
from hilcal.drivers.simulated.world_server import open_board, write_world
from hilcal.drivers.ur_link.worker import environment
from hilcal.errors import DeviceError, InputError
from hilcal.robot.arm import Arm
from hilcal.types import Floats

START_TIMEOUT = 60.0  # s; enough for the simulated devices on a busy machine
UR_PORTS = (29999, 30001, 30003, 30004)
UR_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
EMSCON_PORT = 7000  # of the simulated tracker; the real port, 700, needs the administrator's rights
RDT_PORT, WEB_PORT, NATNET_PORT = 49152, 8081, 1510
PORTS = (*UR_PORTS, EMSCON_PORT, WEB_PORT)
TRACKERS = ("geocom", "emscon", "natnet")
FORCE_SENSORS = ("ft300", "bota", "hex", "netft")
_STALE = ("world.json", "world.bin", "tracker", "force", "world.sock", "arm.sock", "tracker.sock",
          "force.sock")  # fmt: skip
_SOCKET_PATH = 100  # bytes; Linux allows 107 (unix(7)), and the socket is made as "*.sock.new"
_HOSTS = 3  # addresses tried if another program takes their ports first
_POLL = 0.01  # s
_END = 2.0  # longest wait for the end of a process, before each harsher signal, s


class DeviceProcess:
    """Starts, watches and ends `python -m MODULE --directory DIR ...`.

    The process ends when its standard input closes, a pipe held here. Its output goes to
    DIR/NAME.log; it is ready when DIR/NAME.sock appears.
    """

    def __init__(self, name: str, module: str, directory: Path, arguments: tuple[str, ...]) -> None:
        self.name = name
        self.socket, self.log = directory / f"{name}.sock", directory / f"{name}.log"
        self._command = (sys.executable, "-m", module, "--directory", str(directory), *arguments)
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the process, after ending one that still runs; returns at once."""
        self.kill()
        self.socket.unlink(missing_ok=True)
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                self._command,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                env={**environment(), "OMP_NUM_THREADS": "1"},
                start_new_session=True,  # Ctrl-C is for the parent only
            )

    @property
    def pid(self) -> int | None:
        """Process number while it runs."""
        return None if self._process is None or self.has_ended else self._process.pid

    @property
    def has_ended(self) -> bool:
        """Whether it has ended by itself."""
        return self._process is not None and self._process.poll() is not None

    def running_unready(self) -> bool:
        """Whether it has been started and is not yet ready."""
        return self._process is not None and not self.socket.exists()

    def check(self) -> None:
        """Raise DeviceError with the last line of its output if it has ended."""
        if self._process is None or not self.has_ended:
            return
        output = self.log.read_text(encoding="utf-8", errors="replace").split("\n")
        last = next((line.strip() for line in reversed(output) if line.strip()), "no message")
        raise DeviceError(
            f"simulated {self.name}: ended with exit code {self._process.returncode}: {last}"
        )

    def close_input(self) -> None:
        """Close its standard input, on which it ends by itself."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()

    def end(self) -> None:
        """End it, by force if needed."""
        if self._process is None:
            return
        self.close_input()
        for force in (self._process.terminate, self._process.kill, lambda: None):
            try:
                self._process.wait(_END)
                break
            except subprocess.TimeoutExpired:
                force()
        self._process = None
        self.socket.unlink(missing_ok=True)

    def kill(self) -> None:
        """End it at once, as kill -9 or a power cut does."""
        if self._process is not None:
            self._process.kill()
            self.end()


class SimulatedCell:
    """The running processes of a simulated cell; drivers reach them by `config`."""

    def __init__(
        self,
        config: CellConfig,
        directory: Path,
        devices: dict[str, DeviceProcess],
        board: Blackboard,
    ) -> None:
        self.config, self.directory, self._devices, self._board = config, directory, devices, board

    @classmethod
    def start(
        cls,
        world: World,
        config: CellConfig,
        directory: Path,
        seed: int,
        *,
        base_dir: Path | None = None,
        start_s: float = 0.0,
        home: Floats | None = None,
    ) -> Self:
        """Start all devices of the cell, and return when they are ready.

        The world's cell was made from `config`, whose file paths are relative to `base_dir`;
        `directory` must be for this cell alone. The world's time starts at `start_s`, s, over 0 for
        a world continued. The arm starts at `home` (n,); an arm of UR starts upright.
        """
        _check(world, config, directory)
        try:
            directory.mkdir(parents=True, exist_ok=True)
            for name in _STALE:
                (directory / name).unlink(missing_ok=True)
            write_world(directory / "world.json", world, config, base_dir)
            board = open_board(directory, config.simulation.clock, start_s, world.cell.arm.n)
            if not is_ur(world.cell.arm):
                middle = np.mean(world.cell.arm.usual_range, axis=0)
                board.write("arm", q=middle if home is None else home)
        except OSError as error:
            raise InputError(
                f"simulated cell: {directory} cannot be used ({error}); "
                "valid: a directory for it alone"
            ) from None
        for attempt in range(1, _HOSTS + 1):
            host = free_host()
            devices, connected = _devices(world, config, directory, seed, host, base_dir or Path())
            cell = cls(connected, directory, devices, board)
            try:
                cell._start(devices.values())
            except BaseException as error:
                in_use = "in use" in str(error) and any(d.has_ended for d in devices.values())
                cell.close()
                if attempt == _HOSTS or not in_use:
                    raise
            else:
                return cell
        raise AssertionError("unreachable")

    def ask(self, device: str, op: str, **arguments: Any) -> Any:
        """Send a request to a device's admin line: "world", "arm", "tracker" or "force"."""
        return admin.ask(self._device(device).socket, op, **arguments)

    def kill(self, device: str) -> None:
        """End a device at once, as kill -9 or a power cut does."""
        self._device(device).kill()

    def restart(self, device: str) -> None:
        """Restart a device, ended first if it still runs; return when it is ready."""
        process = self._device(device)
        process.kill()
        self._start([process])

    def processes(self) -> dict[str, int]:
        """Return the process numbers of the running devices."""
        return {name: d.pid for name, d in self._devices.items() if d.pid is not None}

    def close(self) -> None:
        """End every process. Never raises; may be called twice."""
        for device in self._devices.values():
            device.close_input()
        for device in self._devices.values():
            device.end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _start(self, devices: Iterable[DeviceProcess]) -> None:
        """Start devices in parallel; wait until they are ready, and arm and world agree."""
        deadline = time.monotonic() + START_TIMEOUT

        def wait(starting: Iterable[DeviceProcess], late: str) -> None:
            for device in starting:
                device.check()
            if time.monotonic() > deadline:
                raise DeviceError(late)
            time.sleep(_POLL)

        for device in devices:
            device.start()
        while waiting := [d for d in self._devices.values() if d.running_unready()]:
            names = ", ".join(d.name for d in waiting)
            late = f"simulated {names}: not ready within {START_TIMEOUT:g} s; see {waiting[0].log}"
            wait(waiting, late)
        while not self._agree():
            wait(
                devices,
                "simulated cell: the arm or the world is ready but does not write its state",
            )

    def _agree(self) -> bool:
        """Whether the world shows the arm's present state; True unless both run."""
        if not {"world", "arm"} <= set(self.processes()):
            return True
        arm, truth = self._board.read("arm"), self._board.read("truth")
        near = np.abs(truth["encoder"] - arm["q"]).max() < 1e-3
        return bool(arm["alive"] and (near or arm["moving"]))

    def _device(self, name: str) -> DeviceProcess:
        if name not in self._devices:
            valid = ", ".join(self._devices)
            raise InputError(f"simulated cell: no device {name!r}; valid: {valid}")
        return self._devices[name]


def free_host() -> str:
    """Return a loopback address where all ports of devices are free."""
    for _ in range(50):
        parts = (secrets.randbelow(254) + 1, secrets.randbelow(256), secrets.randbelow(254) + 1)
        host = "127.{}.{}.{}".format(*parts)
        with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
            for port in PORTS:
                stack.enter_context(socket.socket()).bind((host, port))
            return host
    raise DeviceError(
        "simulated arm: no free loopback address 127.x.y.z with the ports "
        f"{', '.join(map(str, PORTS))}; is the loopback network up?"
    )


def _check(world: World, config: CellConfig, directory: Path) -> None:
    """Raise InputError for a cell that the simulated devices cannot represent."""
    if not np.array_equal(world.station, np.eye(4)):
        raise InputError(
            "simulated cell: a station measures from where it stands, but the readings' origin "
            'lies within the arm\'s reach; valid: [tracker] frame = "tracker", with a base that '
            "is unknown or farther away than the arm reaches"
        )
    sensor = config.force_sensor
    for device, driver, valid in (
        ("tracker", config.tracker.driver or TRACKERS[0], TRACKERS),
        ("force sensor", "ft300" if sensor is None else sensor.driver, FORCE_SENSORS),
    ):
        if driver not in valid:
            raise InputError(
                f"simulated cell: no simulated {device} {driver!r}; valid: {', '.join(valid)}"
            )
    size = len(str((directory / "tracker.sock").absolute()).encode())
    if size > _SOCKET_PATH:
        raise InputError(
            f"simulated cell: the path {directory} is too long for its sockets by "
            f"{size - _SOCKET_PATH} bytes; valid: a directory nearer to the root"
        )
    with contextlib.suppress(DeviceError):
        admin.ask(directory / "world.sock", "state", timeout=1.0)
        raise InputError(
            f"simulated cell: another one runs in {directory}; valid: a directory for "
            "this cell alone"
        )


def _devices(
    world: World, config: CellConfig, directory: Path, seed: int, host: str, base_dir: Path
) -> tuple[dict[str, DeviceProcess], CellConfig]:
    """Return the processes, and the configuration whose drivers connect to them."""
    from hilcal.drivers.simulated.ur_server import API, POLYSCOPE_X  # loads asyncio

    here, noise, sensor = directory.absolute(), world.noise, config.force_sensor
    changes: dict[str, dict[str, Any]] = {}

    def device(name: str, server: str, stream: int, options: dict[str, Any]) -> DeviceProcess:
        command = ["--seed", str(seed + stream)]
        for key, value in options.items():
            values = value if isinstance(value, tuple) else (value,)
            command += [f"--{key.replace('_', '-')}", *map(str, values)]
        return DeviceProcess(name, f"hilcal.drivers.simulated.{server}", directory, tuple(command))

    out = {"world": device("world", "world_server", 0, {})}
    socket = str(here / "world.sock")
    changes["operator"] = {
        "driver": SIMULATED,
        "options": {**config.operator.options, "socket": socket},
    }
    if is_ur(world.cell.arm):
        version, options = config.simulation.controller_version, {**config.robot.options}
        facts: dict[str, Any] = {"host": host, "robot": config.robot.model, "version": version}
        if config.robot.calibration is not None:
            facts["calibration"] = base_dir / config.robot.calibration
        out["arm"] = device("arm", "ur_server", 3, facts)
        if int(version.partition(".")[0]) >= POLYSCOPE_X:
            options["robot_api_port"] = API
        driver = config.robot.driver or "ur"
        changes["robot"] = {"host": host, "driver": driver, "options": options}
    else:
        out["arm"] = device("arm", "arm", 3, {})
        changes["robot"] = {
            "driver": "hilcal.drivers.simulated.arm:open_arm",
            "options": {"socket": str(here / "arm.sock")},
        }
    tracker = config.tracker.driver or TRACKERS[0]
    std = {"range_std": noise.range_std, "transverse_std": noise.transverse_std}
    trackers: dict[str, dict[str, Any]] = {
        "geocom": std,
        "emscon": {
            **{"host": host, "port": EMSCON_PORT, "orientation_std": noise.orientation_std},
            **std,
        },
        "natnet": {"host": host, "port": NATNET_PORT},  # with its own default errors
    }
    facts = trackers[tracker]
    out["tracker"] = device("tracker", f"{tracker}_server", 1, facts)
    in_network = {"host": f"{host}:{facts['port']}"} if "port" in facts else None
    changes["tracker"] = {"driver": tracker, **(in_network or {"port": str(here / "tracker")})}
    if sensor is not None:
        facts = {"kind": sensor.driver}
        changes["force_sensor"] = {"port": str(here / "force")}
        if sensor.driver == "netft":
            facts |= {"host": host, "port": RDT_PORT, "web_port": WEB_PORT}
            web = {**sensor.options, "web_port": WEB_PORT}
            changes["force_sensor"] = {"host": f"{host}:{RDT_PORT}", "options": web}
        out["force"] = device("force", "force_server", 2, facts)
    sections = {
        name: getattr(config, name).model_copy(update=change) for name, change in changes.items()
    }
    return out, config.model_copy(update=sections)


def is_ur(arm: Arm) -> bool:
    """Whether an arm is one of Universal Robots in the catalogue, whose protocols are simulated."""
    return arm.name.startswith("ur") and arm.joint_names == UR_JOINTS
