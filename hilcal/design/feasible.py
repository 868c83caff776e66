"""Feasible states: those that the cell allows with margins; candidates among them."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from hilcal.cell import Cell
from hilcal.errors import CannotAnswerError
from hilcal.measuring.clearance import TRACKER_UNKNOWN
from hilcal.measuring.feasibility import STATE_CHECKS, Feasibility, Margins
from hilcal.measuring.route import approach_pose
from hilcal.robot.chain import evaluate, joint_jacobian
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats

PLANNING_MARGINS = Margins(
    joint=1e-6, workspace=0.02, clearance=0.02, self_collision=0.01, torque_share=0.98
)  # choices

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
"""Checks of a state in their order (cheap and frequently failed ones first): a phrase on the states
that pass, and the configuration keys that decide."""


class FeasibleSpace(Feasibility):
    """Feasible states of a plan: `Feasibility` with margins, at most half a turn per joint."""

    def __init__(self, cell: Cell, margins: Margins = PLANNING_MARGINS) -> None:
        """Build the shapes once."""
        config = cell.configured()
        super().__init__(cell, margins)
        low, high = cell.arm.usual_range
        margin = config.limits.joint_margin_rad + margins.joint
        self.low, self.high = low + margin, high - margin  # (n,) usable joint values, rad or m
        self.loads = (UNLOADED, *(load.name for load in config.loads))  # names, "none" first

    @property
    def remarks(self) -> tuple[str, ...]:
        """Checks that are omitted or use assumed values, where the configuration lacks a key."""
        return (*(() if self.sight is not None else (TRACKER_UNKNOWN,)), *super().remarks)

    def reasons(self, q: Floats, load: str = UNLOADED) -> dict[str, Bools]:
        """Return which of (N, n) states pass each reason (N,), in the order of `REASONS`."""
        return {reason: self.passes(reason, q, load) for reason in REASONS}

    def passes(self, kind: str, q: Floats, load: str = UNLOADED) -> Bools:
        """Return (N,) which states pass one of `REASONS` under a load."""
        if kind == "joint limits":
            return np.asarray(np.all((q >= self.low) & (q <= self.high), axis=1))
        if kind != "singularity":
            return super().passes(kind, q, load)
        # σ_min ≥ [planning] singularity · σ_max of the flange's Jacobian over the reach
        least = self.config.planning.singularity
        if least == 0.0 or not len(q):
            return np.ones(len(q), dtype=np.bool_)
        chain = evaluate(self.cell.arm, q)
        jacobian = np.array(joint_jacobian(chain, chain.position[-1]))
        jacobian[:, :3] /= self.cell.arm.reach
        sigma = np.linalg.svd(jacobian, compute_uv=False)
        return np.asarray(sigma[:, -1] >= least * sigma[:, 0])

    def allowed(
        self, q: Floats, load: str = UNLOADED, kinds: tuple[str, ...] = tuple(REASONS)
    ) -> Bools:
        """Return (N,) which states pass all of some reasons under a load; cheap ones first."""
        return super().allowed(q, load, kinds)

    def collision_free(self, q: Floats) -> Bools:
        """Return (N,) which states pass the geometric reasons under every load."""
        geometry = tuple(r for r in REASONS if r not in ("torque", "payload", "force sensor"))
        good = self.allowed(q, UNLOADED, geometry)
        for load in self.loads[1:]:
            good[good] = self.allowed(q[good], load, ("sight", "hanging"))
        return good

    def can_start(self, q: Floats, loads: Iterable[str]) -> bool:
        """Return whether a run may begin and read again at a state (n,) under some loads."""
        away = approach_pose(q, self.cell.arm, self.config.limits.joint_margin_rad)[None]
        return all(
            self.allowed(away, load, STATE_CHECKS).all() and self.passable(q, away, load).all()
            for load in loads
        )


_CHUNK = 1 << 12
_ALL_REJECTED = 1 << 15  # drawn states, all rejected, after which drawing stops
_MOST_DRAWN = 1 << 19, 64  # drawn states at most: the larger of a total, and a number per candidate
_OF_PAIRS = ("self-collision", "obstacle")
_REJECTED_SAMPLE = 64  # rejected states whose contacts are counted for a message
_OF_LOADS = ("payload", "torque", "force sensor", "hanging", "sight")


@dataclass(frozen=True, slots=True, eq=False)
class DrawnPoses:
    """K poses that are allowed unloaded, and the loads that each can bear."""

    q: Floats  # (K, n) joint angles, rad
    loads: tuple[str, ...]  # 1 + L names, "none" first
    allowed: Bools  # (K, 1 + L) loads that each pose bears
    remarks: tuple[str, ...]  # for people


def draw_poses(
    space: FeasibleSpace,
    count: int,  # poses at most
    rng: np.random.Generator,  # shift of the sequence
    *,
    min_poses: int = 1,  # poses at least
    max_states: int | None = None,  # states drawn at most; by default many times `count`
) -> DrawnPoses:
    """Return poses from a Sobol sequence over the joint space, shifted at random modulo 1."""
    low, high = space.low, space.high
    if np.any(low >= high):
        j = int(np.argmax(low - high)) + 1
        raise CannotAnswerError(f"joint_margin_rad leaves joint {j} no range; lower it")
    from scipy.stats import qmc  # slow to import

    sequence = qmc.Sobol(len(low), scramble=False)
    shift = rng.random(len(low))
    # states that pass up to each reason, and samples of those that it rejects
    remaining, rejected = dict.fromkeys(REASONS, 0), dict[str, Floats]()
    parts = [np.empty((0, len(low)))]
    drawn = accepted = 0
    max_states = max(_MOST_DRAWN[0], _MOST_DRAWN[1] * count) if max_states is None else max_states
    while accepted < count and drawn < (max_states if accepted else _ALL_REJECTED):
        u = (sequence.random(_CHUNK) + shift) % 1.0
        q = space.cell.arm.complete(low + u * (high - low))
        for reason in REASONS:
            if len(q):
                passes = space.passes(reason, q, UNLOADED)
                if not passes.all():
                    rejected[reason] = q[~passes][:_REJECTED_SAMPLE]
                q = q[passes]
            remaining[reason] += len(q)
        parts.append(q)
        drawn += _CHUNK
        accepted += len(q)
    if accepted < min_poses:
        raise CannotAnswerError(_too_few(space, drawn, remaining, rejected, min_poses))
    q = np.vstack(parts)[:count]
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
    return DrawnPoses(q, space.loads, allowed, tuple(remarks))


def _too_few(
    space: FeasibleSpace,
    drawn: int,
    remaining: dict[str, int],
    rejected: dict[str, Floats],
    least: int,
) -> str:
    """Return a message: the first reason that leaves no state, else the one that rejects most."""
    names, counts = list(remaining), list(remaining.values())
    checked = [drawn, *counts[:-1]]
    share = np.array(counts) / np.maximum(checked, 1)
    worst = counts.index(0) if 0 in counts else int(np.argmin(share))
    phrases = [
        f"{n:,} {REASONS[reason][0]}"
        for reason, n, n_before in zip(names[: worst + 1], counts, checked, strict=False)
        if n < n_before
    ]
    head = "no pose" if counts[-1] == 0 else f"only {counts[-1]:,} poses, {least:,} are needed"
    why = _touching(space, names[worst], rejected) or REASONS[names[worst]][1]
    return f"{head}: of {drawn:,} drawn states {', '.join(phrases)} ({why})"


def _touching(space: FeasibleSpace, reason: str, rejected: dict[str, Floats]) -> str:
    """Name the bodies that touch in most of the rejected states, and the keys to look at."""
    if reason not in _OF_PAIRS or reason not in rejected:
        return ""
    pairs = Counter(
        finding.subject
        for q in rejected[reason]
        for finding in space.findings(q[None], UNLOADED, (reason,))
    )
    if not pairs:
        return ""
    (pair, count), keys = pairs.most_common(1)[0], REASONS[reason][1]
    share = 100 * count // len(rejected[reason])
    return f"{pair} touch in {share} % of the others; look at {keys}"


def _unusable(space: FeasibleSpace, q: Floats, load: str) -> str:
    if (heavy := space.unbearable(load).get("payload")) is not None:
        return heavy
    phrases = []
    count = len(q)
    for reason in _OF_LOADS:
        q = q[space.passes(reason, q, load)]
        if len(q) < count:
            phrases.append(f"{len(q):,} {REASONS[reason][0]}")
        if not len(q):
            return (
                f'load "{load}": no pose: of {count:,} feasible poses {", ".join(phrases)} '
                f"({REASONS[reason][1]})"
            )
        count = len(q)
    return f'load "{load}": no pose'
