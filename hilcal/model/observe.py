"""The sensor's side: what the tracker reads of the target, and how it moves.

T_sensor_target = exp(station) T_sensor_base exp(base) T_base_flange T_flange_target'
position read   = (1 + scale) · position

Where there are several observers, each reads the position p = exp(observer) T_observer_sensor p_s
in its own axes: a station p, a point |p| + offset, a gauge p_x (the last two as the first of three
elements, the others zero; see `Readings`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hilcal.cell import Cell, Observer
from hilcal.robot import se3
from hilcal.robot.chain import Chain, Deviation, joint_jacobian, twist_jacobian
from hilcal.robot.se3 import empty, zeros
from hilcal.robot.statics import MotionGradient, rows_times
from hilcal.shown import Brief
from hilcal.types import Bools, Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class Observation(Brief):
    """What the sensor would read without noise."""

    position: Floats  # (N, 3) position read, sensor axes, m; with several observers see above
    rotation: Floats  # (N, 3, 3) target axes in sensor axes
    base_position: Floats  # (N, 3) target position in the base axes of the chain, m
    # (N, 3, 3) orientation of the chain's base axes in sensor axes: the derivative of `position` by
    # displacements of the target, base axes
    axes: Floats
    sensor: Floats | None = None  # (N, 3) target, sensor axes, m; None without several observers
    local: Floats | None = None  # (N, 3) the same in the axes of the observer
    by_local: Floats | None = None  # (N, 3, 3) derivative of `position` by `local`
    by_sensor: Floats | None = None  # (N, 3, 3) derivative of `position` by `sensor`
    is_distance: Bools | None = None  # (N,) where a distance is read, which has an offset


def observe(
    cell: Cell,
    chain: Chain,
    deviation: Deviation,
    target: Ints | None = None,  # (N,) number of the target, where there are several
    observer: Ints | None = None,  # (N,) number of the observer, where there are several
) -> Observation:
    """Read the target of a deviated chain."""
    pose = cell.target_of(target)
    offset, turn = pose[..., :3, 3], pose[..., :3, :3]
    axes, origin = cell.registration[:3, :3], cell.registration[:3, 3]
    rotation = chain.rotation[-1]
    if deviation.target is not None:
        offset = offset + deviation.target[:, :3]
        rotation = se3.product(rotation, se3.rotation(_row_if_constant(deviation.target[:, 3:])))
    rotation = se3.product(rotation, turn)
    base_position = position = chain.point(offset)
    if deviation.base is not None:
        base_r, base_p = se3.exp(_row_if_constant(deviation.base))
        position = base_p + se3.apply(base_r, position)
        rotation, axes = se3.product(base_r, rotation), se3.product(axes, base_r)
    position = origin + se3.apply(cell.registration[:3, :3], position)
    rotation = se3.product(cell.registration[:3, :3], rotation)
    if deviation.station is not None:
        station_r, station_p = se3.exp(_row_if_constant(deviation.station))
        position = station_p + se3.apply(station_r, position)
        rotation, axes = se3.product(station_r, rotation), se3.product(station_r, axes)
    if deviation.scale is not None:
        position = position * (1 + deviation.scale[:, None])
    axes = np.broadcast_to(axes, rotation.shape)
    if observer is None or not cell.observers:
        return Observation(position, rotation, base_position, axes)
    o = observed(cell.observers, observer, position, rotation, deviation.observer)
    return replace(o, base_position=base_position, axes=se3.product(o.axes, axes))


def observed(
    observers: Sequence[Observer],
    number: Ints,
    sensor: Floats,
    rotation: Floats,
    moved: Floats | None = None,
) -> Observation:
    """Return what observers (N,) read of positions (N, 3) and attitudes in sensor axes.

    `moved` (N, 6) are the twists of their frames, see `Deviation.observer`. The base of the
    observation is the sensor.
    """
    frame = np.stack([o.frame for o in observers])[number]
    kind = np.array([o.name.kind for o in observers])[number]
    is_point, is_gauge = kind == "point", kind == "gauge"
    offset, turn = np.array([o.offset for o in observers])[number], frame[:, :3, :3]
    local = frame[:, :3, 3] + se3.apply(turn, sensor)
    if moved is not None:
        observer_r, observer_p = se3.exp(_frame_twist(moved, is_point))
        local, turn = observer_p + se3.apply(observer_r, local), se3.product(observer_r, turn)
        offset = offset + np.where(is_point, moved[:, 3], 0.0)
    length = np.linalg.norm(local, axis=1)
    by_local, value = np.tile(np.eye(3), (len(local), 1, 1)), local.copy()
    by_local[is_point | is_gauge], value[is_point | is_gauge, 1:] = 0.0, 0.0
    by_local[is_point, 0] = local[is_point] / np.maximum(length[is_point], 1e-12)[:, None]
    by_local[is_gauge, 0, 0] = 1.0
    value[is_point, 0] = length[is_point] + offset[is_point]
    by_sensor, turned = se3.product(by_local, turn), se3.product(turn, rotation)
    return Observation(
        value, turned, sensor, by_sensor, sensor, local, by_local, by_sensor, is_point
    )


def _frame_twist(moved: Floats, is_distance: Bools) -> Floats:
    """Twists (N, 6) of the observers without the offsets of distances."""
    return np.where(is_distance[:, None] & (np.arange(6) > 2), 0.0, moved)


def by_observer_frame(o: Observation, m: int, moved: Floats | None = None) -> Floats:
    """Motion (N, m, 6) of a reading by the twist of the observer's frame, as of `observed`."""
    out = zeros(len(o.position), m, 6)
    if o.local is not None and o.by_local is not None and o.is_distance is not None:
        back = None if moved is None else -_frame_twist(moved, o.is_distance)
        jacobian = twist_jacobian(np.eye(3)[None], o.local, back)
        out[:, :3] = o.by_local @ jacobian[:, :3]
        out[:, 3:] = jacobian[:, 3:m]
        out[o.is_distance, 0, 3:] = [1.0, 0.0, 0.0]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class ReadingDerivative:
    """Derivative of the reading by each field of the deviation, sensor axes; the first m rows.

    Without `yielding` the wrenches stay as they are; with it the arm yields to their change.
    """

    cell: Cell
    observation: Observation
    chain: Chain
    deviation: Deviation
    m: int
    dq: Floats  # (N, m, n) derivative by displacements of the chain's joints
    yielding: MotionGradient | None = None  # of the yielding of the arm
    _cache: dict[int, tuple[Floats, Floats]] = field(default_factory=dict, repr=False)
    # R J and R Q (None for zero) of the slots that were needed, see `by_twist`
    _turned: dict[int, tuple[Floats, Floats | None]] = field(default_factory=dict, repr=False)

    @property
    def drives(self) -> Floats:
        """(N, m, n) derivative by the displacements of the drives, `Deviation.dq`."""
        drive = self.cell.arm.drive
        return self.dq if drive is None else np.asarray(self.dq @ drive)

    def by_slot(self, slot: int) -> Floats:
        """Motion (N, m, 6) by the twist of a slot."""
        v, w = self._rigid(slot)
        if self.yielding is not None:
            v, w = v + self.yielding.displacement(slot), w + self.yielding.turn(slot)
        return self.by_twist(slot, v, w)

    def by_twist(self, slot: int, v: Floats, w: Floats) -> Floats:
        """Rows (N, m, 6) by the twist ξ of a slot, from rows by v and ω.

        v = R J dξ_v + R Q dξ_ω and ω = R J dξ_ω are motions of its frame, R the orientation after
        ξ, J and Q the blocks of the right Jacobian (`se3`).
        """
        if slot not in self._turned:
            twist = None if self.chain.twist is None else self.chain.twist[slot]
            r, beyond = self.chain.rotation[slot], None
            if twist is not None and twist.any():
                j, q = se3.right_jacobian_blocks(twist)
                beyond = se3.product(r, q) if twist[:, :3].any() else None
                r = se3.product(r, j)
            self._turned[slot] = r, beyond
        turned, shift = self._turned[slot]
        out = empty(*w.shape[:2], 6)
        out[..., :3] = rows_times(v, turned)
        out[..., 3:] = rows_times(w, turned)
        if shift is not None:
            out[..., 3:] += rows_times(v, shift)
        return out

    def _rigid(self, slot: int) -> tuple[Floats, Floats]:
        """Rows (N, m, 3) by displacement and turn of all beyond a slot, as of a rigid body."""
        if slot not in self._cache:
            o, scale = self.observation, self.deviation.scale
            axes = o.axes if scale is None else o.axes * (1 + scale[:, None, None])
            lever = o.base_position - self.chain.position[slot]
            v, w = axes, se3.cross(lever[:, None], axes)
            if self.m == 6:
                v, w = (np.concatenate(x, axis=1) for x in ((axes, 0 * axes), (w, o.axes)))
            self._cache[slot] = v, w
        return self._cache[slot]

    def by_base(self) -> Floats:
        """Motion (N, m, 6) by the twist of the base."""
        o, base = self.observation, self.deviation.base
        base = None if base is None else _row_if_constant(base)
        moved = twist_jacobian(np.eye(3)[None], o.base_position, base)
        return _to_sensor(o, self.deviation, moved, self.m)

    def by_station(self) -> Floats:
        """Motion (N, m, 6) by the twist of the station; exp(ξ + δ) = exp(J_r(−ξ) δ) exp(ξ)."""
        station, scale = self.deviation.station, self.deviation.scale
        back = None if station is None else -_row_if_constant(station)
        moved = twist_jacobian(np.eye(3)[None], self._unscaled(), back)
        if scale is not None:
            moved[:, :3] *= 1 + scale[:, None, None]
        return self._as_read(moved[:, : self.m])

    def by_target(self) -> Floats:
        """Motion (N, m, 6) by the displacement of the target."""
        flange = self.chain.rotation[-1]
        moved = empty(len(self.dq), 6, 6)
        moved[:, :3, 3:] = moved[:, 3:, :3] = 0.0
        moved[:, :3, :3] = moved[:, 3:, 3:] = flange
        if self.deviation.target is not None:
            # The turn as read is exp(ω) before the target's own axes: ∂ = J_r(−ω).
            turn = -_row_if_constant(self.deviation.target)
            turn[:, :3] = 0.0
            moved[:, 3:, 3:] = se3.product(flange, se3.right_jacobian_blocks(turn)[0])
        return _to_sensor(self.observation, self.deviation, moved, self.m)

    def by_scale(self) -> Floats:
        """Motion (N, m, 1) by the scale error."""
        moved = zeros(len(self.dq), self.m, 1)
        moved[:, :3, 0] = self._unscaled()
        return self._as_read(moved)

    def by_observer(self) -> Floats:
        """Motion (N, m, 6) by the twist of the observer's frame, see `Deviation.observer`."""
        return by_observer_frame(self.observation, self.m, self.deviation.observer)

    def _as_read(self, moved: Floats) -> Floats:
        """Motion (N, m, E) of the reading by that of the target in sensor axes."""
        by_sensor = self.observation.by_sensor
        if by_sensor is None:
            return moved
        blocks = [by_sensor @ moved[:, k : k + 3] for k in range(0, self.m, 3)]
        return np.concatenate(blocks, axis=1)

    def _unscaled(self) -> Floats:
        """Position (N, 3) before the scale error, sensor axes."""
        scale, o = self.deviation.scale, self.observation
        position = o.position if o.sensor is None else o.sensor
        return position if scale is None else position / (1 + scale[:, None])


def motion(
    cell: Cell, observation: Observation, chain: Chain, deviation: Deviation, m: int
) -> ReadingDerivative:
    """Prepare the motions of a reading with m elements at fixed wrenches."""
    moved = joint_jacobian(chain, observation.base_position)
    dq = _to_sensor(observation, deviation, moved, m)
    return ReadingDerivative(cell, observation, chain, deviation, m, dq)


def _row_if_constant(x: Floats) -> Floats:
    """Return x (N, E), or one row of it (1, E) where all are the same."""
    return x[:1] if len(x) and (x == x[:1]).all() else x


def _to_sensor(o: Observation, deviation: Deviation, moved: Floats, m: int) -> Floats:
    """Turn motions (N, 6, P) from base axes into the first m rows in sensor axes."""
    out = empty(len(moved), m, moved.shape[2])
    for first in range(0, m, 3):
        rows = slice(first, first + 3)
        np.einsum("nij,njp->nip", o.axes, moved[:, rows], out=out[:, rows])
    if deviation.scale is not None:
        out[:, :3] *= 1 + deviation.scale[:, None, None]
    return out
