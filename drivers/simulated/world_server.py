"""The process of the physical world: reads what the arm does, writes what is true.

`python -m hilcal.drivers.simulated.world_server --directory DIR --seed N`, with DIR/world.json of
`write_world`. Requests at DIR/world.sock:

    hang {name}       hang a load, null: take it off; returns the name of what truly hangs
    mistake {name}    the next hang hangs this one instead
    push {wrench}     lean on the load point, six numbers, base axes, N and N·m; zeros: let go
    swing {wrench, period, decay}  let what is hung from now on swing for a while (world time)
    state             what is true now
    log               what was hung and pushed, and when (world time)
    die               end at once, as in a crash

The world comes as a JSON file, exactly.
"""

import argparse
import contextlib
import json
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig
from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.blackboard import MOST_TARGETS, Blackboard
from hilcal.drivers.simulated.mechanics import turned
from hilcal.drivers.simulated.own_law import OwnLaw
from hilcal.drivers.simulated.truth import AIR, Truth, warm_up
from hilcal.drivers.simulated.world import SimulatedNoise, World
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.toml import suggest
from hilcal.types import Floats
from hilcal.whole_file import replace_file

ENCODER_STD = 2e-6  # noise of a motor-side encoder at the joint, rad

_REFRESH_NS = 10_000_000  # real time between two publications of an unchanged arm
_STRONGEST = 2000.0  # N and N·m that may push or swing


@dataclass(frozen=True, slots=True, eq=False)
class Swing:
    """A load that swings after it was hung, ever less."""

    wrench: Floats  # (6,) in the beginning, base axes, N and N·m
    period: float  # s
    decay: float  # time constant, s

    def at(self, time: float) -> Floats:
        """Return the (6,) wrench so long after the load was hung, s."""
        phase = 2.0 * np.pi * time / self.period
        return np.asarray(self.wrench * np.exp(-time / self.decay) * np.cos(phase))

    def lasts(self, time: float) -> bool:
        """Whether it is more than a millionth of what it was, so long after the start, s."""
        return time < 14.0 * self.decay


class WorldState:
    """Looks at the arm, computes where it rests, and publishes what is true; from any thread.

    The arm's repeatability: with every arrival the joints miss their command anew by
    `joint_std`. Encoders sit at the motors: they see neither that nor the elastic deflection.
    """

    def __init__(self, world: World, config: CellConfig, board: Blackboard, seed: int) -> None:
        """Take over the board's truth, which a world before this one may have left."""
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
        sensor = config.force_sensor  # at the flange where there is none
        self._sensor_at = np.array(sensor.origin_m) if sensor else np.zeros(3)
        self._sensor_turn = turned(np.array([sensor.rotvec_rad]))[0] if sensor else np.eye(3)
        self._ages = world.ages
        self._rng = np.random.default_rng([seed, 0])
        self._lock = threading.RLock()
        left = board.read("truth")
        self._load, self._since = int(left["load"]), float(left["load_since"])
        self._push = np.zeros(6)
        self._swing: Swing | None = None
        self._mistakes: list[int] = []
        self._log: list[dict[str, Any]] = []
        self._known: tuple[bytes, bytes, bool, int, bool] | None = None
        self._computed_ns = self._written_ns = 0
        self._seen = -1  # number of the arm's last write that was looked at and needs no more
        self._arm = board.read("arm")

    def step(self, now_ns: int) -> None:
        """Publish what has changed; `now_ns` is the real time, `time.monotonic_ns`."""
        with self._lock:
            number = self._board.written("arm")
            if number == self._seen and now_ns - self._written_ns < _REFRESH_NS:
                return
            arm = self._look()
            seen = (arm["q"].tobytes(), arm["side"].tobytes(), self._swings())
            known = (*seen, int(arm["arrivals"]), bool(arm["moving"]))
            before = self._known
            due = now_ns - self._computed_ns >= _REFRESH_NS
            arrived = before is None or before[3:] != known[3:]
            if arrived or (due and (self._ages or known[2] or before != known)):
                try:
                    self._publish(arm)
                except InputError as error:  # the truth stays what it was
                    if not self._log or self._log[-1]["event"] != str(error):
                        self._note(str(error))
                self._known, self._computed_ns = known, now_ns
                self._written_ns = now_ns
            elif now_ns - self._written_ns >= _REFRESH_NS:
                self._board.write("truth", **self._passing(arm))
                self._written_ns = now_ns
            self._seen = number if known == self._known else -1

    def hang(self, name: str | None) -> str | None:
        """Hang a load, or take it off (None); return what truly hangs: there are mistakes."""
        with self._lock:
            wanted = self._number(name)
            load = self._mistakes.pop(0) if self._mistakes else wanted
            with self._tried():
                self._load, self._since = load, self._board.time
            self._known = None  # a load that swings may be at rest by the next look
            self._note(f"asked for {self._name(wanted)}, hung {self._name(load)}")
            return None if load == 0 else self._name(load)

    @contextlib.contextmanager
    def _tried(self) -> Iterator[None]:
        """Publish what is changed inside; what the arm does not bear changes nothing."""
        before = self._load, self._since, self._push
        try:
            yield
            self._publish(self._look())
        except InputError:
            self._load, self._since, self._push = before
            raise

    def mistake(self, name: str | None) -> None:
        """Let the next `hang` hang this load instead, whatever it is asked for."""
        with self._lock:
            self._mistakes.append(self._number(name))

    def push(self, wrench: Sequence[float]) -> None:
        """Apply a further wrench at the load point, base axes, N and N·m, until it is changed."""
        pushed = _six("push", wrench)
        with self._lock:
            with self._tried():
                self._push = pushed
            self._note(f"push {pushed.tolist()}")

    def swing(self, wrench: Sequence[float], period: float, decay: float) -> None:
        """Let every load that is hung from now on swing for a while; zeros: hang still.

        w(t) = w exp(-t / decay) cos(2 pi t / period) adds to the load, t after its change, s.
        """
        start = _six("swing", wrench)
        if not (period > 0.0 and decay > 0.0):
            raise InputError(f"swing: period {period} s, decay {decay} s; valid: over 0")
        with self._lock:
            self._swing = Swing(start, period, decay) if start.any() else None

    def state(self) -> dict[str, Any]:
        """Return what is true now, as JSON can hold it."""
        with self._lock:
            truth = self._board.read("truth")
            seen = np.isfinite(truth["targets"]).all(axis=1)
            out = {name: truth[name].tolist() for name in truth.dtype.names}
            out["targets"] = truth["targets"][seen].tolist()
            arrivals = int(truth["arrivals"])
            return {
                **out,
                "load": None if self._load == 0 else self._name(self._load),
                "push": self._push.tolist(),
                "slip": self.slip(arrivals).tolist(),
            }

    def log(self) -> list[dict[str, Any]]:
        """Return what happened to the load, and when."""
        with self._lock:
            return list(self._log)

    def slip(self, arrivals: int) -> Floats:
        """Return (n,) how far the joints missed their command at this arrival, rad."""
        rng = np.random.default_rng([self._seed, 1, arrivals])
        return np.asarray(self._world.joint_std * rng.standard_normal(self._board.joints))

    def _publish(self, arm: Any) -> None:
        """Compute where the arm rests now, and write all of the truth."""
        world, now = self._world, self._board.time
        wrench = self._push.copy()
        if self._swing is not None and self._swings():
            wrench += self._swing.at(now - self._since)
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
        rest = world.rest(states, slip)
        targets = np.full((MOST_TARGETS, 3), np.nan)
        if world.cell.targets is None:
            sight = world.sight(states, slip, rest)
        else:
            count = len(world.cell.targets)
            each = replace(states[np.zeros(count, dtype=np.int64)], target=np.arange(count))
            sight = world.sight(each, np.repeat(slip, count, axis=0))
            targets[:count] = sight.position
        flange = rest.flange[0]
        self._board.write(
            "truth",
            load=self._load,
            load_since=self._since,
            target=sight.position[0],
            target_rotation=sight.rotation[0],
            targets=targets,
            flange=flange,
            sensor_wrench=self._felt(flange[:3, :3], wrench),
            drive_torque=world.cell.arm.drive_torques(rest.torque[0, world.drives]),
            arrivals=int(arm["arrivals"]),
            **self._passing(arm, now),
        )

    def _felt(self, turn: Floats, wrench: Floats) -> Floats:
        """Return the (6,) wrench of tool and load on the sensor, its axes, N and N·m.

        f = Rᵀ (m g + f_load),  tau = Rᵀ ((c - o) × m g + (p - o) × f_load + tau_load)
        """
        cell, at = self._world.cell, self._sensor_at
        weight = cell.tool_mass * cell.gravity
        point = cell.load_point + self._world.physics.load_point
        moment = (
            np.cross(turn @ (cell.tool_com - at), weight)
            + np.cross(turn @ (point - at), wrench[:3])
            + wrench[3:]
        )
        back = (turn @ self._sensor_turn).T
        return np.concatenate([back @ (weight + wrench[:3]), back @ moment])

    def _look(self) -> Any:
        """Return the arm's section, or what it was before its writer died while writing."""
        with contextlib.suppress(RuntimeError):
            self._arm = self._board.read("arm")
        return self._arm

    def _swings(self) -> bool:
        """Whether the load has not come to rest yet."""
        swing = self._swing
        if swing is None or self._load == 0:
            return False
        return swing.lasts(self._board.time - self._since)

    def _passing(self, arm: Any, now: float | None = None) -> dict[str, Any]:
        """Return the fields that change while the arm rests."""
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


def _six(what: str, wrench: Sequence[float]) -> Floats:
    """Return a wrench that a person could exert."""
    given = np.asarray(wrench, dtype=float)
    if given.shape != (6,) or not np.all(np.abs(given) <= _STRONGEST):
        raise InputError(
            f"{what} {list(wrench)}; valid: six numbers, N and N·m, at most {_STRONGEST:g}"
        )
    return given


def write_world(path: Path, world: World, config: CellConfig, base_dir: Path | None = None) -> None:
    """Write the world and the configuration of its cell, whole or not at all, with every bit."""
    other = _differences(world.cell, cell_from_config(config, base_dir))
    if other:
        raise InputError(
            f"simulated world: its cell and the configuration differ in {', '.join(other)}; "
            "valid: the configuration that the world was made from"
        )
    content = {
        "config": json.loads(config.to_json()),
        "base_dir": None if base_dir is None else str(base_dir.resolve()),
        "physics": {f.name: _listed(getattr(world.physics, f.name)) for f in fields(Truth)},
        "own": None if world.own is None else world.own.to_json(),
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
            own=None if data["own"] is None else OwnLaw.from_json(cell, data["own"]),
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
    """Return an array as JSON; the shape apart, since one of its numbers may be 0."""
    if array is None:
        return None
    return {"shape": list(array.shape), "values": [float(x) for x in array.ravel()]}


def _array(data: dict[str, Any] | None) -> Any:
    return None if data is None else np.array(data["values"], dtype=float).reshape(data["shape"])


def _differences(a: Cell, b: Cell) -> list[str]:
    """Return the names of what is not the same in two cells; registrations do not count."""
    parts: list[tuple[str, Any, Any, str]] = [(name, a, b, "") for name in _CELL]
    parts += [(name, a.arm, b.arm, "arm.") for name in _ARM]
    return [
        prefix + name.removeprefix("all_")
        for name, x, y, prefix in parts
        if not np.array_equal(getattr(x, name), getattr(y, name))
    ]


_POLL = 0.0025  # s, real time between two looks at the arm


def open_board(directory: Path, scale: float, begun: float = 0.0, joints: int = 6) -> Blackboard:
    """Return the blackboard of a cell; the first who asks makes it, whole or not at all."""
    path = directory / "world.bin"
    if not path.exists():
        new = path.with_name("world.bin.new")
        board = Blackboard.create(new, scale, begun, joints)
        new.replace(path)  # the mapping goes with the file
        return board
    return Blackboard(path)


def start(options: argparse.Namespace) -> admin.Device:
    """Return the world of DIR/world.json, as it goes on."""
    world, config = read_world(options.directory / "world.json")
    board = open_board(options.directory, config.simulation.clock, joints=world.cell.arm.n)
    living = WorldState(world, config, board, options.seed)

    def step() -> None:
        living.step(time.monotonic_ns())
        time.sleep(_POLL)

    living.step(time.monotonic_ns())
    names = ("hang", "mistake", "push", "swing", "state", "log")
    return admin.Operations({name: getattr(living, name) for name in names}), step


if __name__ == "__main__":
    sys.exit(admin.run(__doc__, "world", start))
