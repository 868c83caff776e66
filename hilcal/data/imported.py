"""What an import returns."""

from dataclasses import dataclass

from hilcal.data.readings import Readings


@dataclass(frozen=True, slots=True, eq=False)
class ImportResult:
    """Readings, and what was decided on the way.

    Attributes:
        readings: the readings that can be used.
        notes: one sentence per decision; left out rows are named as a spreadsheet counts them.
    """

    readings: Readings
    notes: tuple[str, ...]
