"""The judgement of a fit: one frozen value for commands, `refine`, plans, studies and files.

It holds data only; `hilcal.present.verdict` writes its sentence.
"""

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from hilcal.diagnosis.background_evidence import BackgroundEffect
from hilcal.diagnosis.confounding import Confounded
from hilcal.diagnosis.effect_ranking import FALSE_ALARM, Suspect
from hilcal.diagnosis.evidence import (
    Alternative,
    Insufficiency,
    Separability,
    would_leave_noise,
)
from hilcal.diagnosis.misfit_breakdown import MisfitShare
from hilcal.diagnosis.noise import NoiseVerdict, PureError
from hilcal.diagnosis.order_step import OrderStep
from hilcal.diagnosis.pose_alone import PoseAlone
from hilcal.diagnosis.residual_regression import Dependence
from hilcal.diagnosis.wrong_figures import WrongFigure
from hilcal.identification.fit import Fit
from hilcal.readings.readings import ArmScatter
from hilcal.shown import Tabular, presenter
from hilcal.store.codec import encode

MOST_IN_DOUBT = 4
"""Most effects to separate at once: each ordered pair is a term of the design; a guess."""
PRIOR_ODDS = 1.0 / 9.0
"""Of an effect of the catalogue to be on an arm and large enough to be proved; a choice."""
LARGEST_LOG_EVIDENCE = 30.0
"""Log evidence at which the probability saturates, at 1 - 2e-12."""

Verdict = Literal["adequate", "missing_effect", "ambiguous", "unknown_effect", "noise_misjudged"]
Reason = Literal[
    "residual_is_noise",
    "one_suspect",
    "inseparable_suspects",
    "inseparable_addition",
    "unconfirmed_suspect",
    "insufficient_catalogue",
    "no_suspect",
    "misjudged_noise",
    "arm_scatter",
    "pose_alone",
    "readings_disagree",
    "serial_or_effect",
    "few_readings",
    "background",
    "wrong_figure",
]
VERDICTS: dict[Reason, Verdict] = {
    "residual_is_noise": "adequate",
    "one_suspect": "missing_effect",
    "inseparable_suspects": "ambiguous",
    "inseparable_addition": "ambiguous",
    "unconfirmed_suspect": "ambiguous",
    "insufficient_catalogue": "unknown_effect",
    "no_suspect": "unknown_effect",
    "misjudged_noise": "noise_misjudged",
    "arm_scatter": "adequate",
    "pose_alone": "ambiguous",
    "readings_disagree": "unknown_effect",
    "serial_or_effect": "ambiguous",
    "few_readings": "ambiguous",
    "background": "ambiguous",
    "wrong_figure": "ambiguous",
}
"""The verdict that each reason leads to."""
CURVE_KEYS = (
    "variable", "unit", "share", "moves", "direction", "axes", "labels", "x", "y", "error",
    "y_unit", "determined",
)  # fmt: skip
"""What a document holds of a `Dependence`."""


@dataclass(frozen=True, slots=True)
class History:
    """How a model was reached, as far as refining and its judgement depend on it."""

    added: tuple[str, ...] = ()  # effects that diagnoses chose; others may fit as well
    removed: tuple[str, ...] = ()  # effects that were taken out; refining does not add them again
    rejected: tuple[str, ...] = ()  # effects whose refit did not lower the error on poses left out


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis(Tabular):
    """What is wrong with a fitted model.

    Attributes:
        fit: the fit.
        history: the changes that led to its model.
        reason: the rule of `verdict.judge` that decided.
        suspects: effects that are not in the model: first those that pass all tests, then those
            that explain the misfit but do not surely lower the error on poses left out, then
            the others; by decreasing evidence in each of these three groups.
        misfit_breakdown: variables that the misfit follows, largest share first.
        predictable_share: largest share of the misfit that smooth laws, one variable or one effect
            predict on poses left out; 0 where there is no misfit.
        dependences: variables that carry the predictable share, with the curve of each; of the
            residual after the refit where the catalogue is insufficient.
        follows: names of at most two variables that the unexplained misfit follows.
        pure_error: the scatter of repeated readings, or None without repeats.
        noise: whether the stated covariance is to blame; None where a suspect passes all tests.
        redundant: effects of the model without which the readings are explained as well.
        separability: how each inseparable rival of the first suspect differs from it.
        insufficiency: the misfit that the whole catalogue leaves, where it is not noise.
        alternatives: for each effect of `history.added`, the effects that could replace it.
        scatter: the arm's scatter, where nothing else explains the residual, or where the
            covariance of the fit includes it.
        pose_alone: a misfit that is the same under every load of a pose, where nothing predicts it
            on poses left out, and more poses would identify its effect.
        background: the effects of the model's background, smallest p-values first.
        wrong_figures: figures of the cell each of which, if wrong, alone explains the misfit. No
            effect is a suspect then.
        step: a step in the order of the readings, where nothing else explains the misfit.
        confounded: effects that are named, or the first suspect, which the readings explain as
            well with another recorded variable, such as the air temperature for the time.
    """

    fit: Fit
    history: History
    reason: Reason
    suspects: tuple[Suspect, ...]
    misfit_breakdown: tuple[MisfitShare, ...]
    predictable_share: float = 0.0
    dependences: tuple[Dependence, ...] = ()
    follows: tuple[str, ...] = ()
    pure_error: PureError | None = None
    noise: NoiseVerdict | None = None
    redundant: tuple[str, ...] = ()
    separability: tuple[Separability, ...] = ()
    insufficiency: Insufficiency | None = None
    alternatives: tuple[Alternative, ...] = ()
    scatter: ArmScatter | None = None
    pose_alone: PoseAlone | None = None
    background: tuple[BackgroundEffect, ...] = ()
    wrong_figures: tuple[WrongFigure, ...] = ()
    step: OrderStep | None = None
    confounded: tuple[Confounded, ...] = ()

    def _brief(self) -> dict[str, str]:
        first = self.suspects[:5]
        return {
            "model": self.fit.model.title,
            "verdict": f"{self.verdict} ({self.reason})",
            "message": self.message,
            **{f"suspects[{k}]": repr(s) for k, s in enumerate(first)},
            "and": f"{len(self.suspects) - len(first)} more suspects",
        }

    @property
    def verdict(self) -> Verdict:
        """The verdict of `reason`."""
        return VERDICTS[self.reason]

    @property
    def message(self) -> str:
        """The verdict in a sentence."""
        return str(presenter("verdict").message(self))

    @property
    def variance_factor(self) -> float:
        """The variance factor of the fit."""
        return self.fit.variance_factor

    @property
    def significant(self) -> tuple[str, ...]:
        """Names of the suspects that pass all tests, best first."""
        return tuple(s.effect for s in self.suspects if s.passes)

    @property
    def unconfirmed(self) -> tuple[Suspect, ...]:
        """Suspects each of which would leave noise, without surely predicting poses left out."""
        return tuple(
            s
            for s in self.suspects
            if s.explains and s.plausible and s.keeps and not (s.refuted or s.sure)
            if would_leave_noise(self.fit, s.share)
        )

    @property
    def not_shown(self) -> tuple[str, ...]:
        """Effects, such as geometry in deflections, that no plausible size would reveal here."""
        background = {b.effect for b in self.background}
        failed = (s for s in self.suspects if not s.passes and s.effect not in background)
        return tuple(s.effect for s in failed if not s.shown)

    @property
    def tested(self) -> int:
        """Number of effects that were tested; they share the level of the test."""
        return sum(s.score.rank > 0 for s in self.suspects)

    @property
    def lead(self) -> Suspect | None:
        """The first suspect, where it passes all tests."""
        return self.suspects[0] if self.suspects and self.suspects[0].passes else None

    @property
    def repeated_share(self) -> float:
        """Share of the misfit that repeats of a state have in common; 0 without repeats."""
        excess = self.fit.variance_factor - 1
        if self.pure_error is None or excess <= 0:
            return 0.0
        return min(max(1 - (self.pure_error.factor - 1) / excess, 0.0), 1.0)

    @property
    def residual_is_noise(self) -> bool:
        """Whether the stated noise explains the residual."""
        return self.reason in ("residual_is_noise", "inseparable_addition", "few_readings")

    def to_dict(self) -> dict[str, object]:
        """Return the JSON document of `hilcal diagnose --json`, including the sentence."""
        tests = {"count": self.tested, "level": FALSE_ALARM}
        return {
            "model": list(self.fit.model.named),
            "verdict": self.verdict,
            "message": self.message,
            "reason": self.reason,
            "variance_factor": self.variance_factor,
            "variance_factor_interval": list(self.fit.variance_factor_interval),
            "predictable_share": self.predictable_share,
            "where": [asdict(v) for v in self.misfit_breakdown],
            "suspects": [s.to_dict() for s in self.suspects],
            "not_shown": list(self.not_shown),
            "tests": {**tests, "each": FALSE_ALARM / max(self.tested, 1)},
            "apart": [
                {
                    "effect": a.effect,
                    "unlike": a.unexplained_share,
                    "times": a.readings_factor if a.possible else None,
                }
                for a in self.separability
            ],
            "beyond": self.insufficiency
            and _attributes(self.insufficiency, "effects", "refitted", "share", "variance_factor"),
            "background": [_attributes(b, "effect", "p_value", "rms_m") for b in self.background],
            "wrong_figures": [asdict(f) for f in self.wrong_figures],
            "step": self.step and asdict(self.step),
            "pose_alone": self.pose_alone and asdict(self.pose_alone),
            "rejected": list(self.history.rejected),
            "alternatives": [
                _attributes(a, "effect", "same_as") | {"others": list(a.replacements)}
                for a in self.alternatives
                if a.inseparable
            ],
            "confounded": [asdict(c) for c in self.confounded],
            "needless": list(self.redundant),
            "carriers": [_attributes(v, *CURVE_KEYS) for v in self.dependences],
            "arm_scatter": self.scatter and self.scatter.to_json(),
            "serial_noise": self.fit.readings.serial and self.fit.readings.serial.to_json(),
            "pure_error": self.pure_error and self.pure_error.to_dict(),
        }


def _attributes(value: object, *names: str) -> dict[str, object]:
    return {name: encode(getattr(value, name)) for name in names}


def in_doubt(d: Diagnosis, most: int = MOST_IN_DOUBT) -> tuple[str, ...]:
    """Return effects that the readings do not separate; none unless the verdict is `ambiguous`.

    They are missing from the model, the first suspect first; or the first was added to the model
    and the others could replace it; or they all depend on the pose alone, as the misfit does; or
    each would leave noise, but none surely lowers the error on poses left out. A single one is not
    separated from another effect, but from chance: further poses of any plan do that.
    """
    if d.reason == "inseparable_suspects":
        return (d.suspects[0].effect, *(s.effect for s in d.separability))[:most]
    if d.reason == "inseparable_addition":
        a = next(a for a in d.alternatives if a.inseparable)
        return (a.effect, *(a.same_as or a.replacements))[:most]
    if d.reason == "unconfirmed_suspect":
        names = tuple(s.effect for s in d.unconfirmed)[:most]
        return names if len(names) > 1 else ()
    return d.pose_alone.effects[:most] if d.pose_alone is not None else ()


def effect_probabilities(steps: Sequence[Diagnosis], effects: Iterable[str]) -> dict[str, float]:
    """Return the marginal probability of each effect to be on the arm, from a refinement's steps.

    The odds for an effect are the prior odds times exp(L - 1). L is its log evidence at the most
    evident strength, the choice of which costs one unit. L is taken from the last step that has it:

        an effect that was named: against the model without it
        an effect of a background: half the restricted likelihood ratio, beside all others
        another suspect: beside the model of the step that tested it
        an effect that no step tested: 0

    Where others explain as much as a named effect, they share the probability: the named effect
    has 1 / (1 + exp(L_others - L - (number of others) + 1)), the others have the complement.
    """
    alternatives = steps[-1].alternatives
    evidence = {a.effect: a.effect_log_evidence for a in alternatives}
    for d in reversed(steps):
        evidence = {b.effect: b.ratio / 2 for b in d.background} | evidence
        evidence = {s.effect: s.score.log_evidence for s in d.suspects} | evidence
    names = tuple(effects)
    p = {name: _probability(evidence.get(name, 0.0)) for name in {*names, *evidence}}
    for a in alternatives:
        if not a.sufficient:
            continue
        log_odds = np.clip(
            a.log_evidence - a.effect_log_evidence - len(a.replacements) + 1,
            -LARGEST_LOG_EVIDENCE,
            LARGEST_LOG_EVIDENCE,
        )
        stays = float(1.0 / (1.0 + np.exp(log_odds)))
        p |= {name: max(p.get(name, 0.0), 1.0 - stays) for name in a.replacements}
        p[a.effect] = min(p[a.effect], stays)
    return {name: p[name] for name in names}


def _probability(log_evidence: float) -> float:
    gain = np.clip(log_evidence, -LARGEST_LOG_EVIDENCE, LARGEST_LOG_EVIDENCE) - 1.0
    return float(1.0 / (1.0 + np.exp(-gain) / PRIOR_ODDS))
