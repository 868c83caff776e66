"""An identified arm, ready for use: `predict` and `compensate`, without campaign or devices.

The true position of the tool differs from the prediction by

    Σ = κ J C Jᵀ + s² 1 + J_q Σ_q J_qᵀ

C the covariance of the parameters, what a family does at places that nobody measured included (see
`identification.predictive`); κ ≥ 1 what positions of poses left out were farther off than by C, in
metres; s² what the positions' residuals have beyond the noise, where χ² is larger than chance
allows; Σ_q the arm's scatter from one arrival to the next.

What points do not tell of their state has a further share, see `calibration.measured`.

Of a fit to deflections only what the load does is known: errors are then counted from the unloaded
arm.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.calibration.compensation import Compensation, Inverse, Pose, ToolPoses, invert
from hilcal.calibration.compiled import Compiled, compiled
from hilcal.calibration.covariance_source import CovarianceSource
from hilcal.calibration.measured import Condition, Measured, SensorMount, conditions_of, needed
from hilcal.calibration.scatter import Scatter, scatter_of
from hilcal.calibration.tool import ToolPose, in_chain, tool_of, tool_poses
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.errors import InputError
from hilcal.identification.fit import Fit
from hilcal.identification.predictive import position_factor, predictive
from hilcal.identification.robot_frames import RobotFrames, one_of_each, robot_frames, whole_turns
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import States
from hilcal.readings.whitening import Mode
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.chain import evaluate
from hilcal.robot.factory import SAME, flange_difference, of_dict, with_factory
from hilcal.shown import Brief
from hilcal.store.codec import read_file, write_document
from hilcal.store.schema import is_campaign
from hilcal.stream.fit import StreamFit
from hilcal.types import Bools, Floats, Ints


@dataclass(frozen=True, eq=False)
class Calibration(Brief):
    """A fitted model with what is known of it.

    >>> with hc.Campaign.open(RUN) as run:
    ...     found = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
    >>> calibration = hc.Calibration.of(found)
    >>> q = run.readings.states.q[:3]
    >>> found = calibration.compensate(q, [0, 0, -50, 0, 0, 0])
    >>> bool(found.after.error_m.max() < 1e-9), found.q.shape
    (True, (3, 6))
    """

    model: Model
    theta: Floats  # (P,) its parameters
    mode: Mode  # kind of readings that it was fitted to
    root: Floats | None
    """(P, K) R with κ C = R Rᵀ; None where it is computed when needed, from `learnt`."""
    misfit: float  # s², m²
    scatter: Scatter  # of the arm
    measured: Measured  # where the fitted readings lie
    loads: Mapping[str, Floats]  # (6,) wrench at the load point, base axes, by load of the cell
    source: Mapping[str, Any]  # what it is from, for people
    sensor: SensorMount | None = None  # where the force sensor stands; None without one
    learnt: CovarianceSource | None = None  # what the covariance follows from, where it does
    conditions: Mapping[str, Condition] = field(default_factory=dict)
    """What is taken where points lack a column of `States`, by column."""

    @cached_property
    def _tracked(self) -> ToolPose:
        """The tracked target, the usual tool."""
        return tool_of(self.model, self.theta, None)

    @classmethod
    def of(cls, found: Fit, source: Mapping[str, Any] | None = None) -> "Calibration":
        """Make a calibration of a fit.

        Args:
            source: what it is from, for people.

        Raises:
            InputError: a fit of another scaling than gc.
        """
        if found.scaling != "gc":
            raise InputError(f"a calibration needs scaling gc, this fit has {found.scaling}")
        used, model = found.readings[~found.outlier], found.model
        if not model.cell.measured_torques:  # nothing follows from them
            used = replace(used, states=replace(used.states, torque=None))
        left_out = found.holdout.rms_sigma
        prior = found.solution.prior
        p = predictive(model, found.theta, prior, used, found.mode, left_out)
        values, vectors = np.linalg.eigh(p.covariance)
        noise = np.trace(p.of_noise(found.whitening)[:, :3, :3], axis1=1, axis2=2)
        kappa = position_factor(p, found.holdout.rms_m)
        # A deflection is the difference of two readings.
        readings = 2 if found.mode == "deflection" else 1
        loads = () if model.cell.config is None else model.cell.config.loads
        learnt = None
        if model.prior is None:  # else the covariance does not follow from these readings alone
            stated = p.excess.of_readings(used, found.mode)
            learnt = CovarianceSource(stated, p.prior, p.noise, kappa)
        made = cls(
            model=replace(model, readings=None, prior=None),
            theta=found.theta,
            mode=found.mode,
            root=vectors * np.sqrt(kappa * np.maximum(values, 0.0)),
            misfit=p.excess.position / readings,
            scatter=scatter_of(found),
            measured=Measured.of(used.states, p, noise, model.cell.arm.units),
            loads={load.name: load.wrench(model.cell.gravity) for load in loads},
            source=dict(source or {}),
            sensor=SensorMount.of(model.cell),
            learnt=learnt,
        )
        return replace(made, conditions=conditions_of(model, used.states, made._moves))

    @classmethod
    def load(cls, path: str | Path, catalogue: Catalogue | None = None) -> "Calibration":
        """Read a calibration file, or make the calibration of a campaign's revision in use.

        Args:
            path: a calibration, or a campaign.
            catalogue: has its effects; the installed ones unless given.

        Raises:
            InputError: no calibration, or one with effects that are not at hand.
        """
        from hilcal.calibration.storage import from_json

        if Path(path).is_file() and is_campaign(Path(path)):
            import hilcal  # campaigns are above calibrations: the library knows them

            with hilcal.Campaign.open(path, catalogue, read_only=True) as run:
                return run.calibration()
        return read_file(Path(path), "calibration", lambda c: from_json(c, catalogue))

    def save(self, path: str | Path) -> None:
        """Write it as one JSON file, which needs nothing else to be loaded."""
        from hilcal.calibration.storage import to_json

        write_document(Path(path), to_json(self), indent=1)

    def predict(
        self,
        q: Floats,
        wrench: Floats | None = None,
        *,
        tool: Floats | None = None,
        std: bool = True,
        recorded: Mapping[str, Floats] | None = None,
    ) -> ToolPoses:
        """Say where the tool is.

        Args:
            q: (n,) or (N, n) joint values, rad.
            wrench: (6,) or (N, 6) force and moment of the load at the load point, base axes; none
                where None.
            tool: (4, 4) T_flange_tool; the tracked target where None.
            std: also state the uncertainty, and whether points lie far from what was measured.
            recorded: other columns of `States` by name: `air_temperature`, `load_time`, ...; those
                that the model needs and are not given are taken as in the middle of what was
                measured, see `calibration.measured`.

        Raises:
            InputError: another shape, or a column is missing that the model needs, and that the
                calibration knows nothing of.
        """
        (states, untold), of = self._states(q, wrench, recorded), self._tool(tool)
        return self.poses(of, states, self.nominal(of, states), std, untold)

    def compensate(
        self,
        q: Floats,
        wrench: Floats | None = None,
        *,
        tool: Floats | None = None,
        wanted: Floats | None = None,
        std: bool = True,
        recorded: Mapping[str, Floats] | None = None,
    ) -> Compensation:
        """Find the joint values that put the tool where it is asked to be.

        Arguments that are not named here are those of `predict`.

        Args:
            q: (n,) or (N, n) joint values, rad; the nominal arm has the tool there. Those found
                are on their branch.
            wanted: (4, 4) or (N, 4, 4) T_base_tool to go to instead.

        Raises:
            InputError: as for `predict`.
        """
        (states, untold), of = self._states(q, wrench, recorded), self._tool(tool)
        goal = None
        if wanted is not None:
            given = np.broadcast_to(np.asarray(wanted, dtype=float), (len(states), 4, 4))
            goal = np.array(given[:, :3, :3]), np.array(given[:, :3, 3])
        fast = self._kernel(of)
        if isinstance(fast, Compiled):
            found, left = fast.compensate(states, goal)
            inverse = Inverse(found, left[:, 0], left[:, 1])
        else:
            inverse = self._invert(of, states, goal or self.nominal(of, states))
        return Compensation(inverse, self, of, states, goal, std, untold)

    @cached_property
    def controller(self) -> Arm:
        """The arm by which the controller computes poses, as far as known; else the nominal one."""
        arm, told = self.model.cell.arm, self.source.get("kinematics")
        if told is None or arm.sign is not None or arm.coupling is not None:
            return arm
        other = with_factory(arm, of_dict(told, "the controller's kinematics"))
        return other if flange_difference(other, arm)[1] > SAME else arm

    @cached_property
    def _compiled(self) -> Compiled | tuple[str, ...]:
        """The model for the compiled kernel, with the tracked target as the tool."""
        return compiled(self._tracked, self.mode)

    def _kernel(self, of: ToolPose) -> Compiled | tuple[str, ...]:
        return self._compiled if of is self._tracked else compiled(of, self.mode)

    def without_kernel(self, tool: Floats | None = None) -> tuple[str, ...]:
        """Names of what the compiled kernel has no form for: some hundred times slower with it."""
        found = self._kernel(self._tool(tool))
        return () if isinstance(found, Compiled) else found

    def _invert(self, of: ToolPose, states: States, goal: tuple[Floats, Floats]) -> Inverse:
        def poses(at: Floats, points: Ints) -> Pose:
            prediction = of.model.predict(replace(states[points], q=at), of.theta)
            return (*in_chain(of, *tool_poses(of, prediction)), prediction.situation.chain)

        return invert(self.model.cell.arm, poses, states.q, *in_chain(of, *goal))

    def load_wrench(self, q: Floats, reading: Floats) -> Floats:
        """Return the wrench of a load as the force sensor reads it, for `predict` and `compensate`.

        Args:
            q: (n,) or (N, n) joint values at which it was read, rad.
            reading: (6,) or (N, 6) the sensor's reading with the load less that without it, sensor
                axes, N and N·m.

        Returns:
            (N, 6) force and moment at the load point, base axes.

        Raises:
            InputError: the cell has no force sensor, or another shape.
        """
        if self.sensor is None:
            raise InputError("the campaign's cell has no [force_sensor]: its place is not known")
        at = self._states(q, None, None)[0].q
        reading = np.asarray(reading, dtype=float)
        if reading.shape not in ((6,), (len(at), 6)) or not np.isfinite(reading).all():
            raise InputError(f"reading: valid: finite, of shape (6,) or ({len(at)}, 6)")
        every = np.broadcast_to(reading, (len(at), 6))
        return self.sensor.load_wrench(self.model.cell, at, every)

    def tool_pose(self, tool: Floats | None = None) -> Floats:
        """(4, 4) T_flange_tool: as given, or the tracked target as stated, else as fitted."""
        return self._tool(tool).nominal

    @cached_property
    def frames(self) -> RobotFrames:
        """Base and flange that everything is counted from."""
        return robot_frames(self.model, self.theta)

    @cached_property
    def turns(self) -> Bools:
        """(n,) joints whose angles mean the same after whole turns, see `whole_turns`."""
        return whole_turns(self.model, self.theta)

    def base_in_tracker(self) -> Floats:
        """(4, 4) T_sensor_base, see `identification.robot_frames`."""
        return self.frames.base

    def _tool(self, pose: Floats | None) -> ToolPose:
        """Return the tool with a pose on the flange; raises as `predict` does."""
        if pose is None:
            return self._tracked
        pose = np.asarray(pose, dtype=float)
        turn = pose[:3, :3] if pose.shape == (4, 4) else np.zeros((3, 3))
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) or np.linalg.det(turn) < 0:
            raise InputError("tool is no (4, 4) pose on the flange: a rotation and a position")
        return tool_of(self.model, self.theta, pose)

    def _states(
        self, q: Floats, wrench: Floats | None, recorded: Mapping[str, Floats] | None
    ) -> tuple[States, tuple[str, ...]]:
        """Return points as states, and which columns were not told; raises as `predict` does."""
        n, every = self.model.cell.arm.n, one_of_each(self.model.cell)
        q = np.array(q, dtype=float, order="C", ndmin=2)
        if q.shape[1:] != (n,) or not len(q):
            raise InputError(f"q has shape {q.shape}; valid: ({n},) or (N, {n})")
        given = {"wrench": np.zeros(6) if wrench is None else wrench, **(recorded or {})}
        columns = {}
        for name, value in given.items():
            kind = None if name == "q" else getattr(every, name, None)
            if kind is None:
                raise InputError(f"{name}: no column of hilcal.States that a prediction takes")
            shape, values = (len(q), *kind.shape[1:]), np.asarray(value, dtype=float)
            if values.shape not in (shape, shape[1:]):
                raise InputError(f"{name} has shape {values.shape}; valid: {shape} or {shape[1:]}")
            columns[name] = np.array(np.broadcast_to(values, shape), order="C")
        for name, column in {"q": q, **columns}.items():
            if not np.isfinite(column).all():
                raise InputError(f"{name} has values that are not finite")
        states = States(q, **columns)
        untold = tuple(c for c in needed(self.model, states) if c in self.conditions)
        for name in untold:
            mean = self.conditions[name].mean
            columns[name] = np.broadcast_to(mean, (len(q), *mean.shape)).copy()
        states = States(q, **columns)
        for e in self.model.effects:
            if e.role not in FRAME_ROLES and not e.computable(states):
                raise InputError(
                    f"the model has {e.name}, which needs {', '.join(e.needs)}; give it"
                )
        return states, untold

    def nominal(self, of: ToolPose, states: States) -> tuple[Floats, Floats]:
        """Orientation and position of the tool that errors are counted from."""
        if self.mode == "deflection":
            return tool_poses(of, of.model.predict(_unloaded(states), of.theta))
        chain = evaluate(of.model.cell.arm, states.q)
        rotation = se3.product(chain.rotation[-1], of.nominal[:3, :3])
        return rotation, chain.point(of.nominal[:3, 3])

    def poses(
        self,
        of: ToolPose,
        states: States,
        nominal: tuple[Floats, Floats],
        std: bool,
        untold: tuple[str, ...] = (),
    ) -> ToolPoses:
        """Return where a tool is at N points.

        `nominal` (N, 3, 3) and (N, 3) are orientations and positions that errors are counted from,
        `untold` columns of the states that are means of `conditions`.
        """
        prediction = of.model.predict(states, of.theta)
        rotation, position = tool_poses(of, prediction)
        known = covariance = None
        if std:
            known = self._by_parameters(of, states, prediction)
            turn, chain = of.base[:3, :3], prediction.situation.chain
            at = (position - of.base[:3, 3]) @ turn
            scatter = self.scatter.covariance(of.model.cell, chain, at)
            rest = self.misfit + sum(self.conditions[name].variance_m2 for name in untold)
            covariance = turn @ (known + scatter) @ turn.T + rest * np.eye(3)
            known = np.sqrt(np.trace(known, axis1=1, axis2=2))
        outside = tuple(self.measured.outside(states, known, self.turns))
        return ToolPoses(position, rotation, nominal[1], nominal[0], covariance, outside)

    @cached_property
    def covariance_root(self) -> Floats:
        """(P, K) R with κ C = R Rᵀ."""
        if self.root is not None:
            return self.root
        assert self.learnt is not None  # noqa: S101  (one of both is there)
        return self.learnt.root(self.model, self.theta, self.mode)

    def _by_parameters(self, of: ToolPose, states: States, prediction: Prediction) -> Floats:
        """(N, 3, 3) κ J C Jᵀ of the position, axes of the chain, m²."""
        spread = self._spread(of, prediction)
        if self.mode == "deflection":
            spread = spread - self._spread(of, of.model.predict(_unloaded(states), of.theta))
        return spread @ np.swapaxes(spread, 1, 2)

    def _moves(self, states: States) -> tuple[Floats, Floats]:
        """Position (N, 3) of the tool and J R (N, 3, K); in deflections what the load does."""
        of = self._tracked
        prediction = of.model.predict(states, of.theta)
        position, spread = tool_poses(of, prediction)[1], self._spread(of, prediction)
        if self.mode == "deflection" and states.wrench.any():
            free = self._moves(_unloaded(states))
            position, spread = position - free[0], spread - free[1]
        return position, spread

    def _spread(self, of: ToolPose, prediction: Prediction) -> Floats:
        """(N, 3, K) J R of the position, axes of the chain."""
        jacobian = of.model.jacobian(prediction, of.theta, 3)
        jacobian = np.swapaxes(prediction.observation.axes, 1, 2) @ jacobian
        return np.asarray(jacobian @ self.covariance_root[of.kept])


def _unloaded(states: States) -> States:
    return replace(states, wrench=np.zeros((len(states), 6)))


def calibration_of_stream(found: StreamFit, source: Mapping[str, Any]) -> Calibration:
    """Return the calibration: parameters and covariance of the stream, ranges of its sample.

    The limit of the standard deviation is that of the sample, scaled to the number of readings.
    """
    of_sample = Calibration.of(found.sample, source)
    values, vectors = np.linalg.eigh(found.covariance)
    share = np.sqrt(len(found.sample.readings) / found.readings)
    measured = of_sample.measured
    return replace(
        of_sample,
        model=replace(found.model, readings=None, prior=None),
        theta=found.theta,
        root=vectors * np.sqrt(np.maximum(values, 0.0)),
        measured=replace(measured, most_std_m=float(share * measured.most_std_m)),
        learnt=None,
    )
