"""The state of a workbench, and what can be done at it; every number is one of the library.

One session serves all tabs. Its methods take seconds and are run one at a time (`work`). Each
change names the snapshot on which it was asked for: where the session has gone on since, by another
tab or a second click, it is refused and nothing is appended.
"""

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.campaign.campaign import Campaign
from hilcal.campaign.changes import Changed, add_effect, change_cell, refit, remove_effect
from hilcal.campaign.revisions import chain_in_cell
from hilcal.config.changes import Changes, read_value
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.distinguish import Difference, Recorded, distinguish, recorded_values
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.written import read_effects_text
from hilcal.errors import InputError
from hilcal.identification.full_prediction import full_prediction
from hilcal.names import quoted
from hilcal.present.registration import covariance_words
from hilcal.present.story import Chapter, DependenceCurve, build_story, regressor
from hilcal.procedure.next_plan import NextPlan, doubt_to_settle, next_plan
from hilcal.store.procedure_log import refuse_fitting
from hilcal.store.revision import RevisionRecord
from hilcal.types import Ints
from hilcal.workbench.snapshot import Snapshot, Stamp, figures_of, require_judged
from hilcal.write_report import Asked, write_report

Say = Callable[[str], None]


def silent(words: str) -> None:
    """Say nothing."""


class WorkbenchSession:
    """A campaign file at the workbench.

    Attributes:
        path: the file.
        snapshot: what is shown; None before `load`.
        changed: what the last change did; None before any, and after another revision was chosen.
        planned: the next measurements that were planned last, and their file.
        count: grows whenever another snapshot is shown.
    """

    def __init__(self, path: str | Path, catalogue: Catalogue | None = None) -> None:
        """Take a file; nothing is read yet."""
        self.path, self._catalogue = Path(path), catalogue
        self.snapshot: Snapshot | None = None
        self.changed: Changed | None = None
        self.planned: tuple[NextPlan, Path] | None = None
        self.count = 0
        self._known: dict[int, Chapter] = {}
        self._hash = ""

    def load(self, say: Say = silent, revision: int | None = None) -> Snapshot:
        """Read the file, judge a revision and those that it was made from, and show it.

        Nothing is written to the file, nor beside it.

        Args:
            say: takes progress, one line each.
            revision: its number; the one in use where None.

        Raises:
            InputError: no sound campaign, no such revision, or one that cannot be restored.
            CannotAnswerError: the readings do not determine the baseline.
        """
        stamp = self._stamp()
        with self._open(read_only=True) as o:
            self._forget_others(o)
            chapters = self._chapters(o, revision, say)
            record = o.in_use(revision)
            number = None if record is None else record.number
            snapshot = self._snapshot(o.at(cell_of(record)), number, chapters, stamp)
        return self._show(snapshot)

    def add(self, snapshot: Snapshot, effect: str, say: Say = silent) -> Snapshot:
        """Add an effect, written as for `hilcal add`, to the shown model; see `changes`.

        Raises:
            InputError: not one effect, one that cannot be added, or an outdated snapshot.
            CannotAnswerError: the readings do not determine it.
        """
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
        """Show a revision, and let every command use it; nothing is taken away.

        Raises:
            InputError: no such revision, one that cannot be restored, or an outdated snapshot.
        """
        with self._writing(snapshot) as o:
            chapters = self._chapters(o, number, say)
            o.accept(None if number == len(o.file.revisions()) else number)
            there = o.at(o.file.revision(number).cell)
            found = self._snapshot(there, number, chapters, self._stamp())
        return self._show(found)

    def fit_anew(self, snapshot: Snapshot | None, say: Say = silent) -> Snapshot:
        """Fit the model of the revision in use to all readings, those appended later included.

        A prior that the revision was fitted with is kept.

        Raises:
            InputError: no revision, or an outdated snapshot.
            CannotAnswerError: the readings do not determine it.
        """
        with self._writing(snapshot, changed=True) as o:
            record = o.in_use()
            if record is None:
                raise InputError(f"{o.path}: no revision yet")
            found = refit(o, record, say)
            number = self._store(o, found)
            if o.file.accepted() is not None:
                o.accept(None)  # it cannot be used any more
            snapshot = self._snapshot(o, number, (self._known[number],), self._stamp())
        return self._show(snapshot)

    def change_cell(
        self, snapshot: Snapshot, texts: Mapping[tuple[str, str], str], say: Say = silent
    ) -> Snapshot:
        """Fit the shown model in a changed cell, and show that revision; see `changes`.

        Args:
            snapshot: what is shown.
            texts: values by section and key, written as in CELL.toml; those that are shown change
                nothing, and an empty one leaves the key out.
            say: takes progress, one line each.

        Raises:
            InputError: nothing is changed, a value that is not valid, or an outdated snapshot.
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
            chapters = self._chapters(there, number, silent)
            return self._show(self._snapshot(there, number, chapters, self._stamp()))

    def document(self, snapshot: Snapshot, kind: str, say: Say = silent) -> tuple[str, bytes]:
        """Return name and content of a file about the shown revision.

        Args:
            snapshot: what is shown.
            kind: "report" (HTML), "calibration" (JSON), which keeps a baseline that is not kept,
                or "table" (the exchange table).
            say: takes progress, one line each.

        Raises:
            InputError: an outdated snapshot, or what cannot be written.
        """
        self._require(snapshot)
        stem, number = self.path.stem, snapshot.number
        with tempfile.TemporaryDirectory() as folder:
            if kind == "calibration" and number is None:
                with self._writing(snapshot) as o:
                    number = self._store(o, snapshot.diagnosis)
                    chapters = (self._known[number],)
                    self._show(self._snapshot(o, number, chapters, self._stamp()))
            with self._open(read_only=True) as opened:
                o = opened.at(snapshot.changes)
                if kind == "report":
                    path = Path(folder) / f"{stem}.html"
                    write_report(o, path, Asked(revision=number), say)
                elif kind == "calibration":
                    path = Path(folder) / f"{stem}-calibration.json"
                    o.calibration(number).save(path)
                else:
                    path = Path(folder) / f"{stem}-readings.csv"
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

        Args:
            snapshot: what is shown.
            poses: as many readings as so many poses take; what the doubt needs where None.
            output: the plan's file; it must not exist.
            say: takes progress, one line each.
            quick: without comparing criteria and numbers of poses, as `hilcal next` does.

        Raises:
            InputError: a file that cannot be written, or a plan that may not be run.
            CannotAnswerError: nothing is in doubt, or no measurement would settle it.
        """
        if output.exists():
            raise InputError(f"{output}: the file exists; choose another name")
        self._require(snapshot)
        with self._open(read_only=True) as opened:
            o = opened.at(snapshot.changes)
            doubt = doubt_to_settle(o, snapshot.diagnosis, say)
            rng = np.random.default_rng(0)
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
        found = recorded_values(snapshot.fit)
        return {v.name: replace(v, values=v.values[rows]) for v in found}

    def differences(self, snapshot: Snapshot, measurements: Ints) -> tuple[Difference, ...]:
        """Return what sets some measurements of the story apart, the clearest first."""
        picked = np.zeros(len(snapshot.fit.readings), dtype=bool)
        picked[full_prediction(snapshot.fit).whitening.reading[measurements]] = True
        return distinguish(snapshot.fit, picked)

    def _open(self, *, read_only: bool) -> Campaign:
        return Campaign.open(self.path, self._catalogue, read_only=read_only)

    def _writing(self, snapshot: Snapshot | None, *, changed: bool = False) -> Campaign:
        """Open the file for a change that was asked for on a snapshot.

        Args:
            snapshot: it.
            changed: whether another command may have changed the file since.

        Raises:
            InputError: the session, or the file, has gone on since.
        """
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
        record = o.in_use(revision)
        if record is None:
            refuse_fitting(o.file)
            if 0 not in self._known:
                _, found = o.fit_in_use(say)
                say("diagnosing the baseline")
                self._known[0] = Chapter(1, None, found, diagnose(found, say=say))
            return (self._known[0],)
        o = o.at(record.cell)
        out = [self._chapter(o, r, say) for r in chain_in_cell(o.file.revisions(), record.number)]
        require_judged(o, out[-1])
        return tuple(out)

    def _chapter(self, o: Campaign, record: RevisionRecord, say: Say) -> Chapter:
        number = record.number
        if number not in self._known:
            say(f"restoring revision {number}")
            found, judged = o.restore(record), None
            if found.scaling == "gc":
                say(f"diagnosing revision {number}")
                judged = diagnose(found, o.history(number), say)
            self._known[number] = Chapter(number, record.added, found, judged, record.removed)
        return self._known[number]

    def _forget_others(self, o: Campaign) -> None:
        """Forget what was fitted to other readings than the file has now."""
        stored = o.data_hash
        if stored != self._hash:
            self._known, self._hash = {}, stored

    def _store(self, o: Campaign, found: Diagnosis) -> int:
        number = o.append(found)
        self._known[number] = Chapter(number, None, found.fit, found)
        return number

    def _changed(self, o: Campaign, c: Changed) -> Snapshot:
        if c.before_number not in self._known:  # the baseline, kept now
            self._known[c.before_number] = self._known[0]
        self._known[c.number] = Chapter(c.number, c.added, c.fit, c.diagnosis, c.removed)
        chapters = self._chapters(o, c.number, silent)
        return self._show(self._snapshot(o, c.number, chapters, self._stamp()), c)

    def _snapshot(
        self, o: Campaign, number: int | None, chapters: tuple[Chapter, ...], stamp: Stamp
    ) -> Snapshot:
        return Snapshot(
            name=self.path.name,
            arm=o.cell.arm.name,
            n_readings=len(o.readings),
            records=o.file.revisions(),
            accepted=o.file.accepted(),
            number=number,
            chapters=chapters,
            story=build_story(chapters),
            stamp=stamp,
            source=o.file.source,
            covariance=covariance_words(o.covariance_parts, o.noise),
            changes=o.changes,
            figures=figures_of(o),
        )

    def _show(self, snapshot: Snapshot, changed: Changed | None = None) -> Snapshot:
        self.snapshot, self.changed = snapshot, changed
        self.count += 1
        return snapshot

    def _stamp(self) -> Stamp:
        """Return what tells whether the file was changed.

        Raises:
            InputError: it is not there.
        """
        try:
            found = self.path.stat()
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read ({error.strerror})") from None
        return found.st_size, found.st_mtime_ns, found.st_ino


def cell_of(record: RevisionRecord | None) -> Changes:
    """Return what was changed in the cell before a revision was fitted."""
    return {} if record is None else record.cell
