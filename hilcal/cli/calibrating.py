"""`calibrate`: one command from the plan to the measured improvement."""

import shlex
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hilcal.cell import Cell, cell_from_config
from hilcal.cli.options import POSES, command
from hilcal.cli.planning import answers_of, refuse_unready
from hilcal.cli.running import measure
from hilcal.cli.showing import live_viewer
from hilcal.cli.simulating import lasting_cell, retry_after_failures
from hilcal.cli.terminal import Terminal, confirmed, person_present
from hilcal.config import CellConfig
from hilcal.design.nominal_model import check_effects
from hilcal.drivers.simulated.rehearsal import NO_EFFECT, program_config
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import (
    CannotAnswerError,
    HilcalError,
    InputError,
    LimitError,
    MovedFileError,
    StoppedError,
)
from hilcal.measuring.connect import drivers_of, with_kinematics
from hilcal.measuring.run import HOW_ON
from hilcal.present import calibration as words
from hilcal.present.diagnosis import verdict_line
from hilcal.present.live_viewer import LiveViewer
from hilcal.present.plan import plan_facts
from hilcal.present.progress import working
from hilcal.present.story import chapters_of, errors_by_revision, prior_report
from hilcal.procedure.procedure import Procedure, continued
from hilcal.procedure.state import DECIDED, REFINED, VALIDATED, ProcedureStep, Settings
from hilcal.readings.whitening import Mode
from hilcal.store.campaign_file import CampaignFile, may_write
from hilcal.store.procedure_log import ProcedureLog
from hilcal.store.run_log import RunLog, changed_since_begun
from hilcal.tables.units import parse_duration, parse_length

VALIDATION = 20  # Poses of a validation campaign; a choice: they determine the mean error to 10 %
TOO_LATE = (
    ("--poses", "poses"),
    ("--goal", "goal_m"),
    ("--max-time", "max_time_s"),
    ("--validation", "validation"),
    ("--prior", "prior"),
)
"""Options without effect: the first once a campaign exists, all once its validation is planned."""
DEFAULT_MAX_TIME = "2 h"  # Longest time for measuring; a choice


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """Goals and sizes of a calibration."""

    goal: str | None = None
    limit: str | None = None
    max_time: str | None = None
    poses: int | None = None
    validation: int | None = None
    prior: Path | None = None

    def settings(self) -> dict[str, Any]:
        """Return the stated options as settings of the procedure."""
        for name, count in (("--poses", self.poses), ("--validation", self.validation)):
            if count is not None and count < 1:
                raise InputError(f"{name} {count}; valid: a whole number from 1")
        stated = {
            "goal_m": None if self.goal is None else parse_length(self.goal, "--goal"),
            "limit_m": None if self.limit is None else parse_length(self.limit, "--limit"),
            "max_time_s": None
            if self.max_time is None
            else parse_duration(self.max_time, "--max-time"),
            "poses": self.poses,
            "validation": self.validation,
            "prior": self.prior and str(self.prior.absolute()),
        }
        return {key: value for key, value in stated.items() if value is not None}


DEFAULT_OPTIONS = CalibrationOptions()


@command(f"""
    output | -o --output RUN.hilcal | The campaign file; RUN.validation.hilcal and
        RUN.corrected.hilcal are written to the same folder.
    resume | --resume | Continue the calibration in RUN.hilcal, after any stop.
    skip | --skip POSE | With --resume: omit a pose that cannot be measured; repeatable.
    goal | --goal LENGTH | Target position error, e.g. "0.1 mm", for absolute readings: more is
        measured until 95 % of points are predicted to be within it after compensation, or until
        more readings would not help.
    limit | --limit LENGTH | Largest measured error allowed at the corrected targets; exit 5 if it
        is exceeded.
    max_time | --max-time TIME | Longest total time for the readings that are fitted; default
        "{DEFAULT_MAX_TIME}".
    poses | --poses | Number of poses of the first plan; default {POSES}.
    validation | --validation | Number of poses of the validation campaign; default {VALIDATION}.
    rehearse | --rehearse | Do all steps in a simulated cell.
    yes | --yes -y | Move the arm without asking; for scripts.
    """)
def calibrate(
    t: Terminal, catalogue: Catalogue, cell: Path, output: Path, resume: bool = False,
    skip: list[str] | None = None, options: CalibrationOptions = DEFAULT_OPTIONS,
    rehearse: bool = False, yes: bool = False, view: bool = False,
    effects_from: list[Path] | None = None,
) -> None:  # fmt: skip
    """Plan, measure, fit, measure what is in doubt, validate, correct, and measure the gain."""
    robot_cell = Cell.load(cell)
    config = robot_cell.configured()
    settings = options.settings()
    if config.limits.accuracy_m is not None and not resume:
        settings.setdefault("limit_m", config.limits.accuracy_m)
    line = ["hilcal", "calibrate", str(cell), "-o", str(output)]
    flags = ["--rehearse"] * rehearse + ["--yes"] * yes + ["--view"] * view
    flags += [] if options.prior is None else ["--prior", str(options.prior)]
    flags += [word for path in effects_from or () for word in ("--effects-from", str(path))]
    start, go_on = (shlex.join([*line, *more, *flags]) for more in ([], ["--resume"]))
    p = _procedure(t, cell, output, resume, rehearse, robot_cell, catalogue, settings, go_on)
    if not (yes or rehearse or person_present(t)) and p.next().kind != "done":
        raise InputError(
            "nobody can be asked before the arm moves; give --yes, or run it at a terminal"
        )
    if skip:
        step = p.next()
        if not (resume and step.moves):
            raise InputError("--skip omits poses that --resume would measure; none is missing")
        with CampaignFile.open(step.path) as campaign:
            RunLog(campaign).skip(skip)
    if not (rehearse or output.exists()):
        drivers_of(config)  # refuses a cell without them before anything is planned
    with _explained(p, start, go_on), ExitStack() as stack:
        live = stack.enter_context(live_viewer(t, view, output))
        CalibrationOperator(t, p, stack, rehearse, yes, live).run_steps()
        with working(t.progress) as say:
            improvement = p.compare(say)
    limit_m, files = p.settings.limit_m, p.files
    t.show(words.step_heading(ProcedureStep("compare", output)))
    t.show(words.improvement_report(improvement, limit_m))
    if improvement.refuted:
        t.show("What has changed since is told by:")
        t.command(shlex.join(["hilcal", "compare", str(output), str(files.validation)]))
    t.show(
        f"\nThe calibration is in {output}, its tests are in {files.validation.name} and "
        f"{files.corrected.name}. To correct points and programs:"
    )
    t.command(shlex.join(["hilcal", "compensate", str(output), "POINTS"]))
    t.show("To write a report as one HTML page that begins with a certificate:")
    t.command(shlex.join(["hilcal", "report", str(output), "--operator", "NAME"]))
    failed: HilcalError | None = None
    if limit_m is not None and improvement.over(limit_m):
        failure = words.limit_failure(improvement, limit_m)
        undecided = limit_m < improvement.everything.noise_m
        failed = CannotAnswerError(failure) if undecided else LimitError(failure)
    t.document({**_document(p), "improvement": improvement.to_dict(), "limit_m": limit_m}, failed)


@contextmanager
def _explained(p: Procedure, start: str, go_on: str) -> Iterator[None]:
    """Add to errors what is stored, and the command that starts again or goes on."""

    def safe() -> str:
        if not p.run.exists():
            return f"{p.run} does not exist; start again with: {start}"
        return f"everything measured so far is safe; go on with: {go_on}"

    try:
        yield
    except KeyboardInterrupt:
        raise StoppedError(f"interrupted: nothing moves; {safe()}") from None
    except (InputError, LimitError):
        raise
    except HilcalError as error:
        message = str(error).removesuffix(HOW_ON).rstrip(". ")
        moved = isinstance(error, MovedFileError)
        advice = f"then go on with: {go_on}" if moved else safe()
        raise type(error)(f"{message}; {advice}") from error


def _procedure(
    t: Terminal,
    path: Path,
    output: Path,
    resume: bool,
    rehearse: bool,
    cell: Cell,
    catalogue: Catalogue,
    stated: dict[str, Any],
    go_on: str,
) -> Procedure:
    config = cell.configured()
    hide = (config.simulation.hide or NO_EFFECT) if rehearse else None
    if rehearse:
        config = program_config(config, hide or NO_EFFECT, catalogue)
        cell = cell_from_config(config, cell.base_dir)
    if not output.exists():
        may_write(output, False)
        check_effects(cell, catalogue)
        if resume:
            t.notice(f"{output} does not exist yet: the calibration starts")
        _refuse_goal(config.readings_mode, stated, path)
        max_time_s, seed = parse_duration(DEFAULT_MAX_TIME, "--max-time"), config.simulation.seed
        defaults = Settings(POSES, VALIDATION, max_time_s, seed=seed)
        settings = replace(defaults, readings=config.readings_mode, hide=hide, **stated)
        p = Procedure(output, cell, catalogue, settings)
        p.check_files()
        return p.with_prior("prior" in stated)
    p = continued(output, cell, catalogue)
    if (p.settings.hide is not None) != rehearse:
        kind = "no rehearsal; leave --rehearse out" if rehearse else "a rehearsal; give --rehearse"
        raise InputError(f"{output}: its calibration is {kind}")
    if not resume:
        message = f"{output}: holds a calibration already, {words.state_clause(p.next())}"
        raise InputError(f"{message}; go on with: {go_on}")
    _refuse_goal(p.settings.readings, stated, path)
    too_late = TOO_LATE if p.files.validation.exists() else TOO_LATE[:1]
    for option, key in too_late:
        current = getattr(p.settings, key)
        if stated.get(key, current) != current:
            raise InputError(
                f"{option} comes too late: the measurements that it decides are planned already; "
                "leave it out, or calibrate into another file"
            )
    p = replace(p, settings=replace(p.settings, **stated)).with_prior("prior" in stated)
    with CampaignFile.open(output) as campaign:
        campaign.measure_alone()  # nobody else measures
        p.resume(campaign)
        for text in changed_since_begun(campaign, p.config):
            t.notice(f"note: {text}")
    t.notice(f"{output}: a calibration, {words.state_clause(p.next())}")
    return p


def _refuse_goal(kind: Mode, stated: dict[str, Any], cell: Path) -> None:
    """Refuse a position error as the goal of deflections, which do not show it."""
    if kind == "deflection" and "goal_m" in stated:
        raise InputError(
            "--goal is a position error, which deflections do not show: set "
            f'[planning] readings = "absolute" in {cell}, or leave out --goal'
        )


def _document(p: Procedure) -> dict[str, object]:
    with CampaignFile.open(p.run, read_only=True) as campaign:
        log, run = ProcedureLog(campaign), RunLog(campaign)
        refined, validated = log.last(REFINED) or {}, log.last(VALIDATED) or {}
        decisions = [entry for entry in log.entries() if entry["kind"] == DECIDED]
        readings, plans = campaign.n_readings, len(run.plans)
    return {
        "campaign": str(p.run),
        "validation_campaign": str(p.files.validation),
        "corrected_campaign": str(p.files.corrected),
        "rehearsed": p.settings.hide is not None,
        "readings": readings,
        "plans": plans,
        "revision": refined.get("revisions", [None])[-1],
        "verdict": refined.get("verdict"),
        "decisions": decisions,
        "validation": {k: v for k, v in validated.items() if k not in ("kind", "utc")},
    }


@dataclass(slots=True)
class CalibrationOperator:
    """Carries out the steps of a calibration; asks before the arm moves."""

    t: Terminal
    p: Procedure
    stack: ExitStack
    rehearse: bool
    yes: bool
    viewer: LiveViewer | None = None
    simulated: CellConfig | None = None  # of simulated devices, once they run
    ready: bool = False  # whether every device has reported that it is ready

    def run_steps(self) -> None:
        """Do all remaining steps up to the comparison."""
        while (step := self.p.next()).kind not in ("done", "compare"):
            self.t.show(words.step_heading(step, self.p.clock))
            if step.moves:
                self._moving(step)
            else:
                self._computing(step)

    def _moving(self, step: ProcedureStep) -> None:
        if not self.ready and not self.rehearse:  # every device is asked once
            answers = with_kinematics(answers_of(self.t, self.p.config), self.p.cell)
            for a in answers:
                name = "no answer" if a.report is None else a.report.name
                self.t.show(f"{a.device}: {name}, {'; '.join(a.problems) or 'ready'}")
            # a tracker that has lost its target searches for it before the first motion
            refuse_unready(tuple(a for a in answers if a.device != "tracker" or a.report is None))
            self.ready = True
        if not self.yes and person_present(self.t):
            warning = "The simulated arm will move." if self.rehearse else "The arm will move."
            if not confirmed(self.t, f"Measure now? {warning}"):
                raise StoppedError("not measured, nothing has moved")
        cell = self.p.cell.with_config(self._config())

        def work(campaign: CampaignFile, epoch: float | None) -> None:
            measure(self.t, cell, campaign, epoch=epoch, viewer=self.viewer)

        def measured() -> int:
            return self.p.measure(step, work)

        if self.rehearse:
            retry_after_failures(self.t, measured, lambda: _count(step.path))
        else:
            measured()

    def _config(self) -> CellConfig:
        """Return the configuration of the devices; in a rehearsal, start simulated ones."""
        if not self.rehearse:
            return self.p.config
        if self.simulated is None:
            with working(self.t.progress) as say:
                say("starting the simulated devices")
                self.simulated = self.stack.enter_context(lasting_cell(self.p))
        return self.simulated

    def _computing(self, step: ProcedureStep) -> None:
        """Do a step in which nothing moves, and report its result."""
        p, t, viewer = self.p, self.t, self.viewer
        if step.kind == "plan":
            with working(t.progress) as say:
                checked_plan = p.plan(say)
            t.show(plan_facts(checked_plan.summary))
            p.begin(checked_plan.plan, p.config)
            return
        result: Any
        with working(t.progress) as say:
            if step.kind == "refine" and viewer is not None:
                result = p.refine(say, lambda n, s: viewer.revised(*chapters_of([n], [s])))
            else:
                result = p.compute(step, say)
        if step.kind == "refine":
            with CampaignFile.open(p.run, read_only=True) as campaign:
                refined = ProcedureLog(campaign).last(REFINED) or {"revisions": []}
            t.show(errors_by_revision(chapters_of(refined["revisions"], result.steps)))
            t.show([verdict_line(result.diagnosis), ""])
            t.show(prior_report(result))
        elif step.kind == "decide":
            settings = p.settings
            t.show(words.decision_report(result, settings.goal_m, settings.readings, p.clock))
        elif step.kind == "validate":
            t.show(words.validation_lines(result))


def _count(path: Path) -> int:
    with CampaignFile.open(path, read_only=True) as campaign:
        return campaign.n_readings
