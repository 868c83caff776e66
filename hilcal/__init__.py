"""hilcal: calibration of the elastic and geometric errors of a robot arm.

    import hilcal as hc

    with hc.Campaign("run.hilcal") as run:
        fit = hc.fit(hc.baseline(run), run)
        print(fit.summary())
        print(hc.diagnose(fit).verdict)

Every name is imported when it is first used, so that `import hilcal` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "1.0.0"

_NAMES = {
    "hilcal.calibration.calibration": ("Calibration",),
    "hilcal.campaign.campaign": ("Campaign",),
    "hilcal.campaign.posteriors": ("load_posterior",),
    "hilcal.cell": ("Cell",),
    "hilcal.diagnosis.comparison": ("Comparison",),
    "hilcal.diagnosis.diagnosis": ("Diagnosis",),
    "hilcal.discovery.discovery": ("discover",),
    "hilcal.effects.catalogue": ("Catalogue", "installed"),
    "hilcal.effects.check": ("check_effect",),
    "hilcal.effects.protocol": ("Effect", "effect"),
    "hilcal.errors": ("CannotAnswerError", "DeviceError", "HilcalError", "InputError"),
    "hilcal.identification.fit": ("Fit",),
    "hilcal.identification.carried.posterior": ("Posterior",),
    "hilcal.identification.registration.table_preview": ("preview_table",),
    "hilcal.library": (
        "baseline",
        "bootstrap",
        "diagnose",
        "fit",
        "fit_stream",
        "import_campaign",
        "plan",
        "read_table",
        "refine",
        "simulate",
        "view",
    ),
    "hilcal.model.model": ("Model",),
    "hilcal.procedure.procedure": ("Procedure",),
    "hilcal.readings.readings": ("Readings", "States"),
    "hilcal.refinement": ("Refinement",),
    "hilcal.transfer.compare": ("compare", "validate"),
    "hilcal.write_report": ("report",),
}
"""Names of the library, by module."""
_PLACES = {name: module for module, names in _NAMES.items() for name in names}

__all__ = ["__version__", *sorted(_PLACES)]

if TYPE_CHECKING:
    from hilcal.calibration.calibration import Calibration as Calibration
    from hilcal.campaign.campaign import Campaign as Campaign
    from hilcal.campaign.posteriors import load_posterior as load_posterior
    from hilcal.cell import Cell as Cell
    from hilcal.diagnosis.comparison import Comparison as Comparison
    from hilcal.diagnosis.diagnosis import Diagnosis as Diagnosis
    from hilcal.discovery.discovery import discover as discover
    from hilcal.effects.catalogue import Catalogue as Catalogue
    from hilcal.effects.catalogue import installed as installed
    from hilcal.effects.check import check_effect as check_effect
    from hilcal.effects.protocol import Effect as Effect
    from hilcal.effects.protocol import effect as effect
    from hilcal.errors import CannotAnswerError as CannotAnswerError
    from hilcal.errors import DeviceError as DeviceError
    from hilcal.errors import HilcalError as HilcalError
    from hilcal.errors import InputError as InputError
    from hilcal.identification.carried.posterior import Posterior as Posterior
    from hilcal.identification.fit import Fit as Fit
    from hilcal.identification.registration.table_preview import preview_table as preview_table
    from hilcal.library import baseline as baseline
    from hilcal.library import bootstrap as bootstrap
    from hilcal.library import diagnose as diagnose
    from hilcal.library import fit as fit
    from hilcal.library import fit_stream as fit_stream
    from hilcal.library import import_campaign as import_campaign
    from hilcal.library import plan as plan
    from hilcal.library import read_table as read_table
    from hilcal.library import refine as refine
    from hilcal.library import simulate as simulate
    from hilcal.library import view as view
    from hilcal.model.model import Model as Model
    from hilcal.procedure.procedure import Procedure as Procedure
    from hilcal.readings.readings import Readings as Readings
    from hilcal.readings.readings import States as States
    from hilcal.refinement import Refinement as Refinement
    from hilcal.transfer.compare import compare as compare
    from hilcal.transfer.compare import validate as validate
    from hilcal.write_report import report as report


def __getattr__(name: str) -> object:
    """Import a name of the library when it is first used."""
    if name not in _PLACES:
        valid = ", ".join(sorted(_PLACES))
        raise AttributeError(f"module 'hilcal' has no attribute {name!r}; valid: {valid}")
    value = getattr(import_module(_PLACES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the names of the library."""
    return sorted(__all__)
