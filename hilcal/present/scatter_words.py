"""The arm's own scatter, and noise that is correlated along the order, in words."""

from hilcal import numbers
from hilcal.calibration.scatter import ScatterSource
from hilcal.diagnosis.arm_repeatability import INDUSTRIAL, RP_PER_RMS, instrument_instead, separated
from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.readings.arm_scatter import ArmScatter
from hilcal.readings.serial_noise import SerialNoise
from hilcal.robot.arm import Arm


def left_to_the_arm(d: Diagnosis, nothing_missing: str) -> str:
    """Say that what is left is the arm's repeatability, and that no effect is missing."""
    s = _scatter(d)
    doubt = ""
    if not separated(s):
        doubt = (
            "; these readings cannot separate it from an instrument "
            f"{s.instrument_factor:.2g} times as noisy as stated"
        )
    alone = predicted = ""
    if s.predicted_share < 0.005:
        alone = "is predictable by nothing recorded (0 % on poses left out) and "
    else:
        predicted = f"; {_predicted(s)}"
    return (
        f"What is left, {numbers.length(s.size_m)} rms, {alone}is of the size of the arm's "
        f"repeatability: {sigmas(s)}{_maker(s, d.fit.model.cell.arm)}{predicted}; "
        f"{nothing_missing}{doubt}{_too_large(d)}"
    )


def _predicted(s: ArmScatter) -> str:
    """Say how much of what is left something recorded predicts, and that it is negligible."""
    by = " and ".join(s.predicted_by) if s.predicted_by else "what was recorded"
    size = numbers.length(s.predicted_share**0.5 * s.size_m)
    return (
        f"{100 * s.predicted_share:.0f} % of it, {size} rms, follows {by} on poses left out, which "
        "is negligible beside the rest"
    )


def _too_large(d: Diagnosis) -> str:
    """Say that the stated noise is too large beside the scatter, where it is."""
    if d.fit.readings.arm_scatter is None or d.noise is None or d.noise.reason != "too_large":
        return ""
    factor = d.fit.variance_factor**0.5
    return (
        f"; with it the residuals are {factor:.2g} times the noise, so the instrument's is stated "
        "too large in some of its elements"
    )


def no_repeatability(d: Diagnosis) -> str:
    """Say why what is left is not the arm's repeatability; the start of it is said already."""
    s, arm = _scatter(d), d.fit.model.cell.arm
    if instrument_instead(s):
        return (
            f"they are as if the instrument were {s.instrument_factor:.2g} times as noisy as "
            "stated, and not as if the arm scattered: mend the stated noise, or repeat some "
            "readings to be sure"
        )
    return (
        f"the arm would have to scatter by {numbers.length(s.size_m)} rms{_maker(s, arm)}, more "
        "than an arm's repeatability: the instrument is noisier than stated, or the arm or the "
        "target was loose"
    )


def sigmas(s: ArmScatter) -> str:
    """Write the standard deviations with their uncertainties."""
    if s.kind == "isotropic":
        value, error = numbers.with_std(1e6 * s.std[0], 1e6 * s.std_error[0])
        return f"the target scatters by σ = {value} ± {error} µm along each axis"
    pairs = [numbers.with_std(1e6 * v, 1e6 * e) for v, e in zip(s.std, s.std_error, strict=True)]
    if s.kind == "joints":
        return f"each joint scatters by σ_q = {pairs[0][0]} ± {pairs[0][1]} µrad"
    told = ", ".join(
        f"joint {j + 1} {value} ± {error}"
        for j, (value, error) in enumerate(pairs)
        if s.std[j] > s.std_error[j]
    )
    return f"the joints scatter by σ_q [µrad] = {told}, the others by less than can be told"


def _maker(s: ArmScatter, arm: Arm) -> str:
    """Compare with ISO 9283's figure."""
    own = f" (RP of ISO 9283 about {numbers.length(RP_PER_RMS * s.size_m)}"
    if arm.repeatability is None:
        return f"{own}; arms of industry have 0.02 to 0.1 mm)"
    return f"{own}; the maker states {numbers.digits(1e3 * arm.repeatability, 2)} mm)"


def repeatability_source(source: ScatterSource, arm: Arm) -> str:
    """Say what an arm's repeatability is from, as an uncertainty budget does."""
    if source == "estimated":
        return "type A: estimated with the model"
    if source == "stated":
        return "type B: as [repeatability] states it"
    if source == "repeats":
        return "type A: scatter of the repeated readings"
    if source == "maker" and arm.repeatability is not None:
        return f"type B: the maker states RP {numbers.length(arm.repeatability)} (ISO 9283)"
    if source == "industry":
        return f"type B: not known; RP of arms of industry is up to {numbers.length(INDUSTRIAL)}"
    return "not known"


def _scatter(d: Diagnosis) -> ArmScatter:
    if d.scatter is None:
        raise ValueError("a diagnosis of the arm's scatter without an estimate of it")
    return d.scatter


def correlated(n: SerialNoise) -> str:
    """Say that the readings are correlated along their order, and what it does."""
    rho, error = numbers.with_std(n.rho, n.rho_error)
    unit = "s" if n.clock == "time" else "readings"
    share = "" if n.share > 0.95 else f" in {100 * n.share:.0f} % of their variance"
    doubt = ""
    if not n.proved:
        others = " and ".join(n.instead) or "effects of the catalogue"
        doubt = f"; or not, since {others} would explain the readings as well: repeat them"
    low, high = n.wider
    return (
        f"readings are correlated along their order{share}: ρ = {rho} ± {error} from one to the "
        f"next, half-time {n.half:.2g} {unit}; standard uncertainties are {low:.2g} to {high:.2g} "
        f"times as large for it{doubt}"
    )
