"""What `next` says of pairs: one number for each, and nothing that contradicts it."""

import pytest

from hilcal.design.discriminated_pairs import not_ruled_out
from hilcal.design.next import PairPower
from hilcal.present.plan import power_rows, powers_summary

A, B = "base_compliance", "link_compliance"
SURE, WEAK = PairPower(A, B, 0.2, 0.9999, False), PairPower(B, A, 0.1, 0.45, False)
NEVER = PairPower(B, A, 0.02, 0.05, True)


@pytest.mark.parametrize(
    ("powers", "words"),
    [
        (
            (SURE, SURE),
            "separate the suspects: whichever is there, each of the others is ruled out",
        ),
        ((SURE, WEAK), f"the weakest pair is {B}, where it is there, and {A}, which they rule out"),
        ((SURE, NEVER), "separate what can be separated in this cell: each of these pairs"),
        ((NEVER, NEVER), "rule out none of the suspects"),
    ],
)
def test_the_sentence_follows_from_the_table(powers: tuple[PairPower, ...], words: str) -> None:
    said = powers_summary(powers, 12, 40)
    assert said.startswith("40 readings at 12 poses")
    assert words in said
    assert "100 %" not in said
    assert ("more poses raise it" in said) == (WEAK in powers)


def test_no_chance_is_certain_and_none_is_given_where_nothing_would_do() -> None:
    assert list(power_rows((SURE, WEAK, NEVER))) == [
        (A, B, "20 %", "> 99 %"),
        (B, A, "10 %", "45 %"),
        (B, A, "2 %", "not in this cell"),
    ]
    assert not_ruled_out([(B, A)]) == (
        f"no measurement in this cell rules out {A} where {B} is there: 100 of the best readings "
        "would do so with a chance of less than 20 %"
    )
