"""What `identify` prints of a stream."""

from collections.abc import Iterator

from rich.console import RenderableType
from rich.text import Text

from hilcal import numbers
from hilcal.present.text import heading, model_name, table
from hilcal.stream.fit import StreamFit


def stream_report(fit: StreamFit) -> Iterator[RenderableType]:
    """Yield all that people want to know of a fit to a stream."""
    yield heading(f"Model: {model_name(fit.model.names)}")
    yield f"Fitted to {fit.readings} absolute readings of a stream, in {fit.passes} passes.\n"
    rows = table("parameter", "value", "±", "unit", "meaning", left=(0, 3, 4))
    meaning = {f"{e.name}.{p.name}": p.meaning for e in fit.model.effects for p in e.parameters}
    unseen = []
    for p in fit.parameters:
        if p.value is None or p.std is None:
            unseen.append(p.name)
            continue
        value, std, unit = numbers.measured(p.unit, p.value, p.std)
        rows.add_row(p.name, value, std, unit, meaning[p.name])
    yield rows
    yield Text("±: standard uncertainty.\n", style="dim")
    if unseen:
        yield f"Not determined by these readings: {', '.join(unseen)}.\n"
    errors = table("3-D position error", "rms", "mean", "largest", "rms in σ")
    named = (("readings fitted", fit.error), ("tenths of the stream left out", fit.holdout))
    for name, e in named:
        lengths = [numbers.length(x) for x in (e.rms_m, e.mean_m, e.max_m)]
        errors.add_row(name, *lengths, f"{e.rms_sigma:.2f}")
    errors.add_row("noise alone", numbers.length(fit.noise_floor), "", "", "1.00")
    yield errors
    yield ""
    low, high = fit.variance_factor_interval
    yield (
        f"Variance factor {fit.variance_factor:.4g} (95 % interval {low:.4g} to {high:.4g}): the "
        "squared error in units of the noise, 1 where model and noise are right."
    )
    if fit.inflated:
        yield (
            "The residuals are larger than the noise: the standard uncertainties were widened to "
            "what leaving out tenths of the stream shows."
        )
    if fit.outliers:
        many = f"; the worst: {_rows(fit)}" if fit.named else ""
        yield f"{fit.outliers} readings were set aside as gross errors{many}."
    if not fit.converged:
        yield "Not converged: do not trust the parameters."


def _rows(fit: StreamFit) -> str:
    return ", ".join(f"row {row} ({sigma:.3g} σ)" for row, sigma in fit.named)
