"""Results of the library as HTML for notebooks and as pandas data frames."""

import io
from collections.abc import Iterable, Iterator
from functools import singledispatch
from typing import TYPE_CHECKING

from hilcal import numbers
from hilcal.calibration.compensation import Compensation
from hilcal.design.summary import CheckedPlan
from hilcal.diagnosis.comparison import Comparison
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.discovery.discovery import Discovery
from hilcal.identification.bootstrap import Bootstrap
from hilcal.identification.fit import Estimates, Fit
from hilcal.identification.prediction.full_prediction import residual_table
from hilcal.identification.prediction.validation import CampaignValidation
from hilcal.optional import needed_by
from hilcal.present import diagnosis
from hilcal.present.calibration import (
    bootstrap_report,
    fit_and_test_lines,
    shares_report,
    validation_report,
)
from hilcal.present.comparison import comparison_report
from hilcal.present.document import Block, heading, pairs, table
from hilcal.present.fit import PARAMETER_COLUMNS, fit_report, stream_report
from hilcal.present.plan import plan_report
from hilcal.present.story import chapters_of, errors_by_revision
from hilcal.readings.covariance import INSTRUMENT, INSTRUMENT_AND_ARM
from hilcal.readings.readings import Readings
from hilcal.refinement import Refinement
from hilcal.shown import texts_of
from hilcal.stream import StreamFit
from hilcal.tables.table import covers_with_rounding, exchange_columns
from hilcal.tables.write import plan_csv

if TYPE_CHECKING:
    import pandas as pd


def html_of(value: object) -> str:
    """Return the report of a result as a fragment of HTML."""
    from hilcal.present.html import fragment  # needs an extra

    return fragment(_blocks(value))


@singledispatch
def _blocks(value: object) -> Iterable[Block]:
    return heading(type(value).__name__), pairs(texts_of(value).items())


_blocks.register(Fit, lambda fit: fit_report(fit, details=False))
_blocks.register(StreamFit, stream_report)
_blocks.register(Diagnosis, diagnosis.diagnosis_report)
_blocks.register(Discovery, diagnosis.discovery_report)
_blocks.register(Bootstrap, bootstrap_report)
_blocks.register(CheckedPlan, lambda plan: plan_report(plan.summary))
_blocks.register(
    Comparison, lambda c: comparison_report(c, "the earlier campaign", "the later campaign")
)


@_blocks.register
def _(tested: CampaignValidation) -> Iterator[Block]:
    yield from fit_and_test_lines(tested.judged, tested.prediction)
    yield from validation_report(tested.judged, tested.prediction, tested.beyond)
    yield from shares_report(tested.shares)


@_blocks.register
def _(estimates: Estimates) -> Iterator[Block]:
    out = table(*PARAMETER_COLUMNS[:-1], left=(0, 3), caption="parameters")
    for e in estimates:
        shown = "not determined", "", e.unit
        if e.value is not None and e.std is not None:
            shown = numbers.measured(e.unit, e.value, e.std)
        out.add(e.name, *shown)
    yield out


@_blocks.register
def _(path: Refinement) -> Iterator[Block]:
    yield from errors_by_revision(chapters_of(range(1, len(path.steps) + 1), path.steps))
    yield diagnosis.verdict_line(path.diagnosis)


def frame_of(value: object) -> "pd.DataFrame":
    """Return a result as a data frame; MissingPackageError without pandas."""
    with needed_by("to_frame"):
        import pandas as pd

    if isinstance(value, CheckedPlan):
        frame = pd.read_csv(io.StringIO(plan_csv(value.plan)), dtype=str, na_filter=False)
        return frame.astype({name: float for name in frame if name not in ("pose", "load")})
    if isinstance(value, Readings):
        with_arm = value.scatter_stated or value.arm_scatter is not None
        covers = covers_with_rounding(INSTRUMENT_AND_ARM if with_arm else INSTRUMENT, value)
        return pd.DataFrame(exchange_columns(value, covers))
    if isinstance(value, Fit):
        return pd.DataFrame(residual_table(value))
    if isinstance(value, Compensation):
        frame = pd.DataFrame(value.to_dict()["points"])
        frame = frame.drop(columns=["q_command", "q_corrected", "q_rad", "refused"])
        for j, unit in enumerate(value.units):
            frame[f"q{j + 1}_{unit}"] = value.q[:, j]
        return frame
    if isinstance(value, Diagnosis):
        return pd.DataFrame(value.to_dict()["suspects"])
    raise TypeError(f"no rows for a {type(value).__name__}")
