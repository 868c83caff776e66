"""A plan: the states to measure, in order. Its file can be edited by a person."""

import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import check_names
from hilcal.readings.readings import SAME_POSE
from hilcal.shown import Brief
from hilcal.toml import read_json, suggest
from hilcal.types import Floats

LARGEST = 1e3  # upper bound of joint angles, rad; a choice: larger numbers show damage
MOST_CYCLES = 1_000_000  # upper bound of cycles in a plan file, far below what a campaign can store
FORMAT = "hilcal-plan"
VERSION = 1
UNLOADED = "none"
REFERENCE = "reference"  # the pose of drift checks and load changes
REFERENCE_POSITION = "reference_seen_m"  # key of `Plan.about`: of the target, sensor axes, m
ARM = "robot"  # key of `Plan.about`: the name of the arm that the plan was made for
DURATION = "duration_s"  # key of `Plan.about`: durations, "total" among them, s
BY_HOME = "by_home"  # key of `Plan.about`: steps that are reached by `Plan.home`, see `skipping`
LEFT_OUT = "left_out"  # key of `Plan.about`: points that are not measured, each with the reason


@dataclass(frozen=True, slots=True)
class Step:
    """A reading to take; (pose, load, cycle) is unique in a campaign."""

    pose: str
    load: str  # name of the load, "none" for unloaded
    cycle: int = 0  # readings of one pose and one cycle share their unloaded reading

    def __str__(self) -> str:
        return f"{self.pose}, {self.load}, cycle {self.cycle}"


@dataclass(frozen=True, slots=True, eq=False)
class Plan(Brief):
    """Poses, and steps in the order of measurement."""

    pose_names: tuple[str, ...]  # P distinct names
    q: Floats  # (P, n) commanded joint angles, rad
    steps: tuple[Step, ...]  # distinct steps
    about: dict[str, Any] = field(default_factory=dict)
    """Further keys of the file: origin and predictions of the plan."""

    def joints(self, pose: str) -> Floats:
        """Return the (n,) joint angles of a pose by name, rad."""
        return np.asarray(self.q[self.pose_names.index(pose)])

    @property
    def loads(self) -> tuple[str, ...]:
        """Names of the loads in the order of their first use, "none" included."""
        return tuple(dict.fromkeys(step.load for step in self.steps))

    @property
    def home(self) -> str:
        """The pose where loads are changed: "reference", or else the first pose."""
        return REFERENCE if REFERENCE in self.pose_names else self.pose_names[0]

    def without(self, done: frozenset[Step]) -> "Plan":
        """Return the plan without the steps in `done`."""
        return replace(self, steps=tuple(step for step in self.steps if step not in done))

    def to_json(self) -> str:
        """Return the plan as a JSON document; `read_plan` reads it back exactly."""
        rows = zip(self.pose_names, np.asarray(self.q, dtype=float).tolist(), strict=True)
        poses = [{"name": name, "q_rad": q} for name, q in rows]
        steps = [asdict(step) for step in self.steps]
        head = {"format": FORMAT, "version": VERSION}
        return json.dumps({**head, **self.about, "poses": poses, "steps": steps}, indent=1)

    def skipping(self, poses: Sequence[str], done: frozenset[Step], cycle: int) -> "Plan":
        """Return the steps that are not in `done`, without those at `poses`, which `about` lists.

        The straight motion past a removed step may not be clear: there the arm moves by the pose
        where loads are changed. It goes to that pose even where its readings are left out. If no
        step remains, it is a reading there, else the last step of `done`. `cycle`: the number of
        the first cycle that is not used in the campaign.
        """
        missing, home = self.without(done).steps, self.home
        valid = list(dict.fromkeys(s.pose for s in missing))
        for pose in poses:
            if pose not in valid:
                raise InputError(
                    f"pose {pose!r} cannot be left out: nothing is missing there"
                    f"{suggest(pose, valid)}; valid: {', '.join(valid) or 'none'}"
                )
        gap, by_home = False, list(self.about.get(BY_HOME, []))
        steps: list[Step] = []
        for step in missing:
            if step.pose in poses:
                gap = True
                continue
            last = steps[-1] if steps else None
            if gap and last and last.load == step.load and home not in (last.pose, step.pose):
                by_home.append(asdict(step))
            steps.append(step)
            gap = False
        new = [{"point": p, "why": "left out by the operator"} for p in dict.fromkeys(poses)]
        left_out = [*self.about.get(LEFT_OUT, []), *new]
        about = {**self.about, LEFT_OUT: left_out, BY_HOME: by_home}
        if not steps and home not in [x["point"] for x in left_out]:
            steps = [Step(home, UNLOADED, cycle)]
        steps = steps or [step for step in self.steps if step in done][-1:]
        if not steps:
            raise InputError(f"without {', '.join(poses)} nothing is left of the plan to measure")
        if isinstance(durations := self.about.get(DURATION), dict):
            share = len(steps) / len(self.steps)
            about[DURATION] = {"total": share * float(durations.get("total", 0.0))}
        return replace(self, steps=tuple(steps), about=about)


@limits.bounded
def load_plan(path: Path) -> Plan:
    """Read a plan file."""
    try:
        missing = "no such plan file; make one with: hilcal plan"
        text = limits.read_text(path, limits.DOCUMENT, missing)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: cannot be read ({error})") from None
    plan = read_plan(text, str(path))
    for k, step in enumerate(plan.steps, start=1):
        if step.cycle >= MOST_CYCLES:
            raise InputError(f"{path}: step {k}: cycle {step.cycle} must be below {MOST_CYCLES}")
    for key, (valid, fits) in _USED_KEYS.items():
        if key in plan.about and not fits(plan.about[key]):
            raise InputError(f'{path}: "{key}" must be {valid}, or be left out')
    return plan


def read_plan(text: str, where: str) -> Plan:
    """Return the plan in a JSON document; `where` names it in messages."""
    data = read_json(text, where)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(f'{where}: not a plan; a plan has "format": "{FORMAT}"')
    if data.get("version") != VERSION:
        raise InputError(f"{where}: version {data.get('version')!r}; this hilcal reads {VERSION}")
    check_names(data, where)
    names, q = _poses(data.get("poses"), where)
    steps = _steps(data.get("steps"), names, where)
    keys = ("format", "version", "poses", "steps")
    return Plan(names, q, steps, {key: x for key, x in data.items() if key not in keys})


def _is_number(x: object) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool) and isfinite(x)


def _is_place(x: object) -> bool:
    return isinstance(x, list) and len(x) == 3 and all(map(_is_number, x))


def _are_left_out(x: object) -> bool:
    keys = {"point", "why"}
    return isinstance(x, list) and all(isinstance(p, dict) and keys <= set(p) for p in x)


def _are_steps(x: object) -> bool:
    keys = {"pose", "load", "cycle"}
    return isinstance(x, list) and all(isinstance(s, dict) and keys == set(s) for s in x)


_USED_KEYS: dict[str, tuple[str, Callable[[object], bool]]] = {
    REFERENCE_POSITION: ("three numbers, m", _is_place),
    BY_HOME: ('a list of objects with "pose", "load" and "cycle"', _are_steps),
    LEFT_OUT: ('a list of objects with "point" and "why"', _are_left_out),
    DURATION: (
        'an object with a number "total", s',
        lambda x: not isinstance(x, dict) or _is_number(x.get("total", 0.0)),
    ),
}
"""Keys of `Plan.about` that a run reads: what is valid, and whether a value is."""
KEYS = (
    *_USED_KEYS, ARM, "order", "made_by", "criterion", "efficiency", "predicted_std",
    "position_std_m", "position", "position_note", "candidates", "suspects", "separates",
    "remarks", "purpose", "points",
)  # fmt: skip
"""All keys of `Plan.about`: also how a plan was made, what it predicts, and what it is for."""


def unknown_keys(plan: Plan) -> tuple[str, ...]:
    """Return keys of `Plan.about` that are not in `KEYS`; names that begin with x_ are free."""
    return tuple(key for key in plan.about if key not in KEYS and not key.startswith("x_"))


def _entries(data: object, kind: str, where: str) -> list[Any]:
    if not isinstance(data, list) or not data:
        raise InputError(f'{where}: "{kind}s" must be a list of at least one {kind}')
    limits.check_planned(where, f"{kind}s", len(data))
    return data


def _poses(data: object, where: str) -> tuple[tuple[str, ...], Floats]:
    rows: dict[str, list[float]] = {}
    for k, pose in enumerate(_entries(data, "pose", where), start=1):
        if not isinstance(pose, dict) or set(pose) != {"name", "q_rad"}:
            raise InputError(f'{where}: pose {k} must have exactly the keys "name" and "q_rad"')
        name, q = pose["name"], pose["q_rad"]
        if not isinstance(name, str) or not name:
            raise InputError(f"{where}: pose {k}: name {name!r} must be a text that is not empty")
        if name in rows:
            raise InputError(f"{where}: two poses have the name {name!r}; names must differ")
        count = len(next(iter(rows.values()), ()))
        numbers = isinstance(q, list) and all(
            isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < LARGEST for x in q
        )
        if not numbers or not q or (count and len(q) != count):
            raise InputError(
                f"{where}: pose {name!r}: q_rad must be a list of {f'{count} ' if count else ''}"
                f"finite numbers, rad, below {LARGEST:g}"
            )
        rows[name] = [float(x) for x in q]
    return tuple(rows), np.array(list(rows.values()))


def _steps(data: object, names: tuple[str, ...], where: str) -> tuple[Step, ...]:
    steps: dict[Step, int] = {}
    for k, step in enumerate(_entries(data, "step", where), start=1):
        keys = set(step) if isinstance(step, dict) else set()
        if not {"pose", "load"} <= keys <= {"pose", "load", "cycle"}:
            raise InputError(f'{where}: step {k} must have "pose" and "load", and may have "cycle"')
        pose, load, cycle = step["pose"], step["load"], step.get("cycle", 0)
        if not isinstance(pose, str) or pose not in names:
            hint = suggest(str(pose), names)
            raise InputError(f"{where}: step {k}: there is no pose {pose!r}{hint}")
        if not isinstance(load, str) or not load:
            raise InputError(f'{where}: step {k}: load {load!r} must be a name, "none" is unloaded')
        if not isinstance(cycle, int) or isinstance(cycle, bool) or cycle < 0:
            raise InputError(f"{where}: step {k}: cycle {cycle!r} must be a whole number from 0")
        parsed = Step(pose, load, cycle)
        if parsed in steps:
            raise InputError(f"{where}: steps {steps[parsed]} and {k} are the same ({parsed})")
        steps[parsed] = k
    return tuple(steps)


def with_new_names(plan: Plan, campaign: Plan, number: int) -> Plan:
    """Return plan number `number` of a campaign with names and cycles that are new in it.

    The reference pose becomes that of the campaign, so that the drift refers to it. A pose with a
    name of the campaign at other joints gets a new name. At the same joints it is the same pose,
    and its readings get new cycles, with separate unloaded readings.
    """
    if plan.q.shape[1] != campaign.q.shape[1]:
        raise InputError(
            f"the plan has {plan.q.shape[1]} joint angles per pose; the campaign has "
            f"{campaign.q.shape[1]}"
        )
    if (REFERENCE in plan.pose_names) != (REFERENCE in campaign.pose_names):
        side = "the plan" if REFERENCE in plan.pose_names else "the campaign"
        raise InputError(f'only {side} has a pose "{REFERENCE}"; valid: both or none')
    existing = dict(zip(campaign.pose_names, campaign.q, strict=True))
    used = {*existing, *plan.pose_names}
    names, q = [], []
    for name, joints in zip(plan.pose_names, plan.q, strict=True):
        same = name == REFERENCE or np.abs(joints - existing.get(name, joints)).max() <= SAME_POSE
        q.append(existing.get(name, joints) if same else joints)
        if not same:
            free = (f"{name}-{number}{f'-{k}' * (k > 1)}" for k in itertools.count(1))
            name = next(new for new in free if new not in used)
            used.add(name)
        names.append(name)
    new = dict(zip(plan.pose_names, names, strict=True))
    last: dict[str, int] = {}
    for step in campaign.steps:
        last[step.pose] = max(last.get(step.pose, -1), step.cycle)
    steps = tuple(
        Step(new[s.pose], s.load, s.cycle + last.get(new[s.pose], -1) + 1) for s in plan.steps
    )
    return replace(plan, pose_names=tuple(names), q=np.array(q), steps=steps)


def joined(first: Plan, done: frozenset[Step], further: Plan) -> Plan:
    """Join the measured steps (`done`) of a previous plan and a further plan."""
    measured = tuple(s for s in first.steps if s in done and s not in further.steps)
    used = {s.pose for s in measured} | {REFERENCE}
    added = [k for k, p in enumerate(first.pose_names) if p in used and p not in further.pose_names]
    return Plan(
        (*further.pose_names, *(first.pose_names[k] for k in added)),
        np.vstack([further.q, first.q[added]]),
        (*measured, *further.steps),
        further.about,
    )
