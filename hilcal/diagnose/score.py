"""Earlier names of `regression.evidence`, until their users have changed."""

from hilcal.regression.evidence import STRENGTHS
from hilcal.regression.evidence import FamilyScore as Score
from hilcal.regression.evidence import score_family as score

__all__ = ["STRENGTHS", "Score", "score"]
