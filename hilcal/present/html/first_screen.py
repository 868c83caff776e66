"""The first screen: is the model good, where is it wrong, what is missing; before, after, limit."""

from collections.abc import Iterator

import numpy as np
from scipy.stats import chi2

from hilcal import numbers
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.identification.fit import Fit
from hilcal.identification.full_prediction import error_before, names
from hilcal.identification.variance_factor import CONFIDENCE
from hilcal.present.fit import follows, misses
from hilcal.present.html.content import ReportContent
from hilcal.present.html.page import Card, FirstScreen
from hilcal.present.verdict import headline, message
from hilcal.store.plan import UNLOADED
from hilcal.types import Floats


def first_screen(m: ReportContent) -> FirstScreen:
    """Return what the first screen says."""
    d, fit = m.diagnosis, m.fit
    headline, tone = headline_of(d)
    limit, passed = limit_words(m)
    return FirstScreen(
        headline,
        tone,
        (
            ("Is the model good?", how_good(m)),
            ("Where is it wrong?", where_wrong(m)),
            ("What is missing?", missing(d)),
        ),
        tuple(_cards(m, fit)),
        limit,
        passed,
    )


def headline_of(d: Diagnosis | None) -> tuple[str, str]:
    """Return the verdict in a few words, and its tone."""
    if d is None:
        return "Not judged: only a model fitted with scaling gc can be", "doubt"
    said = headline(d)
    if d.verdict == "missing_effect" and d.lead is not None:
        said = f"{said}: {d.lead.effect}"
    good, open_ = d.verdict == "adequate", d.verdict in ("ambiguous", "noise_misjudged")
    tone = "good" if good else "doubt" if open_ and not d.wrong_figures else "bad"
    return f"{said[0].upper()}{said[1:]}", tone


def how_good(m: ReportContent) -> str:
    """Say in a sentence how well the model predicts."""
    d, prior = m.diagnosis, m.fit.model.prior
    told = misses(m.fit)
    if prior is not None:
        told += f" It also rests on a prior: {prior.posterior.source.campaign or 'a posterior'}."
    if d is None:
        return told
    if d.verdict == "noise_misjudged":
        return f"It cannot be told, for the stated noise is wrong. {told}"
    good = d.verdict == "adequate" or d.reason == "inseparable_addition"
    return f"{'Yes' if good else 'Not yet'}. {told}"


def where_wrong(m: ReportContent) -> str:
    """Say in a sentence where it is worst, and what the misfit follows."""
    d, fit, error = m.diagnosis, m.fit, left_out_errors(m.fit)
    furthest = int(fit.whitening.reading[np.argmax(error)])
    pose, load = names(fit.readings[~fit.outlier], furthest)
    at = "unloaded" if load == UNLOADED else f"under {load}"
    said = f"Of the poses left out, {pose} {at} is furthest off: {numbers.length(error.max())}."
    if d is None:
        return said
    if not d.residual_is_noise:
        return f"{said} {follows(d.misfit_breakdown)}"
    if not beyond_noise(fit):
        return "Nowhere beyond the noise: all poses and loads are predicted within it."
    return (
        "Nowhere in particular: what is left of the fitted poses is noise. Poses left out are off "
        f"by {fit.holdout.rms_sigma:.2f} times the noise, more than by chance; more poses would "
        f"lower that. {said}"
    )


def beyond_noise(fit: Fit) -> bool:
    """Whether poses left out are further off than the noise alone leaves them by chance.

    With R whitened elements of standard deviation 1 their sum of squares is χ²(R).
    """
    count = fit.whitening.rank
    return bool(fit.holdout.rms_sigma**2 * count > chi2.isf((1 - CONFIDENCE) / 2, count))


def missing(d: Diagnosis | None) -> str:
    """Say what is missing, and what that effect is."""
    if d is None:
        return "Not judged; hilcal identify --scaling gc, then hilcal diagnose, say it."
    if d.verdict == "adequate":
        return "Nothing that these readings could show."
    said = numbers.sentence(message(d), d.significant)
    if d.lead is None or d.wrong_figures:
        return said
    name = d.lead.coarse or d.lead.effect
    return f"{said} {name} is: {d.fit.model.catalogue[name].summary}."


def _cards(m: ReportContent, fit: Fit) -> Iterator[Card]:
    before = error_before(fit)
    what = (
        "deflection under load; a rigid arm has none"
        if fit.mode == "deflection"
        else "nominal arm, only its frames fitted"
    )
    yield Card(
        "Before",
        numbers.length(before.rms_m),
        f"rms; largest {numbers.length(before.max_m)}; {what}",
    )
    if m.tested is not None:
        e = m.tested.found.prediction.error
        seen = "never fitted" if m.tested.found.judged.unseen else "fitted, so no test"
        yield Card(
            "After, validation",
            numbers.length(e.rms_m),
            f"rms; largest {numbers.length(e.max_m)}; {seen}",
        )
    if m.corrected is not None:
        e = m.corrected["error"]
        before_m, after_m = (numbers.length(float(e[k]["rms_m"])) for k in ("before", "after"))
        yield Card(
            "Measured at corrected targets",
            after_m,
            f"rms; {before_m} without correction; {e['count']} points",
        )
    held = fit.holdout
    yield Card(
        "After, poses left out",
        numbers.length(held.rms_m),
        f"rms; largest {numbers.length(held.max_m)}",
    )
    yield Card(
        "Noise alone",
        numbers.length(m.story.noise_floor_m),
        "rms that the stated noise would leave",
    )


def limit_words(m: ReportContent) -> tuple[str, bool | None]:
    """Say whether the limit is kept, and by what that was judged."""
    if m.limit_m is None:
        return "", None
    limit = numbers.length(m.limit_m)
    if m.tested is not None:
        a = m.tested.found.shares
        passed = bool(a.passed)
        head = "PASSED" if passed else "FAILED"
        so = f"{a.everything.count - a.over} of {a.everything.count} errors are within {limit}"
        largest = numbers.length(a.everything.max_m)
        end = f" (campaign {m.tested.name}, never fitted; largest {largest})."
        if a.undecided:
            end += " Noise alone exceeds the limit, so that these readings cannot tell."
        return f"{head}: {so}{end}", passed
    error = left_out_errors(m.fit)
    over = int(np.sum(error > m.limit_m))
    head = "PASSED" if over == 0 else "FAILED"
    return (
        f"{head}: {len(error) - over} of {len(error)} errors are within {limit}, each pose "
        f"predicted without itself (largest {numbers.length(float(error.max()))}). No validation "
        "campaign was given: an independent test is missing."
    ), over == 0


def left_out_errors(fit: Fit) -> Floats:
    """Return the 3-D errors (D,) of fitted measurements predicted without their pose, m."""
    return np.asarray(np.linalg.norm(fit.left_out[:, :3], axis=1))
