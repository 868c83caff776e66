"""Tables that break no word, at any width."""

import io

from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from hilcal.present.document import Table, shared, table

WORD = st.text("abcdefghij_", min_size=1, max_size=26)
WORDS = st.lists(WORD, min_size=1, max_size=6).map(" ".join)
NUMBER = st.floats(-1e4, 1e4).map(lambda x: f"{x:.3g} µm")


def rendered(made: Table, width: int) -> list[str]:
    stream = io.StringIO()
    Console(file=stream, width=width).print(made)
    return stream.getvalue().splitlines()


@given(
    rows=st.lists(st.tuples(WORD, WORDS, NUMBER, NUMBER, WORDS), min_size=1, max_size=4),
    width=st.integers(30, 120),
)
def test_no_word_is_broken_and_no_line_is_too_long(rows: list[tuple[str, ...]], width: int) -> None:
    made = table("effect", "what it is", "poses\nfitted", "σ", "verdict", left=(0, 1, 4))
    for row in rows:
        made.add(*row)
    lines = rendered(made, width)
    assert max(map(len, lines)) <= width
    cells = {word for row in rows for cell in row for word in cell.split()}
    heads = {"effect", "what", "it", "is", "poses", "fitted", "σ", "verdict"}
    rule = {word for line in lines for word in line.split() if set(word) == {"─"}}
    shown = {word.rstrip(":") for line in lines for word in line.split()}
    assert cells <= shown
    assert shown - rule <= cells | heads
    if rule:  # a table: a number and its unit stand on one line
        assert all(any(row[2] in line for line in lines) for row in rows)


def test_a_table_that_has_room_is_as_it_was() -> None:
    made = table("effect", "share", left=(0,))
    made.add("creep", "10 %")
    assert rendered(made, 40) == [
        "effect   share",
        "──────────────",
        "creep     10 %",
    ]


def test_a_narrow_terminal_gets_lists() -> None:
    made = table("rev.", "poses\nfitted", "verdict", left=(0, 2))
    made.add("1", "16.7 µm", "missing effect")
    made.add("", "18.9 µm", "")
    assert [line.rstrip() for line in rendered(made, 18)] == [
        "rev. 1",
        "  poses fitted:",
        "  16.7 µm",
        "  verdict: missing",
        "  effect",
        "poses fitted 18.9",
        "µm",
    ]


@given(
    st.lists(st.tuples(st.integers(1, 20), st.integers(0, 20)), min_size=1, max_size=6),
    st.integers(0, 40),
)
def test_widths_share_the_room(columns: list[tuple[int, int]], more: int) -> None:
    least = [a for a, _ in columns]
    wanted = [a + b for a, b in columns]
    widths = shared(least, wanted, sum(least) + more)
    assert sum(widths) == min(sum(least) + more, sum(wanted))
    assert all(a <= w <= b for a, w, b in zip(least, widths, wanted, strict=True))
