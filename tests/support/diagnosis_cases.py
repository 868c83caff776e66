"""What the tests of the diagnosis share."""

from hilcal.diagnosis.stepwise import add
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.readings.readings import Readings
from tests.support.campaigns import Campaign


def fitted(c: Campaign, *effects: str, readings: Readings | None = None) -> Fit:
    """The baseline of a campaign, fitted, with effects added."""
    given = c.readings if readings is None else readings
    found = fit(baseline(c.cell, given, c.mode), given, c.mode)
    for name in effects:
        found = add(found, name)
    return found
