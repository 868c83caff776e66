"""Laws that the readings speak for, in words."""

from collections.abc import Iterator, Sequence

import numpy as np

from hilcal import numbers
from hilcal.diagnosis.misfit_breakdown import ROW_ORDER
from hilcal.discovery.curve import Curve
from hilcal.discovery.discovery import Discovery, LawSearch
from hilcal.discovery.law import Coefficient, Law
from hilcal.discovery.structures import Structure, pareto
from hilcal.present.diagnosis import binned_table, curves
from hilcal.present.document import Block, Words, heading, table
from hilcal.present.fit import model_name

FEW = 3
LEAST_BINS = 3
"""Bins that make a curve; a choice."""
RARE = 0.01
"""Probability below which no figure is written."""
NOT_TRIED = "could not be tried in the exact model"


def discovery_report(d: Discovery) -> Iterator[Block]:
    """Yield what was found, or why nothing is proposed."""
    yield heading(f"Laws for what {model_name(d.fit.model.named)} leaves unexplained")
    if not d.laws:
        yield numbers.sentence(silence(d))
        yield from curves(d.carried)
        return
    yield (
        f"{d.candidates} candidates were tried. Searched for without them, laws explain "
        f"{numbers.percent(d.searched_share)} of the misfit on poses left out."
    )
    for k, law in enumerate(d.laws):
        yield ""
        yield from _law(law, d, first=k == 0)
        if k == 0:
            yield from curve_tables(d.curves)
    yield ""
    yield from structures_table(d.structures)
    moved, std = map(numbers.length, d.average_m())
    yield (
        f"Averaged over them by their probability, laws move the readings by {moved} rms; what is "
        f"then predicted has a standard uncertainty of {std}, the choice of the law included."
    )
    for what, why in (*d.refused, *d.unfitted):
        yield f"{what} {NOT_TRIED} ({why})."


def silence(d: Discovery) -> str:
    """Say why no law is proposed, and what could not be tried."""
    return _silence(d) + "".join(f"; {e} {NOT_TRIED} ({why})" for e, why in d.unfitted)


def _silence(d: Discovery) -> str:
    tried = f"{d.candidates} candidates were tried"
    if d.reason == "adequate":
        return (
            f"no law: the stated noise explains the residual (variance factor "
            f"{d.fit.variance_factor:.2f}), so there is nothing to explain"
        )
    if d.reason == "catalogue":
        return (
            f"no law: {tried}, and none explains the misfit better than effects of the catalogue "
            f"do ({numbers.names(d.catalogue)}); hilcal refine adds them"
        )
    if d.refused:
        law, why = d.refused[0]
        return (
            f"no law is proposed: {tried}; {law} predicts {numbers.percent(d.searched_share)} of "
            f"the misfit on poses left out, but the exact model cannot be fitted with it ({why})"
        )
    if d.reason == "no_law":
        return (
            f"no law: {numbers.percent(d.attainable)} of the misfit is predictable on poses left "
            f"out, but {tried}, and no law of this size predicts it; {_what_helps(d)}"
        )
    return f"no law: {tried}, and nothing recorded predicts the misfit on poses left out"


def _what_helps(d: Discovery) -> str:
    if any(c.variable == ROW_ORDER for c in d.carried[:1]):
        return (
            "it depends mostly on the order of the readings, whose times are missing: without "
            "them no law of time can be searched, so add them"
        )
    return "measure more poses, or record what else may matter"


def _law(law: Law, d: Discovery, first: bool) -> Iterator[Block]:
    yield Words(law.formula, "good" if first else "strong")
    yield f"  acts on      {', '.join(law.acts_on)}"
    yield f"  depends on   {', '.join(law.variables) or 'nothing: a constant'}"
    for c in law.parameters:
        yield f"  {c.name:<12} {coefficient(c)}"
    told = f"  explains     {numbers.percent(law.holdout_share)} of the misfit on poses left out"
    if d.attainable > 0:
        told += f", {numbers.percent(min(law.holdout_share / d.attainable, 1.0))} of what can be"
    yield told
    yield f"  left         variance factor {law.left:.2f}, before {d.fit.variance_factor:.2f}"
    yield f"  chance       {numbers.p_equals(law.p_value)}, the search paid for"
    yield "  found again  in the searches without some poses:"
    for a in law.again:
        causes = f" by {', '.join(a.variables)}" if a.variables else ""
        yield f"    {a.acts_on}{causes}: {numbers.percent(a.share)}"
    near = [f"{r.effect} (cosine {r.cosine:.2f})" for r in law.resembles[:FEW]]
    if near:
        yield f"  resembles    {', '.join(near)}"
    seen = [
        f"{symbol} {numbers.digits(low)} to {numbers.digits(high)}{'' if u == '1' else f' {u}'}"
        for symbol, low, high, u in law.ranges
    ]
    if seen:
        yield f"  seen for     {', '.join(seen)}; nothing is known outside"


def structures_table(of: Sequence[Structure]) -> Iterator[Block]:
    """Yield the likely laws: probability, complexity, share on poses left out."""
    best = pareto(of)
    rows = table("law", "probability", "complexity", "on poses left out", "")
    for x in of:
        said = [x.law] if x.law else []
        said += ["best of its size"] if x in best else []
        share = numbers.percent(x.holdout_share)
        chance = numbers.percent(x.probability) if x.probability >= RARE else f"< {100 * RARE:g} %"
        rows.add(x.form.text(), chance, str(x.form.complexity), share, ", ".join(said))
    yield rows


def curve_tables(of: Sequence[Curve]) -> Iterator[Block]:
    """Yield the law over each quantity beside the mean of the readings there."""
    for c in of:
        x, y, std, _ = c.binned
        if len(x) < LEAST_BINS:
            continue
        head = c.quantity if c.quantity_unit == "1" else f"{c.quantity} [{c.quantity_unit}]"
        yield ""
        yield binned_table((head, c.of), c.unit, (x, y, std), law=np.interp(x, *c.line))


def coefficient(c: Coefficient) -> str:
    """Write a coefficient with its standard uncertainty, in a unit for people."""
    value, std, unit = numbers.measured(c.unit, c.value, c.std)
    return f"{value} ± {std} {'' if unit == '1' else unit}".rstrip()


def refined_laws(s: LawSearch) -> Iterator[Block]:
    """Yield what the searches of a refinement came to: laws that stayed, or why there is none."""
    for d in s.found:
        if not d.laws:
            yield numbers.sentence(silence(d))
            continue
        law = d.laws[0]
        if law.name not in s.files:
            yield f"{law.formula} was tried, and did not lower the error on poses left out."
            continue
        yield heading(f"{law.name}: a law that the catalogue does not have")
        yield from _law(law, d, first=True)
        yield (
            f"It is the effect {law.name} in {s.files[law.name]}, to be edited; commands that read "
            f"these revisions take it by --effects-from.\n"
        )
