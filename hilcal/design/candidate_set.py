"""The candidate set: units of measurement with their information and their cost."""

from dataclasses import dataclass

import numpy as np

from hilcal.types import Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class CandidateSet:
    """K units, each of which a plan may take any whole number of times.

    A unit is one reading (absolute positions), or one pose with its unloaded reading and some
    loads (deflections, which share the unloaded reading and are correlated by it). The
    information of a plan that takes unit k n_k times is

        M = M0 + Σ n_k A_kᵀ A_k,    cost = Σ n_k c_k
    """

    # (K, R, P) whitened Jacobians A_k by the parameters in ordinary magnitudes (pure numbers);
    # units with fewer rows are filled up with zeros
    rows: Floats
    cost: Floats  # (K,) what taking the unit once costs, over 0: readings, or seconds

    def __len__(self) -> int:
        """Return the number of units K."""
        return len(self.rows)

    @property
    def size(self) -> int:
        """Number of parameters P."""
        return int(self.rows.shape[2])

    def information(self, weight: Floats, which: Ints | None = None) -> Floats:
        """Return (P, P) Σ w_k A_kᵀ A_k.

        weight: (K,) weights, or of the chosen units; which: indices of the units that the weights
        belong to; all by default.
        """
        rows = self.rows if which is None else self.rows[which]
        root = (rows * np.sqrt(weight)[:, None, None]).reshape(-1, self.size)
        return np.asarray(root.T @ root)
