"""What laws are made of, which are tried, and how they are written and drawn."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hilcal.discovery import grammar as products
from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Amplitude, Composed, Factor, composed, variables
from hilcal.discovery.curve import drawn_laws
from hilcal.discovery.grammar import grammar
from hilcal.discovery.law import Coefficient, Form, Law, LawPart, effect_class, source_of_form
from hilcal.discovery.refit import refine, refit_exactly, rss_with_law
from hilcal.discovery.screen import screen
from hilcal.discovery.sites import sites
from hilcal.effects.catalogue import effects_of, installed
from hilcal.effects.check import check_effect, example_cell, example_situation, example_states
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import linearise
from hilcal.present.charts import curve_chart
from hilcal.present.document import description_of
from hilcal.present.story import Chapter, build_story
from hilcal.present.viewer import save
from hilcal.readings.whitening import whitening
from studies.benchmark.formula import Formula
from studies.law_scene import scene
from tests.support.campaigns import NO_EFFECT
from tests.support.campaigns import campaign as campaign_written
from tests.support.fit_cases import fitted_model
from tests.support.recordings import rows
from tests.support.rehearsed import rehearsed


def example():
    cell = example_cell()
    return example_situation(cell, example_states(cell))


def named(s):
    return {v.symbol: v for v in variables(s)}


def product(*factors):
    return Amplitude(factors)


def waved(v):
    return Factor(v, shapes.COS, (1.0,))


def accept(*parts):
    """A law is an effect that keeps to the protocol, with its derivatives."""
    check_effect(effect_class(source_of_form(Form(parts), "tried"), "tried"))


FUNCTIONS = (
    (shapes.LINEAR, ()), (shapes.ODD, (2.0, 0.0)), (shapes.ODD, (0.5, 0.3)),
    (shapes.EVEN, (1.0, 0.0)), (shapes.EVEN, (1.7, 0.3)), (shapes.EVEN, (0.6, 0.3)),
    (shapes.THRESHOLD, (5.0,)), (shapes.PLUS, ()), (shapes.MINUS, ()),
    (shapes.SATURATION, (20.0,)), (shapes.SIN, (0.05,)), (shapes.COS, (0.05,)),
)  # fmt: skip


def test_every_function_is_an_effect_with_its_derivative():
    known = {v.kind: v for v in variables(example())}
    places = sites(6)
    for k, (shape, numbers) in enumerate(FUNCTIONS):
        factor, side = Factor(known["torque"], shape, numbers), Factor(known["side"], shapes.LINEAR)
        other = Factor(known["angle"], shapes.COS, (2.0,)) if k % 2 else side
        site = places[(5 * k) % 18]
        site = site if site.takes(True) else places[0]
        accept(LawPart(site, product(factor, other), 0), LawPart(places[1], product(factor), 1))


ONE_SIDED = (
    (shapes.PLUS, ()), (shapes.MINUS, ()), (shapes.ABOVE, (0.0,)), (shapes.SATURATION, (0.05,)),
    (shapes.ABOVE_POWER, (0.0, 1.5)), (shapes.BELOW_POWER, (0.0, 1.2)),
)  # fmt: skip


@pytest.mark.parametrize("joint", [1, 3])
@pytest.mark.parametrize(("shape", "numbers"), ONE_SIDED)
def test_a_one_sided_law_is_an_effect_also_where_nothing_hangs(shape, numbers, joint):
    """Joint 1 of an unloaded arm has no torque: the states are at the bend itself."""
    torque = named(example())[f"τ_{joint}"]
    accept(LawPart(sites(6)[joint - 1], product(Factor(torque, shape, numbers)), 0))


def test_fine_waves_are_tried_up_to_the_number_of_poses_and_in_no_product(monkeypatch):
    monkeypatch.setattr(products, "MOST_COMPLEXITY", 3)
    s = example()
    words = grammar([v for v in variables(s) if v.kind == "angle"][:2], s, 14)
    fine = [a for a in words.amplitudes if any(f.shape.cost == 3 for f in a.factors)]
    assert {a.factors[0].numbers[0] for a in fine} == set(range(5, 15))
    assert all(len(a.factors) == 1 for a in fine)
    place = words.place(fine[0])
    assert place is not None
    partner = words.amplitudes[words.partner[place]].factors[0]
    assert (partner.shape.name, partner.numbers) == ("sin", fine[0].factors[0].numbers)


SIGMA = 6.0
OF_A_SUM = (
    (shapes.ABOVE, (3.0,)), (shapes.BELOW, (-2.0,)), (shapes.ABOVE_POWER, (-3.0, 1.6)),
    (shapes.BELOW_POWER, (4.0, 2.3)), (shapes.THRESHOLD, (2.0,)), (shapes.SATURATION, (9.0,)),
    (shapes.STEP, (-1.0, 7.0)),
)  # fmt: skip


@pytest.mark.parametrize(("shape", "numbers"), OF_A_SUM)
def test_a_function_of_a_sum_of_products_is_an_effect_with_its_derivative(shape, numbers):
    known = named(example())
    u = composed(
        (
            (1.0, product(Factor(known["τ_2"], shapes.LINEAR), waved(known["q_5"]))),
            (-0.7, product(Factor(known["τ_3"], shapes.LINEAR))),
            (0.03, product(Factor(known["m4_y"], shapes.LINEAR))),
        )
    )
    bent = Factor(u, shape, numbers)
    places = [p for p in sites(6) if p.takes(True)]
    other = LawPart(places[9], product(bent, waved(known["q_4"])), 1)
    accept(LawPart(places[1], product(bent), 0), other)


def test_a_bend_with_a_fractional_power_has_its_unit_and_its_formula():
    known = named(example())
    u = composed(((1.0, product(Factor(known["τ_2"], shapes.LINEAR), waved(known["q_5"]))),))
    form = Form((LawPart(sites(6)[2], product(Factor(u, shapes.ABOVE_POWER, (5.0, 1.5))), 0),))
    assert form.text() == "dq_3 = a·max(τ_2·cos(q_5) - 5, 0)^1.5"
    assert form.latex() == r"\delta q_3 = a\,\max(\tau_2\,\cos(q_5) - 5, 0)^{1.5}"
    assert form.unit(0) == "rad/((N·m)^1.5)"
    assert form.variables == ("joint 2 torque", "joint 5 angle")
    assert form.elastic


def test_a_sum_is_written_with_its_weights_and_reads_what_its_products_read():
    s = example()
    known = named(s)
    u = composed(((1.0, product(waved(known["q_5"]))), (-0.25, product(waved(known["q_6"])))))
    assert u.symbol == "(cos(q_5) - 0.25·cos(q_6))"
    assert u.recorded == (known["q_5"], known["q_6"])
    wanted = np.cos(s.angle[:, 4]) - 0.25 * np.cos(s.angle[:, 5])
    assert np.allclose(u.read(s), wanted, rtol=1e-12)
    assert np.allclose(eval(u.code, {"s": s, "np": np}), wanted, rtol=1e-12)


@cache
def campaign():
    """Deflections with a joint that gives way where two quantities together pass a level."""
    of = rehearsed(30, seed=11)
    cell, readings, states = of.cell, of.readings, of.readings.states
    at = scene(of.world, states)
    level = at.torque[:, 1] * np.cos(states.q[:, 4])
    moved = at.of_joint(3, np.maximum(level - np.quantile(level, 0.6), 0.0))
    w = whitening(readings, "deflection")
    moved = moved * (SIGMA / np.sqrt(np.mean(w.whiten(w.raw(moved)) ** 2)))
    readings = replace(readings, value=readings.value + moved)
    return fitted_model(cell, readings, "deflection"), moved


@pytest.mark.parametrize("exponent", [60.0, 200.0, 1e4])
def test_a_law_of_any_exponent_has_a_sum_of_squares(exponent):
    """Powers of 1e200, which a search of exponents may try, overflow in their squares."""
    at = screen(linearise(campaign()[0]))
    s = at.linear.fit.solution.prediction.situation
    torque = {v.symbol: v for v in at.grammar.known}["τ_2"]
    raised = product(Factor(torque, shapes.POWER, (exponent,)))
    form = Form((LawPart(sites(6)[2], raised, 0),))
    assert rss_with_law(at, form, s) > 0.5 * at.linear.test_noise[0]


def test_levels_weights_and_exponents_are_refined_together():
    at = screen(linearise(campaign()[0]))
    s = at.linear.fit.solution.prediction.situation
    known = {v.symbol: v for v in at.grammar.known}
    lever = product(Factor(known["τ_2"], shapes.LINEAR), waved(known["q_5"]))
    other = product(Factor(known["τ_3"], shapes.LINEAR))
    u = composed(((1.0, lever), (0.4, other)))
    level = float(np.quantile(u.read(s), 0.5))
    begin = Form((LawPart(sites(6)[2], product(Factor(u, shapes.ABOVE, (level,))), 0),))
    after = refine(at, begin)
    assert rss_with_law(at, after, s) < 0.5 * rss_with_law(at, begin, s)
    (bent,) = after.parts[0].amplitude.factors
    assert isinstance(bent.variable, Composed)
    ((_, one), (weight, two)) = bent.variable.terms
    assert (one, two) == (lever, other)
    assert abs(weight) < 0.1
    assert bent.numbers != (level,)
    refit_exactly(at, after, "refined")


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
    expressions = law(
        ("dq_3", 2e-4, of("q_3")), ("base_z", 1e-3, of("t")), ("dq_3", -1e-4, of("τ_1"))
    ).expressions
    assert expressions == {
        "dq_3": "0.0002*((q3)) + -0.0001*((tau1))",
        "base_z": "0.001*((time - 0.0))",
    }


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
    c = campaign_written(NO_EFFECT, "deflection", poses=12)
    source = source_of_form(form, "twisted").encode()
    file = effects_of(source, Path("twisted.py"))
    known = replace(installed().with_effects(*file.effects), files=(file,))
    names = ("base_frame", "joint_compliance", "twisted")
    model = with_effects(c.cell, c.readings, "deflection", names, {}, known)
    return fit(model, c.readings, "deflection")


@pytest.mark.parametrize(
    ("form", "of", "over"),
    [(PRODUCT, "dq_3/τ_3", "q_5"), (DRAWN, "dq_3", "q_3 within a period of 2π/96")],
)
def test_a_law_is_drawn_over_what_its_formula_names(form, of, over):
    made = fitted(form)
    (drawn_law,) = drawn_laws(made)
    assert (drawn_law.name, drawn_law.formula, drawn_law.acts_on) == (
        "twisted",
        form.text(),
        ("joint 3",),
    )
    (c,) = drawn_law.curves
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
