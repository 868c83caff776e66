"""The scaling study as a picture: one SVG file that needs nothing else."""

import math
from pathlib import Path

from hilcal.errors import InputError
from hilcal.study.chart import GRID, QUIET, Axis, Panel, Series, Target, document, line, text
from hilcal.study.scaling import ScalingStudy, StudyCell
from hilcal.study.scaling_table import (
    BOUND_TOLERANCE,
    COVERAGE_BAND,
    CURVES,
    largest_shift,
    title,
)

# Colours of the program's views: red is wrong, amber is doubtful, green is the noise's limit.
_RED, _AMBER, _BLUE, _GREEN = "#dc2650", "#ffb000", "#56b4e9", "#009e73"
_INKS = {_RED: "#b3123a", _AMBER: "#8a5d00", _BLUE: "#14699e", _GREEN: "#00694c"}
_COLORS = {"none": _RED, "gu": _AMBER, "gc": _BLUE}
_DASHES = {"m, rad": "", "mm, rad": "7 4", "m, mrad": "2 4"}
_WIDTH, _HEIGHT = 1180, 860
_MARGIN = 30
_LEFT, _TOP, _PANEL_WIDTH, _PANEL_HEIGHT = 74, 202, 370, 230
_STEP_X, _STEP_Y = 580, 364
_X_LABEL = "ρ: share of noise variance common to the six elements"
_CASES = (
    (False, "Each load has its own unloaded reading: deflections are independent"),
    (True, "The loads of a pose share one unloaded reading: deflections are correlated"),
)
_ERROR_TICKS = (1, 1.5, 2, 3, 4, 6, 10, 15, 20, 30, 50, 100, 200, 500, 1000)


def picture(study: ScalingStudy, path: Path) -> None:
    """Write the study as an SVG file: error over bound, and coverage, against correlation.

    Raises:
        InputError: the name does not end in `.svg`, or the file cannot be written.
    """
    if path.suffix.lower() != ".svg":
        raise InputError(f"{path}: the picture is an SVG file; end its name in .svg")
    try:
        path.write_text(svg(study), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot write the picture: {error.strerror}") from None


def svg(study: ScalingStudy) -> str:
    """Return the picture as the text of an SVG document."""
    heading = "What the scaling of the measurements does to the estimate"
    notes = (
        f"{title(study)}; the same noise for all scalings. The arm's repeatability and the "
        f"tracker specify ρ = {study.typical_correlation:.2f}.",
        "none: least squares as is; gu: weighted by standard deviations; gc: whitened by the full "
        "covariance, pose by pose. Error bars: two standard uncertainties of the Monte-Carlo.",
        f"Writing the same data in other units moves an estimate by up to "
        f"{largest_shift(study, 'none'):.0f} standard uncertainties with none; with gu and gc by "
        f"less than {_power_above(largest_shift(study, 'gu', 'gc'))}.",
    )
    out = [text(_MARGIN, 42, heading, size=22, bold=True)]
    out += [text(_MARGIN, 66 + 18 * k, note, color=QUIET) for k, note in enumerate(notes)]
    for row, (shared, words) in enumerate(_CASES):
        top = _TOP + row * _STEP_Y
        out.append(line(_MARGIN, top - 72, _WIDTH - _MARGIN, top - 72, GRID))
        out.append(text(_MARGIN, top - 48, words, size=15, bold=True))
        out += _error_panel(study, shared, top).svg()
        out += _coverage_panel(study, shared, top).svg()
    return document(_WIDTH, _HEIGHT, heading, out)


def _error_panel(study: ScalingStudy, shared: bool, top: float) -> Panel:
    values = [c.error_over_bound for c in _shown(study)]
    low, high = min(0.82, 0.95 * min(values)), 1.12 * max(1.6, *values)
    ticks = tuple((t, f"{t:g}×") for t in _ERROR_TICKS if low <= t <= high)
    return Panel(
        left=_LEFT,
        top=top,
        width=_PANEL_WIDTH,
        height=_PANEL_HEIGHT,
        title="Error of the parameters, in multiples of the bound",
        x_label=_X_LABEL,
        x=_correlation_axis(study),
        y=Axis(low, high, ticks, math.log),
        target=Target(
            1.0,
            1 - BOUND_TOLERANCE,
            1 + BOUND_TOLERANCE,
            "Cramér–Rao bound: no unbiased estimate does better",
            math.sqrt(low * (1 - BOUND_TOLERANCE)),
            _GREEN,
            _INKS[_GREEN],
        ),
        series=tuple(
            _series(cells, [(c.error_over_bound, c.error_over_bound_mc) for c in cells])
            for cells in _curves(study, shared)
        ),
    )


def _coverage_panel(study: ScalingStudy, shared: bool, top: float) -> Panel:
    lowest = min(c.coverage for c in _shown(study))
    low = min(0.85, math.floor(20 * lowest - 0.2) / 20)
    step = 0.05 if low >= 0.7 else 0.1 if low >= 0.4 else 0.2
    ticks = [1 - k * step for k in range(round((1 - low) / step) + 1)]
    band_low, band_high = COVERAGE_BAND
    return Panel(
        left=_LEFT + _STEP_X,
        top=top,
        width=_PANEL_WIDTH,
        height=_PANEL_HEIGHT,
        title="Stated 95 % intervals that hold the true value",
        x_label=_X_LABEL,
        x=_correlation_axis(study),
        y=Axis(low, 1.0, tuple((t, f"{100 * t:.0f} %") for t in ticks), float),
        target=Target(
            0.95,
            band_low,
            band_high,
            f"{100 * band_low:.0f} to {100 * band_high:.0f} %: the intervals are true",
            (1 + band_high) / 2,
            _GREEN,
            _INKS[_GREEN],
        ),
        series=tuple(
            _series(cells, [(c.coverage, c.coverage_mc) for c in cells])
            for cells in _curves(study, shared)
        ),
    )


def _correlation_axis(study: ScalingStudy) -> Axis:
    """Equal steps for equal factors of 1 - ρ, since all that happens happens near 1."""
    values = sorted({c.correlation for c in study.cells})
    ticks = tuple((v, f"{v:g}") for v in values)
    return Axis(values[0], values[-1], ticks, lambda rho: -math.log(1 - rho))


def _shown(study: ScalingStudy) -> list[StudyCell]:
    return [c for shared, _ in _CASES for cells in _curves(study, shared) for c in cells]


def _curves(study: ScalingStudy, shared: bool) -> list[tuple[StudyCell, ...]]:
    return [study.of(scaling, unit, shared) for scaling, unit in CURVES]


def _series(cells: tuple[StudyCell, ...], values: list[tuple[float, float]]) -> Series:
    scaling, unit = cells[0].scaling, cells[0].unit
    color = _COLORS[scaling]
    return Series(
        label=f"none, in {unit.replace(', ', ' and ')}" if scaling == "none" else scaling,
        color=color,
        ink=_INKS[color],
        dash=_DASHES[unit],
        points=tuple((c.correlation, v, 2 * mc) for c, (v, mc) in zip(cells, values, strict=True)),
    )


def _power_above(value: float) -> str:
    """Return the power of ten above a value, in words for a picture."""
    signs = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
    exponent = math.floor(math.log10(max(value, 1e-16))) + 1
    return "10" + str(exponent).translate(signs)
