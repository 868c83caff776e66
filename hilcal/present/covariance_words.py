"""What the covariance of a reading consists of, in words."""

from hilcal import numbers
from hilcal.identification.full_covariance import CovarianceParts
from hilcal.identification.noise_estimate import NoiseEstimate

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


def covariance_words(parts: CovarianceParts, noise: NoiseEstimate | None = None) -> str:
    """Return a sentence without its full stop.

    Args:
        parts: what the covariance consists of.
        noise: the estimate of the noise, where nothing states it.
    """
    if noise is not None:
        return _estimated(noise)
    return f"each covariance is that of {WORDS[parts]}"


def _estimated(n: NoiseEstimate) -> str:
    turn = "" if n.orientation_rad is None else f", orientations {1e6 * n.orientation_rad:.2g} µrad"
    arm = ""
    if n.joint_std_rad is not None:
        arm = f"; each joint scatters by {1e6 * n.joint_std_rad:.2g} µrad from arrival to arrival"
    return (
        f"neither the table nor [tracker] states the noise; it was estimated from the readings, "
        f"together with all effects: {numbers.length(n.along_m)} along the beam, "
        f"{numbers.length(n.across_m)} across it at {n.distance_m:.2g} m{turn}{arm}"
    )
