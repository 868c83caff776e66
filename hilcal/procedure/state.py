"""State of a calibration: its next step, determined by the contents of its files alone."""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal, get_args

from hilcal.errors import InputError
from hilcal.names import quoted
from hilcal.readings.whitening import Mode
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.codec import decode, encode
from hilcal.store.plan import REFERENCE, Plan, read_plan
from hilcal.store.procedure_log import (
    CALIBRATION,
    CORRECTED,
    IMPROVED,
    PURPOSE,
    VALIDATION,
    ProcedureLog,
)
from hilcal.store.run_log import PLAN, RunLog
from hilcal.types import Floats

Moving = Literal["measure", "measure_validation", "measure_corrected"]
Computed = Literal["refine", "decide", "plan_validation", "validate", "correct", "compare"]
Kind = Literal["plan", "done"] | Moving | Computed
MOVING: tuple[Kind, ...] = get_args(Moving)
"""Steps in which the arm moves."""
_VALIDATING: tuple[Kind, Kind, Kind] = ("plan_validation", "measure_validation", "validate")
_CORRECTING: tuple[Kind, Kind, Kind] = ("correct", "measure_corrected", "compare")
BEGUN, REFINED, DECIDED, FROZEN = "begun", "refined", "decided", "frozen"
VALIDATED, WORLD = "validated", "world"
"""Kinds of entries in the log, beside `IMPROVED`."""
MEASURE, STOP = "measure", "stop"
"""Decisions: measure a further plan, or stop measuring."""
SUFFIX = ".hilcal"


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a calibration; stored in its campaign."""

    poses: int = 20  # size of the first plan, and of further ones
    validation: int = 20  # poses of the validation campaign
    max_time_s: float = 7200.0
    """Longest time for measuring, all plans together, by their stated durations, cell s."""
    goal_m: float | None = None
    """Error after compensation that 95 % of the points shall keep; None: an adequate model."""
    limit_m: float | None = None
    """Largest error allowed at corrected targets; None without a limit."""
    seed: int = 0  # of all random numbers
    readings: Mode = "deflection"  # kind of readings that is fitted
    hide: str | None = None  # effect hidden in a rehearsal's simulated cell; None on real devices
    under_load: bool = False  # whether the model is tested under loads only, where there are any
    prior: str | None = None
    """File of the campaign or posterior that is the prior of every fit; None without a prior."""

    def to_json(self) -> dict[str, object]:
        """Return the settings as JSON, which `settings_of` reads."""
        return dict(encode(self))


@dataclass(frozen=True, slots=True)
class Files:
    """The files of a calibration."""

    run: Path  # the campaign that is fitted

    @property
    def validation(self) -> Path:
        """The validation campaign."""
        return self._sibling(VALIDATION)

    @property
    def corrected(self) -> Path:
        """The run at corrected targets."""
        return self._sibling(CORRECTED)

    def _sibling(self, purpose: str) -> Path:
        return self.run.with_name(f"{self.run.name.removesuffix(SUFFIX)}.{purpose}{SUFFIX}")


@dataclass(frozen=True, slots=True)
class ProcedureStep:
    """A step of a calibration; the counts are 0 where the arm does not move."""

    kind: Kind
    path: Path  # the campaign of the step
    missing: int = 0  # missing readings
    planned: int = 0  # readings of the plan
    load_changes: int = 0  # load changes by a person
    seconds: float = 0.0  # approximate duration of the missing readings, cell s

    @property
    def moves(self) -> bool:
        """Whether the arm moves."""
        return self.kind in MOVING


def next_step(run: Path) -> ProcedureStep:
    """Return the next step of a calibration."""
    files = Files(run)
    if not run.exists():
        return ProcedureStep("plan", run)
    with CampaignFile.open(run, read_only=True) as campaign:
        log = ProcedureLog(campaign)
        if log.last(BEGUN) is None:
            raise _not_of_calibrate(run)
        decided = log.last(DECIDED)
        kinds = [entry["kind"] for entry in log.entries() if entry["kind"] in (BEGUN, DECIDED)]
        changed = kinds[-1] == BEGUN  # the settings, after the last decision
        again = changed and not files.validation.exists()
        if decided is None or decided["action"] == MEASURE or again:
            missing = _missing("measure", campaign)
            if missing is not None:
                return missing
            fitted = log.last(REFINED) or {}
            now = (campaign.data_hash(), settings_of(campaign).prior)
            if (fitted.get("readings_sha256"), fitted.get("prior")) != now:
                return ProcedureStep("refine", run)
            return ProcedureStep("decide", run)
        validated, improved = log.last(VALIDATED) is not None, log.last(IMPROVED) is not None
    tests: list[tuple[Path, str, Kind, Kind, Kind, bool, Path]] = [
        (files.validation, VALIDATION, *_VALIDATING, validated, files.validation),
        (files.corrected, CORRECTED, *_CORRECTING, improved, run),
    ]
    for path, purpose, plan, measure, judge, judged, target in tests:
        if not path.exists():
            return ProcedureStep(plan, path)
        with opened(path, purpose, run) as campaign:
            missing = _missing(measure, campaign)
        if missing is not None or not judged:
            return missing or ProcedureStep(judge, target)
    return ProcedureStep("done", run)


def opened(path: Path, purpose: str, run: Path) -> CampaignFile:
    """Open a test campaign of the calibration `run`; refuse a file of another purpose or run."""
    campaign = CampaignFile.open(path, read_only=True)
    if campaign.about(PURPOSE) != purpose or campaign.about(CALIBRATION) != identity(run):
        campaign.close()
        raise InputError(f"{path}: not the {purpose} campaign of {run}; rename or move it away")
    return campaign


def identity(run: Path) -> str:
    """Return name and creation time of a campaign, stored in the other files of a calibration."""
    with CampaignFile.open(run, read_only=True) as campaign:
        return f"{run.name} of {campaign.created}"


def settings_of(campaign: CampaignFile) -> Settings:
    """Return the latest settings of a calibration."""
    entry = ProcedureLog(campaign).last(BEGUN)
    if entry is None:
        raise _not_of_calibrate(campaign.path)
    settings: Settings = decode(Settings, entry["settings"])
    return settings


def _not_of_calibrate(run: Path) -> InputError:
    """Return the error for a campaign that `calibrate` did not make."""
    return InputError(
        f"{run}: not a campaign of hilcal calibrate; choose another name, or go on with its own "
        f"commands: hilcal info {quoted(run)}"
    )


def duration_of(plan: Plan) -> float:
    """Return the duration that a plan states, cell s; 0 without one."""
    durations = plan.about.get("duration_s", {})
    return float(durations.get("total", 0.0)) if isinstance(durations, dict) else 0.0


def _missing(kind: Kind, campaign: CampaignFile) -> ProcedureStep | None:
    """Return the step that measures the missing readings of the last plan; None without any."""
    log = RunLog(campaign)
    plan, done = log.plans[-1], log.done()
    steps = plan.without(done).steps
    if not steps:
        return None
    loads = ["none", *(s.load for s in steps), "none"]
    changes = sum(a != b for a, b in pairwise(loads))
    seconds = len(steps) / len(plan.steps) * duration_of(plan)
    return ProcedureStep(kind, campaign.path, len(steps), len(plan.steps), changes, seconds)


def reference_in(file: CampaignFile) -> Floats | None:
    """Return the joints (n,) of a campaign's reference pose; None where it has no plan."""
    text = file.about(PLAN)
    return None if text is None else reference_of(read_plan(text, f"{file.path}, its plan"))


def reference_of(plan: Plan) -> Floats | None:
    """Return the joints (n,) of a plan's reference pose."""
    return plan.joints(REFERENCE) if REFERENCE in plan.pose_names else None
