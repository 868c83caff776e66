"""When an effect of the catalogue is named, and when a law that is near one."""

from functools import cache

import numpy as np
import pytest

from hilcal.discover.discovery import _catalogue, _tells_more
from hilcal.discover.problem import Problem
from hilcal.discover.screen import screen
from hilcal.discover.search import Selection
from hilcal.discover.terms import Term
from hilcal.identify.linearisation import linearise
from tests.unit.discover.test_discover import campaign


@cache
def problem() -> Problem:
    return Problem(screen(linearise(campaign())))


def term(p: Problem, power: float) -> Term:
    """A displacement of joint 2 by a power of its torque."""
    (f,) = (
        k
        for k, a in enumerate(p.screen.grammar.amplitudes)
        if a.names == ("joint 2 torque",)
        and [(x.shape.name, x.numbers[:1]) for x in a.factors] == [("odd", (power,))]
    )
    (s,) = (k for k, o in enumerate(p.screen.sites) if (o.field, o.joint) == ("dq", 1))
    return Term(((s, f),), 10.0)


@pytest.mark.parametrize(("power", "size", "more"), [(3.0, 300.0, False), (0.5, 300.0, True)])
def test_a_law_is_told_beside_an_effect_only_where_it_is_another(
    power: float, size: float, more: bool
) -> None:
    """The cube is what `joint_stiffening` describes; a root of the torque is not."""
    p = problem()
    own = term(p, power)
    column = p.model.project_out(p.columns(own))[:, 0]
    noise = p.residual.copy()
    p.residual = noise + size * column / np.linalg.norm(column)
    _, _, columns = _catalogue(campaign())
    chosen = Selection((own,), (size**2 / 2,))
    try:
        assert _tells_more(p, chosen, columns, "joint_stiffening") is more
    finally:
        p.residual = noise
