"""Sections of CELL.toml that say what a plan is for, and what stands around the arm."""

from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator, Field, Strict, model_validator

from hilcal.config.rig import VECTOR_M, Whole
from hilcal.toml import NonNegative, Number, Positive, Section, Vector3

_Name = Annotated[str, Field(min_length=1)]
_Joints = Annotated[tuple[Number, ...], Field(min_length=1)]
_BOX = ("center_m", "size_m")
_CYLINDER = ("bottom_m", "radius_m", "height_m")
LOADED = ("joint_compliance",)
"""What loads show, and what is planned for unless the cell says otherwise."""
GEOMETRY = ("encoder_offset",)
"""What a first plan of absolute readings is for, beside what loads do."""


class Planning(Section):
    """[planning]: what the measurements are for, and what is known of them."""

    model: tuple[_Name, ...] = Field(
        LOADED,
        min_length=1,
        description='the effects that are assumed, a list of names, e.g. ["joint_compliance"], '
        'with options as in ["joint_compliance(joints=2-6)"]',
        examples=[["joint_compliance", "creep(joints=each)"]],
    )
    readings: Literal["deflection", "absolute"] = Field(
        "deflection", description='"deflection" or "absolute": what will be fitted'
    )
    against: Literal["catalogue"] | tuple[_Name, ...] = Field(
        "catalogue",
        description='"catalogue", or a list of effects (may be empty), which the plan could still '
        "find although the model lacks them",
        examples=[["creep", "hysteresis"]],
    )
    criterion: Annotated[
        Literal["D", "A", "E", "K", "I", "separate"] | None,
        BeforeValidator(lambda name: "I" if name == "test" else name),  # its name before 1.0
    ] = Field(
        None,
        description='"D", "A", "E", "K", "I" or "separate"; if absent "I" for absolute readings, '
        '"D" for deflections',
        examples=["I"],
    )
    work_q_rad: tuple[_Joints, ...] = Field(
        (),
        description="a list of joint vectors in rad where the robot will work",
        examples=[[[0.0, -1.57, 1.57, 0.0, 1.57, 0.0]]],
    )
    work_min_m: Vector3 | None = Field(
        None,
        description=VECTOR_M + ": the lowest corner of the target's work, base axes",
        examples=[[0.3, -0.4, 0.2]],
    )
    work_max_m: Vector3 | None = Field(
        None,
        description=VECTOR_M + ": the highest corner of the target's work, base axes",
        examples=[[0.9, 0.4, 0.8]],
    )
    work_load: _Name = Field(
        "none",
        description='the name of one of [[loads]], or "none", under which it will work',
        examples=["5kg"],
    )
    reading_s: Positive | None = Field(
        None,
        description="how long a reading takes in s, over 0; from [acquire] if absent",
        examples=[8.0],
    )
    load_change_s: Positive = Field(
        60.0, description="how long a person needs for a change of the load in s, over 0"
    )
    candidates: Annotated[Whole, Field(le=1_000_000)] = Field(
        2000, description="how many poses to choose from, a whole number, 1 to 1000000"
    )
    singularity: Annotated[float, Strict(), Field(ge=0, lt=1)] = Field(
        0.05,
        description="the least ratio of the smallest to the largest singular value of the "
        "flange's Jacobian, lengths in units of the reach, 0 or more, below 1",
    )

    @model_validator(mode="after")
    def _work(self) -> "Planning":
        low, high = self.work_min_m, self.work_max_m
        if (low is None) != (high is None):
            alone, other = ("work_min_m", "work_max_m")[:: 1 if high is None else -1]
            raise ValueError(f"{alone} alone; a box needs {other} too")
        if low is not None and high is not None:
            if self.work_q_rad:
                raise ValueError("work_q_rad together with work_min_m; give one of them")
            if not all(a < b for a, b in zip(low, high, strict=True)):
                raise ValueError(f"work_min_m = {list(low)} is not below work_max_m = {list(high)}")
        if len({len(q) for q in self.work_q_rad}) > 1:
            raise ValueError("work_q_rad has joint vectors of different lengths")
        return self


class Obstacle(Section):
    """[[obstacles]]: a box along the base axes, or a cylinder that stands along base z."""

    name: str = Field(min_length=1, description='a name, e.g. "tripod"', examples=["tripod"])
    center_m: Vector3 | None = Field(
        None, description=VECTOR_M + ": the box's centre, base axes", examples=[[0.0, 0.9, 0.4]]
    )
    size_m: tuple[Positive, Positive, Positive] | None = Field(
        None,
        description="three lengths in m, over 0: the box along x, y and z of the base",
        examples=[[1.2, 0.6, 0.8]],
    )
    bottom_m: Vector3 | None = Field(
        None,
        description=VECTOR_M + ": the centre of the cylinder's lower face, base axes",
        examples=[[0.9, -0.9, 0.0]],
    )
    radius_m: Positive | None = Field(
        None, description="the cylinder's radius in m, over 0", examples=[0.3]
    )
    height_m: Positive | None = Field(
        None, description="the cylinder's height in m, over 0", examples=[1.2]
    )

    @model_validator(mode="after")
    def _one_shape(self) -> "Obstacle":
        box = [key for key in _BOX if getattr(self, key) is not None]
        cylinder = [key for key in _CYLINDER if getattr(self, key) is not None]
        whole = (len(box), len(cylinder)) in ((len(_BOX), 0), (0, len(_CYLINDER)))
        if not whole:
            given = ", ".join((*box, *cylinder)) or "no shape"
            raise ValueError(
                f'obstacle "{self.name}" has {given}; give {" and ".join(_BOX)} for a box, or '
                f"{', '.join(_CYLINDER[:-1])} and {_CYLINDER[-1]} for an upright cylinder"
            )
        lengths = (*(self.size_m or ()), self.radius_m or 0.0, self.height_m or 0.0)
        if max(lengths) > 100.0:
            raise ValueError(f'obstacle "{self.name}" measures {max(lengths):g} m; is it in m?')
        return self


class Sight(Section):
    """[sight]: what the tracker sees of the target."""

    tracker_m: Vector3 | None = Field(
        None,
        description=VECTOR_M + ": the tracker's approximate position in base axes",
        examples=[[3.0, 0.5, 0.9]],
    )
    target_normal: Vector3 | None = Field(
        None,
        description="three numbers, not all 0: where the reflector looks, flange axes",
        examples=[[0.0, 0.0, 1.0]],
    )
    incidence_max_rad: Annotated[float, Strict(), Field(gt=0, le=np.pi / 2)] = Field(
        0.5,
        description="the largest angle between the reflector's normal and the beam in rad, "
        "over 0, at most 1.5707",
    )
    clearance_m: NonNegative = Field(
        0.03, description="the distance between the beam and the arm in m, 0 or more"
    )

    @model_validator(mode="after")
    def _plausible(self) -> "Sight":
        if self.target_normal is not None and not any(self.target_normal):
            raise ValueError("target_normal = [0.0, 0.0, 0.0] points nowhere; e.g. [0, 0, 1]")
        if self.clearance_m > 1.0:
            raise ValueError(f"clearance_m = {self.clearance_m} is over 1 m; is it in m?")
        return self
