"""The steps of a calibration: each reads the files, does one thing, and appends the result.

    plan ─► measure ─► refine ─► decide ─► plan_validation ─► measure_validation ─► validate
               ▲                    │                                                  │
               └── a further plan ──┘          compare ◄─ measure_corrected ◄─ correct ◄─┘

An interrupted step has appended either all of its result or nothing; readings are stored one by
one. So the next step follows from the files (`state.next_step`) after any stop, and nothing is
measured twice.

The validation campaign is a separate file. Its hash enters the calibration's log before any of its
readings is predicted; from then on the file must not change.
"""

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.improvement import Improvement, improvement
from hilcal.calibration.measured import with_mean_temperatures
from hilcal.campaign.campaign import Campaign
from hilcal.campaign.posteriors import load_prior
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.planner import Planned, PlanRequest, plan_readings
from hilcal.design.summary import CheckedPlan, about, checked, remarks, summarise
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError, expect
from hilcal.identification.baseline import baseline
from hilcal.identification.carried.carried_prior import CarriedPrior
from hilcal.identification.noise.arm_scatter import with_arm_scatter
from hilcal.identification.noise.full_covariance import full_readings
from hilcal.identification.prediction import validation
from hilcal.identification.prediction.validation import Acceptance, acceptance, extrapolation
from hilcal.names import quoted
from hilcal.present.progress import Say
from hilcal.procedure import state
from hilcal.procedure.next_plan import Decision, FurtherMeasuring, PredictedError, predicted_error
from hilcal.procedure.validation_plan import corrected_plan, paired, validation_plan
from hilcal.readings.covariance import COVERS_KEY, INSTRUMENT
from hilcal.readings.readings import TEMPERATURES, ArmScatter, Readings
from hilcal.readings.same_readings import found_among
from hilcal.readings.whitening import usual_mode
from hilcal.refinement import Refinement, refine
from hilcal.refinement import RefinementStep as RefinementStep
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import LEFT_OUT, REFERENCE, REFERENCE_POSITION, Plan, read_plan
from hilcal.store.procedure_log import (
    CALIBRATION,
    CORRECTED,
    ENTRY,
    IMPROVED,
    PURPOSE,
    VALIDATION,
    ProcedureLog,
    entry,
)
from hilcal.store.revision import RevisionRecord
from hilcal.store.rows import content_hash
from hilcal.store.run_log import (
    PLAN,
    REHEARSED,
    SERIAL_NUMBER,
    RunLog,
    check_same_cell,
    create_run,
)

Measure = Callable[[CampaignFile, float | None], None]
"""Measures and stores the missing readings of a campaign's plan. The second argument is the wall
time at zero of the campaign's time, s; None: the campaign's own start."""

_FIRST, _FURTHER, _VALIDATING, _CORRECTING = range(4)
"""Streams of random numbers."""


@dataclass(frozen=True, eq=False)
class Procedure:
    """A calibration in a cell.

    >>> p = hc.Procedure.at("new.hilcal", hc.Cell.load(CELL), poses=6)
    >>> p.next().kind
    'plan'
    """

    run: Path  # the campaign file that is fitted; the others are in the same directory
    cell: Cell  # as configured
    catalogue: Catalogue  # the effects that a model can have
    settings: state.Settings  # goals, sizes and seed
    prior: CarriedPrior | None = None  # the prior of every fit, from `settings.prior`
    _refinements: list[Refinement] = field(default_factory=list, repr=False)  # the latest, if any

    @property
    def config(self) -> CellConfig:
        """The configuration of the cell."""
        return self.cell.configured()

    @property
    def clock(self) -> float:
        """Cell seconds per real second; in a rehearsal that of the simulated devices."""
        rehearsed = self.settings.hide is not None
        return self.config.simulation.clock if rehearsed else self.config.clock

    @classmethod
    def at(
        cls, run: str | Path, cell: Cell, catalogue: Catalogue | None = None, **options: Any
    ) -> "Procedure":
        """Begin a calibration, or resume that of an existing campaign file.

        The options are fields of `Settings`; by default those of the existing calibration. `prior`
        is the path of a campaign or posterior.
        """
        path, config, effects = Path(run), cell.configured(), catalogue or installed()
        stated = options.get("prior") is not None
        if stated:
            expect(options["prior"], (str, Path), "prior", "the path of a campaign or posterior")
            options["prior"] = str(Path(options["prior"]).absolute())
        if path.exists():
            begun = continued(path, cell, effects)
        else:
            default = state.Settings(seed=config.simulation.seed, readings=config.readings_mode)
            begun = cls(path, cell, effects, default)
        return replace(begun, settings=replace(begun.settings, **options)).with_prior(stated)

    def with_prior(self, stated: bool) -> "Procedure":
        """Return it with the prior that its settings name, if the campaign may still be fitted.

        Raises:
            InputError: no posterior; or a file elsewhere that nobody stated but the campaign.
        """
        prior = self.settings.prior
        if prior is None or self.files.validation.exists():
            return self
        if not stated and Path(prior).parent != self.run.absolute().parent:
            raise InputError(
                f"{self.run}: its prior is {prior!r}; a file that a campaign names is read from "
                f"the campaign's folder only; confirm it with: --prior {quoted(prior)}"
            )
        return replace(self, prior=load_prior(Path(prior), self.catalogue))

    @property
    def files(self) -> state.Files:
        """All files of the calibration."""
        return state.Files(self.run)

    def record(self) -> RevisionRecord:
        """Return the revision that the last refinement ended with."""
        with Campaign.open(self.run, self.catalogue, read_only=True) as o:
            return self._record(o)

    def next(self) -> state.ProcedureStep:
        """Return the next step."""
        return state.next_step(self.run)

    def plan(self, say: Say = lambda text: None) -> CheckedPlan:
        """Choose the first plan, unstored; a CannotAnswerError for a cell with too few poses."""
        rng, cell = self._rng(_FIRST), self._planned()
        return checked_plan(cell, self.settings.poses, rng, self.catalogue, say)

    def begin(self, plan: Plan, config: CellConfig, *, covers: str = INSTRUMENT) -> None:
        """Make the campaign file with its first plan.

        `config` is stored in it, with the devices that are used; `covers` is what the covariance of
        the readings will cover.
        """
        self.check_files()
        first = entry(state.BEGUN, {"settings": self.settings.to_json()})
        texts = {COVERS_KEY: covers, ENTRY.format(1): first}
        create_run(
            self.run, config, self.cell.base_dir, plan, source=self._source(), more_texts=texts
        ).close()

    def check_files(self) -> None:
        """Refuse existing files under the names of this calibration's test campaigns."""
        for path in (self.files.validation, self.files.corrected):
            if path.exists():
                raise InputError(
                    f"{path}: the file exists, and {self.run} does not; rename or move it away"
                )

    def resume(self, campaign: CampaignFile) -> None:
        """Store the settings in the campaign's log, where they have changed."""
        check_same_cell(campaign, self.config, self.cell.base_dir)
        log, settings = ProcedureLog(campaign), self.settings.to_json()
        stored = log.last(state.BEGUN)
        if stored is None or stored["settings"] != settings:
            log.append(state.BEGUN, {"settings": settings})

    def measure(self, step: state.ProcedureStep, measure: Measure) -> int:
        """Measure the missing readings of a plan; return the number that its campaign then holds.

        After a DeviceError or a KeyboardInterrupt, the readings so far are stored.
        """
        epoch = None if step.path == self.run else self._epoch()
        with CampaignFile.open(step.path) as campaign:
            measure(campaign, epoch)
            return campaign.n_readings

    def _epoch(self) -> float | None:
        """Return the wall time at zero of the campaign's time, s; None where unknown.

        It is that of the last reading of these campaigns, as a clock may have been set meanwhile;
        after one that was set back the time goes on from that reading.
        """
        last: dict[str, Any] = {}
        for path in (self.run, self.files.validation):
            if path.exists():
                with CampaignFile.open(path, read_only=True) as campaign:
                    if campaign.about(PLAN) is not None:
                        last = next(reversed(RunLog(campaign).details()), last)
        wall, elapsed = last.get("wall_s"), last.get("time_s")
        if wall is None or elapsed is None:  # not of a session
            return last.get("epoch_wall_s")
        return float(min(wall, time.time()) - elapsed / self.clock)

    def refine(
        self,
        say: Say = lambda text: None,
        on_step: Callable[[int, RefinementStep], None] = lambda number, step: None,
    ) -> Refinement:
        """Fit, diagnose, and change the model until it is adequate; all revisions are stored.

        `on_step` is called with each revision's number and step as soon as it is
        diagnosed. Raises CannotAnswerError where the readings do not determine the baseline.
        """
        with Campaign.open(self.run, self.catalogue) as o:
            mode = usual_mode(o.readings, self.settings.readings)
            say("registering")
            model = baseline(o.cell, o.readings, mode, o.catalogue, self.prior)
            numbers = itertools.count(len(o.file.revisions()) + 1)
            refinement = refine(
                model, o.readings, mode, say, on_step=lambda step: on_step(next(numbers), step)
            )
            say("computing standard uncertainties")
            self.keep(o, refinement)
        return refinement

    def keep(self, o: Campaign, refinement: Refinement) -> tuple[int, ...]:
        """Store the revisions of a refinement; return their numbers."""
        records = [o.record(s.fit, s.diagnosis, s.added, s.removed) for s in refinement.steps]
        fitted = {"readings_sha256": o.data_hash, "prior": self.settings.prior}
        content = {**fitted, "verdict": refinement.verdict}
        self._refinements[:] = [refinement]
        return ProcedureLog(o.file).append(state.REFINED, content, revisions=records)

    def decide(self, say: Say = lambda text: None) -> Decision:
        """Decide whether to measure more; a further plan is appended to the campaign."""
        with Campaign.open(self.run, self.catalogue) as o:
            o.file.measure_alone()  # two that decide at once would append two plans
            log, run = ProcedureLog(o.file), RunLog(o.file)
            if self._refinements:
                d = self._refinements[0].diagnosis
            else:
                record = self._record(o)
                say(f"diagnosing revision {record.number}")
                d = diagnose(o.restore(record), o.history(record.number), say)
            rng = self._rng(_FURTHER, len(run.plans))
            cell, settings = self._planned(), self.settings
            decision = FurtherMeasuring(cell, settings, d, run.plans, rng, say).decide()
            plan = decision.plan if decision.measures else None
            if plan is not None:
                plan = run.with_new_names(plan)  # `run` checks every motion of it
            action = state.STOP if plan is None else state.MEASURE
            log.append(state.DECIDED, {"action": action, **decision.to_json()}, plan=plan)
        return decision

    def stop(self) -> None:
        """Stop measuring: the last refinement will be tested."""
        with CampaignFile.open(self.run) as campaign:
            ProcedureLog(campaign).append(state.DECIDED, {"action": state.STOP, "reason": "asked"})

    def compute(self, step: state.ProcedureStep, say: Say = lambda text: None) -> object:
        """Do a step in which nothing moves, other than "plan"; return its result."""
        result: object = getattr(self, step.kind)(say)
        return result

    def predicted(self) -> PredictedError:
        """Predict the error after compensation with the last model."""
        with Campaign.open(self.run, self.catalogue, read_only=True) as o:
            calibration, record = self._calibration(o)
            return predicted_error(calibration, o.fitted_readings(record).states, self.config)

    def plan_validation(self, say: Say = lambda text: None) -> Plan:
        """Choose poses and loads of the validation campaign, and make its file."""
        with Campaign.open(self.run, self.catalogue, read_only=True) as o:
            say("restoring the model")
            calibration, record = self._calibration(o)
            fitted, rng = o.fitted_readings(record), self._rng(_VALIDATING)
            reference = state.reference_in(o.file)
            plan = validation_plan(
                self.cell, calibration, fitted, reference, self.settings, rng, say
            )
            self._create(self.files.validation, VALIDATION, plan, o)
        return plan

    def validate(self, say: Say = lambda text: None) -> Acceptance:
        """Freeze the validation campaign, and predict its readings."""
        with self._frozen() as (o, unseen):
            record = self._record(o)
            fitted = o.fitted_readings(record)
            readings = self._readings(o, record, unseen)
            if found_among(readings, fitted).any():
                raise InputError(
                    f"{unseen.path}: some of its readings were fitted by revision "
                    f"{record.number} of {self.run}; they test nothing"
                )
            say(f"predicting {len(readings)} readings")
            model, theta = o.restore_model(record)
            mode = usual_mode(fitted, self.settings.readings)
            prediction = validation.validate(model, theta, fitted, readings, mode)
            beyond = extrapolation(o.predictive(record, model, theta), fitted, prediction)
            shares = acceptance(prediction, beyond)
            total = shares.everything
            content = {"revision": record.number, "error": prediction.error.to_json()}
            content |= {"noise_floor_m": prediction.noise_floor, "stated_m": total.stated_m}
            ProcedureLog(o.file).append(state.VALIDATED, {**content, "within": total.within})
        return shares

    @contextmanager
    def _frozen(self) -> Iterator[tuple[Campaign, CampaignFile]]:
        """Open the campaign and its validation; record the latter's hash, or refuse another one."""
        with (
            Campaign.open(self.run, self.catalogue) as o,
            state.opened(self.files.validation, VALIDATION, self.run) as unseen,
        ):
            log, readings = ProcedureLog(o.file), unseen.readings()
            frozen, hashed = log.last(state.FROZEN), content_hash(readings)
            if frozen is None:
                content = {"file": unseen.path.name, "readings_sha256": hashed}
                log.append(state.FROZEN, {**content, "readings": len(readings)})
            elif frozen["readings_sha256"] != hashed:
                raise InputError(
                    f"{unseen.path}: other readings than when it was frozen "
                    f"(SHA-256 {frozen['readings_sha256'][:12]}…, now {hashed[:12]}…)"
                )
            yield o, unseen

    def correct(self, say: Say = lambda text: None) -> Plan:
        """Correct the joint targets of the validation poses, and make the campaign for them."""
        with self._frozen() as (o, unseen):
            say("restoring the model")
            calibration, record = self._calibration(o)
            readings = self._readings(o, record, unseen)
            measured_plan = read_plan(unseen.about(PLAN) or "", f"{unseen.path}, its plan")
            reference, rng = state.reference_of(measured_plan), self._rng(_CORRECTING)
            plan = corrected_plan(self.cell, calibration, readings, reference, rng, say)
            self._create(self.files.corrected, CORRECTED, plan, o)
        return plan

    def compare(self, say: Say = lambda text: None) -> Improvement:
        """Compare the measured errors at uncorrected and corrected joint targets."""
        corrected_run = state.opened(self.files.corrected, CORRECTED, self.run)
        with self._frozen() as (o, unseen), corrected_run as moved:
            say("comparing errors before and after")
            calibration, record = self._calibration(o)
            first, last = (self._readings(o, record, file) for file in (unseen, moved))
            uncorrected, corrected = paired(first, last, calibration.mode)
            listed = RunLog(moved).plans[-1].about.get(LEFT_OUT, [])
            left_out = [(x["point"], x["why"]) for x in listed if x["point"] != REFERENCE]
            p = o.predictive(record, *o.restore_model(record))
            gain = improvement(calibration, p, uncorrected, corrected, uncorrected.states, left_out)
            log = ProcedureLog(o.file)
            if log.last(IMPROVED) is None:
                content = {"revision": record.number, "readings_sha256": moved.data_hash()}
                log.append(IMPROVED, {**content, **gain.to_dict()})
        return gain

    def _rng(self, *stream: int) -> np.random.Generator:
        return np.random.default_rng([self.settings.seed, *stream])

    def _planned(self) -> Cell:
        """Return the cell for planning, with the kind of readings that is fitted."""
        config = self.config.with_keys("planning", readings=self.settings.readings)
        return self.cell.with_config(config)

    def _record(self, o: Campaign) -> RevisionRecord:
        refined = ProcedureLog(o.file).last(state.REFINED)
        if refined is None:
            raise InputError(f"{self.run}: not refined yet")
        return o.file.revision(int(refined["revisions"][-1]))

    def _calibration(self, o: Campaign) -> tuple[Calibration, RevisionRecord]:
        record = self._record(o)
        return o.calibration(record.number), record

    def _readings(self, o: Campaign, record: RevisionRecord, file: CampaignFile) -> Readings:
        """Return the readings of another file, with their covariance by the fit of a revision.

        Temperatures that they lack and that the model may need are the means of the fitted ones.
        """
        model, _ = o.restore_model(record)
        all_known = (True,) * len(model.cell.known_targets)
        cell = replace(model.cell, registration_known=True)
        cell = cell.with_targets(cell.all_targets, all_known)
        readings = full_readings(
            file.readings(), file.about(COVERS_KEY), cell.with_config(o.config)
        )
        scatter = record.parameters_json.get("arm_scatter")
        if scatter is not None:
            readings = with_arm_scatter(cell, readings, ArmScatter.from_json(scatter))
        fitted = o.fitted_readings(record).states
        kinds = [
            [getattr(s, n) is not None for n in TEMPERATURES] for s in (fitted, readings.states)
        ]
        if kinds[0] == kinds[1]:
            return readings
        return with_mean_temperatures(readings, self._calibration(o)[0].conditions)

    def _create(self, path: Path, purpose: str, plan: Plan, o: Campaign) -> None:
        covers = o.file.about(COVERS_KEY) or INSTRUMENT
        texts = {PURPOSE: purpose, CALIBRATION: state.identity(self.run), COVERS_KEY: covers}
        if o.file.about(PLAN) is not None:  # measured with `run`
            texts[SERIAL_NUMBER] = RunLog(o.file).serial_number()
        config, readings = CellConfig.from_json(o.file.config_json), o.file.readings()
        at_reference = np.array(readings.pose_names)[readings.pose] == REFERENCE
        if (unloaded := at_reference & readings.unloaded).any():
            position = readings.value[unloaded][-1, :3]
            plan = replace(plan, about={**plan.about, REFERENCE_POSITION: position.tolist()})
        source = self._source(f"{purpose} campaign of {self.run.name}, ")
        create_run(path, config, self.cell.base_dir, plan, source=source, more_texts=texts).close()

    def _source(self, prefix: str = "") -> str:
        origin = "measured" if self.settings.hide is None else REHEARSED
        return f"{prefix}{origin} by hilcal calibrate"


def with_origin(chosen: Planned) -> Plan:
    """Return a plan with its origin and remarks."""
    return replace(chosen.ordered.plan, about={**about(chosen), "remarks": list(remarks(chosen))})


def checked_plan(
    cell: Cell,
    poses: int,
    rng: np.random.Generator,
    catalogue: Catalogue,
    say: Say,
) -> CheckedPlan:
    """Choose a plan, each pose under every load that it bears; check all motions."""
    chosen = plan_readings(cell, PlanRequest(poses), rng, None, say, catalogue)
    summary = summarise(chosen, cell.configured(), rng, say, compare=False)
    say("checking every motion in a dry run")
    return checked(cell, with_origin(chosen), summary)


def continued(run: Path, cell: Cell, catalogue: Catalogue) -> Procedure:
    """Return the calibration of a campaign file, with the file's settings."""
    with CampaignFile.open(run, read_only=True) as campaign:
        settings = state.settings_of(campaign)
        check_same_cell(campaign, cell.configured(), cell.base_dir)
    return Procedure(run, cell, catalogue, settings)
