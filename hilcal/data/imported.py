"""What an import returns."""

from dataclasses import dataclass

from hilcal.data.covariance import INSTRUMENT
from hilcal.data.readings import Readings


@dataclass(frozen=True, slots=True, eq=False)
class ImportResult:
    """Readings, and what was decided on the way.

    Attributes:
        readings: the readings that can be used.
        notes: one sentence per decision; left out rows are named as a spreadsheet counts them.
        covers: what the covariances cover, see `data.covariance`.
    """

    readings: Readings
    notes: tuple[str, ...]
    covers: str = INSTRUMENT
