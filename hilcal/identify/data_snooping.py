"""Data snooping (Baarda): gross errors, by a test of a shift of each reading.

With P the projection off the columns of the model and of smooth nuisance functions (those with a
prior by their marginal covariance, see `regression.projection`), and S_k (R, m) the whitened
effect of a shift of reading k, loaded or the unloaded one that deflections share,

    t²_k = (S_kᵀ P r)ᵀ (S_kᵀ P S_k)⁻¹ (S_kᵀ P r)

is χ²_m for a good reading, whatever its leverage. The search is a forward selection: the shift of
the reading with the largest t² joins the columns that P projects off, and t² is computed anew, so
that gross errors neither mask each other nor raise t² of good readings.

Source: Baarda, *A testing procedure for use in geodetic networks* (1968).
"""

from dataclasses import dataclass

import numpy as np

from hilcal.data.readings import Readings
from hilcal.data.whitening import Whitening
from hilcal.identify.gauss_newton import Solution
from hilcal.identify.outliers import bulk, limit
from hilcal.identify.smooth_nuisance import smooth_nuisance_columns
from hilcal.model import Model
from hilcal.regression import products, schur
from hilcal.regression.distributions import binom
from hilcal.regression.factored import Factored, Tall, beside, of_rows, written
from hilcal.regression.products import times
from hilcal.regression.small_forms import quadratic_forms
from hilcal.types import Bools, Floats, Ints

SMALLEST = 3e-3
"""Share of the largest t² below which errors wait for a new fit; a choice, no study set it."""
LEVERAGE = 1e-6
"""Share of a reading's information that P must leave for a test; a choice, no study set it."""
ACCIDENT = 1e-3
"""Binomial probability of so many shared unloaded readings among the gross errors, below which the
cause is a misfit; a choice, the tests of effects on unloaded readings confirm it."""
PATIENCE = 10
"""Selections beyond the last gross error after which the search ends, with half of the most that
may be set aside; a choice, no study set it."""


@dataclass(frozen=True, slots=True, eq=False)
class SetAside:
    """Gross errors of a solution.

    Attributes:
        drop: rows of the readings to set aside.
        count: number of gross errors; one in a shared unloaded reading drops several rows.
    """

    drop: Ints
    count: int


def find_gross_errors(
    model: Model, solution: Solution, readings: Readings, w: Whitening, most: int
) -> SetAside:
    """Search a gc-scaled solution for at most `most` gross errors.

    More than twice as many, or too large a share of unloaded readings, is a misfit of the model:
    none is returned.
    """
    e, columns, root = _projection(model, solution, readings, w)
    c = _candidates(w)
    g = c.gradients(e[:, None])[:, :, 0]
    off = _Elimination(c, columns, root)
    a = off.information()
    trace = np.trace(a, axis1=1, axis2=2)
    drop: list[Ints] = []
    taken: list[int] = []
    largest, found, candidate = 0.0, 0, np.ones(len(c.row), dtype=bool)
    t2 = _t2(g, a, trace)
    least, patience = limit(w.m, len(c.row)), most // 2 + PATIENCE
    while len(drop) <= min(2 * most, found + patience) and (candidate & c.loaded).any():
        k = int(np.argmax(np.where(candidate, t2, 0.0)))
        top = float(t2[k])
        largest = max(largest, top)
        if top <= max(least, SMALLEST * largest):
            break
        drop.append(c.drops[k])
        taken.append(k)
        candidate &= ~np.isin(c.row, c.drops[k])
        # P becomes P − P S (Sᵀ P S)⁻¹ Sᵀ P; it is no projection where parts have a prior.
        inverse_root = _inverse_root(a[k], float(trace[k]))
        slope = off.eliminate(k, inverse_root)
        size = inverse_root.T @ g[k]
        g = g - slope @ size
        a = a - slope @ np.swapaxes(slope, 1, 2)
        t2 = _t2(g, a, trace)
        # The scale of the bulk is that without the selected shifts, which act on all residuals.
        if top > limit(w.m, len(c.row), bulk(t2[c.loaded & candidate], w.m)):
            found = len(drop)
    shared = int(np.count_nonzero(~c.loaded[taken[:found]]))
    chance = float(binom.sf(shared - 1, found, np.mean(~c.loaded))) if shared else 1.0
    if found > 2 * most or chance < ACCIDENT:
        found = 0
    found = min(found, most)
    rows = np.unique(np.concatenate(drop[:found])) if found else np.zeros(0, dtype=np.int64)
    return SetAside(rows, found)


def _projection(
    model: Model, solution: Solution, readings: Readings, w: Whitening
) -> tuple[Floats, Tall, Floats]:
    """Residual (R,), columns B (R, K) of model and smooth nuisance, and T (K, K).

    P = 1 − B TᵀT Bᵀ, see `regression.projection`.
    """
    x = smooth_nuisance_columns(model, solution.prediction, readings, w)
    across = solution.tall.T @ x
    gram = np.block([[solution.equations.gram, across], [across.T, products.gram(x)]])
    columns, ridge = beside(solution.tall, x), np.append(solution.ridge, np.ones(x.shape[1]))
    root = schur.inverse_root(gram + np.diag(ridge))
    z = np.append(solution.coordinates(), np.zeros(x.shape[1]))
    step = root.T @ (root @ (columns.T @ solution.white - ridge * z))
    return np.asarray(solution.white - columns @ step), columns, root


def _inverse_root(a: Floats, trace: float) -> Floats:
    """Root (m, r) of the pseudo-inverse of (m, m), of eigenvalues above `LEVERAGE`."""
    values, vectors = np.linalg.eigh(a)
    kept = values > LEVERAGE * max(trace, 1e-300)
    return np.asarray(vectors[:, kept] / np.sqrt(values[kept]))


def _t2(g: Floats, a: Floats, trace: Floats) -> Floats:
    """(N,) t²; zero for a reading without eigenvalues above `LEVERAGE`."""
    return quadratic_forms(a, g, LEVERAGE * np.maximum(trace, 1e-300))


@dataclass(frozen=True, slots=True, eq=False)
class _Shifts:
    """Whitened effects of shifts of N candidate readings.

    Attributes:
        row: (N,) the reading.
        loaded: (N,) whether it is a measurement by itself.
        drops: rows to set aside with it.
        blocks: per shape: whitened rows (G, r) and shifts (G, r, c·m) of c readings each.
        m: elements.
    """

    row: Ints
    loaded: Bools
    drops: list[Ints]
    blocks: list[tuple[Ints, Floats]]
    m: int

    def gradients(self, x: Floats) -> Floats:
        """(N, m, P) Sᵀ x of whitened columns (R, P)."""
        out = [
            (np.swapaxes(s, 1, 2) @ x[rows]).reshape(-1, self.m, x.shape[1])
            for rows, s in self.blocks
        ]
        return np.concatenate(out)

    def place(self, k: int) -> tuple[Floats, Ints, slice, slice]:
        """Shifts (r, c·m) of candidate k's group, its rows, its candidates, and k's columns."""
        first = 0
        for rows, s in self.blocks:
            each = s.shape[2] // self.m
            group, i = divmod(k - first, each)
            if group < len(rows):
                start = first + group * each
                own = slice(i * self.m, (i + 1) * self.m)
                return s[group], rows[group], slice(start, start + each), own
            first += len(rows) * each
        raise IndexError(k)


class _Elimination:
    """P of the model, and of the shifts that were selected, as the candidates see it.

    A shift acts on the rows of its own group alone. With L the projection off the selected shifts,
    group by group, and P = I − Q Qᵀ before, Q = B Tᵀ,

        P = L − L Q C Qᵀ L,    C = (I − Qᵀ (I − L) Q)⁻¹

    so that only C (K, K) has to be kept, and S_kᵀ L Q (m, K) of the candidates whose group has a
    selected shift. Of the others it is S_kᵀ B Tᵀ, of which only products are formed.
    """

    def __init__(self, shifts: _Shifts, columns: Tall, root: Floats) -> None:
        """Begin without selected shifts.

        Args:
            shifts: of the candidates.
            columns: (R, K) B.
            root: (K, K) T.
        """
        self._shifts, self._columns, self._root = shifts, columns, root
        self._c = np.eye(len(root))
        self._local: dict[int, Floats] = {}
        self._seen: dict[int, tuple[slice, Floats]] = {}

    def information(self) -> Floats:
        """(N, m, m) Sᵀ P S before the first selection."""
        m, own = self._shifts.m, []
        for _, s in self._shifts.blocks:
            parts = s.reshape(*s.shape[:2], -1, m)
            own.append(np.einsum("grci,grcj->gcij", parts, parts).reshape(-1, m, m))
        return np.asarray(np.concatenate(own) - self._gone())

    def _gone(self) -> Floats:
        """(N, m, m) Sᵀ Q Qᵀ S."""
        shifts, columns = self._shifts, self._columns
        if isinstance(columns, Factored):  # each reading by itself
            ((rows, s),) = shifts.blocks
            forms = columns.forms(self._root)[rows[:, 0] // shifts.m]
            return np.asarray(np.swapaxes(s, 1, 2) @ forms @ s)
        seen = shifts.gradients(times(columns, self._root.T))
        return np.asarray(seen @ np.swapaxes(seen, 1, 2))

    def eliminate(self, k: int, inverse_root: Floats) -> Floats:
        """Project off candidate k, too; returns Sᵀ P S_k times the root, (N, m, r).

        Args:
            k: the candidate.
            inverse_root: (m, r) root of the pseudo-inverse of S_kᵀ P S_k.
        """
        m = self._shifts.m
        shifts, rows, members, own = self._shifts.place(k)
        local = self._local.get(members.start, shifts)
        seen = self._of_group(members, shifts, rows)
        ours = seen[k - members.start].T @ inverse_root
        along = self._c @ ours
        slope = -self._shifts.gradients(self._columns @ (self._root.T @ along))
        for changed, of in self._seen.values():
            slope[changed] = -(of @ along)
        mine = local[:, own] @ inverse_root
        slope[members] += (local.T @ mine).reshape(-1, m, mine.shape[1])
        self._c += along @ along.T
        unit, r = np.linalg.qr(mine)
        gone = np.linalg.solve(r.T, ours.T)
        now = seen - ((local.T @ unit) @ gone).reshape(-1, m, seen.shape[2])
        self._seen[members.start] = members, now
        self._local[members.start] = local - unit @ (unit.T @ local)
        return slope

    def _of_group(self, members: slice, shifts: Floats, rows: Ints) -> Floats:
        """(c, m, K) Sᵀ L Q of the candidates of a group."""
        if members.start in self._seen:
            return self._seen[members.start][1]
        mine = np.zeros(len(self._columns), dtype=np.bool_)
        mine[rows] = True
        q = written(of_rows(self._columns, mine)) @ self._root.T
        return np.asarray((shifts.T @ q).reshape(-1, self._shifts.m, q.shape[1]))


def _candidates(w: Whitening) -> _Shifts:
    m = w.m
    row, loaded, drops, blocks = [], [], [], []
    first = 0
    for b in w.buckets:
        groups, size = b.loaded.shape
        refs = b.reference.shape[1]
        rows = first + np.arange(groups * size * m).reshape(groups, -1)
        shifts, cells = [b.factor], [b.loaded]
        each = b.factor.reshape(groups, size * m, size, m)
        # Where one deflection is taken from one unloaded reading, a shift of either is the same.
        users = [np.flatnonzero(b.weights[:, u]) for u in range(refs)]
        alone = [bool(np.all(b.weights[mine, u] == 1.0)) for u, mine in enumerate(users)]
        tested = [u for u in range(refs) if len(users[u]) > 1 or not alone[u]]
        shifts += [-np.einsum("grli,l->gri", each, b.weights[:, u]) for u in tested]
        cells += [b.reference[:, [u]] for u in tested]
        blocks.append((rows, np.concatenate(shifts, axis=2)))
        of = np.concatenate(cells, axis=1)
        row.append(of.reshape(-1))
        loaded.append(np.tile(np.arange(of.shape[1]) < size, groups))
        for g in range(groups):
            drops += [np.array([r]) for r in b.loaded[g]]
            for u in tested:
                own = b.reference[g, [u]]
                drops.append(np.concatenate([own, b.loaded[g, users[u]]]) if alone[u] else own)
        first += groups * size * m
    return _Shifts(np.concatenate(row), np.concatenate(loaded), drops, blocks, m)
