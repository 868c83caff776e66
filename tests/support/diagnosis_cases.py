"""What the tests of the diagnosis share."""

from hilcal.diagnosis.stepwise import add
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from studies.study_cases import study_case
from tests.support.campaigns import configuration
from tests.support.fit_cases import fitted_model


def fitted_baseline(c, *effects, readings=None):
    """The baseline of a campaign, fitted, with effects added."""
    given = c.readings if readings is None else readings
    fitted = fit(baseline(c.cell, given, c.mode), given, c.mode)
    for name in effects:
        fitted = add(fitted, name)
    return fitted


def studied(mode, *hidden, robot="ur5e", seed=1, strength=3.0, **more):
    """The baseline of a campaign of the studies, which hides effects or laws."""
    c = study_case(configuration(), robot, mode, hidden, strength, seed, **more)
    return fitted_model(c.cell, c.readings, mode)
