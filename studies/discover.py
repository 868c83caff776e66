"""One case of the study of `discover`: a campaign, the search, and the error at fresh poses."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from zlib import crc32

import numpy as np

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.discovery.discovery import agreement, discover
from hilcal.discovery.law import Law
from hilcal.drivers.simulated.injected_effects import hide_effect, world_without_effect
from hilcal.drivers.simulated.rehearsal import measurement_noise, simulate
from hilcal.drivers.simulated.world import World
from hilcal.effects.protocol import EffectSpec
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.identification.residual import residual
from hilcal.readings.readings import Readings, States
from hilcal.readings.whitening import Mode, whitening
from hilcal.types import Floats, Ints
from studies.foreign_laws import KINDS, Foreign
from studies.law_scene import Scene, scene
from studies.random_campaigns import rehearsal_states
from studies.study_cases import with_study_loads

POSES = 30
CAUSES = {
    "joint_stiffening": ("torque",),
    "backlash": ("torque",),
    "hysteresis": ("side",),
    "transmission_error": ("angle",),
    "periodic_joint_compliance": ("torque", "angle"),
}
"""Quantities of the joint that an effect of the catalogue depends on."""
LAST_AXIS = "axis of joint 6 to gravity"
CLEAR = 3.0
"""Value of a parameter, in standard uncertainties, above which it counts as found."""


@dataclass(frozen=True, slots=True)
class DiscoveryCase:
    """A case: a hidden law of `KINDS`, a hidden effect of the catalogue, or nothing.

    `loads` is the number of the study's loads that are used; None for all.
    """

    robot: str
    mode: Mode
    law: str = ""
    effect: str = ""
    seed: int = 0
    strength: float = 3.0
    stated: float = 1.0
    poses: int = POSES
    loads: int | None = None


@dataclass(frozen=True, slots=True)
class DiscoveryOutcome:
    """Result of a case.

    Attributes:
        asked: the case.
        reason: of the search.
        formula: of the first law; empty for none.
        truth: the hidden law.
        site: whether the site is right.
        variables: whether the variables are exactly right.
        correlation: of the displacements by the law and the hidden one, the model projected out.
        before: error at fresh poses over their noise, by the model alone.
        after: the same with the first law, if any.
        p_value: of the first law.
        impossible: reason why there is no such campaign.
    """

    asked: DiscoveryCase
    reason: str = ""
    formula: str = ""
    truth: str = ""
    site: bool = False
    variables: bool = False
    correlation: float = 0.0
    before: float = 0.0
    after: float = 0.0
    p_value: float = 1.0
    impossible: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """Readings with the law; displacements (N, 3) by law and noise; the arm at rest."""

    readings: Readings
    moved: Floats
    noise: Floats
    scene: Scene


@dataclass(frozen=True, slots=True, eq=False)
class Simulated:
    """Two campaigns with the same law, or None, and the fit of the first without the law."""

    law: Foreign | None
    before: Fit
    first: Campaign
    fresh: Campaign


def run_case(config: CellConfig, asked: DiscoveryCase) -> DiscoveryOutcome:
    """Simulate, search, and measure the error at fresh poses."""
    try:
        c = simulated(config, asked)
    except InputError as error:
        return DiscoveryOutcome(asked, impossible=str(error))
    law, before = c.law, c.before
    d = discover(before)
    out = DiscoveryOutcome(asked, d.reason, truth=asked.effect if law is None else law.words)
    if d.laws:
        out = replace(out, formula=d.laws[0].formula, p_value=d.laws[0].p_value)
    if law is None:
        return out
    without_law = error_at(before, c.fresh)
    if d.reason == "catalogue":
        return with_catalogue(replace(out, before=without_law), law, before, d.catalogue, c)
    if not d.laws or d.after is None:
        return replace(out, before=without_law, after=without_law)
    return replace(
        out,
        site=_right_site(law, d.laws[0]),
        variables=_same_quantities(d.laws[0].variables) == _same_quantities(law.variables),
        correlation=agreement(before, d.after, c.first.moved),
        before=without_law,
        after=error_at(d.after, c.fresh),
    )


def simulated(config: CellConfig, asked: DiscoveryCase) -> Simulated:
    """Simulate two campaigns, and fit the first one.

    Raises:
        InputError: there is no such campaign.
    """
    rng = np.random.default_rng(
        [
            asked.seed,
            *(crc32(w.encode()) for w in (asked.robot, asked.mode, asked.law, asked.effect)),
        ]
    )
    robot_config, loads = with_study_loads(config, asked.robot)
    loads = loads[: asked.loads]
    cell = cell_from_config(robot_config)
    world = world_without_effect(
        cell,
        rng,
        noise=measurement_noise(robot_config),
        joint_std=robot_config.repeatability.per_joint(cell.arm.n),
    )
    law = KINDS[asked.law][1](rng) if asked.law else None
    campaign = rehearsal_states(cell, asked.poses, loads, rng)
    if asked.effect:
        states, pose, _, cycle = campaign
        world = hide_effect(
            asked.effect, cell, states, asked.strength, asked.mode, rng,
            world=world, pose=pose, cycle=cycle,
        )  # fmt: skip
    names = ("none", *(name for name, _ in loads))
    first = _measured(world, campaign, names, rng, law, asked.stated)
    size = 1.0
    if law is not None:
        w = whitening(first.readings, asked.mode)
        white = w.whiten(w.raw(first.moved))
        size = asked.strength / max(float(np.sqrt(np.mean(white**2))), 1e-12)
        first = _scaled(first, size)
    readings = first.readings
    before = fit(baseline(cell, readings, asked.mode), readings, asked.mode)
    again = rehearsal_states(cell, asked.poses, loads, rng)
    fresh = _scaled(_measured(world, again, names, rng, law, before=first.scene), size)
    return Simulated(law, before, first, fresh)


def _same_quantities(names: Iterable[str]) -> frozenset[str]:
    """Replace the axis of the last joint by the equivalent attitude of the flange."""
    return frozenset("flange attitude" if n == LAST_AXIS else n for n in names)


def with_catalogue(
    out: DiscoveryOutcome,
    law: Foreign,
    before: Fit,
    names: Sequence[str],
    c: Simulated,
) -> DiscoveryOutcome:
    """Return the outcome after adding the effects of the catalogue that the answer names."""
    model = before.model
    for name in names:
        model = model + EffectSpec(name)
    after = fit(model, before.readings, before.mode)
    clear = [
        e.name
        for e in after.parameters
        if e.name.partition(".")[0] in names
        and e.value is not None
        and e.std is not None
        and abs(e.value) > CLEAR * e.std
    ]
    return replace(
        out,
        formula=f"{' + '.join(names)} of the catalogue",
        site=bool(clear) and all(f"joint {n[-1]}" in law.sites for n in clear),
        variables=law.variables
        == {f"joint {n[-1]} {c}" for n in clear for c in CAUSES.get(n.partition(".")[0], ())},
        correlation=agreement(before, after, c.first.moved),
        after=error_at(after, c.fresh),
    )


def _measured(
    world: World,
    campaign: tuple[States, Ints, Ints, Ints],
    names: Sequence[str],
    rng: np.random.Generator,
    law: Foreign | None,
    stated: float = 1.0,
    before: Scene | None = None,
) -> Campaign:
    states, pose, load, cycle = campaign
    readings = simulate(world, states, pose, load, cycle, names, rng)
    s = scene(world, states, before)
    moved = np.zeros_like(s.seen) if law is None else law.displaced(s)
    noise = readings.value - s.seen
    stated_so = replace(readings, covariance=stated**2 * readings.covariance)
    return Campaign(stated_so, moved, noise, s)


def _scaled(c: Campaign, size: float) -> Campaign:
    moved = size * c.moved
    return replace(c, readings=replace(c.readings, value=c.readings.value + moved), moved=moved)


def _right_site(law: Foreign, proposed: Law) -> bool:
    """Whether all sites of a proposed law are right, or equivalent by geometry."""
    return all(any(place.startswith(site) for site in law.sites) for place in proposed.acts_on)


def error_at(f: Fit, fresh: Campaign) -> float:
    """Return the rms error at fresh readings over the rms of their noise."""
    w = whitening(fresh.readings, f.mode)
    prediction = f.model.predict(fresh.readings.states, f.theta)
    error = residual(fresh.readings, prediction, w)[:, :3]
    noise = w.raw(fresh.noise)[:, :3]
    return float(np.sqrt(np.sum(error**2) / np.sum(noise**2)))
