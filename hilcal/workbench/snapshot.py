"""What the workbench shows of a campaign: a frozen value, made anew after every change."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hilcal.campaign import Campaign
from hilcal.data.revision import RevisionRecord, change
from hilcal.diagnose.diagnosis import Diagnosis
from hilcal.identify.fit import Fit
from hilcal.report.build_story import Chapter
from hilcal.report.story import Story, StoryRevision

Stamp = tuple[int, int, int]
"""Size (bytes), time of the last change (ns) and inode of a file, by which a change is noticed."""


@dataclass(frozen=True, slots=True)
class RevisionRow:
    """A stored revision as it is listed.

    Attributes:
        number: of the revision.
        change: what it changed in the one that it was made from; empty for a first model.
        model: names of its effects.
        made_from: number of the revision that it was made from; None for a first model.
        verdict: on it; empty where it was not diagnosed when it was stored.
        fitted_m: rms of the 3-D position error on the fitted readings, m.
        left_out_m: the same on poses left out, m.
    """

    number: int
    change: str
    model: tuple[str, ...]
    made_from: int | None
    verdict: str
    fitted_m: float
    left_out_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A campaign with one of its revisions, and the way to it.

    Attributes:
        name: of the file.
        arm: name of the arm.
        n_readings: all readings.
        rows: all revisions, oldest first.
        accepted: the revision that every command uses; None where it is the latest.
        number: the revision that is shown; None for the baseline, which is not kept.
        chapters: the shown revision and those that it was made from, oldest first.
        story: the same as it is drawn.
        stamp: of the file as it was read.
    """

    name: str
    arm: str
    n_readings: int
    rows: tuple[RevisionRow, ...]
    accepted: int | None
    number: int | None
    chapters: tuple[Chapter, ...]
    story: Story
    stamp: Stamp

    @property
    def fit(self) -> Fit:
        """The fit that is shown."""
        return self.chapters[-1].fit

    @property
    def diagnosis(self) -> Diagnosis:
        """The judgement of it."""
        found = self.chapters[-1].diagnosis
        if found is None:
            raise ValueError("a snapshot without a diagnosis")
        return found

    @property
    def revision(self) -> StoryRevision:
        """The shown revision as it is drawn."""
        return self.story.revisions[-1]

    @property
    def in_use(self) -> int | None:
        """The revision that every command uses; None where there is none yet."""
        latest = self.rows[-1].number if self.rows else None
        return latest if self.accepted is None else self.accepted

    @property
    def removable(self) -> tuple[str, ...]:
        """Effects of the shown model that may be taken out: all but frames that are unknown."""
        frames = self.fit.model.catalogue.unknown_frames(self.fit.model.cell)
        return tuple(name for name in self.fit.model.named if name not in frames)


def row_of(record: RevisionRecord) -> RevisionRow:
    """Return how a stored revision is listed."""
    result: Mapping[str, Any] = record.result_json
    error = result["identify"]["error"]
    return RevisionRow(
        number=record.number,
        change=change(record.added, record.removed, record.scatter_alone),
        model=record.effects,
        made_from=record.made_from,
        verdict=str(result.get("diagnose", {}).get("verdict", "")),
        fitted_m=float(error["fit"]["rms_m"]),
        left_out_m=float(error["holdout"]["rms_m"]),
    )


def require_judged(o: Campaign, chapter: Chapter) -> None:
    """Refuse to show a revision that cannot be judged.

    Raises:
        InputError: it was fitted without the full covariance.
    """
    if chapter.diagnosis is None:
        o.require_gc(chapter.number, chapter.fit.scaling, "judging")
