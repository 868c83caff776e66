"""Without a hidden effect p-values are uniform, in all that makes a real campaign irregular."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest, poisson, wishart

from hilcal.diagnosis.effect_ranking import candidates, rank_suspects
from hilcal.diagnosis.misfit_breakdown import misfit_breakdown
from hilcal.diagnosis.stepwise import add
from hilcal.effects.catalogue import installed
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import linearise
from hilcal.readings.covariance import PRIOR_REPEATS
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import MODES
from tests.support.campaigns import NO_EFFECT, campaign
from tests.support.rows import first

SAMPLES = 5
"""Readings of the tracker that are averaged, from whose scatter a covariance is estimated."""
IN_THE_MODEL = {"absolute": ("hysteresis", "encoder_offset"), "deflection": ("backlash",)}


def estimated(readings: Readings, rng: np.random.Generator) -> Readings:
    """The covariances as a run estimates them: what is stated, and the scatter of few samples."""
    m, repeats = readings.m, SAMPLES - 1
    drawn = [wishart.rvs(repeats, v, random_state=rng) for v in readings.covariance]
    shrunk = (PRIOR_REPEATS * readings.covariance + np.array(drawn)) / (PRIOR_REPEATS + repeats)
    assert shrunk.shape[1:] == (m, m)
    return replace(readings, covariance=shrunk)


def unequal(readings: Readings, rng: np.random.Generator) -> Readings:
    """Some loaded readings are missing, and others were taken twice (but not of one noise)."""
    loaded = np.flatnonzero(~readings.unloaded)
    drop = rng.choice(loaded, len(loaded) // 3, replace=False)
    return readings[np.setdiff1d(np.arange(len(readings)), drop)]


def p_values(kind: str, mode: str, seeds: range) -> dict[str, list[float]]:
    out: dict[str, list[float]] = {}
    for seed in seeds:
        c = campaign(NO_EFFECT, mode, seed, poses=14, plan_seed=3, registration_known=True)
        rng = np.random.default_rng([seed, 77])
        readings = c.readings
        if kind == "estimated covariances":
            readings = estimated(readings, rng)
        elif kind == "unequal numbers":
            readings = unequal(readings, rng)
        fitted = fit(baseline(c.cell, readings, mode), readings, mode)
        if kind == "several effects":
            for name in IN_THE_MODEL[mode]:
                fitted = add(fitted, name)
        p = linearise(fitted)
        for s in rank_suspects(p, candidates(p.fit)):
            if s.score.rank:
                out.setdefault(s.effect, []).append(s.score.p_value)
        for v in misfit_breakdown(p):
            if "direction" not in v.variable:
                out.setdefault(f"where {v.variable}", []).append(v.p_value)
    return out


def check(kind: str, mode: str, count: int) -> None:
    uniform = p_values(kind, mode, range(count))
    assert len(uniform) > len(installed().names) // 2
    for effect, p in uniform.items():
        assert len(p) > 0.8 * count, effect
        # Families are tested one by one, about a hundred over all cases: one in 1e5 each.
        assert kstest(p, "uniform").pvalue > 1e-5, (effect, np.round(sorted(p)[:5], 4))
    suspects = [np.array(p) for name, p in uniform.items() if not name.startswith("where")]
    least = np.min([p[: min(map(len, suspects))] for p in suspects], axis=0)
    alarms = int(np.sum(least * len(suspects) < 1e-2))  # any effect named, one in a hundred
    assert alarms <= poisson.isf(1e-3, 1e-2 * len(least))
    every = np.concatenate(suspects)
    # Of one campaign they depend on each other: as if there were five independent families.
    for level in (0.05, 0.2, 0.5):
        spread = np.sqrt(level * (1 - level) / (5 * count))
        assert abs(np.mean(every < level) - level) < 4 * spread, level


KINDS = ("estimated covariances", "unequal numbers", "several effects", "as stated")


@pytest.mark.parametrize(
    ("kind", "mode"),
    first(0, list(zip(KINDS, ("absolute", "deflection", "deflection", "absolute"), strict=True))),
)
def test_p_values_are_uniform(kind, mode):
    """Each kind in one mode; both modes over many campaigns in the slow suite."""
    check(kind, mode, 12 if kind == "several effects" else 24)


@pytest.mark.slow
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", KINDS)
def test_p_values_are_uniform_over_many_campaigns(kind, mode):
    check(kind, mode, 300)
