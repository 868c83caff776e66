"""The linear problem of a mixed model: rows, columns by family, and blocks of the noise.

    y = A b + Σ_f Z_f u_f + e,    e ~ N(0, Σ_k exp(2 η_k) R_k)

All R_k are diagonal. For rows whitened by the stated covariance R_0 = 1, the instrument; R_1, the
arm's scatter, is block diagonal, and its eigenvectors turn the rows so that both are diagonal
(`independent_rows`). Columns are scaled to ordinary magnitudes, X = [Q | Z D^½] with Q an
orthonormal basis of the frames' columns. A frame of known size, as a target that the poses leave
open, hardly differs from the others: its columns have no part in the span of Q, which would cancel
by nine digits, and the coordinates of Q are b plus that part.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hilcal.mixed.families import Families, LogStdPrior, log_std_prior
from hilcal.types import Bools, Floats, Ints

FRAMES_TOLERANCE = 1e-9
"""Share of the largest singular value of the frames' columns, scaled to unit length, below which a
direction counts as undetermined by the readings (the gauge of base and target)."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """One component of the noise: covariance exp(2 η) R_k."""

    name: str
    variance: Floats  # (R,) diagonal of R_k
    prior: LogStdPrior  # of η


@dataclass(frozen=True, eq=False)
class MixedProblem:
    """Rows, columns and noise at a linearisation."""

    y: Floats  # (R,) measured minus what the model predicts without frames and families
    x: Floats  # (R, K) columns [Q | Z D^½]
    frames: Floats  # (F, k): b = frames @ the first k coordinates
    families: Families  # of the other columns
    family: Ints  # (K − k,) family of each other column
    noise: tuple[Noise, ...]  # components, that of the instrument first
    absorbed: Floats  # (k, K − k) Qᵀ Z D^½ of families of known size, zero for others
    zeros: int = 0  # further rows, zero in y and x, with the variance exp(2 η) of the instrument

    @property
    def flat(self) -> int:
        """Number k of coordinates without a prior."""
        return int(self.frames.shape[1])

    @property
    def priors(self) -> tuple[LogStdPrior, ...]:
        """Priors of log s and η, families first."""
        return (*(f.prior for f in self.families.random), *(n.prior for n in self.noise))

    @cached_property
    def log_std_prior(self) -> tuple[Floats, Floats]:
        """Prior mean (F + N,) and precision (F + N, F + N) of log s and η."""
        return log_std_prior(self.priors, self.families.random)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of families and components of the noise."""
        return (*self.families.names, *(n.name for n in self.noise))

    @cached_property
    def white(self) -> bool:
        """Whether all measured rows have the noise of one component, of equal variance."""
        variance = self.noise[0].variance
        return len(self.noise) == 1 and bool(np.all((variance == 0.0) | (variance == 1.0)))

    @cached_property
    def gram(self) -> Floats:
        """(K, K) Xᵀ X."""
        return np.asarray(self.x.T @ self.x)

    def coordinates(self, jacobian: Floats) -> Floats:
        """Return columns (..., K) from derivatives (..., P) by the model's parameters."""
        out = np.empty((*jacobian.shape[:-1], self.flat + len(self.family)))
        out[..., : self.flat] = jacobian[..., self.families.frames] @ self.frames
        start = self.flat
        for f in self.families.random:
            stop = start + len(f.parameters)
            out[..., start:stop] = jacobian[..., f.parameters] * f.magnitude
            start = stop
        if self.absorbed.any():
            out[..., self.flat :] -= out[..., : self.flat] @ self.absorbed
        return out

    def parameters(self, c: Floats, size: int) -> Floats:
        """Return parameters (size, ...) of the model from coordinates (K, ...)."""
        theta = np.zeros((size, *c.shape[1:]))
        theta[self.families.frames] = self.frames @ (
            c[: self.flat] - self.absorbed @ c[self.flat :]
        )
        start = self.flat
        for f in self.families.random:
            stop = start + len(f.parameters)
            theta[f.parameters] = (c[start:stop].T * f.magnitude).T
            start = stop
        return theta

    def noise_std(self, eta: Floats) -> Floats:
        """(R,) R^½ at η (N,); 1 for rows without variance, which carry no information."""
        variance = sum(np.exp(2 * e) * n.variance for n, e in zip(self.noise, eta, strict=True))
        return np.sqrt(np.where(variance == 0.0, 1.0, variance))

    def without(self, numbers: Sequence[int]) -> "MixedProblem":
        """Return the problem without the columns of some families."""
        random = tuple(f for k, f in enumerate(self.families.random) if k not in numbers)
        retained = ~np.isin(self.family, numbers)
        x = np.hstack([self.x[:, : self.flat], self.x[:, self.flat :][:, retained]])
        renumbered = np.cumsum(~np.isin(np.arange(len(self.families.random)), numbers)) - 1
        return MixedProblem(
            self.y, x, self.frames, Families(self.families.frames, random),
            renumbered[self.family[retained]], self.noise, self.absorbed[:, retained], self.zeros,
        )  # fmt: skip

    def compressed(self) -> "MixedProblem":
        """Return the same problem in K + 1 rows, where it has more, and white noise alone.

        [X | y] = Q R with orthonormal Q: the rows R have the same noise as [X | y], and the others
        of Qᵀ [X | y] are zero.
        """
        noise = self.noise[0]
        measured = noise.variance > 0.0
        count, columns = int(measured.sum()), self.x.shape[1]
        if not self.white or count <= columns + 1:
            return self
        rows = np.asarray(np.linalg.qr(np.column_stack([self.x, self.y])[measured], mode="r"))
        white = replace(noise, variance=np.ones(len(rows)))
        zeros = self.zeros + count - len(rows)
        return replace(self, y=rows[:, -1], x=rows[:, :-1], noise=(white,), zeros=zeros)


def mixed_problem(
    y: Floats,  # (R,)
    jacobian: Floats,  # (R, P) whitened derivative by all parameters of the model
    families: Families,
    noise: Sequence[Noise],  # components, that of the instrument first
) -> MixedProblem:
    """Build the problem from whitened rows."""
    frames = _frame_basis(jacobian[:, families.frames])
    random = families.random
    counts = [len(f.parameters) for f in random]
    family = np.repeat(np.arange(len(random)), counts)
    problem = MixedProblem(
        y, jacobian, frames, families, family, tuple(noise),
        np.zeros((frames.shape[1], len(family))),
    )  # fmt: skip
    x = problem.coordinates(jacobian)
    known = np.array([f.known for f in random], dtype=np.bool_)[family]
    q = x[:, : problem.flat]
    absorbed = np.where(known, q.T @ x[:, problem.flat :], 0.0)
    x[:, problem.flat :][:, known] -= q @ absorbed[:, known]
    return replace(problem, x=x, absorbed=absorbed)


def independent_rows(covariance: Floats, measured: Bools) -> tuple[Floats, Floats]:
    """Return U (G, S, S) and the variances (G, S) of rows Uᵀ y with a covariance (G, S, S).

    Rows that are not measured (G, S), of covariance zero, are not mixed with measured ones.
    """
    diagonal = np.arange(measured.shape[1])
    marked = covariance.copy()
    marked[:, diagonal, diagonal] -= ~measured
    variance, u = np.linalg.eigh(marked)
    return np.asarray(u), np.asarray(variance)


def _frame_basis(a: Floats) -> Floats:
    """Basis (F, k): the columns of A @ basis are orthonormal and span those of A."""
    if not a.shape[1]:
        return np.zeros((0, 0))
    length = np.linalg.norm(a, axis=0)
    scale = np.where(length > 0, length, 1.0)
    _, values, v = np.linalg.svd(a / scale, full_matrices=False)
    moving = values > FRAMES_TOLERANCE * values[0]
    return np.asarray((v[moving].T / values[moving]) / scale[:, None])
