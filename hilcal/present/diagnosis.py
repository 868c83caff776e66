"""Diagnoses and revisions in words and tables: suspects, what was not found, curves of a misfit."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hilcal import numbers
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.effect_ranking import FALSE_ALARM, LEAST_SHARE, Suspect
from hilcal.diagnosis.live_model import LEAST
from hilcal.diagnosis.noise import PureError
from hilcal.diagnosis.residual_regression import Dependence
from hilcal.diagnosis.stepwise import predicts_better
from hilcal.identification.fit import Fit
from hilcal.identification.full_prediction import full_prediction
from hilcal.present.document import Block, Table, Tone, Words, heading, note, table
from hilcal.present.fit import CERTAIN, error_words, follows, misses, model_name, where_table
from hilcal.present.verdict import broken, headline, implausible, message
from hilcal.readings.readings import Readings
from hilcal.types import Floats

SUSPECTS = 6
REVISION_HEADS = (
    *("rev.", "model", "poses\nfitted", "\nσ", "poses\nleft out", "\nσ"),
    *("variance\nfactor", "verdict"),
)
"""Of a table of revisions."""


def verdict_line(d: Diagnosis) -> Words:
    """Return the verdict with its message; names of the catalogue keep their spelling."""
    words = numbers.sentence(message(d), d.fit.model.catalogue.names)
    tone: Tone = "good" if d.verdict == "adequate" else "doubt"
    return Words(f"Verdict: {headline(d)}.\n{words}", tone, headline(d))


def suspects_table(d: Diagnosis, most: int = SUSPECTS) -> Table:
    """Return the ranked suspects that chance alone does not explain."""
    heads = ("missing effect?", "explains", "on poses left out", "p-value", "inseparable from")
    out = table(*heads, left=(0, 4))
    for s in shown_suspects(d)[:most]:
        shares = (numbers.percent(s.share), numbers.percent(max(s.holdout_share, 0.0)))
        same = numbers.few(s.same_as) if s.passes else ""
        out.add(s.effect, *shares, numbers.chance(s.score.p_value), same)
    return out


def shown_suspects(d: Diagnosis) -> list[Suspect]:
    """Return the suspects that pass the test, then those that nearly do, each best first."""
    return [s for s in d.suspects if s.passes or s.score.p_value < CERTAIN]


def addition_lines(s: Suspect) -> Iterator[str]:
    """Yield what is wrong with an effect that was added: its size, or a promise that broke."""
    if not s.plausible:
        yield f"{s.effect} is implausible: it {implausible(s)}."
    if not s.keeps:
        kept = numbers.percent(max(s.kept, 0.0))
        yield (
            f"The linearisation promised that {s.effect} explains {numbers.percent(s.share)} of "
            f"the misfit; the refit kept {kept} of that: remove it, hilcal remove RUN {s.effect}."
        )


def diagnosis_report(d: Diagnosis) -> Iterator[Block]:
    """Yield the verdict, where the model fails and the suspects."""
    yield heading(f"Model: {model_name(d.fit.model.named)}")
    yield misses(d.fit)
    if d.verdict != "adequate" and not d.dependences:
        yield follows(d.misfit_breakdown)
    yield ""
    yield verdict_line(d)
    yield ""
    if d.significant:
        yield suspects_table(d)
        yield note(
            "explains: share of the misfit, the error beyond noise, that adding the effect would "
            "remove; p-value: chance of that much if it were not there. "
            f"{numbers.many_tests(d.tested, FALSE_ALARM)}\n"
        )
    if d.verdict != "adequate":
        yield from finer(d)
        yield from doubtful(d)
        yield from (*where_table(d.misfit_breakdown), "")
    if d.verdict in ("unknown_effect", "noise_misjudged"):
        if d.verdict == "noise_misjudged" or d.predictable_share >= LEAST_SHARE:
            predicted = numbers.percent(d.predictable_share)
            yield f"What is recorded predicts {predicted} of the misfit on poses left out."
        if d.insufficiency is not None:
            refitted = d.insufficiency.effects[: d.insufficiency.refitted]
            yield f"The residual{' with ' * bool(refitted)}{numbers.names(refitted)}:"
        yield from curves(d.dependences)
    if d.verdict == "unknown_effect":
        yield note(
            "An effect of your own: hilcal effects new NAME writes one to begin with, and "
            "--effects-from FILE.py tries it."
        )
    if d.pure_error is not None:
        yield from repeats(d.pure_error)
    yield from redundant_line(d)
    yield from could_have_been_seen(d)


def finer(d: Diagnosis) -> Iterator[str]:
    """Yield how to let joints differ, where the readings ask for it."""
    for s in d.suspects:
        if s.passes and s.coarse:
            yield (
                f"Let joints differ: {s.coarse} has one parameter for several joints; to give each "
                f'its own: hilcal add RUN "{s.effect}".'
            )


def revisions_table(rows: Sequence[tuple[int, str, Fit, str]]) -> Table:
    """Return the table in which the error falls, from (number, change, fit, verdict)."""
    out = table(*REVISION_HEADS, left=(0, 1, 7))
    for row in rows:
        out.add(*revision_cells(*row))
    floor = numbers.length(full_prediction(rows[-1][2]).noise_floor)
    out.add("", "noise alone", floor, "1.00", floor, "1.00", "1", "", tone="note")
    return out


def revision_cells(number: int, change: str, fit: Fit, verdict: str) -> tuple[str, ...]:
    """Return the cells of a revision in `revisions_table`."""
    return (
        str(number),
        change or model_name(fit.model.named),
        numbers.length(fit.error.rms_m),
        f"{fit.error.rms_sigma:.2f}",
        numbers.length(fit.holdout.rms_m),
        f"{fit.holdout.rms_sigma:.2f}",
        numbers.digits(fit.variance_factor),
        verdict.replace("_", " "),
    )


def key(readings: Readings) -> Words:
    """Return what the columns of `revisions_table` are."""
    what = error_words(readings)
    return note(
        f"Errors: rms of the {what}, and of all elements in σ, one standard deviation of the "
        "noise.\n"
    )


def fell(before: Fit, after: Fit, effect: str) -> str:
    """Say what adding an effect did to the error on poses left out."""
    change = _from_to(before, after)
    if after.holdout.rms_sigma < before.holdout.rms_sigma:
        return f"With {effect} the error on poses left out falls {change}."
    return (
        f"With {effect} the error on poses left out does not fall ({change}): these readings do "
        "not show this effect. The revisions before it are still there."
    )


def rose(before: Fit, after: Fit, effect: str) -> str:
    """Say what taking an effect out did to the error on poses left out."""
    change = f"the error on poses left out {{}} {_from_to(before, after)}"
    if predicts_better(after, before):
        return f"Without {effect} {change.format('rises')}: it belongs there."
    return f"Without {effect} {change.format('goes')}: it is not needed."


def _from_to(before: Fit, after: Fit) -> str:
    a, b = (numbers.length(f.holdout.rms_m) for f in (before, after))
    return f"from {a} to {b}"


def could_have_been_seen(d: Diagnosis) -> Iterator[Block]:
    """Yield the table of effects that were not found, the best visible first."""
    rest = [s for s in d.suspects if not s.passes]
    seen = sorted((s for s in rest if s.shown), key=lambda s: s.least.displacement_m)
    hidden = d.not_shown
    if seen:
        rows = [
            (s.effect, numbers.length(s.least.displacement_m), numbers.sizes(s.least.parameters))
            for s in seen
        ]
        heads = ("not found", "would be seen from", "its parameters, rms")
        yield from ("", table(*heads, rows=rows, left=(0, 2)))
        yield note(
            "would be seen from: rms displacement of the target at which nine campaigns like this "
            "one in ten would name the effect; rms of the parameters that make it.\n"
        )
    for s in rest:
        if s.least.finest_m is not None:
            much = numbers.length(s.least.finest_m)
            when = f"from {much}" if np.isfinite(s.least.finest_m) else "at no size"
            yield f"A {s.effect} finer than these poses resolve would be seen {when}.\n"
    if hidden:
        yield f"At no plausible size would these readings show {numbers.names(hidden, 'or')}.\n"


def doubtful(d: Diagnosis) -> Iterator[str]:
    """Yield suspects that would need an implausible size, or do not keep what they promise."""
    for s in d.suspects:
        if not s.plausible and s.score.p_value < CERTAIN:
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


NEAR = 0.99
"""Component from which a direction is called an axis; a choice."""
BARS = "▁▂▃▄▅▆▇█"
CURVES = 2


def repeats(e: PureError) -> Iterator[str]:
    """Yield the scatter of repeated readings, and where it differs most from what is stated."""
    yield (
        f"Repeated readings scatter {e.factor**0.5:.2f} times as much as stated "
        f"({e.dof:.0f} degrees of freedom)."
    )
    if e.where is not None:
        low, high = (v**0.5 for v in e.where.interval)
        yield (
            f"Most of all {e.where.name}: {e.where.factor**0.5:.2f} times as much as stated "
            f"(95 % interval {low:.2f} to {high:.2f}; {numbers.p_equals(e.where.p_value)})."
        )


def curves(dependences: Sequence[Dependence], most: int = CURVES) -> Iterator[Block]:
    """Yield the curve of each leading variable as a row of bars and a table.

    Only of those that carry `LEAST_SHARE` or more, and by a curve only where it is determined.
    """
    carrying = [d for d in dependences if d.share >= LEAST_SHARE][:most]
    for d in carrying:
        told = f"{d.variable} carries {numbers.percent(d.share)}"
        if d.determined:
            yield f"{told}; {moves(d)} errs by:"
            yield from (curve_table(d), "")
        else:
            yield f"{told}, but these readings do not determine its curve."
    if any(d.determined for d in carrying):
        yield note("±: standard uncertainty; the mean over the bins is taken as zero.")


def moves(d: Dependence) -> str:
    """Say what errs with a variable."""
    if d.y_unit == "rad":
        return d.moves
    main = int(np.argmax(np.abs(d.direction)))
    if d.direction[main] > NEAR:
        return f"the {d.moves} along base {'xyz'[main]}"
    along = ", ".join(f"{v:.2f}" for v in d.direction)
    return f"the {d.moves} along ({along}) in base axes"


def sparkline(values: Sequence[float]) -> str:
    """Draw values as bars, the smallest the lowest."""
    low, high = min(values), max(values)
    size = (high - low) or 1.0
    return "".join(BARS[round((v - low) / size * (len(BARS) - 1))] for v in values)


def curve_table(d: Dependence) -> Table:
    """Return the table of a dependence."""
    head = f"{d.variable} [{d.unit}]" if d.unit else d.variable
    return binned_table((head, "error"), d.y_unit, (d.x, d.y, d.error), d.labels)


def binned_table(
    heads: tuple[str, str],
    unit_of: str,
    bins: tuple[Floats, Floats, Floats],
    names: Sequence[str] = (),
    law: Floats | None = None,
) -> Table:
    """Return means over K bins of a variable, drawn as bars in the heading.

    Args:
        heads: the variable, and what the means are of.
        unit_of: of the means, SI.
        bins: (K,) variable, mean and its standard uncertainty.
        names: (K,) of the bins, where the variable only counts them.
        law: (K,) of a law there.
    """
    x, y, error = bins
    unit, factor = numbers.unit_for(unit_of, list(y))
    bars = f"{heads[1]} [{unit}] {sparkline(list(y))}"
    out = table(heads[0], bars, "±", *(() if law is None else ("law",)))
    for k in range(len(x)):
        value, spread = numbers.with_std(factor * float(y[k]), factor * float(error[k]))
        places = len(value.partition(".")[2])
        more = () if law is None else (f"{factor * law[k]:.{places}f}",)
        out.add(names[k] if names else numbers.digits(float(x[k])), value, spread, *more)
    return out


COMPARED = 24
"""Parameters that are compared with the true ones."""
NEWCOMER = f"""\
The lines that follow are those of a real run: what the arm does, and each reading with its pose,
load and cycle. It begins beside the reference pose, so that every joint arrives there from a known
side. From {LEAST} poses on, a first model predicts each reading before it counts: the residual is
how far it misses. While it is fitted to few poses, and lacks what is hidden, that is a lot."""


def step_report(number: int, change: str, d: Diagnosis) -> Iterator[Block]:
    """Yield what one revision shows: how far off, where, and which effect would explain it."""
    name = change or model_name(d.fit.model.named)
    yield heading(f"Revision {number}: {name}")
    yield misses(d.fit)
    if d.verdict != "adequate":
        yield follows(d.misfit_breakdown)
    if d.significant:
        yield ""
        yield suspects_table(d)
    yield numbers.sentence(message(d), d.fit.model.catalogue.names)
    yield ""


@dataclass(frozen=True, slots=True)
class Compared:
    """A parameter that was found, beside the true one; SI."""

    name: str
    true: float
    value: float
    std: float
    unit: str


def compared(fit: Fit, truth: Mapping[str, float]) -> list[Compared]:
    """Identifiable parameters that have a true value."""
    rows = []
    for effect, s in zip(fit.model.effects, fit.model.slices(), strict=True):
        if effect.groups() is not None:
            continue  # shrunk on purpose
        for k, p in zip(range(s.start, s.stop), effect.parameters, strict=True):
            true = truth.get(f"{effect.name}.{p.name}")
            if true is not None and fit.uncertainty.identifiable[k]:
                value, std = float(fit.theta[k]), float(fit.uncertainty.std[k])
                rows.append(Compared(f"{effect.name}.{p.name}", true, value, std, p.unit))
    return rows


def truth_table(rows: Sequence[Compared]) -> Iterator[Block]:
    """Yield the table of found against true parameters."""
    out = table("parameter", "true", "found", "±", "unit", "off by", left=(0, 4))
    for r in rows[:COMPARED]:
        unit, factor = numbers.unit_for(r.unit, [r.true, r.value])
        found, spread = numbers.with_std(factor * r.value, factor * r.std)
        places = len(found.partition(".")[2])
        off = f"{abs(r.value - r.true) / r.std:.1f} ±" if r.std > 0 else ""
        out.add(r.name, f"{factor * r.true:.{places}f}", found, spread, unit, off)
    yield out
    if len(rows) > COMPARED:
        yield f"... and {len(rows) - COMPARED} more"
    yield note("±: standard uncertainty; off by: the error in units of it.\n")
