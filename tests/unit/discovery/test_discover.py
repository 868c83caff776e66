"""Laws searched, none where nothing is hidden, and effects of the catalogue before them."""

import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import hilcal as hc
from hilcal.diagnosis.stepwise import add
from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Amplitude, Factor, variables
from hilcal.discovery.discovery import Discovery, LawSearch, discover, laws_json
from hilcal.discovery.known_effects import (
    Replacement,
    effects_replacing_law,
    known_effects,
    needed_beside_effect,
)
from hilcal.discovery.law import Form, LawPart, effect_class, source_of_form
from hilcal.discovery.problem import SearchProblem
from hilcal.discovery.refit import refit_exactly
from hilcal.discovery.screen import LawTerm, screen
from hilcal.discovery.search import LEAST_LOG_ODDS, Selection, search, sufficiently_better
from hilcal.discovery.sites import ORDINARY
from hilcal.effects.catalogue import installed
from hilcal.effects.check import check_effect
from hilcal.effects.protocol import EffectSpec
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit import fit, fit_again
from hilcal.identification.linearisation import effect_columns, linearise
from hilcal.present.diagnosis import discovery_report, no_law_sentence, refined_laws
from hilcal.refinement import Path, refine
from studies.unmodelled_laws import law_named, shift
from tests.support.fit_cases import fitted_model
from tests.support.rehearsed import rehearsed
from tests.support.rows import first

LAW = "compliance by another joint"


@cache
def campaign(law="", stated=1.0, seed=4):
    """Deflections of 14 poses under two weights, with a law that no effect describes."""
    of = rehearsed(14, seed)
    cell, readings, value = of.cell, of.readings, of.readings.value
    if law:
        drawn = law_named(law)
        value = value + shift(
            drawn, of.world, readings.states, 6.0, "deflection", of.pose, of.cycle
        )
    readings = replace(readings, value=value, covariance=stated**2 * readings.covariance)
    return fitted_model(cell, readings, "deflection")


@cache
def discovery():
    return discover(campaign(LAW), name="bent")


@pytest.mark.long
def test_a_law_outside_of_the_catalogue_is_found_with_its_site_and_variables():
    law = discovery().laws[0]
    assert discovery().reason == "law"
    assert law.formula == "dq_3 = a·cos(q_4)·τ_3"
    assert law.name == "bent"
    after = discovery().after
    assert after.model.names[-1] == "bent"
    assert law.acts_on == ("joint 3",)
    assert set(law.variables) == {"joint 4 angle", "joint 3 torque"}
    assert law.parameters[0].unit == "rad/(N·m)"
    assert law.p_value < 1e-6
    assert law.holdout_share > 0.8


@pytest.mark.long
def test_a_refinement_adds_the_law_and_its_file_gives_it_back(tmp_path, monkeypatch):
    before, laws = campaign(LAW), LawSearch(tmp_path, "bent")
    monkeypatch.setattr(
        sys.modules[LawSearch.__module__], "discover", lambda fit, say, name: discovery()
    )
    r = refine(before.model, before.readings, before.mode, laws=laws, background=False)
    assert r.steps[0].diagnosis.verdict == "unknown_effect"
    assert [s.added for s in r.steps] == [None, "bent"]
    assert r.verdict == "adequate"
    laws.write(r.names)
    again = installed().with_file(tmp_path / "bent.py")
    stored = r.fit.model.catalogue.file_of("bent")
    assert again.files[0].sha256 == stored.sha256
    states = before.readings.states
    model = before.model + again.make("bent", before.model.cell, states)
    original, same = (m.predict(states, r.fit.theta).observation for m in (r.fit.model, model))
    assert same.position == pytest.approx(original.position, abs=1e-12)
    printed = "\n".join(str(part) for part in refined_laws(laws))
    assert "dq_3 = a·cos(q_4)·τ_3" in printed
    assert str(tmp_path / "bent.py") in printed
    (document,) = laws_json(laws)["discover"]
    assert document["written"] == str(tmp_path / "bent.py")


def test_nothing_is_searched_where_the_model_is_adequate(tmp_path):
    before, laws = campaign(), LawSearch(tmp_path)
    assert refine(before.model, before.readings, before.mode, laws=laws).verdict == "adequate"
    assert laws.discoveries == []
    assert hc.refine(before.model, before.readings, discover=tmp_path).verdict == "adequate"
    assert [*tmp_path.iterdir()] == []
    with pytest.raises(InputError, match="no such folder"):
        hc.refine(before.model, before.readings, discover=tmp_path / "nowhere")


@pytest.mark.long
def test_a_law_is_searched_before_a_misfit_is_taken_for_noise(tmp_path, monkeypatch):
    """It may act where the diagnosis does not look, as along the axis of a joint."""
    monkeypatch.setattr(
        sys.modules[LawSearch.__module__],
        "discover",
        lambda fit, say, name: Discovery(fit, "unpredictable"),
    )
    before, laws = campaign(stated=0.5), LawSearch(tmp_path)
    r = refine(before.model, before.readings, before.mode, laws=laws)
    (first, *_), (searched, *_) = r.steps, laws.discoveries
    assert first.diagnosis.verdict == "noise_misjudged"
    assert searched.fit is first.fit


def test_a_law_takes_a_name_and_a_file_that_are_free(tmp_path, monkeypatch):
    (tmp_path / "found.py").write_text("mine", encoding="utf-8")
    asked = []

    def silent(fit, say, name):
        asked.append(name)
        return Discovery(fit, "no_law")

    monkeypatch.setattr(sys.modules[LawSearch.__module__], "discover", silent)
    laws = LawSearch(tmp_path)
    assert laws.propose(campaign(LAW), lambda text: None) is None
    laws.write(("found", "found_2"))
    assert asked == ["found_2"]
    assert [p.name for p in tmp_path.iterdir()] == ["found.py"]
    assert "no law of this size" in "".join(map(str, refined_laws(laws)))
    (tmp_path / "law_of_demo.py").touch()
    (tmp_path / "law_of_demo_2.py").touch()
    LawSearch(tmp_path, "law_of_demo", replacing=True)
    assert [p.name for p in tmp_path.iterdir()] == ["found.py"]


@cache
def searched():
    return search(SearchProblem(screen(linearise(campaign(LAW)))))


@pytest.mark.parametrize("stated", first(1, [0.5, 2.0]))
def test_noise_that_is_misjudged_is_no_law(stated):
    d = discover(campaign(stated=stated))
    assert d.laws == ()
    assert d.reason in ("adequate", "unpredictable", "catalogue", "no_law")
    assert no_law_sentence(d).startswith("no law")


def test_a_drift_of_readings_without_times_is_said_to_need_them(monkeypatch):
    of = campaign()
    timeless = replace(of.readings.states, time=None, load_time=None)
    value = of.readings.value.copy()
    value[:, 0] += 400e-6 * np.maximum(np.linspace(-1.0, 1.0, len(value)), 0.0)
    readings = replace(of.readings, states=timeless, value=value)
    before = fitted_model(of.model.cell, readings, "absolute")
    monkeypatch.setattr(sys.modules[Discovery.__module__], "search", lambda problem: [])
    d = discover(before)
    assert (d.reason, d.carried[0].variable) == ("no_law", "row order")
    assert "add their times" in no_law_sentence(d)
    assert "row order explains" in "".join(map(str, discovery_report(d)))
    assert d.to_dict()["carried_by"][0]["variable"] == "row order"


@cache
def screened():
    return screen(linearise(campaign(LAW)))


def test_screening_is_what_the_columns_themselves_give():
    s = screened()
    problem = SearchProblem(s)
    rng = np.random.default_rng(0)
    visible = np.argwhere(s.square > 0)
    for site, amplitude in rng.choice(visible, 40, replace=False).tolist():
        x = problem.columns(LawTerm(((site, amplitude),), 0.0))
        exact = float(s.linear.information(x)[0, 0])
        assert s.square[site, amplitude] == pytest.approx(exact, rel=2e-2)
        slope = float(x[:, 0] @ problem.residual)
        size = float(np.linalg.norm(x) * np.linalg.norm(problem.residual))
        assert problem.slope[site, amplitude] == pytest.approx(slope, abs=1e-4 * size)


def test_columns_of_the_written_effect_are_those_of_the_search():
    s, f = screened(), campaign(LAW)
    situation = f.solution.prediction.situation
    rng = np.random.default_rng(2)
    for site, amplitude in rng.choice(np.argwhere(s.square > 0), 6, replace=False).tolist():
        form = Form((LawPart(s.sites[site], s.grammar.amplitudes[amplitude], 0),))
        kind = effect_class(source_of_form(form, "tried"), "tried")
        effect = kind(f.model.cell, situation.states)
        columns = effect_columns(f, effect)
        assert columns.white / columns.scale == pytest.approx(
            form.columns(s, situation) / unit_motion(form),
            rel=1e-6,
            abs=1e-6 * np.ptp(columns.white),
        )


def unit_motion(form):
    return ORDINARY[form.parts[0].site.unit]


@pytest.mark.long
def test_the_curve_of_a_law_lies_where_the_readings_are():
    by_angle, by_torque = discovery().curves
    assert (by_angle.site, by_angle.quantity, by_angle.of) == ("joint 3", "q_4", "dq_3/τ_3")
    assert (by_torque.quantity, by_torque.unit) == ("τ_3", "rad")
    (a,) = discovery().laws[0].parameters
    x, law = by_angle.line
    assert law == pytest.approx(a.value * np.cos(x), rel=1e-9)
    for c in (by_angle, by_torque):
        x, y, std, count = c.binned
        off = (c.y - np.interp(c.x, *c.line)) / c.std
        assert np.sqrt(np.mean(off**2)) == pytest.approx(1.0, abs=3 / np.sqrt(2 * len(off)))
        assert count.sum() == len(c.x)
        assert np.all(np.abs(y - np.interp(x, *c.line)) < 5 * std)
    printed = "".join(str(part) for part in discovery_report(discovery()))
    assert "valid for" in printed
    drawn = discovery().to_dict()["curves"][0]
    assert drawn["binned"][0]["readings"] == by_angle.binned[3][0]


def test_a_longer_law_has_to_be_more_likely_than_every_shorter_one():
    one, two, three = (
        Selection((LawTerm(((0, 0),), 0.0),) * k, odds)
        for k, odds in ((1, (182.3,)), (2, (171.9, 9.0)), (3, (171.9, 9.0, 5.0)))
    )
    assert sufficiently_better([one, two, three]) == [one, three]
    assert sufficiently_better([one, two]) == [one]


def with_zero(symbol, *more):
    """A law a·cos(q_4)·τ_3, and b times a quantity at the same site."""
    s = screened().linear.fit.solution.prediction.situation
    known = {v.symbol: v for v in variables(s)}
    wave, torque = Factor(known["q_4"], shapes.COS, (1.0,)), Factor(known["τ_3"], shapes.LINEAR)
    other = Factor(known[symbol], shapes.LINEAR)
    place = next(x for x in screened().sites if x.field == "dq" and x.element == 2)
    both = LawPart(place, Amplitude((other,)), 0), LawPart(place, Amplitude((wave, torque)), 1)
    return Form((*both, *more))


@pytest.mark.slow
def test_a_law_is_searched_again_beside_what_was_added_after_it():
    """Its first search saw no effect that it hid; a shorter law of the second one replaces it."""
    longer, of = with_zero("τ_6"), campaign(LAW)
    tilting = of.model + "joint_tilt_compliance"
    sizes = np.concatenate([0.0 * of.theta, tilting.effects[-1].magnitudes])
    moved = [
        tilting.predict(of.readings.states, x).observation.position for x in (sizes, 0 * sizes)
    ]
    tilted = replace(of.readings, value=of.readings.value + moved[0] - moved[1])
    before = fitted_model(of.model.cell, tilted, of.mode)
    shorter = Form((replace(longer.parts[1], coefficient=0),))

    def with_law(fitted, form, name):
        kind = effect_class(source_of_form(form, name), name)
        model = fitted.model
        effect = kind(model.cell, fitted.readings.states)
        start = np.concatenate([fitted.theta, np.zeros(form.count)])
        return fit_again(fitted, replace(model, effects=(*model.effects, effect)), start=start)

    class Search:
        proposed = ("longer",)

        def propose(self, fitted, say):
            assert "longer" not in (*fitted.model.names, *fitted.model.catalogue.names)
            return with_law(fitted, shorter, "shorter"), "shorter"

    path = Path(before, laws=Search(), background=False)
    path.append(with_law(before, longer, "longer"), "longer")
    tilt = "joint_tilt_compliance"
    path.append(add(path.steps[-1].fit, tilt), tilt)
    path.complete()
    replaced = next(x for x in path.steps if x.removed == "longer")
    assert replaced.added == "shorter"
    assert replaced.fit.model.names[-2:] == (tilt, "shorter")


@pytest.mark.long
def test_a_number_that_the_model_absorbs_is_dropped():
    """The zero of a compliance that is no constant: the model has one already."""
    form = with_zero("τ_3")
    assert form.text() == "dq_3 = a·τ_3 + b·cos(q_4)·τ_3"
    after, kept, values, kind = refit_exactly(screened(), form, "kept")
    assert kept.text() == "dq_3 = a·cos(q_4)·τ_3"
    assert [c.name for c in values] == ["a"]
    assert abs(values[0].value) > 10 * values[0].std
    assert after.variance_factor == pytest.approx(discovery().laws[0].variance_factor, rel=1e-3)
    check_effect(kind)


@cache
def problem():
    return SearchProblem(screen(linearise(campaign())))


def term(p, power):
    """A displacement of joint 2 by a power of its torque."""
    (f,) = (
        k
        for k, a in enumerate(p.screen.grammar.amplitudes)
        if a.names == ("joint 2 torque",)
        and [(x.shape.name, x.numbers[:1]) for x in a.factors] == [("odd", (power,))]
    )
    (s,) = (k for k, o in enumerate(p.screen.sites) if (o.field, o.joint) == ("dq", 1))
    return LawTerm(((s, f),), 10.0)


@pytest.mark.parametrize(("power", "size", "more"), [(3.0, 300.0, False), (0.5, 300.0, True)])
def test_a_law_is_told_beside_an_effect_only_where_it_is_another(power, size, more):
    """The cube is what `joint_stiffening` describes; a root of the torque is not."""
    p = problem()
    law = term(p, power)
    column = p.model.project_out(p.columns(law))[:, 0]
    before = p.residual.copy(), p.noise
    p.residual = before[0] + size * column / np.linalg.norm(column)
    p.noise = float(p.residual @ p.residual), p.dof
    known = known_effects(campaign())
    chosen = Selection((law,), (size**2 / 2,))
    try:
        assert needed_beside_effect(p, chosen, known, "joint_stiffening") is more
    finally:
        p.residual, p.noise = before


@pytest.mark.parametrize(("shift", "named"), [(0.5, ("load_point",)), (0.2, ())])
def test_a_large_effect_is_named_by_its_exact_refit(shift, named):
    """What a load half a metre off does beyond the linearisation is no law of its own.

    By algebra the law is likelier by 20 in the logarithm of the odds, in either case.
    """
    fitted = _with_load_off(shift)
    p = SearchProblem(screen(linearise(fitted)))
    known = known_effects(fitted)
    assert known.names[0] == "load_point"
    law = Selection((term(p, 0.5),), (known.total + 20.0,))
    assert effects_replacing_law(fitted, p, law, known) == Replacement(named)


def test_no_refit_fails_in_silence(monkeypatch):
    """An effect that cannot be refitted is named; a law that cannot is not preferred to effects."""

    def fails(*_):
        raise CannotAnswerError("it finds no equilibrium")

    fitted = _with_load_off(0.2)
    p, known = SearchProblem(screen(linearise(fitted))), known_effects(fitted)
    law = Selection((term(p, 0.5),), (known.total + 20.0,))
    module = sys.modules[effects_replacing_law.__module__]
    with monkeypatch.context() as m:
        m.setattr(module, "refit_exactly", fails)
        assert (
            effects_replacing_law(fitted, p, law, known).names == ()
        )  # far less likely by algebra
        near = Selection((term(p, 0.5),), (known.total + LEAST_LOG_ODDS,))
        m.setattr(
            module, "_exact_effects", lambda *_: (known.total + 1.0, Replacement(known.names))
        )
        assert effects_replacing_law(fitted, p, near, known).names == known.names
    monkeypatch.setattr(module, "add", fails)
    replacement = effects_replacing_law(fitted, p, law, known)
    assert replacement == Replacement((), ((known.names[0], "it finds no equilibrium"),))
    answer = Discovery(fitted, "no_law", unfitted=replacement.unfitted)
    assert "load_point could not be tried in the exact model (it finds no eq" in no_law_sentence(
        answer
    )
    assert repr(replace(answer, reason="catalogue", catalogue=("creep",))) == (
        "Discovery('catalogue', 'creep')"
    )
    assert answer.to_dict()["unfitted"] == [
        {"effect": "load_point", "why": replacement.unfitted[0][1]}
    ]


def _with_load_off(shift):
    """Deflections as the model would read them with the load off by so much along z, and noise."""
    before = campaign()
    model = before.model + EffectSpec("load_point")
    states = before.readings.states
    theta = np.concatenate([before.theta, [0.0, 0.0, shift]])
    clean = model.predict(states, theta).observation.position
    noise = before.readings.value - before.model.predict(states, before.theta).observation.position
    readings = replace(before.readings, value=clean + noise)
    return fit(before.model, readings, before.mode)
