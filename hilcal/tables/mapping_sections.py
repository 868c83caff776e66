"""Sections of a mapping file: what one column, or columns that belong together, hold."""

from typing import Annotated, Literal

from pydantic import Field, Strict, model_validator

from hilcal.tables.orientation import CONVENTIONS, NUMBERS
from hilcal.tables.units import Angle, Length, Temperature
from hilcal.toml import NonNegative, Positive, Section, suggest

Column = Annotated[str, Field(min_length=1)] | Annotated[int, Strict(), Field(ge=1)]
Row = Annotated[int, Strict(), Field(ge=1)]
_UNLOADED = (
    "none|0|no|no load|unloaded|empty|-|ohne|leer|keine|unbelastet|sans|sans charge|vide|"
    "sin carga|vacío|senza|无|空载"
)
UNLOADED = tuple(_UNLOADED.split("|"))
"""Names that mean "no load" unless the mapping lists others, in small letters; a choice."""

_COLUMN = "the name of a column, or its number from 1"
_LENGTH = 'a unit of length: "m", "mm", "um" or "in"'
_ANGLE = 'a unit of angles: "rad", "mrad", "deg" or "arcsec"'
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
    encoding: Literal["utf-8", "latin-1", "utf-16"] | None = Field(
        None, description='"utf-8", "latin-1" or "utf-16"'
    )
    header_row: Annotated[int, Strict(), Field(ge=0)] = Field(
        1, description="the row of the column names, a whole number from 1; 0 where there is none"
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
        (), description="names of the targets whose positions stand side by side in a row"
    )

    @model_validator(mode="after")
    def _three_each(self) -> "Position":
        wanted = 3 * max(1, len(self.targets))
        if len(self.columns) != wanted:
            raise ValueError(
                f"columns: {len(self.columns)} given; it must be {wanted}"
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
    def _known(self) -> "Orientation":
        if self.convention not in CONVENTIONS:
            raise ValueError(
                f'convention = "{self.convention}" is unknown'
                f"{suggest(self.convention, list(CONVENTIONS))}; valid: {', '.join(CONVENTIONS)}"
            )
        wanted = NUMBERS.get(CONVENTIONS[self.convention], 3)
        if len(self.columns) != wanted:
            raise ValueError(
                f'columns: {len(self.columns)} given; "{self.convention}" has {wanted}'
            )
        return self


class Joints(Section):
    """[actual_joints]: joint angles that the encoders reported."""

    columns: Annotated[tuple[Column, ...], Field(min_length=1)] = Field(
        description="one column per joint"
    )
    unit: Angle = Field(description=_ANGLE)


class CommandedJoints(Joints):
    """[joints]: commanded joint angles."""

    reported: bool = Field(
        False,
        description="true where they are what the encoders reported: those of a pose's first row "
        "then count as commanded, else false",
    )


class Name(Section):
    """[pose], [cycle]: a column of names or numbers."""

    column: Column = Field(description=_COLUMN)


class LoadName(Section):
    """[load]: the load's name."""

    column: Column = Field(description=_COLUMN)
    none: tuple[str, ...] = Field(UNLOADED, description="the names that mean no load")


class Time(Section):
    """[time] and [load_time]: seconds, a date and time, or a spreadsheet's day number."""

    column: Column = Field(description=_COLUMN)
    unit: Literal["s", "ms", "min", "h", "iso", "excel", "format"] = Field(
        description='"s", "ms", "min", "h", "iso" (2024-05-31T12:00:00), "excel" (days since '
        '1899-12-30), or "format" with the key format'
    )
    format: str | None = Field(
        None, min_length=1, description='as of strptime, e.g. "%d.%m.%Y %H:%M:%S"'
    )

    @model_validator(mode="after")
    def _both(self) -> "Time":
        if (self.unit == "format") != (self.format is not None):
            raise ValueError('unit = "format" and the key format belong together')
        return self


class Air(Section):
    """[air]: temperature of the air."""

    column: Column = Field(description=_COLUMN)
    unit: Temperature = Field("degC", description=_UNIT_T)


class JointTemperatures(Section):
    """[joint_temperatures]: one per joint."""

    columns: Annotated[tuple[Column, ...], Field(min_length=1)] = Field(
        description="one column per joint"
    )
    unit: Temperature = Field("degC", description=_UNIT_T)


class Wrench(Section):
    """[wrench]: what the load exerts on the tool at the load point, base axes; empty is 0."""

    columns: tuple[Column, ...] = Field(
        description="three columns: fx, fy, fz; or six with mx, my, mz"
    )
    unit: Literal["N", "kN", "kgf", "lbf"] = Field("N", description='"N", "kN", "kgf" or "lbf"')
    moment_unit: Literal["Nm", "Nmm", "kNm"] = Field("Nm", description='"Nm", "Nmm" or "kNm"')
    of: Literal["load", "reaction"] = Field(
        "load", description='"load": exerted on the tool; "reaction": exerted by the tool'
    )

    @model_validator(mode="after")
    def _number(self) -> "Wrench":
        if len(self.columns) not in (3, 6):
            raise ValueError(f"columns: {len(self.columns)} given; it must be 3 or 6")
        return self


class HungMass(Section):
    """[hung_mass]: a mass that hangs at the load point; its weight is the wrench. Empty is 0."""

    column: Column = Field(description=_COLUMN)
    unit: Literal["kg", "g", "lb"] = Field("kg", description='"kg", "g" or "lb"')


class Approach(Section):
    """[approach]: the side from which each joint arrived, -1 or +1."""

    columns: Annotated[tuple[Column, ...], Field(min_length=1)] = Field(
        description="one column per joint"
    )


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

    @model_validator(mode="after")
    def _number(self) -> "Std":
        if bool(self.columns) == bool(self.values):
            raise ValueError("columns or values: give one of them")
        given = len(self.columns) or len(self.values)
        if given not in (1, 6) and (given % 3 or not given):
            raise ValueError(f"{given} figures; it must be 1, 3 or 6, or 3 for each target")
        if self.of == "point" and given != 1:
            raise ValueError(f'of = "point" with {given} figures; it must be one')
        if self.values and not all(self.values):
            raise ValueError("values must be more than 0")
        return self


class Correlation(Section):
    """[correlation]: coefficients beside [std]."""

    columns: tuple[Column, ...] = Field(
        description="three columns (xy, xz, yz), or the 15 of the upper triangle row by row"
    )

    @model_validator(mode="after")
    def _number(self) -> "Correlation":
        if len(self.columns) not in (3, 15):
            raise ValueError(f"columns: {len(self.columns)} given; it must be 3 or 15")
        return self


class CovarianceColumns(Section):
    """[covariance]: the matrix, its upper triangle or all of it, row by row."""

    columns: tuple[Column, ...] = Field(
        description="6 (upper triangle) or 9 columns of the position's covariance, or 21 or 36"
    )
    unit: Length = Field(description=_LENGTH + "; the covariance is in its square")
    angle_unit: Angle = Field("rad", description=_ANGLE)

    @model_validator(mode="after")
    def _number(self) -> "CovarianceColumns":
        if len(self.columns) not in (6, 9, 21, 36):
            raise ValueError(f"columns: {len(self.columns)} given; it must be 6, 9, 21 or 36")
        return self
