"""A plan that knows what another campaign taught."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.design.information import DesignProblem, problem
from hilcal.design.nominal_model import nominal_model
from hilcal.design.predicted import predicted
from hilcal.errors import InputError
from hilcal.identification.baseline import with_effects
from hilcal.identification.carried import CarriedPrior, carried_prior
from hilcal.identification.fit import fit
from hilcal.identification.posterior import Posterior
from tests.support.campaigns import campaign, configuration, plan

NAMES = ("joint_compliance", "joint_tilt_compliance")


@cache
def learnt() -> Posterior:
    c = campaign("joint_tilt_compliance", "absolute", 1, poses=30, registration_known=True)
    found = fit(with_effects(c.cell, c.readings, "absolute", NAMES), c.readings, "absolute")
    return Posterior.of(found)


def problem_with(prior: CarriedPrior | None, names: tuple[str, ...] = NAMES) -> DesignProblem:
    config = configuration()
    planning = config.planning.model_copy(update={"model": names, "against": ()})
    config = config.model_copy(update={"planning": planning})
    nominal = nominal_model(cell_from_config(config), config, 3, prior=prior)
    return problem(nominal, config, np.unique(plan(4, 5).states.q, axis=0))


def std(of: DesignProblem) -> dict[str, float]:
    return predicted(of, np.ones(len(of.units))).by_name()


def test_what_is_known_is_in_the_prediction() -> None:
    alone, known = std(problem_with(None)), std(problem_with(carried_prior(learnt())))
    assert known.keys() == alone.keys()
    own = dict(zip(learnt().names, learnt().std, strict=True))
    for name in learnt().names:
        assert known[name] < min(alone[name], own[name])


def test_effects_that_only_the_prior_knows_are_planned_for() -> None:
    found = problem_with(carried_prior(learnt()), NAMES[:1])
    assert "joint_tilt_compliance" in found.nominal.model.names


def test_a_prior_that_knows_nothing_changes_no_prediction() -> None:
    p = learnt()
    nothing = carried_prior(replace(p, information=np.zeros_like(p.information)))
    alone, known = std(problem_with(None)), std(problem_with(nothing))
    np.testing.assert_allclose(list(known.values()), list(alone.values()), rtol=1e-9)


def test_of_another_arm_is_refused() -> None:
    p = learnt()
    with pytest.raises(InputError, match="nominal links"):
        problem_with(carried_prior(replace(p, links=1.01 * p.links)))
