"""Tours from the reference pose through stops and back: short tours, random tours, and loops.

All functions use a matrix of travel times, s, (m + 1, m + 1), whose element (i, j) is the way from
stop i to stop j; 0 is the reference. A way that does not exist costs `NEVER`.
"""

from collections.abc import Sequence
from itertools import pairwise, permutations

import numpy as np

from hilcal.types import Floats

NEVER = 1e7  # s, of a way that does not exist: longer than any campaign, and sums stay exact
_EXACT = 7  # stops up to which every order is tried
_LONGEST = 3  # stops of a segment that is moved, at most
_KICKS = 20  # double bridges
_GAIN = 1e-9  # s, below which a change is rounding


def length(seconds: Floats, order: Sequence[int]) -> float:
    """Return the seconds of the tour 0, order, 0."""
    way = [0, *order, 0]
    return float(seconds[way[:-1], way[1:]].sum())


def short_tour(seconds: Floats, rng: np.random.Generator) -> list[int]:
    """Return an order of stops 1 to m whose tour is short; up to 7 stops, the shortest.

    Nearest insertion, then 2-opt and Or-opt exchanges until none helps. The exchanges are repeated
    after each of several double bridges (Martin, Otto & Felten 1991); the best tour is returned.
    """
    count = len(seconds) - 1
    if count <= _EXACT:
        orders = np.array(list(permutations(range(1, count + 1))), dtype=np.int64)
        ways = np.pad(orders, ((0, 0), (1, 1)))
        first = int(np.argmin(seconds[ways[:, :-1], ways[:, 1:]].sum(axis=1)))
        return [int(k) for k in orders[first]]
    best = improved_tour(seconds, _inserted(seconds))
    least = length(seconds, best)
    for _ in range(_KICKS):
        a, b, c = sorted(int(k) for k in rng.choice(np.arange(1, count), 3, replace=False))
        order = improved_tour(seconds, best[:a] + best[b:c] + best[a:b] + best[c:])
        if (total := length(seconds, order)) < least - _GAIN:
            best, least = order, total
    return best


def _inserted(seconds: Floats) -> list[int]:
    """Repeatedly insert the stop nearest to the tour at the place where it costs least."""
    count = len(seconds) - 1
    near = np.minimum(seconds, seconds.T)
    gap, outside = near[0].copy(), np.ones(count + 1, dtype=np.bool_)
    outside[0] = False
    way = [0, 0]
    for _ in range(count):
        k = int(np.argmin(np.where(outside, gap, np.inf)))
        a, b = way[:-1], way[1:]
        place = int(np.argmin(seconds[a, k] + seconds[k, b] - seconds[a, b]))
        way.insert(place + 1, k)
        outside[k] = False
        gap = np.minimum(gap, near[k])
    return way[1:-1]


def improved_tour(seconds: Floats, order: Sequence[int]) -> list[int]:
    """Return an order that no 2-opt or Or-opt exchange shortens; the best exchange first."""
    way = np.array([0, *order, 0])
    while len(way) > 3:
        change = min(_turned(seconds[np.ix_(way, way)]), _moved(seconds[np.ix_(way, way)]))
        if change[0] > -_GAIN:
            break
        _, i, j, place, turn = change
        part = way[i : j + 1][::-1] if turn else way[i : j + 1]
        remaining = np.concatenate([way[:i], way[j + 1 :]])
        index = place + 1 if place < i else place - (j - i)
        way = np.concatenate([remaining[:index], part, remaining[index:]])
    return [int(k) for k in way[1:-1]]


_Change = tuple[float, int, int, int, bool]  # added s; first and last of part; place; turned


def _turn_cost(p: Floats) -> Floats:
    """Return (k, k), s: the cost of reversing the part from place i to j, without its ends."""
    forward = np.concatenate([[0.0], np.cumsum(np.diagonal(p, 1))])
    back = np.concatenate([[0.0], np.cumsum(np.diagonal(p, -1))])
    extra = back - forward
    return np.asarray(extra[None, :] - extra[:, None])


def _turned(p: Floats) -> _Change:
    """Return the best reversal of a part (2-opt); `p`, s: times between places of the tour."""
    k = len(p)
    i, j = np.triu_indices(k - 2, 1)
    i, j = i + 1, j + 1
    gain = p[i - 1, j] + p[i, j + 1] - p[i - 1, i] - p[j, j + 1] + _turn_cost(p)[i, j]
    best = int(np.argmin(gain))
    return float(gain[best]), int(i[best]), int(j[best]), int(i[best]) - 1, True


def _moved(p: Floats) -> _Change:
    """Return the best move of a part of up to three stops to another place (Or-opt)."""
    k, turn_cost = len(p), _turn_cost(p)
    places = np.arange(k - 1)
    best: _Change = (np.inf, 0, 0, 0, False)
    for size in range(1, min(_LONGEST, k - 3) + 1):
        i = np.arange(1, k - size)[:, None]
        j = i + size - 1
        out = p[i - 1, j + 1] - p[i - 1, i] - p[j, j + 1] - p[places, places + 1]
        inside = (places >= i - 1) & (places <= j)
        for turn in (False, True) if size > 1 else (False,):
            a, b = (j, i) if turn else (i, j)
            gain = out + p[places, a] + p[b, places + 1] + (turn_cost[i, j] if turn else 0.0)
            gain = np.where(inside, np.inf, gain)
            index = int(np.argmin(gain))
            row, place = divmod(index, k - 1)
            change = (float(gain[row, place]), row + 1, row + size, place, turn)
            best = min(best, change)
    return best


def random_tour(
    seconds: Floats, order: Sequence[int], budget: float, rng: np.random.Generator, n_moves: int
) -> list[int]:
    """Return a random order whose tour takes at most `budget`, s, or no more than that of `order`.

    A random walk by reversals and moves of parts, each as probable as its inverse; a step that
    exceeds the budget is not taken.
    """
    way = [0, *order, 0]
    total, count = length(seconds, order), len(order)
    if count < 2:
        return list(order)
    symmetric = bool(np.array_equal(seconds, seconds.T))
    w = seconds.tolist()
    draws = rng.integers(1, count + 1, (n_moves, 2)).tolist()
    turns = (rng.random(n_moves) < 0.5).tolist()
    for (a, b), turn in zip(draws, turns, strict=True):
        if a == b:
            continue
        i, j = min(a, b), max(a, b)
        part = way[i : j + 1]
        # the part is reversed, or the stop at a moves to b
        new = part[::-1] if turn else [*part[1:], part[0]] if a < b else [part[-1], *part[:-1]]
        start, end = way[i - 1], way[j + 1]
        gain = w[start][new[0]] - w[start][part[0]] + w[new[-1]][end] - w[part[-1]][end]
        if not turn:  # within the part, one way is added and one removed
            added, removed = (new[-2:], part[:2]) if a < b else (new[:2], part[-2:])
            gain += w[added[0]][added[1]] - w[removed[0]][removed[1]]
        elif not symmetric:
            gain += sum(w[x][y] for x, y in pairwise(new))
            gain -= sum(w[x][y] for x, y in pairwise(part))
        if total + gain <= max(budget, total):
            way[i : j + 1] = new
            total += gain
    return way[1:-1]


def loops(
    direct: Floats, order: Sequence[int], reading_s: float, limit_s: float
) -> list[list[int]] | None:
    """Return a tour cut into loops from the reference of least total time; None if impossible.

    Dynamic programming over the places to cut the tour (Beasley 1983): T(j) = min over i
    of T(i) + loop(i + 1 … j). A loop of one stop is always allowed.
    """
    count = len(order)
    best, cut = np.full(count + 1, np.inf), np.zeros(count + 1, dtype=np.int64)
    best[0] = 0.0
    for i in range(count):
        if not np.isfinite(best[i]):
            continue
        out = direct[0, order[i]]
        for j in range(i, count):
            if j > i:
                out += direct[order[j - 1], order[j]]
            out += reading_s
            if out >= NEVER or (j > i and out > limit_s):
                break
            closed = out + direct[order[j], 0]
            if closed >= NEVER or (j > i and closed > limit_s):
                continue
            if best[i] + closed + reading_s < best[j + 1]:
                best[j + 1], cut[j + 1] = best[i] + closed + reading_s, i
    if not np.isfinite(best[count]):
        return None
    out, j = [], count
    while j > 0:  # follow the cuts from the end
        out.append(list(order[int(cut[j]) : j]))
        j = int(cut[j])
    return out[::-1]
