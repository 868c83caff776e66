"""The scaling study as a table for people."""

from rich import box
from rich.table import Table
from rich.text import Text

from hilcal.readings.whitening import Scaling
from hilcal.study.scaling import UNITS, ScalingStudy, StudyCell

BOUND_TOLERANCE = 0.03
COVERAGE_BAND = (0.94, 0.96)
# What is shown: the units matter to `none` alone.
CURVES: tuple[tuple[Scaling, str], ...] = (
    *(("none", unit) for unit, _, _ in UNITS),
    ("gu", UNITS[0][0]),
    ("gc", UNITS[0][0]),
)
UNLOADED = {False: "own", True: "shared"}


def title(study: ScalingStudy) -> str:
    """One line that says what was simulated."""
    return (
        f"Joint compliances of a {study.arm}: {study.poses} poses x {study.loads} loads, "
        f"{study.runs} Monte-Carlo runs"
    )


def largest_shift(study: ScalingStudy, *scalings: Scaling) -> float:
    """Largest change of an estimate with the units, in units of the bound."""
    return max(c.unit_shift for c in study.cells if c.scaling in scalings)


def table(study: ScalingStudy) -> Table:
    """Error over bound and coverage per scaling: one row per correlation."""
    out = Table(
        title=title(study), caption=_caption(study), box=box.SIMPLE_HEAD, caption_justify="left"
    )
    out.add_column("unloaded\nreading")
    out.add_column("corr.\nrho", justify="right")
    for scaling, unit in CURVES:
        out.add_column(f"{scaling}\n{unit if scaling == 'none' else 'any unit'}", justify="right")
    for shared, word in UNLOADED.items():
        curves = [study.of(scaling, unit, shared) for scaling, unit in CURVES]
        for k, row in enumerate(zip(*curves, strict=True)):
            out.add_row(
                word if k == 0 else "",
                f"{row[0].correlation:g}",
                *(_entry(cell) for cell in row),
                end_section=k == len(curves[0]) - 1,
            )
    return out


def _entry(cell: StudyCell) -> Text:
    """Error and coverage, green where they are as they should be."""
    low, high = COVERAGE_BAND
    fits = abs(cell.error_over_bound - 1) <= BOUND_TOLERANCE
    covers = low <= cell.coverage <= high
    return Text.assemble(
        (f"{cell.error_over_bound:.2f}x", "green" if fits else "red"),
        " ",
        (f"{100 * cell.coverage:.1f}%", "green" if covers else "red"),
    )


def _caption(study: ScalingStudy) -> str:
    """How to read the table."""
    error = max(c.error_over_bound_mc / c.error_over_bound for c in study.cells)
    coverage = max(c.coverage_mc for c in study.cells)
    return (
        "Each entry: error of the estimated compliances, as a multiple of the smallest that is "
        "possible (Cramér–Rao bound), and the share of the stated 95 % intervals that hold the "
        "true value. It should say 1.00x 95.0%.\n"
        "corr.: share of the noise variance that the six elements of a reading have in common; "
        f"{study.typical_correlation:.2f} is what the arm's repeatability and the tracker specify. "
        "own: each load has its own unloaded reading; shared: the loads of a pose share one, so "
        "that their deflections are correlated as well.\n"
        f"Changing units moves an estimate by up to {largest_shift(study, 'none'):.0f} standard "
        f"uncertainties with none, and by {largest_shift(study, 'gu', 'gc'):.0e} with gu and gc. "
        f"Monte-Carlo standard uncertainty: below {100 * error:.1f} % of an error, "
        f"{100 * coverage:.1f} % in coverage."
    )
