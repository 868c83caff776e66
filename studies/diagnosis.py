"""One case of the study of the diagnosis: a simulated campaign, its diagnosis and refinement.

Campaigns come from an external function (`Simulate`) with independent mechanics. Only the public
results of diagnosis and refinement are read. A case in which the program fails is an outcome, too:
it counts as a miss and states the reason.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hilcal.cell import Cell
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.serial_noise import with_serial_noise
from hilcal.diagnosis.verdict import diagnose
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.identification.prediction.full_prediction import full_prediction
from hilcal.present.verdict import message
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode
from hilcal.refinement import Refinement, refine
from hilcal.types import Floats

Kind = Literal["hidden", "nothing", "noise", "pairs", "outside"]
KINDS: tuple[Kind, ...] = ("hidden", "nothing", "noise", "pairs", "outside")
MOST = 3
"""Largest size of a set of inseparable effects that counts as an answer."""
NAMING = ("missing_effect", "ambiguous")
LEADING = 2
"""Number of variables of each list that count."""
INTERVAL = 1.959964
"""Half width of a 95 % interval, standard uncertainties."""


@dataclass(frozen=True, slots=True)
class DiagnosisCase:
    """Settings of a case.

    Attributes:
        kind: kind of the case.
        robot: name of the arm.
        mode: of the readings.
        hidden: hidden effects, or the hidden law outside of the catalogue; empty for nothing.
        strength: of each, rms in units of the noise.
        seed: of the simulation.
        stated: stated over true standard deviation of the noise.
        cycles: number of times that all poses are measured.
        again: whether readings that separate the suspects are measured in a further round.
    """

    kind: Kind
    robot: str
    mode: Mode
    hidden: tuple[str, ...]
    strength: float
    seed: int
    stated: float = 1.0
    cycles: int = 1
    again: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """A simulated campaign.

    Attributes:
        cell: as given to the program.
        readings: the readings.
        noise: (N, m) noise of each reading.
        truth: true parameters that are not zero, by the program's names.
        variables: variables of a law outside of the catalogue.
    """

    cell: Cell
    readings: Readings
    noise: Floats
    truth: Mapping[str, float]
    variables: tuple[str, ...] = ()


Simulate = Callable[[DiagnosisCase], Sample]
"""Simulate a campaign; equal settings give equal campaigns."""

More = Callable[[DiagnosisCase, Diagnosis], Readings | None]
"""Measure readings that separate the suspects of a diagnosis, and return all readings, those of the
campaign first; None where nothing is in doubt or can be separated."""


@dataclass(frozen=True, slots=True)
class Judgement:
    """The part of a diagnosis that a case needs.

    Attributes:
        verdict: in a word.
        lead: the first suspect.
        same_as: suspects that the readings do not separate from it.
        variables: variables that the residual follows most.
        carriers: variables that carry the predictable part of the residual.
        message: the verdict in a sentence.
        variance_factor: of the fit.
    """

    verdict: str
    lead: str
    same_as: tuple[str, ...]
    variables: tuple[str, ...]
    carriers: tuple[str, ...]
    message: str
    variance_factor: float

    @property
    def named(self) -> bool:
        """Whether the verdict names an effect."""
        return self.verdict in NAMING

    def finds(self, effect: str) -> bool:
        """Whether an effect is first, or one of at most three inseparable first ones."""
        return effect == self.lead or (effect in self.same_as and len(self.same_as) < MOST)

    def follows(self, variables: tuple[str, ...]) -> bool:
        """Whether one of the variables is among the first two of either list."""
        return not {*self.variables, *self.carriers}.isdisjoint(variables)


@dataclass(frozen=True, slots=True)
class AddedEffect:
    """An effect that a refinement added, and the effects inseparable from it."""

    effect: str
    same_as: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class IntervalCount:
    """Number of identifiable true parameters of an effect inside their 95 % intervals."""

    effect: str
    inside: int
    parameters: int


@dataclass(frozen=True, slots=True)
class RefinementResult:
    """Result of a refinement.

    Attributes:
        judgement: of the last model.
        added: added effects, in order.
        model: effects of the last model.
        holdout: error on poses left out over the stated noise floor.
        holdout_real: error on poses left out over the true noise of these readings.
        intervals: of the true effects in the last model.
    """

    judgement: Judgement
    added: tuple[AddedEffect, ...]
    model: tuple[str, ...]
    holdout: float
    holdout_real: float
    intervals: tuple[IntervalCount, ...]

    def finds(self, effect: str) -> bool:
        """Whether an effect is in the model, or inseparable from an added one."""
        return effect in self.model or any(
            effect in a.same_as and len(a.same_as) < MOST for a in self.added
        )


@dataclass(frozen=True, slots=True)
class DiagnosisOutcome:
    """A case.

    Attributes:
        case: its settings.
        first: judgement of the baseline; None where the case failed.
        refined: result of the refinement; None without one.
        again: judgement of the baseline after a round of further readings.
        variables: variables of a law outside of the catalogue.
        failure: reason for no answer; empty where there is one.
        impossible: reason why there is no such campaign; the case then does not count.
    """

    case: DiagnosisCase
    first: Judgement | None = None
    refined: RefinementResult | None = None
    again: Judgement | None = None
    variables: tuple[str, ...] = ()
    failure: str = ""
    impossible: str = ""


def run_case(
    asked: DiagnosisCase, simulate: Simulate, more: More | None = None, refined: bool = True
) -> DiagnosisOutcome:
    """Simulate, fit the baseline, diagnose as `diagnose` does, and refine as `refine` does.

    Args:
        asked: settings of the case.
        simulate: makes the campaign.
        more: measures a further round, if the settings ask for it.
        refined: whether the model is refined, too.
    """
    try:
        sample = simulate(asked)
    except InputError as error:  # e.g. a gear that would have to stiffen to nothing
        return DiagnosisOutcome(asked, impossible=_line(error))
    except Exception as error:
        return DiagnosisOutcome(asked, failure=f"{type(error).__name__}: {_line(error)}")
    try:
        return _run(asked, sample, more, refined)
    except Exception as error:
        return DiagnosisOutcome(asked, failure=f"{type(error).__name__}: {_line(error)}")


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def _run(
    asked: DiagnosisCase, sample: Sample, more: More | None, refined: bool
) -> DiagnosisOutcome:
    model = baseline(sample.cell, sample.readings, asked.mode)
    if refined and asked.kind not in ("nothing", "noise"):
        r = refine(model, sample.readings, asked.mode)
        diagnosis, result = r.steps[0].diagnosis, _refined(r, sample)
        if diagnosis.history.rejected:  # `diagnose` alone has no such history
            diagnosis = diagnose(diagnosis.fit)
    else:
        diagnosis, result = (
            diagnose(with_serial_noise(fit(model, sample.readings, asked.mode))),
            None,
        )
    again = None
    if more is not None and asked.again:
        readings, later = more(asked, diagnosis), diagnosis
        if readings is not None:
            later_model = baseline(sample.cell, readings, asked.mode)
            later = diagnose(fit(later_model, readings, asked.mode))
        again = judgement(later)
    return DiagnosisOutcome(asked, judgement(diagnosis), result, again, sample.variables)


def judgement(d: Diagnosis) -> Judgement:
    """Return the part of a diagnosis that a case needs."""
    lead = d.suspects[0] if d.suspects else None
    kinds = [
        v.variable for v in d.misfit_breakdown if v.variable.split()[0] not in ("pose", "direction")
    ]
    return Judgement(
        verdict=d.verdict,
        lead="" if lead is None else lead.effect,
        same_as=() if lead is None else lead.same_as,
        variables=tuple(kinds[:LEADING]),
        carriers=tuple(c.variable for c in d.dependences[:LEADING]),
        message=message(d),
        variance_factor=d.fit.variance_factor,
    )


def _refined(r: Refinement, sample: Sample) -> RefinementResult:
    last = r.steps[-1]
    floor, real = _floors(last.fit, sample)
    return RefinementResult(
        judgement=judgement(last.diagnosis),
        added=tuple(
            AddedEffect(after.added, _same_as(before.diagnosis, after.added))
            for before, after in zip(r.steps, r.steps[1:], strict=False)
            if after.added is not None
        ),
        model=last.fit.model.names,
        holdout=last.fit.holdout.rms_m / floor,
        holdout_real=last.fit.holdout.rms_m / real,
        intervals=intervals(last.fit, sample.truth),
    )


def _same_as(d: Diagnosis, effect: str) -> tuple[str, ...]:
    return next((s.same_as for s in d.suspects if s.effect == effect), ())


def _floors(f: Fit, sample: Sample) -> tuple[float, float]:
    """Root mean square position error by the stated noise, and by the true noise, m."""
    e = full_prediction(f)
    noise = e.whitening.raw(sample.noise)[:, :3]
    return e.noise_floor, float(np.sqrt(np.mean(np.sum(noise**2, axis=1))))


def intervals(f: Fit, truth: Mapping[str, float]) -> tuple[IntervalCount, ...]:
    """Count true parameters in their 95 % intervals, of effects in the truth.

    Parameters that are not identifiable have no interval. Newly registered frames have no true
    value.
    """
    true_effects = {name.split(".")[0] for name in truth}
    out = []
    for effect, rows in zip(f.model.effects, f.model.slices(), strict=True):
        if effect.name not in true_effects:
            continue
        true = np.array([truth.get(f"{effect.name}.{p.name}", 0.0) for p in effect.parameters])
        identifiable = f.uncertainty.identifiable[rows]
        error = np.abs(f.theta[rows] - true)[identifiable]
        inside = error <= INTERVAL * f.uncertainty.std[rows][identifiable]
        out.append(IntervalCount(effect.name, int(inside.sum()), int(identifiable.sum())))
    return tuple(out)
