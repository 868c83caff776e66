"""Where a campaign's readings go while they are measured."""

from typing import Any, Protocol

from hilcal.readings.readings import Readings
from hilcal.store.plan import Step


class Store(Protocol):
    """A campaign file that is being written.

    What `record` and `event` have returned from survives a kill of the process. Both raise
    InputError or DeviceError, one clear line, where it cannot be written.
    """

    def record(
        self, reading: Readings, step: Step, detail: dict[str, Any], *more: dict[str, Any]
    ) -> None:
        """Store a step's reading with everything raw behind it, as one transaction.

        Of several targets all that were read in the arrival: a row and a detail for each.
        """
        ...

    def event(self, kind: str, content: dict[str, Any]) -> None:
        """Store something that happened."""
        ...

    def done(self) -> frozenset[Step]:
        """Return the steps whose readings are stored."""
        ...

    def details(self) -> list[dict[str, Any]]:
        """Return the details of the stored readings, in order."""
        ...

    def readings(self) -> Readings | None:
        """Return the stored readings, in order; None where there are none yet."""
        ...
