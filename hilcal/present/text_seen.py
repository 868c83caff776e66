"""Minimum detectable effects: the strength from which an effect would have been found."""

from collections.abc import Iterator

import numpy as np
from rich.console import RenderableType
from rich.text import Text

from hilcal import numbers
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.minimum_detectable_effect import Strength
from hilcal.present import text
from hilcal.present.verdict_words import broken, implausible


def could_have_been_seen(d: Diagnosis) -> Iterator[RenderableType]:
    """Yield the table of effects that were not found, the best visible first."""
    rest = [s for s in d.suspects if not s.passes]
    seen = sorted((s for s in rest if s.shown), key=lambda s: s.least.displacement_m)
    hidden = d.not_shown
    if seen:
        yield ""
        out = text.table("not found", "would be seen from", "its parameters, rms", left=(0, 2))
        for s in seen:
            out.add_row(s.effect, numbers.length(s.least.displacement_m), own_units(s.least))
        yield out
        yield Text(
            "would be seen from: rms displacement of the target at which nine campaigns like this "
            "one in ten would name the effect; rms of the parameters that make it.\n",
            style="dim",
        )
    for s in rest:
        if s.least.finest_m is not None:
            much = numbers.length(s.least.finest_m)
            when = f"from {much}" if np.isfinite(s.least.finest_m) else "at no size"
            yield f"A {s.effect} finer than these poses resolve would be seen {when}.\n"
    if hidden:
        yield f"At no plausible size would these readings show {numbers.names(hidden, 'or')}.\n"


def own_units(least: Strength) -> str:
    """Write a strength in the units of the effect's parameters."""
    return numbers.sizes(least.parameters)


def doubtful(d: Diagnosis) -> Iterator[str]:
    """Yield suspects that would need an implausible size, or do not keep what they promise."""
    for s in d.suspects:
        if not s.plausible and s.score.p_value < text.CERTAIN:
            yield f"{s.effect} is implausible: it {implausible(s)}."
        elif not s.keeps:
            yield f"{s.effect} is not named: {broken(s)}."


def redundant_line(d: Diagnosis) -> Iterator[str]:
    """Yield a sentence on effects of the model without which the readings are explained as well."""
    if d.redundant:
        names = ", ".join(d.redundant)
        it = "it" if len(d.redundant) == 1 else "them"
        yield (
            f"These readings are explained as well without {names}; to remove {it}: "
            f"hilcal remove RUN {d.redundant[0]}."
        )
