"""Diagnoses and revisions in words and tables, for people."""

from collections.abc import Iterator, Sequence

from rich.console import RenderableType
from rich.text import Text

from hilcal import numbers
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.effect_ranking import FALSE_ALARM, LEAST_SHARE, Suspect
from hilcal.diagnosis.stepwise import predicts_better
from hilcal.identification.fit import Fit
from hilcal.identification.full_prediction import full_prediction
from hilcal.present import text
from hilcal.present.text_seen import could_have_been_seen, doubtful, redundant_line
from hilcal.present.text_unknown import curves, repeats
from hilcal.present.verdict_words import headline, implausible, message

SUSPECTS = 6


def verdict_line(d: Diagnosis) -> Text:
    """Return the verdict with its message; names of the catalogue keep their spelling."""
    style = "bold green" if d.verdict == "adequate" else "bold yellow"
    words = numbers.sentence(message(d), d.fit.model.catalogue.names)
    return Text.assemble("Verdict: ", (headline(d), style), f".\n{words}")


def suspects_table(d: Diagnosis, most: int = SUSPECTS) -> RenderableType:
    """Return the ranked suspects that chance alone does not explain."""
    shown = [s for s in d.suspects if s.passes or s.score.p_value < text.CERTAIN]
    out = text.table(
        "missing effect?",
        "explains",
        "on poses left out",
        "p-value",
        "inseparable from",
        left=(0, 4),
    )
    for s in shown[:most]:
        out.add_row(
            s.effect,
            numbers.percent(s.share),
            numbers.percent(max(s.holdout_share, 0.0)),
            numbers.chance(s.score.p_value),
            numbers.few(s.same_as) if s.passes else "",
        )
    return out


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


def diagnosis_report(d: Diagnosis) -> Iterator[RenderableType]:
    """Yield the verdict, where the model fails and the suspects."""
    yield text.heading(f"Model: {text.model_name(d.fit.model.named)}")
    yield text.misses(d.fit)
    if d.verdict != "adequate" and not d.dependences:
        yield text.follows(d.misfit_breakdown)
    yield ""
    yield verdict_line(d)
    yield ""
    if d.significant:
        yield suspects_table(d)
        yield Text(
            "explains: share of the misfit, the error beyond noise, that adding the effect would "
            "remove; p-value: chance of that much if it were not there. "
            f"{numbers.many_tests(d.tested, FALSE_ALARM)}\n",
            style="dim",
        )
    if d.verdict != "adequate":
        yield from finer(d)
        yield from doubtful(d)
        yield from (*text.where_table(d.misfit_breakdown), "")
    if d.verdict in ("unknown_effect", "noise_misjudged"):
        if d.verdict == "noise_misjudged" or d.predictable_share >= LEAST_SHARE:
            predicted = numbers.percent(d.predictable_share)
            yield f"What is recorded predicts {predicted} of the misfit on poses left out."
        if d.insufficiency is not None:
            refitted = d.insufficiency.effects[: d.insufficiency.refitted]
            yield f"The residual{' with ' * bool(refitted)}{numbers.names(refitted)}:"
        yield from curves(d.dependences)
    if d.verdict == "unknown_effect":
        yield Text(
            "An effect of your own: hilcal effects new NAME writes one to begin with, and "
            "--effects-from FILE.py tries it.",
            style="dim",
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


def revisions_table(rows: Sequence[tuple[int, str, Fit, str]]) -> RenderableType:
    """Return the table in which the error falls, from (number, change, fit, verdict)."""
    out = text.table(
        "rev.",
        "model",
        "poses\nfitted",
        "\nσ",
        "poses\nleft out",
        "\nσ",
        "variance\nfactor",
        "verdict",
        left=(0, 1, 7),
    )
    for number, change, fit, verdict in rows:
        out.add_row(
            str(number),
            change or text.model_name(fit.model.named),
            numbers.length(fit.error.rms_m),
            f"{fit.error.rms_sigma:.2f}",
            numbers.length(fit.holdout.rms_m),
            f"{fit.holdout.rms_sigma:.2f}",
            numbers.digits(fit.variance_factor),
            verdict.replace("_", " "),
        )
    floor = numbers.length(full_prediction(rows[-1][2]).noise_floor)
    out.add_row("", "noise alone", floor, "1.00", floor, "1.00", "1", "", style="dim")
    return out


def key() -> Text:
    """Return what the columns of `revisions_table` are."""
    return Text(
        "Errors: rms of the 3-D position, and of all elements in σ, one standard deviation of "
        "the noise.\n",
        style="dim",
    )


def fell(before: Fit, after: Fit, effect: str) -> str:
    """Say what adding an effect did to the error on poses left out."""
    a, b = before.holdout, after.holdout
    if b.rms_sigma < a.rms_sigma:
        return f"With {effect} the error on poses left out falls {_from_to(before, after)}."
    return (
        f"With {effect} the error on poses left out does not fall ({_from_to(before, after)}): "
        "these readings do not show this effect. The revisions before it are still there."
    )


def rose(before: Fit, after: Fit, effect: str) -> str:
    """Say what taking an effect out did to the error on poses left out."""
    change = _from_to(before, after)
    if predicts_better(after, before):
        return f"Without {effect} the error on poses left out rises {change}: it belongs there."
    return f"Without {effect} the error on poses left out goes {change}: it is not needed."


def _from_to(before: Fit, after: Fit) -> str:
    a, b = before.holdout, after.holdout
    return f"from {numbers.length(a.rms_m)} to {numbers.length(b.rms_m)}"
