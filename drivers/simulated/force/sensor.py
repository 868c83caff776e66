"""What the server asks of a sensor's protocol."""

from typing import Any, Protocol

from hilcal.types import Floats


class SensorProtocol(Protocol):
    """A sensor's wire protocol.

    Attributes:
        baud: the line's rate, Bd.
        rate: frames per second; may change by command.
        noise: of one frame, force in N and moment in N·m.
        streaming: whether it sends by itself.
    """

    baud: int
    rate: float
    noise: tuple[float, float]
    streaming: bool

    def frame(self, number: int, wrench: Floats, temperature: float) -> bytes:
        """Return one frame.

        Args:
            number: of the frame since power-on, lost ones counted.
            wrench: (6,) N and N·m.
            temperature: °C.
        """
        ...

    def receive(self, data: bytes, wrench: Floats) -> bytes:
        """Take in what the client sent and return the answer, empty where there is none."""
        ...

    def admin(self, op: str, arguments: dict[str, Any]) -> bool:
        """Carry out an admin operation of this sensor's own; False where there is none such."""
        ...
