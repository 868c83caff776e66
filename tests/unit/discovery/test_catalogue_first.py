"""When an effect of the catalogue is named, and when a law that is near one."""

import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hilcal.discovery.discovery import Discovery, discovery_json
from hilcal.discovery.known_effects import (
    Replacement,
    effects_replacing_law,
    known_effects,
    needed_beside_effect,
)
from hilcal.discovery.problem import SearchProblem
from hilcal.discovery.screen import LawTerm, screen
from hilcal.discovery.search import LEAST_LOG_ODDS, Selection
from hilcal.effects.protocol import EffectSpec
from hilcal.errors import CannotAnswerError
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import linearise
from hilcal.present.diagnosis import no_law_sentence
from tests.unit.discovery.test_discover import campaign


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
    own = term(p, power)
    column = p.model.project_out(p.columns(own))[:, 0]
    before = p.residual.copy(), p.noise
    p.residual = before[0] + size * column / np.linalg.norm(column)
    p.noise = float(p.residual @ p.residual), p.dof
    known = known_effects(campaign())
    chosen = Selection((own,), (size**2 / 2,))
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
    found = effects_replacing_law(fitted, p, law, known)
    assert found == Replacement((), ((known.names[0], "it finds no equilibrium"),))
    answer = Discovery(fitted, "no_law", unfitted=found.unfitted)
    assert "load_point could not be tried in the exact model (it finds no eq" in no_law_sentence(
        answer
    )
    assert discovery_json(answer)["unfitted"] == [
        {"effect": "load_point", "why": found.unfitted[0][1]}
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
