"""Sections [points.NAME] and [gauges.NAME]: what reads one number of the target's position."""

import numpy as np
from pydantic import Field, model_validator

from hilcal.config.rig import VECTOR_M
from hilcal.toml import Number, Positive, Section, Vector3


class Point(Section):
    """[points.NAME]: a point from which distances are measured: a ball bar, a cable, a range.

    In the axes of the positions. reading = |target − position| + offset.
    """

    position_m: Vector3 | None = Field(
        None,
        description=VECTOR_M + ": the point; leave it out to have it estimated",
        examples=[[1.2, 0.4, 0.0]],
    )
    offset_m: Number = Field(
        0.0,
        description="what the reading is beyond the distance, in m; see estimate_offset",
        examples=[0.0],
    )
    estimate_offset: bool = Field(
        False,
        description="true or false: whether offset_m is rough, and estimated, as the length of a "
        "bar whose change alone is read",
        examples=[True],
    )
    std_m: Positive | None = Field(
        None,
        description="the standard deviation of a reading in m, more than 0, where the table has no "
        "column cov_d_d",
        examples=[1e-5],
    )


class Gauge(Section):
    """[gauges.NAME]: a dial gauge, or a plane that is touched: one direction of the position.

    In the axes of the positions. reading = direction · (target − origin).
    """

    direction: Vector3 | None = Field(
        None,
        description="three numbers, the direction in which the reading grows; leave it out to have "
        "it estimated",
        examples=[[0.0, 0.0, 1.0]],
    )
    origin_m: Vector3 | None = Field(
        None,
        description=VECTOR_M + ": where the reading is 0; leave it out to have it estimated",
        examples=[[0.6, 0.2, 0.1]],
    )
    std_m: Positive | None = Field(
        None,
        description="the standard deviation of a reading in m, more than 0, where the table has no "
        "column cov_g_g",
        examples=[1e-6],
    )

    @model_validator(mode="after")
    def _sound(self) -> "Gauge":
        if self.direction is not None and not np.linalg.norm(self.direction) > 1e-6:
            raise ValueError(f"direction = {list(self.direction)} has no length")
        if self.origin_m is not None and self.direction is None:
            raise ValueError("origin_m without direction; give both, the direction, or neither")
        return self
