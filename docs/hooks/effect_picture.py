"""The picture of an effect: how it moves the target of an example arm, drawn from its own law.

On the left the displacement of the target over what the effect depends on (the load, a column that
it needs, the angle of a joint), by the parameter that moves it most, at its ordinary size; on the
right how far each parameter moves the target, over poses. One function draws all effects; the
numbers are those of `Model.predict` with the effect and without.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig
from hilcal.effects.catalogue import installed
from hilcal.effects.check import ROBOT, example_cell
from hilcal.effects.protocol import Effect, Parameter
from hilcal.model.model import Model
from hilcal.numbers import unit_for
from hilcal.present.charts import AMBER, HOLDOUT, MEASURED, NOISE, template
from hilcal.readings.readings import States
from hilcal.types import Floats

POSE = np.array([0.3, -1.2, 1.5, -0.6, 1.1, 0.4])
"""Joint angles of the pose that sweeps begin from, rad: the tool at work in front of the arm."""
TARGET, LOAD_POINT = (0.06, 0.02, 0.12), (0.1, 0.0, 0.15)
MASS, MOST = 5.0, 12.5
"""Load at the pose and the largest one of a sweep, kg: what the UR10e bears."""
POINTS, POSES, SHOWN = 73, 200, 12
SMALL = 0.02
"""A variable that changes the displacement by less than this share of it has no chart."""
COLOURS = (MEASURED, AMBER, HOLDOUT)
WIDTH, HEIGHT = 760, 300


@dataclass(frozen=True, slots=True)
class Sweep:
    """States along one variable.

    Attributes:
        title: of the axis.
        values: (N,) along the axis.
        states: N + 1; the first one is the reference that some laws take (time 0, 20 °C).
        scale: "linear" or "log".
    """

    title: str
    values: Floats
    states: States
    scale: str = "linear"


def _states(count: int) -> States:
    """Return the pose, a load, warm joints and air, half an hour after the first state."""
    time = np.full(count + 1, 1800.0)
    warm = np.full((count + 1, 6), 35.0)
    air = np.full(count + 1, 25.0)
    time[0], warm[0], air[0] = 0.0, 20.0, 20.0
    return States(
        q=np.tile(POSE, (count + 1, 1)),
        wrench=np.tile([0.0, 0.0, -9.81 * MASS, 0.0, 0.0, 0.0], (count + 1, 1)),
        time=time,
        load_time=np.full(count + 1, 600.0),
        air_temperature=air,
        joint_temperature=warm,
        approach=np.ones((count + 1, 6)),
    )


def _with(base: States, column: str, values: Floats) -> States:
    """Return the states with a column changed after the reference."""
    changed = np.array(getattr(base, column))
    changed[1:] = values if changed.ndim == 1 else values.reshape(len(values), -1)
    return replace(base, **{column: changed})


COLUMNS: dict[str, tuple[str, Callable[[int], Floats], str]] = {
    "time": ("time, min", lambda n: np.linspace(0, 3600, n), "linear"),
    "load_time": ("time under the load, s", lambda n: np.geomspace(1, 3600, n), "log"),
    "air_temperature": ("air, °C", lambda n: np.linspace(10, 35, n), "linear"),
    "joint_temperature": ("joints, °C", lambda n: np.linspace(20, 50, n), "linear"),
    "approach": (
        "side of the approach",
        lambda n: np.repeat([-1.0, 1.0], [n // 2, n - n // 2]),
        "linear",
    ),
}
"""Columns that an effect may need: title of the axis, values, scale."""


def _sweeps(kind: type[Effect], cell: Cell) -> list[Sweep]:
    """Return the variables that an effect may depend on; angles of joints at the end."""
    base = _states(POINTS)
    masses = np.linspace(0.0, MOST, POINTS)
    weights = np.zeros((POINTS, 6))
    weights[:, 2] = -9.81 * masses
    out = [Sweep("load, kg", masses, _with(base, "wrench", weights))]
    for need in kind.needs:
        column = need.split(" or ")[0]
        title, values, scale = COLUMNS[column]
        x = values(POINTS)
        shown = x / 60 if column == "time" else x
        out.append(Sweep(title, shown, _with(base, column, x), scale))
    for k in range(6):
        along, arm = cell.arm.slides[k], cell.arm
        ends = (arm.q_min[k], arm.q_max[k]) if along else (-np.pi, np.pi)
        q = np.tile(POSE, (POINTS, 1))
        q[:, k] = np.linspace(*ends, POINTS)
        title = f"slide {k + 1}, m" if along else f"joint {k + 1}, °"
        shown = q[:, k] if along else np.degrees(q[:, k])
        out.append(Sweep(title, shown, _with(base, "q", q)))
    return out


def _cell(kind: type[Effect]) -> tuple[Cell, bool]:
    """Return the example arm; one with observers or a slide for effects of these."""
    cell = cell_from_config(
        CellConfig.model_validate(
            {
                "robot": {"model": ROBOT},
                "tool": {"target_m": TARGET, "load_point_m": LOAD_POINT},
                "tracker": {"frame": "base"},
            }
        )
    )
    if kind.role == "observer":
        return replace(cell, observers=example_cell().observers), False
    if kind.applies(cell):
        return cell, False
    return replace(cell, arm=example_cell(slides=True).arm), True


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A picture and what its caption says.

    Attributes:
        figure: what is drawn.
        parameters: of the effect, for the example arm.
        strongest: index of the one whose displacement is drawn over variables.
        arm: what arm it is, in words.
    """

    figure: go.Figure
    parameters: tuple[Parameter, ...]
    strongest: int
    arm: str


def picture_of(kind: type[Effect]) -> Picture:
    """Return the picture of an effect."""
    cell, slides = _cell(kind)
    options = {"reference_degC": 20.0} if "reference_degC" in kind.option_help else {}
    sweeps = _sweeps(kind, cell)
    rng = np.random.default_rng(0)
    poses = _with(_states(POSES), "q", rng.uniform(-np.pi, np.pi, (POSES, 6)))
    if cell.observers:
        sweeps = [replace(s, states=_observed(s.states, 0)) for s in sweeps]
        poses = _observed(poses, None)

    moved = _Moved(kind, cell, options, poses)
    sizes = moved.by_parameter()
    strongest = int(np.argmax(sizes))
    over = [(s, moved.along(s.states, strongest)) for s in sweeps]
    joints = [pair for pair in over if pair[0].title.startswith(("joint ", "slide "))]
    others = [pair for pair in over[: len(over) - 6] if _variation(pair[1]) > SMALL]
    chosen = [*others[:2], _turned(joints, moved.effect.parameters[strongest].name)]
    arm = f"a {ROBOT.upper().replace('E', 'e')}" + ", whose first joint slides here," * slides
    parameters = moved.effect.parameters
    return Picture(_drawn(parameters, sizes, strongest, chosen), parameters, strongest, arm)


def _turned(joints: list[tuple[Sweep, Floats]], parameter: str) -> tuple[Sweep, Floats]:
    """Return the joint whose angle changes how far the target moves: a parameter's own, if any."""
    changes = [np.ptp(np.linalg.norm(moved, axis=1)) for _, moved in joints]
    own = re.match(r"j([1-6])", parameter)
    if own and changes[int(own[1]) - 1] > SMALL * max(changes):
        return joints[int(own[1]) - 1]
    return joints[int(np.argmax(changes))]


def _observed(states: States, by: int | None) -> States:
    number = np.arange(len(states)) % 4 if by is None else np.full(len(states), by)
    return replace(states, observer=number)


class _Moved:
    """How the parameters of an effect move the target, of a cell beside whose joints give way."""

    def __init__(
        self, kind: type[Effect], cell: Cell, options: dict[str, float], poses: States
    ) -> None:
        self.cell, self.options, self.poses = cell, options, poses
        self.name, self.kind = kind.name, kind
        self.effect = self._made(poses)

    def _made(self, states: States) -> Effect:
        return installed().make(self.name, self.cell, states, {**self._harmonics(), **self.options})

    def _harmonics(self) -> dict[str, object]:
        return {"harmonics": 4} if "harmonics" in self.kind.option_help else {}

    def _model(self, states: States) -> tuple[Model, Floats, slice]:
        """Return the joints' compliance and the effect, ordinary parameters, and whose are own."""
        effect = self._made(states)
        rest = installed().with_role("baseline")
        beside = tuple(k(self.cell, states) for k in rest if k is not self.kind)
        model = Model(self.cell, (*beside, effect))
        theta = np.concatenate([e.magnitudes for e in model.effects])
        return model, theta, model.slices()[-1]

    def by_parameter(self) -> Floats:
        """(P,) root mean square of the displacement over poses, ordinary parameters, m."""
        model, theta, own = self._model(self.poses)
        theta = theta.copy()
        size = theta[own].copy()
        theta[own] = 0.0
        at = model.predict(self.poses, theta)
        jacobian = model.jacobian(at, theta, 3)[1:, :, own] * size
        found: Floats = np.sqrt(np.mean(np.sum(jacobian**2, axis=1), axis=0))
        return found

    def along(self, states: States, parameter: int) -> Floats:
        """(N, 3) displacement of the target by one parameter of ordinary size, m."""
        model, theta, own = self._model(states)
        without = theta.copy()
        without[own] = 0.0
        with_it = without.copy()
        with_it[own.start + parameter] = theta[own.start + parameter]
        a, b = (model.predict(states, t).observation.position for t in (with_it, without))
        return np.asarray((a - b)[1:])


def _variation(displacement: Floats) -> float:
    largest = float(np.abs(displacement).max())
    return float(np.ptp(displacement, axis=0).max()) / largest if largest > 0 else 0.0


def _drawn(
    parameters: tuple[Parameter, ...],
    sizes: Floats,
    strongest: int,
    chosen: list[tuple[Sweep, Floats]],
) -> go.Figure:
    several = len(parameters) > 1
    columns = len(chosen) + several
    out = make_subplots(rows=1, cols=columns, horizontal_spacing=0.1)
    unit, factor = unit_for("m", [float(np.abs(d).max()) for _, d in chosen])
    axes = ("x", "y", "z")
    for column, (sweep, displacement) in enumerate(chosen, start=1):
        for k, (axis, colour) in enumerate(zip(axes, COLOURS, strict=True)):
            out.add_trace(
                go.Scatter(
                    x=sweep.values,
                    y=factor * displacement[:, k],
                    mode="lines",
                    line={"color": colour, "width": 2, "dash": ("solid", "dash", "dot")[k]},
                    name=axis,
                    showlegend=column == 1,
                ),
                row=1,
                col=column,
            )
        ends = np.unique(sweep.values)
        ticks = {"tickvals": ends} if len(ends) == 2 else {}
        out.update_xaxes(title_text=sweep.title, type=sweep.scale, **ticks, row=1, col=column)
    out.update_yaxes(title_text=f"target moves, {unit}", row=1, col=1)
    if several:
        order = np.argsort(sizes)[::-1][:SHOWN][::-1]
        per, times = unit_for("m", [float(sizes.max())])
        names = [parameters[k].name for k in order]
        out.add_trace(
            go.Bar(
                x=times * sizes[order],
                y=names,
                orientation="h",
                marker={"color": [NOISE if k != strongest else MEASURED for k in order]},
                showlegend=False,
            ),
            row=1,
            col=columns,
        )
        out.update_xaxes(title_text=f"over poses, {per} rms", row=1, col=columns)
        out.update_yaxes(tickmode="array", tickvals=names, row=1, col=columns)
    out.update_layout(
        template=template(False), width=WIDTH, height=HEIGHT, paper_bgcolor="rgba(0,0,0,0)"
    )
    return out
