"""Formulas of docstrings as MathML: what is one, what is not, and what it looks like."""

import re

import pytest

from tests.support.hooks import hook

LAW = hook("law")


def seen(markup: str) -> str:
    """What a reader sees: formulas in braces."""
    text = re.sub(r"<mspace[^>]*></mspace>", " ", markup)
    text = text.replace("<span><math>", "{").replace("</math></span>", "}")
    return re.sub(r"</?m[a-z]*[^>]*>", "", text)


@pytest.mark.parametrize(
    ("written", "shown"),
    [
        ("dq_j = c_j τ_j: each joint gives way", "{dqj = cj τj}: each joint gives way"),
        ("the zero of a joint is off [rad]", "the zero of a joint is off [rad]"),
        ("has s_j < 0 (s_j < 0: stiffens)", "has {sj &lt; 0} ({sj &lt; 0}: stiffens)"),
        ("by the moment (R_k δ_k) × g there", "by the moment {(Rk δk) × g} there"),
        ("see `joint_coupling`, i = j", "see `joint_coupling`, {i = j}"),
        ("e.g. of a slide, or an arm's own", "e.g. of a slide, or an arm's own"),
    ],
)
def test_a_sentence_keeps_its_words_and_its_formulas_are_mathematics(
    written: str, shown: str
) -> None:
    assert seen(LAW.inline(written)) == shown


def test_subscripts_and_powers_have_their_places() -> None:
    made = LAW.inline("s_j τ_j³")
    assert "<msub><mrow><mi>s</mi></mrow><mrow><mi>j</mi></mrow></msub>" in made
    assert "<msubsup>" in made
    assert "<mn>3</mn></msubsup>" in made


def test_words_of_a_displayed_formula_stay_upright() -> None:
    made = LAW.display("    displacement = bend (L³/3 F⊥)\n    z = a_1 s     x = b_1 s")
    assert made.count('<p class="law">') == 3
    assert "<mtext>displacement</mtext>" in made
    assert "<mtext>bend</mtext>" in made
