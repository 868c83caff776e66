"""Where a run in memory leaves what it stores and tells."""

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hilcal.errors import DeviceError
from hilcal.readings.readings import Readings
from hilcal.store.plan import Step
from hilcal.store.stored_schema import DETAIL as Detail
from hilcal.store.stored_schema import check, check_event
from tests.support.fake_world import World


class MemoryStore:
    """Keeps what it is given, as JSON where a file would; may be full."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.full_at: int | None = None
        self.rows: list[tuple[Step, Readings, str]] = []
        self.events: list[tuple[str, dict[str, Any]]] = []

    def record(self, reading: Readings, step: Step, detail: dict[str, Any]) -> None:
        self.world.call("store.record")
        if self.full_at == len(self.rows):
            raise DeviceError("run.hilcal: the disk is full")
        assert len(reading) == 1
        assert not self.world.is_moving, "stored in motion"
        text = json.dumps(detail, allow_nan=False)
        check(Detail, json.loads(text))
        self.rows.append((step, reading, text))
        self.world.call("store.recorded")

    def event(self, kind: str, content: dict[str, Any]) -> None:
        self.world.call("store.event")
        check_event(json.loads(json.dumps({"kind": kind, "utc": "now", **content})))
        self.events.append((kind, content))

    def done(self) -> frozenset[Step]:
        return frozenset(step for step, _, _ in self.rows)

    def details(self) -> list[dict[str, Any]]:
        return [json.loads(text) for _, _, text in self.rows]

    def readings(self) -> Readings | None:
        if not self.rows:
            return None
        rows = [reading for _, reading, _ in self.rows]
        poses = tuple(dict.fromkeys(r.pose_names[0] for r in rows))
        loads = tuple(dict.fromkeys(r.load_names[0] for r in rows))
        states = {
            name: np.concatenate([getattr(r.states, name) for r in rows])
            for name in rows[0].states.__dataclass_fields__
            if getattr(rows[0].states, name) is not None
        }
        return Readings(
            states=type(rows[0].states)(**states),
            pose=np.array([poses.index(r.pose_names[0]) for r in rows]),
            load=np.array([loads.index(r.load_names[0]) for r in rows]),
            cycle=np.concatenate([r.cycle for r in rows]),
            value=np.concatenate([r.value for r in rows]),
            covariance=np.concatenate([r.covariance for r in rows]),
            load_names=loads,
            pose_names=poses,
        )

    def kinds(self) -> list[str]:
        """Kinds of the events, in order."""
        return [kind for kind, _ in self.events]

    def last(self, kind: str) -> dict[str, Any]:
        """The newest event of a kind."""
        return next(content for k, content in reversed(self.events) if k == kind)


@dataclass
class Notes:
    """A watcher that remembers."""

    told: list[object] = field(default_factory=list)

    def notify(self, event: object) -> None:
        self.told.append(event)

    def of(self, kind: type) -> list[Any]:
        """What was told of one kind."""
        return [event for event in self.told if isinstance(event, kind)]
