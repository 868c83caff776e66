"""The state of a workbench, and what can be done at it; every number is one of the library.

One session serves all tabs. Its methods take seconds and are run one at a time (`work`). Each
change names the snapshot on which it was asked for: where the session has gone on since, by another
tab or a second click, it is refused and nothing is appended.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.campaign.campaign import Campaign
from hilcal.campaign.changes import Changed, add_effect, change_cell, refit, remove_effect
from hilcal.campaign.revisions import chain_in_cell
from hilcal.config import Target
from hilcal.config.changes import (
    CHANGEABLE,
    INSTRUMENT_NOISE,
    Changes,
    described,
    read_value,
    write_value,
)
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.distinguish import Difference, Recorded, distinguish, recorded_values
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.written import read_effects_text
from hilcal.errors import InputError
from hilcal.identification.fit import Fit
from hilcal.identification.full_prediction import full_prediction
from hilcal.names import quoted
from hilcal.present.registration import covariance_words
from hilcal.present.story import (
    Chapter,
    DependenceCurve,
    Story,
    StoryRevision,
    build_story,
    regressor,
)
from hilcal.procedure.next_plan import NextPlan, doubt_to_settle, next_plan
from hilcal.store.procedure_log import refuse_fitting
from hilcal.store.revision import RevisionRecord
from hilcal.types import Ints
from hilcal.workbench.work import Say
from hilcal.write_report import Asked, write_report

Stamp = tuple[int, int, int]
"""Size (bytes), time of the last change (ns) and inode of a file, by which a change is noticed."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A value of the cell that can be changed."""

    section: str  # of CELL.toml
    key: str
    text: str  # as CELL.toml has it; empty where it is not given, or was estimated
    valid: str  # what is valid, in words
    fixed: str  # why these readings do not let it change; empty where they do


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A campaign with one of its revisions, and the way to it; made anew after every change."""

    name: str  # of the file
    arm: str
    n_readings: int  # all of them
    records: tuple[RevisionRecord, ...]  # all revisions, oldest first
    accepted: int | None  # the revision that every command uses; None where it is the latest
    number: int | None  # the revision that is shown; None for the baseline, which is not kept
    chapters: tuple[Chapter, ...]  # the shown revision and those before it, oldest first
    story: Story  # the same as it is drawn
    stamp: Stamp  # of the file as it was read
    source: str  # where the readings come from
    covariance: str  # what their covariance consists of, in words
    changes: Changes  # of the cell since they were taken
    figures: tuple[Figure, ...]  # of the cell as it is for the shown revision

    @property
    def fit(self) -> Fit:
        """The fit that is shown."""
        return self.chapters[-1].fit

    @property
    def diagnosis(self) -> Diagnosis:
        """The judgement of it."""
        judged = self.chapters[-1].diagnosis
        if judged is None:
            raise ValueError("a snapshot without a diagnosis")
        return judged

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


def _figures(o: Campaign) -> tuple[Figure, ...]:
    """Return what can be changed in the cell of a campaign."""
    together = {"tracker": dict.fromkeys(INSTRUMENT_NOISE)}  # what needs a stated noise is shown
    fixed, out = o.unchangeable(together), []
    for section, keys in CHANGEABLE.items():
        of = getattr(o.config, section)
        for key in keys:
            value = getattr(of, key)
            if isinstance(value, tuple) and value and isinstance(value[0], Target):
                value = [target.model_dump(exclude_none=True) for target in value]
            elif key == "targets" or (o.config.tool.targets and key.startswith("target_")):
                continue  # the tool has one target, or several
            estimated = o.noise is not None and key in INSTRUMENT_NOISE
            text = "" if value is None or estimated else write_value(value)
            why = fixed.get((section, key), "")
            out.append(Figure(section, key, text, described(section, key), why))
    return tuple(out)


def silent(words: str) -> None:
    """Say nothing."""


class WorkbenchSession:
    """A campaign file at the workbench.

    Every method that takes a snapshot raises InputError where that is outdated; `say` takes
    progress, one line each.
    """

    def __init__(self, path: str | Path, catalogue: Catalogue | None = None) -> None:
        """Take a file; nothing is read yet."""
        self.path, self._catalogue = Path(path), catalogue
        self.snapshot: Snapshot | None = None  # what is shown; None before `load`
        self.changed: Changed | None = None  # by the last change; None where another was chosen
        self.planned: tuple[NextPlan, Path] | None = None  # the last plan, and its file
        self.count = 0  # of the snapshots that were shown
        self._known: dict[int, Chapter] = {}
        self._hash = ""

    def load(self, say: Say = silent, revision: int | None = None) -> Snapshot:
        """Read the file, judge a revision and those that it was made from, and show it.

        Nothing is written to the file, nor beside it. `revision` is the one in use where None.

        Raises:
            InputError: no sound campaign, no such revision, or one that cannot be restored.
            CannotAnswerError: the readings do not determine the baseline.
        """
        stamp = self._stamp()
        with self._open(read_only=True) as o:
            self._forget_others(o)
            chapters, record = self._chapters(o, revision, say), o.in_use(revision)
            if record is None:
                return self._show(o.at({}), None, chapters, stamp=stamp)
            return self._show(o.at(record.cell), record.number, chapters, stamp=stamp)

    def add(self, snapshot: Snapshot, effect: str, say: Say = silent) -> Snapshot:
        """Add an effect, written as for `hilcal add`, to the shown model; see `changes`."""
        with self._writing(snapshot) as o:
            wanted = read_effects_text(effect, "effect", o.catalogue)
            if len(wanted) != 1:
                raise InputError(f"effect {effect!r} has {len(wanted)} effects; valid: one")
            ((name, options),) = wanted.items()
            o.catalogue.make(name, o.cell, o.readings.states, options).prior_std()
            of = snapshot.number, snapshot.fit
            return self._changed(o, add_effect(o, *of, name, options, say, snapshot.diagnosis))

    def remove(self, snapshot: Snapshot, effect: str, say: Say = silent) -> Snapshot:
        """Take an effect out of the shown model; raises as `add`."""
        with self._writing(snapshot) as o:
            of = snapshot.number, snapshot.fit
            return self._changed(o, remove_effect(o, *of, effect, say, snapshot.diagnosis))

    def go_back(self, snapshot: Snapshot, number: int, say: Say = silent) -> Snapshot:
        """Show a revision, and let every command use it; nothing is taken away."""
        with self._writing(snapshot) as o:
            chapters = self._chapters(o, number, say)
            o.accept(None if number == len(o.file.revisions()) else number)
            return self._show(o.at(o.file.revision(number).cell), number, chapters)

    def fit_anew(self, snapshot: Snapshot | None, say: Say = silent) -> Snapshot:
        """Fit the model and prior of the revision in use to all readings, also later ones."""
        with self._writing(snapshot, changed=True) as o:
            record = o.in_use()
            if record is None:
                raise InputError(f"{o.path}: no revision yet")
            number = self._store(o, refit(o, record, say))
            if o.file.accepted() is not None:
                o.accept(None)  # it cannot be used any more
            return self._show(o, number, (self._known[number],))

    def change_cell(
        self, snapshot: Snapshot, texts: Mapping[tuple[str, str], str], say: Say = silent
    ) -> Snapshot:
        """Fit the shown model in a changed cell, and show that revision; see `changes`.

        `texts` are values by section and key, written as in CELL.toml; those that are shown change
        nothing, and an empty one leaves the key out.

        Raises:
            InputError: nothing is changed, or a value that is not valid.
            CannotAnswerError: the readings do not determine the model.
        """
        changes: dict[str, dict[str, Any]] = {}
        for f in snapshot.figures:
            text = texts.get((f.section, f.key), f.text)
            if text.strip() != f.text:
                changes.setdefault(f.section, {})[f.key] = read_value(f.section, f.key, text)
        if not changes:
            raise InputError("no value differs from what is used already; nothing was fitted")
        with self._writing(snapshot) as o:
            of = snapshot.number, snapshot.fit
            there, number, found = change_cell(o, *of, changes, say, snapshot.diagnosis)
            self._known[number] = Chapter(number, None, found.fit, found)
            return self._show(there, number, self._chapters(there, number, silent))

    def document(self, snapshot: Snapshot, kind: str, say: Say = silent) -> tuple[str, bytes]:
        """Return name and content of a file about the shown revision.

        `kind` is "report" (HTML), "calibration" (JSON), which keeps a baseline that is not kept,
        or "table" (the exchange table).
        """
        self._require(snapshot)
        number = snapshot.number
        if kind == "calibration" and number is None:
            with self._writing(snapshot) as o:
                number = self._store(o, snapshot.diagnosis)
                self._show(o, number, (self._known[number],))
        ends = {"report": ".html", "calibration": "-calibration.json", "table": "-readings.csv"}
        with tempfile.TemporaryDirectory() as folder, self._open(read_only=True) as opened:
            o, path = opened.at(snapshot.changes), Path(folder) / f"{self.path.stem}{ends[kind]}"
            if kind == "report":
                write_report(o, path, Asked(revision=number), say)
            elif kind == "calibration":
                o.calibration(number).save(path)
            else:
                o.save_table(path)
            return path.name, path.read_bytes()

    def plan(
        self,
        snapshot: Snapshot,
        poses: int | None,
        output: Path,
        say: Say = silent,
        *,
        quick: bool = True,
    ) -> NextPlan:
        """Plan the measurements that settle what the shown diagnosis leaves open, and save them.

        `poses` is what the doubt needs where None; `quick` compares no criteria, nor numbers of
        poses, as `hilcal next` does.

        Raises:
            InputError: a file that exists or cannot be written, or a plan that may not be run.
            CannotAnswerError: nothing is in doubt, or no measurement would settle it.
        """
        if output.exists():
            raise InputError(f"{output}: the file exists; choose another name")
        self._require(snapshot)
        with self._open(read_only=True) as opened:
            o = opened.at(snapshot.changes)
            doubt, rng = doubt_to_settle(o, snapshot.diagnosis, say), np.random.default_rng(0)
            found = next_plan(o, doubt, poses, rng, say, compare=not quick)
        found.made.save(output)
        self.planned = found, output
        return found

    def run_line(self) -> str:
        """Return the command that measures the plan into the same campaign."""
        if self.planned is None:
            return ""
        return (
            f"hilcal run CELL.toml -o {quoted(self.path)} --append --plan {quoted(self.planned[1])}"
        )

    @property
    def stale(self) -> bool:
        """Whether another command has changed the file since it was read."""
        try:
            return self.snapshot is not None and self._stamp() != self.snapshot.stamp
        except InputError:
            return True

    def evidence(self, snapshot: Snapshot, effect: str) -> DependenceCurve | None:
        """Return residual and regressor of a suspect, for its added-variable plot."""
        found = next((s for s in snapshot.diagnosis.suspects if s.effect == effect), None)
        return None if found is None else regressor(snapshot.fit, found)

    def recorded(self, snapshot: Snapshot) -> dict[str, Recorded]:
        """Return what was recorded of each measurement of the story (D,), by name."""
        rows = full_prediction(snapshot.fit).whitening.reading
        return {v.name: replace(v, values=v.values[rows]) for v in recorded_values(snapshot.fit)}

    def differences(self, snapshot: Snapshot, measurements: Ints) -> tuple[Difference, ...]:
        """Return what sets some measurements of the story apart, the clearest first."""
        picked = np.zeros(len(snapshot.fit.readings), dtype=bool)
        picked[full_prediction(snapshot.fit).whitening.reading[measurements]] = True
        return distinguish(snapshot.fit, picked)

    def _open(self, *, read_only: bool) -> Campaign:
        return Campaign.open(self.path, self._catalogue, read_only=read_only)

    def _writing(self, snapshot: Snapshot | None, *, changed: bool = False) -> Campaign:
        """Open the file for a change; `changed`: another command may have changed it since."""
        self._require(snapshot, changed=changed)
        o = self._open(read_only=False)
        try:
            refuse_fitting(o.file)
            self._forget_others(o)
            return o if changed or snapshot is None else o.at(snapshot.changes)
        except BaseException:
            o.close()
            raise

    def _require(self, snapshot: Snapshot | None, *, changed: bool = False) -> None:
        if snapshot is not self.snapshot:
            raise InputError("the workbench has gone on since that click; nothing was changed")
        if self.stale and not changed:
            raise InputError(
                f"{self.path.name} was changed by another command; read it again first"
            )

    def _chapters(self, o: Campaign, revision: int | None, say: Say) -> tuple[Chapter, ...]:
        """Return a revision and those that it was made from; they are judged where not known."""
        record, numbers = o.in_use(revision), [0]
        if record is None:
            refuse_fitting(o.file)
        else:
            o = o.at(record.cell)
            numbers = [r.number for r in chain_in_cell(o.file.revisions(), record.number)]
        if not self._known.keys() >= set(numbers):
            self._known |= zip(numbers, o.chapters(say, revision), strict=True)
        out = tuple(self._known[number] for number in numbers)
        if out[-1].diagnosis is None:
            o.require_gc(out[-1].number, out[-1].fit.scaling, "judging")
        return out

    def _forget_others(self, o: Campaign) -> None:
        """Forget what was fitted to other readings than the file has now."""
        if (stored := o.data_hash) != self._hash:
            self._known, self._hash = {}, stored

    def _store(self, o: Campaign, found: Diagnosis) -> int:
        number = o.append(found)
        self._known[number] = Chapter(number, None, found.fit, found)
        return number

    def _changed(self, o: Campaign, c: Changed) -> Snapshot:
        if c.before_number not in self._known:  # the baseline, kept now
            self._known[c.before_number] = self._known[0]
        self._known[c.number] = Chapter(c.number, c.added, c.fit, c.diagnosis, c.removed)
        return self._show(o, c.number, self._chapters(o, c.number, silent), changed=c)

    def _show(
        self,
        o: Campaign,
        number: int | None,
        chapters: tuple[Chapter, ...],
        *,
        stamp: Stamp | None = None,
        changed: Changed | None = None,
    ) -> Snapshot:
        """Show a revision of a file that is as it is now, or as it was at a stamp."""
        self.snapshot = Snapshot(
            name=self.path.name,
            arm=o.cell.arm.name,
            n_readings=len(o.readings),
            records=o.file.revisions(),
            accepted=o.file.accepted(),
            number=number,
            chapters=chapters,
            story=build_story(chapters),
            stamp=stamp or self._stamp(),
            source=o.file.source,
            covariance=covariance_words(o.covariance_parts, o.noise),
            changes=o.changes,
            figures=_figures(o),
        )
        self.changed = changed
        self.count += 1
        return self.snapshot

    def _stamp(self) -> Stamp:
        """Return what tells whether the file was changed; InputError where it is not there."""
        try:
            found = self.path.stat()
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read ({error.strerror})") from None
        return found.st_size, found.st_mtime_ns, found.st_ino
