"""The arms of the catalogue, and loading of other arms."""

import math
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from hilcal.config.sections import Conventions
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.robot.arm import Arm, description_gaps, with_controller_conventions
from hilcal.toml import NonNegative, Number, Positive, Section, Vector3, load_section, suggest

_LENGTH = "a finite number in m"
_ANGLE = "a finite number in degrees"
_POSE = "six finite numbers: x, y, z in m and a rotation vector in rad"
Pose = tuple[Number, Number, Number, Number, Number, Number]


class JointRow(Section):
    """One joint of a DH table: row i, and the body moved by joint i."""

    name: str = Field(min_length=1, description="a name")
    type: Literal["revolute", "prismatic"] = Field(
        "revolute", description='"revolute", or "prismatic" of a rail or column: q_i adds to d_m'
    )
    a_m: Number = Field(description=_LENGTH)
    d_m: Number = Field(description=_LENGTH)
    alpha_deg: Number = Field(description=_ANGLE)
    offset_deg: Number = Field(0.0, description=_ANGLE)
    mass_kg: NonNegative = Field(0.0, description="a mass in kg, 0 or more")
    com_m: Vector3 = Field(
        (0.0, 0.0, 0.0), description="three finite numbers in m, in DH frame i (after row i)"
    )
    q_min_deg: Number | None = Field(None, description=_ANGLE)
    q_max_deg: Number | None = Field(None, description=_ANGLE)
    torque_max_Nm: Positive | None = Field(None, description="a torque in N·m, more than 0")
    q_min_m: Number | None = Field(None, description=_LENGTH + ", of a prismatic joint")
    q_max_m: Number | None = Field(None, description=_LENGTH + ", of a prismatic joint")
    force_max_N: Positive | None = Field(
        None, description="the force of a prismatic joint's drive in N, more than 0"
    )

    @model_validator(mode="after")
    def _range(self) -> "JointRow":
        slides = self.type == "prismatic"
        keys = (("q_min_deg", "q_max_deg", "torque_max_Nm"), ("q_min_m", "q_max_m", "force_max_N"))
        for key in keys[not slides]:
            if getattr(self, key) is not None:
                raise ValueError(f"{key} of a {self.type} joint; valid: {', '.join(keys[slides])}")
        low_key, high_key, _ = keys[slides]
        low, high = getattr(self, low_key), getattr(self, high_key)
        if slides and (low is None or high is None):
            raise ValueError(f"{low_key} and {high_key} are missing; a prismatic joint needs both")
        if (low is None) != (high is None):
            raise ValueError(f"{low_key} and {high_key}: give both or neither")
        if low is not None and low >= high:
            raise ValueError(f"{low_key} = {low} must be less than {high_key} = {high}")
        return self

    @property
    def range(self) -> tuple[float, float]:
        """Lowest and highest joint value, rad or m; by default ±360°."""
        if self.q_min_m is not None and self.q_max_m is not None:
            return self.q_min_m, self.q_max_m
        if self.q_min_deg is None or self.q_max_deg is None:
            return -2 * math.pi, 2 * math.pi
        return math.radians(self.q_min_deg), math.radians(self.q_max_deg)


class DhTable(Conventions):
    """A file of `configs/robots`."""

    title: str | None = Field(None, min_length=1, description="the arm's full name")
    payload_kg: Positive | None = Field(None, description="the rated payload in kg, more than 0")
    weight_kg: Positive | None = Field(
        None, description="the weight of the whole arm in kg (not used in predictions)"
    )
    repeatability_m: Positive | None = Field(
        None, description="the pose repeatability of ISO 9283 in m, more than 0"
    )
    source: str | None = Field(None, min_length=1, description="where the figures come from")
    convention: Literal["standard", "modified"] = Field(
        "standard", description='"standard" (classic rows) or "modified" (Craig\'s rows)'
    )
    base_m_rad: Pose | None = Field(None, description=_POSE)
    flange_m_rad: Pose | None = Field(None, description=_POSE)
    joints: tuple[JointRow, ...] = Field(min_length=1, description="sections [[joints]], in order")


def arm_from_dh(path: Path) -> Arm:
    """Read an arm from a DH table in TOML.

    Classic rows: T_base_flange = Π_i Rz(q_i + offset_i) Tz(d_i) Tx(a_i) Rx(alpha_i), with the
    constant transforms L_0 = Rz(offset_1), L_i = Tz(d_i) Tx(a_i) Rx(alpha_i) Rz(offset_{i+1}).
    Centres of mass are in DH frame i; in the body frame they are Tz(d) Tx(a) Rx(alpha) com.

    Modified rows (Craig, *Introduction to Robotics*, section 3.4): T_base_flange = Π_i Rx(alpha_i)
    Tx(a_i) Rz(q_i + offset_i) Tz(d_i), with alpha and a of the link before the joint; L_n =
    Tz(d_n); in the body frame, centres of mass are Tz(d) com.

    A prismatic joint has Tz(d_i + q_i) and Rz(offset_i). With `base_m_rad` = B and `flange_m_rad` =
    E of calibrated arms, T_base_flange = B Π … E. `Arm.notes` lists what rows lack.
    """
    table = load_section(path, DhTable)
    rows = table.joints
    offsets = [math.radians(row.offset_deg) for row in rows]
    shifts = [se3.screw(2, 0.0, row.d_m) for row in rows]
    turns = [se3.screw(0, math.radians(row.alpha_deg), row.a_m) for row in rows]
    if table.convention == "modified":
        fixed, trailing = shifts, [*turns[1:], np.eye(4)]
    else:
        fixed = [a @ b for a, b in zip(shifts, turns, strict=True)]
        trailing = [np.eye(4)] * len(rows)
    spins = [*(se3.screw(2, offset) for offset in offsets), np.eye(4)]
    parts = zip(fixed, trailing, spins[1:], strict=True)
    links = np.array([spins[0], *(a @ b @ spin for a, b, spin in parts)])
    if table.convention == "modified":
        links[0] = turns[0] @ links[0]
    if table.base_m_rad is not None:
        links[0] = se3.of_six(table.base_m_rad) @ links[0]
    if table.flange_m_rad is not None:
        links[-1] = links[-1] @ se3.of_six(table.flange_m_rad)
    slides = np.array([row.type == "prismatic" for row in rows])
    coms = [f[:3, :3] @ row.com_m + f[:3, 3] for f, row in zip(fixed, rows, strict=True)]
    arm = Arm(
        name=path.stem,
        links=links,
        masses=np.array([row.mass_kg for row in rows]),
        coms=np.array(coms),
        q_min=np.array([row.range[0] for row in rows]),
        q_max=np.array([row.range[1] for row in rows]),
        torque_max=np.array([row.torque_max_Nm or row.force_max_N or math.inf for row in rows]),
        payload=table.payload_kg or math.inf,
        joint_names=tuple(row.name for row in rows),
        source=table.source or f"DH rows of {path.name}",
        notes=description_gaps(
            path.name,
            any(row.mass_kg for row in rows),
            [row.name for row in rows if row.q_min_deg is None and row.q_min_m is None],
            [row.name for row in rows if row.torque_max_Nm is None and row.type == "revolute"],
            [row.name for row in rows if row.force_max_N is None and row.type == "prismatic"],
        ),
        repeatability=table.repeatability_m,
        prismatic=slides if slides.any() else None,
    )
    try:
        return with_controller_conventions(arm, table)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None


OTHER_ARMS = "the path of a .urdf file, or of a .toml file with DH rows"
UNPUBLISHED = {
    "ur10g-1750": "the lengths and torques of its joints",
    "ur17g-1300": "the lengths, masses, centres of mass and torques of its joints",
    "ur18g-950": "the lengths and torques of its joints",
}
"""Arms on sale, and their figures without a published source (November 2026)."""
_PACKAGE = Path(__file__).resolve().parents[1]


def configs_dir() -> Path:
    """Return the directory of configurations: in the package, or next to it in a checkout."""
    inside = _PACKAGE / "configs"
    return inside if inside.is_dir() else _PACKAGE.parent / "configs"


def robot_names() -> tuple[str, ...]:
    """Return the names of the arms in the catalogue."""
    return tuple(sorted(path.stem for path in (configs_dir() / "robots").glob("*.toml")))


def other_arms(arm: Arm) -> Iterator[Arm]:
    """Yield the other arms of the catalogue with the same number of joints and other lengths."""
    for name in robot_names():
        listed = load_arm(name)
        if name != arm.name and listed.n == arm.n and not np.array_equal(listed.links, arm.links):
            yield listed


def load_arm(
    model: str,  # catalogue name, or a path relative to `base_dir`
    base_dir: Path | None = None,  # directory of the cell; the working directory if None
    *,
    base_link: str | None = None,  # first link of a URDF's chain
    tip_link: str | None = None,  # last link of a URDF's chain
    text: str | None = None,  # content of the file, as stored in a campaign
) -> Arm:
    """Load an arm by catalogue name, or from a file: `.urdf`, or `.toml` with a DH table."""
    path = (base_dir or Path()) / model
    suffix = path.suffix.lower()
    if text is not None and suffix in (".urdf", ".toml"):
        with TemporaryDirectory(prefix="hilcal-") as folder:
            (Path(folder) / path.name).write_text(text, encoding="utf-8")
            return load_arm(path.name, Path(folder), base_link=base_link, tip_link=tip_link)
    if suffix == ".urdf":
        from hilcal.robot.urdf import arm_from_urdf  # Pinocchio is slow to import

        return arm_from_urdf(path, base_link, tip_link)
    for key, value in (("base_link", base_link), ("tip_link", tip_link)):
        if value is not None:
            raise InputError(f'{key} = "{value}" is only for a URDF; the robot is "{model}"')
    if suffix == ".toml":
        return arm_from_dh(path)
    names = robot_names()
    if model in UNPUBLISHED:
        raise InputError(
            f'robot "{model}" is not in the catalogue: {UNPUBLISHED[model]} are not published; '
            f"give {OTHER_ARMS}"
        )
    if model not in names:
        raise InputError(
            f'unknown robot "{model}"{suggest(model, names)}; '
            f"valid: {', '.join(names)}, or {OTHER_ARMS}"
        )
    return arm_from_dh(configs_dir() / "robots" / f"{model}.toml")
