"""Whether the stated noise is to blame, where no effect is: the rule and its sentence.

An effect is judged against the scatter as it is (F-tests), so a noise that is misjudged as a
whole names none. What remains is a χ² that is too large or too small:

- too small: no model makes residuals smaller than the noise; the statement is too large;
- too large, and repeats scatter as much: the statement is too small;
- too large, and repeats scatter less: the model misses something;
- too large, without enough repeats: the noise only where nothing at all predicts the residual,
  and the sentence says that this cannot be known.
"""

from dataclasses import dataclass

from scipy.stats import chi2

from hilcal.diagnose.noise import PureError
from hilcal.identify.fit import Fit

MISFIT_ALARM = 0.0005
"""Chance of calling the variance factor wrong where it is right, each side."""
PREDICTABLE = 0.1
"""Share of the misfit that a generic learner must predict for the model to be to blame."""


@dataclass(frozen=True, slots=True)
class NoiseVerdict:
    """What a variance factor that is off, or not, says of the noise.

    Attributes:
        misjudged: the stated noise is to blame.
        off: the variance factor is not what chance allows.
        message: a sentence; empty where nothing is to be said of the noise.
    """

    misjudged: bool
    off: bool
    message: str


def judge_noise(fit: Fit, repeats: PureError | None, predictable: bool) -> NoiseVerdict:
    """Judge the noise of a fit in which no effect is found missing.

    Args:
        fit: the fit.
        repeats: what repeated readings say.
        predictable: whether anything predicts the residual on poses left out.
    """
    high = float(chi2.sf(fit.chi2, fit.dof)) < MISFIT_ALARM
    low = float(chi2.cdf(fit.chi2, fit.dof)) < MISFIT_ALARM
    where = _where(repeats)
    if not high and not low:
        return NoiseVerdict(False, False, where)
    spread = f"{fit.variance_factor**0.5:.2g} times the stated noise"
    apart = repeats is not None and not repeats.interval[0] <= 1 <= repeats.interval[1]
    lacking = repeats is not None and repeats.lack_of_fit_p <= MISFIT_ALARM
    if repeats is not None and apart and (low or not lacking):
        return NoiseVerdict(
            True,
            True,
            f"Repeated readings scatter {repeats.factor**0.5:.2g} times as much as stated, and "
            f"the residuals no {'less' if low else 'more'} than the repeats: scale the covariance "
            f"by {repeats.factor:.2g}; no effect is missing{where}",
        )
    if low:
        return NoiseVerdict(
            True, True, f"Residuals are only {spread}: the stated covariance is too large{where}"
        )
    if lacking or predictable:
        beyond = (
            ""
            if repeats is None
            else (
                f"; repeated readings scatter only {repeats.factor**0.5:.2g} times what is stated"
            )
        )
        return NoiseVerdict(False, True, beyond if lacking else "")
    few = "without repeated readings" if repeats is None else "with so few repeated readings"
    return NoiseVerdict(
        True,
        True,
        f"Residuals are {spread} and nothing predicts them; {few} the program cannot know "
        "whether the noise is larger than stated: repeat some readings",
    )


def _where(repeats: PureError | None) -> str:
    """Say where the noise differs from what is stated, as the end of a sentence."""
    if repeats is None or repeats.where is None:
        return ""
    w = repeats.where
    place = {"axis": w.name, "joint": f"along the motion of {w.name}"}.get(
        w.kind, f"{'of' if w.name == 'unloaded' else 'under'} {_readings(w.name)}"
    )
    return (
        f"; it differs most {place}, where the repeats scatter {w.factor**0.5:.2g} times as much "
        "as stated"
    )


def _readings(name: str) -> str:
    return "unloaded readings" if name == "unloaded" else name
