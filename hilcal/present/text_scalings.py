"""The same model fitted with each scaling, side by side."""

from collections.abc import Iterator, Mapping, Sequence

from rich.console import RenderableType
from rich.text import Text

from hilcal import numbers
from hilcal.identification.fit import Fit
from hilcal.present import text
from hilcal.readings.whitening import Scaling

MOST = 60


def scalings_table(fits: Mapping[Scaling, Fit]) -> Iterator[RenderableType]:
    """Yield a table: parameters with standard uncertainties, errors, condition numbers."""
    yield text.heading("The same readings with every scaling")
    out = text.table("", *fits, "unit", left=(0, len(fits) + 1))
    first = next(iter(fits.values()))
    for effect, s in zip(first.model.effects, first.model.slices(), strict=True):
        if effect.groups() is not None or s.stop - s.start > MOST:
            continue
        for k, p in zip(range(s.start, s.stop), effect.parameters, strict=True):
            values = [float(f.theta[k]) for f in fits.values() if f.uncertainty.identifiable[k]]
            if values:
                unit, factor = numbers.unit_for(p.unit, values)
                out.add_row(
                    f"{effect.name}.{p.name}",
                    *(_entry(f, k, factor) for f in fits.values()),
                    unit,
                )
    out.add_section()
    for name, entries in _summary(tuple(fits.values())):
        out.add_row(name, *entries, "")
    yield out
    yield Text(
        "none: least squares as is; gu: weighted by standard deviations; gc: whitened by the full "
        "covariance, pose by pose. The revision that is kept is that of gc.",
        style="dim",
    )


def _summary(fits: Sequence[Fit]) -> Iterator[tuple[str, list[str]]]:
    bases = [f.solution.equations.basis for f in fits]
    yield "rms error, poses fitted", [numbers.length(f.error.rms_m) for f in fits]
    yield "rms error, poses left out", [numbers.length(f.holdout.rms_m) for f in fits]
    yield "variance factor (of gc)", [numbers.digits(f.variance_factor) for f in fits]
    yield "condition, physical units", [numbers.condition(b.condition_unscaled) for b in bases]
    yield "condition, parameters scaled", [numbers.condition(b.condition_scaled) for b in bases]


def _entry(fit: Fit, k: int, factor: float) -> str:
    if not fit.uncertainty.identifiable[k]:
        return "-"
    value, std = numbers.with_std(
        factor * float(fit.theta[k]), factor * float(fit.uncertainty.std[k])
    )
    return f"{value} ± {std}" if std else value
