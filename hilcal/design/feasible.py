"""Which states a plan may use: those that the cell allows with margins, and that tell something."""

from collections.abc import Iterable

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.measuring.clearance import TRACKER_UNKNOWN
from hilcal.measuring.feasibility import STATE, Feasibility, Margins
from hilcal.measuring.route import beside
from hilcal.robot.chain import evaluate, joint_jacobian
from hilcal.store.plan import UNLOADED
from hilcal.types import Bools, Floats

PLANNED = Margins(joint=1e-6, inside=0.02, clear=0.02, itself=0.01, bear=0.98)
"""What a planner keeps beyond the limits: choices, no study behind them."""

REASONS = {
    "joint limits": ("keep the joint limits", "[limits] joint_margin_rad"),
    "workspace": ("keep workspace and floor", "[limits] workspace_min_m, workspace_max_m"),
    "self-collision": (
        "do not touch themselves",
        "[tool] target_m, load_point_m in flange axes, [robot] model",
    ),
    "obstacle": ("are clear of obstacles", "[[obstacles]]"),
    "singularity": ("are not singular", "[planning] singularity"),
    "torque": ("keep the joint torques", "[limits] torque_share"),
    "payload": ("keep the payload", "[tool] mass_kg, [[loads]] mass_kg"),
    "force sensor": ("keep the force sensor's range", "[force_sensor] max_force_N, max_moment_Nm"),
    "sight": ("leave the beam free", "[sight] clearance_m, [[obstacles]], the tracker's place"),
    "incidence": ("turn the target to the tracker", "[sight] incidence_max_rad, target_normal"),
    "hanging": ("let what hangs or pulls hang free", "[[loads]] hang_m, radius_m, cable_m"),
}
"""Why a state may be left out, cheap and common reasons first: what the states that stay do, and
what in the cell's configuration decides it."""


class Space(Feasibility):
    """The states that a plan may use: `Feasibility` with margins, at most half a turn of a joint.

    All targets have to be seen, and the pose is no singular one.
    """

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
        """Return by reason (N,) which states keep it; in the order of `REASONS`.

        Args:
            q: (N, n) joint angles, rad.
        """
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
        """Return whether a run may begin and read again at a state (n,) under some loads.

        The arm comes there from `beside` it.
        """
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
