"""Earlier names of `identify.linearisation`, until their users have changed."""

from hilcal.identify.fit import Fit
from hilcal.identify.linearisation import Linearisation, left_out_by_pose
from hilcal.regression.evidence import FamilyScore
from hilcal.types import Floats

__all__ = ["Projection", "left_out_by_pose", "projection"]


class Projection(Linearisation):
    """A linearisation."""

    @property
    def white(self) -> Floats:
        """Residual."""
        return self.residual

    @property
    def yy(self) -> float:
        """‖r‖²."""
        return self.rss

    @property
    def factor(self) -> tuple[Floats, bool]:
        """Cholesky factor of H."""
        return self.projection.low, True

    def free(self, x: Floats) -> Floats:
        """M X."""
        return self.project_out(x)

    def score_of(self, s: Floats, x: Floats) -> FamilyScore:
        """Score with S known."""
        return self.score(x, s)

    def held_out_share(self, x: Floats, found: FamilyScore) -> float:
        """Share on poses left out."""
        return self.held_out(x, found).share


def projection(fit: Fit) -> Projection:
    """Return the linearisation of a gc-scaled fit."""
    return Projection(fit, fit.solution.projection(), fit.solution.projected_residual())
