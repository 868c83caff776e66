"""The process of the physical world: reads the arm's state, writes the truth.

`python -m hilcal.drivers.simulated.world_server --directory DIR --seed N`, with DIR/world.json of
`write_world`. Requests at DIR/world.sock:

    hang {name}       hang a load, null: take it off; returns the name of the load that hangs
    mistake {name}    the next hang hangs this load instead
    push {wrench}     push at the load point, six numbers, base axes, N and N·m; zeros: let go
    swing {wrench, period, decay}  from now on, loads swing after hanging (world time)
    state             the present truth
    log               loads and pushes with their times (world time)
    die               end at once, as in a crash

The JSON file holds the world without rounding.
"""

import contextlib
import json
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig
from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.blackboard import MOST_TARGETS, Blackboard
from hilcal.drivers.simulated.mechanics import rotation_matrices
from hilcal.drivers.simulated.truth import AIR, Truth, warm_up
from hilcal.drivers.simulated.user_effect import HiddenUserEffect
from hilcal.drivers.simulated.world import SimulatedNoise, World
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.toml import suggest
from hilcal.types import Floats
from hilcal.whole_file import replace_file

ENCODER_STD = 2e-6  # noise of a motor-side encoder, at the joint, rad

_REFRESH_NS = 10_000_000  # real time between two publications of an unchanged arm
_STRONGEST = 2000.0  # largest push or swing, N and N·m


class WorldState:
    """Reads the arm's state, computes the equilibrium, and publishes the truth; thread-safe.

    Repeatability: at every arrival the joints have a new error of `joint_std`. Encoders are at the
    motors: they measure neither this error nor the elastic deflection.
    """

    def __init__(self, world: World, config: CellConfig, board: Blackboard, seed: int) -> None:
        """Continue from the board's truth, which a previous world may have written."""
        if world.cell.arm.n != board.joints:
            raise InputError(
                f"simulated cell: the arm {world.cell.arm.name} has {world.cell.arm.n} joints, "
                f"the shared world one of {board.joints}"
            )
        if len(world.cell.all_targets) > MOST_TARGETS:
            raise InputError(
                f"simulated cell: {len(world.cell.all_targets)} [[tool.targets]]; valid: at most "
                f"{MOST_TARGETS}"
            )
        self._world, self._board, self._seed = world, board, seed
        self._loads = config.loads
        sensor = config.force_sensor  # None: at the flange
        self._sensor_origin = np.array(sensor.origin_m) if sensor else np.zeros(3)
        self._sensor_turn = (
            rotation_matrices(np.array([sensor.rotvec_rad]))[0] if sensor else np.eye(3)
        )
        self._ages = world.drifts
        self._rng = np.random.default_rng([seed, 0])
        self._lock = threading.RLock()
        truth = board.read("truth")
        self._load, self._since = int(truth["load"]), float(truth["load_since"])
        self._push = np.zeros(6)
        self._swing: tuple[Floats, float, float] | None = None  # wrench, period, decay
        self._mistakes: list[int] = []
        self._log: list[dict[str, Any]] = []
        self._published: tuple[bytes, bytes, bool, int, bool] | None = None
        self._computed_ns = self._written_ns = 0
        self._handled = -1  # number of the arm's last write that needs no further update
        self._arm = board.read("arm")

    def step(self, now_ns: int) -> None:
        """Publish what has changed; `now_ns` is the real time, `time.monotonic_ns`."""
        with self._lock:
            number = self._board.write_count("arm")
            if number == self._handled and now_ns - self._written_ns < _REFRESH_NS:
                return
            arm = self._read_arm()
            pose = (arm["q"].tobytes(), arm["side"].tobytes(), self._swinging() is not None)
            state = (*pose, int(arm["arrivals"]), bool(arm["moving"]))
            published = self._published
            due = now_ns - self._computed_ns >= _REFRESH_NS
            arrived = published is None or published[3:] != state[3:]
            if arrived or (due and (self._ages or state[2] or published != state)):
                try:
                    self._publish(arm)
                except InputError as error:  # the truth stays unchanged
                    if not self._log or self._log[-1]["event"] != str(error):
                        self._note(str(error))
                self._published, self._computed_ns = state, now_ns
                self._written_ns = now_ns
            elif now_ns - self._written_ns >= _REFRESH_NS:
                self._board.write("truth", **self._variable_fields(arm))
                self._written_ns = now_ns
            self._handled = number if state == self._published else -1

    def hang(self, name: str | None) -> str | None:
        """Hang a load, or take it off (None); return the load that hangs (see `mistake`)."""
        with self._lock:
            requested = self._number(name)
            load = self._mistakes.pop(0) if self._mistakes else requested
            with self._transaction():
                self._load, self._since = load, self._board.time
            self._published = None  # a swinging load may rest by the next step
            self._note(f"asked for {self._name(requested)}, hung {self._name(load)}")
            return None if load == 0 else self._name(load)

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        """Publish the changes of the block; undo them if the arm has no equilibrium."""
        saved = self._load, self._since, self._push
        try:
            yield
            self._publish(self._read_arm())
        except InputError:
            self._load, self._since, self._push = saved
            raise

    def mistake(self, name: str | None) -> None:
        """Let the next `hang` hang this load, whatever the request."""
        with self._lock:
            self._mistakes.append(self._number(name))

    def push(self, wrench: Sequence[float]) -> None:
        """Apply an additional wrench at the load point, base axes, N and N·m, until changed."""
        push = _six("push", wrench)
        with self._lock:
            with self._transaction():
                self._push = push
            self._note(f"push {push.tolist()}")

    def swing(self, wrench: Sequence[float], period: float, decay: float) -> None:
        """Let every load swing after hanging from now on; zeros: no swing.

        Adds w(t) = w exp(-t / decay) cos(2 pi t / period) to the load, t s after its change.
        """
        start = _six("swing", wrench)
        if not (period > 0.0 and decay > 0.0):
            raise InputError(f"swing: period {period} s, decay {decay} s; valid: over 0")
        with self._lock:
            self._swing = (start, period, decay) if start.any() else None

    def state(self) -> dict[str, Any]:
        """Return the present truth, for JSON."""
        with self._lock:
            truth = self._board.read("truth")
            valid = np.isfinite(truth["targets"]).all(axis=1)
            out = {name: truth[name].tolist() for name in truth.dtype.names}
            out["targets"] = truth["targets"][valid].tolist()
            arrivals = int(truth["arrivals"])
            return {
                **out,
                "load": None if self._load == 0 else self._name(self._load),
                "push": self._push.tolist(),
                "slip": self.slip(arrivals).tolist(),
            }

    def log(self) -> list[dict[str, Any]]:
        """Return the events of load and pushes, with their times."""
        with self._lock:
            return list(self._log)

    def slip(self, arrivals: int) -> Floats:
        """Return the (n,) errors of the joints at this arrival, rad."""
        rng = np.random.default_rng([self._seed, 1, arrivals])
        return np.asarray(self._world.joint_std * rng.standard_normal(self._board.joints))

    def _publish(self, arm: Any) -> None:
        """Compute the present equilibrium, and write the whole truth."""
        world, now = self._world, self._board.time
        wrench = self._push.copy()
        swinging = self._swinging()
        if swinging is not None:
            wrench += swinging
        if self._load:
            wrench += self._loads[self._load - 1].wrench(world.cell.gravity)
        states = States(
            q=arm["q"][None].copy(),
            wrench=wrench[None],
            time=np.array([now]),
            load_time=np.array([now - self._since]),
            joint_temperature=warm_up(np.array([now]), self._board.joints),
            approach=arm["side"][None].copy(),
        )
        slip = self.slip(int(arm["arrivals"]))[None]
        rest = world.equilibrium(states, slip)
        targets = np.full((MOST_TARGETS, 3), np.nan)
        if world.cell.targets is None:
            ideal = world.ideal_readings(states, slip, rest)
        else:
            count = len(world.cell.targets)
            repeated = replace(states[np.zeros(count, dtype=np.int64)], target=np.arange(count))
            ideal = world.ideal_readings(repeated, np.repeat(slip, count, axis=0))
            targets[:count] = ideal.position
        flange = rest.flange[0]
        self._board.write(
            "truth",
            load=self._load,
            load_since=self._since,
            target=ideal.position[0],
            target_rotation=ideal.rotation[0],
            targets=targets,
            flange=flange,
            sensor_wrench=self._sensor_wrench(flange[:3, :3], wrench),
            drive_torque=world.cell.arm.drive_torques(rest.torque[0, world.drives]),
            arrivals=int(arm["arrivals"]),
            **self._variable_fields(arm, now),
        )

    def _sensor_wrench(self, turn: Floats, wrench: Floats) -> Floats:
        """Return the (6,) wrench of tool and load on the sensor, in its axes, N and N·m.

        f = Rᵀ (m g + f_load),  tau = Rᵀ ((c - o) × m g + (p - o) × f_load + tau_load)
        """
        cell, origin = self._world.cell, self._sensor_origin
        weight = cell.tool_mass * cell.gravity
        point = cell.load_point + self._world.physics.load_point
        moment = (
            np.cross(turn @ (cell.tool_com - origin), weight)
            + np.cross(turn @ (point - origin), wrench[:3])
            + wrench[3:]
        )
        to_sensor = (turn @ self._sensor_turn).T
        return np.concatenate([to_sensor @ (weight + wrench[:3]), to_sensor @ moment])

    def _read_arm(self) -> Any:
        """Return the arm's section; the previous one if its writer died while writing."""
        with contextlib.suppress(RuntimeError):
            self._arm = self._board.read("arm")
        return self._arm

    def _swinging(self) -> Floats | None:
        """Return what the swing of the load adds to it (6,); None when it has come to rest."""
        if self._swing is None or self._load == 0:
            return None
        (start, period, decay), time = self._swing, self._board.time - self._since
        if time >= 14.0 * decay:  # below a millionth of its start
            return None
        return np.asarray(start * np.exp(-time / decay) * np.cos(2.0 * np.pi * time / period))

    def _variable_fields(self, arm: Any, now: float | None = None) -> dict[str, Any]:
        time = self._board.time if now is None else now
        return {
            "time": time,
            "encoder": arm["q"] + ENCODER_STD * self._rng.standard_normal(self._board.joints),
            "joint_temperature": warm_up(np.array([time]), self._board.joints)[0],
            "air_temperature": AIR,
        }

    def _number(self, name: str | None) -> int:
        """Return the number of a load by name, 0 for none."""
        if name is None or name == "none":
            return 0
        names = [load.name for load in self._loads]
        if name not in names:
            raise InputError(
                f"there is no load {name!r}{suggest(name, names)}; valid: none, {', '.join(names)}"
            )
        return names.index(name) + 1

    def _name(self, number: int) -> str:
        return self._loads[number - 1].name if number else "none"

    def _note(self, event: str) -> None:
        self._log.append({"time": self._board.time, "event": event})


def _six(request: str, wrench: Sequence[float]) -> Floats:
    """Return the wrench of a request; raises InputError if invalid or too large."""
    values = np.asarray(wrench, dtype=float)
    if values.shape != (6,) or not np.all(np.abs(values) <= _STRONGEST):
        raise InputError(
            f"{request} {list(wrench)}; valid: six numbers, N and N·m, at most {_STRONGEST:g}"
        )
    return values


def write_world(path: Path, world: World, config: CellConfig, base_dir: Path | None = None) -> None:
    """Write the world and the configuration of its cell, atomically and without rounding."""
    differing = _differences(world.cell, cell_from_config(config, base_dir))
    if differing:
        raise InputError(
            f"simulated world: its cell and the configuration differ in {', '.join(differing)}; "
            "valid: the configuration that the world was made from"
        )
    content = {
        "config": json.loads(config.to_json()),
        "base_dir": None if base_dir is None else str(base_dir.resolve()),
        "physics": {f.name: _listed(getattr(world.physics, f.name)) for f in fields(Truth)},
        "own": None if world.user_effect is None else world.user_effect.to_json(),
        "noise": asdict(world.noise),
        "joint_reference": world.joint_reference,
        **{name: _listed(getattr(world, name)) for name in _ARRAYS},
    }
    replace_file(path, json.dumps(content, indent=1))


def read_world(path: Path) -> tuple[World, CellConfig]:
    """Return the world of a file and the configuration of its cell."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        config = CellConfig.from_json(json.dumps(data["config"]))
        base_dir = None if data["base_dir"] is None else Path(data["base_dir"])
        cell, noise = cell_from_config(config, base_dir), data["noise"]
        along, across = tuple(noise["range_std"]), tuple(noise["transverse_std"])
        world = World(
            cell=cell,
            physics=Truth(**{name: _array(value) for name, value in data["physics"].items()}),
            noise=SimulatedNoise(along, across, noise["orientation_std"]),
            joint_reference=data["joint_reference"],
            user_effect=None
            if data["own"] is None
            else HiddenUserEffect.from_json(cell, data["own"]),
            **{name: _array(data[name]) for name in _ARRAYS},
        )
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"{path}: no world: {type(error).__name__} {error}") from None
    return world, config


_ARRAYS = ("registration", "station", "joint_std", "offsets")
_CELL = ("all_targets", "load_point", "tool_mass", "tool_com", "gravity")
_ARM = ("links", "masses", "coms", "q_min", "q_max", "torque_max", "coupling", "slides")


def _listed(array: Floats | None) -> dict[str, Any] | None:
    """Return an array as JSON, with its shape, where a dimension may be 0."""
    if array is None:
        return None
    return {"shape": list(array.shape), "values": [float(x) for x in array.ravel()]}


def _array(data: dict[str, Any] | None) -> Any:
    return None if data is None else np.array(data["values"], dtype=float).reshape(data["shape"])


def _differences(a: Cell, b: Cell) -> list[str]:
    """Return the names of the fields in which two cells differ, except registrations."""
    parts: list[tuple[str, Any, Any, str]] = [(name, a, b, "") for name in _CELL]
    parts += [(name, a.arm, b.arm, "arm.") for name in _ARM]
    return [
        prefix + name.removeprefix("all_")
        for name, x, y, prefix in parts
        if not np.array_equal(getattr(x, name), getattr(y, name))
    ]


_POLL = 0.0025  # real s between two readings of the arm's state


def open_board(directory: Path, scale: float, start: float = 0.0, joints: int = 6) -> Blackboard:
    """Return the blackboard of a cell; create it, atomically, if absent."""
    path = directory / "world.bin"
    if not path.exists():
        new = path.with_name("world.bin.new")
        board = Blackboard.create(new, scale, start, joints)
        new.replace(path)  # the mapping stays valid
        return board
    return Blackboard(path)


def start(options: admin.Arguments) -> admin.Device:
    """Return the world of DIR/world.json, and its step."""
    world, config = read_world(options.directory / "world.json")
    board = open_board(options.directory, config.simulation.clock, joints=world.cell.arm.n)
    state = WorldState(world, config, board, options.seed)

    def step() -> None:
        state.step(time.monotonic_ns())
        time.sleep(_POLL)

    state.step(time.monotonic_ns())
    names = ("hang", "mistake", "push", "swing", "state", "log")
    return admin.Operations({name: getattr(state, name) for name in names}), step


if __name__ == "__main__":
    admin.run(__doc__, "world", start)
