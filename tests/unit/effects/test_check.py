"""`check_effect` finds a response that is declared local and is not."""

from typing import Any

import numpy as np
import pytest

from hilcal.effects.check import check_effect
from hilcal.effects.protocol import Columns, Effect, Parameter, Response, Situation
from hilcal.errors import InputError
from hilcal.types import Floats


class Neighbour(Effect):
    """dq_j = a_j τ_{j−1}: each joint follows the torque of the one before it."""

    name = "neighbour"
    summary = "dq_j = a_j τ_{j−1}"
    elastic = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(Parameter(f"j{j + 1}", "rad/(N·m)", 1e-6) for j in range(self.cell.arm.n))

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        joints = np.arange(self.cell.arm.n)
        return (Columns("dq", joints, joints, np.roll(s.torque, 1, axis=1)),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        return Response(dq=theta * np.roll(change[:, :, :-1, 5], 1, axis=2))


class Declared(Neighbour):
    """The same, declared to be local."""

    local_response = True


class PerState(Neighbour):
    """dq_j = a_j sin(q_j) τ_j, whose response takes no (1, P, n + 1, 6)."""

    local_response = True

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        joints = np.arange(self.cell.arm.n)
        return (Columns("dq", joints, joints, np.sin(s.angle) * s.torque),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        out: Any = np.empty((len(change), change.shape[1], self.cell.arm.n))
        out[:] = (theta * np.sin(s.angle))[: len(change), None, :] * change[:, :, :-1, 5]
        return Response(dq=out)


def test_an_effect_that_couples_slots_is_accepted_where_it_says_so() -> None:
    check_effect(Neighbour)


def test_one_that_is_declared_local_and_couples_slots_is_refused() -> None:
    with pytest.raises(InputError, match=r"moves other slots than 0 .* set local_response = False"):
        check_effect(Declared)


def test_one_whose_response_does_not_take_equal_changes_is_refused() -> None:
    with pytest.raises(InputError, match=r"changes \(1, P, n \+ 1, 6\) has another dq"):
        check_effect(PerState)
