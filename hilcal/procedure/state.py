"""Where a calibration stands: the next step, by what its files hold and nothing else."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from hilcal.errors import InputError
from hilcal.names import quoted
from hilcal.readings.whitening import Mode
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.codec import decode, encode
from hilcal.store.plan import REFERENCE, Plan, read_plan
from hilcal.store.procedure_log import CALIBRATION, CORRECTED, PURPOSE, VALIDATION, ProcedureLog
from hilcal.store.run_log import PLAN, RunLog
from hilcal.types import Floats

Kind = Literal[
    "plan",
    "measure",
    "refine",
    "decide",
    "plan_validation",
    "measure_validation",
    "validate",
    "correct",
    "measure_corrected",
    "compare",
    "done",
]
MOVING: tuple[Kind, ...] = ("measure", "measure_validation", "measure_corrected")
"""Steps in which the arm moves."""
_VALIDATING: tuple[Kind, Kind, Kind] = ("plan_validation", "measure_validation", "validate")
_CORRECTING: tuple[Kind, Kind, Kind] = ("correct", "measure_corrected", "compare")
BEGUN, REFINED, DECIDED, FROZEN = "begun", "refined", "decided", "frozen"
VALIDATED, IMPROVED, WORLD = "validated", "improved", "world"
"""Kinds of entries in the log."""
MEASURE, STOP = "measure", "stop"
"""What was decided: to measure a further plan, or that the model is as good as it gets."""
SUFFIX = ".hilcal"


@dataclass(frozen=True, slots=True)
class Settings:
    """What a calibration was asked for; kept in its campaign."""

    poses: int = 20  # size of the first plan, and of further ones
    validation: int = 20  # poses of the validation campaign
    max_time_s: float = 7200.0
    """How long measuring may last in all plans together, as they state it, cell s."""
    goal_m: float | None = None
    """The error that is wanted after compensation: 95 % of the points within it; None for no goal
    beside an adequate model."""
    limit_m: float | None = None
    """The largest error that is allowed at corrected targets; None for none."""
    seed: int = 0  # of everything random
    readings: Mode = "deflection"  # kind of readings that is fitted
    hide: str | None = None  # what a rehearsal hides in its simulated cell; None on real devices
    under_load: bool = False  # whether the model is tested under loads alone, where there are any
    prior: str | None = None
    """File of the campaign or the posterior that is the prior of every fit; None without."""

    def to_json(self) -> dict[str, object]:
        """Return it as JSON; `settings_of` reads it."""
        return dict(encode(self))


@dataclass(frozen=True, slots=True)
class Files:
    """The files of a calibration."""

    run: Path  # the campaign that is fitted

    @property
    def validation(self) -> Path:
        """The validation campaign."""
        return self._beside(VALIDATION)

    @property
    def corrected(self) -> Path:
        """The run at corrected targets."""
        return self._beside(CORRECTED)

    def _beside(self, what: str) -> Path:
        return self.run.with_name(f"{self.run.name.removesuffix(SUFFIX)}.{what}{SUFFIX}")


@dataclass(frozen=True, slots=True)
class ProcedureStep:
    """What a calibration does next."""

    kind: Kind  # what
    path: Path  # the campaign that it is about
    missing: int = 0  # readings that are missing, where the arm moves
    planned: int = 0  # readings of the plan, where the arm moves
    load_changes: int = 0  # how often a person has to change the load, where the arm moves
    seconds: float = 0.0  # how long the arm takes for what is missing, roughly, cell s

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
            raise _another(run)
        decided = log.last(DECIDED)
        if decided is not None and not files.validation.exists() and _asked_anew(log):
            return ProcedureStep("decide", run)
        if decided is None or decided["action"] == MEASURE:
            missing = _missing("measure", campaign)
            if missing is not None:
                return missing
            refined = log.last(REFINED)
            if refined is None or refined["readings_sha256"] != campaign.data_hash():
                return ProcedureStep("refine", run)
            return ProcedureStep("decide", run)
        looked, improved = log.last(VALIDATED) is not None, log.last(IMPROVED) is not None
    tests: list[tuple[Path, str, Kind, Kind, Kind, bool, Path]] = [
        (files.validation, VALIDATION, *_VALIDATING, looked, files.validation),
        (files.corrected, CORRECTED, *_CORRECTING, improved, run),
    ]
    for path, purpose, plan, measure, judge, judged, of in tests:
        if not path.exists():
            return ProcedureStep(plan, path)
        with opened(path, purpose, run) as campaign:
            missing = _missing(measure, campaign)
        if missing is not None or not judged:
            return missing or ProcedureStep(judge, of)
    return ProcedureStep("done", run)


def _asked_anew(log: ProcedureLog) -> bool:
    """Whether other settings were asked for since measuring was ended."""
    kinds = [entry["kind"] for entry in log.entries() if entry["kind"] in (BEGUN, DECIDED)]
    last = log.last(DECIDED)
    return kinds[-1] == BEGUN and last is not None and last["action"] == STOP


def opened(path: Path, purpose: str, run: Path, *, read_only: bool = True) -> CampaignFile:
    """Open a file of a calibration."""
    campaign = CampaignFile.open(path, read_only=read_only)
    if campaign.about(PURPOSE) != purpose or campaign.about(CALIBRATION) != identity(run):
        campaign.close()
        raise InputError(f"{path}: not the {purpose} campaign of {run}; rename or move it away")
    return campaign


def identity(run: Path) -> str:
    """Return what the other files of a calibration know their campaign by: name and beginning."""
    with CampaignFile.open(run, read_only=True) as campaign:
        return f"{run.name} of {campaign.created}"


def settings_of(campaign: CampaignFile) -> Settings:
    """Return what a calibration was asked for, as it was last."""
    begun = ProcedureLog(campaign).last(BEGUN)
    if begun is None:
        raise _another(campaign.path)
    settings: Settings = decode(Settings, begun["settings"])
    return settings


def _another(run: Path) -> InputError:
    """Return the error of a campaign that was not made by `calibrate`."""
    return InputError(
        f"{run}: not a campaign of hilcal calibrate; choose another name, or go on with its own "
        f"commands: hilcal info {quoted(run)}"
    )


def duration_of(plan: Plan) -> float:
    """Return how long a plan takes as it states it, cell s."""
    told = plan.about.get("duration_s", {})
    return float(told.get("total", 0.0)) if isinstance(told, dict) else 0.0


def _missing(kind: Kind, campaign: CampaignFile) -> ProcedureStep | None:
    """Return the step that measures what is missing of the last plan; None where nothing is."""
    log = RunLog(campaign)
    last, done = log.plans[-1], log.done()
    left = last.without(done).steps
    if not left:
        return None
    loads = [s.load for s in left]
    changes = sum(a != b for a, b in zip(["none", *loads], [*loads, "none"], strict=True))
    share = len(left) / len(last.steps)
    seconds = share * duration_of(last)
    return ProcedureStep(kind, campaign.path, len(left), len(last.steps), changes, seconds)


def reference_in(file: CampaignFile) -> Floats | None:
    """Return the joints (n,) of a campaign's reference pose; None where it has no plan."""
    text = file.about(PLAN)
    return None if text is None else reference_of(read_plan(text, f"{file.path}, its plan"))


def reference_of(plan: Plan) -> Floats | None:
    """Return the joints (n,) of a plan's reference pose."""
    return plan.joints(REFERENCE) if REFERENCE in plan.pose_names else None
