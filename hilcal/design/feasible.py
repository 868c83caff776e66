"""Which states a plan may use: those that the cell allows with margins; candidates among them."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.errors import CannotAnswerError
from hilcal.measuring.clearance import TRACKER_UNKNOWN
from hilcal.measuring.feasibility import STATE, Feasibility, Margins
from hilcal.measuring.route import beside
from hilcal.robot.chain import evaluate, joint_jacobian
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats

PLANNED = Margins(joint=1e-6, inside=0.02, clear=0.02, itself=0.01, bear=0.98)  # choices

REASONS = {
    "joint limits": ("keep the joint limits", "[limits] joint_margin_rad"),
    "payload": ("keep the payload", "[tool] mass_kg, [[loads]] mass_kg"),
    "workspace": ("keep workspace and floor", "[limits] workspace_min_m, workspace_max_m"),
    "incidence": ("turn the target to the tracker", "[sight] incidence_max_rad, target_normal"),
    "torque": ("keep the joint torques", "[limits] torque_share"),
    "force sensor": ("keep the force sensor's range", "[force_sensor] max_force_N, max_moment_Nm"),
    "singularity": ("are not singular", "[planning] singularity"),
    "self-collision": (
        "do not touch themselves",
        "[tool] target_m, load_point_m in flange axes, [robot] model",
    ),
    "obstacle": ("are clear of obstacles", "[[obstacles]]"),
    "sight": ("leave the beam free", "[sight] clearance_m, [[obstacles]], the tracker's place"),
    "hanging": ("let what hangs or pulls hang free", "[[loads]] hang_m, radius_m, cable_m"),
}
"""Why a state may be left out, in the order of checking (cheap ones and those that leave little
first): what the states that stay do, and what in the cell's configuration decides it."""


class Space(Feasibility):
    """The states that a plan may use: `Feasibility` with margins, at most half a turn a joint."""

    def __init__(self, cell: Cell, config: CellConfig, margins: Margins = PLANNED) -> None:
        """Build the shapes once."""
        super().__init__(cell, config, margins)

    @property
    def low(self) -> Floats:
        """(n,) lowest usable joint values, rad or m; at most half a turn."""
        return np.asarray(self.cell.arm.usual_range[0] + self._margin)

    @property
    def high(self) -> Floats:
        """(n,) highest usable joint values, rad or m; at most half a turn."""
        return np.asarray(self.cell.arm.usual_range[1] - self._margin)

    @property
    def _margin(self) -> float:
        return self.config.limits.joint_margin_rad + self.margins.joint

    @property
    def loads(self) -> tuple[str, ...]:
        """1 + L names of the loads, "none" first."""
        return (UNLOADED, *(load.name for load in self.config.loads))

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is not checked, or is guessed, since it is not configured."""
        return (*(() if self.sight is not None else (TRACKER_UNKNOWN,)), *super().remarks)

    def reasons(self, q: Floats, load: str = UNLOADED) -> dict[str, Bools]:
        """Return by reason, in the order of `REASONS`, (N,) which states (N, n) keep it."""
        return {reason: self.keeps(reason, q, load) for reason in REASONS}

    def keeps(self, kind: str, q: Floats, load: str = UNLOADED) -> Bools:
        """Return (N,) which states keep one of `REASONS` under a load."""
        if kind == "joint limits":
            return np.asarray(np.all((q >= self.low) & (q <= self.high), axis=1))
        return self._regular(q) if kind == "singularity" else super().keeps(kind, q, load)

    def allowed(
        self, q: Floats, load: str = UNLOADED, kinds: tuple[str, ...] = tuple(REASONS)
    ) -> Bools:
        """Return (N,) which states keep all of some reasons under a load; cheap ones first."""
        return super().allowed(q, load, kinds)

    def clear(self, q: Floats) -> Bools:
        """Return (N,) which states keep all but torques and sensor, under every load."""
        geometry = tuple(r for r in REASONS if r not in ("torque", "payload", "force sensor"))
        good = self.allowed(q, UNLOADED, geometry)
        for load in self.loads[1:]:
            good[good] = self.allowed(q[good], load, ("sight", "hanging"))
        return good

    def begins(self, q: Floats, loads: Iterable[str]) -> bool:
        """Return whether a run may begin and read again at a state (n,) under some loads."""
        away = beside(q, self.cell.arm, self.config.limits.joint_margin_rad)[None]
        return all(
            self.allowed(away, load, STATE).all() and self.passable(q, away, load).all()
            for load in loads
        )

    def _regular(self, q: Floats) -> Bools:
        """σ_min ≥ [planning] singularity · σ_max of the flange's Jacobian, lengths by the reach."""
        least = self.config.planning.singularity
        if least == 0.0 or not len(q):
            return np.ones(len(q), dtype=np.bool_)
        chain = evaluate(self.cell.arm, q)
        jacobian = np.array(joint_jacobian(chain, chain.position[-1]))
        jacobian[:, :3] /= self.cell.arm.reach
        sigma = np.linalg.svd(jacobian, compute_uv=False)
        return np.asarray(sigma[:, -1] >= least * sigma[:, 0])


_CHUNK = 1 << 12
_VAIN = 1 << 15  # drawn states after which nothing will come
_MOST = 1 << 19, 64  # drawn at most: so many states, or so many per candidate
_OF_PAIRS = ("self-collision", "obstacle")
_LOOK = 64  # states of which is told what touches
_OF_LOADS = ("payload", "torque", "force sensor", "hanging", "sight")


@dataclass(frozen=True, slots=True, eq=False)
class DrawnPoses:
    """K poses that are allowed unloaded, and the loads that each may bear."""

    q: Floats  # (K, n) joint angles, rad
    loads: tuple[str, ...]  # 1 + L names, "none" first
    allowed: Bools  # (K, 1 + L) which loads each pose bears
    drawn: int  # how many states were looked at
    left: dict[str, int]  # by reason, how many of them were left after it, in the order of checking
    remarks: tuple[str, ...]  # what people should know


def draw(
    space: Space,
    count: int,  # poses wanted; fewer where the cell leaves fewer
    rng: np.random.Generator,  # shift of the sequence
    *,
    least: int = 1,  # so many have to be found
    most: int | None = None,  # so many states are drawn at most; by default many times `count`
) -> DrawnPoses:
    """Return poses from a Sobol sequence over the joint space, turned by a random shift."""
    low, high = space.low, space.high
    if np.any(low >= high):
        j = int(np.argmax(low - high)) + 1
        raise CannotAnswerError(f"joint_margin_rad leaves joint {j} no range; lower it")
    from scipy.stats import qmc  # slow to import

    sequence = qmc.Sobol(len(low), scramble=False)
    shift = rng.random(len(low))
    left, lost = dict.fromkeys(REASONS, 0), dict[str, Floats]()
    found = [np.empty((0, len(low)))]
    drawn = have = 0
    most = max(_MOST[0], _MOST[1] * count) if most is None else most
    while have < count and drawn < (most if have else _VAIN):
        u = (sequence.random(_CHUNK) + shift) % 1.0
        q = space.cell.arm.complete(low + u * (high - low))
        found.append(_kept(space, q, left, lost))
        drawn += _CHUNK
        have += len(found[-1])
    if have < least:
        raise CannotAnswerError(_too_few(space, drawn, left, lost, least))
    q = np.vstack(found)[:count]
    allowed = np.ones((len(q), len(space.loads)), dtype=np.bool_)
    remarks = [*space.remarks]
    if len(q) < count:
        remarks.append(f"{drawn:,} drawn states gave {len(q):,} of {count:,} candidates")
    for k, load in enumerate(space.loads[1:], start=1):
        allowed[:, k] = space.allowed(q, load, _OF_LOADS)
        if not allowed[:, k].any():
            remarks.append(_unusable(space, q, load))
    if len(space.loads) > 1 and not allowed[:, 1:].any():
        raise CannotAnswerError("; ".join(remarks[-(len(space.loads) - 1) :]))
    return DrawnPoses(q, space.loads, allowed, drawn, left, tuple(remarks))


def _kept(space: Space, q: Floats, left: dict[str, int], lost: dict[str, Floats]) -> Floats:
    """Return the states that are allowed unloaded; note what each reason leaves and takes."""
    for reason in REASONS:
        if len(q):
            keeps = space.keeps(reason, q, UNLOADED)
            if not keeps.all():
                lost[reason] = q[~keeps][:_LOOK]
            q = q[keeps]
        left[reason] += len(q)
    return q


def _too_few(
    space: Space, drawn: int, left: dict[str, int], lost: dict[str, Floats], least: int
) -> str:
    """What leaves too few: the first reason that leaves none, else the one that takes most."""
    counts = list(left.values())
    names = list(left)
    before = [drawn, *counts[:-1]]
    share = np.array(counts) / np.maximum(before, 1)
    worst = counts.index(0) if 0 in counts else int(np.argmin(share))
    told = [
        f"{n:,} {REASONS[reason][0]}"
        for reason, n, b in zip(names[: worst + 1], counts, before, strict=False)
        if n < b
    ]
    head = "no pose" if counts[-1] == 0 else f"only {counts[-1]:,} poses, {least:,} are needed"
    why = _touching(space, names[worst], lost) or REASONS[names[worst]][1]
    return f"{head}: of {drawn:,} drawn states {', '.join(told)} ({why})"


def _touching(space: Space, reason: str, lost: dict[str, Floats]) -> str:
    """Name the bodies that touch in most of the states that were lost, and what to look at."""
    if reason not in _OF_PAIRS or reason not in lost:
        return ""
    met = Counter(
        found.of for q in lost[reason] for found in space.findings(q[None], UNLOADED, (reason,))
    )
    if not met:
        return ""
    (pair, count), look = met.most_common(1)[0], REASONS[reason][1]
    return f"{pair} touch in {100 * count // len(lost[reason])} % of the others; look at {look}"


def _unusable(space: Space, q: Floats, load: str) -> str:
    if (heavy := space.unbearable(load).get("payload")) is not None:
        return heavy
    told = []
    before = len(q)
    for reason in _OF_LOADS:
        q = q[space.keeps(reason, q, load)]
        if len(q) < before:
            told.append(f"{len(q):,} {REASONS[reason][0]}")
        if not len(q):
            return (
                f'load "{load}": no pose: of {before:,} feasible poses {", ".join(told)} '
                f"({REASONS[reason][1]})"
            )
        before = len(q)
    return f'load "{load}": no pose'
