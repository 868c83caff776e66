"""The starting model of a campaign: unknown frames, and joint compliance where loads act.

An arm that is described without masses sags under its own weight as under the load, and the model
knows the load's torque alone. Where both pull alike, a compliance c comes out of absolute readings
as

    c (1 + τ_weight/τ_load)

2.7 times c for joint 2 of a UR10e (34 kg) under 5 kg, 6.6 times under 1 kg. Where poses are read
under several loads, the difference tells c, and the unloaded reading what the weight does: then the
first moments of the links are estimated along with it. Under one load nothing tells the two apart.
"""

from collections.abc import Iterable, Mapping

import numpy as np

from hilcal import limits
from hilcal.cell import Cell
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.effects.options import Options
from hilcal.effects.spec import EffectSpec
from hilcal.identification.carried import CarriedPrior, check_prior
from hilcal.identification.fit import Fit
from hilcal.identification.misdescription import refuse_misdescribed
from hilcal.identification.registration import TARGET_M, TELL, register
from hilcal.identification.torques import require_torques
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode

ARM = 0.5  # m, from the length to the angle of a registration's prior: half of a reach, a guess


def baseline(
    cell: Cell,
    readings: Readings,
    mode: Mode,
    catalogue: Catalogue | None = None,
    prior: CarriedPrior | None = None,
) -> Model:
    """Return the starting model: unknown frames, and joint compliance where a load acts.

    They are found by the `role` of the catalogue's effects. In absolute readings of an arm without
    masses, what its weight does is estimated as well where poses were read under several loads.
    The effects of a prior are in the model, too, but for those that need what the readings lack.

    Raises:
        InputError: a prior of another arm, or of these very readings.
        CannotAnswerError: the readings do not determine an unknown frame.
    """
    known = catalogue or installed()
    names: list[str] = []
    if np.any(readings.states.wrench != 0):
        names = [kind.name for kind in known.with_role("baseline")]
        if masses_missing(cell, mode) and loads_differ(readings):
            names += [kind.name for kind in known.effects if kind.for_missing_weight]
    if prior is not None:
        learnt = [e.name for e in prior.posterior.effects]
        names += [name for name in learnt if known[name].computable(readings.states)]
    return with_effects(cell, readings, mode, names, catalogue=known, prior=prior)


def with_effects(
    cell: Cell,
    readings: Readings,
    mode: Mode,
    names: Iterable[str],
    options: Mapping[str, Options] | None = None,
    catalogue: Catalogue | None = None,
    prior: CarriedPrior | None = None,
) -> Model:
    """Return frames where unknown, and the named effects.

    In deflections the frames act only by turning them, so the registration to the positions
    enters as a prior, with its rms error as standard deviation. In absolute readings the target
    gets a prior of an ordinary size where the poses do not tell all of its offset. Effects have
    the options of a prior unless others are given by name.

    Raises:
        InputError: an unknown effect or option, a bad value, readings that lack what an
            effect needs, or a prior of another arm or of these very readings.
        CannotAnswerError: the readings do not determine an unknown frame.
    """
    limits.check_fitted(len(readings), readings.m)
    known, given = catalogue or installed(), options or {}
    learnt: dict[str, Options] = {}
    if prior is not None:
        check_prior(prior, cell.arm, readings)
        learnt = {e.name: e.options for e in prior.posterior.effects}
    require_torques(cell, readings)
    registered = register(cell, readings)
    refuse_misdescribed(registered, readings)
    model = Model(registered.cell, (), known, readings, prior)
    frames = known.unknown_frames(registered.cell)
    held = [n for n in frames if known[n].role == "target" or registered.cell.observers]
    for name in dict.fromkeys((*frames, *names)):
        begun: Options = {}
        if name in frames and mode == "deflection":
            length = max(registered.rms, 1e-6)
            begun = {"prior_m": length, "prior_rad": length / ARM}
        elif name in held and registered.undetermined:
            begun = {"prior_m": TARGET_M, "prior_rad": TELL}
        chosen = given.get(name) or learnt.get(name, {})
        model = model + EffectSpec(name, {**begun, **chosen})
    return model


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
