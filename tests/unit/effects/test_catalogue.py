"""The catalogue is a value; effects are added by name, by class and by package."""

import numpy as np
import pytest

from hilcal.diagnosis.effect_ranking import candidates
from hilcal.effects.catalogue import installed
from hilcal.effects.protocol import Columns, Effect, Parameter, Role, effect, failure_of
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.model.model import Model
from tests.support.campaigns import campaign
from tests.support.refusals import refusal


class Sag(Effect):
    """dq_1 = a cos(q_2)."""

    name = "sag"
    summary = "dq_1 = a cos(q_2)"
    role: Role = "baseline"

    @property
    def parameters(self):
        return (Parameter("a", "rad", 1e-5),)

    def columns(self, s):
        return (Columns("dq", np.array([0]), np.array([0]), np.cos(s.angle[:, 1:2])),)


def test_an_effect_is_added_by_name_and_options():
    c = campaign()
    model = baseline(c.cell, c.readings, "absolute") + effect("hysteresis", joints="1-3")
    assert model.names[-1] == "hysteresis"
    assert model.effects[-1].options == {"joints": "1-3"}
    with pytest.raises(InputError, match=r"unknown effect 'hysteresys' \(did you mean"):
        model + effect("hysteresys")
    with pytest.raises(InputError, match="hysteresis is in the model already"):
        model + effect("hysteresis")
    with pytest.raises(InputError, match="unknown option 'joint'; valid: joints"):
        model + effect("encoder_offset", joint=1)


def test_an_effect_is_added_by_its_class_and_is_in_the_catalogue_then():
    c = campaign()
    model = baseline(c.cell, c.readings, "absolute") + effect(Sag)
    assert model.names[-1] == "sag"
    assert model.catalogue.names[-1] == "sag"
    assert "sag" not in installed().names


def test_a_model_without_readings_takes_effects_that_are_built_only():
    with pytest.raises(InputError, match="creep: this model was made without readings"):
        Model(campaign().cell, ()) + effect("creep")


def test_what_a_model_could_have_is_what_its_catalogue_holds():
    c = campaign()
    mine = installed().with_effects(Sag)
    assert "sag" in baseline(c.cell, c.readings, "absolute", mine).names  # by its role
    bare = Model(c.cell, (), mine, c.readings) + effect("joint_compliance") + effect("base_frame")
    found = fit(bare, c.readings, "absolute")
    assert "sag" in {e.name for e in candidates(found)}
    refusal("class Sag: effect sag is in the catalogue already", mine.with_effects, Sag)


class Fails(Sag):
    """Raises where there are many states."""

    name = "fails"

    def columns(self, s):
        return super().columns([s][len(s.angle) > 40])


def test_what_an_effect_raises_in_use_is_traced_to_its_line():
    c = campaign()
    model = baseline(c.cell, c.readings, "absolute") + effect(Fails)
    with pytest.raises(IndexError) as caught:
        model.predict(c.readings.states, np.zeros(model.size))
    line = Fails.columns.__code__.co_firstlineno + 1
    start = f"{__file__}, line {line}: effect fails: columns raises IndexError: list index out of"
    assert str(failure_of(caught.value)).startswith(start)


def test_what_hilcal_raises_is_no_failure_of_a_users_effect():
    c = campaign()
    model = baseline(c.cell, c.readings, "absolute")
    with pytest.raises(IndexError) as caught:
        model.predict(c.readings.states, np.zeros(0))  # no parameters
    assert failure_of(caught.value) is None
