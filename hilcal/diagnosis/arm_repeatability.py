"""Whether an estimated scatter of the arm is of the size of an arm's repeatability."""

from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE
from hilcal.readings.readings import ArmScatter
from hilcal.robot.arm import Arm

RP_PER_RMS = 2.09
"""Pose repeatability RP = mean + 3 S of the distances from their centre (ISO 9283, 7.2.2), in units
of their rms, for an isotropic normal scatter."""
INDUSTRIAL = 1e-4
"""RP of industrial arms reaches from 0.02 to 0.1 mm in their data sheets; this where an arm's own
is not known, m."""
ELSEWHERE = 3.0
"""How many times RP an arm may scatter in a campaign; a choice. RP is measured warm, at five poses
in one cube, each approached from one side; a campaign goes everywhere, from all sides."""


def stated_repeatability(arm: Arm) -> float:
    """Return RP as the arm's maker states it, else that of industrial arms, m."""
    return INDUSTRIAL if arm.repeatability is None else arm.repeatability


def of_repeatability_size(scatter: ArmScatter, arm: Arm) -> bool:
    """Whether an arm like this may scatter so much."""
    return RP_PER_RMS * scatter.size_m <= ELSEWHERE * stated_repeatability(arm)


def instrument_instead(scatter: ArmScatter) -> bool:
    """Whether the readings prefer an instrument that is noisier than stated, beyond doubt."""
    return scatter.log_evidence < -SAME_EVIDENCE


def separated(scatter: ArmScatter) -> bool:
    """Whether the readings tell the arm's scatter from a noisier instrument."""
    return abs(scatter.log_evidence) > SAME_EVIDENCE
