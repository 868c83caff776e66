"""Compliance from absolute readings of an arm that is described without masses.

The arm sags under its own weight and under the load, and the model knows the load's torque alone.
Where both pull alike, a compliance c comes out as

    c (1 + τ_weight/τ_load)

2.7 times c for joint 2 of a UR10e (34 kg) under 5 kg, 6.6 times under 1 kg. Where poses are read
under several loads, the difference tells c, and the unloaded reading what the weight does: then the
first moments of the links are estimated along with it. Under one load nothing tells the two apart.
"""

import numpy as np

from hilcal.cell import Cell
from hilcal.identification.fit import Fit
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode


def masses_missing(cell: Cell, mode: Mode) -> bool:
    """Whether the weight of the arm pulls in these readings, and is not described."""
    return mode == "absolute" and not np.any(cell.arm.masses)


def loads_differ(readings: Readings) -> bool:
    """Whether some pose was read under more than one load."""
    states = np.column_stack([readings.pose, readings.states.wrench])
    return len(np.unique(states, axis=0)) > len(np.unique(readings.pose))


def masses_note(fit: Fit) -> str | None:
    """Return what the missing masses do to the compliances of a fit; None where nothing.

    One sentence, to be begun with a capital and ended with a full stop.
    """
    model, readings = fit.model, fit.readings[~fit.outlier]
    if not masses_missing(model.cell, fit.mode) or not any(e.elastic for e in model.effects):
        return None
    begin = "the arm's description has no masses"
    names = [kind.name for kind in model.catalogue.effects if kind.for_missing_weight]
    known = " and ".join(n for n in names if n in model.names)
    if not loads_differ(readings):
        return (
            f"{begin} and no pose was read under two loads: nothing tells the sag under the arm's "
            "weight from that under the load, and compliances come out too large by (weight + "
            "load)/load, as torques, e.g. 3 times for an arm of 30 kg under 5 kg; give the masses, "
            "or read each pose unloaded, too"
        )
    if known:
        return (
            f"{begin}: {known} estimates what its weight does, so that the compliances follow from "
            "the loads, which are known"
        )
    return (
        f"{begin}: its sag is taken for the load's, and compliances come out too large by up to "
        f"(weight + load)/load, as torques; hilcal add RUN {' or '.join(names)}, fit deflections, "
        "or give the masses"
    )
