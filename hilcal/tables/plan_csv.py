"""A plan as a table: one row per reading, in order; with positions it is an exchange table."""

import csv
import io
from collections.abc import Mapping

import numpy as np

from hilcal.names import csv_text
from hilcal.store.plan import UNLOADED, Plan
from hilcal.tables.columns import TEXT, WRENCH, joint_columns
from hilcal.types import Floats

ORDER = "x_order"


def plan_csv(plan: Plan, wrenches: Mapping[str, Floats] | None = None) -> str:
    """Return a plan as CSV: `x_order` from 1, pose, load, cycle, q1_rad ... (and wrenches).

    The columns are those of the exchange table: who measures by hand adds x_m, y_m, z_m and
    imports it.

    Args:
        plan: poses and steps.
        wrenches: (6,) by load, base axes, N and N·m; adds fx_N ... mz_Nm where given.

    Raises:
        KeyError: a load of the plan has no wrench.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    forces = WRENCH if wrenches is not None else ()
    writer.writerow((ORDER, *TEXT, "cycle", *joint_columns(plan.q.shape[1]), *forces))
    for k, step in enumerate(plan.steps, start=1):
        texts = csv_text(step.pose), csv_text(step.load)
        row: list[object] = [k, *texts, step.cycle, *plan.joints(step.pose).tolist()]
        if wrenches is not None:
            free = step.load == UNLOADED
            row += (np.zeros(6) if free else np.asarray(wrenches[step.load])).tolist()
        writer.writerow(row)
    return out.getvalue()
