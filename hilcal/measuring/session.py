"""A session of a campaign: follows a route, and stores a reading at every stop with a step.

Every reading is stored before the next motion.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import partial
from itertools import takewhile
from typing import Any, TypeVar

import numpy as np

from hilcal.errors import DeviceError, HilcalError, InputError
from hilcal.measuring.arrival import ArrivalReader, RoughRegistration
from hilcal.measuring.connect import Setup
from hilcal.measuring.devices import (
    LoadChangedError,
    TargetLostError,
    WrenchSample,
)
from hilcal.measuring.force import ForceMeter, TaredWrench
from hilcal.measuring.loads import TRIES, Hook
from hilcal.measuring.measure import MeasuredStop, Measurer
from hilcal.measuring.motion import WHERE_LEFT, Mover
from hilcal.measuring.progress import (
    GoalMet,
    GoalStatus,
    LiveResidual,
    Phase,
    ReadingStored,
    Remark,
)
from hilcal.measuring.route import Stop, way_home
from hilcal.measuring.session_state import (
    Eta,
    SessionState,
    Shift,
    detail,
    repeatability,
    sample_json,
    stored_force,
    stored_wrench,
)
from hilcal.readings.readings import Readings, States
from hilcal.store.plan import REFERENCE, REFERENCE_POSITION, UNLOADED, Plan, Step
from hilcal.store.run_log import RunLog
from hilcal.types import Floats

AT_LAST = "where its last reading was taken"  # it may have been stopped on the way to the next
MOVED_M = 1e-3
"""Distance of the unloaded target at the reference pose from every previous position there, m,
above which a person is asked; an arm returns more exactly, even while it warms up. A choice."""
GRAVITY_CHANGE = 5.0
"""Change of gravity in the sensor's axes, m/s², that separates a load from its zero: 30°."""
Done = TypeVar("Done")
LiveModel = Callable[[Readings], LiveResidual]
"""Returns the residual of the last reading by a model fitted to the previous ones."""
StoppingRule = Callable[[Readings, bool], GoalStatus]
"""Returns the status of the goal from all readings. The second argument is whether the plan has no
further readings; else the status may be of fewer ones, as fits must not delay the campaign."""


class Session:
    """Visits the stops of a route, and stores a reading at every stop with a step."""

    def __init__(
        self,
        setup: Setup,
        plan: Plan,
        store: RunLog,
        live: LiveModel | None = None,
        wall: Callable[[], float] = time.time,
        goal: StoppingRule | None = None,
        epoch: float | None = None,
    ) -> None:
        """Read the stored readings of previous sessions; no device is used yet."""
        self.in_control = False
        rig, cell, config = setup.rig, setup.cell, setup.cell.configured()
        self._rig, self._cell, self._config = rig, cell, config
        self._clock, self._watcher = setup.clock, setup.watcher
        self._plan, self._store, self._live, self._wall = plan, store, live, wall
        self._rule = goal
        self._goal: GoalStatus | None = None
        self.pose: str | None = None  # of the current reading
        self._meter: ForceMeter | None = None
        if rig.force is not None and config.force_sensor is not None:
            window = setup.clock.real(config.acquire.force_window_s)
            self._meter = ForceMeter(rig.force, config.force_sensor, cell, window)
        self._mover = Mover(setup, self._meter)
        self._hook = Hook(setup, self._meter, self._mover)
        self._joint_std = config.repeatability.per_joint(cell.arm.n)
        self._state = SessionState(cell, self._joint_std)
        measurer = Measurer(setup, self._meter, self._mover)
        self._reader = ArrivalReader(setup, measurer, self._state.registration)
        self._identified = 0
        self._reported: dict[str, bool] = {}  # whether the campaign has a quantity of the arm
        self._lost: set[str] = set()  # quantities that the last reading lacks
        self._tared = False
        self._done = 0
        start = wall()
        self._epoch = start if epoch is None else epoch
        self._start = setup.clock.now()
        self._elapsed = max(start - self._epoch, 0.0) * setup.clock.scale
        self._restore()

    def _restore(self) -> None:
        """Restore times, tool, reference and unloaded positions from the stored readings."""
        details = self._store.details()
        stored = self._store.readings()
        if not details or stored is None:
            return
        if not all("q_actual" in raw for raw in details):
            raise InputError(
                "some readings of the campaign were drawn, not measured on devices: measure into "
                "another file"
            )
        self._epoch = float(details[0]["epoch_wall_s"])
        last = 0.0 if stored.states.time is None else float(stored.states.time[-1])
        pause = self._wall() - float(details[-1]["wall_s"])
        self._elapsed = last + max(pause, 0.0) * self._clock.scale
        if pause < 0.0:
            self._remark(
                f"this computer's clock is {-pause:.0f} s before the last reading: it was set "
                "back; the pause since that reading is not known and counts as none"
            )
        self._reported["temperatures"] = stored.states.joint_temperature is not None
        self._reported["torques"] = stored.states.torque is not None
        self._done = len(self._store.done())
        for raw, value, target in zip(details, stored.value, stored.target.tolist(), strict=True):
            step = Step(raw["pose"], raw["load"], raw["cycle"])
            q, covariance = np.array(raw["q_actual"]), np.array(raw["tracker_covariance"])
            tared = stored_wrench(raw, self._meter)
            self._state.add(step, q, value, covariance, tared, target)
        force = stored_force(details[-1], self._meter)
        if self._meter is not None and force is not None:
            self._meter.zero = np.array(force["zero"])
            self._identify()

    def visit(self, stops: tuple[Stop, ...]) -> None:
        """Visit all stops; move home as soon as the goal is met."""
        self._event("start", {"missing": sum(s.step is not None for s in stops)})
        self._begin(stops[:2])
        if self._hook.load_denied:
            self._watched(partial(self._check_zero, stops))
        pace = self._pace = Eta(self._clock)
        visited, remaining_stops = list(stops[:2]), stops[2:]
        if self._goal_newly_met(last=False):  # the last session was stopped on its way home
            remaining_stops = way_home(self._cell, self._plan, visited, self._store.done())
        while remaining_stops:
            stop, remaining_stops = remaining_stops[0], remaining_stops[1:]
            visited.append(stop)
            result = self._watched(partial(self._visit, stop))
            if stop.step is not None and result is not None:
                pace.note_reading()
                if self._goal_newly_met(last=all(s.step is None for s in remaining_stops)):
                    done = self._store.done()
                    remaining_stops = way_home(self._cell, self._plan, visited, done)
                readings_left = sum(s.step is not None for s in remaining_stops)
                remaining = pace.remaining(
                    readings_left, sum(s.change_to is not None for s in remaining_stops)
                )
                self._report_stored(stop.step, *result, remaining)
        self._finish()

    def _goal_newly_met(self, last: bool) -> bool:
        """Apply the stopping rule; return whether the goal has just been met, which is reported."""
        readings = None if self._rule is None else self._readings()
        if self._rule is None or readings is None or (self._goal is not None and self._goal.met):
            return False
        status = self._goal = self._rule(readings, last)
        count, planned = len(readings), len(self._plan.steps)
        if status.met or last:
            self._event("goal", {**status.to_dict(), "readings": count, "planned": planned})
        if status.met:
            self._watcher.notify(GoalMet(status, count, planned))
        return status.met

    def _visit(self, stop: Stop) -> tuple[Readings, float] | None:
        step = stop.step
        self.pose = None if step is None else step.pose
        self._move(stop)
        change = None if stop.change_to == self._hook.hanging else stop.change_to
        if change is not None:
            self._pace.note_motion()
            self._change(change)
        if not self._tared:
            self._tare()
        if change is not None:
            self._pace.note_load_change()
        return None if stop.step is None else self._reading(stop, stop.step)

    def _watched(self, do: Callable[[], Done]) -> Done:
        """Call a function; call it again after a wrong load has been corrected."""
        for remaining in reversed(range(TRIES)):
            try:
                return do()
            except LoadChangedError as error:
                self._rig.arm.stop()
                if not remaining:
                    raise
                if self._mover.goal is None:  # it was stopped in motion
                    self._mover.goal = self._rig.arm.sample().q
                self._event("load", {"hanging": None, "why": str(error)})
                self._remark(f"{error} The arm stands")
                self._hook.restore(str(error))
                self._event("load", {"hanging": self._hook.hanging})
        raise AssertionError("unreachable")

    def _begin(self, start: tuple[Stop, ...]) -> None:
        """Check the arm's position, have the load taken off, move to the reference, tare.

        The force sensor is tared before the first motion, too, so that it is compared from then on.
        The position is checked again after every question and, by the mover, before each motion, as
        the arm may be moved by hand. In a resumed campaign, people are asked if the arm does not
        stand at its last reading.
        """
        first, last_q = start[0], self._state.last_q
        sample = self._mover.sample_with_free_path(first.q, first.name)
        turn = np.where(self._cell.arm.slides, 0.0, np.abs(first.q - sample.q))
        if turn.max() > np.pi:  # said before the question whose answer lets the arm move
            joint = self._cell.arm.joint_names[int(turn.argmax())]
            self._remark(
                f"the first motion turns {joint} by {np.degrees(turn.max()):.0f}°: see that "
                "cables and hoses bear it, or bring the arm nearer by hand first"
            )
        self._hook.take_all_off()
        expected, place = (sample.q, WHERE_LEFT) if last_q is None else (last_q, AT_LAST)
        self._mover.goal = self._mover.agreed_start(
            first.q, first.name, expected, self._hook.confirm, place
        )
        self.in_control = True
        self._mover.take_control()
        self._watched(self._zero)
        registration = RoughRegistration(self._cell)  # of this session: the tracker may have moved
        positions: list[tuple[Floats, Floats]] = []
        for stop in start:
            self._watched(partial(self._move, stop))
            with suppress(TargetLostError):  # a reading will search it again
                measured = self._target_position(stop)
                # of several targets it is not known which one was measured
                if self._cell.targets is None and self._compare_place(stop.name, measured):
                    measured = self._target_position(stop)  # put back, or agreed to
                    self._state.references.append(measured)
                positions.append((stop.q, measured))
        for position in positions:
            if (wrong := registration.implausible(*position)) is not None:
                raise DeviceError(wrong)
            registration.add(*position)
        for position in positions:
            self._state.registration.add(*position)
        self._watched(self._tare)

    def _target_position(self, stop: Stop) -> Floats:
        """Return the position (3,) of the target, sensor axes, m.

        A lost target is searched if its position will be compared: the tracker may have been moved.
        """
        tracker = self._rig.tracker
        try:
            return tracker.measure().value[:3]
        except TargetLostError:
            if self._cell.targets is not None or not self._previous_positions(stop.name):
                raise
            tracker.find_target()
            self._mover.checked_sample()
            return tracker.measure().value[:3]

    def _compare_place(
        self, pose: str, position: Floats, raws: Sequence[dict[str, Any]] = ()
    ) -> bool:
        """Ask a person if the unloaded target at the reference pose is at none of its positions.

        Returns whether the person was asked. `raws` are the raw data of a reading that is not
        stored for that.
        """
        previous = self._previous_positions(pose)
        moved = min((float(np.linalg.norm(position - x)) for x in previous), default=0.0)
        if moved <= MOVED_M:
            return False
        reason = (
            f"the target at the reference pose is {1e3 * moved:.3g} mm from where it was before"
        )
        self._event("moved", {"reason": reason, "moved_m": moved})
        for raw in raws:
            self._event("doubted", {"why": reason, "reading": raw})
        self._hook.confirm(
            f"{reason}. If the tracker or the target has been moved, readings before and after "
            "do not belong together: put it back, or give up and begin a new campaign"
        )
        return True

    def _previous_positions(self, pose: str) -> list[Floats]:
        """Return the previous positions of the first target at the reference pose, unloaded."""
        if pose != REFERENCE:
            return []
        stated = self._plan.about.get(REFERENCE_POSITION)
        return [*self._state.references, *([] if stated is None else [np.asarray(stated)])]

    def _move(self, stop: Stop) -> None:
        if not self._mover.is_at(stop.q):
            self._watcher.notify(Phase(f"moving to {stop.name}"))
            self._mover.move(stop.q, stop.name)

    def _tare(self) -> None:
        """Set the force sensor's zero at the reference pose, and store it."""
        zero = self._zero()
        self._tared = True
        if zero is not None:
            sample, q = zero
            self._event("tare", {"force": sample_json(sample), "q": q.tolist()})

    def _check_zero(self, stops: tuple[Stop, ...]) -> None:
        """Check the zero at another direction of gravity in the sensor, then start again.

        A load that hung during the tare is part of the zero, and shows only there.
        """
        meter = self._meter
        if meter is None:
            return
        way = tuple(takewhile(lambda s: s.hanging == UNLOADED and s.change_to is None, stops[1:]))
        turned = [k for k, s in enumerate(way) if meter.gravity_change(s.q) > GRAVITY_CHANGE]
        out = way[: turned[0] + 1] if turned else ()
        for stop in out:
            self._move(stop)
        self._zero()
        for stop in (*out[::-1], *stops[:2]):
            self._move(stop)
        self._tare()

    def _zero(self) -> tuple[WrenchSample, Floats] | None:
        """Set the zero at the present pose, unloaded; return mean wrench and joint angles."""
        meter, watch = self._meter, self._mover.watch
        if meter is None or watch is None:
            return None
        self._watcher.notify(Phase("taring the force sensor"))
        self._mover.wait(self._config.acquire.settle_s)
        sample = meter.average()
        q = self._mover.checked_sample().q
        wrong = watch.difference(meter.tared(sample, q))
        if wrong:
            raise LoadChangedError(wrong)
        meter.set_zero(sample, q)
        watch.expect(None)
        return sample, q

    def _change(self, name: str) -> None:
        if name != UNLOADED and len(self._state.tared_wrenches) > self._identified:
            self._identify()
        self._hook.change(name)
        self._event("load", {"hanging": name})
        self._tared = name != UNLOADED

    def _identify(self) -> None:
        if self._meter is None:
            return
        self._identified = len(self._state.tared_wrenches)
        tolerance = self._config.operator.tolerance_N
        try:
            left_out = self._meter.identify(self._state.tared_wrenches, tolerance)
        except HilcalError as error:
            self._remark(f"the tool is not identified: {error}")
            return
        if left_out is None:
            return
        if left_out:
            self._remark(
                f"{len(left_out)} of {self._identified} unloaded readings differ by more than "
                f"{tolerance:g} N from the tool that the others weigh: was the tool touched?"
            )
        tool = self._meter.tool
        content: dict[str, Any] = {
            "mass_kg": float(tool.mass),
            "com_m": self._meter.to_flange(tool.com).tolist(),
            "bias": tool.bias.tolist(),
            "variance_factor": tool.variance_factor,
            "readings": self._identified,
            "left_out": list(left_out),
        }
        self._event("tool", content)
        if (differs := self._meter.tool_differs(tolerance)) is not None:
            self._remark(differs)

    def _reading(self, stop: Stop, step: Step) -> tuple[Readings, float]:
        """Measure and store all targets; return the first reading and the total settling time."""
        self._watcher.notify(Phase(f"measuring {step}"))
        measurements, rows, details = self._measured(stop, step)
        first = measurements[0]
        unloaded = step.load == UNLOADED and not first.target
        if unloaded and self._compare_place(step.pose, first.mean.value[:3], details):
            measurements, rows, details = self._measured(stop, step)  # put back, or agreed to
        self._store.record(Readings.joined(rows), step, details[0], *details[1:])
        self._done += 1
        for measured in measurements:
            mean, target = measured.mean, measured.target
            name = f"{step}" if target is None else f"{step}, {self._cell.target_names[target]}"
            for text in measured.remarks:
                self._remark(f"{name}: {text}")
            tared = None if target else self._tared_wrench(measured)
            shift = self._state.add(
                step, measured.q, mean.value, mean.covariance, tared, target or 0
            )
            if shift is not None:
                self._report_drift(step, shift)
        self._report_doubtful()
        return rows[0], sum(measured.settling for measured in measurements)

    def _measured(
        self, stop: Stop, step: Step
    ) -> tuple[list[MeasuredStop], list[Readings], list[dict[str, Any]]]:
        """Measure all targets; return their measurements, readings and raw data."""
        measurements = self._reader.read(stop.q, stop.name)
        pairs = [self._row(stop, step, measured) for measured in measurements]
        rows, details = map(list, zip(*pairs, strict=True))
        self._check(measurements, details)
        return measurements, rows, details

    def _check(self, measurements: list[MeasuredStop], details: list[dict[str, Any]]) -> None:
        """Refuse the readings of an arrival if one is of another target or load."""
        wrong = next(filter(None, map(self._doubt, measurements)), None)
        if wrong is None:
            return
        for raw in details:
            self._event("doubted", {"why": str(wrong), "reading": raw})
        for measured in measurements:
            position, target = measured.mean.value[:3], measured.target or 0
            self._state.registration.doubt_repeated(measured.q, position, target)
        self._report_doubtful()
        raise wrong

    def _report_doubtful(self) -> None:
        """Report stored readings that have become doubtful."""
        for step, why in self._state.registration.late_doubts():
            self._event("doubted", {"why": why, "reading": asdict(step), "stored": True})
            self._remark(f"{step}, stored before: {why} A fit sets gross errors aside")

    def _doubt(self, measured: MeasuredStop) -> DeviceError | None:
        """Return why a reading cannot be of its target under its load, or None."""
        position, target = measured.mean.value[:3], measured.target or 0
        stray = self._state.registration.implausible(measured.q, position, target)
        if stray is not None:
            return DeviceError(stray)
        watch, tared = self._mover.watch, self._tared_wrench(measured)
        wrong = "" if watch is None or tared is None else watch.difference(tared)
        return LoadChangedError(wrong) if wrong else None

    def _row(
        self, stop: Stop, step: Step, measured: MeasuredStop
    ) -> tuple[Readings, dict[str, Any]]:
        """Return one reading, with the instrument's covariance, and its raw data."""
        tared = self._tared_wrench(measured)
        target, names = measured.target, self._cell.target_names
        elapsed = self._elapsed + measured.end_time - self._start
        both = measured.before.joint_temperature, measured.after.joint_temperature
        temperature = self._of_arm("temperatures", np.mean(both, axis=0))
        torque = self._of_arm("torques", measured.torque)
        states = States(
            q=stop.q[None].copy(),
            wrench=self._wrench(step, tared)[None].copy(),
            time=np.array([elapsed]),
            load_time=np.array([measured.end_time - self._hook.since]),
            joint_temperature=None if temperature is None else temperature[None],
            approach=self._mover.side[None].copy(),
            q_actual=measured.q[None].copy(),
            torque=None if torque is None else torque[None].copy(),
            target=None if target is None else np.array([target]),
        )
        number = np.zeros(1, dtype=np.int64)
        row = Readings(
            states=states,
            pose=number,
            load=number,
            cycle=np.array([step.cycle], dtype=np.int64),
            value=measured.mean.value[None].copy(),
            covariance=measured.mean.covariance[None].copy(),
            load_names=(step.load,),
            pose_names=(step.pose,),
            target_names=() if target is None else names,
        )
        session: dict[str, Any] = {
            "epoch_wall_s": self._epoch,
            "wall_s": self._wall(),
            "time_s": elapsed,
            "side": self._mover.side.tolist(),
            "losses": None if self._rig.force is None else sample_json(self._rig.force.losses()),
        }
        if target is not None:
            session["target"] = names[target]
        return row, detail(step, measured, tared, self._meter) | session

    def _tared_wrench(self, measured: MeasuredStop) -> TaredWrench | None:
        if self._meter is None or measured.force is None:
            return None
        return self._meter.tared(measured.force, measured.q)

    def _wrench(self, step: Step, tared: TaredWrench | None) -> Floats:
        """Return the load's wrench (6,) at the load point, base axes: configured or measured."""
        load, sensor = self._hook.load(step.load), self._config.force_sensor
        if load is None:
            return np.zeros(6)
        if sensor is not None and self._meter is not None and tared is not None:
            pulls = any((*load.force_N, *load.moment_Nm))
            if sensor.use == "all" or (sensor.use == "pulls" and pulls):
                return self._meter.load_wrench(tared)
        return load.wrench(self._cell.gravity)

    def _of_arm(self, name: str, value: Floats | None) -> Floats | None:
        """Return a quantity (n,) that an arm may not report, NaN if it no longer does.

        None in a campaign whose first reading lacks it: the columns of a campaign do not change.
        """
        known = value if value is not None and np.isfinite(value).all() else None
        if not self._reported.setdefault(name, known is not None):
            return None
        if known is not None:
            self._lost.discard(name)
            return known
        if name not in self._lost:
            self._remark(
                f"arm: it no longer reports the {name} of its joints; readings go on without "
                f"them, and effects that need the {name} of all readings cannot be fitted"
            )
        self._lost.add(name)
        return np.full(self._cell.arm.n, np.nan)

    def _report_drift(self, step: Step, shift: Shift) -> None:
        limit = self._config.acquire.drift_limit_sigma
        content = {"shift_m": shift.metres.tolist(), "sigma": shift.sigma}
        self._event("drift", {"cycle": step.cycle, **content, "over": shift.sigma > limit})
        if shift.sigma > limit:
            self._remark(
                f"the reference pose has moved by {1e6 * np.linalg.norm(shift.metres):.0f} µm, "
                f"{shift.sigma:.1f} sigma (drift_limit_sigma {limit:g}): is the tracker or the "
                "target loose, or the arm still warming up?"
            )

    def _report_stored(
        self, step: Step, reading: Readings, settling: float, remaining: float
    ) -> None:
        number = int(reading.target[0])
        (_, live), *others = self._compared(reading)
        stored = ReadingStored(
            step,
            self._done,
            len(self._plan.steps),
            self._clock.real(remaining),
            self._state.deflection(step, reading.value[0, :3], number),
            live,
            settling,
            self._goal,
            number,
            tuple(others),
        )
        self._watcher.notify(stored)

    def _compared(self, reading: Readings) -> list[tuple[int, LiveResidual]]:
        """Return the residual of each target of an arrival, by a model of the previous readings.

        It only serves the operator's eyes: no error of it ends a campaign.
        """
        out = [(int(k), LiveResidual()) for k in reading.target]
        readings = None if self._live is None else self._readings()
        if self._live is None or readings is None:
            return out
        previous = np.arange(len(readings) - len(reading))
        for k, (target, _) in enumerate(out):
            with suppress(Exception):  # too few readings for a model
                selected = readings[np.append(previous, len(previous) + k)]
                out[k] = target, self._live(selected)
        return out

    def _readings(self) -> Readings | None:
        """Return all readings as fits take them; None without any."""
        readings = self._store.readings()
        return None if readings is None else readings.whole()

    def _finish(self) -> None:
        estimate = repeatability(self._state.visits)
        if estimate is not None:
            self._event("repeatability", asdict(estimate))
            self._remark(estimate.sentence(self._joint_std))
        if self._hook.hanging != UNLOADED:  # the plan ends so
            self._remark(f"{self._hook.hanging} still hangs on the arm: take it off")
            self.remark_on_payload()
        self._event("finished", {"readings": self._done})
        self._watcher.notify(Phase("finished"))

    def remark_on_payload(self) -> None:
        """Say which payload the session leaves in the controller, where a weight may hang."""
        if (text := self._mover.payload_left()) is not None:
            self._remark(text)

    def _remark(self, text: str) -> None:
        self._watcher.notify(Remark(text))

    def _event(self, kind: str, content: dict[str, Any]) -> None:
        self._store.event(kind, {"wall_s": self._wall(), **content})
