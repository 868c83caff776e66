"""Where no load was hung, an effect of the load is named only where gravity tells of it."""

from dataclasses import replace

import numpy as np

from hilcal.diagnosis.effect_ranking import (
    beyond_geometry,
    candidates,
    geometry_columns,
    rank_suspects,
    through_load,
)
from hilcal.identification.baseline import baseline
from hilcal.identification.effect_columns import effect_columns
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import linearise
from tests.support.campaigns import campaign, measured, plan

POSES = 30


def without_loads(seed: int, stiff: bool) -> Fit:
    """Unloaded readings of an arm whose geometry is off, as compliant as any or hardly so."""
    c = campaign("link_geometry", "absolute", seed, plan_seed=0, poses=POSES, strength=10.0)
    world, r = c.world, c.readings
    if stiff:
        given = world.physics.joint_compliance
        world = replace(world, physics=world.physics.with_effect("joint_compliance", 1e-6 * given))
        r = measured(world, plan(POSES, 0), np.random.default_rng(seed))
    r = r[r.load == 0]
    return fit(baseline(c.cell, r, "absolute"), r, "absolute")


def test_a_stiff_arm_with_a_wrong_geometry_is_not_compliant() -> None:
    for seed in range(2):
        found = without_loads(seed, stiff=True)
        p = linearise(found)
        effects = candidates(found)
        elastic = {e.name for e in effects if through_load(e)}
        assert {"joint_compliance", "link_mass", "load_point"} <= elastic
        assert not {"link_geometry", "transmission_error", "hysteresis"} & elastic
        assert not elastic & {s.effect for s in rank_suspects(p, effects) if s.passes}
        geometry = geometry_columns(p, effects)
        for e in effects:
            if e.name in elastic:
                assert not beyond_geometry(p, effect_columns(found, e), geometry, 3.0), e.name


def test_gravity_tells_of_a_compliant_arm() -> None:
    found = without_loads(0, stiff=False)
    p, effects = linearise(found), candidates(found)
    (e,) = (e for e in effects if e.name == "joint_compliance")
    assert beyond_geometry(p, effect_columns(found, e), geometry_columns(p, effects), 3.0)
    assert "joint_compliance" in {s.effect for s in rank_suspects(p, effects) if s.passes}
