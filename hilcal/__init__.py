"""hilcal: calibration of the elastic and geometric errors of a robot arm.

    import hilcal as hc

    with hc.Campaign("run.hilcal") as run:
        fit = hc.fit(hc.baseline(run), run)
        print(fit.summary())
        print(hc.diagnose(fit).verdict)

Every name is imported when it is first used, so that `import hilcal` costs nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, cast

from hilcal.shown import Presenter

__version__ = "1.0.0"

_PLACES = {
    "Calibration": "hilcal.calibration.calibration",
    "Campaign": "hilcal.campaign.campaign",
    "CannotAnswerError": "hilcal.errors",
    "Catalogue": "hilcal.effects.catalogue",
    "Cell": "hilcal.cell",
    "Comparison": "hilcal.diagnosis.comparison",
    "DeviceError": "hilcal.errors",
    "Diagnosis": "hilcal.diagnosis.diagnosis",
    "Effect": "hilcal.effects.protocol",
    "Fit": "hilcal.identification.fit",
    "HilcalError": "hilcal.errors",
    "InputError": "hilcal.errors",
    "Model": "hilcal.model.model",
    "Posterior": "hilcal.identification.posterior",
    "Procedure": "hilcal.procedure.procedure",
    "Readings": "hilcal.readings.readings",
    "Refinement": "hilcal.refinement",
    "States": "hilcal.readings.readings",
    "baseline": "hilcal.library",
    "bootstrap": "hilcal.library",
    "check_effect": "hilcal.effects.check",
    "compare": "hilcal.transfer.compare",
    "diagnose": "hilcal.library",
    "discover": "hilcal.discovery.discovery",
    "effect": "hilcal.effects.spec",
    "fit": "hilcal.library",
    "fit_stream": "hilcal.library",
    "installed": "hilcal.effects.catalogue",
    "load_posterior": "hilcal.library",
    "plan": "hilcal.library",
    "preview_table": "hilcal.identification.table_preview",
    "read_table": "hilcal.library",
    "refine": "hilcal.library",
    "report": "hilcal.write_report",
    "simulate": "hilcal.library",
    "validate": "hilcal.transfer.compare",
    "view": "hilcal.library",
}

__all__ = ["__version__", *_PLACES]

if TYPE_CHECKING:
    from hilcal.calibration.calibration import Calibration as Calibration
    from hilcal.campaign.campaign import Campaign as Campaign
    from hilcal.cell import Cell as Cell
    from hilcal.diagnosis.comparison import Comparison as Comparison
    from hilcal.diagnosis.diagnosis import Diagnosis as Diagnosis
    from hilcal.discovery.discovery import discover as discover
    from hilcal.effects.catalogue import Catalogue as Catalogue
    from hilcal.effects.catalogue import installed as installed
    from hilcal.effects.check import check_effect as check_effect
    from hilcal.effects.protocol import Effect as Effect
    from hilcal.effects.spec import effect as effect
    from hilcal.errors import CannotAnswerError as CannotAnswerError
    from hilcal.errors import DeviceError as DeviceError
    from hilcal.errors import HilcalError as HilcalError
    from hilcal.errors import InputError as InputError
    from hilcal.identification.fit import Fit as Fit
    from hilcal.identification.posterior import Posterior as Posterior
    from hilcal.identification.table_preview import preview_table as preview_table
    from hilcal.library import baseline as baseline
    from hilcal.library import bootstrap as bootstrap
    from hilcal.library import diagnose as diagnose
    from hilcal.library import fit as fit
    from hilcal.library import fit_stream as fit_stream
    from hilcal.library import load_posterior as load_posterior
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
        raise AttributeError(f"module 'hilcal' has no attribute {name!r}")
    value = getattr(import_module(_PLACES[name]), name)
    globals()[name] = value
    return value


def presenter() -> Presenter:
    """Return the presenter of values, see `shown.Presenter`."""
    return cast(Presenter, import_module("hilcal.present"))


def __dir__() -> list[str]:
    """Return the names of the library."""
    return sorted(__all__)
