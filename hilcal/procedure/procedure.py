"""The steps of a calibration: each reads what the files hold, does one thing, and appends it.

    plan ─► measure ─► refine ─► decide ─► plan_validation ─► measure_validation ─► validate
               ▲                    │                                                  │
               └── a further plan ──┘          compare ◄─ measure_corrected ◄─ correct ◄─┘

A step that was cut short has either appended all of its result or nothing; readings are stored one
by one. So the next step follows from the files (`state.next_step`), whatever has stopped the one
before, and nothing is measured twice.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.checked_plan import CheckedPlan, checked
from hilcal.design.planner import Request, make
from hilcal.design.summary import about, remarks, summarise
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.present.progress import Say
from hilcal.procedure.decision import Decision, PredictedError, decide, predicted_error
from hilcal.procedure.shared import reference_of
from hilcal.procedure.state import (
    BEGUN,
    DECIDED,
    MEASURE,
    REFINED,
    STOP,
    ProcedureStep,
    Settings,
    next_step,
    settings_of,
)
from hilcal.procedure.validation_steps import ValidationSteps
from hilcal.readings.covariance import COVERS, INSTRUMENT
from hilcal.refinement import Refinement, refine
from hilcal.refinement import RefinementStep as RefinementStep
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan
from hilcal.store.procedure_log import ENTRY, ProcedureLog, entry
from hilcal.store.run_log import PLAN, RunLog, check_same_cell, create_run

Measure = Callable[[CampaignFile, float | None], None]
"""Measures what is missing of a campaign's plan and stores it there; the time of day, s, that its
time counts from is given where it is not its own."""

_FIRST, _FURTHER = 0, 1
"""Streams of random numbers; those of the steps that test follow."""


@dataclass(frozen=True, eq=False)
class Procedure(ValidationSteps):
    """A calibration in a cell.

    >>> p = hc.Procedure.at("new.hilcal", hc.Cell.load(CELL), poses=6)
    >>> p.next().kind
    'plan'

    Its attributes are those of `Shared`.
    """

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

        Raises:
            InputError: the campaign is of another cell, or not of a calibration.
        """
        path, config, known = Path(run), cell.configured(), catalogue or installed()
        if path.exists():
            there = continued(path, cell, config, known)
            return replace(there, settings=replace(there.settings, **asked))
        readings = config.planning.readings if config.loads else "absolute"
        usual = Settings(seed=config.simulation.seed, readings=readings)
        return cls(path, cell, config, cell.base_dir.absolute(), known, replace(usual, **asked))

    def next(self) -> ProcedureStep:
        """Return the next step."""
        return next_step(self.run)

    # the first plan

    def plan(self, say: Say = lambda words: None) -> CheckedPlan:
        """Choose the first plan; nothing is stored yet.

        Raises:
            InputError: numbers or names that cannot be.
            CannotAnswerError: the cell leaves too few poses.
        """
        rng, config = self._rng(_FIRST), self._planned()
        chosen = make(
            self.cell, config, Request(self.settings.poses), rng, None, say, self.catalogue
        )
        plan = replace(
            chosen.ordered.plan, about={**about(chosen), "remarks": list(remarks(chosen))}
        )
        summary = summarise(chosen, config, rng, say, compare=False)
        say("checking every motion in a dry run")
        return checked(self.cell, config, plan, summary)

    def begin(self, plan: Plan, config: CellConfig, *, covers: str = INSTRUMENT) -> None:
        """Make the campaign file with its first plan.

        Args:
            plan: the plan.
            config: the configuration that the file holds, with the devices that are used.
            covers: what the covariance of the readings will cover.

        Raises:
            InputError: it cannot be written, or is there already.
        """
        self.check_files()
        first = entry(BEGUN, {"settings": self.settings.to_json()})
        more = {COVERS: covers, ENTRY.format(1): first}
        create_run(self.run, config, self.base_dir, plan, source=self._source(), more=more).close()

    def check_files(self) -> None:
        """Refuse files of another calibration where those of this one will be.

        Raises:
            InputError: one is there.
        """
        for path in (self.files.validation, self.files.corrected):
            if path.exists():
                raise InputError(
                    f"{path}: the file exists, and {self.run} does not; rename or move it away"
                )

    def resume(self, campaign: CampaignFile) -> None:
        """Keep what is asked for in the log of the campaign.

        Raises:
            InputError: the campaign is of another cell.
        """
        check_same_cell(campaign, self.config, self.base_dir)
        log = ProcedureLog(campaign)
        told = self.settings.to_json()
        before = log.last(BEGUN)
        if before is None or before["settings"] != told:
            log.append(BEGUN, {"settings": told})

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
        """Store the revisions of a refinement; returns their numbers.

        Raises:
            InputError: it is of other readings than those of the campaign.
        """
        records = [
            o.record(step.fit, step.diagnosis, step.added, step.removed) for step in found.steps
        ]
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
            found = decide(
                self.cell, self._planned(), self.settings, d, run.plans, reference, rng, say
            )
            content = found.to_json()
            if found.measures and found.plan is not None:
                plan = run.with_new_names(found.plan)  # `run` checks every motion of it
                log.append(DECIDED, {"action": MEASURE, **content}, plan=plan)
            else:
                log.append(DECIDED, {"action": STOP, **content})
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


def continued(run: Path, cell: Cell, config: CellConfig, catalogue: Catalogue) -> Procedure:
    """Return a calibration as its campaign file has it.

    Raises:
        InputError: the campaign is of another cell, or not of a calibration.
    """
    with CampaignFile.open(run, read_only=True) as campaign:
        settings, base_dir = settings_of(campaign), cell.base_dir.absolute()
        check_same_cell(campaign, config, base_dir)
    return Procedure(run, cell, config, base_dir, catalogue, settings)
