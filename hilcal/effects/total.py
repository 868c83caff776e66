"""The deviation that an effect's columns and parameters make."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hilcal.robot.batch import zeros
from hilcal.robot.deviation import Deviation
from hilcal.types import Floats

if TYPE_CHECKING:
    from hilcal.effects.protocol import Columns, Situation


def total(
    columns: "tuple[Columns, ...]", theta: Floats, s: "Situation", start: Deviation | None = None
) -> Deviation:
    """Return the deviation Σ columns_p θ_p of N states, added to one of them where it is given."""
    count, n = s.angle.shape
    width = {"dq": (n,), "twist": (n + 1, 6), "scale": ()}
    fields: dict[str, Floats] = {}
    for c in columns:
        field = fields.get(c.field)
        if field is None:
            before = None if start is None else getattr(start, c.field)
            shape = (count, *width.get(c.field, (6,)))
            field = zeros(*shape) if before is None else before.copy(order="F")
            fields[c.field] = field
        t = theta[c.parameter]
        if c.field in ("dq", "twist"):
            for e, mine in c.runs():
                if mine.stop - mine.start == 1:
                    field[:, e] += c.values[:, mine.start] * t[mine.start]
                else:
                    field[:, e] += np.einsum("np...,p->n...", c.values[:, mine], t[mine])
        else:
            field += np.einsum("np...,p->n...", c.values, t)
    return Deviation(**fields) if start is None else replace(start, **fields)
