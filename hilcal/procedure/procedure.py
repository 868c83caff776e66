"""The steps of a calibration: each reads what the files hold, does one thing, and appends it.

    plan ─► measure ─► refine ─► decide ─► plan_validation ─► measure_validation ─► validate
               ▲                    │                                                  │
               └── a further plan ──┘          compare ◄─ measure_corrected ◄─ correct ◄─┘

A step that was cut short has either appended all of its result or nothing; readings are stored one
by one. So the next step follows from the files (`state.next_step`), whatever has stopped the one
before, and nothing is measured twice.

The validation campaign is a file of its own. Before anything is predicted of it, its hash enters
the calibration's log; from then on it has to be just this.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.improvement import Improvement, improvement
from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.planner import Planned, Request, make
from hilcal.design.summary import CheckedPlan, about, checked, remarks, summarise
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError
from hilcal.identification import validation
from hilcal.identification.arm_scatter import with_arm_scatter
from hilcal.identification.baseline import baseline
from hilcal.identification.carried import CarriedPrior
from hilcal.identification.full_covariance import full_readings
from hilcal.identification.validation import Acceptance, acceptance, extrapolation
from hilcal.present.progress import Say
from hilcal.procedure.next_plan import (
    Decision,
    FurtherMeasuring,
    PredictedError,
    predicted_error,
)
from hilcal.procedure.state import (
    BEGUN,
    DECIDED,
    FROZEN,
    IMPROVED,
    MEASURE,
    REFINED,
    STOP,
    VALIDATED,
    Files,
    ProcedureStep,
    Settings,
    identity,
    next_step,
    opened,
    reference_in,
    reference_of,
    settings_of,
)
from hilcal.procedure.validation_plan import corrected_plan, left_out_of, paired, validation_plan
from hilcal.readings.covariance import COVERS, INSTRUMENT
from hilcal.readings.readings import ArmScatter, Readings
from hilcal.readings.same_readings import already
from hilcal.readings.whitening import Mode, usual_mode
from hilcal.refinement import Refinement, refine
from hilcal.refinement import RefinementStep as RefinementStep
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, read_plan
from hilcal.store.procedure_log import (
    CALIBRATION,
    CORRECTED,
    ENTRY,
    PURPOSE,
    VALIDATION,
    ProcedureLog,
    entry,
)
from hilcal.store.revision import RevisionRecord
from hilcal.store.rows import content_hash
from hilcal.store.run_log import PLAN, RunLog, check_same_cell, create_run

Measure = Callable[[CampaignFile, float | None], None]
"""Measures what is missing of a campaign's plan and stores it there; the time of day, s, that its
time counts from is given where it is not its own."""

_FIRST, _FURTHER, _VALIDATING, _CORRECTING = range(4)
"""Streams of random numbers."""


@dataclass(frozen=True, eq=False)
class Procedure:
    """A calibration in a cell.

    >>> p = hc.Procedure.at("new.hilcal", hc.Cell.load(CELL), poses=6)
    >>> p.next().kind
    'plan'

    Attributes:
        run: the campaign file that is fitted; the others stand beside it.
        cell: the cell as configured.
        config: its configuration.
        base_dir: directory that paths in the configuration are relative to.
        catalogue: the effects that a model can have.
        settings: what is asked for.
        known: the prior of every fit, of `settings.prior`; None without one.
    """

    run: Path
    cell: Cell
    config: CellConfig
    base_dir: Path
    catalogue: Catalogue
    settings: Settings
    known: CarriedPrior | None = None
    _found: list[Refinement] = field(default_factory=list, repr=False)

    @classmethod
    def at(
        cls, run: str | Path, cell: Cell, catalogue: Catalogue | None = None, **asked: Any
    ) -> "Procedure":
        """Begin a calibration, or take up the one that a campaign file holds.

        Args:
            run: the campaign file; the others go beside it.
            cell: from `Cell.load`.
            catalogue: the effects that a model can have; the installed ones unless given.
            **asked: what is asked for, see `Settings`; of a calibration that is there, what it was.
        """
        path, config, known = Path(run), cell.configured(), catalogue or installed()
        if path.exists():
            there = continued(path, cell, config, known)
            return replace(there, settings=replace(there.settings, **asked))
        readings = config.planning.readings if config.loads else "absolute"
        usual = Settings(seed=config.simulation.seed, readings=readings)
        return cls(path, cell, config, cell.base_dir.absolute(), known, replace(usual, **asked))

    @property
    def files(self) -> Files:
        """Its files."""
        return Files(self.run)

    def record(self) -> RevisionRecord:
        """Return the revision that the last refinement ended with."""
        with Campaign.open(self.run, self.catalogue, read_only=True) as o:
            return self._record(o)

    def next(self) -> ProcedureStep:
        """Return the next step."""
        return next_step(self.run)

    # the first plan

    def plan(self, say: Say = lambda words: None) -> CheckedPlan:
        """Choose the first plan; nothing is stored yet. A cell may leave too few poses."""
        rng, config = self._rng(_FIRST), self._planned()
        return checked_plan(self.cell, config, self.settings.poses, rng, self.catalogue, say)

    def begin(self, plan: Plan, config: CellConfig, *, covers: str = INSTRUMENT) -> None:
        """Make the campaign file with its first plan.

        `config` is what the file holds, with the devices that are used; `covers` what the
        covariance of the readings will cover.
        """
        self.check_files()
        first = entry(BEGUN, {"settings": self.settings.to_json()})
        more = {COVERS: covers, ENTRY.format(1): first}
        create_run(self.run, config, self.base_dir, plan, source=self._source(), more=more).close()

    def check_files(self) -> None:
        """Refuse files of another calibration where those of this one will be."""
        for path in (self.files.validation, self.files.corrected):
            if path.exists():
                raise InputError(
                    f"{path}: the file exists, and {self.run} does not; rename or move it away"
                )

    def resume(self, campaign: CampaignFile) -> None:
        """Keep what is asked for in the log of the campaign."""
        check_same_cell(campaign, self.config, self.base_dir)
        log, settings = ProcedureLog(campaign), self.settings.to_json()
        before = log.last(BEGUN)
        if before is None or before["settings"] != settings:
            log.append(BEGUN, {"settings": settings})

    # measuring

    def measure(self, step: ProcedureStep, measure: Measure) -> int:
        """Measure what is missing of a plan; returns how many readings its campaign then holds.

        Raises:
            DeviceError: a device failed; what was measured is stored.
            KeyboardInterrupt: somebody stopped it; the same holds.
        """
        epoch = None if step.path == self.run else self._epoch()
        with CampaignFile.open(step.path) as campaign:
            measure(campaign, epoch)
            return campaign.n_readings

    def _epoch(self) -> float | None:
        """Return the time of day that the campaign's time counts from, s; None where not known."""
        with CampaignFile.open(self.run, read_only=True) as campaign:
            details = RunLog(campaign).details() if campaign.about(PLAN) is not None else []
        return float(details[0]["epoch_wall_s"]) if details else None

    # fitting

    def refine(
        self,
        say: Say = lambda words: None,
        seen: Callable[[int, RefinementStep], None] = lambda number, step: None,
    ) -> Refinement:
        """Fit, diagnose, and change the model until it is adequate; all revisions are stored.

        Args:
            say: takes progress.
            seen: takes each step as soon as it is judged, with the number of its revision.

        Raises:
            CannotAnswerError: the readings do not determine the baseline.
        """
        with Campaign.open(self.run, self.catalogue) as o:
            mode = self._mode(o.readings)
            say("registering")
            model = baseline(o.cell, o.readings, mode, o.catalogue, self.known)
            numbers = itertools.count(len(o.file.revisions()) + 1)
            found = refine(
                model, o.readings, mode, say, seen=lambda step: seen(next(numbers), step)
            )
            say("computing standard uncertainties")
            self.keep(o, found)
        return found

    def keep(self, o: Campaign, found: Refinement) -> tuple[int, ...]:
        """Store the revisions of a refinement; returns their numbers."""
        records = [o.record(s.fit, s.diagnosis, s.added, s.removed) for s in found.steps]
        content = {"readings_sha256": o.data_hash, "verdict": found.verdict}
        self._found[:] = [found]
        return ProcedureLog(o.file).append(REFINED, content, revisions=records)

    def decide(self, say: Say = lambda words: None) -> Decision:
        """Decide whether to measure more; a further plan is in the campaign then."""
        with Campaign.open(self.run, self.catalogue) as o:
            log, run = ProcedureLog(o.file), RunLog(o.file)
            if self._found:
                d = self._found[0].diagnosis
            else:
                record = self._record(o)
                say(f"diagnosing revision {record.number}")
                d = diagnose(o.restore(record), o.history(record.number), say)
            rng = self._rng(_FURTHER, len(run.plans))
            reference = reference_of(run.plans[0])
            asked = (self.cell, self._planned(), self.settings)
            found = FurtherMeasuring(*asked, d, run.plans, reference, rng, say).decide()
            plan = found.plan if found.measures else None
            if plan is not None:
                plan = run.with_new_names(plan)  # `run` checks every motion of it
            action = STOP if plan is None else MEASURE
            log.append(DECIDED, {"action": action, **found.to_json()}, plan=plan)
        return found

    def stop(self) -> None:
        """Measure no further plan: the last refinement is what will be tested."""
        with CampaignFile.open(self.run) as campaign:
            ProcedureLog(campaign).append(DECIDED, {"action": STOP, "reason": "asked"})

    def compute(self, step: ProcedureStep, say: Say = lambda words: None) -> object:
        """Do a step after the first in which nothing moves; returns what came of it."""
        steps: dict[str, Callable[[Say], object]] = {
            "refine": self.refine,
            "decide": self.decide,
            "plan_validation": self.plan_validation,
            "validate": self.validate,
            "correct": self.correct,
            "compare": self.compare,
        }
        return steps[step.kind](say)

    def predicted(self) -> PredictedError:
        """Predict the error after compensation with the model as it is."""
        with Campaign.open(self.run, self.catalogue, read_only=True) as o:
            calibration, record = self._calibration(o)
            return predicted_error(calibration, o.fitted_readings(record).states, self.config)

    # testing what is never fitted

    def plan_validation(self, say: Say = lambda words: None) -> Plan:
        """Choose poses and loads of the validation campaign, and make its file."""
        with Campaign.open(self.run, self.catalogue, read_only=True) as o:
            say("restoring the model")
            calibration, record = self._calibration(o)
            plan = validation_plan(
                self.cell,
                self.config,
                calibration,
                o.fitted_readings(record),
                reference_in(o.file),
                self.settings.validation,
                self._rng(_VALIDATING),
                say,
                under_load=self.settings.under_load,
            )
            self._create(self.files.validation, VALIDATION, plan, o)
        return plan

    def validate(self, say: Say = lambda words: None) -> Acceptance:
        """Freeze the validation campaign, and predict its readings."""
        with (
            Campaign.open(self.run, self.catalogue) as o,
            opened(self.files.validation, VALIDATION, self.run) as unseen,
        ):
            log = ProcedureLog(o.file)
            self._freeze(log, unseen)
            record = self._record(o)
            fitted = o.fitted_readings(record)
            readings = self._readings(o, record, unseen)
            if already(readings, fitted).any():
                raise InputError(
                    f"{unseen.path}: some of its readings were fitted by revision "
                    f"{record.number} of {self.run}; they test nothing"
                )
            say(f"predicting {len(readings)} readings")
            model, theta = o.restore_model(record)
            mode = self._mode(fitted)
            found = validation.validate(model, theta, fitted, readings, mode)
            beyond = extrapolation(o.predictive(record, model, theta), fitted, found)
            shares = acceptance(found, beyond)
            every = shares.everything
            content = {"revision": record.number, "error": found.error.to_json()}
            content |= {"noise_floor_m": found.noise_floor, "stated_m": every.stated_m}
            log.append(VALIDATED, {**content, "within": every.within})
        return shares

    def _freeze(self, log: ProcedureLog, unseen: CampaignFile) -> None:
        """Record the hash of the validation campaign; later it has to be the same."""
        frozen, readings = log.last(FROZEN), unseen.readings()
        hashed = content_hash(readings)
        if frozen is None:
            content = {"file": unseen.path.name, "readings_sha256": hashed}
            log.append(FROZEN, {**content, "readings": len(readings)})
        elif frozen["readings_sha256"] != hashed:
            raise InputError(
                f"{unseen.path}: other readings than when it was frozen "
                f"(SHA-256 {frozen['readings_sha256'][:12]}…, now {hashed[:12]}…)"
            )

    def correct(self, say: Say = lambda words: None) -> Plan:
        """Correct the joint targets of the validation poses, and make the file of their run."""
        with (
            Campaign.open(self.run, self.catalogue) as o,
            opened(self.files.validation, VALIDATION, self.run) as unseen,
        ):
            self._freeze(ProcedureLog(o.file), unseen)
            say("restoring the model")
            calibration, record = self._calibration(o)
            readings = self._readings(o, record, unseen)
            made = read_plan(unseen.about(PLAN) or "", f"{unseen.path}, its plan")
            reference = reference_of(made)
            time = readings.states.time
            plan = corrected_plan(
                self.cell,
                self.config,
                calibration,
                readings,
                readings.states.q[0] if reference is None else reference,
                0.0 if time is None else float(time[-1]),
                self._rng(_CORRECTING),
                say,
            )
            self._create(self.files.corrected, CORRECTED, plan, o)
        return plan

    def compare(self, say: Say = lambda words: None) -> Improvement:
        """Compare the errors at uncorrected and at corrected joint targets, as measured."""
        with (
            Campaign.open(self.run, self.catalogue) as o,
            opened(self.files.validation, VALIDATION, self.run) as unseen,
            opened(self.files.corrected, CORRECTED, self.run) as moved,
        ):
            log = ProcedureLog(o.file)
            self._freeze(log, unseen)
            say("comparing errors before and after")
            calibration, record = self._calibration(o)
            first, last = (self._readings(o, record, file) for file in (unseen, moved))
            before, after = paired(first, last, calibration.mode)
            left_out = left_out_of(read_plan(moved.about(PLAN) or "", f"{moved.path}, its plan"))
            p = o.predictive(record, *o.restore_model(record))
            found = improvement(calibration, p, before, after, before.states, left_out)
            if log.last(IMPROVED) is None:
                content = {"revision": record.number, "readings_sha256": moved.data_hash()}
                log.append(IMPROVED, {**content, **found.to_dict()})
        return found

    # what the steps share

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self.settings.seed, *stream])

    def _planned(self) -> CellConfig:
        """Return the configuration for planning: of the kind of readings that is fitted."""
        planning = self.config.planning.model_copy(update={"readings": self.settings.readings})
        return self.config.model_copy(update={"planning": planning})

    def _mode(self, readings: Readings) -> Mode:
        """Return the kind of readings that is fitted; deflections where the readings allow."""
        return usual_mode(readings, self.settings.readings)

    def _record(self, o: Campaign) -> RevisionRecord:
        refined = ProcedureLog(o.file).last(REFINED)
        if refined is None:
            raise InputError(f"{self.run}: not refined yet")
        return o.file.revision(int(refined["revisions"][-1]))

    def _calibration(self, o: Campaign) -> tuple[Calibration, RevisionRecord]:
        record = self._record(o)
        return o.calibration(record.number), record

    def _readings(self, o: Campaign, record: RevisionRecord, file: CampaignFile) -> Readings:
        """Return the readings of another file with the covariance that the fit takes them for."""
        model, _ = o.restore_model(record)
        known = (True,) * len(model.cell.known_targets)
        cell = replace(model.cell, registration_known=True)
        cell = cell.with_targets(cell.all_targets, known)
        found = full_readings(file.readings(), file.about(COVERS), cell, o.config)
        scatter = record.parameters_json.get("arm_scatter")
        if scatter is None:
            return found
        return with_arm_scatter(cell, found, ArmScatter.from_json(scatter))

    def _create(self, path: Path, purpose: str, plan: Plan, o: Campaign) -> None:
        more = {
            PURPOSE: purpose,
            CALIBRATION: identity(self.run),
            COVERS: o.file.about(COVERS) or INSTRUMENT,
        }
        config = CellConfig.from_json(o.file.config_json)
        source = self._source(f"{purpose} campaign of {self.run.name}, ")
        create_run(path, config, self.base_dir, plan, source=source, more=more).close()

    def _source(self, what: str = "") -> str:
        how = "measured" if self.settings.hide is None else "rehearsed in a simulated cell"
        return f"{what}{how} by hilcal calibrate"


def with_origin(chosen: Planned) -> Plan:
    """Return a plan that says where it is from."""
    return replace(chosen.ordered.plan, about={**about(chosen), "remarks": list(remarks(chosen))})


def checked_plan(
    cell: Cell,
    config: CellConfig,
    poses: int,
    rng: np.random.Generator,
    catalogue: Catalogue,
    say: Say,
) -> CheckedPlan:
    """Choose a plan of so many poses, each under every load that it bears; check all motions."""
    chosen = make(cell, config, Request(poses), rng, None, say, catalogue)
    summary = summarise(chosen, config, rng, say, compare=False)
    say("checking every motion in a dry run")
    return checked(cell, config, with_origin(chosen), summary)


def continued(run: Path, cell: Cell, config: CellConfig, catalogue: Catalogue) -> Procedure:
    """Return a calibration as its campaign file has it."""
    with CampaignFile.open(run, read_only=True) as campaign:
        settings, base_dir = settings_of(campaign), cell.base_dir.absolute()
        check_same_cell(campaign, config, base_dir)
    return Procedure(run, cell, config, base_dir, catalogue, settings)
