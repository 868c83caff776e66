"""Products one of whose factors has a free zero, as (T − T0)·d: screened as pairs of columns."""

import numpy as np

from hilcal.discovery.amplitudes import Amplitude
from hilcal.discovery.problem import SearchProblem
from hilcal.discovery.screen import LawTerm, Screen
from hilcal.discovery.search import search
from tests.unit.discovery.test_discover import screened


def products(s: Screen, count: int) -> list[tuple[int, int]]:
    """Sites and products, of which the model explains neither these nor their factors alone."""
    words = s.grammar
    seen = s.square > 0
    out = []
    rng = np.random.default_rng(3)
    for f in rng.permutation(np.flatnonzero((words.less >= 0).all(axis=0))).tolist():
        one, two = words.less[:, f].tolist()
        places = np.flatnonzero(seen[:, f] & seen[:, one] & seen[:, two])
        if len(places):
            out.append((int(rng.choice(places)), f))
        if len(out) == count:
            return out
    raise AssertionError("too few products")


def test_a_product_knows_what_is_left_without_either_factor() -> None:
    words = screened().grammar
    for _, f in products(screened(), 20):
        first, second = words.at(f).factors
        without_first, without_second = words.less[:, f].tolist()
        assert words.at(without_first) == Amplitude((second,))
        assert words.at(without_second) == Amplitude((first,))
    single = words.amplitudes.index(Amplitude((words.singles[0],)))
    assert words.less[:, single].tolist() == [-1, -1]


def test_a_pair_is_found_of_which_neither_part_explains_anything_alone() -> None:
    """As where a temperature is far from its zero all the time: T d and d are nearly the same."""
    s = screened()
    place, f, less, direction = _nearly_alike(s)
    p = SearchProblem(s)
    noise = 0.3 * np.random.default_rng(5).standard_normal(len(p.residual))
    p.residual = p._thin_residual = 40.0 * direction + p.model.project_out(noise)
    p.rss = float(p.residual @ p.residual)
    alone = p.beside(()).score([LawTerm(((place, k),), 0.0) for k in (f, less)])
    assert all(c.score.gain < 0.05 * p.rss for c in alone)
    best = search(p, most=1)[0].terms[0]
    x = np.hstack([p.columns(best)])
    free = p.model.project_out(x)
    told = free @ np.linalg.lstsq(free, p.residual, rcond=None)[0]
    assert told @ told > 0.95 * p.rss
    assert {at for at, _ in best.parts} == {place}


def _nearly_alike(s: Screen) -> tuple[int, int, int, np.ndarray]:
    """A product of a site, a factor of it alone, and the unit direction between their columns."""
    for place, f in products(s, 1000):
        for less in s.grammar.less[:, f].tolist():
            free = s.linear.project_out(s.columns([(place, f), (place, less)]))
            unit = free / np.linalg.norm(free, axis=0)
            cosine = float(unit[:, 0] @ unit[:, 1])
            if 0.8 < abs(cosine) < 0.97 and s.alias[place] == place:
                between = unit[:, 0] - np.sign(cosine) * unit[:, 1]
                return place, f, less, between / np.linalg.norm(between)
    raise AssertionError("no such pair")
