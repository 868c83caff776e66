"""The columns of a law that are chosen together, and what is known of them beside others."""

from dataclasses import dataclass

from hilcal.regression.evidence import FamilyScore
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class LawTerm:
    """Columns of a law that are chosen together.

    Attributes:
        parts: (site, amplitude) of each column, by index.
        price: what the search costs it.
        common: whether all columns have one coefficient.
        alone: what it would cost as the first term.
    """

    parts: tuple[tuple[int, int], ...]
    price: float
    common: bool = False
    alone: float = 0.0

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return 1 if self.common else len(self.parts)


@dataclass(frozen=True, eq=False)
class Scored:
    """A term beside others.

    Attributes:
        score: its score as a family.
    """

    term: LawTerm
    score: FamilyScore

    @property
    def odds(self) -> float:
        """Evidence less what the search costs."""
        return self.score.log_evidence - self.term.price


@dataclass(frozen=True, slots=True)
class ScreenedTerm:
    """A candidate of the screening: site, amplitude, and its odds."""

    s: int
    f: int
    odds: float


@dataclass(frozen=True, eq=False)
class Screening:
    """All candidates beside some columns, as in `Screen`.

    Attributes:
        slope: (S, F) xᵀ r.
        square: (S, F) xᵀ M x; zero where little of a column is left.
        across: (S, F) xᵀ M x' with the partner.
        across_one: (S, F) xᵀ M x' with a constant at the site.
    """

    slope: Floats
    square: Floats
    across: Floats
    across_one: Floats
