"""The physical world: the true equilibrium of the arm, and the readings of the tracker."""

from dataclasses import dataclass, field

import numpy as np

from hilcal.cell import Cell
from hilcal.drivers.simulated import mechanics as mech
from hilcal.drivers.simulated import truth as laws
from hilcal.drivers.simulated.user_effect import HiddenUserEffect
from hilcal.readings.readings import States
from hilcal.shown import Brief
from hilcal.types import Floats, Ints


@dataclass(frozen=True, slots=True)
class SimulatedNoise:
    """Standard deviations of one reading at distance d from the station.

        sigma_range = a + b d,   sigma_transverse = c + e d

    The defaults are half of a maximum permissible error of ±15 µm + 6 µm/m across the line of
    sight, a less noisy range, and half of ±0.01° for the target's orientation: the usual class of
    laser trackers with a six-degrees-of-freedom probe.
    """

    range_std: tuple[float, float] = (5e-6, 0.5e-6)  # (a, b) in m and m/m
    transverse_std: tuple[float, float] = (7.5e-6, 3e-6)
    """(c, e) in m and m/m, for each of the two directions across the sight."""
    orientation_std: float = 8.7e-5  # rad, about each axis of the tracker

    def covariance(self, position: Floats, m: int) -> Floats:
        """Return the (N, m, m) covariance at (N, 3) positions in station axes, m.

        Cov = sigma_t² I + (sigma_r² - sigma_t²) e eᵀ with e along the line of sight; the same
        as J diag(sigma_az², sigma_el², sigma_r²) Jᵀ with sigma_az = sigma_t / (d cos el).
        """
        along, across, sight = self._spread(position)
        out = np.zeros((len(position), m, m))
        out[:, :3, :3] = across[:, None, None] ** 2 * np.eye(3) + (
            (along**2 - across**2)[:, None, None] * sight[:, :, None] * sight[:, None, :]
        )
        if m == 6:
            out[:, 3:, 3:] = self.orientation_std**2 * np.eye(3)
        return out

    def observe(self, position: Floats, rng: np.random.Generator) -> Floats:
        """Return (N, 3) positions with noise on azimuth, elevation and range.

        The noise is drawn in spherical coordinates, so a reading leaves the sphere's tangent plane
        as a real one does. Both angles are great-circle angles about the line of sight, so the law
        also holds near the zenith, where azimuth alone is undefined.
        """
        along, across, sight = self._spread(position)
        distance = np.linalg.norm(position, axis=1)
        left, up = _across(sight)
        draw = rng.standard_normal((3, len(position)))
        # turn about `up` moves the sight to the left (azimuth), about -left moves it upwards
        azimuth = up * (draw[0] * across / distance)[:, None]
        elevation = -left * (draw[1] * across / distance)[:, None]
        direction = mech.rotation_matrices(azimuth + elevation) @ sight[:, :, None]
        return np.asarray(direction[:, :, 0] * (distance + draw[2] * along)[:, None])

    def _spread(self, position: Floats) -> tuple[Floats, Floats, Floats]:
        """Return sigma_range (N,), sigma_transverse (N,) and the line of sight (N, 3)."""
        distance = np.linalg.norm(position, axis=1)
        along = self.range_std[0] + self.range_std[1] * distance
        across = self.transverse_std[0] + self.transverse_std[1] * distance
        return along, across, position / distance[:, None]


def _across(sight: Floats) -> tuple[Floats, Floats]:
    """Return two unit vectors (N, 3) across the line of sight: to the left, and up."""
    steep = np.abs(sight[:, 2]) > 0.999
    zenith = np.where(steep[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    left = np.cross(zenith, sight)
    left /= np.linalg.norm(left, axis=1)[:, None]
    return left, np.cross(sight, left)


@dataclass(frozen=True, slots=True, eq=False)
class IdealReading:
    """Readings of N states without any noise."""

    position: Floats  # (N, 3) of the target, sensor axes, m
    rotation: Floats  # (N, 3, 3) of the target, sensor axes
    jacobian: Floats  # (N, 6, n) twist of the target per displacement of a drive, sensor axes

    def value(self, m: int) -> Floats:
        """Return (N, m): the position and, for m = 6, the rotation vector."""
        if m == 3:
            return self.position
        return np.hstack([self.position, mech.rotation_vector(self.rotation)])


@dataclass(frozen=True, slots=True, eq=False)
class World(Brief):
    """A simulated cell, with all that is hidden from the program."""

    cell: Cell  # the cell as configured, which the program knows
    physics: laws.Truth  # the hidden parameters
    registration: Floats  # (4, 4) the true T_sensor_base, before `physics.base_frame`
    station: Floats  # (4, 4) T_station_sensor: pose of the sensor axes in the instrument's
    noise: SimulatedNoise  # the tracker's noise
    joint_std: Floats  # (n,) the arm's repeatability at each joint, rad
    joint_reference: float = 22.0  # temperature at which joints do not drift, °C
    offsets: Floats | None = None
    """(T, 3) displacement of each of several targets from its configured place, flange axes, m.
    `physics.target_offset` moves all of them."""
    user_effect: HiddenUserEffect | None = None
    """A user's effect, in addition to the mechanics."""
    _tree: mech.ElasticTree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", mech.build(self.cell, self.physics))

    @property
    def truth(self) -> dict[str, float]:
        """The hidden parameters that are not zero, as "effect.part": value in SI."""
        law = {} if self.user_effect is None else self.user_effect.truth
        return {**self.physics.nonzero_parameters(self.cell.arm), **law}

    @property
    def drives(self) -> Ints:
        """(n,) indices of the drives among the elastic degrees of freedom of `equilibrium`."""
        return self._tree.drive

    @property
    def drifts(self) -> bool:
        """Whether the target moves with time or temperature while arm and load rest."""
        causes = ("tracker_drift", "creep", "thermal_growth", "thermal_joint_drift")
        return self.user_effect is not None or any(np.any(getattr(self.physics, c)) for c in causes)

    def equilibrium(self, states: States, slip: Floats | None = None) -> mech.Equilibrium:
        """Return the equilibrium of N states; `slip` (N, n): error of the drives at rest, rad."""
        arm, hidden = self.cell.arm, self.physics
        errors = laws.joint_errors(hidden, arm, states, self.joint_reference)
        q = arm.chain_angles(states.q) + errors
        guided = laws.guide_motion(hidden, arm, states)
        extra = laws.further_compliance(hidden, arm, states)
        return mech.equilibrium(
            self._tree,
            mech.elasticity(self._tree, hidden, arm, extra),
            q if slip is None else q + arm.driven(slip),
            states.wrench,
            self.cell.load_point + hidden.load_point,
            growth=laws.link_growth(hidden, states),
            sensor=laws.Misreading.of(hidden),
            guide=None if guided is None else guided[:, :, [0, 1, 3, 4, 5]],
        )

    def drive_torque(self, states: States) -> Floats:
        """Return the (N, n) torque that weight and load exert at each drive, N·m."""
        return self.cell.arm.drive_torques(self.equilibrium(states).torque[:, self.drives])

    def ideal_readings(
        self,
        states: States,
        slip: Floats | None = None,
        equilibrium: mech.Equilibrium | None = None,
    ) -> IdealReading:
        """Return the readings of N states without the tracker's noise.

        T_sensor_target = exp(t [drift]) T_sensor_base exp([base_frame]) T_base_flange
        T_flange_target, with the target shifted by its offset; the position is then multiplied by
        1 + s about the origin of the sensor axes. A user's effect displaces the target before drift
        and scale. `slip` as for `equilibrium`; `equilibrium`: the equilibrium, if already computed.
        """
        hidden, equilibrium = self.physics, equilibrium or self.equilibrium(states, slip)
        target = np.array(self.cell.target_of(states.target))
        target[..., :3, 3] += hidden.target_offset
        if self.offsets is not None:
            target[..., :3, 3] += self.offsets[0 if states.target is None else states.target]
        frame = self.registration @ mech.displacement(hidden.base_frame)
        R = frame[:3, :3]
        pose = frame @ equilibrium.flange @ target
        position, rotation = pose[:, :3, 3], pose[:, :3, :3]
        by_drive = (
            equilibrium.jacobian
            if self.cell.arm.drive is None
            else (equilibrium.jacobian @ self.cell.arm.drive)
        )
        jac = mech.at_point(
            by_drive, (equilibrium.flange[:, :3, :3] @ target[..., :3, 3:])[:, :, 0]
        )
        jac = np.concatenate([R @ jac[:, :3], R @ jac[:, 3:]], axis=1)
        if self.user_effect is not None:
            shift, turn = self.user_effect.displacements(
                self.cell, frame, hidden.joint_compliance, states
            )
            position, rotation = position + shift, turn @ rotation
        if np.any(hidden.tracker_drift):
            lack = "carry no time stamps; valid: seconds since the campaign's start"
            time = laws.required_column("tracker_drift", "time", states.time, lack)
            drift = np.array([mech.displacement(hidden.tracker_drift * t) for t in time])
            position = (drift[:, :3, :3] @ position[:, :, None])[:, :, 0] + drift[:, :3, 3]
            rotation = drift[:, :3, :3] @ rotation
        if np.any(hidden.tracker_scale):
            position = position * (1.0 + hidden.tracker_scale)
            jac[:, :3] *= 1.0 + hidden.tracker_scale
        return IdealReading(position, rotation, jac)

    def covariance(self, ideal: IdealReading, m: int = 3) -> Floats:
        """Return the (N, m, m) covariance of readings: tracker + J Sigma_q Jᵀ, sensor axes."""
        turn = self.station[:3, :3].T
        cov = self.noise.covariance(self._from_station(ideal.position), m)
        cov[:, :3, :3] = turn @ cov[:, :3, :3] @ turn.T
        jac = ideal.jacobian[:, :m] * self.joint_std
        return np.asarray(cov + jac @ np.swapaxes(jac, 1, 2))

    def observe(
        self, states: States, rng: np.random.Generator, m: int = 3, arrival: Ints | None = None
    ) -> Floats:
        """Return the (N, m) readings of N states, with all noise.

        The arm's repeatability is drawn in joint space and passed through the equilibrium, so that
        it is correlated over all elements; then the tracker's noise is added. Readings of the same
        `arrival` (N,) share the arm's scatter; None: each has its own. m is 3 or 6.
        """
        k = np.arange(len(states)) if arrival is None else arrival
        slip = self.joint_std * rng.standard_normal((int(k.max()) + 1, states.q.shape[1]))[k]
        ideal = self.ideal_readings(states, slip)
        observed = self.noise.observe(self._from_station(ideal.position), rng)
        axes, origin = self.station[:3, :3], self.station[:3, 3:]
        position = observed @ axes - (axes.T @ origin)[:, 0]
        if m == 3:
            return position
        turn = mech.rotation_matrices(
            self.noise.orientation_std * rng.standard_normal((len(states), 3))
        )
        return np.hstack([position, mech.rotation_vector(turn @ ideal.rotation)])

    def _from_station(self, position: Floats) -> Floats:
        """Return positions (N, 3) in sensor axes as positions in station axes."""
        return np.asarray(position @ self.station[:3, :3].T + self.station[:3, 3])


def place_tracker(cell: Cell, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Place the tracker: return the true T_sensor_base and T_station_sensor, (4, 4) each.

    An unknown registration is drawn: the station is 3 m away from the base, at a height near the
    arm's, turned about the vertical at random. A known registration is true; if its origin lies
    within the arm's reach (readings in base axes), the instrument stands 3 m away.
    """
    distance = 3.0
    if cell.arm.slides.any():  # beside the rail, wherever on it the arm stands
        distance = max(distance, cell.arm.reach + 1.0)
    side, turn = rng.uniform(0.0, 2.0 * np.pi, 2)
    drawn = np.eye(4)
    cos, sin = np.cos(turn), np.sin(turn)
    drawn[:2, :2] = [[cos, -sin], [sin, cos]]
    drawn[:3, 3] = distance * np.cos(side), distance * np.sin(side), rng.uniform(-0.8, 0.2)
    if not cell.registration_known:
        return drawn, np.eye(4)
    if np.linalg.norm(cell.registration[:3, 3]) > cell.arm.reach:
        return cell.registration, np.eye(4)
    return cell.registration, drawn
