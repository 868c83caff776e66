"""Results in a notebook: what the terminal says of them, as HTML."""

from collections.abc import Iterable, Iterator
from functools import singledispatch

from hilcal.design.checked_plan import CheckedPlan
from hilcal.diagnosis.comparison import Comparison
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.discovery.discovery import Discovery
from hilcal.identification.bootstrap import Bootstrap
from hilcal.identification.fit import Fit
from hilcal.identification.validation import CampaignValidation
from hilcal.present.comparison import comparison_report
from hilcal.present.diagnosis import diagnosis_report, key, revisions_table, verdict_line
from hilcal.present.discovery import discovery_report
from hilcal.present.document import Block
from hilcal.present.fit import fit_report, stream_report
from hilcal.present.html.page import fragment
from hilcal.present.plan import plan_report
from hilcal.present.validation import bootstrap_report, opening, shares_report, validation_report
from hilcal.refinement import Refinement
from hilcal.store.revision import change
from hilcal.stream.fit import StreamFit


def html_of(value: object) -> str:
    """Return a result as a piece of HTML."""
    return fragment(blocks_of(value))


@singledispatch
def blocks_of(value: object) -> Iterable[Block]:
    """Return what is said of a result."""
    raise TypeError(f"nothing is said of a {type(value).__name__}")


blocks_of.register(Fit, lambda fit: fit_report(fit, details=False))
blocks_of.register(StreamFit, stream_report)
blocks_of.register(Diagnosis, diagnosis_report)
blocks_of.register(Discovery, discovery_report)
blocks_of.register(Bootstrap, bootstrap_report)
blocks_of.register(CheckedPlan, lambda plan: plan_report(plan.summary))
blocks_of.register(
    Comparison, lambda c: comparison_report(c, "the earlier campaign", "the later campaign")
)


@blocks_of.register
def _(tested: CampaignValidation) -> Iterator[Block]:
    yield from opening(tested.judged, tested.prediction)
    yield from validation_report(tested.judged, tested.prediction, tested.beyond)
    yield from shares_report(tested.shares)


@blocks_of.register
def _(path: Refinement) -> Iterator[Block]:
    rows = []
    for k, s in enumerate(path.steps, start=1):
        changed = change(s.added, s.removed, s.fit.readings.arm_scatter is not None)
        rows.append((k, changed, s.fit, s.diagnosis.verdict))
    yield from (revisions_table(rows), key(path.fit.readings), verdict_line(path.diagnosis))
