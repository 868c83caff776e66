"""The demo in words: what was found against what is true."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from rich.console import RenderableType
from rich.text import Text

from hilcal import numbers
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.live_model import LEAST
from hilcal.identification.fit import Fit
from hilcal.present import text, text_refine
from hilcal.present.verdict_words import message

MOST = 24

NEWCOMER = f"""\
The lines that follow are those of a real run: what the arm does, and each reading with its pose,
load and cycle. It begins beside the reference pose, so that every joint arrives there from a known
side. From {LEAST} poses on, a first model predicts each reading before it counts: the residual is
how far it misses. While it is fitted to few poses, and lacks what is hidden, that is a lot."""


def step_report(number: int, change: str, d: Diagnosis) -> Iterator[RenderableType]:
    """Yield what one revision shows: how far off, where, and which effect would explain it."""
    name = change or text.model_name(d.fit.model.named)
    yield text.heading(f"Revision {number}: {name}")
    yield text.misses(d.fit)
    if d.verdict != "adequate":
        yield text.follows(d.misfit_breakdown)
    if d.significant:
        yield ""
        yield text_refine.suspects_table(d)
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


def truth_table(rows: Sequence[Compared]) -> Iterator[RenderableType]:
    """Yield the table of found against true parameters."""
    out = text.table("parameter", "true", "found", "±", "unit", "off by", left=(0, 4))
    for r in rows[:MOST]:
        unit, factor = numbers.unit_for(r.unit, [r.true, r.value])
        found, spread = numbers.with_std(factor * r.value, factor * r.std)
        places = len(found.partition(".")[2])
        off = f"{abs(r.value - r.true) / r.std:.1f} ±" if r.std > 0 else ""
        out.add_row(r.name, f"{factor * r.true:.{places}f}", found, spread, unit, off)
    yield out
    if len(rows) > MOST:
        yield f"... and {len(rows) - MOST} more"
    yield Text("±: standard uncertainty; off by: the error in units of it.\n", style="dim")
