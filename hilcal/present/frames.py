"""Results as pandas data frames: the columns that tables of files have."""

import csv
import io
from functools import singledispatch
from typing import TYPE_CHECKING

from hilcal.design.checked_plan import CheckedPlan
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.identification.fit import Fit
from hilcal.identification.full_prediction import residual_table
from hilcal.optional import needed_by
from hilcal.readings.readings import Readings
from hilcal.tables.table import exchange_columns
from hilcal.tables.write import plan_csv

if TYPE_CHECKING:
    import pandas as pd


def frame_of(value: object) -> "pd.DataFrame":
    """Return a result as a data frame.

    Raises:
        MissingPackageError: pandas is not installed.
    """
    with needed_by("to_frame"):
        import pandas as pd

    return pd.DataFrame(_columns(value))


@singledispatch
def _columns(value: object) -> object:
    raise TypeError(f"no rows for a {type(value).__name__}")


_columns.register(Readings, exchange_columns)
_columns.register(Fit, residual_table)


@_columns.register
def _(plan: CheckedPlan) -> object:
    head, *rows = csv.reader(io.StringIO(plan_csv(plan.plan)))
    words = ("pose", "load")
    return [
        {k: v if k in words else float(v) for k, v in zip(head, row, strict=True)} for row in rows
    ]


@_columns.register
def _(d: Diagnosis) -> object:
    rows = d.to_dict()["suspects"]
    assert isinstance(rows, list)  # noqa: S101 - so the contract says
    return rows
