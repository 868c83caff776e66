"""Laws as arithmetic: it has the value of the law's own amplitudes, or is left out."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Amplitude, Factor, composed, variables
from hilcal.discovery.curve import drawn_laws
from hilcal.discovery.law import Coefficient, Form, Law, LawPart, source_of_form
from hilcal.discovery.sites import sites
from hilcal.effects.catalogue import effects_of, installed
from hilcal.effects.check import example_cell, example_situation, example_states
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import fit
from hilcal.present.charts import curve_chart
from hilcal.present.document import description_of
from hilcal.present.story import Chapter, build_story
from hilcal.present.viewer import save
from studies.benchmark.formula import Formula
from tests.support.campaigns import NO_EFFECT, campaign
from tests.support.recordings import rows

CELL = example_cell()


def situation():
    states = example_states(CELL)
    n = len(states)
    more = {"time": 30.0 * np.arange(n), "air_temperature": 20.0 + np.linspace(-1.0, 2.0, n)}
    return example_situation(CELL, replace(states, **more))


S = situation()
NAMED = {v.symbol: v for v in variables(S)}
COLUMNS = {
    **{f"q{j + 1}": S.angle[:, j] for j in range(6)},
    **{f"tau{j + 1}": S.torque[:, j] for j in range(6)},
    "force": np.linalg.norm(S.states.wrench[:, :3], axis=1),
    "time": S.states.time,
    "air": S.states.air_temperature,
}


def site(symbol):
    return next(s for s in sites(CELL.arm.n) if s.symbol == symbol)


def law(*parts):
    """A law with a coefficient of each part."""
    form = Form(tuple(LawPart(site(at), a, k) for k, (at, _, a) in enumerate(parts)))
    numbers = tuple(Coefficient("abc"[k], value, 0.0, "1") for k, (_, value, _) in enumerate(parts))
    return Law("law_1", form, numbers, 0.0, 9.0, 0.9, 1.0, 1.0, (), ())


def of(symbol, shape=shapes.LINEAR, *numbers):
    return Amplitude((Factor(NAMED[symbol], shape, numbers),))


AIR = next(symbol for symbol in NAMED if symbol.startswith("(T_air"))
SUM = "(q_2 + q_3 + q_4)"
WAVE = Amplitude((Factor(NAMED["q_4"], shapes.COS, (2.0,)), Factor(NAMED["τ_3"], shapes.LINEAR)))
BEND = Amplitude((Factor(composed(((1.0, of("q_1")), (-0.5, of("q_5")))), shapes.ABOVE, (0.2,)),))


AMPLITUDES = (
    of("q_3", shapes.SIN, 3.0), of(SUM, shapes.COS, 1.0), of("(q_1 - q_2)", shapes.COS, 1.0),
    of("τ_2", shapes.THRESHOLD, 4.0), of("|f|", shapes.ABOVE, 10.0), of(AIR), WAVE, BEND,
    of("t", shapes.RELAXATION, 600.0), Amplitude(()),
)  # fmt: skip


@pytest.mark.parametrize("amplitude", AMPLITUDES, ids=lambda a: a.text() or "constant")
def test_an_expression_has_the_value_of_the_law(amplitude):
    text = law(("dq_3", 2e-4, amplitude)).expressions["dq_3"]
    value = Formula.parse(text, COLUMNS).value(COLUMNS)
    np.testing.assert_allclose(value + 0.0 * S.angle[:, 0], 2e-4 * amplitude.values(S), rtol=1e-12)


def test_each_site_has_the_sum_of_its_terms():
    found = law(
        ("dq_3", 2e-4, of("q_3")), ("base_z", 1e-3, of("t")), ("dq_3", -1e-4, of("τ_1"))
    ).expressions
    assert found == {"dq_3": "0.0002*((q3)) + -0.0001*((tau1))", "base_z": "0.001*((time - 0.0))"}


@pytest.mark.parametrize("symbol", ["f_x", "ρ", "z", "mF_x", "gF_z"])
def test_a_site_whose_law_depends_on_what_has_no_name_is_left_out(symbol):
    both = law(("dq_1", 1e-4, of("q_2")), ("dq_2", 1e-4, of(symbol)))
    assert list(both.expressions) == ["dq_1"]


Q5 = Factor(NAMED["q_5"], shapes.COS, (1.0,))
TWISTS = Amplitude((Q5, Factor(NAMED["τ_3"], shapes.LINEAR)))
PRODUCT = Form((LawPart(site("dq_3"), TWISTS, 0),))
DRAWN = Form((LawPart(site("dq_3"), of("q_3", shapes.COS, 96.0), 0),))


@cache
def fitted(form):
    """A fit with a law that is not there, to readings of 12 poses."""
    found = campaign(NO_EFFECT, "deflection", poses=12)
    source = source_of_form(form, "twisted").encode()
    file = effects_of(source, Path("twisted.py"))
    known = replace(installed().with_effects(*file.effects), files=(file,))
    names = ("base_frame", "joint_compliance", "twisted")
    model = with_effects(found.cell, found.readings, "deflection", names, {}, known)
    return fit(model, found.readings, "deflection")


@pytest.mark.parametrize(
    ("form", "of", "over"),
    [(PRODUCT, "dq_3/τ_3", "q_5"), (DRAWN, "dq_3", "q_3 within a period of 2π/96")],
)
def test_a_law_is_drawn_over_what_its_formula_names(form, of, over):
    made = fitted(form)
    (found,) = drawn_laws(made)
    assert (found.name, found.formula, found.acts_on) == ("twisted", form.text(), ("joint 3",))
    (c,) = found.curves
    assert (c.of, c.quantity) == (of, over)
    a = made.theta[-1]
    truth = a * np.cos(c.x if "q_5" in over else 96 * c.x)
    off = (c.y - truth) / c.std  # the residual of each reading, in the noise of the site's motion
    assert 0.5 < float(np.sqrt(np.mean(off**2))) < 1.5
    inside = np.interp(c.x, *c.line)
    assert np.abs(inside - truth).max() < 0.1 * abs(a)


def test_a_law_is_seen_on_the_page_and_in_the_viewer(tmp_path):
    made = fitted(PRODUCT)
    before = replace(made.model, effects=made.model.effects[:-1])
    chapters = [
        Chapter(1, None, fit(before, made.readings, made.mode), None),
        Chapter(2, "twisted", made, None),
    ]
    story = build_story(chapters)
    assert story.revisions[0].laws == ()
    (one,) = story.revisions[1].laws
    assert one.x_label == "q_5 [°]"
    assert one.y_label == "dq_3/τ_3 of joint 3 [µrad/(N·m)]"
    assert dict(one.facts)["coefficients"].startswith("a = ")
    assert "dq_3 = a·cos(q_5)·τ_3" in description_of(curve_chart(one))
    save(story, tmp_path / "x.rrd")
    law = rows(tmp_path / "x.rrd", "/law/law", "BarChart:values", "revision")
    assert set(law) == {2}
