"""What the covariance of a reading consists of, in words."""

from hilcal.identify.full_covariance import CovarianceParts

WORDS: dict[CovarianceParts, str] = {
    "instrument": (
        "the instrument alone; the arm's own scatter is not in it ([repeatability] "
        "joint_std_rad states it)"
    ),
    "instrument and repeatability": (
        "the instrument, and the arm's scatter as [repeatability] states it"
    ),
    "instrument and arm as stated": (
        "instrument and arm's scatter together; [repeatability] is not added again"
    ),
    "as imported": (
        "as an older version of hilcal imported it; [repeatability] is not added (import the "
        "table again for that)"
    ),
}


def covariance_words(parts: CovarianceParts) -> str:
    """Return a sentence without its full stop."""
    return f"each covariance is that of {WORDS[parts]}"
