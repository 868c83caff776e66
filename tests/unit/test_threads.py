"""Parts of a computation on several processors: the order of the items, the same bits."""

import pickle
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pytest

from hilcal import threads
from hilcal.diagnose.verdict import diagnose
from hilcal.identify.baseline import baseline
from hilcal.identify.fit import fit
from hilcal.model import Model
from hilcal.regression.products import ROWS, cross, gram, keep_columns, times
from tests.support.campaigns import campaign


def processors(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr(threads, "cores", lambda: count)


def test_results_are_in_the_order_of_the_items(monkeypatch: pytest.MonkeyPatch) -> None:
    processors(monkeypatch, 2)
    first = threading.Event()

    def after(item: int) -> int:
        if item == 0:
            assert first.wait(10)  # until the second has been computed
        first.set()
        return item * item

    assert threads.in_threads(after, range(5)) == [0, 1, 4, 9, 16]


class Counted:
    """How many threads are in a block at once, at most."""

    def __init__(self) -> None:
        self.most = self._now = 0
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        with self._lock:
            self._now += 1
            self.most = max(self.most, self._now)

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._now -= 1


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_more_threads_compute_than_there_are_processors(
    monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    processors(monkeypatch, count)
    counted = Counted()

    def compute(item: int) -> int:
        with counted:
            time.sleep(0.001)
        return item

    def outer(item: int) -> int:
        return sum(threads.in_threads(compute, range(item, item + 4)))

    with threads.later() as ahead:
        for _ in range(3):
            ahead(lambda: compute(0), 1)
        assert threads.in_threads(outer, range(6)) == [4 * k + 6 for k in range(6)]
    # For a moment also those that go on after waiting; without a limit it would be dozens.
    assert counted.most <= (1 if count == 1 else 2 * count)


def test_who_waits_leaves_its_processor_to_what_it_waits_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    processors(monkeypatch, 2)
    used: set[int] = set()

    def inner(_: int) -> None:
        used.add(threading.get_ident())
        time.sleep(0.001)

    def outer(item: int) -> None:
        if item == 1:  # the other thread has no more to do than the first item
            threads.in_threads(inner, range(100))

    threads.in_threads(outer, range(2))
    assert len(used) == 2


def test_a_worker_of_many_computes_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    processors(monkeypatch, 2)

    def worker() -> set[int]:
        threads.one_thread()
        found = set(threads.in_threads(lambda _: threading.get_ident(), range(4)))
        with threads.later() as ahead:
            ahead(lambda: found.add(0), 1)
        return found

    with ThreadPoolExecutor(1) as pool:
        assert len(pool.submit(worker).result()) == 1


def test_the_first_of_several_errors_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    processors(monkeypatch, 2)
    second = threading.Event()

    def fails(item: int) -> None:
        if item == 0:
            assert second.wait(10)
        second.set()
        raise ValueError(str(item))

    with pytest.raises(ValueError, match="0"):
        threads.in_threads(fails, range(2))


class Once:
    """A property, and how often it was computed."""

    def __init__(self) -> None:
        self.count = 0
        self.go = threading.Event()

    @threads.once
    def value(self) -> int:
        assert self.go.wait(10)
        self.count += 1
        return 7


def test_a_property_is_computed_once_and_others_wait_for_it() -> None:
    of, other = Once(), Once()
    with ThreadPoolExecutor(3) as pool:
        found = [pool.submit(lambda: of.value) for _ in range(3)]
        other.go.set()
        assert other.value == 7  # another instance waits for nobody
        assert not of.count
        of.go.set()
        assert [f.result() for f in found] == [7, 7, 7]
    assert of.count == 1
    assert pickle.loads(pickle.dumps(Point(2))).square == 4


@dataclass(frozen=True, eq=False)
class Point:
    x: int

    @threads.once
    def square(self) -> int:
        if self.x < 0:
            raise ValueError("negative")
        return self.x**2


def test_a_property_that_fails_is_not_kept() -> None:
    of = Point(-1)
    for _ in range(2):
        with pytest.raises(ValueError, match="negative"):
            _ = of.square


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_reaches_the_caller(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    processors(monkeypatch, count)

    def fails() -> None:
        raise ValueError("here")

    with pytest.raises(ValueError, match="here"):
        threads.in_threads(lambda _: fails(), range(3))


def test_many_rows_are_worked_off_in_this_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    processors(monkeypatch, 2)
    own = threading.get_ident()
    found = threads.in_threads(lambda _: threading.get_ident(), range(3), threads.MANY + 1)
    assert set(found) == {own}


def test_what_is_asked_for_later_is_computed_beside_the_block_where_it_may_be(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    done: list[str] = []
    for count in (1, 2):
        processors(monkeypatch, count)
        first = threading.Event()

        def compute(name: str = f"on {count}", first: threading.Event = first) -> None:
            done.append(name)
            first.set()

        with threads.later() as ahead:
            ahead(compute, threads.MANY + 1)
            assert not first.is_set()
            ahead(compute, threads.MANY)
            assert count == 1 or first.wait(10)
    assert done == ["on 2"]


def test_nothing_is_computed_ahead_while_no_processor_is_free(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    processors(monkeypatch, 2)
    done: list[int] = []
    begun, ended = threading.Event(), threading.Event()

    def part(number: int) -> int:
        if number == 0:  # has the other processor until the block of the other part has ended
            begun.set()
            assert ended.wait(10)
            return number
        assert begun.wait(10)
        with threads.later() as ahead:
            ahead(lambda: done.append(number), 1)
            time.sleep(0.01)
        ended.set()
        return number

    assert threads.in_threads(part, range(2)) == [0, 1]
    assert done == []


@pytest.mark.parametrize("order", ["C", "F"])
def test_columns_are_kept_in_their_own_memory(order: Literal["C", "F"]) -> None:
    a = np.array(np.random.default_rng(2).normal(size=(2 * ROWS + 7, 5)), order=order)
    kept = np.array([True, False, True, True, False])
    wanted = a[:, kept].copy()
    np.testing.assert_array_equal(keep_columns(a, kept), wanted)


@pytest.mark.parametrize("shape", [(40, 3), (701, 401)])
def test_products_by_halves(monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=shape), rng.normal(size=(shape[0], shape[1] + 1))
    found = []
    for count in (1, 2, 3):
        processors(monkeypatch, count)
        found.append((gram(a), cross(a, b), times(a, b[: shape[1]])))
    for whole, of_both, product in found:
        np.testing.assert_allclose(product, a @ b[: shape[1]], atol=1e-10)
        assert np.array_equal(product, found[0][2])
        np.testing.assert_allclose(whole, a.T @ a, atol=1e-10)
        np.testing.assert_allclose(of_both, a.T @ b, atol=1e-10)
        assert np.array_equal(whole, found[0][0])
        assert np.array_equal(of_both, found[0][1])


def test_a_judgement_has_the_same_bits_on_one_processor_and_on_two(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    c = campaign("transmission_error", "absolute", poses=25, m=6, strength=2.0)
    model: Model = baseline(c.cell, c.readings, "absolute")
    model = model + model.catalogue.make("transmission_error", c.cell, c.readings.states, m=6)
    found = []
    for count in (1, 2):
        processors(monkeypatch, count)
        of = fit(model, c.readings, "absolute")
        d = diagnose(of)
        scores = [(s.effect, s.score.p_value, s.holdout_share) for s in d.suspects]
        found.append((of.theta.tobytes(), of.left_out.tobytes(), scores, d.misfit_breakdown))
    assert found[0] == found[1]
