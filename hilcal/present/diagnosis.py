"""Reports of diagnoses, revisions and laws: suspects, detectable effects, curves."""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hilcal import numbers
from hilcal.diagnosis.diagnosis import Diagnosis, in_doubt
from hilcal.diagnosis.effect_ranking import FALSE_ALARM, LEAST_SHARE, Suspect
from hilcal.diagnosis.live_model import FEWEST_POSES
from hilcal.diagnosis.noise import PureError
from hilcal.diagnosis.recorded import ROW_ORDER
from hilcal.diagnosis.residual_regression import Dependence
from hilcal.diagnosis.stepwise import predicts_better
from hilcal.discovery.discovery import Discovery, LawSearch
from hilcal.discovery.law import Coefficient, Law
from hilcal.discovery.search import pareto
from hilcal.effects.catalogue import Catalogue
from hilcal.identification.fit import Fit
from hilcal.names import quoted
from hilcal.numbers import length, percent
from hilcal.present.document import Block, Table, Tone, Words, heading, note, table
from hilcal.present.fit import (
    MAX_SHOWN_P,
    dependence_sentence,
    holdout_sentence,
    model_name,
    where_table,
)
from hilcal.present.verdict import erring_quantity, headline, implausible, message, unconfirmed
from hilcal.types import Floats

if TYPE_CHECKING:
    from hilcal.campaign.changes import StoredChange

MOST_SUSPECTS = 6
BARS = "▁▂▃▄▅▆▇█"
MOST_CURVES = 2
MOST_COMPARED = 24  # most parameters that are compared with the true ones
MOST_RESEMBLING, LEAST_BINS = 3, 3  # listed effects that a law resembles; bins of a curve
MIN_SHOWN = 0.01  # probability below which only "< 1 %" is written
NOT_TRIED = "could not be tried in the exact model"
RUN_EXPLANATION = f"""\
The following lines are those of a real run: the motions of the arm, and each reading with its pose,
load and cycle. The run begins next to the reference pose, so that every joint reaches it from a
known side. From {FEWEST_POSES} poses on, a first model predicts each reading before it is fitted to
it, and the residual is printed: large while the model is fitted to few poses and lacks the hidden
effect."""


def verdict_line(d: Diagnosis) -> Words:
    """Return the verdict with its message."""
    tone: Tone = "good" if d.verdict == "adequate" else "doubt"
    return Words(f"Verdict: {headline(d)}.\n{message(d)}", tone, headline(d))


ORDER = "Effects that pass every test stand first; others by evidence, less for more parameters."


def suspects_table(d: Diagnosis, most: int = MOST_SUSPECTS) -> Table:
    """Return the table of the most significant suspects."""
    heads = ("missing effect?", "explains", "on poses left out", "p-value", "inseparable from")
    out = table(*heads, left=(0, 4))
    for s in shown_suspects(d)[:most]:
        shares = percent(s.share), percent(max(s.holdout_share, 0.0))
        same = numbers.few(s.same_as) if s.passes else ""
        out.add(s.effect, *shares, numbers.chance(s.score.p_value), same)
    return out


def shown_suspects(d: Diagnosis) -> list[Suspect]:
    """Return the suspects that pass the test or have a p-value below `MAX_SHOWN_P`."""
    return [s for s in d.suspects if s.passes or s.score.p_value < MAX_SHOWN_P]


def diagnosis_report(d: Diagnosis) -> Iterator[Block]:
    """Yield verdict, suspects and the variables that the misfit follows."""
    yield from (heading(f"Model: {model_name(d.fit.model.named)}"), holdout_sentence(d.fit))
    if d.verdict != "adequate" and not d.dependences:
        yield dependence_sentence(d.misfit_breakdown)
    yield from ("", verdict_line(d), "")
    if d.significant or d.reason == "unconfirmed_suspect":
        yield suspects_table(d)
        yield note(
            f"{ORDER} explains: share of the misfit, the error beyond noise, that adding the "
            "effect would remove; p-value: chance of that share without the effect. "
            f"{numbers.many_tests(d.tested, FALSE_ALARM)}\n"
        )
    if d.verdict != "adequate":
        coarse = (
            f'{s.coarse} of the model is too coarse; to make it finer: hilcal add RUN "{s.effect}".'
            for s in d.suspects
            if s.passes and s.coarse
        )
        yield from _paragraph([*coarse, *doubtful_lines(d)])
        yield from (*where_table(d.misfit_breakdown), "")
    yield from _paragraph([*_unexplained(d), *_repeats(d), *redundant_line(d)])
    yield from detectable_sizes(d)


def _paragraph(parts: Sequence[Block]) -> Sequence[Block]:
    """Return parts, if there are any, with an empty line behind."""
    return [*parts, ""] if parts else []


def _unexplained(d: Diagnosis) -> Iterator[Block]:
    if d.verdict in ("unknown_effect", "noise_misjudged"):
        if d.verdict == "noise_misjudged" or d.predictable_share >= LEAST_SHARE:
            predicted = percent(d.predictable_share)
            yield f"The recorded variables predict {predicted} of the misfit on poses left out."
        if d.insufficiency is not None:
            refitted = d.insufficiency.effects[: d.insufficiency.refitted]
            yield f"The residual{' with ' * bool(refitted)}{numbers.names(refitted)}:"
        yield from curves(d.dependences)
    if d.verdict == "unknown_effect":
        yield note(
            "hilcal discover searches for its law. To try an effect of your own: hilcal effects "
            "new NAME writes an example, --effects-from FILE.py adds it to the catalogue."
        )


def _repeats(d: Diagnosis) -> Iterator[str]:
    if (e := d.pure_error) is not None:
        yield repeats_sentence(e)
        if (w := e.where) is not None:
            low, high = (v**0.5 for v in w.interval)
            yield (
                f"Most of all {w.name}: {w.factor**0.5:.2f} times as much as stated (95 % interval "
                f"{low:.2f} to {high:.2f}; {numbers.p_equals(w.p_value)})."
            )


def repeats_sentence(e: PureError) -> str:
    """Return a sentence on the scatter of repeated readings."""
    low, high = e.interval
    return (
        f"Repeated readings scatter {e.factor**0.5:.2f} times as much as stated (variance factor "
        f"{e.factor:.2f}, 95 % interval {low:.2f} to {high:.2f}, {e.dof:.0f} degrees of freedom)."
    )


def change_sentence(before: Fit, after: Fit, effect: str, *, added: bool) -> str:
    """Return a sentence on the change of the error by an added or removed effect.

    It falls only where it does so by more than it scatters from pose to pose.
    """
    change = f"from {length(before.holdout.rms_m)} to {length(after.holdout.rms_m)}"
    if not added:
        needed = predicts_better(after, before)
        verb, end = ("rises", "it is needed") if needed else ("goes", "it is not needed")
        return f"Without {effect} the error on poses left out {verb} {change}: {end}."
    if before.model.background - after.model.background:
        return (
            f"{effect} is named now; predictions included it already, as part of the background: "
            f"the error on poses left out goes {change}."
        )
    if predicts_better(before, after):
        return f"With {effect} the error on poses left out falls {change}."
    return (
        f"With {effect} the error on poses left out does not fall by more than it scatters from "
        f"pose to pose ({change}): these readings do not show this effect. The previous revisions "
        "are still stored."
    )


def change_lines(c: "StoredChange", effect: str) -> Iterator[str]:
    """Yield `change_sentence` of a stored change, and warnings."""
    yield change_sentence(c.before, c.fit, effect, added=c.added is not None)
    if (s := c.expected) is not None and not s.plausible:
        yield f"{s.effect} is implausible: it {implausible(s)}."
    if s is not None and not s.keeps:
        yield (
            f"{s.effect} was predicted to explain {percent(s.share)} of the misfit; the refit "
            f"confirms {percent(max(s.kept, 0.0))} of that. To remove it: hilcal remove RUN "
            f"{s.effect}."
        )


def detectable_sizes(d: Diagnosis) -> Iterator[Block]:
    """Yield the minimum detectable sizes of the effects that are not named, smallest first."""
    not_named = [s for s in d.suspects if not s.passes]
    visible = sorted((s for s in not_named if s.shown), key=lambda s: s.least.displacement_m)
    if visible:
        least = [(s.effect, s.least) for s in visible]
        rows = [(e, length(x.displacement_m), numbers.sizes(x.parameters)) for e, x in least]
        heads = ("not named", "detectable from", "its parameters, rms")
        yield table(*heads, rows=rows, left=(0, 2))
        yield note(
            "detectable from: rms displacement of the target at which nine of ten campaigns like "
            "this one would name the effect, and the rms of its parameters for that "
            "displacement.\n"
        )
    for s in not_named:
        if (finest := s.least.finest_m) is not None:
            when = f"from {length(finest)}" if np.isfinite(finest) else "at no size"
            yield f"A {s.effect} finer than these poses resolve would be detectable {when}.\n"
    if hidden := d.not_shown:
        yield f"These readings cannot show, at any plausible size: {numbers.names(hidden)}.\n"


def doubtful_lines(d: Diagnosis) -> Iterator[str]:
    """Yield suspects with an implausible size, or with less gain than predicted."""
    for s in d.suspects:
        if not s.plausible and s.score.p_value < MAX_SHOWN_P:
            yield f"{s.effect} is implausible: it {implausible(s)}."
        elif not s.keeps:
            yield f"{s.effect} is not named: {unconfirmed(s)}."


def redundant_line(d: Diagnosis) -> Iterator[str]:
    """Yield a sentence on redundant effects of the model."""
    if d.redundant:
        it = "it" if len(d.redundant) == 1 else "them"
        yield (
            f"These readings are explained as well without {', '.join(d.redundant)}; to remove "
            f"{it}: hilcal remove RUN {d.redundant[0]}."
        )


def curves(dependences: Sequence[Dependence], most: int = MOST_CURVES) -> Iterator[Block]:
    """Yield the curve of each variable that explains at least `LEAST_SHARE` of the misfit."""
    shown = [d for d in dependences if d.share >= LEAST_SHARE][:most]
    for d in shown:
        explains = f"{d.variable} explains {percent(d.share)}"
        if d.determined:
            yield f"{explains}; error of {erring_quantity(d)}:"
            head, factor = variable_head(d)
            bins = (factor * d.x, d.y, d.error)
            yield from (_binned((head, "error"), d.y_unit, bins, d.labels), "")
        else:
            yield f"{explains}, but these readings do not determine its curve."
    if any(d.determined for d in shown):
        yield note("±: standard uncertainty; the mean over the bins is taken as zero.")


def variable_head(d: Dependence) -> tuple[str, float]:
    """Return the variable of a dependence with its display unit, and the factor to it."""
    unit, factor = numbers.joint_unit(d.unit) if d.unit in ("rad", "m") else (d.unit, 1.0)
    if d.unit == "s":
        unit, factor = numbers.time_unit(float(np.ptp(d.x)))
    return f"{d.variable} [{unit}]" if unit else d.variable, factor


def _binned(
    heads: tuple[str, str],
    unit_of: str,
    bins: tuple[Floats, Floats, Floats],
    names: Sequence[str] = (),
    law: Floats | None = None,
) -> Table:
    """Return a table of K bins (variable, mean in SI, standard uncertainty) with bars as head."""
    x, y, error = bins
    unit, factor = numbers.unit_for(unit_of, list(y))
    height = (y - y.min()) / ((y.max() - y.min()) or 1.0) * (len(BARS) - 1)
    bars = f"{heads[1]} [{unit}] {''.join(BARS[round(h)] for h in height.tolist())}"
    out = table(heads[0], bars, "±", *(() if law is None else ("law",)))
    for k in range(len(x)):
        values = (factor * float(v[k]) for v in (y, error, law) if v is not None)
        out.add(names[k] if names else numbers.digits(float(x[k])), *numbers.with_std(*values))
    return out


def step_report(number: int, change: str, d: Diagnosis) -> Iterator[Block]:
    """Yield the error of one revision, the variables that it follows, and the suspects."""
    yield heading(f"Revision {number}: {change or model_name(d.fit.model.named)}")
    yield holdout_sentence(d.fit)
    if d.verdict != "adequate" and not d.dependences:
        yield dependence_sentence(d.misfit_breakdown)
    if d.significant or d.reason == "unconfirmed_suspect":
        yield from ("", suspects_table(d))
    yield from (message(d), "")


def true_and_fitted(fit: Fit, truth: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return the identifiable parameters with a true value, without families that are shrunk."""
    parameters = [(e, p) for e in fit.model.effects for p in e.parameters]
    std, rows = fit.uncertainty.std.tolist(), []
    for k in np.flatnonzero(fit.uncertainty.identifiable):
        effect, p = parameters[k]
        name, value = f"{effect.name}.{p.name}", float(fit.theta[k])
        if name in truth and effect.groups() is None:
            row = {"name": name, "true": truth[name], "value": value, "std": std[k]}
            rows.append({**row, "unit": p.unit})
    return rows


def truth_table(rows: Sequence[Mapping[str, Any]]) -> Iterator[Block]:
    """Yield the table of estimated and true parameters."""
    out = table("parameter", "true", "fitted", "±", "unit", "off by", left=(0, 4))
    for r in rows[:MOST_COMPARED]:
        value, std, true = (float(r[key]) for key in ("value", "std", "true"))
        unit, factor = numbers.unit_for(r["unit"], [true, value])
        off = f"{abs(value - true) / std:.1f} ±" if std > 0 else ""
        fitted, spread, known = numbers.with_std(*(factor * v for v in (value, std, true)))
        out.add(r["name"], known, fitted, spread, unit, off)
    yield out
    if len(rows) > MOST_COMPARED:
        yield f"... and {len(rows) - MOST_COMPARED} more"
    yield note("±: standard uncertainty; off by: the error in units of it.\n")


def discovery_report(d: Discovery) -> Iterator[Block]:
    """Yield the discovered laws, or the reason for none."""
    yield heading(f"Laws for what {model_name(d.fit.model.named)} leaves unexplained")
    if not d.laws:
        yield numbers.sentence(no_law_sentence(d))
        yield from curves(d.carried)
        return
    yield (
        f"{d.candidates} candidates were tried. On poses left out of the search, laws explain "
        f"{percent(d.searched_share)} of the misfit."
    )
    for k, law in enumerate(d.laws):
        yield ""
        yield from _law(law, d, first=k == 0)
        for c in d.curves if k == 0 else ():
            x, y, std, _ = c.binned
            if len(x) >= LEAST_BINS:
                head = c.quantity if c.quantity_unit == "1" else f"{c.quantity} [{c.quantity_unit}]"
                law_line = np.interp(x, *c.line)
                yield from ("", _binned((head, c.of), c.unit, (x, y, std), law=law_line))
    best = pareto(d.structures)
    rows = table("law", "probability", "complexity", "on poses left out", "")
    for s in d.structures:
        remark = ", ".join(filter(None, (s.law, "best of its size" if s in best else "")))
        p = s.probability
        likely = percent(p) if p >= MIN_SHOWN else f"< {100 * MIN_SHOWN:g} %"
        rows.add(s.form.text(), likely, str(s.form.complexity), percent(s.holdout_share), remark)
    yield from ("", rows)
    moved, std = map(length, d.average_m())
    yield (
        f"Averaged by their probability, laws move the readings by {moved} rms; this prediction "
        f"has a standard uncertainty of {std}, the choice of the law included."
    )
    for law_name, why in (*d.refused, *d.unfitted):
        yield f"{law_name} {NOT_TRIED} ({why})."


def no_law_sentence(d: Discovery) -> str:
    """Return the reason why no law is proposed, and the effects that could not be tried."""
    tried = f"{d.candidates} candidates were tried"
    helps = "measure more poses, or record what else may matter"
    if any(c.variable == ROW_ORDER for c in d.carried[:1]):
        helps = (
            "it depends mostly on the order of the readings: add their times, without which no law "
            "of time can be searched for"
        )
    why = (
        f"no law: {percent(d.attainable)} of the misfit is predictable on poses left out, but "
        f"{tried}, and no law of this size predicts it; {helps}"
    )
    if d.reason == "adequate":
        why = (
            f"no law: the stated noise explains the residual (variance factor "
            f"{d.fit.variance_factor:.2f}), so there is nothing to explain"
        )
    elif d.reason == "catalogue":
        why = (
            f"no law: {tried}, and none explains the misfit better than effects of the catalogue "
            f"do ({numbers.names(d.catalogue)}); to add one: hilcal add RUN {d.catalogue[0]}"
        )
    elif d.refused:
        law, refusal = d.refused[0]
        why = (
            f"no law is proposed: {tried}; {law} predicts {percent(d.searched_share)} of the "
            f"misfit on poses left out, but the exact model cannot be fitted with it ({refusal})"
        )
    elif d.reason != "no_law":
        why = f"no law: {tried}, and nothing recorded predicts the misfit on poses left out"
    return why + "".join(f"; {e} {NOT_TRIED} ({because})" for e, because in d.unfitted)


def _law(law: Law, d: Discovery, first: bool) -> Iterator[Block]:
    yield Words(law.formula, "good" if first else "strong")
    yield f"  acts on      {', '.join(law.acts_on)}"
    yield f"  depends on   {', '.join(law.variables) or 'nothing: a constant'}"
    for c in law.parameters:
        yield f"  {c.name:<12} {coefficient(c)}"
    share = f"{percent(law.holdout_share)} of the misfit on poses left out"
    if d.attainable > 0:
        share += f", {percent(min(law.holdout_share / d.attainable, 1.0))} of what can be"
    yield f"  explains     {share}"
    before = d.fit.variance_factor
    yield f"  remains      variance factor {law.variance_factor:.2f}, before {before:.2f}"
    yield f"  chance       {numbers.p_equals(law.p_value)}, corrected for the size of the search"
    yield "  repeated in  searches without some of the poses:"
    for a in law.selection_frequencies:
        causes = f" by {', '.join(a.variables)}" if a.variables else ""
        yield f"    {a.acts_on}{causes}: {percent(a.share)}"
    if near := [f"{r.effect} (cosine {r.cosine:.2f})" for r in law.resembles[:MOST_RESEMBLING]]:
        yield f"  resembles    {', '.join(near)}"
    ranges = [
        f"{symbol} {numbers.digits(low)} to {numbers.digits(high)}{'' if u == '1' else f' {u}'}"
        for symbol, low, high, u in law.ranges
    ]
    if ranges:
        yield f"  valid for    {', '.join(ranges)}; not tested outside"


def coefficient(c: Coefficient) -> str:
    """Return a coefficient with its standard uncertainty, in a display unit."""
    value, std, unit = numbers.measured(c.unit, c.value, c.std)
    return f"{value} ± {std} {'' if unit == '1' else unit}".rstrip()


def refined_laws(s: LawSearch) -> Iterator[Block]:
    """Yield the laws that a refinement retained, or the reason for none, of each search."""
    for d in s.discoveries:
        if not d.laws:
            yield numbers.sentence(no_law_sentence(d))
        elif (law := d.laws[0]).name not in s.files:
            yield f"{law.formula} was tried, and is not in the model."
        else:
            yield heading(f"{law.name}: a law that the catalogue does not have")
            yield from _law(law, d, first=True)
            yield (
                f"It is stored as the effect {law.name} in {s.files[law.name]}; commands that read "
                "these revisions need it: --effects-from.\n"
            )


def next_command(d: Diagnosis, run: Path, revision: int | None) -> tuple[str, str] | tuple[()]:
    """Return the command that adds what is missing, searches for it, or plans what tells more.

    A sentence and the command; nothing where there is nothing to do.
    """
    doubt, catalogue = in_doubt(d), d.fit.model.catalogue
    if d.verdict == "missing_effect" and d.lead is not None:
        doubt, what = (d.lead.effect,), "To add it, and see the error before and after:"
        line = ["hilcal", "add", quoted(run), quoted(d.lead.effect)]
    elif doubt:
        what = "To plan the measurements that separate them:"
        line = ["hilcal", "next", quoted(run), "-o", "PLAN.json"]
    elif d.reason in ("background", "few_readings", "unconfirmed_suspect"):
        what = "To plan further poses:"
        line = ["hilcal", "plan", "CELL.toml", "-o", "PLAN.json", "--after", quoted(run)]
    elif d.reason in ("no_suspect", "insufficient_catalogue") and d.step is None:
        what = "To search for the law of what is missing:"
        names = itertools.chain(["law"], (f"law_{k}" for k in itertools.count(2)))
        new = next(name for name in names if name not in catalogue.names)
        line = ["hilcal", "discover", quoted(run), "-o", f"{new}.py"]
    else:
        return ()
    line += [] if revision is None else ["--revision", str(revision)]
    return what, " ".join([*line, *effect_files(catalogue, (*d.fit.model.names, *doubt))])


def effect_files(catalogue: Catalogue, names: Iterable[str]) -> list[str]:
    """Return the options that give a command the files of effects."""
    files = (catalogue.file_of(name) for name in names)
    paths = dict.fromkeys(f.path for f in files if f is not None)
    return [word for path in paths for word in ("--effects-from", quoted(path))]
