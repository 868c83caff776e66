"""A mapping file: which column of a table holds what, in which unit and convention.

TOML with the sections of `Mapping`; docs/how-to/import-a-table.md explains it.
"""

from pathlib import Path

from pydantic import Field, model_validator

from hilcal.errors import InputError
from hilcal.robot.catalogue import configs_dir
from hilcal.tables.mapping_sections import (
    Air,
    Approach,
    CommandedJoints,
    Correlation,
    CovarianceColumns,
    FileFormat,
    HungMass,
    Joints,
    JointTemperatures,
    LoadName,
    Name,
    Orientation,
    Position,
    SecondFile,
    Std,
    Time,
    Wrench,
)
from hilcal.tables.units import SECONDS
from hilcal.toml import Section, load_section, suggest


class Mapping(Section):
    """The whole of a mapping file."""

    file: FileFormat = Field(default_factory=FileFormat, description="a section [file]")
    second_file: SecondFile | None = Field(None, description="a section [second_file]")
    position: Position = Field(
        description='a section [position] with columns = ["x", "y", "z"] and unit = "mm" or so'
    )
    orientation: Orientation | None = Field(None, description="a section [orientation]")
    joints: CommandedJoints = Field(
        description='a section [joints] with columns, one per joint, and unit = "deg" or "rad"'
    )
    actual_joints: Joints | None = Field(None, description="a section [actual_joints]")
    pose: Name | None = Field(None, description="a section [pose] with column")
    load: LoadName | None = Field(None, description="a section [load] with column")
    cycle: Name | None = Field(None, description="a section [cycle] with column")
    target: Name | None = Field(None, description="a section [target] with column")
    time: Time | None = Field(None, description="a section [time]")
    load_time: Time | None = Field(None, description="a section [load_time]")
    air: Air | None = Field(None, description="a section [air]")
    joint_temperatures: JointTemperatures | None = Field(
        None, description="a section [joint_temperatures]"
    )
    wrench: Wrench | None = Field(None, description="a section [wrench]")
    hung_mass: HungMass | None = Field(None, description="a section [hung_mass]")
    approach: Approach | None = Field(None, description="a section [approach]")
    std: Std | None = Field(None, description="a section [std]")
    correlation: Correlation | None = Field(None, description="a section [correlation]")
    covariance: CovarianceColumns | None = Field(None, description="a section [covariance]")

    @model_validator(mode="after")
    def _consistent(self) -> "Mapping":
        if self.wrench and self.hung_mass:
            raise ValueError("[wrench] together with [hung_mass]; give one of them")
        if self.covariance and (self.std or self.correlation):
            raise ValueError("[covariance] together with [std] or [correlation]; give one of them")
        if self.correlation and (self.std is None or len(self.std.columns) == 1):
            raise ValueError("[correlation] needs [std] with three or six columns")
        wide = 3 * len(self.position.targets)
        figures = 0 if self.std is None else len(self.std.columns or self.std.values)
        six = (figures == 6 and wide != 6) or (
            self.covariance is not None and len(self.covariance.columns) > 9
        )
        if six and self.orientation is None:
            raise ValueError("uncertainties of six elements need [orientation]")
        if self.joints.reported and (self.pose is None or self.actual_joints is not None):
            raise ValueError("[joints] reported = true needs [pose], and no [actual_joints]")
        if self.position.targets and self.target:
            raise ValueError("[target] together with targets in [position]; give one of them")
        if self.std and len(self.std.columns or self.std.values) > 6 and not self.position.targets:
            raise ValueError("[std] has more than 6 figures; it must be 1, 3 or 6")
        if self.load_time and self.load_time.unit not in SECONDS:
            raise ValueError('[load_time] unit must be "s", "ms", "min" or "h"')
        return self


def mapping_names() -> tuple[str, ...]:
    """Names of the mappings that come with the program."""
    return tuple(sorted(path.stem for path in (configs_dir() / "mappings").glob("*.toml")))


def find_mapping(name: str | Path) -> Mapping:
    """Load a mapping by the name of one that comes with the program, or by a file's path.

    Raises:
        InputError: no such mapping (lists the valid names), or a bad file.
    """
    if str(name) in mapping_names():
        return load_mapping(configs_dir() / "mappings" / f"{name}.toml")
    if Path(name).suffix.lower() != ".toml":
        raise InputError(
            f"format '{name}' is unknown{suggest(str(name), mapping_names())}; valid: "
            f"{', '.join(mapping_names())}, or the path of a mapping file (.toml)"
        )
    return load_mapping(Path(name))


def load_mapping(path: Path) -> Mapping:
    """Read a mapping file.

    Raises:
        InputError: unreadable file, syntax error (names the line), unknown key (lists the valid
            ones of its section), missing key or bad value.
    """
    mapping = load_section(path, Mapping)
    if (second := mapping.second_file) is None or second.path is None:
        return mapping
    second = second.model_copy(update={"path": str(_beside(path, str(second.path)))})
    return mapping.model_copy(update={"second_file": second})


def _beside(path: Path, name: str) -> Path:
    """Return a file that a mapping names; it may have come from somebody else.

    Raises:
        InputError: it is outside the mapping's folder, by its name or by a link.
    """
    folder = path.absolute().parent
    if not (folder / name).resolve().is_relative_to(folder.resolve()):
        raise InputError(
            f"{path}: [second_file] path = {name!r} leaves the folder of the mapping; a mapping "
            "names files beside or below it, others are given by --second"
        )
    return folder / name
