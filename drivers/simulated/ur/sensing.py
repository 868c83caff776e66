"""Every RTDE output variable of the controller, from state and truth."""

import re
from collections.abc import Callable

import numpy as np

from drivers.simulated.blackboard import Blackboard
from drivers.simulated.ur.frames import OUTPUTS
from drivers.simulated.ur.kinematics import GRAVITY, pose, transform
from drivers.simulated.ur.state import ArmState, RobotMode, Runtime
from hilcal.types import Floats

Numbers = tuple[float, ...]

_ENCODER_STD = 3e-6  # rad, while the arm moves
_SPEED_STD = 2e-4  # rad/s
# Torque per motor current at the joint, N·m/A: plausible for gear ratios of about 100.
_TORQUE_PER_AMPERE = np.array([13.0, 13.0, 11.0, 9.0, 9.0, 9.0])
_DEVIATION_STOP = 0.1  # rad at which a controller stops the arm (C153), a guess
_CURRENT_STD = 0.02  # A
_TEMPERATURES = np.array([29.0, 30.0, 30.5, 33.0, 34.0, 33.5])  # °C, a guess
_FORCE_OFFSET = np.array([3.1, -2.4, 4.2, 0.12, -0.21, 0.08])  # N and N·m, flange axes
_FORCE_STD = np.array([0.4, 0.4, 0.5, 0.02, 0.02, 0.01])
_REGISTER = re.compile(r"output_(int|double)_register_(\d+)")
_REAL = frozenset({"DOUBLE", "VECTOR3D", "VECTOR6D"})
_ZEROS = {"VECTOR6D": 6, "VECTOR6INT32": 6, "VECTOR3D": 3}
_POWERED = 253  # joint mode "running"
_UNPOWERED = 239  # joint mode "power off"


class Sensors:
    """Values of one instant; `refresh` begins the next.

    Where nobody has written the truth, the arm is rigid and carries what it has been told.
    The sensor in the flange is taken as aligned with the cell's force sensor.
    """

    def __init__(self, arm: ArmState, board: Blackboard, rng: np.random.Generator) -> None:
        """Look into the world."""
        self._arm, self._board, self._rng = arm, board, rng
        self._now = 0.0
        self._known: dict[str, Numbers] = {}
        self._truth = board.read("truth")
        self._places: dict[bytes, Floats] = {}
        self._readers = self._table()

    def refresh(self) -> None:
        """Forget the last instant."""
        self._now = self._arm.clock.now
        self._known = {}
        self._truth = self._board.read("truth")

    def value(self, name: str) -> Numbers:
        """Return the numbers of an output variable at this instant."""
        if name not in self._known:
            found = self._read(name)
            numbers = found.tolist() if isinstance(found, np.ndarray) else map(float, found)
            self._known[name] = tuple(numbers)
        return self._known[name]

    def integers(self, name: str) -> tuple[int, ...]:
        """Return the same where its type is a whole number."""
        return tuple(int(x) for x in self.value(name))

    def packed(self, name: str) -> tuple[float, ...]:
        """Return the numbers as `struct` wants them."""
        return self.value(name) if OUTPUTS[name] in _REAL else self.integers(name)

    def _read(self, name: str) -> Floats | Numbers:
        if name in self._readers:
            return self._readers[name]()
        register = _REGISTER.fullmatch(name)
        if register:
            registers = self._arm.registers
            file = registers.out_int if register[1] == "int" else registers.out_double
            return (file[int(register[2])],)
        return (0.0,) * _ZEROS.get(OUTPUTS[name], 1)

    def _table(self) -> dict[str, Callable[[], Floats | Numbers]]:
        arm, motion = self._arm, self._arm.trajectory
        powered = (_POWERED,) * 6, (_UNPOWERED,) * 6
        return {
            "timestamp": lambda: (self._now,),
            "actual_q": self._q,
            "target_q": lambda: motion.q,
            "actual_qd": self._qd,
            "target_qd": lambda: motion.qd,
            "target_moment": self._torque,
            "target_current": self._target_current,
            "actual_current": self._current,
            "joint_control_output": self._target_current,
            "joint_temperatures": self._temperatures,
            "joint_mode": lambda: powered[arm.robot_mode is not RobotMode.RUNNING],
            "actual_joint_voltage": lambda: (47.5,) * 6,
            "actual_main_voltage": lambda: (48.0,),
            "actual_robot_voltage": lambda: (48.0,),
            "actual_robot_current": lambda: (0.5,),
            "actual_TCP_pose": lambda: self._tool_pose(np.array(self.value("actual_q"))),
            "target_TCP_pose": lambda: self._tool_pose(motion.q),
            "actual_TCP_speed": lambda: self._tool_speed(np.array(self.value("actual_qd"))),
            "target_TCP_speed": lambda: self._tool_speed(motion.qd),
            "actual_TCP_force": self._tool_force,
            "ft_raw_wrench": self._raw_wrench,
            "tcp_offset": lambda: arm.tcp,
            "payload": lambda: (arm.payload,),
            "payload_cog": lambda: arm.payload_com,
            "robot_mode": lambda: (arm.robot_mode,),
            "safety_mode": lambda: (arm.safety_mode,),
            "safety_status": lambda: (arm.safety_mode,),
            "safety_status_bits": lambda: (arm.safety_bits,),
            "robot_status_bits": lambda: (
                (arm.robot_mode is not RobotMode.POWER_OFF) | (arm.runtime is Runtime.PLAYING) << 1,
            ),
            "runtime_state": lambda: (arm.runtime,),
            "joint_position_deviation_ratio": self._deviation,
            "actual_digital_output_bits": lambda: (arm.digital_outputs,),
            "speed_scaling": lambda: (arm.scaling,),
            "target_speed_fraction": lambda: (arm.slider,),
        }

    @property
    def _is_told(self) -> bool:
        """Whether somebody tells the truth."""
        return bool(self._truth["flange"][3, 3] == 1.0)

    @property
    def _at_rest(self) -> bool:
        """Whether the truth is that of the arm where it rests."""
        motion = self._arm.trajectory
        same = int(self._truth["arrivals"]) == motion.arrivals
        return self._is_told and same and not motion.moving

    def _q(self) -> Floats:
        if self._arm.frozen_q is not None:
            return self._arm.frozen_q
        if self._at_rest:
            return np.asarray(self._truth["encoder"])
        return self._arm.trajectory.q + self._noise(_ENCODER_STD)

    def _deviation(self) -> Numbers:
        """Largest deviation of a joint from its command, over the one that stops the arm."""
        off = np.abs(np.array(self.value("actual_q")) - np.array(self.value("target_q")))
        return (float(off.max() / _DEVIATION_STOP),)

    def _qd(self) -> Floats:
        motion = self._arm.trajectory
        return motion.qd + self._noise(_SPEED_STD) if motion.moving else motion.qd

    def _torque(self) -> Floats:
        if self._is_told:
            return np.asarray(self._truth["drive_torque"])
        arm = self._arm
        return arm.kinematics.weight_torque(arm.trajectory.q, arm.payload, arm.payload_com)

    def _target_current(self) -> Floats:
        if self._arm.robot_mode is not RobotMode.RUNNING:
            return np.zeros(6)
        return np.asarray(np.array(self.value("target_moment")) / _TORQUE_PER_AMPERE)

    def _current(self) -> Floats:
        return np.array(self.value("target_current")) + self._noise(_CURRENT_STD)

    def _temperatures(self) -> Floats:
        return np.asarray(self._truth["joint_temperature"]) if self._is_told else _TEMPERATURES

    def _tool_pose(self, q: Floats) -> Floats:
        return pose(self._flange(q) @ transform(self._arm.tcp))

    def _tool_speed(self, qd: Floats) -> Floats:
        if not qd.any():
            return qd
        q = self._arm.trajectory.q
        place = self._flange(q)
        point = place[:3, 3] + place[:3, :3] @ self._arm.tcp[:3]
        return np.asarray(self._arm.kinematics.jacobian(q, point) @ qd)

    def _weight(self) -> Floats:
        """Wrench of the payload that has been told, at the flange, flange axes."""
        arm = self._arm
        turn = self._flange(arm.trajectory.q)[:3, :3]
        force = arm.payload * (turn.T @ GRAVITY)
        return np.concatenate([force, np.cross(arm.payload_com, force)])

    def _wrench(self) -> Floats:
        """What the sensor in the flange feels, flange axes, with its offset and noise."""
        felt = self._truth["sensor_wrench"] if self._is_told else self._weight()
        return np.asarray(felt + _FORCE_OFFSET + _FORCE_STD * self._rng.standard_normal(6))

    def _raw_wrench(self) -> Floats:
        return self._wrench()

    def _tool_force(self) -> Floats:
        """Remainder after the compensation of the payload, at the tool point, base axes."""
        left = np.array(self.value("ft_raw_wrench")) - self._weight()
        turn = self._flange(self._arm.trajectory.q)[:3, :3]
        moment = left[3:] - np.cross(self._arm.tcp[:3], left[:3])
        return np.concatenate([turn @ left[:3], turn @ moment])

    def _flange(self, q: Floats) -> Floats:
        key = q.tobytes()
        if key not in self._places:
            if len(self._places) > 4:
                self._places.clear()
            self._places[key] = self._arm.kinematics.flange(q)
        return self._places[key]

    def _noise(self, std: float) -> Floats:
        return np.asarray(std * self._rng.standard_normal(6))
