"""Measured joint torques against those of the described masses and loads.

The torque τ_ij that drive j was measured to exert in reading i is

    τ_ij = −Σ_l a_l L_lij − b W_ij − c T_ij + o_j + d_j s_ij + ε_ij,      ε_ij ~ N(0, σ_j²)

L_l the torque of load l as stated, W of the arm's masses, T of the tool's mass, o_j an offset,
d_j Coulomb friction where the side s_ij of the approach is recorded. The factors a, b, c are 1
where the description is right. Those of the loads come from differences between the readings of
one pose, from which all that does not depend on the load cancels; b and c from the poses' means.
σ_j is estimated from the residual of each drive, so that friction of unknown direction widens the
intervals.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np
import scipy

from hilcal.cell import Cell
from hilcal.errors import InputError
from hilcal.readings.readings import Readings, States
from hilcal.robot.chain import evaluate
from hilcal.robot.statics import Load, slot_wrenches
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats, Ints

ARM, TOOL = "the arm's masses", "the tool's mass"
CONFIDENCE = 0.95
TEST_LEVEL = 1e-3  # two-sided p-value below which a factor differs from 1; a choice
LEAST_DIFFERENCE = 0.02
"""Share by which it has to differ: torque constants are known to some %; a choice."""
MOST_ROUNDS = 4  # times that the noise of the drives is estimated anew; a choice
ROUNDING = 1e-6  # torques below this share of the largest are rounding

_Factor = tuple[float, float, float, float]
"""Estimate, lower and upper end of its interval, p-value of 1."""


@dataclass(frozen=True, slots=True)
class TorqueFactor:
    """How large a cause of torques is, in units of its description."""

    of: str  # the load's name, `ARM` or `TOOL`
    factor: float  # estimate; 1 where the description is right
    low: float  # lower end of its 95 % interval
    high: float  # upper end
    stated_kg: float | None  # the described mass; None for a load that is no weight
    differs: bool  # whether it differs from the description


@dataclass(frozen=True, slots=True, eq=False)
class TorqueCheck:
    """Measured against modelled torques."""

    factors: tuple[TorqueFactor, ...]  # of loads, arm and tool, those that are determined
    std_Nm: Floats  # (n,) standard deviation of the residual of each drive, N·m

    def to_json(self) -> dict[str, object]:
        """Return its JSON."""
        return {"factors": [asdict(f) for f in self.factors], "std_Nm": self.std_Nm.tolist()}


def modelled_torques(cell: Cell, states: States, wrench: Floats, arm: bool, tool: bool) -> Floats:
    """(N, n) static torques of a load's wrench (N, 6), and of the arm's and the tool's masses."""
    angle = states.q if states.q_actual is None else states.q_actual
    bare = cell.arm if arm else replace(cell.arm, masses=np.zeros(cell.arm.n))
    load = Load(wrench, cell.load_point, cell.tool_mass * tool, cell.tool_com, cell.gravity)
    torques = slot_wrenches(bare, evaluate(cell.arm, angle), load)[:, :-1, 5]
    return np.asarray(cell.arm.drive_torques(torques))


def require_torques(cell: Cell, readings: Readings) -> None:
    """Refuse a cell that asks for measured torques of readings that have none."""
    torque = readings.states.torque
    lost = 0 if torque is None else int(np.isnan(torque).any(axis=1).sum())
    if not cell.measured_torques or (torque is not None and not lost):
        return
    reason = "the readings have no columns tau1_Nm, ..."
    if torque is not None:
        reason = f"{lost} of {len(readings)} readings have none"
    raise InputError(
        f'[robot] torques = "measured", but {reason}; valid: readings with them, or torques = '
        '"modelled"'
    )


def check_torques(cell: Cell, readings: Readings) -> TorqueCheck | None:
    """Compare measured with modelled torques; None where no reading has measured ones."""
    if readings.states.torque is None:
        return None
    readings = readings[np.flatnonzero(~np.isnan(readings.states.torque).any(axis=1))]
    states, torque = readings.states, readings.states.torque
    if torque is None or not len(readings):
        return None
    none = np.zeros_like(states.wrench)
    loads: dict[str, Floats] = {}
    for k in np.unique(readings.load):
        wrench = states.wrench * (readings.load == k)[:, None]
        if wrench.any():
            torques = modelled_torques(cell, states, wrench, False, False)
            loads[readings.load_names[k]] = -torques
    body = {
        ARM: -modelled_torques(cell, states, none, True, False),
        TOOL: -modelled_torques(cell, states, none, False, True),
    }
    visits = np.stack([readings.pose, readings.cycle], axis=1)
    group = np.unique(visits, axis=0, return_inverse=True)[1].reshape(-1)
    side = {} if states.approach is None else {"side": states.approach}

    def centred(parts: Mapping[str, Floats]) -> dict[str, Floats]:
        return {k: x - _means(x, group)[group] for k, x in parts.items()}

    def means(parts: Mapping[str, Floats]) -> dict[str, Floats]:
        return {k: _means(x, group) for k, x in parts.items()}

    pairs = zip(centred(loads).values(), loads.values(), strict=True)
    determined = [np.abs(x).max() > ROUNDING * max(np.abs(y).max(), 1e-12) for x, y in pairs]
    if loads and all(determined):  # every load by differences between the readings of one pose
        lost = len(np.unique(group))
        y = centred({"y": torque})["y"]
        estimates, std = _fitted(y, centred(loads), centred(side), lost)
        remainder = torque - sum((estimates[k][0] * loads[k] for k in estimates), np.zeros(()))
        estimates = estimates | _fitted(_means(remainder, group), means(body), means(side), 0)[0]
    else:
        estimates, std = _fitted(torque, loads | body, side, 0)
    factors = [_factor(cell, readings, k, *estimates[k]) for k in (*loads, *body) if k in estimates]
    return TorqueCheck(tuple(factors), std)


def _means(x: Floats, group: Ints) -> Floats:
    out = np.zeros((int(group.max()) + 1, x.shape[1]))
    np.add.at(out, group, x)
    return np.asarray(out / np.bincount(group)[:, None])


def _fitted(
    y: Floats, causes: Mapping[str, Floats], side: Mapping[str, Floats], lost: int
) -> tuple[dict[str, _Factor], Floats]:
    """Return the factors of the causes that are determined, and the drives' noise (n,).

    The sides of the approach (N, n) are fitted with them, but have no factor. Centring `y` took
    `lost` degrees of freedom from each drive; where it took none, a drive has an offset.
    """
    count, n = y.shape
    largest = max([float(np.abs(x).max()) for x in causes.values()], default=0.0)
    names = [k for k, x in causes.items() if np.abs(x).max() > ROUNDING * largest]
    columns = [causes[k].T.reshape(-1) for k in names]
    unit = np.eye(n)
    if not lost:
        columns += [np.kron(unit[j], np.ones(count)) for j in range(n)]
    columns += [
        np.kron(unit[j], s[:, j]) for s in side.values() for j in range(n) if np.ptp(s[:, j]) > 0
    ]
    a = np.stack(columns, axis=1) if columns else np.zeros((n * count, 0))
    b, std = y.T.reshape(-1), np.ones(n)
    dof_of_each = max(count - lost - a.shape[1] / n, 1.0)
    for _ in range(MOST_ROUNDS):
        w = np.repeat(1.0 / std, count)
        u, s, vt = np.linalg.svd(a * w[:, None], full_matrices=False)
        regular = s > 1e-9 * max(float(s.max(initial=0.0)), 1e-300)
        back = vt[regular].T / s[regular]
        x, cov = back @ (u[:, regular].T @ (b * w)), back @ back.T
        square = np.sum((b - a @ x).reshape(n, count) ** 2, axis=1)
        std = np.maximum(np.sqrt(square / dof_of_each), 1e-9 * (1 + np.abs(b).max()))
    null = np.abs(vt[~regular]).max(axis=0, initial=0.0)
    dof = max(n * (count - lost) - a.shape[1], 1)
    half, out = float(scipy.stats.t.ppf(0.5 + CONFIDENCE / 2, dof)), {}
    for k, name in enumerate(names):
        if null[k] <= 1e-6:
            value, size = float(x[k]), float(np.sqrt(cov[k, k]))
            p = 2 * float(scipy.stats.t.sf(abs(value - 1) / max(size, 1e-12), dof))
            out[name] = (value, value - half * size, value + half * size, p)
    return out, std


def _factor(
    cell: Cell, r: Readings, name: str, value: float, low: float, high: float, p: float
) -> TorqueFactor:
    stated: float | None = None
    g = float(np.linalg.norm(cell.gravity))
    if name == ARM:
        stated = float(cell.arm.masses.sum())
    elif name == TOOL:
        stated = cell.tool_mass
    elif name in r.load_names and name != UNLOADED and g:
        force = r.states.wrench[r.load == r.load_names.index(name), :3]
        if np.all(np.linalg.norm(np.cross(force, cell.gravity), axis=1) < 1e-3 * g):
            stated = float(np.mean(force @ cell.gravity)) / g**2
    differs = p < TEST_LEVEL and abs(value - 1) > LEAST_DIFFERENCE
    return TorqueFactor(name, value, low, high, stated, differs)
