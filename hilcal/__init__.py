"""hilcal: calibration of the elastic and geometric errors of a robot arm.

    import hilcal as hc

    with hc.Campaign.open("run.hilcal") as run:
        model = hc.baseline(run.cell, run.readings)
        found = hc.fit(model, run.readings)
        print(found.summary())
        print(hc.diagnose(found).verdict)

Every name is imported when it is first used, so that `import hilcal` costs nothing.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

__version__ = "0.1.0"

_PLACES = {
    "Calibration": "hilcal.calibration.calibration",
    "Campaign": "hilcal.campaign",
    "CannotAnswerError": "hilcal.errors",
    "Catalogue": "hilcal.effects.catalogue",
    "Cell": "hilcal.cell",
    "Comparison": "hilcal.diagnose.comparison",
    "DeviceError": "hilcal.errors",
    "Diagnosis": "hilcal.diagnose.diagnosis",
    "Effect": "hilcal.effects.protocol",
    "Fit": "hilcal.identify.fit",
    "HilcalError": "hilcal.errors",
    "InputError": "hilcal.errors",
    "Model": "hilcal.model",
    "Posterior": "hilcal.identify.posterior",
    "Procedure": "hilcal.procedure.procedure",
    "Readings": "hilcal.data.readings",
    "Refinement": "hilcal.refine",
    "States": "hilcal.data.readings",
    "baseline": "hilcal.library",
    "bootstrap": "hilcal.library",
    "check_effect": "hilcal.effects.check",
    "compare": "hilcal.compare",
    "diagnose": "hilcal.diagnose.verdict",
    "discover": "hilcal.discover.discovery",
    "effect": "hilcal.effects.spec",
    "fit": "hilcal.library",
    "fit_stream": "hilcal.library",
    "installed": "hilcal.effects.catalogue",
    "load_posterior": "hilcal.library",
    "plan": "hilcal.library",
    "preview_table": "hilcal.identify.table_preview",
    "read_table": "hilcal.library",
    "refine": "hilcal.library",
    "report": "hilcal.write_report",
    "validate": "hilcal.validate",
    "view": "hilcal.library",
}

__all__ = ["__version__", *_PLACES]

if TYPE_CHECKING:
    from hilcal.calibration.calibration import Calibration
    from hilcal.campaign import Campaign
    from hilcal.cell import Cell
    from hilcal.compare import compare
    from hilcal.data.readings import Readings, States
    from hilcal.diagnose.comparison import Comparison
    from hilcal.diagnose.diagnosis import Diagnosis
    from hilcal.diagnose.verdict import diagnose
    from hilcal.discover.discovery import discover
    from hilcal.effects.catalogue import Catalogue, installed
    from hilcal.effects.check import check_effect
    from hilcal.effects.protocol import Effect
    from hilcal.effects.spec import effect
    from hilcal.errors import CannotAnswerError, DeviceError, HilcalError, InputError
    from hilcal.identify.fit import Fit
    from hilcal.identify.posterior import Posterior
    from hilcal.identify.table_preview import preview_table
    from hilcal.library import (
        baseline,
        bootstrap,
        fit,
        fit_stream,
        load_posterior,
        plan,
        read_table,
        refine,
        view,
    )
    from hilcal.model import Model
    from hilcal.procedure.procedure import Procedure
    from hilcal.refine import Refinement
    from hilcal.validate import validate
    from hilcal.write_report import report


def __getattr__(name: str) -> object:
    """Import a name of the library when it is first used."""
    if name not in _PLACES:
        raise AttributeError(f"module 'hilcal' has no attribute {name!r}")
    found = getattr(import_module(_PLACES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """Return the names of the library."""
    return sorted(__all__)


class _Library(ModuleType):
    """A module where `diagnose`, `discover`, `plan`, `refine`, `report` are functions.

    They are subpackages as well. Importing one sets it as an attribute of its parent; here names of
    the library keep their meaning. Modules are imported by `from hilcal.plan import planner`;
    `import hilcal.plan.planner as planner` would look the attribute up, and find the function.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if name not in _PLACES or not isinstance(value, ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Library
