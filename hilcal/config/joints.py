"""The keys that say how a controller counts the joints of its arm."""

from pydantic import Field, model_validator

from hilcal.toml import Number, Section


class Coupling(Section):
    """One entry of `joint_coupling`: a joint that another one takes along."""

    joint: int = Field(
        ge=1, description="the number of the joint that follows, from 1", examples=[3]
    )
    follows: int = Field(
        ge=1, description="the number of the joint that it follows, from 1", examples=[2]
    )
    factor: Number = Field(1.0, description="turns of the joint per turn of the one it follows")
    mechanical: bool = Field(
        True,
        description="true where the motor of the one turns the other along; false where the "
        "controller only counts so",
    )

    @model_validator(mode="after")
    def _another(self) -> "Coupling":
        if self.joint == self.follows:
            raise ValueError(f"joint = {self.joint} follows itself; name two joints")
        return self


class Conventions(Section):
    """Keys of [robot] and of a DH file that say how the controller counts the joints."""

    joint_sign: tuple[int, ...] | None = Field(
        None,
        description="1 or −1 per joint, e.g. [1, 1, 1, -1, 1, 1]",
        examples=[[1, 1, 1, -1, 1, 1]],
    )
    joint_offset_deg: tuple[Number, ...] | None = Field(
        None,
        description="an angle in degrees per joint, e.g. [0, -90, 0, 0, 0, 0]",
        examples=[[0.0, -90.0, 0.0, 0.0, 0.0, 0.0]],
    )
    joint_coupling: tuple[Coupling, ...] = Field(
        (),
        description="a list such as [{ joint = 3, follows = 2, factor = 1.0 }]",
        examples=[[{"joint": 3, "follows": 2, "factor": 1.0}]],
    )

    @model_validator(mode="after")
    def _signs(self) -> "Conventions":
        if any(s not in (1, -1) for s in self.joint_sign or ()):
            raise ValueError(f"joint_sign = {list(self.joint_sign or ())}; valid: 1 and −1")
        return self
