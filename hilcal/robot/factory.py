"""Factory kinematics: those that a maker has measured of one arm and stored in its controller.

A controller of Universal Robots stores classic rows,
T_base_flange = Π_i Rz(q_i + θ_i) Tz(d_i) Tx(a_i) Rx(α_i). Its `calibration.conf` has the
differences from the nominal rows; `ur_calibration` of the ROS driver writes the transforms between
the joints, each as x, y, z, roll, pitch, yaw. As axes 2 to 4 are nearly parallel, their d are up
to some kilometres and cancel. Moving a joint's frame along its axis and about it does not change
the arm:

    L_k → Z_k⁻¹ L_k Z_{k+1},   Z_k = Tz(s_k) Rz(φ_k), which Rz(q_k) commutes with,

and s_k, φ_k are chosen to bring each frame as near as possible to that of the nominal arm. So all
quantities in frames (masses, compliances, shapes) keep their meaning.

Sources: Universal Robots, "Remote Control via TCP/IP", kinematics info; `ur_calibration` of the
Universal Robots ROS 2 driver; `ur_description`, urdf/inc and config/*/default_kinematics.yaml.
"""

import configparser
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from hilcal import limits
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.chain import evaluate
from hilcal.types import Floats

N = 6
KINDS = "a calibration.conf, a .yaml of ur_calibration, or a .toml of check --save-calibration"
SAME_FLANGE_M = 1e-6  # m, flange difference of equal kinematics: files have at least 12 digits
LINEARISED_STATUS = 2  # calibration status of an arm that the factory has measured
OTHER_ARM_M = 0.05  # m, flange difference of another arm; one arm's is some millimetres
_KEYS = ("theta_rad", "a_m", "d_m", "alpha_rad")
_DELTAS = ("delta_theta", "delta_a", "delta_d", "delta_alpha")
_BODIES = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
_PLACE = ("x", "y", "z", "roll", "pitch", "yaw")
_EXACT = 1e-9
_LARGEST = 1e5  # m or rad


@dataclass(frozen=True, slots=True, eq=False)
class FactoryKinematics:
    """The kinematics of one arm."""

    links: Floats  # (7, 4, 4) constant transforms L_k, see `Arm`; their frames may be far away
    rows: Floats | None  # (4, 6) θ, a, d, α of classic rows, rad and m; None if unknown
    status: int  # of the calibration, 2 if the factory has measured the arm
    checksum: tuple[int, ...]  # of the joints by the controller; empty if unknown
    source: str

    def to_dict(self) -> dict[str, object]:
        """Return the numbers for files and campaigns; `rows` must not be None."""
        assert self.rows is not None  # noqa: S101 - for the type checker
        out: dict[str, object] = dict(zip(_KEYS, self.rows.tolist(), strict=True))
        return {**out, "calibration_status": self.status, "joint_checksum": list(self.checksum)}

    def to_toml(self) -> str:
        """Return a file for `[robot] calibration`; `rows` must not be None."""
        head = (
            f"# Kinematics of one arm: {self.source}.\n"
            "# T_base_flange = product over i of Rz(q_i + theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i).\n"
        )
        return head + tomli_w.dumps(self.to_dict())


def of_rows(
    rows: Floats, source: str, status: int = LINEARISED_STATUS, checksum: tuple[int, ...] = ()
) -> FactoryKinematics:
    """Return the kinematics of classic rows (4, 6): θ, a, d, α."""
    if rows.shape != (4, N) or not (np.abs(rows) < _LARGEST).all():
        raise InputError(f"{source}: not four times {N} lengths in m and angles in rad")
    theta, a, d, alpha = rows
    links = np.tile(np.eye(4), (N + 1, 1, 1))
    for k in range(N):
        links[k] = links[k] @ se3.screw(2, theta[k])
        links[k + 1] = se3.screw(2, 0.0, d[k]) @ se3.screw(0, alpha[k], a[k])
    return FactoryKinematics(links, rows, status, checksum, source)


def of_dict(content: Any, source: str) -> FactoryKinematics:
    """Return the kinematics of a `FactoryKinematics.to_dict`."""
    try:
        rows = np.array([content[key] for key in _KEYS], dtype=float)
        checksum = tuple(map(int, content["joint_checksum"]))
        return of_rows(rows, source, int(content["calibration_status"]), checksum)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{source}: not the kinematics of an arm ({_why(error)})") from None


def _why(error: Exception) -> str:
    if isinstance(error, KeyError):
        return f"it lacks {error.args[0]}"
    return " ".join(str(error).split())


def read_factory(path: Path, nominal: Arm, text: str | None = None) -> FactoryKinematics:
    """Read a file of one arm's kinematics; a calibration.conf adds to the nominal arm.

    The kinematics of another arm are refused.
    """
    kind = path.suffix.lower()
    if kind not in (".conf", ".yaml", ".yml", ".toml"):
        raise InputError(f"{path}: not the kinematics of an arm; valid: {KINDS}")
    try:
        if text is None:
            text = limits.read_text(path, limits.PROGRAM, f"no such file; expected {KINDS}")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: {error}; expected {KINDS}") from None
    try:
        if kind == ".conf":
            factory = _of_conf(text, nominal, str(path))
        elif kind == ".toml":
            factory = of_dict(tomllib.loads(text), str(path))
        else:
            factory = _of_yaml(text, str(path))
    except (ValueError, KeyError, TypeError, configparser.Error) as error:
        raise InputError(
            f"{path}: not the kinematics of an arm ({_why(error)}); valid: {KINDS}"
        ) from None
    difference = flange_difference(with_factory(nominal, factory), nominal)[1]
    if not difference < OTHER_ARM_M:
        raise InputError(
            f"{factory.source}: the kinematics of another arm than {nominal.name}: the flanges "
            f"differ by up to {1e3 * difference:.0f} mm"
        )
    return factory


def with_factory(nominal: Arm, factory: FactoryKinematics) -> Arm:
    """Return an arm with measured kinematics, with frames as near as possible to nominal."""
    if nominal.n != N or nominal.coupling is not None or nominal.drive is not None:
        raise InputError(
            f"{factory.source}: kinematics of an arm of {N} uncoupled joints, which {nominal.name} "
            "is not"
        )
    nominal_frame, frame = nominal.links[0], factory.links[0]
    links = factory.links.copy()
    for k in range(N):
        # both frames at zero angles: the nominal one's origin and x axis, in the measured frame
        offset = se3.inverse(frame) @ nominal_frame
        move = se3.screw(2, float(np.arctan2(offset[1, 0], offset[0, 0])), float(offset[2, 3]))
        links[k] = links[k] @ move
        links[k + 1] = se3.inverse(move) @ links[k + 1]
        frame = frame @ move @ links[k + 1]
        nominal_frame = nominal_frame @ nominal.links[k + 1]
    return replace(nominal, links=links, source=f"{nominal.source}; kinematics: {factory.source}")


def flange_difference(first: Arm, second: Arm) -> tuple[float, float]:
    """Return the distance of the flanges of two arms, RMS and largest, m, over 400 random poses."""
    q = np.random.default_rng(20251126).uniform(-np.pi, np.pi, (400, first.n))
    difference = evaluate(first, q).position[-1] - evaluate(second, q).position[-1]
    distance = np.linalg.norm(difference, axis=1)
    return float(np.sqrt(np.mean(distance**2))), float(distance.max())


def nominal_rows(arm: Arm) -> Floats:
    """Return θ, a, d, α (4, 6) of an arm of classic rows without offsets."""
    rows = np.zeros((4, arm.n))
    for k, link in enumerate(arm.links[1:]):
        rows[1:, k] = link[0, 3], link[2, 3], np.arctan2(link[2, 1], link[1, 1])
    if arm.n != N or np.abs(of_rows(rows, arm.name).links - arm.links).max() > _EXACT:
        raise ValueError(f"the nominal rows of {arm.name} are not known")
    return rows


def _of_conf(text: str, nominal: Arm, source: str) -> FactoryKinematics:
    parser = configparser.ConfigParser(inline_comment_prefixes=("#", ";"), strict=False)
    parser.read_string(text)
    mounting = parser["mounting"]
    deltas = np.array([[float(v) for v in _values(mounting[key])] for key in _DELTAS])
    status = int(mounting.get("calibration_status", str(LINEARISED_STATUS)), 0)
    checksum = tuple(int(v, 0) for v in _values(mounting.get("joint_checksum", "")))
    return of_rows(nominal_rows(nominal) + deltas, source, status, checksum)


def _values(text: str) -> list[str]:
    return text.strip().strip("[]").replace(",", " ").split()


def _of_yaml(text: str, source: str) -> FactoryKinematics:
    """Parse the layout of `ur_calibration`: a mapping of bodies, each with six numbers."""
    places: dict[str, dict[str, float]] = {}
    body = ""
    for line in text.splitlines():
        key, colon, value = line.partition("#")[0].strip().partition(":")
        if not colon:
            continue
        if not value.strip():
            body = key
        elif key in _PLACE:
            places.setdefault(body, {})[key] = float(value)
    links = np.tile(np.eye(4), (N + 1, 1, 1))
    for k, name in enumerate(_BODIES):
        place = np.array([places[name][key] for key in _PLACE])
        if not np.abs(place).max() < _LARGEST:
            raise ValueError(f"the place of {name} is not finite, or too far away")
        links[k] = se3.matrix(se3.of_rpy(place[3:]), place[:3])
    return FactoryKinematics(links, None, LINEARISED_STATUS, (), source)
