"""What `bootstrap` says, and its JSON document."""

from collections.abc import Iterator

import numpy as np

from hilcal import numbers
from hilcal.identification.bootstrap import Bootstrap
from hilcal.identification.priors import names_of
from hilcal.present.document import Block, Table, heading, note, table
from hilcal.present.fit import kind, model_name

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
    rows = table(
        "parameter", "value", "± stated", "± drawn", "ratio", "95 % of the draws", "unit",
        left=(0, 6),
    )  # fmt: skip
    fit, (low, high) = found.fit, found.interval()
    units = [p.unit for e in fit.model.effects for p in e.parameters]
    for k, name in enumerate(names_of(fit.model)):
        if not found.compared[k]:
            continue
        unit, factor = numbers.unit_for(units[k], [float(fit.theta[k])])
        value, stated = numbers.with_std(
            factor * float(fit.theta[k]), factor * float(fit.uncertainty.std[k])
        )
        drawn = numbers.with_std(0.0, factor * float(found.std[k]))[1]
        places = len(stated.partition(".")[2])
        between = f"{factor * float(low[k]):.{places}f} to {factor * float(high[k]):.{places}f}"
        rows.add(name, value, stated, drawn, f"{found.ratio[k]:.2f}", between, unit)
    return rows


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
