"""What the workbench shows of a campaign: a frozen value, made anew after every change."""

from dataclasses import dataclass

from hilcal.campaign.campaign import Campaign
from hilcal.config import Target
from hilcal.config.changes import CHANGEABLE, INSTRUMENT_NOISE, Changes, described, write_value
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.identification.fit import Fit
from hilcal.present.story import Chapter, Story, StoryRevision
from hilcal.store.revision import RevisionRecord

Stamp = tuple[int, int, int]
"""Size (bytes), time of the last change (ns) and inode of a file, by which a change is noticed."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A value of the cell that can be changed.

    Attributes:
        section: of CELL.toml.
        key: in it.
        text: the value as CELL.toml has it; empty where it is not given, or was estimated.
        valid: what is valid, in words.
        fixed: why these readings do not let it change; empty where they do.
    """

    section: str
    key: str
    text: str
    valid: str
    fixed: str


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A campaign with one of its revisions, and the way to it.

    Attributes:
        name: of the file.
        arm: name of the arm.
        n_readings: all readings.
        records: all revisions, oldest first.
        accepted: the revision that every command uses; None where it is the latest.
        number: the revision that is shown; None for the baseline, which is not kept.
        chapters: the shown revision and those that it was made from, oldest first.
        story: the same as it is drawn.
        stamp: of the file as it was read.
        source: where the readings come from.
        covariance: what their covariance consists of, in words.
        changes: what was changed in the cell since they were taken.
        figures: of the cell as it is for the shown revision.
    """

    name: str
    arm: str
    n_readings: int
    records: tuple[RevisionRecord, ...]
    accepted: int | None
    number: int | None
    chapters: tuple[Chapter, ...]
    story: Story
    stamp: Stamp
    source: str
    covariance: str
    changes: Changes
    figures: tuple[Figure, ...]

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
        latest = self.records[-1].number if self.records else None
        return latest if self.accepted is None else self.accepted

    @property
    def removable(self) -> tuple[str, ...]:
        """Effects of the shown model that may be taken out: all but frames that are unknown."""
        frames = self.fit.model.catalogue.unknown_frames(self.fit.model.cell)
        return tuple(name for name in self.fit.model.named if name not in frames)


def figures_of(o: Campaign) -> tuple[Figure, ...]:
    """Return what can be changed in the cell of a campaign."""
    together = {"tracker": dict.fromkeys(INSTRUMENT_NOISE)}  # what needs a stated noise is shown
    fixed, found = o.unchangeable(together), []
    for section, keys in CHANGEABLE.items():
        of = getattr(o.config, section)
        for key in keys:
            value = getattr(of, key)
            if isinstance(value, tuple) and value and isinstance(value[0], Target):
                value = [target.model_dump(exclude_none=True) for target in value]
            elif key == "targets" or (o.config.tool.targets and key.startswith("target_")):
                continue  # the tool has one target, or several
            estimated = o.noise is not None and key in INSTRUMENT_NOISE
            shown = "" if value is None or estimated else write_value(value)
            valid = described(section, key)
            found.append(Figure(section, key, shown, valid, fixed.get((section, key), "")))
    return tuple(found)


def require_judged(o: Campaign, chapter: Chapter) -> None:
    """Refuse to show a revision that cannot be judged.

    Raises:
        InputError: it was fitted without the full covariance.
    """
    if chapter.diagnosis is None:
        o.require_gc(chapter.number, chapter.fit.scaling, "judging")
