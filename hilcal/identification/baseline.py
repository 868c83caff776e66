"""The starting model of a campaign: unknown frames, and joint compliance where loads act."""

from collections.abc import Iterable, Mapping

import numpy as np

from hilcal import limits
from hilcal.cell import Cell
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.effects.options import Options
from hilcal.effects.protocol import Role
from hilcal.effects.spec import EffectSpec
from hilcal.identification.carried import CarriedPrior, check_prior
from hilcal.identification.misdescription import refuse_misdescribed
from hilcal.identification.missing_masses import loads_differ, masses_missing
from hilcal.identification.registration import Registration, register
from hilcal.identification.rigid_frames import TARGET_M, TELL
from hilcal.identification.torques import require_torques
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode

ARM = 0.5
"""Lever from the length to the angle of a registration's prior, m. A guess: half of the reach of a
middle-sized arm."""


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

    Args:
        cell: the cell.
        readings: what is to be fitted.
        mode: "deflection" or "absolute".
        catalogue: the effects that a model can have; the installed ones unless given.
        prior: what another campaign taught; its effects are in the model, too, but for those that
            need what the readings do not have.

    Raises:
        InputError: a prior of another arm, or of these very readings.
        CannotAnswerError: the readings do not determine an unknown frame.
    """
    known = catalogue or installed()
    loaded = bool(np.any(readings.states.wrench != 0))
    names = [kind.name for kind in known.with_role("baseline") if loaded]
    if loaded and masses_missing(cell, mode) and loads_differ(readings):
        names += [kind.name for kind in known.effects if kind.for_missing_weight]
    if prior is not None:
        learnt = [e.name for e in prior.posterior.effects]
        names += [name for name in learnt if known[name].computable(readings.states)]
    return with_effects(cell, readings, mode, names, catalogue=known, prior=prior)


def _held(role: Role, found: Registration) -> bool:
    """Whether frames of a role get a prior where the readings do not determine all of them."""
    return role == "target" or bool(found.cell.observers)


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
    gets a prior of an ordinary size where the poses do not tell all of its offset.

    Args:
        cell: the cell.
        readings: what is to be fitted.
        mode: "deflection" or "absolute".
        names: of the effects.
        options: by name, where they are not the usual ones.
        catalogue: the effects that a model can have; the installed ones unless given.
        prior: what another campaign taught; effects have its options unless others are given.

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
    for name in dict.fromkeys((*frames, *names)):
        begun: Options = {}
        if name in frames and mode == "deflection":
            length = max(registered.rms, 1e-6)
            begun = {"prior_m": length, "prior_rad": length / ARM}
        elif name in frames and registered.undetermined and _held(known[name].role, registered):
            begun = {"prior_m": TARGET_M, "prior_rad": TELL}
        chosen = given.get(name) or learnt.get(name, {})
        model = model + EffectSpec(name, {**begun, **chosen})
    return model
