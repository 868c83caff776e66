"""The columns of a law that are chosen together, and what is known of them beside others."""

from dataclasses import dataclass

from hilcal.regression.evidence import FamilyScore
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class LawTerm:
    """Columns of a law that are chosen together."""

    parts: tuple[tuple[int, int], ...]  # (site, amplitude) of each column, by index
    price: float  # what the search costs it
    common: bool = False  # whether all columns have one coefficient
    alone: float = 0.0  # what it would cost as the first term

    @property
    def count(self) -> int:
        """Number of coefficients."""
        return 1 if self.common else len(self.parts)


@dataclass(frozen=True, eq=False)
class Scored:
    """A term beside others."""

    term: LawTerm
    score: FamilyScore  # its score as a family

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
    """All candidates beside some columns, as in `Screen`."""

    slope: Floats  # (S, F) xᵀ r
    square: Floats  # (S, F) xᵀ M x; zero where little of a column is left
    across: Floats  # (S, F) xᵀ M x' with the partner
    across_one: Floats  # (S, F) xᵀ M x' with a constant at the site
