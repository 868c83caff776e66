"""`joint_coupling`: its law, its pairs, and that it is what a description's factor is off by."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.config.sections import Conventions, Coupling
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import fit
from hilcal.model.model import Model
from hilcal.robot.chain import evaluate
from hilcal.robot.conventions import as_counted
from tests.support.campaigns import campaign
from tests.support.effect_cases import CELLS, make, some_states

ODD = CELLS["odd"]


def coupled(arm, **factors):
    """An arm whose joints follow others: j3q2=-1.0 is joint 3 by joint 2."""
    entries = tuple(
        Coupling(joint=int(name[1]), follows=int(name[3]), factor=k) for name, k in factors.items()
    )
    return as_counted(arm, Conventions(joint_coupling=entries))


@pytest.mark.parametrize("given", [{}, {"j3q2": -1.0, "j7q6": 0.5}])
def test_it_is_what_the_factors_of_the_description_are_off_by(given):
    """An arm described with other factors stands where the effect says, whatever it is coupled by.

    The factors are those of the controller's values, also where these turn other joints too.
    """
    believed = coupled(ODD.arm, **given)
    k = {"j2q1": 3e-3, "j3q2": -2e-3, "j7q5": 1e-3, "j7q6": -1e-3}
    true = coupled(ODD.arm, **{p: given.get(p, 0.0) + k.get(p, 0.0) for p in {*k, *given}})
    cell = replace(ODD, arm=believed)
    states = some_states(cell)
    effect = make("joint_coupling", cell, states)
    theta = np.array([k.get(p.name.replace(".", ""), 0.0) for p in effect.parameters])
    assert np.count_nonzero(theta) == len(k)
    chain = Model(cell, (effect,)).predict(states, theta).situation.chain
    expected = evaluate(true, states.q)
    np.testing.assert_allclose(chain.position[-1], expected.position[-1], rtol=0, atol=1e-14)
    np.testing.assert_allclose(chain.rotation[-1], expected.rotation[-1], rtol=0, atol=1e-14)


def test_pairs_are_those_of_arms_with_couplings_or_those_that_are_named():
    states = some_states(ODD)
    assert make("joint_coupling", ODD, states).options == {"pairs": "2:1/3:2/4:3/5:4/6:5/7:5/7:6"}
    some = make("joint_coupling", ODD, states, {"pairs": "4:4/ 3:2"})
    assert some.options == {"pairs": "3:2/4:4"}
    assert [p.name for p in some.parameters] == ["j3.q2", "j4.q4"]
    assert some.parameters[1].meaning == "own ratio of joint 4"
    s = Model(ODD, ()).predict(states, np.zeros(0)).situation
    twist = some.deviation(np.array([0.1, 0.01]), s).twist
    expected = np.zeros_like(twist)
    expected[:, 2, 5], expected[:, 3, 5] = 0.1 * states.q[:, 1], 0.01 * states.q[:, 3]
    np.testing.assert_allclose(twist, expected, rtol=1e-15)


@pytest.mark.parametrize("given", ["", "3", "3:2/3:2", "8:1", "0:1", "3-2", 3.2, None, ["3:2"]])
def test_other_pairs_are_refused_with_what_would_be_valid(given):
    with pytest.raises(InputError, match=r"pairs = .*; valid: pairs of joints 1 to 7") as caught:
        make("joint_coupling", ODD, some_states(ODD), {"pairs": given})
    assert "\n" not in str(caught.value)


def test_hidden_factors_are_estimated_within_their_uncertainty():
    c = campaign("joint_coupling", "absolute", 0, strength=3.0)
    names = ("joint_compliance", "joint_coupling")
    found = fit(with_effects(c.cell, c.readings, "absolute", names), c.readings, "absolute")
    z = [
        (p.value - c.world.truth[p.name]) / p.std
        for p in found.parameters
        if p.name.startswith("joint_coupling")
    ]
    assert len(z) == 6
    assert np.sqrt(np.mean(np.square(z))) < 2.0  # chi-square of 6: 24 has a chance of 5e-4
    assert (
        found.variance_factor
        < 1.2
        < fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute").variance_factor
    )
