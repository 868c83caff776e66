"""Common parts of the simple entrants, with numpy only: task, arm, and fit by least squares.

The model of a reading of a target t on the flange, in the tracker's frame:

    y = R_b F(q + dq) t + p_b,    dq_j = o_j + c_j τ_j,    F = Π_j T_j X_j Rot(a_j, q_j) · T_tool

R_b, p_b: registration; T_j: nominal placement of joint j, X_j: a small displacement and rotation
of it; c_j: compliance of joint j; τ_j: torque about its axis by the weights of links and tool and
by the load, on the nominal arm. Parameters are fitted by Gauss-Newton on

    Σ |y − f(θ)|² / σ² + Σ (θ_i / s_i)²,    s_i = ∞: free; s_i = 0: held at zero.
"""

import json
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..formula import Floats
from ..task import JOINTS, POSITION, WRENCH, Table, Task, read_task

Ints = npt.NDArray[np.int64]
FRAMES = 9
"""Parameters of registration (rotation vector, position) and target: always free."""
GEOMETRY = slice(9, 45)
"""Displacement, m, and rotation, rad, at each joint's placement."""
COMPLIANCE = slice(45, 51)
"""rad/(N m)."""
ORDINARY = np.r_[np.tile([5e-4] * 6, 6), np.full(6, 2e-5)]
"""Standard deviations of geometry and compliance: half a millimetre, half a milliradian, and the
compliance of a gear of a mid-sized arm; choices."""
UNITS = (("q", "_rad"), ("tau", ""))
MULTIPLES = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Multiples of `ORDINARY` that are tried on poses left out."""


@dataclass(frozen=True)
class ArmRows:
    """N readings.

    Attributes:
        pose: (N,) names of the poses.
        q: (N, 6) joint angles, rad.
        torque: (N, 6) torque about each joint's axis, of the nominal arm, N m.
        y: (N, 3) measured positions, m; NaN where they are to be predicted.
        columns: all columns of numbers by name; `tau1`, … are those of `torque`.
    """

    pose: npt.NDArray[Any]
    q: Floats
    torque: Floats
    y: Floats
    columns: Mapping[str, Floats]

    @classmethod
    def of(cls, table: Table, arm: "NominalArm") -> "ArmRows":
        """Take the columns of a table."""
        q, nothing = table.of(JOINTS), np.full((len(table.pose), 3), np.nan)
        y = table.of(POSITION) if POSITION[0] in table.numbers else nothing
        torque = arm.torques(q, table.of(WRENCH))
        torques = {f"tau{j + 1}": torque[:, j] for j in range(6)}
        return cls(np.array(table.pose), q, torque, y, {**table.numbers, **torques})

    def __getitem__(self, i: npt.NDArray[Any]) -> "ArmRows":
        """Return the chosen readings."""
        columns = {name: c[i] for name, c in self.columns.items()}
        return ArmRows(self.pose[i], self.q[i], self.torque[i], self.y[i], columns)


@dataclass(frozen=True)
class TaskInput:
    """A task: its description, rows to train on and to predict, the nominal arm."""

    task: Task
    train: ArmRows
    test: ArmRows
    arm: "NominalArm"

    @classmethod
    def read(cls, folder: Path) -> "TaskInput":
        """Read the folder of a task."""
        task = read_task(folder)
        arm = NominalArm.read(folder / "robot.urdf", task.about["arm"])
        return cls(task, ArmRows.of(task.train, arm), ArmRows.of(task.test, arm), arm)

    @property
    def sigma(self) -> float:
        """Standard deviation of a reading, per axis, m."""
        return float(self.task.about["noise"]["sigma_m"])


def rotation(v: Floats) -> Floats:
    """(..., 3, 3) rotation matrices of rotation vectors (..., 3)."""
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(v, -1, 0)
    o = np.zeros_like(x)
    K = np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*v.shape, 3)
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.asarray(np.eye(3) + a * K + b * (K @ K))


def placement(xyz: Floats, turn: Floats) -> Floats:
    """(4, 4) of a position and a rotation matrix."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, xyz
    return T


@dataclass(frozen=True)
class NominalArm:
    """The nominal arm: placements (6, 4, 4), axes (6, 3), flange, and weights on each body."""

    placements: Floats
    axes: Floats
    tool: Floats
    bodies: tuple[tuple[int, float, Floats], ...]
    target: Floats
    load_point: Floats
    gravity: Floats

    @classmethod
    def read(cls, urdf: Path, info: dict[str, Any]) -> "NominalArm":
        """Read the arm from a URDF and the `arm` of a task."""
        root = ET.parse(urdf).getroot()  # noqa: S314  (the task's own file)
        above = {j.find("child").get("link"): j for j in root.findall("joint")}  # type: ignore[union-attr]
        links = {x.get("name"): x for x in root.findall("link")}
        way: list[ET.Element] = []
        link = "tool0"
        while link in above:
            way.insert(0, above[link])
            link = above[link].find("parent").get("link")  # type: ignore[union-attr, assignment]
        T, placements, axes, bodies = np.eye(4), [], [], []
        for joint in way:
            T = T @ _origin(joint.find("origin"))
            if joint.get("type") in ("revolute", "continuous"):
                axis = joint.find("axis")
                placements.append(T)
                axes.append(_numbers("1 0 0" if axis is None else axis.get("xyz", "1 0 0")))
                T = np.eye(4)
            inertial = links[joint.find("child").get("link")].find("inertial")  # type: ignore[union-attr]
            if inertial is not None and placements:
                mass = float(inertial.find("mass").get("value"))  # type: ignore[union-attr, arg-type]
                at = (T @ _origin(inertial.find("origin")))[:3, 3]
                bodies.append((len(placements), mass, at))
        point = (T @ np.r_[np.array(info["tool"]["com_m"]), 1.0])[:3]
        bodies.append((len(placements), float(info["tool"]["mass_kg"]), point))
        target, load, down = (
            np.array(info[n]) for n in ("target_m", "load_point_m", "gravity_m_s2")
        )
        return cls(np.array(placements), np.array(axes), T, tuple(bodies), target, load, down)

    def frames(self, q: Floats, shifts: Floats | None = None) -> tuple[Floats, Floats]:
        """(N, 6, 4, 4) frames of the joints before and after their rotation, base axes.

        Args:
            q: (N, 6) joint angles.
            shifts: (6, 6) displacement and rotation vector of each placement.
        """
        before, after = np.zeros((2, len(q), 6, 4, 4))
        T = np.broadcast_to(np.eye(4), (len(q), 4, 4))
        for j in range(6):
            P = self.placements[j]
            if shifts is not None:
                P = P @ placement(shifts[j, :3], rotation(shifts[j, 3:]))
            turn = np.zeros((len(q), 4, 4))
            turn[:, :3, :3], turn[:, 3, 3] = rotation(q[:, j, None] * self.axes[j]), 1.0
            before[:, j] = T @ P
            T = after[:, j] = before[:, j] @ turn
        return before, after

    def torques(self, q: Floats, wrench: Floats) -> Floats:
        """(N, 6) torque about each joint's axis of weights and load, N m."""
        F = self.frames(q)[1]
        out = np.zeros((len(q), 6))
        point = (self.tool @ np.r_[self.load_point, 1.0])[:3]
        loads = [(k, m * self.gravity, at) for k, m, at in self.bodies]
        for j in range(6):
            axis = F[:, j, :3, :3] @ self.axes[j]
            moment = wrench[:, 3:].copy()
            for k, force, at in (*loads, (6, wrench[:, :3], point)):
                if k > j:
                    arm = F[:, k - 1, :3, :3] @ at + F[:, k - 1, :3, 3] - F[:, j, :3, 3]
                    moment += np.cross(arm, force)
            out[:, j] = np.sum(axis * moment, axis=1)
        return out

    def predict(self, theta: Floats, rows: ArmRows, added: Floats | None = None) -> Floats:
        """(N, 3) positions of the target in the tracker's frame; `added`: (N, 6) joint angles."""
        q = rows.q + theta[COMPLIANCE] * rows.torque + (0.0 if added is None else added)
        F = self.frames(q, theta[GEOMETRY].reshape(6, 6))[1][:, 5] @ self.tool
        x = F[:, :3, :3] @ (self.target + theta[6:9]) + F[:, :3, 3]
        return np.asarray(x @ rotation(theta[:3]).T + theta[3:6])

    def jacobian(self, theta: Floats, rows: ArmRows) -> tuple[Floats, Floats]:
        """(N, 3, 51) derivatives by the parameters, and (N, 3, 6) by the joint angles."""
        q = rows.q + theta[COMPLIANCE] * rows.torque
        before, after = self.frames(q, theta[GEOMETRY].reshape(6, 6))
        R, flange = rotation(theta[:3]), after[:, 5] @ self.tool
        x = flange[:, :3, :3] @ (self.target + theta[6:9]) + flange[:, :3, 3]
        h = 1e-6 * np.eye(3)
        turned = [x @ (rotation(theta[:3] + d) - rotation(theta[:3] - d)).T / 2e-6 for d in h]
        out, joints = np.zeros((len(x), 3, 51)), np.zeros((len(x), 3, 6))
        out[:, :, :3] = np.stack(turned, axis=-1)
        out[:, :, 3:6], out[:, :, 6:9] = np.eye(3), R @ flange[:, :3, :3]
        for j in range(6):
            start, lever = FRAMES + 6 * j, x - before[:, j, :3, 3]
            axes = before[:, j, :3, :3]
            out[:, :, start : start + 3] = R @ axes
            out[:, :, start + 3 : start + 6] = R @ np.cross(axes, lever[:, :, None], axis=1)
            joints[:, :, j] = np.cross(axes @ self.axes[j], lever) @ R.T
        out[:, :, COMPLIANCE] = joints * rows.torque[:, None]
        return out, joints

    def registered(self, rows: ArmRows) -> Floats:
        """Return θ with the registration of the nominal arm (Kabsch), all else zero."""
        theta = np.zeros(51)
        x = self.predict(theta, rows)
        U, _, V = np.linalg.svd((x - x.mean(0)).T @ (rows.y - rows.y.mean(0)))
        R = V.T @ np.diag([1.0, 1.0, np.linalg.det(V.T @ U.T)]) @ U.T
        w, v = np.linalg.eig(R)
        axis = np.real(v[:, np.argmin(np.abs(w - 1))])
        skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        theta[:3] = axis * np.arctan2(skew @ axis, np.trace(R) - 1)
        theta[3:6] = rows.y.mean(0) - R @ x.mean(0)
        return theta

    def fit(self, rows: ArmRows, prior: Floats, sigma: float, steps: int = 6) -> Floats:
        """Return θ (51,) by Gauss-Newton; prior (42,): s of geometry and compliance."""
        theta, std = self.registered(rows), np.r_[np.full(FRAMES, np.inf), prior]
        free = np.flatnonzero(std > 0)
        scale = np.where(np.isinf(std), 1.0, std)[free]
        held = np.diag(np.where(np.isinf(std[free]), 0.0, 1.0))
        for _ in range(steps):
            A = self.jacobian(theta, rows)[0][:, :, free].reshape(-1, len(free)) * scale / sigma
            r = (rows.y - self.predict(theta, rows)).ravel() / sigma
            b = np.r_[r, -held @ (theta[free] / scale)]
            theta[free] += scale * np.linalg.lstsq(np.vstack([A, held]), b, rcond=1e-12)[0]
        return theta


def _numbers(text: str) -> Floats:
    return np.array([float(v) for v in text.split()])


def _origin(origin: Any) -> Floats:
    if origin is None:
        return np.eye(4)
    r, p, y = _numbers(origin.get("rpy", "0 0 0"))
    turn = rotation(np.array([0, 0, y])) @ rotation(np.array([0, p, 0.0]))
    return placement(_numbers(origin.get("xyz", "0 0 0")), turn @ rotation(np.array([r, 0, 0.0])))


Fitter = Callable[[ArmRows, ArmRows], Floats]
"""Predicts the positions (M, 3) of the second rows by a fit to the first ones."""


def left_out(rows: ArmRows, predict: Fitter, folds: int = 5) -> Floats:
    """(N, 3) measured minus predicted of poses left out, by folds of whole poses."""
    names, pose = np.unique(rows.pose, return_inverse=True)
    fold = (np.random.default_rng(0).permutation(len(names)) % folds)[pose]
    out = np.zeros_like(rows.y)
    for k in range(folds):
        tested = fold == k
        out[tested] = rows.y[tested] - predict(rows[~tested], rows[tested])
    return out


def spread(residual: Floats, data: TaskInput) -> Floats:
    """(M, 3) standard deviation of predictions: rms on poses left out, without the noise."""
    variance = max(float(np.mean(residual**2)) - data.sigma**2, (0.1 * data.sigma) ** 2)
    return np.full((len(data.test.q), 3), np.sqrt(variance))


def chosen(
    data: TaskInput,
    settings: Sequence[float],
    predict: Callable[[float, ArmRows, ArmRows], Floats],
) -> tuple[float, Floats]:
    """Return the setting that predicts poses left out best, and their residual (N, 3)."""
    tried = [left_out(data.train, partial(predict, setting)) for setting in settings]
    best = int(np.argmin([np.sum(r**2) for r in tried]))
    return settings[best], tried[best]


def ridge(data: TaskInput) -> tuple[Callable[[ArmRows], Floats], Floats]:
    """Choose the multiple of the prior of geometry and compliance on poses left out.

    Returns:
        A function that fits θ (51,) to rows, and the residual (N, 3) of poses left out.
    """

    def fit(multiple: float, rows: ArmRows, steps: int = 4) -> Floats:
        return data.arm.fit(rows, ORDINARY * multiple, data.sigma, steps)

    def predict(multiple: float, rows: ArmRows, tested: ArmRows) -> Floats:
        return data.arm.predict(fit(multiple, rows, 3), tested)

    best, residual = chosen(data, MULTIPLES, predict)
    return lambda rows: fit(best, rows), residual


def families(
    data: TaskInput, theta: Floats, rows: ArmRows, waves: int
) -> tuple[Floats, dict[str, Floats]]:
    """Columns of frames and of families of effects, at a fit.

    Args:
        data: the task.
        theta: (51,) point of linearisation.
        rows: N readings.
        waves: K; waves of the joints, sin k q and cos k q, k = 1 ... K.

    Returns:
        (3N, 9) of the frames, and (3N, q) of each family in ordinary magnitudes: link lengths, link
        angles, compliances, and the waves, each octave a family.
    """
    columns, joints = data.arm.jacobian(theta, rows)
    links = columns[:, :, GEOMETRY].reshape(len(columns), 3, 6, 6)
    z = {"length": 5e-4 * links[..., :3], "angle": 5e-4 * links[..., 3:]}
    z["give"] = 1e-5 * columns[:, :, COMPLIANCE]
    for k in range(1, waves + 1):
        name = f"octave {int(np.ceil(np.log2(k)))}"
        two = [1e-4 * joints * f(k * rows.q)[:, None] for f in (np.sin, np.cos)]
        z[name] = np.concatenate([*([z[name]] if name in z else []), *two], axis=-1)
    frames = columns[:, :, :FRAMES].reshape(-1, FRAMES)
    return frames, {n: c.reshape(3 * len(columns), -1) for n, c in z.items()}


def wave(name: str, k: int) -> tuple[Callable[[Floats], Floats], Callable[[str], str]]:
    """Return sine or cosine of k x, and its text."""
    f = getattr(np, name)
    return lambda x: np.asarray(f(k * x)), lambda x: f"{name}({k}*{x})"


def with_residual_regression(
    data: TaskInput, fit: Callable[[ArmRows], Floats], make: Callable[[], Any]
) -> dict[str, Any]:
    """Add a regression of the residual, in the tracker's axes, to a fit.

    Args:
        data: the task.
        fit: fits θ (51,) to rows.
        make: makes a regression with `fit` and `predict`, on sines and cosines of the joint angles,
            torques, and the task's other quantities of laws.
    """
    named = [c for c in data.task.about.get("quantities", {}).values() if "_rad" not in c]

    def features(rows: ArmRows) -> Floats:
        further = [rows.columns[name][:, None] for name in named]
        return np.hstack([np.sin(rows.q), np.cos(rows.q), rows.torque, *further])

    trained = features(data.train)
    mean, scale = trained.mean(0), np.maximum(trained.std(0), 1e-9)

    def predict(rows: ArmRows, tested: ArmRows) -> Floats:
        theta = fit(rows)
        residual = rows.y - data.arm.predict(theta, rows)
        size = np.sqrt(np.mean(residual**2))
        regression = make().fit((features(rows) - mean) / scale, residual / size)
        correction = size * regression.predict((features(tested) - mean) / scale)
        return np.asarray(data.arm.predict(theta, tested) + correction)

    std = spread(left_out(data.train, predict), data)
    return {"prediction_m": predict(data.train, data.test), "std_m": std}


@dataclass(frozen=True)
class FormulaSearch:
    """Input of a search for formulas: quantities, and a value from the residual of a fit.

    In a task with a law the value is v = D·r / D·D, with the residual r and its derivative D by the
    joint or along the axis that the law acts on; else the values are the three columns of r.

    Attributes:
        names: texts of the quantities in a formula, each divided by its largest value.
        x: (N, m) quantities of the rows.
        y: (N, k) values, in units of their root mean square.
        size: this root mean square.
        derivative: (N, 3, k) derivative of the positions by the values.
        fitted_position: (N, 3) positions by the fit.
    """

    names: list[str]
    x: Floats
    y: Floats
    size: float
    derivative: Floats
    fitted_position: Floats

    @classmethod
    def of(cls, data: TaskInput, theta: Floats, rows: ArmRows) -> "FormulaSearch":
        """Prepare rows; values are NaN in rows to be predicted."""
        named = data.task.about.get("quantities")
        named = named or {f"{n}{j}": f"{n}{j}{u}" for n, u in UNITS for j in range(1, 7)}
        names, x = [], []
        for name, column in named.items():
            most = float(f"{np.abs(data.train.columns[column]).max():.4g}")
            if most < 1e-9:  # as the torque of an upright axis
                continue
            names.append(name if name[0] == "q" else f"({name}/{most})")
            x.append(rows.columns[column] / (1.0 if name[0] == "q" else most))
        known, to = data.arm.predict(theta, rows), data.task.about.get("acts_on")
        off, moves = rows.y - known, np.broadcast_to(np.eye(3), (len(known), 3, 3))
        if to is not None:
            joints = data.arm.jacobian(theta, rows)[1]
            up = np.broadcast_to(rotation(theta[:3])[:, 2], known.shape)
            moves = (up if to == "base_z" else joints[:, :, int(to[1:]) - 1])[:, :, None]
        square = np.sum(moves**2, axis=1)
        y = np.einsum("nik,ni->nk", moves, off) / np.maximum(square, 1e-2 * square.max())
        size = float(np.sqrt(np.mean(y**2)))
        return cls(names, np.stack(x, axis=1), y / size, size, moves, known)

    def law(self, factors: Floats, terms: Sequence[str]) -> dict[str, str] | None:
        """Return the law Σ factor · term, with terms that are products of quantities; else None."""
        named = zip(factors * self.size, terms, strict=True)
        texts = [f"{c:.4g}*{term.replace(' ', '*')}" for c, term in named if c != 0.0]
        return {"formula": " + ".join(texts)} if texts else None

    def positions(self, value: Floats) -> Floats:
        """(N, 3) positions of the fit plus the motion by values (N, k), in units of `size`."""
        return np.asarray(
            self.fitted_position + self.size * np.einsum("nik,nk->ni", self.derivative, value)
        )


def enter(entrant: Callable[[TaskInput], dict[str, Any]]) -> None:
    """Run an entrant as the command `python entrant.py TASK_DIR OUT.json`.

    Its seconds are processor time, which does not depend on other load of the machine.
    """
    began = time.process_time()
    result: dict[str, Any] = {"std_m": None, "effects": None, "law": None, "note": ""}
    result |= entrant(TaskInput.read(Path(sys.argv[1])))
    result["seconds"] = time.process_time() - began
    plain = {n: v.tolist() if isinstance(v, np.ndarray) else v for n, v in result.items()}
    Path(sys.argv[2]).write_text(json.dumps(plain), encoding="utf-8")
