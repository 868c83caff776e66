"""Readings that were never fitted, by load, pose and limit; poses that were drawn again."""

from collections.abc import Iterable, Iterator

import numpy as np

from hilcal import numbers
from hilcal.identification.bootstrap import Bootstrap
from hilcal.identification.priors import names_of
from hilcal.identification.validation import (
    BAND,
    Acceptance,
    Beyond,
    Extrapolation,
    Judged,
    Share,
    Validation,
)
from hilcal.present.document import Block, Table, heading, load_name, note, table
from hilcal.present.fit import error_words, kind, model_name
from hilcal.types import Floats

MOST = 4
"""Variables that are listed."""
WORST = 6
"""Poses that are listed."""
DOUBTED = 1.5
"""Error over the stated standard deviation from which the statement is called too small."""


def opening(judged: Judged, found: Validation) -> Iterator[str]:
    """Yield how many of the readings were fitted, and how far the others are off."""
    error = f"{numbers.length(found.error.rms_m)} rms"
    noise = f"noise alone would leave {numbers.length(found.noise_floor)}.\n"
    count = f"{len(found.raw)} {judged.what}"
    if not judged.unseen:
        all_ = "All" if judged.fitted == judged.readings else f"{judged.fitted} of the"
        yield (
            f"{all_} {judged.readings} readings were fitted by {judged.model}: these errors say "
            f"how well it fits, not how well it predicts. {count} are off by {error}; {noise}"
        )
        return
    if judged.fitted:
        more = f", and {judged.spoilt} more share an unloaded reading" if judged.spoilt else ""
        yield (
            f"{judged.fitted} of the {judged.readings} readings were fitted by {judged.model}"
            f"{more}; they are left out."
        )
    yield f"{count} that were never fitted are predicted to {error}; {noise}"


def validation_report(judged: Judged, found: Validation, beyond: Extrapolation) -> Iterator[Block]:
    """Yield the errors, inside and outside of what was measured, and where outside is."""
    out = table(error_words(found.readings), "rms", "mean", "largest", "rms in σ", "stated", "z")
    inside, outside = beyond.inside_error, beyond.outside_error
    every = np.ones(len(beyond.z), dtype=np.bool_)
    rows = [("never fitted" if judged.unseen else "fitted", found.error, every)]
    if inside is not None and outside is not None:
        parts = (("inside", inside, ~beyond.outside), ("outside", outside, beyond.outside))
        rows += parts
    for name, e, mine in rows:
        lengths = (numbers.length(x) for x in (e.rms_m, e.mean_m, e.max_m))
        stated = numbers.length(_rms(beyond.stated_m[mine]))
        out.add(name, *lengths, f"{e.rms_sigma:.2f}", stated, f"{_rms(beyond.z[mine]):.2f}")
    out.add("noise alone", numbers.length(found.noise_floor), "", "", "1.00", "", "")
    yield out
    yield note(
        "stated: standard deviation that the fit states for these readings, what it does not know "
        "where nothing was measured included; z: error over it.\n"
    )
    yield from _where(beyond)
    if (z := _rms(beyond.z)) > DOUBTED:
        yield f"These readings are {z:.2g} times as far off as the fit states.\n"


def _where(beyond: Extrapolation) -> Iterator[str]:
    """Yield where readings lie outside."""
    count, total = int(beyond.outside.sum()), len(beyond.outside)
    if not count:
        yield "All of them lie inside of what was measured.\n"
        return
    yield f"Extrapolation: {count} of {total} lie outside of what was measured:"
    for v in beyond.variables[:MOST]:
        yield f"  {_beyond(v)}"
    more = len(beyond.variables) - MOST
    yield f"  and {more} more variables\n" if more > 0 else ""


def _beyond(v: Beyond) -> str:
    if v.variable == "leverage":
        return f"leverage: {v.count}, far from all fitted poses in several joints together"
    if v.unit == "rad":
        low, high, most = (f"{np.degrees(x):.0f}°" for x in (v.low, v.high, v.most))
    else:
        unit = "°C" if v.unit == "K" else v.unit  # the readings hold °C, differences are in K
        low, high = (f"{numbers.digits(x)} {unit}" for x in (v.low, v.high))
        most = f"{numbers.digits(v.most)} {v.unit}"
    return f"{v.variable}: {v.count}, by up to {most} (measured: {low} to {high})"


def shares_report(found: Acceptance) -> Iterator[Block]:
    """Yield errors by load, the worst poses, and whether a limit is kept."""
    yield from loads_report(found)
    yield worst_table(found)
    yield ""
    if found.limit_m is not None:
        yield _limit_words(found, found.limit_m)


def loads_report(found: Acceptance) -> Iterator[Block]:
    """Yield errors by load."""
    every = () if len(found.loads) == 1 else (found.everything,)
    yield _shares_table("load", "at", (*found.loads, *every), found.limit_m)
    yield note(
        f"in 95 %: share of the readings inside of their stated {100 * BAND:.0f} % region.\n"
    )


def worst_table(found: Acceptance) -> Table:
    """Return the errors of the worst poses."""
    return _shares_table("worst poses", "load", found.poses[:WORST], found.limit_m)


def _shares_table(of: str, at: str, shares: Iterable[Share], limit: float | None) -> Table:
    heads = (of, "n", "rms", "largest", at, "stated", "z", "in 95 %")
    out = table(*heads, *(() if limit is None else ("limit",)), left=(0, 4))
    for s in shares:
        rms, largest, stated = (numbers.length(x) for x in (s.rms_m, s.max_m, s.stated_m))
        kept = () if limit is None else ("kept" if s.passes(limit) else "over",)
        within = f"{100 * s.within:.0f} %"
        out.add(s.name, str(s.count), rms, largest, s.worst, stated, f"{s.z:.2f}", within, *kept)
    return out


def _limit_words(found: Acceptance, limit: float) -> str:
    size, a = numbers.length(limit), found.everything
    worst = found.poses[0]
    largest = f"the largest error is {numbers.length(a.max_m)}, at {_place(worst)}"
    if found.passed:
        return f"PASSED: no error is over the limit of {size}; {largest}.\n"
    poses = sum(not s.passes(limit) for s in found.poses)
    return (
        f"FAILED: {found.over} of {a.count} errors are over the limit of {size}, at {poses} of "
        f"{len(found.poses)} poses; {largest}.\n"
    )


def _place(worst: Share) -> str:
    """Return a pose and the load of its largest error."""
    return f"{worst.name} {load_name(worst.worst, 'under ')}"


def validation_failure(found: Acceptance, judged: Judged) -> str:
    """Return the one line on a limit that is not kept."""
    limit, worst = found.limit_m or 0.0, found.poses[0]
    head = (
        f"the limit of {numbers.length(limit)} is not kept: {found.over} of "
        f"{found.everything.count} {judged.what} are further off, {_place(worst)} by "
        f"{numbers.length(worst.max_m)}"
    )
    if not found.undecided:
        return head
    return (
        f"{head}; but noise alone leaves {numbers.length(found.noise_m)} rms, so that these "
        "readings cannot tell: measure with less noise, or give a limit above it"
    )


def _rms(x: Floats) -> float:
    return float(np.sqrt(np.mean(x**2)))


WIDER = 1.5
"""Ratio from which on the stated standard uncertainty is called too small; a choice. The standard
deviation of 200 draws is known to 5 %, but that of few poses to much less."""

CROWDED = 0.5
"""Degrees of freedom that a fit spends, per pose, from which on draws are too wide; a choice."""


def bootstrap_report(found: Bootstrap) -> Iterator[Block]:
    """Yield all that people want to know of a bootstrap."""
    fit = found.fit
    yield heading(f"Model: {model_name(fit.model.named)}")
    yield (
        f"Fitted to {kind(fit)}; {len(found.theta)} times to {found.poses} poses drawn from its "
        f"{found.poses}, with replacement.\n"
    )
    if found.compared.any():
        yield _table(found)
        yield note(
            "± stated: standard uncertainty of the fit. ± drawn: standard deviation over the draws."
            "\n"
        )
    yield from bootstrap_remarks(found)


def _table(found: Bootstrap) -> Table:
    heads = ("parameter", "value", "± stated", "± drawn", "ratio", "95 % of the draws", "unit")
    out = table(*heads, left=(0, 6))
    fit, ends = found.fit, found.interval()
    units = [p.unit for e in fit.model.effects for p in e.parameters]
    for k, name in enumerate(names_of(fit.model)):
        if not found.compared[k]:
            continue
        theta, std = float(fit.theta[k]), float(fit.uncertainty.std[k])
        unit, factor = numbers.unit_for(units[k], [theta])
        value, stated = numbers.with_std(factor * theta, factor * std)
        drawn = numbers.with_std(0.0, factor * float(found.std[k]))[1]
        places = len(stated.partition(".")[2])
        between = " to ".join(f"{factor * float(end[k]):.{places}f}" for end in ends)
        out.add(name, value, stated, drawn, f"{found.ratio[k]:.2f}", between, unit)
    return out


def bootstrap_remarks(found: Bootstrap) -> Iterator[str]:
    """Yield what the draws say of the stated standard uncertainties."""
    known = found.ratio[found.compared]
    if len(known):
        yield (
            f"Over the draws the parameters scatter {known.min():.2f} to {known.max():.2f} times "
            f"as far as is stated (median {np.median(known):.2f})."
        )
    names = names_of(found.fit.model)
    wide = sorted(np.flatnonzero(found.ratio > WIDER), key=lambda k: -found.ratio[k])
    if wide:
        listed = numbers.few([f"{names[k]} ({found.ratio[k]:.1f} times)" for k in wide], 5)
        spent = found.fit.solution.effective
        if spent > CROWDED * found.poses:
            yield (
                f"Wider than stated: {listed}. This does not show that the stated ones are too "
                f"small: the fit spends {spent:.0f} degrees of freedom on {found.poses} poses, and "
                "draws, which have 63 % of the poses, scatter too much then. More poses tell."
            )
        else:
            yield (
                f"Stated too small, or few poses carry it: {listed}. Take the drawn one, and "
                "measure more poses that move these parameters."
            )
    elif found.fit.uncertainty.inflated:
        yield (
            "The residuals are larger than the noise. What neighbouring poses then have in common "
            "is chance for draws of single poses; the stated ones, found by leaving out regions of "
            "joint space, are the ones to use."
        )
    elif len(known):
        yield f"None scatters more than {WIDER:g} times as far: the stated ones can be used."
    other = int((found.fit.solution.estimated & ~found.compared).sum())
    if other:
        yield (
            f"{other} parameters are not compared: the readings do not determine them, or they "
            "are of a family that shrinks its parameters towards zero."
        )
    if found.failed:
        yield (
            f"{found.failed} further draws are left out: their poses do not determine the "
            "parameters. What is said of the others is too good by that."
        )
