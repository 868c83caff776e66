"""What an import returns."""

from dataclasses import dataclass

from hilcal.readings.covariance import INSTRUMENT
from hilcal.readings.readings import Readings


@dataclass(frozen=True, slots=True, eq=False)
class ImportResult:
    """Readings, and what was decided on the way.

    Attributes:
        readings: the readings that can be used.
        notes: one sentence per decision; left out rows are named as a spreadsheet counts them.
        covers: what the covariances cover, see `readings.covariance`.
        noise_stated: whether the table or [tracker] states the noise; where False, the covariances
            are those of the instrument that [tracker] has by default.
        from_tracker: whether the covariances are those of the noise in [tracker].
    """

    readings: Readings
    notes: tuple[str, ...]
    covers: str = INSTRUMENT
    noise_stated: bool = True
    from_tracker: bool = False
