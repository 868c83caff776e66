"""An identified arm, ready for use: `predict` and `compensate`, without campaign or devices.

The true position of the tool differs from the prediction by

    Σ = κ J C Jᵀ + s² 1 + J_q Σ_q J_qᵀ

C is the covariance of the parameters, which includes families of parameters where nothing was
measured (see `identification.prediction.predictive`). κ ≥ 1 scales C to the mean square
position error at held-out poses. s² is the variance of the position residuals beyond the noise,
where χ² is larger than chance allows. Σ_q is the arm's scatter from one arrival to the next.

Columns of `States` that the points lack add a further variance, see `calibration.measured`.

A fit to deflections knows only the effect of the load: errors are then relative to the unloaded
arm.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.calibration.compensation import (
    Compensation,
    Pose,
    ToolPose,
    ToolPoses,
    in_chain,
    invert,
    tool_of,
    tool_poses,
)
from hilcal.calibration.compiled import Compiled, compiled
from hilcal.calibration.covariance_source import CovarianceSource
from hilcal.calibration.measured import (
    Condition,
    MeasuredRanges,
    SensorMount,
    conditions_of,
    missing_columns,
)
from hilcal.calibration.scatter import Scatter, scatter_of
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.protocol import FRAME_ROLES
from hilcal.errors import InputError, expect
from hilcal.identification.fit import Fit
from hilcal.identification.gauss_newton import derivative
from hilcal.identification.prediction.collinear_conditions import Proxy
from hilcal.identification.prediction.other_temperatures import OtherTemperatures
from hilcal.identification.prediction.predictive import position_factor, predictive
from hilcal.identification.registration.robot_frames import (
    RobotFrames,
    nominal_flange,
    robot_frames,
    state_with_every_column,
    whole_turns,
)
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import States
from hilcal.readings.whitening import Mode
from hilcal.robot import se3
from hilcal.robot.arm import Arm, array_of
from hilcal.robot.chain import evaluate
from hilcal.robot.factory import SAME_FLANGE_M, flange_difference, of_dict, with_factory
from hilcal.shown import Brief
from hilcal.store.codec import read_file, write_document
from hilcal.store.schema import is_campaign
from hilcal.stream import StreamFit
from hilcal.types import Bools, Floats, Ints

_VALID = "six, as Calibration.loads['5kg'], or a column of as many rows as q"


@dataclass(frozen=True, eq=False)
class Calibration(Brief):
    """A fitted model with its uncertainty and the range that was measured.

    >>> with hc.Campaign.open(RUN) as run:
    ...     fit = hc.fit(hc.baseline(run.cell, run.readings), run.readings)
    >>> calibration = hc.Calibration.of(fit)
    >>> q = run.readings.states.q[:3]
    >>> compensation = calibration.compensate(q, [0, 0, -50, 0, 0, 0])
    >>> bool(compensation.after.error_m.max() < 1e-9), compensation.q.shape
    (True, (3, 6))
    """

    model: Model
    theta: Floats  # (P,) its parameters
    mode: Mode  # kind of readings that it was fitted to
    root: Floats | None
    """(P, K) R with κ C = R Rᵀ; None: computed from `covariance_source` when needed."""
    misfit: float  # s², m²
    scatter: Scatter  # of the arm
    measured: MeasuredRanges  # ranges of the fitted readings
    loads: Mapping[str, Floats]  # (6,) wrench at the load point, base axes, by load of the cell
    source: Mapping[str, Any]  # origin of the calibration, for people
    sensor: SensorMount | None = None  # pose of the force sensor; None without one
    refuted_by: tuple[int, int] | None = None
    """Points within their 95 % band, of all points of a test that refutes the bands, see
    `improvement.refuted`; None: not refuted, or not tested."""
    covariance_source: CovarianceSource | None = None  # None where `root` is stated
    conditions: Mapping[str, Condition] = field(default_factory=dict)
    """Means that replace columns of `States` that points lack, by column."""
    turn_std: float = 0.0
    """rad, about each axis: how far the flange may be turned beside the target, see `_turn_std`."""
    other_temperatures: OtherTemperatures | None = None  # None of deflections, and of old files
    proxies: tuple[Proxy, ...] = ()  # conditions that may stand for those that the model reads

    @cached_property
    def _tracked(self) -> ToolPose:
        """The tracked target, the usual tool."""
        return tool_of(self.model, self.theta, None)

    @classmethod
    def of(cls, fit: Fit, source: Mapping[str, Any] | None = None) -> "Calibration":
        """Make the calibration of a fit; an InputError where its scaling is not gc."""
        expect(fit, Fit, "fit", "a Fit, as of hc.fit(model, readings), or path.fit of a refinement")
        if fit.scaling != "gc":
            raise InputError(f"a calibration needs scaling gc, this fit has {fit.scaling}")
        used, model = fit.readings[~fit.outlier], fit.model
        if not model.cell.measured_torques:  # nothing follows from them
            used = replace(used, states=replace(used.states, torque=None))
        p = predictive(model, fit.theta, fit.solution.prior, used, fit.mode, fit.holdout.rms_sigma)
        std = np.sqrt(np.diagonal(p.covariance))
        std = np.where(std > 0.0, std, 1.0)  # units differ: a target's place, a gear's compliance
        values, vectors = np.linalg.eigh(p.covariance / (std[:, None] * std))
        kappa = position_factor(p, fit.holdout.rms_m)
        # A deflection is the difference of two readings.
        readings = 2 if fit.mode == "deflection" else 1
        loads = () if model.cell.config is None else model.cell.config.loads
        covariance_source = None
        if model.prior is None:  # else the covariance does not follow from these readings alone
            stated = p.excess.of_readings(used, fit.mode)
            covariance_source = CovarianceSource(stated, p.prior, p.noise, kappa, p.by_variances)
        bare = cls(
            model=replace(model, readings=None, prior=None),
            theta=fit.theta,
            mode=fit.mode,
            root=std[:, None] * vectors * np.sqrt(kappa * np.maximum(values, 0.0)),
            misfit=p.excess.position / readings,
            scatter=scatter_of(fit),
            measured=MeasuredRanges.of(used.states, p, kappa, model.cell.arm.units),
            loads={load.name: load.wrench(model.cell.gravity) for load in loads},
            source=dict(source or {}),
            sensor=SensorMount.of(model.cell),
            covariance_source=covariance_source,
            turn_std=_turn_std(fit),
            other_temperatures=p.other_temperatures,
            proxies=p.proxies,
        )
        return replace(bare, conditions=conditions_of(model, used.states, bare._moves))

    @classmethod
    def load(cls, path: str | Path, catalogue: Catalogue | None = None) -> "Calibration":
        """Read a calibration file, or make the calibration of a campaign's revision in use.

        `catalogue` has the effects to choose from; None: the installed ones.

        Raises:
            InputError: no calibration, or the catalogue lacks an effect.
        """
        from hilcal.calibration.storage import from_json

        if Path(path).is_file() and is_campaign(Path(path)):
            import hilcal  # campaigns are above calibrations: the library knows them

            with hilcal.Campaign.open(path, catalogue, read_only=True) as run:
                return run.calibration()
        return read_file(Path(path), "calibration", lambda c: from_json(c, catalogue))

    def save(self, path: str | Path) -> None:
        """Write the calibration as one self-contained JSON file."""
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
        """Predict the pose of the tool.

        Args:
            q: (n,) or (N, n) joint values, rad.
            wrench: (6,) or (N, 6) force and moment of the load at the load point, base axes; none
                where None.
            tool: (4, 4) T_flange_tool; the tracked target where None.
            std: also state the uncertainty, and whether points lie far from the measured ones.
            recorded: other columns of `States` by name: `air_temperature`, `load_time`, ...; a
                missing column that the model needs is replaced by its mean while measuring, see
                `calibration.measured`.

        Raises:
            InputError: a wrong shape, or the model needs a missing column whose mean the
                calibration does not know.
        """
        (states, unstated), tool_pose = self._states(q, wrench, recorded), self._tool(tool)
        return self.poses(tool_pose, states, self.nominal(tool_pose, states), std, unstated)

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
        """Find the joint values that put the tool at its target pose.

        Arguments that are not named here are those of `predict`.

        Args:
            q: (n,) or (N, n) joint values, rad, for which the nominal arm has the tool at its
                target pose. The solution stays on their branch.
            wanted: (4, 4) or (N, 4, 4) T_base_tool, the target pose instead.

        Raises:
            InputError: as for `predict`.
        """
        (states, unstated), tool_pose = self._states(q, wrench, recorded), self._tool(tool)
        goal = None
        if wanted is not None:
            pose = np.broadcast_to(np.asarray(wanted, dtype=float), (len(states), 4, 4))
            goal = np.array(pose[:, :3, :3]), np.array(pose[:, :3, 3])
        kernel = self._kernel(tool_pose)
        if isinstance(kernel, Compiled) and kernel.covers(states.q):
            inverse = kernel.compensate(states, goal)
        else:
            model, theta = tool_pose.model, tool_pose.theta

            def poses(q: Floats, points: Ints) -> Pose:
                prediction = model.predict(replace(states[points], q=q), theta)
                pose = in_chain(tool_pose, *tool_poses(tool_pose, prediction))
                return (*pose, prediction.situation.chain)

            target = in_chain(tool_pose, *(goal or self.nominal(tool_pose, states)))
            inverse = invert(self.model.cell.arm, poses, states.q, *target)
        return Compensation(inverse, self, tool_pose, states, goal, std, unstated)

    @cached_property
    def controller(self) -> Arm:
        """The controller's own arm model where it is known, else the nominal arm."""
        arm, stated = self.model.cell.arm, self.source.get("kinematics")
        if stated is None or arm.sign is not None or arm.coupling is not None:
            return arm
        with_stated = with_factory(arm, of_dict(stated, "the controller's kinematics"))
        return with_stated if flange_difference(with_stated, arm)[1] > SAME_FLANGE_M else arm

    @cached_property
    def _compiled(self) -> Compiled | tuple[str, ...]:
        """The model for the compiled kernel, with the tracked target as the tool."""
        return compiled(self._tracked, self.mode)

    def _kernel(self, tool: ToolPose) -> Compiled | tuple[str, ...]:
        return self._compiled if tool is self._tracked else compiled(tool, self.mode)

    def without_kernel(self, tool: Floats | None = None) -> tuple[str, ...]:
        """Effects and joints that the compiled kernel does not cover: some hundred times slower."""
        kernel = self._kernel(self._tool(tool))
        return () if isinstance(kernel, Compiled) else kernel

    def load_wrench(self, q: Floats, reading: Floats) -> Floats:
        """Return the load's wrench (N, 6) for `predict` from readings of the force sensor.

        Args:
            q: (n,) or (N, n) joint values of the reading, rad.
            reading: (6,) or (N, 6) reading with the load minus reading without, sensor axes, N and
                N·m.

        Raises:
            InputError: the cell has no force sensor, or a wrong shape.
        """
        if self.sensor is None:
            raise InputError("the campaign's cell has no [force_sensor]: its place is not known")
        joints = self._states(q, None, None)[0].q
        reading = np.asarray(reading, dtype=float)
        if reading.shape not in ((6,), (len(joints), 6)) or not np.isfinite(reading).all():
            raise InputError(f"reading: valid: finite, of shape (6,) or ({len(joints)}, 6)")
        readings = np.broadcast_to(reading, (len(joints), 6))
        return self.sensor.load_wrench(self.model.cell, joints, readings)

    def tool_pose(self, tool: Floats | None = None) -> Floats:
        """(4, 4) T_flange_tool: `tool`, or the tracked target as stated, else as fitted."""
        return self._tool(tool).nominal

    @cached_property
    def frames(self) -> RobotFrames:
        """Base and flange frames that all poses refer to."""
        return robot_frames(self.model, self.theta)

    @cached_property
    def turns(self) -> Bools:
        """(n,) joints whose angles are equivalent modulo whole turns, see `whole_turns`."""
        return whole_turns(self.model, self.theta)

    def base_in_tracker(self) -> Floats:
        """(4, 4) T_sensor_base, see `identification.registration.robot_frames`."""
        return self.frames.base

    def _tool(self, pose: Floats | None) -> ToolPose:
        """Return the tool with a pose on the flange; raises as `predict` does."""
        if pose is None:
            return self._tracked
        pose = np.asarray(pose, dtype=float)
        turn = pose[:3, :3] if pose.shape == (4, 4) else np.zeros((3, 3))
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) or np.linalg.det(turn) < 0:
            raise InputError("tool is no (4, 4) pose on the flange: a rotation and a position")
        return tool_of(self.model, self.theta, pose, self._flange)

    @cached_property
    def _flange(self) -> Floats | None:
        """(4, 4) the fitted flange turned about the target to its nominal attitude.

        None where readings have no attitudes. Attitudes of one target do not tell the turn of the
        flange (see `_turn_std`): what is fitted is the mean attitude error of
        the nominal arm, which the target's estimated turn has.
        """
        if not self.turn_std:
            return None
        target = self._tracked.nominal[:3, 3]
        turn = nominal_flange(self.frames.links, self.model.cell.arm.links)[0][:3, :3]
        return se3.matrix(turn, target - turn @ target)

    def _states(
        self, q: Floats, wrench: Floats | None, recorded: Mapping[str, Floats] | None
    ) -> tuple[States, tuple[str, ...]]:
        """Return points as states, and the columns filled with means; raises as `predict` does."""
        example, q = state_with_every_column(self.model.cell), self.model.cell.arm.checked(q)
        arguments = {"wrench": np.zeros(6) if wrench is None else wrench, **(recorded or {})}
        columns: dict[str, Any] = {}
        for name, value in arguments.items():
            kind = None if name == "q" else getattr(example, name, None)
            if kind is None:
                raise InputError(f"{name}: no column of hilcal.States that a prediction takes")
            shape, values = (len(q), *kind.shape[1:]), array_of(value, name, _VALID)
            if values.shape not in (shape, shape[1:]):
                raise InputError(f"{name} has shape {values.shape}; valid: {shape} or {shape[1:]}")
            columns[name] = np.array(np.broadcast_to(values, shape), order="C")
        for name, column in columns.items():
            if not np.isfinite(column).all():
                raise InputError(f"{name} has values that are not finite")
        missing = missing_columns(self.model, States(q, **columns))
        unstated = tuple(c for c in missing if c in self.conditions)
        for name in unstated:
            mean = self.conditions[name].mean
            columns[name] = np.broadcast_to(mean, (len(q), *mean.shape)).copy()
        states = States(q, **columns)
        for e in self.model.effects:
            if e.role not in FRAME_ROLES and not e.computable(states):
                raise InputError(
                    f"the model has {e.name}, which needs {', '.join(e.needs)}; give it"
                )
        return states, unstated

    def nominal(self, tool: ToolPose, states: States) -> tuple[Floats, Floats]:
        """Orientation (N, 3, 3) and position (N, 3) of the tool that errors are relative to."""
        if self.mode == "deflection":
            return tool_poses(tool, tool.model.predict(_unloaded(states), tool.theta))
        chain = evaluate(tool.model.cell.arm, states.q)
        rotation = se3.product(chain.rotation[-1], tool.nominal[:3, :3])
        return rotation, chain.point(tool.nominal[:3, 3])

    def poses(
        self,
        tool: ToolPose,
        states: States,
        nominal: tuple[Floats, Floats],
        std: bool,
        unstated: tuple[str, ...] = (),
    ) -> ToolPoses:
        """Return the poses of a tool at N points.

        Errors are relative to `nominal`, orientations (N, 3, 3) and positions (N, 3). `unstated`
        are columns of the states that are filled with means of `conditions`.
        """
        prediction = tool.model.predict(states, tool.theta)
        rotation, position = tool_poses(tool, prediction)
        std_m = covariance = None
        if std:
            spread = self._spread(tool, prediction)
            if self.mode == "deflection":
                unloaded = tool.model.predict(_unloaded(states), tool.theta)
                spread = spread - self._spread(tool, unloaded)
            by_parameters = spread @ np.swapaxes(spread, 1, 2)
            turn, chain = tool.base[:3, :3], prediction.situation.chain
            point = (position - tool.base[:3, 3]) @ turn
            scatter = self.scatter.covariance(tool.model.cell, chain, point)
            unknown = sum(self.conditions[name].variance_m2 for name in unstated)
            isotropic = np.full(len(states), self.misfit + unknown)
            time = self.conditions.get("time")
            if time is not None and time.high is not None and states.time is not None:
                isotropic += time.variance_m2 * (states.time > time.high)
            of_tool = by_parameters + scatter
            if self.other_temperatures is not None:
                axes = prediction.observation.axes
                thermal = self.other_temperatures.of_readings(states, 3, tool.model.cell)
                of_tool = of_tool + np.swapaxes(axes, 1, 2) @ thermal @ axes
            covariance = turn @ of_tool @ turn.T + isotropic[:, None, None] * np.eye(3)
            here = self._position(tool, states) if self.proxies else position
            for proxy in self.proxies:
                other = proxy.applied(states)
                if other is not None:
                    moved = self._position(tool, other) - here
                    covariance += proxy.probability * moved[:, :, None] * moved[:, None]
            offset = tool.nominal[:3, 3] - self._tracked.nominal[:3, 3]  # flange axes
            lever = se3.apply(se3.product(rotation, tool.nominal[:3, :3].T), offset)
            across = np.sum(lever**2, axis=1)[:, None, None] * np.eye(3)
            covariance = covariance + self.turn_std**2 * (
                across - lever[:, :, None] * lever[:, None, :]
            )
            std_m = np.sqrt(np.trace(by_parameters, axis1=1, axis2=2))
        outside = tuple(self.measured.outside(states, std_m, self.turns))
        return ToolPoses(position, rotation, nominal[1], nominal[0], covariance, outside)

    def _position(self, tool: ToolPose, states: States) -> Floats:
        """Position (N, 3) of a tool; its change by the load for deflections."""
        position = tool_poses(tool, tool.model.predict(states, tool.theta))[1]
        if self.mode == "deflection":
            unloaded = tool.model.predict(_unloaded(states), tool.theta)
            position = position - tool_poses(tool, unloaded)[1]
        return position

    @cached_property
    def covariance_root(self) -> Floats:
        """(P, K) R with κ C = R Rᵀ."""
        if self.root is not None:
            return self.root
        assert self.covariance_source is not None  # noqa: S101  (one of both is there)
        return self.covariance_source.root(self.model, self.theta, self.mode)

    def _moves(self, states: States) -> tuple[Floats, Floats]:
        """Position (N, 3) of the tool and J R (N, 3, K); changes by the load for deflections."""
        tool = self._tracked
        prediction = tool.model.predict(states, tool.theta)
        position, spread = tool_poses(tool, prediction)[1], self._spread(tool, prediction)
        if self.mode == "deflection" and states.wrench.any():
            unloaded = self._moves(_unloaded(states))
            position, spread = position - unloaded[0], spread - unloaded[1]
        return position, spread

    def _spread(self, tool: ToolPose, prediction: Prediction) -> Floats:
        """(N, 3, K) J R of the position, in axes of the chain."""
        jacobian = derivative(tool.model, prediction, tool.theta, 3, self.mode)
        jacobian = np.swapaxes(prediction.observation.axes, 1, 2) @ jacobian
        return np.asarray(jacobian @ self.covariance_root[tool.columns])


def _turn_std(fit: Fit) -> float:
    """Return the standard deviation, rad, of the flange's turn that attitudes do not tell.

    One target's turn on the flange is estimated from its attitudes by the nominal arm, and held; so
    turns behind the last joint, and about its axis, are known by their priors alone. Their variance
    is taken as the same about each axis.
    """
    model, n = fit.model, fit.model.cell.arm.n
    if fit.mode != "absolute" or fit.readings.m == 3 or model.cell.targets is not None:
        return 0.0
    if any(e.role == "target" for e in model.effects):  # then its turn is estimated with the others
        return 0.0
    turning = [f"link{n}.rx", f"link{n}.ry", f"link{n}.rz", f"link{n - 1}.rz"]
    prior = fit.solution.prior
    sizes = [
        e.magnitudes[k] if np.isinf(prior[part][k]) else prior[part][k]
        for e, part in zip(model.effects, model.slices(), strict=True)
        for k, p in enumerate(e.parameters)
        if e.change is not None and e.change.kind == "link" and p.name in turning
    ]
    return float(np.sqrt(np.sum(np.square(sizes)) / 3.0))


def _unloaded(states: States) -> States:
    return replace(states, wrench=np.zeros((len(states), 6)))


def calibration_of_stream(fit: StreamFit, source: Mapping[str, Any]) -> Calibration:
    """Return a calibration with the stream's parameters and covariance and its sample's ranges.

    The limit of the standard deviation is the sample's, scaled to the number of readings.
    """
    of_sample = Calibration.of(fit.sample, source)
    values, vectors = np.linalg.eigh(fit.covariance)
    share = np.sqrt(len(fit.sample.readings) / fit.readings)
    measured = of_sample.measured
    return replace(
        of_sample,
        model=replace(fit.model, readings=None, prior=None),
        theta=fit.theta,
        root=vectors * np.sqrt(np.maximum(values, 0.0)),
        measured=replace(measured, most_std_m=float(share * measured.most_std_m)),
        covariance_source=None,
    )
