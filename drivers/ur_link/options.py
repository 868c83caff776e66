"""[robot.options] of the driver `ur`."""

from typing import Annotated

from pydantic import Field, Strict

from hilcal.toml import Section


class UrOptions(Section):
    """[robot.options]: keys of the driver "ur"."""

    receive_hz: Annotated[float, Strict(), Field(ge=10, le=500)] = Field(
        125.0, description="packets of state per second, 10 to 500"
    )
    robot_api_port: Annotated[int, Strict(), Field(ge=1, le=65535)] = Field(
        80, description="number of the TCP port of PolyScope X's Robot API, 1 to 65535"
    )
