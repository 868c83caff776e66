"""A mapping file, TOML: which column of a table holds what, in which unit and convention."""

from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

from pydantic import AfterValidator, Field, Strict, model_validator

from hilcal.errors import InputError
from hilcal.readings.covariance import TrackerNoise
from hilcal.readings.readings import ObserverKind
from hilcal.robot.catalogue import configs_dir
from hilcal.tables.units import CONVENTIONS, NUMBERS, TIMES, Angle, Length, Temperature
from hilcal.toml import NonNegative, Positive, Section, load_section, suggest

Column = Annotated[str, Field(min_length=1)] | Annotated[int, Strict(), Field(ge=1)]


def _columns(*valid: int) -> AfterValidator:
    *first, last = map(str, valid)

    def counted(columns: tuple[Column, ...]) -> tuple[Column, ...]:
        if len(columns) not in valid:
            counts = f"{', '.join(first)} or {last}"
            raise ValueError(f"columns: {len(columns)} given; it must be {counts}")
        return columns

    return AfterValidator(counted)


_ENCODINGS = '"utf-8", "latin-1", "utf-16", "gb18030", "shift_jis", "euc_kr" ...'


def _text_encoding(name: str) -> str:
    try:
        "a".encode(name)
    except LookupError:
        raise ValueError(f'encoding "{name}" is unknown; valid: {_ENCODINGS}') from None
    return name


PerJoint = Annotated[tuple[Column, ...], Field(min_length=1, description="one column per joint")]
Row = Annotated[int, Strict(), Field(ge=1)]
UNLOADED = (
    "none", "0", "no", "no load", "unloaded", "empty", "-", "ohne", "leer", "keine", "unbelastet",
    "sans", "sans charge", "vide", "à vide", "sin carga", "vacío", "senza", "无", "空载",
)  # fmt: skip
"""Names that mean "no load" unless the mapping lists others, in small letters; a choice."""

TABLE = "table"  # The exchange table: the format that is read without a mapping
_COLUMN = "the name of a column, or its number from 1"
_LENGTH = 'a unit of length: "m", "cm", "mm", "um" or "in"'
_ANGLE = 'a unit of angles: "rad", "mrad", "deg" or "arcsec"'
_POSITION = 'a section [position] with columns = ["x", "y", "z"] and unit = "mm" or so'
_JOINTS = 'a section [joints] with columns, one per joint, and unit = "deg" or "rad"'
_OPTIONAL = "true where some files lack it, else false"
_UNIT_T = '"degC", "degF" or "K"'


class FileFormat(Section):
    """[file]: how the file is written; what is left out is as in a plain CSV file."""

    separator: Literal[",", ";", "|", "tab", "blanks"] | None = Field(
        None, description='",", ";", "|", "tab" or "blanks"'
    )
    decimal: Literal[".", ","] = Field(".", description='the decimal mark: "." or ","')
    thousands: Literal[",", ".", "'", " "] | None = Field(
        None, description='the mark between thousands: ",", ".", "\'" or " "'
    )
    encoding: Annotated[str, AfterValidator(_text_encoding)] | None = Field(
        None, description=_ENCODINGS
    )
    header_row: Annotated[int, Strict(), Field(ge=0)] = Field(
        1, description="the row of the column names, a whole number from 1; 0 where there is none"
    )
    group_row: Row | None = Field(
        None,
        description="the row above the header whose names stand over several columns, from 1: it "
        'tells columns of one name apart, as "Nominal X" and "Measured X"',
    )
    units_row: Row | None = Field(None, description="the row of units, a whole number from 1")
    skip_rows: tuple[Row, ...] = Field((), description="rows that are no readings, from 1")
    comment: str | None = Field(
        None, min_length=1, description='what a comment line begins with, e.g. "//"'
    )
    missing: tuple[str | float, ...] = Field(
        (), description='values that mean that there is none, e.g. [-9999, "lost"]'
    )
    sheet: str | None = Field(None, min_length=1, description="the name of a sheet (XLSX)")
    variable: str | None = Field(None, min_length=1, description="the name of a variable (MAT)")

    @model_validator(mode="after")
    def _marks_differ(self) -> "FileFormat":
        if self.thousands == self.decimal:
            raise ValueError(f'thousands and decimal are both "{self.decimal}"; they must differ')
        if self.decimal == "," and self.separator == ",":
            raise ValueError('separator and decimal are both ","; they must differ')
        return self


class SecondFile(FileFormat):
    """[second_file]: the other half of the columns, e.g. the controller's log of the joints."""

    path: str | None = Field(
        None, min_length=1, description="a path relative to the mapping file; or give --second"
    )
    match: tuple[Column, Column] | None = Field(
        None, description="two columns, of the first and of this file, that name the row"
    )


class Position(Section):
    """[position]: the target's position, or those of several targets side by side."""

    columns: tuple[Column, ...] = Field(
        description="three columns x, y, z; with targets, three for each"
    )
    unit: Length = Field(description=_LENGTH)
    targets: tuple[str, ...] = Field(
        (),
        description="names of the targets whose positions stand side by side in a row; empty "
        "names for repeats of the only one",
    )

    @model_validator(mode="after")
    def _three_each(self) -> "Position":
        count = 3 * max(1, len(self.targets))
        if len(self.columns) != count:
            raise ValueError(
                f"columns: {len(self.columns)} given; it must be {count}"
                + (f" for {len(self.targets)} targets" if self.targets else ": x, y, z")
            )
        return self


class Orientation(Section):
    """[orientation]: the target's orientation."""

    columns: tuple[Column, ...] = Field(
        description="three columns of angles or of a rotation vector, four of a quaternion, or "
        "nine of a rotation matrix, row by row"
    )
    convention: str = Field(description=f"one of {', '.join(CONVENTIONS)}")
    unit: Angle = Field("rad", description=_ANGLE)

    @model_validator(mode="after")
    def _valid_convention(self) -> "Orientation":
        if self.convention not in CONVENTIONS:
            raise ValueError(
                f'convention = "{self.convention}" is unknown'
                f"{suggest(self.convention, list(CONVENTIONS))}; valid: {', '.join(CONVENTIONS)}"
            )
        count = NUMBERS.get(CONVENTIONS[self.convention], 3)
        if len(self.columns) != count:
            raise ValueError(f'columns: {len(self.columns)} given; "{self.convention}" has {count}')
        return self


class Joints(Section):
    """[actual_joints]: joint angles that the encoders reported."""

    columns: PerJoint
    slide_unit: Length = Field("m", description=_LENGTH + ", of joints that slide")
    unit: Angle = Field(description=_ANGLE)
    from_zero: bool = Field(
        False,
        description="true where angles are counted from 0 to 360°: those over 180° then count as "
        "negative ones; else false",
    )


class CommandedJoints(Joints):
    """[joints]: commanded joint angles."""

    reported: bool = Field(
        False,
        description="true where the encoders reported them: those of a pose's first row then "
        "count as commanded; else false",
    )


class Name(Section):
    """[cycle], [target], [station]: a column of names or numbers."""

    column: Column = Field(description=_COLUMN)


class PoseName(Section):
    """[pose]: a column of names; or every row is a pose of its own."""

    column: Column | None = Field(None, description=_COLUMN)
    each_row: bool = Field(
        False, description="true where every row is a pose of its own, called after its number"
    )

    @model_validator(mode="after")
    def _one_source(self) -> "PoseName":
        if (self.column is None) != self.each_row:
            raise ValueError("column or each_row = true: give one of them")
        return self


class LoadName(Name):
    """[load]: the load's name."""

    none: tuple[str, ...] = Field(UNLOADED, description="the names that mean no load")


class Time(Name):
    """[time] and [load_time]: seconds, a date and time, or a spreadsheet's day number."""

    unit: Literal["s", "ms", "us", "ns", "min", "h", "iso", "excel", "format"] = Field(
        description='"s", "ms", "us", "ns", "min", "h", "iso" (2024-05-31T12:00:00), "excel" '
        '(days since 1899-12-30), or "format" with the key format'
    )
    format: str | None = Field(
        None, min_length=1, description='as of strptime, e.g. "%d.%m.%Y %H:%M:%S"'
    )
    date_column: Column | None = Field(
        None, description="the column of the date, where the other has the time of day alone"
    )

    @model_validator(mode="after")
    def _both(self) -> "Time":
        if (self.unit == "format") != (self.format is not None):
            raise ValueError('unit = "format" and the key format belong together')
        if self.date_column is not None and self.unit not in ("iso", "format"):
            raise ValueError('date_column needs unit = "iso" or "format", of date and time of day')
        return self


class Air(Name):
    """[air]: temperature of the air."""

    optional: bool = Field(False, description=_OPTIONAL)
    unit: Temperature = Field("degC", description=_UNIT_T)


class JointTemperatures(Section):
    """[joint_temperatures]: one per joint."""

    columns: PerJoint
    unit: Temperature = Field("degC", description=_UNIT_T)


class Torques(Section):
    """[torques]: static torques that the drives were measured to exert; of slides forces."""

    columns: PerJoint
    unit: Literal["Nm", "Nmm", "kNm"] = Field("Nm", description='"Nm", "Nmm" or "kNm"')
    slide_unit: Literal["N", "kN", "kgf", "lbf"] = Field(
        "N", description='"N", "kN", "kgf" or "lbf", of joints that slide'
    )
    of: Literal["drive", "load"] = Field(
        "drive",
        description='"drive": positive in the direction in which the joint\'s value grows, so that '
        'it holds against the load; "load": the opposite, what the drive is loaded with',
    )


class OneNumber(Name):
    """[distance] from a point, [gauge]: height over a plane; rows without it leave it empty."""

    unit: Length = Field(description=_LENGTH)
    name_column: Column | None = Field(
        None, description="the column that names the row's point or gauge"
    )
    name: str | None = Field(None, min_length=1, description="the name of the only point or gauge")
    std_column: Column | None = Field(
        None, description="the column of its standard deviation; else std_m of the cell counts"
    )
    std_unit: Length | None = Field(None, description=_LENGTH + "; as unit where left out")

    @model_validator(mode="after")
    def _one_source(self) -> "OneNumber":
        if (self.name_column is None) == (self.name is None):
            raise ValueError("name_column or name: give one of them")
        if self.std_unit is not None and self.std_column is None:
            raise ValueError("std_unit needs std_column")
        return self


class Wrench(Section):
    """[wrench]: what the load exerts on the tool at the load point; empty is 0."""

    columns: Annotated[tuple[Column, ...], _columns(1, 3, 6)] = Field(
        description="three columns: fx, fy, fz; or six with mx, my, mz; or fz alone"
    )
    unit: Literal["N", "kN", "kgf", "lbf"] = Field("N", description='"N", "kN", "kgf" or "lbf"')
    moment_unit: Literal["Nm", "Nmm", "kNm"] = Field("Nm", description='"Nm", "Nmm" or "kNm"')
    of: Literal["load", "reaction"] = Field(
        "load", description='"load": exerted on the tool; "reaction": exerted by the tool'
    )
    axes: Literal["base", "flange"] = Field(
        "base", description='"base" or "flange": the axes in which the columns are'
    )


class HungMass(Name):
    """[hung_mass]: a mass that hangs at the load point; its weight is the wrench. Empty is 0."""

    unit: Literal["kg", "g", "lb", "N", "kN", "kgf", "lbf"] = Field(
        "kg", description='"kg", "g" or "lb" of a mass; "N", "kN", "kgf" or "lbf" of its weight'
    )


class Approach(Section):
    """[approach]: the side from which each joint arrived, -1 or +1."""

    columns: tuple[Column, ...] = Field((), description="one column per joint")
    by_order: bool = Field(
        False, description="true where rows stand in the order of the moves, which tell the side"
    )

    @model_validator(mode="after")
    def _one_source(self) -> "Approach":
        if bool(self.columns) == self.by_order:
            raise ValueError("columns or by_order = true: give one of them")
        return self


class Rows(Section):
    """[rows]: which rows are readings."""

    plausible_only: bool = Field(
        description="true: leave out rows that read what the row before reads though the joints "
        "were sent elsewhere, and rows of the same joints whose positions cannot all be right"
    )


class Instrument(Section):
    """[instrument]: its noise, where the table's figures are not of the cell's [tracker]."""

    range_std_m: NonNegative = Field(description="along the beam, m, e.g. 5e-6")
    range_std_per_m: NonNegative = Field(0.0, description="its growth with distance, m/m")
    transverse_std_m: NonNegative = Field(description="across the beam, m, e.g. 8e-6")
    transverse_std_per_m: NonNegative = Field(0.0, description="its growth with distance, m/m")
    orientation_std_rad: NonNegative = Field(0.0, description="of an orientation, rad")

    def noise(self) -> TrackerNoise:
        """Return the noise as a specification, whose fields are these in the same order."""
        return TrackerNoise(*self.model_dump().values())


class Std(Section):
    """[std]: standard deviations, as columns or as figures for all readings."""

    columns: tuple[Column, ...] = Field(
        (), description="one column for all axes, three for the position, or six"
    )
    values: tuple[NonNegative, ...] = Field(
        (), description="one number for all axes, three for the position, or six"
    )
    kind: Literal["std", "expanded", "variance"] = Field(
        "std",
        description='"std", "expanded" (U = k times the standard deviation) or "variance" '
        "(then unit and angle_unit are those of its root)",
    )
    k: Positive = Field(2.0, description="the coverage factor of an expanded uncertainty, e.g. 2")
    of: Literal["axis", "point"] = Field(
        "axis", description='"axis", or "point": one figure is the 3-D length, √3 times an axis\'s'
    )
    unit: Length = Field("m", description=_LENGTH)
    angle_unit: Angle = Field("rad", description=_ANGLE)
    add_instrument: bool = Field(
        False,
        description="true where they are the scatter of samples only: the noise in [tracker] is "
        "added, else false",
    )
    at_least: tuple[NonNegative, NonNegative] | None = Field(
        None,
        description="the least figure of a position and of an angle, in their units: the mean of "
        "few samples can agree by chance",
    )
    optional: bool = Field(
        False, description=f"{_OPTIONAL}; at_least is taken in the place of the columns then"
    )

    @model_validator(mode="after")
    def _number(self) -> "Std":
        if bool(self.columns) == bool(self.values):
            raise ValueError("columns or values: give one of them")
        count = len(self.columns) or len(self.values)
        if count != 1 and count % 3:
            raise ValueError(f"{count} figures; it must be 1, 3 or 6, or 3 for each target")
        if self.of == "point" and count != 1:
            raise ValueError(f'of = "point" with {count} figures; it must be one')
        if self.values and not all(self.values):
            raise ValueError("values must be more than 0")
        if self.optional and (self.at_least is None or not self.columns):
            raise ValueError("optional = true needs columns and at_least")
        return self


class Correlation(Section):
    """[correlation]: coefficients beside [std]."""

    columns: Annotated[tuple[Column, ...], _columns(3, 15)] = Field(
        description="three columns (xy, xz, yz), or the 15 of the upper triangle row by row"
    )


class CovarianceColumns(Section):
    """[covariance]: the matrix, its upper triangle or all of it, row by row."""

    columns: Annotated[tuple[Column, ...], _columns(6, 9, 21, 36)] = Field(
        description="6 (upper triangle) or 9 columns of the position's covariance, or 21 or 36"
    )
    unit: Length = Field(description=_LENGTH + "; the covariance is in its square")
    angle_unit: Angle = Field("rad", description=_ANGLE)


class PointMapping(Section):
    """A mapping file for points to go to: they have joint values, positions, or both."""

    file: FileFormat = Field(default_factory=FileFormat)
    second_file: SecondFile | None = None
    position: Position | None = Field(None, description=_POSITION)
    orientation: Orientation | None = None
    joints: CommandedJoints | None = Field(None, description=_JOINTS)
    actual_joints: Joints | None = None
    pose: PoseName | None = Field(None, description="a section [pose] with column")
    load: LoadName | None = Field(None, description="a section [load] with column")
    cycle: Name | None = Field(None, description="a section [cycle] with column")
    target: Name | None = Field(None, description="a section [target] with column")
    station: Name | None = Field(None, description="a section [station] with column")
    distance: OneNumber | None = None
    gauge: OneNumber | None = None
    torques: Torques | None = None
    time: Time | None = None
    load_time: Time | None = None
    air: Air | None = None
    joint_temperatures: JointTemperatures | None = None
    wrench: Wrench | None = None
    hung_mass: HungMass | None = None
    approach: Approach | None = None
    rows: Rows | None = None
    instrument: Instrument | None = None
    std: Std | None = None
    correlation: Correlation | None = None
    covariance: CovarianceColumns | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.position is None and self.joints is None:
            raise ValueError("neither [joints] nor [position]: one of them says where a point is")
        if self.position is None and self.orientation is not None:
            raise ValueError("[orientation] needs [position]")
        if self.wrench and self.hung_mass:
            raise ValueError("[wrench] together with [hung_mass]; give one of them")
        if self.covariance and (self.std or self.correlation):
            raise ValueError("[covariance] together with [std] or [correlation]; give one of them")
        if self.correlation and (self.std is None or len(self.std.columns) == 1):
            raise ValueError("[correlation] needs [std] with three or six columns")
        targets = () if self.position is None else self.position.targets
        wide = 3 * len(targets)
        figures = 0 if self.std is None else len(self.std.columns or self.std.values)
        matrix = 0 if self.covariance is None else len(self.covariance.columns)
        if ((figures == 6 and wide != 6) or matrix > 9) and self.orientation is None:
            raise ValueError("uncertainties of six elements need [orientation]")
        reported = self.joints is not None and self.joints.reported
        if reported and (self.pose is None or self.actual_joints is not None):
            raise ValueError("[joints] reported = true needs [pose], and no [actual_joints]")
        if self.scalars and (self.orientation or targets or self.rows):
            raise ValueError(
                "[distance] or [gauge] together with [orientation], [rows] or targets in "
                "[position]; give those in a table of their own"
            )
        if targets and self.target:
            raise ValueError("[target] together with targets in [position]; give one of them")
        if figures > 6 and not targets:
            raise ValueError("[std] has more than 6 figures; it must be 1, 3 or 6")
        if self.load_time and self.load_time.unit not in TIMES:
            raise ValueError('[load_time] unit must be "s", "ms", "min" or "h"')
        return self

    @property
    def scalars(self) -> dict[ObserverKind, OneNumber]:
        """Sections of readings that are one number, by kind of observer."""
        both: dict[ObserverKind, OneNumber | None] = {"point": self.distance, "gauge": self.gauge}
        return {kind: section for kind, section in both.items() if section is not None}


class Mapping(PointMapping):
    """The whole of a mapping file for readings."""

    joints: CommandedJoints = Field(description=_JOINTS)

    @model_validator(mode="after")
    def _read(self) -> Self:
        if self.position is None and not self.scalars:
            raise ValueError(f"no reading: it must be {_POSITION}, or [distance] or [gauge]")
        if self.position is None and (self.std or self.covariance or self.station):
            raise ValueError("[std], [covariance] and [station] need [position]")
        return self


M = TypeVar("M", bound=PointMapping)


def mapping_names() -> tuple[str, ...]:
    """Names of the mappings that come with the program."""
    return tuple(sorted(path.stem for path in (configs_dir() / "mappings").glob("*.toml")))


def find_mapping(name: str | Path, kind: type[M]) -> M:
    """Load a mapping by the name of one that comes with the program, or by a file's path."""
    if str(name) in mapping_names():
        return load_mapping(configs_dir() / "mappings" / f"{name}.toml", kind)
    if Path(name).suffix.lower() != ".toml":
        names = (TABLE, *mapping_names())
        raise InputError(
            f"--format {name} is unknown{suggest(str(name), names)}; valid: {', '.join(names)}, "
            f"or the path of a mapping file (.toml)"
        )
    return load_mapping(Path(name), kind)


def load_mapping(path: Path, kind: type[M]) -> M:
    """Read a mapping file."""
    mapping = load_section(path, kind)
    if (second := mapping.second_file) is None or second.path is None:
        return mapping
    folder = path.absolute().parent
    if not (folder / second.path).resolve().is_relative_to(folder.resolve()):
        raise InputError(
            f"{path}: [second_file] path = {second.path!r} leaves the folder of the mapping; a "
            "mapping names files beside or below it, others are given by --second"
        )
    second = second.model_copy(update={"path": str(folder / second.path)})
    return mapping.model_copy(update={"second_file": second})
