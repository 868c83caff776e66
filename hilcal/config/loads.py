"""Sections of CELL.toml: the loads at hand, and the limits that are kept."""

from typing import Annotated

import numpy as np
from pydantic import Field, Strict, model_validator

from hilcal.config.rig import VECTOR_M
from hilcal.toml import NonNegative, Positive, Section, Vector3
from hilcal.types import Floats

HANG_M = 0.3
"""Length of what hangs from the load point where a load with a mass does not say, m."""


class CellLoad(Section):
    """[[loads]]: a load at hand: a dead weight, a pull in base axes, or both."""

    name: str = Field(min_length=1, description='a name other than "none"', examples=["5kg"])
    mass_kg: NonNegative = Field(0.0, description="a mass in kg, 0 or more", examples=[5.0])
    force_N: Vector3 = Field(
        (0.0, 0.0, 0.0),
        description="three finite numbers in N, base axes, e.g. [50.0, 0.0, 0.0]",
        examples=[[80.0, 0.0, 0.0]],
    )
    moment_Nm: Vector3 = Field(
        (0.0, 0.0, 0.0),
        description="three finite numbers in N·m, base axes",
        examples=[[0.0, 6.0, 6.0]],
    )
    hang_m: NonNegative | None = Field(
        None,
        description="the length in m of what hangs below the load point, 0 or more; if absent "
        f"{HANG_M:g} for a load with a mass, else 0",
        examples=[0.3],
    )
    radius_m: Positive = Field(
        0.06, description="the radius in m of what hangs below the load point, over 0"
    )
    cable_m: NonNegative = Field(
        0.0,
        description="the length in m of the cable of a pull, kept clear along force_N, 0 or more",
        examples=[2.0],
    )

    @model_validator(mode="after")
    def _some_load(self) -> "CellLoad":
        if self.name == "none":
            raise ValueError('the name "none" is kept for the unloaded state; choose another')
        if self.mass_kg == 0.0 and not any((*self.force_N, *self.moment_Nm)):
            raise ValueError(
                f'load "{self.name}" is zero; give mass_kg, force_N or moment_Nm '
                "(the unloaded state is always there)"
            )
        if self.cable_m > 0.0 and not any(self.force_N):
            raise ValueError(f'load "{self.name}" has cable_m without force_N; it has no direction')
        for key in ("hang_m", "radius_m", "cable_m"):
            if (getattr(self, key) or 0.0) > 50.0:
                raise ValueError(f"{key} = {getattr(self, key)} is over 50 m; is it in m?")
        return self

    @property
    def hanging_m(self) -> float:
        """Length of what hangs below the load point, m: `hang_m`, or its default."""
        if self.hang_m is not None:
            return self.hang_m
        return HANG_M if self.mass_kg > 0.0 else 0.0

    def wrench(self, gravity: Floats) -> Floats:
        """Return (6,) force and moment at the load point, base axes, N and N·m.

        force = mass * gravity + force_N; a dead weight hangs from the load point.
        """
        force = self.mass_kg * gravity + np.asarray(self.force_N)
        return np.concatenate([force, np.asarray(self.moment_Nm)])


class Limits(Section):
    """[limits]: what a plan keeps clear of, and the error that is allowed."""

    joint_margin_rad: NonNegative = Field(
        0.05, description="the distance kept from every joint limit in rad, 0 or more"
    )
    torque_share: Annotated[float, Strict(), Field(gt=0, le=1)] = Field(
        0.9, description="the usable share of the joint torques, more than 0, at most 1"
    )
    workspace_min_m: Vector3 | None = Field(
        None,
        description=VECTOR_M + ": a corner that forearm, wrists, tool and what hangs stay above; "
        "if absent, the mounting plane z = 0 is the floor",
        examples=[[-1.2, -1.2, 0.05]],
    )
    workspace_max_m: Vector3 | None = Field(
        None,
        description=VECTOR_M + ": a corner that forearm, wrists, tool and what hangs stay below",
        examples=[[1.2, 1.2, 1.5]],
    )
    joint_speed_rad_s: Positive = Field(
        2.0, description="a measured joint speed in rad/s that stops the arm, over 0"
    )
    accuracy_m: Positive | None = Field(
        None,
        description="the largest 3-D position error that is allowed in m, over 0: calibrate, "
        "validate and report judge by it where --limit is not given",
        examples=[0.0001],
    )

    @model_validator(mode="after")
    def _box(self) -> "Limits":
        low, high = self.workspace_min_m, self.workspace_max_m
        if (
            low is not None
            and high is not None
            and not all(a < b for a, b in zip(low, high, strict=True))
        ):
            raise ValueError(
                f"workspace_min_m = {list(low)} is not below workspace_max_m = {list(high)}"
            )
        return self
