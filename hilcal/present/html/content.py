"""What a report is made of: values of the library, none of them computed by the report itself."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.identification.acceptance import CampaignValidation
from hilcal.identification.fit import Fit
from hilcal.identification.full_covariance import CovarianceParts
from hilcal.present.story import Chapter, Story, StoryRevision
from hilcal.readings.whitening import Scaling
from hilcal.store.overview import Overview
from hilcal.store.plan import Plan


@dataclass(frozen=True, slots=True, eq=False)
class Tested:
    """A model against readings of another campaign.

    Attributes:
        name: of the campaign's file.
        sha256: of that file.
        found: errors of its readings, what the fit states of them, and the limit.
    """

    name: str
    sha256: str
    found: CampaignValidation


@dataclass(frozen=True, slots=True, eq=False)
class ReportContent:
    """Everything that a report says.

    Attributes:
        name: of the campaign's file.
        sha256: of that file.
        made: when the report was made, ISO 8601, UTC.
        version: of the program.
        overview: what the campaign holds.
        covariance: what the covariances consist of.
        chapters: the revisions, oldest first; the last is what the report is about.
        stored: whether they are in the file; else the baseline was fitted for the report alone.
        story: of the same revisions.
        left_out: the last of them with the errors of poses left out.
        scalings: the last model fitted with each scaling; empty without an appendix.
        plan: what was planned; None where nothing was.
        tested: on readings that were never fitted; None without a validation campaign.
        corrected: error at uncorrected and at corrected joint targets, as `calibrate` measured it
            with this revision and the file keeps it: a document of `Improvement`; None without.
        limit_m: the largest 3-D position error that is allowed, m; None without a limit.
        operator: who answers for the measurement; empty where nobody is named.
        commands: that lead to the same result.
        appendix: whether the page has one.
    """

    name: str
    sha256: str
    made: str
    version: str
    overview: Overview
    covariance: CovarianceParts
    chapters: tuple[Chapter, ...]
    stored: bool
    story: Story
    left_out: StoryRevision
    scalings: Mapping[Scaling, Fit]
    plan: Plan | None
    tested: Tested | None
    corrected: Mapping[str, Any] | None
    limit_m: float | None
    operator: str
    commands: tuple[str, ...]
    appendix: bool

    @property
    def fit(self) -> Fit:
        """The fit that the report is about."""
        return self.chapters[-1].fit

    @property
    def diagnosis(self) -> Diagnosis | None:
        """Its diagnosis; None where it is not scaled by gc."""
        return self.chapters[-1].diagnosis
