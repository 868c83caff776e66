"""Blocks of a document: how rich prints them, and what a page makes of them."""

import io

from rich.console import Console

from hilcal.present.document import Block, Table, Words, captioned, heading, note, pairs, table


def printed(block: Block, *, color: bool = False) -> str:
    stream = io.StringIO()
    Console(file=stream, width=60, force_terminal=color).print(block, markup=False)
    return stream.getvalue()


def captions(*blocks: Block, caption: str = "") -> list[str]:
    return [b.caption for b in captioned(blocks, caption) if isinstance(b, Table)]


def test_a_caption_is_its_own_or_the_heading_above_or_what_is_given() -> None:
    plain = table("effect", "share")
    assert captions(heading("Suspects"), plain) == ["Suspects"]
    assert captions(heading("Suspects"), table("a", caption="Its own")) == ["Its own"]
    assert captions(heading("Nothing has changed."), plain) == ["effect"]  # a sentence stays
    assert captions(plain, plain, caption="Errors") == ["Errors", "Errors: effect"]


def test_a_page_has_a_paragraph_for_each_line() -> None:
    found = captioned(["first\n  second\n", "", note("small\n")])
    assert found == (Words("first"), Words("second"), Words("small", "note"))


def test_the_stressed_part_of_words_has_their_tone() -> None:
    shown = printed(Words("Verdict: adequate.\nNoise.", "good", "adequate"), color=True)
    assert shown.startswith("Verdict: \x1b[1;32madequate\x1b[0m.")
    assert printed(Words("told", indent=4)).startswith("    told")


def test_pairs_stand_in_two_columns_without_heads() -> None:
    assert printed(pairs([("poses", "8"), ("", "and the reference")])).split("\n")[:2] == [
        "  poses  8                ".rstrip().ljust(len("         and the reference")),
        "         and the reference",
    ]


def test_a_rule_parts_groups_of_rows() -> None:
    made = table("a", "b", rows=[("row 0", "0")])
    made.rule()
    made.add("row 1", "1")
    lines = [line.strip() for line in printed(made).split("\n")]
    assert lines[lines.index("row 0   0") + 1 :][:2] == ["", "row 1   1"]
