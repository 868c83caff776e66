"""The scatter of repeats and curves of an unexplained misfit, for people."""

from collections.abc import Iterator, Sequence

from rich.console import RenderableType
from rich.text import Text

from hilcal import numbers
from hilcal.diagnosis.effect_ranking import LEAST_SHARE
from hilcal.diagnosis.noise import PureError
from hilcal.diagnosis.residual_regression import Dependence
from hilcal.present import text

BARS = "▁▂▃▄▅▆▇█"
MOST = 2


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


def curves(dependences: Sequence[Dependence], most: int = MOST) -> Iterator[RenderableType]:
    """Yield the curve of each leading variable as a row of bars and a table.

    Only of those that carry `LEAST_SHARE` or more, and by a curve only where it is determined.
    """
    carrying = [d for d in dependences if d.share >= LEAST_SHARE][:most]
    for d in carrying:
        told = f"{d.variable} carries {numbers.percent(d.share)}"
        if d.determined:
            yield f"{told}; {moves(d)} errs by:"
            yield from (curve(d), "")
        else:
            yield f"{told}, but these readings do not determine its curve."
    if any(d.determined for d in carrying):
        yield Text("±: standard uncertainty; the mean over the bins is taken as zero.", style="dim")


def moves(d: Dependence) -> str:
    """Say what errs with a variable."""
    if d.y_unit == "rad":
        return d.moves
    along = ", ".join(f"{v:.2f}" for v in d.direction)
    return f"the target along ({along}) in base axes"


def sparkline(values: Sequence[float]) -> str:
    """Draw values as bars, the smallest the lowest."""
    low, high = min(values), max(values)
    size = (high - low) or 1.0
    return "".join(BARS[round((v - low) / size * (len(BARS) - 1))] for v in values)


def curve(d: Dependence) -> RenderableType:
    """Return the table of a dependence, with its bars in the heading."""
    unit, factor = numbers.unit_for(d.y_unit, list(d.y))
    head = f"{d.variable} [{d.unit}]" if d.unit else d.variable
    out = text.table(head, f"error [{unit}] {sparkline(list(d.y))}", "±")
    for k, (x, y, error) in enumerate(zip(d.x, d.y, d.error, strict=True)):
        name = d.labels[k] if d.labels else numbers.digits(float(x))
        out.add_row(name, *numbers.with_std(factor * float(y), factor * float(error)))
    return out
