"""Parts of a computation on several processors: the order of the items, the same bits."""

import threading
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


def test_a_thread_computes_its_own_items_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    processors(monkeypatch, 2)

    def inner(item: int) -> set[int]:
        return set(threads.in_threads(lambda _: threading.get_ident(), range(3)))

    for own in threads.in_threads(inner, range(4)):
        assert len(own) == 1


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_reaches_the_caller(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    processors(monkeypatch, count)

    def fails() -> None:
        raise ValueError("here")

    with pytest.raises(ValueError, match="here"):
        threads.in_threads(lambda _: fails(), range(3))
    with pytest.raises(ValueError, match="here"), threads.beside(fails):
        pass


@pytest.mark.parametrize("count", [1, 2])
def test_what_is_beside_a_block_is_done_after_it(
    monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    processors(monkeypatch, count)
    done: list[str] = []
    with threads.beside(lambda: done.append("beside")):
        done.append("block")
    assert sorted(done) == ["beside", "block"]


def test_many_rows_are_worked_off_in_this_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    processors(monkeypatch, 2)
    own = threading.get_ident()
    found = threads.in_threads(lambda _: threading.get_ident(), range(3), threads.MANY + 1)
    assert set(found) == {own}
    done: list[int] = []
    with threads.beside(lambda: done.append(threading.get_ident()), threads.MANY + 1):
        assert not done
    assert done == [own]


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


def test_nothing_is_computed_ahead_where_many_compute(monkeypatch: pytest.MonkeyPatch) -> None:
    processors(monkeypatch, 2)
    done: list[int] = []

    def part(number: int) -> int:
        with threads.later() as ahead:
            ahead(lambda: done.append(number), 1)
        return number

    assert threads.in_threads(part, range(4)) == [0, 1, 2, 3]
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
