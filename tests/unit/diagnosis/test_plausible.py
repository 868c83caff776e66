"""Suspects must be of plausible size, and keep what their linearisation promises."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.config import load_config
from hilcal.diagnosis.effect_ranking import (
    LEAST_KEPT,
    candidates,
    kept_by_refit,
    kept_by_step,
    most,
    rank_suspects,
    unloaded_readings,
)
from hilcal.diagnosis.stepwise import add
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.catalogue import BUILT_IN
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.effect_columns import effect_columns
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import linearise
from hilcal.present.verdict import message
from studies.study_cases import study_case
from tests.support.campaigns import campaign, configuration
from tests.support.paths import ROOT

SECOND_ORDER = {"link_geometry", "encoder_offset", "joint_coupling", "link_mass"}


def unmodelled(law: str, robot: str) -> Fit:
    case = study_case(
        load_config(ROOT / "configs/cells/demo_ur10e.toml"),
        robot,
        "deflection",
        (law,),
        3.0,
        seed=0,
    )
    return fit(baseline(case.cell, case.readings, "deflection"), case.readings, "deflection")


@pytest.mark.parametrize(
    ("law", "robot"), [("crosswise compliance", "ur5e"), ("compliance by another joint", "ur10e")]
)
def test_no_error_of_second_order_is_named_for_deflections(law: str, robot: str) -> None:
    d = diagnose(unmodelled(law, robot))
    assert d.verdict == "unknown_effect"
    assert not SECOND_ORDER & set(d.significant)
    geometry = next(s for s in d.suspects if s.effect == "link_geometry")
    needed = {unit: rms for unit, rms, _ in geometry.needs}
    assert needed["m"] > 0.01 or needed["rad"] > 0.01
    assert "plausible" in message(d) or d.suspects[0].effect != "link_geometry"


def test_every_effect_that_ships_states_what_is_plausible() -> None:
    assert all(1.0 <= kind.plausible < np.inf for kind in BUILT_IN)


def test_the_cell_may_allow_more() -> None:
    c = campaign("none", "absolute", 1)
    found = fit(baseline(c.cell, c.readings, c.mode), c.readings, c.mode)

    def largest(factor: dict[str, float]) -> float:
        config = configuration().model_copy(update={"plausible": factor})
        cell = replace(found.model.cell, config=config)
        same = replace(found, model=replace(found.model, cell=cell))
        (e,) = (e for e in candidates(same) if e.name == "link_geometry")
        return e.most()

    assert largest({}) == pytest.approx(3.0)
    assert largest({"link_geometry": 4.0}) == pytest.approx(12.0)
    with pytest.raises(InputError, match=r"\[plausible\] gremlins: no such effect"):
        largest({"gremlins": 2.0})


def test_unloaded_readings_bound_what_geometry_may_do_to_deflections() -> None:
    """A geometry that is off by so much is allowed as much, and not ten times as much."""
    c = campaign("link_geometry", "absolute", 1, strength=10.0)
    found = fit(baseline(c.cell, c.readings, "deflection"), c.readings, "deflection")
    (e,) = (e for e in candidates(found) if e.name == "link_geometry")
    off = c.world.physics.link_geometry
    allowed = most(effect_columns(found, e), unloaded_readings(found))
    true = float(np.sqrt(np.mean((1e3 * off) ** 2)))
    assert true < allowed < 10 * true
    assert most(effect_columns(found, e), None) == pytest.approx(e.most())


@pytest.mark.parametrize("effect", ["link_geometry", "joint_tilt_compliance"])
def test_true_effects_keep_their_promise(effect: str) -> None:
    mode = "absolute" if effect == "link_geometry" else "deflection"
    c = campaign(effect, mode, 1)
    found = fit(baseline(c.cell, c.readings, c.mode), c.readings, c.mode)
    p = linearise(found)
    (s,) = rank_suspects(p, [e for e in candidates(found) if e.name == effect])
    (e,) = (e for e in candidates(found) if e.name == effect)
    assert s.passes
    assert s.plausible
    assert kept_by_step(p, effect_columns(found, e), s.score) == pytest.approx(1.0, abs=0.1)
    assert kept_by_refit(found, add(found, effect), s.score) == pytest.approx(1.0, abs=0.15)


def test_a_refit_that_changes_nothing_keeps_nothing() -> None:
    c = campaign("joint_tilt_compliance", "deflection", 1)
    found = fit(baseline(c.cell, c.readings, c.mode), c.readings, c.mode)
    p = linearise(found)
    (e,) = (e for e in candidates(found) if e.name == "joint_tilt_compliance")
    (s,) = rank_suspects(p, [e], refit=lambda before, effect: before)
    assert s.keeps
    assert kept_by_refit(found, found, s.score) == 0.0
    far = replace(s.score, step=100 * s.score.step)
    assert kept_by_step(p, effect_columns(found, e), far) < LEAST_KEPT
