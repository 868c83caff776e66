"""The starting model of a campaign: unknown frames, and joint compliance where loads act.

An arm sags under its weight and under the load. Where its description has no masses, the model
contains the torque of the load only. Where both torques act in the same direction, absolute
readings give in place of a compliance c

    c (1 + τ_weight/τ_load)

which is 2.7 c for joint 2 of a UR10e (34 kg) under 5 kg, and 6.6 c under 1 kg. Where poses are read
under several loads, differences between the loads determine c, and the unloaded readings the sag
under the weight: the first moments of the links are then estimated, too. Under one load the two
cannot be separated.
"""

from collections.abc import Iterable, Mapping

import numpy as np

from hilcal import limits
from hilcal.cell import Cell
from hilcal.effects.catalogue import Catalogue, installed
from hilcal.effects.options import Options
from hilcal.effects.protocol import EffectSpec
from hilcal.identification.carried.carried_prior import CarriedPrior, check_prior
from hilcal.identification.fit import Fit
from hilcal.identification.registration.misdescription import refuse_misdescribed
from hilcal.identification.registration.placement import DETERMINED_SHARE, TARGET_M
from hilcal.identification.registration.registration import register
from hilcal.identification.torques import require_torques
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode

SURE_SIGMA = 3.0  # value, in standard uncertainties, from which a sign is determined
LEVER_M = 0.5  # m, length over angle of a registration's prior: half of a reach; a guess


def baseline(
    cell: Cell,
    readings: Readings,
    mode: Mode,
    catalogue: Catalogue | None = None,
    prior: CarriedPrior | None = None,
) -> Model:
    """Return the starting model: unknown frames, and joint compliance where a load acts.

    The `role` of the catalogue's effects selects them. For absolute readings of an arm without
    masses under several loads, the effects of its weight are added; so are those of a prior, except
    where they need data which the readings lack. Raises as `with_effects`.
    """
    catalogue = catalogue or installed()
    names: list[str] = []
    if np.any(readings.states.wrench != 0):
        names = [kind.name for kind in catalogue.with_role("baseline")]
        if masses_missing(cell, mode) and loads_differ(readings):
            names += [kind.name for kind in catalogue.effects if kind.for_missing_weight]
    if prior is not None:
        carried = [e.name for e in prior.posterior.effects]
        names += [name for name in carried if catalogue[name].computable(readings.states)]
    return with_effects(cell, readings, mode, names, catalogue=catalogue, prior=prior)


def with_effects(
    cell: Cell,
    readings: Readings,
    mode: Mode,
    names: Iterable[str],
    options: Mapping[str, Options] | None = None,
    catalogue: Catalogue | None = None,
    prior: CarriedPrior | None = None,
) -> Model:
    """Return the model of the unknown frames and the named effects.

    Frames only rotate deflections, so the registration to the positions enters as a prior, with its
    rms error as standard deviation. In absolute readings the target gets a prior of an ordinary
    size where the poses do not determine its whole offset. Effects have the options of the carried
    prior, unless `options` has some for their names.

    Raises:
        InputError: an unknown effect or option, a bad value, readings that lack what an
            effect needs, or a prior of another arm or of these very readings.
        CannotAnswerError: the readings do not determine an unknown frame.
    """
    limits.check_fitted(len(readings), readings.m)
    catalogue, options = catalogue or installed(), options or {}
    carried: dict[str, Options] = {}
    if prior is not None:
        check_prior(prior, cell.arm, readings)
        carried = {e.name: e.options for e in prior.posterior.effects}
    require_torques(cell, readings)
    registered = register(cell, readings)
    refuse_misdescribed(registered, readings)
    model = Model(registered.cell, (), catalogue, readings, prior)
    frames = catalogue.unknown_frames(registered.cell)
    held = [n for n in frames if catalogue[n].role == "target" or registered.cell.observers]
    for name in dict.fromkeys((*frames, *names)):
        defaults: Options = {}
        if name in frames and mode == "deflection":
            length = max(registered.rms, 1e-6)
            defaults = {"prior_m": length, "prior_rad": length / LEVER_M}
        elif name in held and registered.undetermined:
            defaults = {"prior_m": TARGET_M, "prior_rad": DETERMINED_SHARE}
        chosen = options.get(name) or carried.get(name, {})
        model = model + EffectSpec(name, {**defaults, **chosen})
    return model


def masses_missing(cell: Cell, mode: Mode) -> bool:
    """Whether the readings contain the sag under the arm's weight, but its masses are unknown."""
    return mode == "absolute" and not np.any(cell.arm.masses)


def loads_differ(readings: Readings) -> bool:
    """Whether some pose was read under more than one load."""
    states = np.column_stack([readings.pose, readings.states.wrench])
    return len(np.unique(states, axis=0)) > len(np.unique(readings.pose))


def loads_note(fit: Fit) -> str | None:
    """Return in a sentence why the compliances of a fit are in doubt; None if they are not.

    Without the initial capital and the full stop.
    """
    return _turned_forces(fit) or _missing_masses(fit)


def _turned_forces(fit: Fit) -> str | None:
    """Describe forces of the wrong sign: a load does positive work on what it deforms."""
    std, of_load = fit.uncertainty.std, np.zeros(len(fit.theta), dtype=bool)
    for effect, columns in zip(fit.model.effects, fit.model.slices(), strict=True):
        of_load[columns] = effect.role == "baseline"
    sure = of_load & (np.abs(fit.theta) > SURE_SIGMA * std)
    if np.count_nonzero(sure) < 2 or np.any(fit.theta[sure] > 0):
        return None
    return (
        "every compliance that is determined is negative: the arm moves against its loads. Are the "
        "forces those on the sensor, of the opposite sign? Valid are those that the load exerts on "
        "the tool, in base axes: of a weight, downwards"
    )


def _missing_masses(fit: Fit) -> str | None:
    """Describe how missing masses affect the compliances."""
    model, readings = fit.model, fit.readings[~fit.outlier]
    if not masses_missing(model.cell, fit.mode) or not any(e.elastic for e in model.effects):
        return None
    cause = "the arm's description has no masses"
    names = [kind.name for kind in model.catalogue.effects if kind.for_missing_weight]
    added = " and ".join(n for n in names if n in model.names)
    if not loads_differ(readings):
        return (
            f"{cause} and no pose was read under two loads: nothing tells the sag under the arm's "
            "weight from that under the load, and compliances come out too large by (weight + "
            "load)/load, as torques, e.g. 3 times for an arm of 30 kg under 5 kg; give the masses, "
            "or read each pose unloaded, too"
        )
    if added:
        return (
            f"{cause}: {added} estimates what its weight does, so that the compliances follow from "
            "the loads, which are known"
        )
    return (
        f"{cause}: its sag is taken for the load's, and compliances come out too large by up to "
        f"(weight + load)/load, as torques; hilcal add RUN {' or '.join(names)}, fit deflections, "
        "or give the masses"
    )
