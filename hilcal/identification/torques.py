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

from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.stats import t as student

from hilcal.cell import Cell
from hilcal.errors import InputError
from hilcal.readings.readings import Readings, States
from hilcal.robot.chain import evaluate
from hilcal.robot.statics import Load, slot_wrenches
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats

ARM, TOOL = "the arm's masses", "the tool's mass"
LEVEL = 0.95
SURE = 1e-3
"""Two-sided p-value below which a factor differs from 1; a choice."""
LEAST = 0.02
"""Share by which a factor has to differ to be worth a word; a choice: motors' torque constants are
known to a few per cent."""
ROUNDS = 4
"""Times that the noise of the drives is estimated anew; a choice."""
TOLD = 1e-6
"""Torques below this share of the largest tell nothing of their cause, rounding apart."""


@dataclass(frozen=True, slots=True)
class TorqueFactor:
    """How large a cause of torques is, in units of its description.

    Attributes:
        of: the load's name, `ARM` or `TOOL`.
        factor: estimate; 1 where the description is right.
        low: lower end of its 95 % interval.
        high: upper end.
        stated_kg: the mass as described; None where it is not one of a weight.
        differs: whether it is another than described.
    """

    of: str
    factor: float
    low: float
    high: float
    stated_kg: float | None
    differs: bool


@dataclass(frozen=True, slots=True, eq=False)
class TorqueCheck:
    """Measured against modelled torques.

    Attributes:
        factors: of loads, arm and tool, as far as the readings tell them.
        std_Nm: (n,) standard deviation of what is left, of each drive, N·m.
    """

    factors: tuple[TorqueFactor, ...]
    std_Nm: Floats

    def to_json(self) -> dict[str, object]:
        """Return its JSON."""
        return {"factors": [asdict(f) for f in self.factors], "std_Nm": self.std_Nm.tolist()}


def modelled_torques(cell: Cell, states: States, wrench: Floats, arm: bool, tool: bool) -> Floats:
    """(N, n) static torques of a load's wrench (N, 6), and of the arm's and the tool's masses."""
    angle = states.q if states.q_actual is None else states.q_actual
    bare = cell.arm if arm else replace(cell.arm, masses=np.zeros(cell.arm.n))
    load = Load(wrench, cell.load_point, cell.tool_mass * tool, cell.tool_com, cell.gravity)
    found = slot_wrenches(bare, evaluate(cell.arm, angle), load)[:, :-1, 5]
    return np.asarray(cell.arm.drive_torques(found))


def require_torques(cell: Cell, readings: Readings) -> None:
    """Refuse a cell that asks for measured torques of readings that have none.

    Raises:
        InputError: says so.
    """
    if not cell.measured_torques:
        return
    torque = readings.states.torque
    if torque is None:
        raise InputError(
            '[robot] torques = "measured", but the readings have no columns tau1_Nm, ...; valid: '
            'readings with them, or torques = "modelled"'
        )
    if lost := int(np.isnan(torque).any(axis=1).sum()):
        raise InputError(
            f'[robot] torques = "measured", but {lost} of {len(readings)} readings have none; '
            'valid: readings with them, or torques = "modelled"'
        )


def check_torques(cell: Cell, readings: Readings) -> TorqueCheck | None:
    """Compare measured with modelled torques, of the readings that have some; None without.

    Args:
        cell: arm, tool and gravity as described.
        readings: N readings.
    """
    if readings.states.torque is None:
        return None
    readings = readings[np.flatnonzero(~np.isnan(readings.states.torque).any(axis=1))]
    states = readings.states
    if states.torque is None or not len(readings):
        return None
    none = np.zeros_like(states.wrench)
    own: dict[str, Floats] = {}
    for k in np.unique(readings.load):
        mine = (readings.load == k)[:, None]
        if (states.wrench * mine).any():
            own[readings.load_names[k]] = -modelled_torques(
                cell, states, states.wrench * mine, False, False
            )
    body = {
        ARM: -modelled_torques(cell, states, none, True, False),
        TOOL: -modelled_torques(cell, states, none, False, True),
    }
    visit = np.unique(
        np.stack([readings.pose, readings.cycle], axis=1), axis=0, return_inverse=True
    )
    group = visit[1].reshape(-1)
    paired = bool(np.any(np.bincount(group) > 1)) and _within(group, own)
    side = [] if states.approach is None else [states.approach]
    if paired:
        loads, std = _fitted(
            _centred(states.torque, group),
            {name: _centred(x, group) for name, x in own.items()},
            [_centred(s, group) for s in side],
            len(np.unique(group)),
        )
        rest = states.torque - sum(
            (loads[name][0] * x for name, x in own.items() if name in loads), np.zeros(())
        )
        bodies, _ = _fitted(_means(rest, group), {k: _means(x, group) for k, x in body.items()},
                              [_means(s, group) for s in side], 0)  # fmt: skip
        found = loads | bodies
    else:
        found, std = _fitted(states.torque, own | body, side, 0)
    factors = tuple(
        _factor(cell, readings, name, *found[name]) for name in (*own, *body) if name in found
    )
    return TorqueCheck(factors, std)


def _within(group: np.ndarray, own: dict[str, Floats]) -> bool:
    """Whether every load is told by differences between readings of one pose."""
    return bool(own) and all(
        np.abs(_centred(x, group)).max() > TOLD * max(np.abs(x).max(), 1e-12) for x in own.values()
    )


def _means(x: Floats, group: np.ndarray) -> Floats:
    """(G, n) means of the groups."""
    count = np.bincount(group)[:, None]
    out = np.zeros((len(count), x.shape[1]))
    np.add.at(out, group, x)
    return np.asarray(out / count)


def _centred(x: Floats, group: np.ndarray) -> Floats:
    """(N, n) what differs from the mean of the group."""
    return np.asarray(x - _means(x, group)[group])


def _fitted(
    y: Floats, causes: dict[str, Floats], side: list[Floats], lost: int
) -> tuple[dict[str, tuple[float, float, float, float]], Floats]:
    """Factors (estimate, low, high, p of 1) of causes (N, n), and the drives' noise (n,).

    Args:
        y: (N, n) measured torques.
        causes: torques of each at a factor of 1.
        side: sides of the approach (N, n), where they are known.
        lost: degrees of freedom that centring took from each drive.
    """
    count, n = y.shape
    largest = max([float(np.abs(x).max()) for x in causes.values()], default=0.0)
    names = [k for k, x in causes.items() if np.abs(x).max() > TOLD * largest]
    columns = [causes[k].T.reshape(-1) for k in names]
    one = np.eye(n)
    own = [np.kron(one[j], np.ones(count)) for j in range(n)] if not lost else []
    own += [np.kron(one[j], s[:, j]) for s in side for j in range(n) if np.ptp(s[:, j]) > 0]
    a = np.stack([*columns, *own], axis=1) if columns or own else np.zeros((n * count, 0))
    b, std = y.T.reshape(-1), np.ones(n)
    own_dof = max(count - lost - a.shape[1] / n, 1.0)
    x, cov = np.zeros(a.shape[1]), np.zeros((a.shape[1], a.shape[1]))
    for _ in range(ROUNDS):
        w = np.repeat(1.0 / std, count)
        u, s, vt = np.linalg.svd(a * w[:, None], full_matrices=False)
        kept = s > 1e-9 * max(float(s.max(initial=0.0)), 1e-300)
        back = vt[kept].T / s[kept]
        x, cov = back @ (u[:, kept].T @ (b * w)), back @ back.T
        left = (b - a @ x).reshape(n, count)
        std = np.maximum(np.sqrt(np.sum(left**2, axis=1) / own_dof), 1e-9 * (1 + np.abs(b).max()))
    null = vt[~kept] if a.shape[1] else np.zeros((0, 0))
    dof = max(n * (count - lost) - a.shape[1], 1)
    half, out = float(student.ppf(0.5 + LEVEL / 2, dof)), {}
    for k, name in enumerate(names):
        if null.size and np.abs(null[:, k]).max() > 1e-6:
            continue  # not told apart from others
        size = float(np.sqrt(cov[k, k]))
        p = 2 * float(student.sf(abs(x[k] - 1) / max(size, 1e-12), dof))
        out[name] = (float(x[k]), float(x[k] - half * size), float(x[k] + half * size), p)
    return out, std


def _factor(
    cell: Cell, r: Readings, name: str, value: float, low: float, high: float, p: float
) -> TorqueFactor:
    """Return a factor with its mass."""
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
    differs = p < SURE and abs(value - 1) > LEAST
    return TorqueFactor(name, value, low, high, stated, differs)
