"""A fit as plain text, for an interactive session; `hilcal.present` writes it for a terminal."""

from hilcal.identification.estimates import Estimates
from hilcal.identification.residual import ErrorBlock


def summary(
    names: tuple[str, ...],
    fitted: str,
    estimates: Estimates,
    errors: tuple[ErrorBlock, ErrorBlock],
    variance_factor: float,
    interval: tuple[float, float],
) -> str:
    """Return the model, its errors and its parameters, a line each.

    Args:
        names: of the model's effects.
        fitted: number and kind of the measurements, and their scaling.
        estimates: the parameters.
        errors: of the fit, and on poses left out.
        variance_factor: χ²/dof.
        interval: its 95 % confidence interval.
    """
    lines = [f"{' + '.join(names) or 'nominal arm'}, fitted to {fitted}"]
    for what, e in zip(("fitted poses", "poses left out"), errors, strict=True):
        lines.append(
            f"  3-D error on {what}: {1e6 * e.rms_m:.1f} µm rms, {1e6 * e.max_m:.1f} µm largest, "
            f"{e.rms_sigma:.2f} σ"
        )
    lines.append(f"  variance factor {variance_factor:.3g} [{interval[0]:.3g}, {interval[1]:.3g}]")
    width = max((len(row.name) for row in estimates), default=0)
    for row in estimates:
        value = "not determined"
        if row.value is not None and row.std is not None:
            value = f"{row.value: .4e} ± {row.std:.1e} {row.unit}"
        lines.append(f"  {row.name:<{width}}  {value}")
    return "\n".join(lines)
