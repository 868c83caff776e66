"""Decision on further measurements: effects in doubt, and the gain of a further plan."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.compensation import band, tool_of
from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.next import PairPower, SeparatingPlan, plan_poses, plan_separating
from hilcal.design.planner import PlanRequest, plan_readings
from hilcal.design.predicted import predicted_uncertainty
from hilcal.design.summary import CheckedPlan, about, checked, summarise
from hilcal.diagnosis.diagnosis import Diagnosis, in_doubt
from hilcal.diagnosis.effect_ranking import Suspect
from hilcal.diagnosis.pose_alone import PoseAlone, pose_powers
from hilcal.diagnosis.stepwise import remove
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit import Fit
from hilcal.names import quoted
from hilcal.present.progress import Say
from hilcal.procedure.state import Settings, duration_of, reference_in, reference_of
from hilcal.procedure.validation_plan import recorded_columns
from hilcal.readings.readings import States
from hilcal.robot.chain import evaluate
from hilcal.store.plan import Plan
from hilcal.store.run_log import PLAN
from hilcal.types import Floats

POSES = 20
"""Poses of a plan, where the doubt does not determine their number; a choice."""


@dataclass(frozen=True, slots=True)
class Doubt:
    """Effects to separate."""

    fit: Fit  # of a model without the suspects
    suspects: tuple[str, ...]
    pose_alone: PoseAlone | None = None
    """The misfit that depends on the pose alone, where further unloaded poses settle the doubt."""


def doubt_of(d: Diagnosis, say: Say = lambda text: None) -> Doubt | None:
    """Return the doubt that a diagnosis leaves; None without one, or where an option settles it."""
    suspects = in_doubt(d)
    if not suspects or any(s.coarse for s in d.suspects if s.effect in suspects):
        return None
    a = d.pose_alone
    alone = a if a is not None and a.chance is not None and d.fit.mode == "absolute" else None
    return Doubt(fit_without(d.fit, suspects, say), suspects, alone)


def fit_without(fitted: Fit, suspects: tuple[str, ...], say: Say = lambda text: None) -> Fit:
    """Return the fit of a model without some effects."""
    for name in suspects:
        if name in fitted.model.names:
            say(f"fitting without {name}")
            fitted = remove(fitted, name)
    return fitted


def separating_plan(
    cell: Cell,
    doubt: Doubt,
    poses: int | None,  # whose readings the plan has; None: as many as the doubt needs
    rng: np.random.Generator,
    say: Say,
    reference: Floats | None,  # (n,) joints of the campaign's reference pose, rad
    default_poses: int = POSES,  # poses where the doubt does not determine their number
) -> SeparatingPlan:
    """Plan the measurements that separate the suspects of a doubt, or raise a CannotAnswerError."""
    fitted, effects = doubt.fit, doubt.suspects
    if doubt.pose_alone is None:
        request = PlanRequest(default_poses if poses is None else poses)
        return plan_separating(cell, fitted, effects, request, rng, say, reference)
    count = doubt.pose_alone.more if poses is None else poses
    planned = plan_poses(cell, fitted, count, rng, say, reference)
    say("predicting the powers")
    powers = tuple(PairPower(*row, False) for row in pose_powers(fitted, effects, count))
    return SeparatingPlan(planned, powers, {}, 1.0, ())


def plan_of(chosen: SeparatingPlan, suspects: tuple[str, ...]) -> Plan:
    """Return the plan with its origin, the suspects and the powers of separating them."""
    powers = [[t.effect, t.rival, round(t.power_planned, 4)] for t in chosen.powers]
    content = {**about(chosen.planned), "suspects": list(suspects), "separates": powers}
    return replace(chosen.planned.ordered.plan, about=content)


@dataclass(frozen=True, slots=True, eq=False)
class NextPlan:
    """The next measurements."""

    separating: SeparatingPlan  # the powers, pair by pair
    checked: CheckedPlan  # the plan, all motions checked
    appendable: bool  # whether the campaign was measured by a plan, so that another can follow


def next_plan(
    o: Campaign,
    doubt: Doubt,
    poses: int | None,
    rng: np.random.Generator,
    say: Say,
    *,
    cell: Cell | None = None,
    compare: bool = False,
) -> NextPlan:
    """Plan the measurements that settle a doubt, and check every motion in a dry run.

    `poses` is as in `separating_plan`. `cell` replaces the campaign's where it has changed. To
    `compare` criteria and numbers of poses takes longer. Raises as `separating_plan` does.
    """
    cell = o.cell if cell is None else cell
    chosen = separating_plan(cell, doubt, poses, rng, say, reference_in(o.file))
    compare = compare and not doubt.pose_alone
    summary = summarise(chosen.planned, cell.configured(), rng, say, compare=compare, curve=compare)
    say("checking every motion in a dry run")
    plan = checked(cell, plan_of(chosen, doubt.suspects), summary)
    return NextPlan(chosen, plan, o.file.about(PLAN) is not None)


def doubt_to_settle(o: Campaign, d: Diagnosis, say: Say) -> Doubt:
    """Return the doubt that a diagnosis leaves.

    Raises:
        CannotAnswerError: nothing is in doubt; the message has the next step instead.
    """
    doubt = doubt_of(d, say)
    if doubt is not None:
        return doubt
    finer = [s for s in d.suspects if s.coarse and s.effect in in_doubt(d)]
    if finer:
        raise CannotAnswerError(f"not two effects, but one in doubt: {_finer_advice(o, finer[0])}")
    raise CannotAnswerError(_nothing_to_separate(o, d))


def _nothing_to_separate(o: Campaign, d: Diagnosis) -> str:
    """Return the message that there are no suspects to separate, with the next step."""
    see = f"see hilcal diagnose {quoted(o.path)}"
    further = f"hilcal plan CELL.toml -o PLAN.json --after {quoted(o.path)}"
    if d.verdict == "adequate":
        why = (
            f"the model is adequate; to sharpen it, plan on with: {further}, or separate named "
            "effects with --suspects A,B"
        )
    elif d.wrong_figures:
        why = f"a figure of the cell seems to be wrong, {see}"
    elif d.step is not None:
        why = (
            f"something was moved in the middle of the readings, {see}; the table to mend is "
            f"written by: hilcal export {quoted(o.path)} --readings READINGS.csv"
        )
    elif d.verdict == "noise_misjudged":
        why = f"the noise is misjudged, {see}; repeat some readings, or state the covariance anew"
    elif d.reason == "background":
        why = (
            "effects of the background are not told apart one by one; measure more poses, spread "
            f"over all joints, with: {further}"
        )
    elif d.reason == "few_readings":
        why = f"these poses are too few to judge the model by; measure more with: {further}"
    elif d.reason == "unconfirmed_suspect":
        why = (
            f"{d.suspects[0].effect} is the only suspect, and these poses are too few to confirm "
            f"it; measure more poses with: {further}"
        )
    elif d.verdict == "missing_effect":
        lead = d.suspects[0]
        add = f"hilcal add {quoted(o.path)} {quoted(lead.effect)}"
        missing = f"{lead.effect} alone is missing; add it with: {add}"
        why = _finer_advice(o, lead) if lead.coarse else missing
    else:
        why = "no effect of the catalogue explains the misfit"
        if d.reason == "insufficient_catalogue":
            why = (
                f"all effects of the catalogue together do not explain the misfit, and "
                f"{d.suspects[0].effect} may only resemble the missing effect"
            )
        why += f"; {see}, or give an effect of your own by --effects-from"
    return f"no suspects to separate: {why}"


def _finer_advice(o: Campaign, s: Suspect) -> str:
    """Return the message on how to make an effect finer."""
    return (
        f"{s.coarse} of the model is too coarse; make it finer, and diagnose again: "
        f"hilcal add {quoted(o.path)} {quoted(s.effect)}"
    )


MIN_ERROR_GAIN = 0.05
"""Least share by which a further plan must lower the predicted error; a choice."""
MIN_POWER_GAIN = 0.1
"""Least power that a further plan must add for a pair of suspects; a choice."""
MAX_PLANS = 6
"""Most plans of a campaign; a choice: a doubt left by five further plans survives a sixth of the
same size."""
MAX_POINTS = 200
"""Most points at which the error is predicted; a choice."""


@dataclass(frozen=True, slots=True)
class PredictedError:
    """Predicted 95 % quantiles of the position error after compensation."""

    now_m: float  # with all contributions
    floor_m: float
    """Without that of the parameters: the arm's repeatability and the model's misfit."""


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """What to do after a refinement."""

    reason: str
    """"adequate", "goal_met"; "doubt" or "goal" where a further plan is to be measured; "floor",
    "no_gain", "inseparable", "time" or "plans" where a further plan gains nothing or costs too
    much; the verdict where no measurement would help."""
    verdict: str
    error: PredictedError
    then_m: float | None = None  # `error.now_m` after a further plan; None where it is for a doubt
    suspects: tuple[str, ...] = ()  # effects in doubt
    power: float | None = None  # least power of separating two of them after the further plan
    plan: Plan | None = None
    """The further plan; see `measures`."""
    seconds: float = 0.0  # duration of the further plan, cell s

    @property
    def measures(self) -> bool:
        """Whether the further plan is to be measured."""
        return self.reason in ("doubt", "goal")

    def to_json(self) -> dict[str, object]:
        """Return the decision as an entry of the log."""
        return {
            "reason": self.reason,
            "verdict": self.verdict,
            "predicted_m": self.error.now_m,
            "floor_m": self.error.floor_m,
            "then_m": self.then_m,
            "suspects": list(self.suspects),
            "power": self.power,
            "readings": 0 if self.plan is None else len(self.plan.steps),
            "seconds": self.seconds,
        }


@dataclass(frozen=True, slots=True, eq=False)
class FurtherMeasuring:
    """The decision whether to measure more, after a refinement."""

    cell: Cell
    settings: Settings
    d: Diagnosis  # of the last fit
    plans: tuple[Plan, ...]  # all plans so far
    rng: np.random.Generator
    say: Say

    def decide(self) -> Decision:
        """Decide whether to measure a further plan, and which.

        A doubt between effects comes first, then a predicted error above the goal. A further plan
        must bring a gain within the time allowed.
        """
        d, settings = self.d, self.settings
        error = predicted_error(
            Calibration.of(d.fit), d.fit.readings.states, self.cell.configured()
        )
        further = self._separating(error)
        if further is None or not further.measures:
            sharper = self._sharpening(error)
            if sharper is not None and (further is None or sharper.measures):
                further = sharper
        if further is None:
            # the predicted error has the uncertainty of what a background only predicts
            explained = d.verdict == "adequate" or d.reason == "background"
            reached = settings.goal_m is not None and explained
            return Decision("goal_met" if reached else d.verdict, d.verdict, error)
        if not further.measures:
            return further
        if sum(map(duration_of, self.plans)) + further.seconds > settings.max_time_s:
            return replace(further, reason="time")
        return replace(further, reason="plans") if len(self.plans) >= MAX_PLANS else further

    def _separating(self, error: PredictedError) -> Decision | None:
        """Return the decision on the diagnosis' doubt; None without a doubt."""
        doubt = doubt_of(self.d, self.say)
        if doubt is None:
            return None
        inseparable = Decision("inseparable", self.d.verdict, error, suspects=doubt.suspects)
        poses, reference = self.settings.poses, reference_of(self.plans[0])
        try:
            chosen = separating_plan(self.cell, doubt, None, self.rng, self.say, reference, poses)
        except (CannotAnswerError, InputError):
            return inseparable
        separable = [p for p in chosen.powers if not p.not_separable]
        if max((p.power_planned - p.power_now for p in separable), default=0.0) < MIN_POWER_GAIN:
            return inseparable
        plan, power = plan_of(chosen, doubt.suspects), min(p.power_planned for p in separable)
        seconds = duration_of(plan)
        return replace(inseparable, reason="doubt", power=power, plan=plan, seconds=seconds)

    def _sharpening(self, error: PredictedError) -> Decision | None:
        """Return the decision on the predicted error; None where it meets the goal."""
        goal = self.settings.goal_m
        if goal is None or error.now_m <= goal:
            return None
        decision = Decision("no_gain", self.d.verdict, error)
        if error.floor_m >= goal:
            return replace(decision, reason="floor")
        self.say("planning what would lower the predicted error")
        config = self.cell.configured().with_keys("planning", readings=self.d.fit.mode)
        cell, request = self.cell.with_config(config), PlanRequest(self.settings.poses)
        reference = reference_of(self.plans[0])
        try:
            planned = plan_readings(
                cell, request, self.rng, self.d.fit, self.say, reference=reference
            )
        except (CannotAnswerError, InputError):
            return decision
        std = predicted_uncertainty(planned.problem, work=planned.work).position
        std_then, share = planned.predicted.position, 1.0
        if std is not None and std_then is not None and np.isfinite(std_then):
            share = (std_then / std) ** 2 if np.isfinite(std) and std > 0 else 0.0
        parameter_variance = max(error.now_m**2 - error.floor_m**2, 0.0)
        then = float(np.sqrt(error.floor_m**2 + share * parameter_variance))
        if then > (1.0 - MIN_ERROR_GAIN) * error.now_m:
            return replace(decision, then_m=then)
        plan = replace(planned.ordered.plan, about=about(planned))
        seconds = duration_of(plan)
        return replace(decision, reason="goal", then_m=then, plan=plan, seconds=seconds)


def predicted_error(calibration: Calibration, fitted: States, config: CellConfig) -> PredictedError:
    """Predict the position error after compensation where the robot will work, as 95 % quantile.

    The points are at `[planning] work_q_rad`, or half-way between measured poses, under the loads
    of the readings.
    """
    states = _work(fitted, config)
    prediction = calibration.predict(states.q, states.wrench, recorded=recorded_columns(states))
    assert prediction.covariance is not None  # noqa: S101  (asked for by default)
    tool = tool_of(calibration.model, calibration.theta, None)
    chain = evaluate(calibration.model.cell.arm, states.q)
    floor = calibration.scatter.covariance(tool.model.cell, chain, prediction.position)
    floor = floor + calibration.misfit * np.eye(3)
    pooled = np.stack([prediction.covariance.mean(axis=0), floor.mean(axis=0)])
    total, least_error = band(pooled)
    return PredictedError(float(total), float(least_error))


def _work(fitted: States, config: CellConfig) -> States:
    loaded = np.flatnonzero(np.any(fitted.wrench != 0, axis=1))
    rows = loaded if len(loaded) else np.arange(len(fitted))
    rows = rows[np.linspace(0, len(rows) - 1, min(MAX_POINTS, len(rows))).astype(np.int64)]
    q = fitted.q[rows]
    between = 0.5 * (q + np.roll(q, -max(len(q) // 3, 1), axis=0))
    if config.planning.work_q_rad:
        work = np.array(config.planning.work_q_rad, dtype=float)
        between = work[np.arange(len(rows)) % len(work)]
    return replace(fitted[rows], q=between, q_actual=None, target=None)
