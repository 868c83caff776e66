"""Changes of a model: an effect more, one less, one in place of another."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from hilcal.diagnose.gain import LEAST_GAIN, improves
from hilcal.diagnose.projection import left_out_by_pose, projection
from hilcal.diagnose.suspects import SAME_EVIDENCE, Suspect, candidates, rank_suspects
from hilcal.effects.catalogue import make
from hilcal.effects.options import Options, reading_options
from hilcal.errors import InputError
from hilcal.identify.fit import Fit, fit
from hilcal.model import Model

MOST_TOGETHER = 3
"""Effects that are tried together in place of one."""
PRICE = 1.0
"""Evidence that each further effect costs: its strength was chosen by the data, too."""


def add(before: Fit, effect: str, options: Options | None = None) -> Fit:
    """Refit with one more effect, from where the fit stands.

    Args:
        before: the fit.
        effect: its name.
        options: of the effect, where they are not the usual ones.

    Raises:
        InputError: unknown effect, one that is there already, or one that these readings
            cannot show; an unknown option, or a bad value.
    """
    readings = before.readings
    if effect in before.model.names:
        raise InputError(
            f"effect {effect} is in the model already: {', '.join(before.model.names)}"
        )
    all_options = {**reading_options(effect, readings.m), **(options or {})}
    model = before.model + make(effect, before.model.cell, readings.states, all_options)
    start = np.concatenate([before.theta, np.zeros(model.size - before.model.size)])
    return fit(model, readings, before.mode, before.scaling, start)


def remove(before: Fit, effect: str) -> Fit:
    """Refit without an effect, from where the fit stands.

    Raises:
        InputError: an effect that is not there.
    """
    model = before.model
    if effect not in model.names:
        raise InputError(f"effect {effect} is not in the model: {', '.join(model.names)}")
    place = model.names.index(effect)
    rest = tuple(e for e in model.effects if e.name != effect)
    start = np.delete(before.theta, model.slices()[place])
    return fit(Model(model.cell, rest), before.readings, before.mode, before.scaling, start)


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Other effects in place of one.

    Attributes:
        own: the one, scored anew against the model without it.
        effects: the others, in the order in which they were added.
        fits: with the first of them, with the first two, ...
        log_evidence: of all of them together.
    """

    own: Suspect
    effects: tuple[str, ...]
    fits: tuple[Fit, ...]
    log_evidence: float

    @property
    def better(self) -> bool:
        """Whether the readings prefer the others, beyond doubt."""
        return self.log_evidence > self.own.score.log_evidence + SAME_EVIDENCE

    @property
    def as_good(self) -> bool:
        """Whether the readings do not tell the others from the one."""
        return self.log_evidence > self.own.score.log_evidence - SAME_EVIDENCE


def alternative(without: Fit, effect: str, never: Collection[str] = ()) -> Alternative:
    """Look for other effects that explain together what one does.

    The evidence of a chain of additions is the sum of theirs, ln p(r | all) − ln p(r | none), so
    that one large family and several small effects compare.

    Args:
        without: a fit that lacks the effect.
        effect: that was in the model.
        never: effects that were taken out before.
    """
    own: Suspect | None = None
    names: list[str] = []
    fits: list[Fit] = []
    total, current = 0.0, without
    for left in range(MOST_TOGETHER, 0, -1):
        p = projection(current)
        ranked = rank_suspects(p, candidates(p))
        if own is None:
            own = next(s for s in ranked if s.effect == effect)
        best = next((s for s in ranked if s.effect != effect and s.effect not in never), None)
        if best is None or best.score.log_evidence <= SAME_EVIDENCE:
            break
        # The best one comes first, so those that follow hardly add more than it does.
        if total + left * best.score.log_evidence < own.score.log_evidence - SAME_EVIDENCE:
            break
        names.append(best.effect)
        total += best.score.log_evidence - (PRICE if fits else 0.0)
        current = add(current, best.effect)
        fits.append(current)
        if total > own.score.log_evidence + SAME_EVIDENCE:
            break
    assert own is not None  # noqa: S101 - the first round finds it
    return Alternative(own, tuple(names), tuple(fits), total)


def again(without: Fit, effect: str) -> Suspect:
    """Score an effect anew, against a fit that lacks it."""
    p = projection(without)
    return next(s for s in rank_suspects(p, candidates(p)) if s.effect == effect)


def predicts_better(before: Fit, after: Fit) -> bool:
    """Whether the error on poses left out falls, by more than it scatters from pose to pose."""
    if np.any(before.outlier != after.outlier):
        return after.holdout.rms_sigma < (1 - LEAST_GAIN) * before.holdout.rms_sigma
    return improves(left_out_by_pose(before), left_out_by_pose(after))
