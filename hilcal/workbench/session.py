"""State and actions of a workbench; all computations are those of the library.

One session serves all tabs. Its methods take seconds, and `Work` runs one at a time. Each change
names the snapshot that it is based on. If the session has a newer snapshot, by another tab or a
second click, the change is refused and nothing is appended.
"""

import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.campaign.campaign import Campaign
from hilcal.campaign.changes import StoredChange, add_effect, change_cell, refit, remove_effect
from hilcal.campaign.revisions import chain_in_cell
from hilcal.config import Target
from hilcal.config.cell import (
    CHANGEABLE,
    INSTRUMENT_NOISE,
    Changes,
    described,
    read_value,
    write_value,
)
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.recorded import Difference, StateVariable, distinguish, recorded_values
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.protocol import failure_of
from hilcal.effects.written import read_effects_text
from hilcal.errors import HilcalError, InputError
from hilcal.identification.fit import Fit
from hilcal.identification.prediction.full_prediction import full_prediction
from hilcal.present.progress import Say
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
from hilcal.workbench.viewer import WebViewer
from hilcal.write_report import ReportOptions, write_report

Stamp = tuple[int, int, int]
"""Size (bytes), time of the last change (ns) and inode of a file, to detect changes."""
OUTDATED: Stamp = (0, 0, 0)  # the stamp of no file


@dataclass(frozen=True, slots=True)
class CellKey:
    """A value of the cell that can be changed."""

    section: str  # of CELL.toml
    key: str
    text: str  # in the syntax of CELL.toml; empty if not stated, or if estimated
    valid: str  # description of the valid values
    why_fixed: str  # why these readings forbid a change; empty if they allow it


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """A campaign with the shown revision and its predecessors; created after every change."""

    n_readings: int  # including those set aside
    records: tuple[RevisionRecord, ...]  # all revisions, oldest first
    accepted: int | None  # the revision that every command uses; None: the latest
    number: int | None  # the shown revision; None for the baseline, which is not stored
    chapters: tuple[Chapter, ...]  # the shown revision and its predecessors, oldest first
    story: Story  # of the same revisions
    stamp: Stamp  # of the file when it was read
    source: str  # of the readings
    covariance: str  # description of the contents of their covariance
    changes: Changes  # of the cell since the measurement
    cell_keys: tuple[CellKey, ...]  # of the cell of the shown revision

    @property
    def fit(self) -> Fit:
        """The fit of the shown revision."""
        return self.chapters[-1].fit

    @property
    def diagnosis(self) -> Diagnosis:
        """The diagnosis of the shown revision."""
        if (judged := self.chapters[-1].diagnosis) is None:
            raise ValueError("a snapshot without a diagnosis")
        return judged

    @property
    def revision(self) -> StoryRevision:
        """The shown revision of the story."""
        return self.story.revisions[-1]

    @property
    def in_use(self) -> int | None:
        """The revision that every command uses; None without revisions."""
        latest = self.records[-1].number if self.records else None
        return latest if self.accepted is None else self.accepted

    @property
    def removable(self) -> tuple[str, ...]:
        """Effects of the shown model that can be removed: all except unknown frames."""
        frames = self.fit.model.catalogue.unknown_frames(self.fit.model.cell)
        return tuple(name for name in self.fit.model.named if name not in frames)


def _cell_keys(o: Campaign) -> tuple[CellKey, ...]:
    # with the instrument's noise, so that keys that need a stated noise are shown, too
    fixed, out = o.unchangeable({"tracker": dict.fromkeys(INSTRUMENT_NOISE)}), []
    for section, keys in CHANGEABLE.items():
        section_config = getattr(o.config, section)
        for key in keys:
            value = getattr(section_config, key)
            if isinstance(value, tuple) and value and isinstance(value[0], Target):
                value = [target.model_dump(exclude_none=True) for target in value]
            elif key == "targets" or (o.config.tool.targets and key.startswith("target_")):
                continue  # keys of the other way to state targets
            estimated = o.noise is not None and key in INSTRUMENT_NOISE
            text = "" if value is None or estimated else write_value(value)
            why = fixed.get((section, key), "")
            out.append(CellKey(section, key, text, described(section, key), why))
    return tuple(out)


def ignore_progress(text: str) -> None:
    """Ignore progress."""


class WorkbenchSession:
    """A campaign file at the workbench.

    Every method with a snapshot raises InputError if the snapshot is outdated; `say` gets lines of
    progress.
    """

    def __init__(self, path: str | Path, catalogue: Catalogue | None = None) -> None:
        self.path, self._catalogue = Path(path), catalogue
        self.work, self.viewer = Work(), WebViewer()
        self.snapshot: Snapshot | None = None  # current one; None before `load`
        self.changed: StoredChange | None = None  # the change that led to it; None: another action
        self.planned: tuple[NextPlan, Path] | None = None  # the last plan, and its file
        self.count = 0  # number of snapshots so far
        self._cache: dict[int, Chapter] = {}  # by number of the revision; 0: baseline
        self._hash = ""  # of the readings of the cache

    def load(self, say: Say = ignore_progress, revision: int | None = None) -> Snapshot:
        """Read the file, diagnose a revision and its predecessors, and show it.

        Nothing is written. `revision` None is the one in use. Raises as `Campaign.chapters`.
        """
        stamp = self._stamp()
        with self._open(read_only=True) as o:
            self._check_cache(o)
            chapters, record = self._chapters(o, revision, say), o.in_use(revision)
            cell, number = ({}, None) if record is None else (record.cell, record.number)
            return self._show(o.at(cell), number, chapters, stamp=stamp)

    def add(self, snapshot: Snapshot, effect: str, say: Say = ignore_progress) -> Snapshot:
        """Add an effect, in the syntax of `hilcal add`, to the shown model; see `changes`."""
        with self._writing(snapshot) as o:
            effects = read_effects_text(effect, "effect", o.catalogue)
            if len(effects) != 1:
                raise InputError(f"effect {effect!r} has {len(effects)} effects; valid: one")
            ((name, options),) = effects.items()
            o.catalogue.make(name, o.cell, o.readings.states, options).prior_std()
            base = snapshot.number, snapshot.fit
            return self._changed(o, add_effect(o, *base, name, options, say, snapshot.diagnosis))

    def remove(self, snapshot: Snapshot, effect: str, say: Say = ignore_progress) -> Snapshot:
        """Remove an effect from the shown model; raises as `add`."""
        with self._writing(snapshot) as o:
            base = snapshot.number, snapshot.fit
            return self._changed(o, remove_effect(o, *base, effect, say, snapshot.diagnosis))

    def go_back(self, snapshot: Snapshot, number: int, say: Say = ignore_progress) -> Snapshot:
        """Show a revision, and accept it for every command; no revision is deleted."""
        with self._writing(snapshot) as o:
            chapters = self._chapters(o, number, say)
            o.accept(None if number == len(o.file.revisions()) else number)
            return self._show(o.at(o.file.revision(number).cell), number, chapters)

    def refit(self, snapshot: Snapshot | None, say: Say = ignore_progress) -> Snapshot:
        """Fit the model and prior of the revision in use to all readings, including new ones."""
        with self._writing(snapshot, changed=True) as o:
            record = o.in_use()
            if record is None:
                raise InputError(f"{o.path}: no revision yet")
            number = self._store(o, refit(o, record, say))
            if o.file.accepted() is not None:
                o.accept(None)  # it is invalid for the new readings
            return self._show(o, number, (self._cache[number],))

    def change_cell(
        self, snapshot: Snapshot, texts: Mapping[tuple[str, str], str], say: Say = ignore_progress
    ) -> Snapshot:
        """Fit the shown model in a changed cell, and show that revision; see `changes`.

        `texts` are values by section and key, in the syntax of CELL.toml; unchanged texts have no
        effect, an empty text omits the key. Raises InputError for no change or an invalid value.
        """
        changes: dict[str, dict[str, Any]] = {}
        for f in snapshot.cell_keys:
            text = texts.get((f.section, f.key), f.text)
            if text.strip() != f.text:
                changes.setdefault(f.section, {})[f.key] = read_value(f.section, f.key, text)
        if not changes:
            raise InputError("no value differs from what is used already; nothing was fitted")
        with self._writing(snapshot) as o:
            base = snapshot.number, snapshot.fit
            in_cell, number, diagnosis = change_cell(o, *base, changes, say, snapshot.diagnosis)
            self._cache[number] = Chapter(number, None, diagnosis.fit, diagnosis)
            return self._show(in_cell, number, self._chapters(in_cell, number, ignore_progress))

    def document(
        self, snapshot: Snapshot, kind: str, say: Say = ignore_progress
    ) -> tuple[str, bytes]:
        """Return name and content of a file on the shown revision.

        `kind` is "report" (HTML), "calibration" (JSON; stores the baseline if it is shown) or
        "table" (the exchange table).
        """
        self._require(snapshot)
        number = snapshot.number
        if kind == "calibration" and number is None:
            with self._writing(snapshot) as o:
                number = self._store(o, snapshot.diagnosis)
                self._show(o, number, (self._cache[number],))
        ends = {"report": ".html", "calibration": "-calibration.json", "table": "-readings.csv"}
        with tempfile.TemporaryDirectory() as folder, self._open(read_only=True) as opened:
            o, path = opened.at(snapshot.changes), Path(folder) / f"{self.path.stem}{ends[kind]}"
            if kind == "report":
                write_report(o, path, ReportOptions(revision=number), say)
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
        say: Say = ignore_progress,
        *,
        quick: bool = True,
    ) -> NextPlan:
        """Plan the measurements that resolve the doubt of the shown diagnosis, and save the plan.

        `poses` None is the number that the doubt needs; `quick` omits the comparison of criteria
        and numbers of poses. Raises InputError if the file exists, and as `next_plan`.
        """
        if output.is_dir():
            raise InputError('the plan file has no name; valid: a name, e.g. "next.json"')
        if output.exists():
            raise InputError(f"{output}: the file exists; choose another name")
        self._require(snapshot)
        with self._open(read_only=True) as opened:
            o = opened.at(snapshot.changes)
            doubt, rng = doubt_to_settle(o, snapshot.diagnosis, say), np.random.default_rng(0)
            plan = next_plan(o, doubt, poses, rng, say, compare=not quick)
        plan.checked.save(output)
        self.planned = plan, output
        return plan

    @property
    def stale(self) -> bool:
        """Whether another command has changed the file since it was read."""
        try:
            return self.snapshot is not None and self._stamp() != self.snapshot.stamp
        except InputError:
            return True

    def evidence(self, snapshot: Snapshot, effect: str) -> DependenceCurve | None:
        """Return residual and regressor of a suspect, for its added-variable plot."""
        suspect = next((s for s in snapshot.diagnosis.suspects if s.effect == effect), None)
        return None if suspect is None else regressor(snapshot.fit, suspect)

    def recorded(self, snapshot: Snapshot) -> dict[str, StateVariable]:
        """Return the recorded variables of the measurements of the story (D,), by name."""
        rows = full_prediction(snapshot.fit).whitening.reading
        return {v.name: replace(v, values=v.values[rows]) for v in recorded_values(snapshot.fit)}

    def differences(self, snapshot: Snapshot, measurements: Ints) -> tuple[Difference, ...]:
        """Return how some measurements of the story differ from the others, clearest first."""
        picked = np.zeros(len(snapshot.fit.readings), dtype=bool)
        picked[full_prediction(snapshot.fit).whitening.reading[measurements]] = True
        return distinguish(snapshot.fit, picked)

    def _open(self, *, read_only: bool) -> Campaign:
        return Campaign.open(self.path, self._catalogue, read_only=read_only)

    def _writing(self, snapshot: Snapshot | None, *, changed: bool = False) -> Campaign:
        """Open the file for a change; `changed`: also after a change by another command."""
        self._require(snapshot, changed=changed)
        o = self._open(read_only=False)
        try:
            refuse_fitting(o.file)
            self._check_cache(o)
            return o if changed or snapshot is None else o.at(snapshot.changes)
        except BaseException:
            o.close()
            raise

    def _require(self, snapshot: Snapshot | None, *, changed: bool = False) -> None:
        if snapshot is not self.snapshot:
            raise InputError("the workbench has changed since that click; nothing was done")
        if self.stale and not changed:
            name = self.path.name
            raise InputError(f"{name} was changed by another command; read it again first")

    def _chapters(self, o: Campaign, revision: int | None, say: Say) -> tuple[Chapter, ...]:
        """Return a revision and its predecessors, diagnosed unless they are in the cache."""
        record, numbers = o.in_use(revision), [0]
        if record is None:
            refuse_fitting(o.file)
        else:
            o = o.at(record.cell)
            numbers = [r.number for r in chain_in_cell(o.file.revisions(), record.number)]
        if not self._cache.keys() >= set(numbers):
            self._cache |= zip(numbers, o.chapters(say, revision), strict=True)
        out = tuple(self._cache[number] for number in numbers)
        if out[-1].diagnosis is None:
            o.require_gc(out[-1].number, out[-1].fit.scaling, "judging")
        return out

    def _check_cache(self, o: Campaign) -> None:
        if (stored := o.data_hash) != self._hash:
            self._cache, self._hash = {}, stored

    def _store(self, o: Campaign, diagnosis: Diagnosis) -> int:
        number = o.append(diagnosis)
        self._cache[number] = Chapter(number, None, diagnosis.fit, diagnosis)
        return number

    def _changed(self, o: Campaign, c: StoredChange) -> Snapshot:
        if c.parent not in self._cache:  # the baseline, which the change has stored
            self._cache[c.parent] = self._cache[0]
        self._cache[c.number] = Chapter(c.number, c.added, c.fit, c.diagnosis, c.removed)
        return self._show(o, c.number, self._chapters(o, c.number, ignore_progress), changed=c)

    def _show(
        self,
        o: Campaign,
        number: int | None,
        chapters: tuple[Chapter, ...],
        *,
        stamp: Stamp | None = None,
        changed: StoredChange | None = None,
    ) -> Snapshot:
        """Show a revision; `stamp` is that of the file when it was read, None: its current one.

        Where the file has got readings meanwhile, the snapshot is outdated.
        """
        current = o.file.n_readings == len(o.readings)
        self.snapshot = Snapshot(
            n_readings=len(o.readings),
            records=o.file.revisions(),
            accepted=o.file.accepted(),
            number=number,
            chapters=chapters,
            story=build_story(chapters),
            stamp=(stamp or self._stamp()) if current else OUTDATED,
            source=o.file.source,
            covariance=covariance_words(o.covariance_parts, o.noise),
            changes=o.changes,
            cell_keys=_cell_keys(o),
        )
        self.changed = changed
        self.work.answers.pop("revisions", None)  # it says which revision was shown before
        self.count += 1
        return self.snapshot

    def _stamp(self) -> Stamp:
        try:
            status = self.path.stat()
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read ({error.strerror})") from None
        return status.st_size, status.st_mtime_ns, status.st_ino


@dataclass(frozen=True, slots=True)
class Answer:
    """The outcome of a task: a text, and whether the task succeeded."""

    text: str
    done: bool = True


@dataclass(slots=True)
class Work:
    """The current task and the last answers."""

    task: str | None = None  # its description; None without a task
    section: str = ""  # the part of the page that started it
    progress: str = ""  # the last line of its progress
    answers: dict[str, Answer] = field(default_factory=dict)  # the last answer at each place
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def start(self, task: str, action: Callable[[Say], object], section: str = "file") -> bool:
        """Start a task in a thread unless one is running; its text or its error is the answer."""
        with self._lock:
            if self.task is not None:
                return False
            self.task, self.progress, self.section = task, "", section
            self.answers.pop(section, None)
        threading.Thread(target=self._run, args=(action,), name="workbench", daemon=True).start()
        return True

    def _run(self, do: Callable[[Say], object]) -> None:
        try:
            result = do(lambda text: setattr(self, "progress", text))
            answer = Answer(result) if isinstance(result, str) and result else None
        except HilcalError as error:
            answer = Answer(str(error), done=False)
        except (Exception, SystemExit) as error:
            text = f"{type(error).__name__}: {' '.join(str(error).split())}"
            why = failure_of(error) or f"unexpected {text}; please report it"
            answer = Answer(str(why), done=False)
        with self._lock:
            if answer is not None:
                self.answers[self.section] = answer
            self.task, self.progress = None, ""

    @property
    def line(self) -> str:
        """The current task and its progress in a line; empty without a task."""
        task, progress = self.task, self.progress
        if task is None:
            return ""
        return task if progress.lower() in ("", task.lower()) else f"{task}: {progress}"

    def failure(self, section: str = "file") -> str:
        """Return the error of the last task at a place; empty if it succeeded."""
        answer = self.answers.get(section)
        return "" if answer is None or answer.done else answer.text
