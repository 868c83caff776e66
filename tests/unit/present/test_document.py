"""Blocks of a document: how rich prints them, at any width, and what a page makes of them."""

from hypothesis import given
from hypothesis import strategies as st

from hilcal.present.document import (
    Table,
    Words,
    captioned,
    heading,
    note,
    pairs,
    shared_widths,
    table,
)

WORD = st.text("abcdefghij_", min_size=1, max_size=26)
WORDS = st.lists(WORD, min_size=1, max_size=6).map(" ".join)
NUMBER = st.floats(-1e4, 1e4).map(lambda x: f"{x:.3g} µm")
ROW = st.tuples(WORD, WORDS, NUMBER, NUMBER, WORDS)


def captions(*blocks, caption=""):
    return [b.caption for b in captioned(blocks, caption) if isinstance(b, Table)]


def test_a_caption_is_its_own_or_the_heading_above_or_what_is_given():
    plain = table("effect", "share")
    assert captions(heading("Suspects"), plain) == ["Suspects"]
    assert captions(heading("Suspects"), table("a", caption="Its own")) == ["Its own"]
    assert captions(heading("Nothing has changed."), plain) == ["effect"]  # a sentence stays
    assert captions(plain, plain, caption="Errors") == ["Errors", "Errors: effect"]


def test_a_page_has_a_paragraph_for_each_line():
    paragraphs = captioned(["first\n  second\n", "", note("small\n")])
    assert paragraphs == (Words("first"), Words("second"), Words("small", "note"))
    code = Words("[ordinary]\ncreep = 0.1", "code")
    assert captioned([code]) == (code,)


def test_the_stressed_part_of_words_has_their_tone(printed):
    shown = printed(Words("Verdict: adequate.\nNoise.", "good", "adequate"), color=True)
    assert shown.startswith("Verdict: \x1b[1;32madequate\x1b[0m.")
    assert printed(Words("told", indent=4)).startswith("    told")


def test_pairs_stand_in_two_columns_and_a_rule_parts_groups_of_rows(printed):
    of = printed(pairs([("poses", "8"), ("", "and the reference")]), width=60)
    lines = [line.rstrip() for line in of.split("\n")]
    assert lines[:2] == ["  poses  8", "         and the reference"]
    made = table("a", "b", rows=[("row 0", "0")])
    made.rule()
    made.add("row 1", "1")
    lines = [line.strip() for line in printed(made).split("\n")]
    assert lines[lines.index("row 0   0") + 1 :][:2] == ["", "row 1   1"]


@given(rows=st.lists(ROW, min_size=1, max_size=4), width=st.integers(30, 120))
def test_no_word_is_broken_and_no_line_is_too_long(printed, rows, width):
    heads = ("effect", "what it is", "poses\nfitted", "σ", "verdict")
    lines = printed(table(*heads, rows=rows, left=(0, 1, 4)), width=width).splitlines()
    assert max(map(len, lines)) <= width
    cells = {word for row in rows for cell in row for word in cell.split()}
    rule = {word for line in lines for word in line.split() if set(word) == {"─"}}
    shown = {word.rstrip(":") for line in lines for word in line.split()}
    assert cells <= shown
    assert shown - rule <= cells | {word for head in heads for word in head.split()}
    if rule:  # a table: a number and its unit stand on one line
        assert all(any(row[2] in line for line in lines) for row in rows)


def test_a_table_that_has_room_is_as_it_was_and_a_narrow_terminal_gets_lists(printed):
    wide = printed(table("effect", "share", rows=[("creep", "10 %")]), width=40).splitlines()
    assert wide == ["effect   share", "──────────────", "creep     10 %"]
    rows = [("1", "16.7 µm", "missing effect"), ("", "18.9 µm", "")]
    made = table("rev.", "poses\nfitted", "verdict", rows=rows, left=(0, 2))
    assert [line.rstrip() for line in printed(made, width=18).splitlines()] == [
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
def test_widths_share_the_room(columns, more):
    least, wanted = [a for a, _ in columns], [a + b for a, b in columns]
    widths = shared_widths(least, wanted, sum(least) + more)
    assert sum(widths) == min(sum(least) + more, sum(wanted))
    assert all(a <= w <= b for a, w, b in zip(least, widths, wanted, strict=True))
