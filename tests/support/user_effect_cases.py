"""A small law in a file, for the tests of effects of a user's own."""

MODULE_HEAD = """\
import numpy as np
from hilcal.effects.protocol import Columns, Effect, Parameter, Response
"""
CLASS = (
    MODULE_HEAD
    + """\

class Mine(Effect):
    name = "mine"
    summary = "dq_j = a sin(2 q_j)"

    @property
    def parameters(self):
        return (Parameter("a", "rad", 1e-5),)

    def columns(self, s):
        values = np.sin(2 * s.angle[:, :1])
        return (Columns("dq", np.array([0]), np.array([1]), values),)
"""
)
COLUMNS = "values = np.sin(2 * s.angle[:, :1])"
