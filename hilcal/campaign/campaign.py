"""A campaign: its readings with their full covariance, and its stored fits."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Self

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.improvement import refuted
from hilcal.campaign import revisions
from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig
from hilcal.config.cell import INSTRUMENT_NOISE, Changes, changed
from hilcal.diagnosis.background_evidence import background_evidence
from hilcal.diagnosis.diagnosis import Diagnosis, History
from hilcal.diagnosis.evidence import Evidence
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.diagnosis.verdict import diagnose, judge_naming, with_insufficiency
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError, expect, undone_by
from hilcal.identification.baseline import baseline
from hilcal.identification.carried.posterior import Posterior, Source
from hilcal.identification.fit import Fit, fit
from hilcal.identification.noise.full_covariance import (
    CovarianceParts,
    covariance_parts,
    full_readings,
    with_noise_of,
)
from hilcal.identification.noise.noise_estimate import NOISE_KEY, NoiseEstimate, with_noise_factors
from hilcal.identification.prediction.predictive import Predictive
from hilcal.model.model import Model
from hilcal.names import quoted
from hilcal.present.story import Chapter
from hilcal.readings.covariance import COVERS_KEY, FROM_KEY, INSTRUMENT, INSTRUMENT_AND_ARM, TRACKER
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, usual_mode
from hilcal.refinement import Refinement
from hilcal.shown import Brief
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.overview import overview
from hilcal.store.procedure_log import IMPROVED, ProcedureLog, refuse_fitting
from hilcal.store.revision import CELL, STORED_HASH, RevisionRecord
from hilcal.store.rows import content_hash
from hilcal.store.run_log import PLAN, RunLog
from hilcal.store.stored_texts import CALIBRATION_FILE, ROBOT_FILE, check_robot, running_command
from hilcal.tables.table import covers_with_rounding, write_table
from hilcal.types import Floats

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False, init=False)
class Campaign(Brief):
    """An open campaign file; close it, or use it in a `with` statement.

    A method's parameter `revision` is a number; None is the revision in use, see `in_use`.

    >>> with hc.Campaign.open(RUN) as run:
    ...     len(run.readings), run.cell.arm.name, run.mode()
    (50, 'ur10e', 'deflection')

    Attributes:
        file: the SQLite file, open for appending revisions.
        readings: all readings, with the covariance of instrument, averaging and repeatability.
        catalogue: the effects that a model can have.
        changes: changes of the cell since the readings were taken, see `with_cell`.
        noise: the noise as estimated from the readings; None where the table, the cell or the
            samples of the readings state it.
    """

    file: CampaignFile
    cell: Cell
    readings: Readings
    catalogue: Catalogue
    changes: Changes
    noise: NoiseEstimate | None

    def __init__(
        self, path: str | Path, catalogue: Catalogue | None = None, *, read_only: bool = False
    ) -> None:
        """Open a campaign file; its cell is that of the revision in use.

        Args:
            catalogue: the effects that a model can have; the installed ones unless given.
            read_only: write neither the file nor files next to it.

        Raises:
            InputError: not a valid campaign, or without readings.
        """
        file = CampaignFile.open(path, read_only=read_only)
        with undone_by(file.close):
            number, records = file.accepted(), file.revisions()
            in_use = records[-1:] if number is None else records[number - 1 : number]
            self._set(file, catalogue or installed(), in_use[0].cell if in_use else {})

    @property
    def config(self) -> CellConfig:
        """The configuration of the cell."""
        return self.cell.configured()

    @classmethod
    def open(
        cls, path: str | Path, catalogue: Catalogue | None = None, *, read_only: bool = False
    ) -> Self:
        """Open a campaign file: the same as `Campaign(path)`."""
        return cls(path, catalogue, read_only=read_only)

    def _brief(self) -> dict[str, str]:
        poses = len(np.unique(self.readings.pose))
        try:
            record = self.in_use()
            revision = "no revision yet" if record is None else f"revision {record.number}"
        except InputError:  # the file is closed or deleted
            revision = "not known, the file is closed"
        return {
            "file": str(self.path),
            "arm": self.cell.arm.name,
            "readings": f"{len(self.readings)} at {poses} poses",
            "in use": revision,
            "more": "readings.to_frame(), fit(), calibration(), append()",
        }

    def _repr_html_(self) -> str:
        from hilcal.present.campaign import info_report  # for notebooks only
        from hilcal.present.html import fragment
        from hilcal.present.registration import covariance_words

        covariance = covariance_words(self.covariance_parts, self.noise)
        return fragment(info_report(overview(self.file), self.path.name, covariance))

    def _set(self, file: CampaignFile, catalogue: Catalogue, changes: Changes) -> None:
        """Set the attributes from an open file and the changes of its cell."""
        config = CellConfig.from_json(file.config_json)
        try:
            config = changed(config, changes)
        except InputError as error:
            raise InputError(f"{file.path}: a revision is damaged ({error})") from None
        robot_texts = file.about(ROBOT_FILE), file.about(CALIBRATION_FILE)
        check_robot(file.path, file.config_json, *robot_texts)
        cell, restated = cell_from_config(config, None, *robot_texts), _restates(file, changes)
        noise = None if restated else estimated_noise(file)
        readings = _with_instrument(file.readings(), config, restated, noise)
        readings = full_readings(readings, _covers(file, changes), cell)
        readings = replace(readings, noise_stated=noise is None)
        values = (file, cell, readings, catalogue, changes, noise)
        for field, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, field.name, value)

    def at(self, changes: Changes) -> Self:
        """Return the campaign, on the same open file, with these changes of the original cell."""
        if changes == self.changes:
            return self
        campaign = object.__new__(type(self))
        campaign._set(self.file, self.catalogue, changes)
        return campaign

    def with_cell(self, changes: Changes) -> Self:
        """Return the campaign with further changes of the cell; the file is not changed.

        The tracker's noise determines the covariances of readings whose table states none, as in
        an import; no other number of a reading changes. `changes` are values by section and key,
        for the keys of `config.cell.CHANGEABLE`; the value None removes a key.

        Raises:
            InputError: a key or a value is not valid, or these readings do not use the key.
        """
        merged = {
            section: {**self.changes.get(section, {}), **changes.get(section, {})}
            for section in sorted(self.changes.keys() | changes.keys())
        }
        for (section, key), why in self.unchangeable(merged).items():
            if key in changes.get(section, {}):
                raise InputError(f"the cell: [{section}] {key} cannot be changed: {why}")
        changed(self.config, changes)
        return self.at(merged)

    def unchangeable(self, changes: Changes | None = None) -> dict[tuple[str, str], str]:
        """Return the keys of the cell that cannot be changed, by (section, key), with the reason.

        `changes` are all changes of the cell; those of the campaign where None.
        """
        reasons: dict[tuple[str, str], str] = {}
        noise, changes = self.file.about(NOISE_KEY), self.changes if changes is None else changes
        if noise is None and self.file.about(FROM_KEY) != TRACKER:
            why = "the covariances of these readings are those that were measured, or of the table"
            reasons |= {("tracker", key): why for key in INSTRUMENT_NOISE}
        covers = _covers(self.file, changes)
        if covers != INSTRUMENT:
            hint = "; state the noise in [tracker], too" if noise is not None else ""
            why = f"the covariances of these readings include the arm's scatter already{hint}"
            old = "an older version of hilcal imported these readings; import the table again"
            reasons["repeatability", "joint_std_rad"] = why if covers == INSTRUMENT_AND_ARM else old
        if self.file.about(PLAN) is not None and self.config.force_sensor is not None:
            reasons["tool", "load_point_m"] = "the force sensor's moments are stored about it"
        return reasons

    @property
    def path(self) -> Path:
        """The file."""
        return self.file.path

    @property
    def covariance_parts(self) -> CovarianceParts:
        """The components of the readings' covariance."""
        return covariance_parts(_covers(self.file, self.changes), self.config)

    @property
    def covers(self) -> str:
        """What the covariance of `readings` covers, in the words of an exchange table."""
        return (
            INSTRUMENT
            if self.covariance_parts in ("instrument", "as imported")
            else INSTRUMENT_AND_ARM
        )

    @property
    def stored_covers(self) -> str:
        """What the covariance of the file's readings covers, in the words of an exchange table.

        Covariances of a file that does not state this are taken as complete where the cell states
        a scatter of the arm.
        """
        added = covariance_parts(INSTRUMENT, self.config) != "instrument"
        return _covers(self.file, self.changes) or (INSTRUMENT_AND_ARM if added else INSTRUMENT)

    @property
    def data_hash(self) -> str:
        """SHA-256 of `readings` as the file stores them, without readings appended since."""
        return self.file.data_hash(len(self.readings))

    def save_table(self, path: Path, *, as_stored: bool = False) -> None:
        """Write the readings as an exchange table, CSV or Parquet by the file's name.

        `as_stored` leaves out the arm's scatter where it was added to the covariance. An existing
        file is replaced; InputError: it cannot be written.
        """
        about = {"campaign": self.path.name, "source": self.file.source}
        about["robot"] = self.cell.arm.name
        readings, covers = self.readings, self.covers
        if as_stored:
            readings, covers = self.file.readings(), self.stored_covers
            about["readings_sha256"] = content_hash(readings)
            restated = _restates(self.file, self.changes)
            readings = _with_instrument(readings, self.config, restated, self.noise)
        covers = covers_with_rounding(covers, readings)
        write_table(readings, path, covers, about, self.cell.arm.units)

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    def __enter__(self) -> Self:
        """Return the campaign."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self.close()

    @property
    def revisions(self) -> tuple[RevisionRecord, ...]:
        """All revisions, oldest first; `fit(n)` restores the one of number n."""
        return self.file.revisions()

    def latest(self) -> RevisionRecord | None:
        """Return the latest revision; None without revisions."""
        return next(reversed(self.file.revisions()), None)

    def in_use(self, revision: int | None = None) -> RevisionRecord | None:
        """Return the revision of a number; None: the accepted one, else the latest."""
        number = self.file.accepted() if revision is None else revision
        return self.latest() if number is None else self.file.revision(number)

    def _fitted(self, revision: int | None) -> RevisionRecord:
        """Return the same; refuse a campaign without revisions."""
        record = self.in_use(revision)
        if record is None:
            raise InputError(f"{self.path}: no revision yet; run hilcal identify or refine first")
        return record

    def accept(self, revision: int | None) -> None:
        """Make a revision the one in use; None: always the latest."""
        self.file.accept(revision)

    def mode(self) -> Mode:
        """Return the kind of readings of the revision in use, else of plan and readings."""
        record = self.in_use()
        if record is not None:
            return revisions.mode_of(record)
        return usual_mode(self.readings, self.config.planning.readings)

    def fit(self, revision: int | None = None) -> Fit:
        """Return a stored fit.

        Raises:
            InputError: no such revision, or its readings or effects have changed since.
        """
        return self.restore(self._fitted(revision))

    def restore(self, record: RevisionRecord) -> Fit:
        """Return the fit of a stored revision; raises as `fit` does."""
        revisions.check_sources(record, self.path, self.catalogue)
        self._require_its_cell(record)
        try:
            return revisions.restore(
                record, self.cell, self.readings, self.catalogue, self.data_hash
            )
        except InputError as error:
            raise InputError(f"{error}{self._until_used(record.number)}") from None

    def _require_its_cell(self, record: RevisionRecord) -> None:
        if record.cell != self.changes:
            raise InputError(
                f"revision {record.number} was fitted in a cell that was changed otherwise than "
                f"that of the revision in use; use it first: hilcal accept {quoted(self.path)} "
                f"{record.number}"
            )

    def require_gc(self, number: int | None, scaling: str, task: str) -> None:
        """Refuse a fit, of revision `number`, whose residual is not whitened."""
        if scaling != "gc":
            raise InputError(
                f"revision {number} has scaling {scaling}; {task} needs gc: run hilcal identify "
                f"again{self._until_used(number)}"
            )

    def _until_used(self, number: int | None) -> str:
        """Return how to put a new fit into use, after "run hilcal identify again"."""
        if number is None or number != self.file.accepted():
            return ""
        return (
            f"; revision {number} is accepted: release it, and the latest one is used: "
            f"hilcal accept {quoted(self.path)} --release"
        )

    def fitted_readings(self, record: RevisionRecord) -> Readings:
        """Return the readings that a revision was fitted to, which are the first ones."""
        self._require_its_cell(record)
        with revisions.damage_refused(record):
            return self.readings[: int(record.result_json["identify"]["n_readings"])]

    def restore_model(self, record: RevisionRecord) -> tuple[Model, Floats]:
        """Return model and parameters (P,) of a stored revision; raises as `fit` does."""
        revisions.check_sources(record, self.path, self.catalogue)
        return revisions.restore_model(
            record, self.cell, self.fitted_readings(record), self.catalogue
        )

    def predictive(self, record: RevisionRecord, model: Model, theta: Floats) -> Predictive:
        """Return the predictive distribution of a stored revision."""
        return revisions.restore_predictive(record, model, theta, self.fitted_readings(record))

    def calibration(self, revision: int | None = None) -> Calibration:
        """Return the calibration of a stored fit; raises as `fit` does."""
        record = self._fitted(revision)
        judged: Mapping[str, Any] = record.result_json.get("diagnose", {})
        source = {
            "campaign": self.path.name,
            "revision": record.number,
            "effects": list(record.effects),
            "verdict": judged.get("verdict"),
            "readings_sha256": record.data_hash,
            **self._kinematics(),
        }
        calibration = Calibration.of(self.restore(record), source)
        return replace(calibration, refuted_by=self._refuted_by(record))

    def _refuted_by(self, record: RevisionRecord) -> tuple[int, int] | None:
        """Return `Calibration.refuted_by` of a revision."""
        tested = ProcedureLog(self.file).last(IMPROVED)
        if tested is None or tested["revision"] != record.number:
            return None
        inside, count = tested["error"]["inside"], tested["error"]["count"]
        return (inside, count) if refuted(inside, count) else None

    def _kinematics(self) -> dict[str, object]:
        """Return the controller's kinematics for a calibration; empty where unknown."""
        if self.file.about(PLAN) is not None:
            event = RunLog(self.file).last("devices") or {}
            for answer in event.get("answers", ()):
                if "kinematics" in answer.get("fields", {}):
                    return {"kinematics": answer["fields"]["kinematics"]}
        factory = self.cell.factory
        return {} if factory is None or factory.rows is None else {"kinematics": factory.to_dict()}

    def posterior(self, revision: int | None = None) -> Posterior:
        """Return the posterior of a stored fit, which can be the prior of another campaign.

        Raises:
            InputError: see `fit`, or the fit's scaling is not gc.
            CannotAnswerError: the model has no effect of the arm.
        """
        record = self._fitted(revision)
        source = Source(self.path.name, record.number, record.created)
        return Posterior.of(self.restore(record), source)

    def history(self, revision: int | None = None) -> History:
        """Return the history of a revision's model, which `diagnose` takes."""
        record = self.in_use(revision)
        chain = () if record is None else revisions.chain(self.file.revisions(), record.number)
        return revisions.history(chain)

    def append(self, result: Fit | Diagnosis | Refinement) -> int:
        """Append a fit, a diagnosed fit, or all steps of a refinement as revisions.

        Return the number of the (last) revision. Nothing is stored where the latest revisions are
        these already. Raises as `store` does.
        """
        if isinstance(result, Refinement):
            records = [self.record(s.fit, s.diagnosis, s.added, s.removed) for s in result.steps]
        elif isinstance(result, Diagnosis):
            records = [self.record(result.fit, result)]
        else:
            expect(result, Fit, "result", "a Fit, a Diagnosis or a Refinement")
            records = [self.record(result)]
        return self.append_records(records)[-1]

    def append_records(
        self, records: Sequence[RevisionRecord], parent: int | None = None
    ) -> tuple[int, ...]:
        """Store a chain of revisions from `record`, each made from the previous one.

        Return their numbers; none is stored where the latest chain ends with them already.
        `parent` is the number of the revision that the first one is made from, if any.
        """
        if not records:
            return ()
        last = revisions.chain(self.file.revisions())[-len(records) :]
        comparable = last and last[0].made_from == parent and len(last) == len(records)
        if comparable and all(map(revisions.equal_but_for_origin, records, last)):
            return tuple(r.number for r in last)
        numbers = []
        for record in records:
            parent = self.file.append_revision(replace(record, parent=parent))
            numbers.append(parent)
        return tuple(numbers)

    def store(
        self,
        fitted: Fit,
        diagnosis: Diagnosis | None = None,
        added: str | None = None,
        removed: str | None = None,
        parent: int | None = None,
    ) -> int:
        """Store a fit, with the effect that was added to or removed from the model.

        Return the number of the revision. `parent` is the number of the revision that was changed;
        None: the previous one.

        Raises:
            InputError: it was fitted to other readings than those of this campaign, or these are
                of a validation campaign (`store.procedure_log`).
        """
        return self.file.append_revision(self.record(fitted, diagnosis, added, removed, parent))

    def record(
        self,
        fitted: Fit,
        diagnosis: Diagnosis | None = None,
        added: str | None = None,
        removed: str | None = None,
        parent: int | None = None,
    ) -> RevisionRecord:
        """Return the record that `store` stores; raises as `store` does."""
        refuse_fitting(self.file)
        hashed = content_hash(fitted.readings)
        if hashed != content_hash(self.readings):
            raise InputError(f"{self.path}: the fit is of other readings than this campaign's")
        document = None if diagnosis is None else diagnosis.to_dict()
        record = revisions.to_record(fitted, document, added, hashed, removed, parent)
        options = {**record.options, STORED_HASH: self.data_hash, **running_command()}
        if self.changes:
            options[CELL] = self.changes
        return replace(record, options=options)

    def fit_in_use(
        self, say: Say = lambda text: None, revision: int | None = None
    ) -> tuple[int | None, Fit]:
        """Return number and fit of the revision in use; without one, None and the baseline's fit.

        Nothing is stored.
        """
        record = self.in_use(revision)
        if record is not None:
            say(f"restoring revision {record.number}")
            return record.number, self.restore(record)
        refuse_fitting(self.file)
        model = baseline(self.cell, self.readings, self.mode(), self.catalogue)
        say(f"fitting {' + '.join(model.names) or 'the nominal arm'}")
        return None, with_serial_noise(fit(model, self.readings, self.mode()))

    def chapters(self, say: Say = lambda text: None, revision: int | None = None) -> list[Chapter]:
        """Return the revision in use and its ancestors, diagnosed; see `view`.

        Without revisions, return the baseline, which is not stored. Raises as `fit` does.
        """
        last = self.in_use(revision)
        if last is None:
            _, fitted = self.fit_in_use(say)
            say("diagnosing it")
            return [Chapter(1, None, fitted, diagnose(fitted, say=say))]
        records = revisions.chain_in_cell(self.file.revisions(), last.number)
        fits = []
        for record in records:
            say(f"restoring revision {record.number}")
            fits.append(self.restore(record))
        numbers = {id(f): r.number for f, r in zip(fits, records, strict=True)}
        judged: list[Diagnosis | None] = []
        while len(judged) < len(fits):
            group = _named_from(fits[len(judged) :])
            say(f"diagnosing revision {numbers[id(group[-1])]}")
            is_last = len(judged) + len(group) == len(fits)
            judged += _judged(group, lambda f: self.history(numbers[id(f)]), say, is_last)
        if (end := judged[-1]) is not None:
            judged = [d and with_insufficiency(d, end) for d in judged]
        return [
            Chapter(r.number, r.added, f, d, r.removed)
            for r, f, d in zip(records, fits, judged, strict=True)
        ]


def _judged(
    fits: Sequence[Fit], history: Callable[[Fit], History], say: Say, whole_catalogue: bool
) -> Sequence[Diagnosis | None]:
    """Diagnose a fit, or fits that name more and more effects of one background."""
    if fits[0].scaling != "gc":
        return [None]
    if len(fits) == 1:
        return [diagnose(fits[0], history(fits[0]), say, whole_catalogue)]
    tested = background_evidence(fits[0])
    return judge_naming(
        fits, tested, history, lambda remaining: Evidence(fits[-1], say=say, background=remaining)
    )[0]


def _named_from(fits: Sequence[Fit]) -> Sequence[Fit]:
    """Return the first fit, and the next ones that only name further effects of its background."""
    for count, (previous, f) in enumerate(pairwise(fits), start=1):
        fewer = f.model.background < previous.model.background
        if not fewer or not np.array_equal(f.theta, fits[0].theta):
            return fits[:count]
    return fits


def estimated_noise(file: CampaignFile) -> NoiseEstimate | None:
    """Return the noise estimated at import or after measuring; None where it is stated."""
    if file.about(PLAN) is None:
        return NoiseEstimate.from_json(file.about(NOISE_KEY))
    event = RunLog(file).last(NOISE_KEY)
    return None if event is None or event["factors"] is None else NoiseEstimate.of(event)


def _with_instrument(
    readings: Readings, config: CellConfig, restated: bool, noise: NoiseEstimate | None
) -> Readings:
    """Return stored readings with the instrument's covariance as stated or estimated."""
    if restated:
        return with_noise_of(config.tracker, readings)
    if noise is not None and noise.factors is not None:
        return with_noise_factors(readings, config.tracker, noise.factors)
    return readings


def _restates(file: CampaignFile, changes: Changes) -> bool:
    """Whether changes in [tracker] replace the covariances of the readings."""
    keys = changes.get("tracker", {}).keys()
    if file.about(NOISE_KEY) is not None:
        return not keys.isdisjoint(INSTRUMENT_NOISE)
    return file.about(FROM_KEY) == TRACKER and not keys.isdisjoint((*INSTRUMENT_NOISE, "station_m"))


def _covers(file: CampaignFile, changes: Changes) -> str | None:
    """Return what the covariance of the readings covers before the arm's scatter is added."""
    return INSTRUMENT if _restates(file, changes) else file.about(COVERS_KEY)


@contextmanager
def opened(run: Campaign | str | Path) -> Iterator[Campaign]:
    """Yield a campaign as it is; open that of a path, and close it after the block."""
    if isinstance(run, Campaign):
        yield run
        return
    expect(run, (str, Path), "run", "a Campaign, or the path of one")
    with Campaign(run) as campaign:
        yield campaign
