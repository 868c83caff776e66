"""The sizes of effects that a type of arm has, from arms whose true sizes are known."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig
from hilcal.identification.baseline import baseline
from hilcal.identification.mixed_fit import mixed_fit, with_all_effects
from hilcal.mixed.families import families_of
from hilcal.model.model import Model
from hilcal.present.comparison import size_lines
from hilcal.transfer.members import evidence_of, type_sizes
from studies.random_descriptions import readings_of

TRUTH = {"transmission_error": 0.1, "link_geometry": 0.3}
"""Sizes of the type, in those of other arms; 1 of all other effects."""
NOISE_M, ARM, FAMILY = 2e-5, 0.5, 0.5
"""Noise of a reading; how far arms and families scatter about them, in log s."""


def cell_of(ordinary):
    tool = {"target_m": [0.05, 0.02, 0.1], "mass_kg": 1.0, "com_m": [0.0, 0.0, 0.04]}
    section = {"robot": {"model": "ur10e"}, "tool": tool, "ordinary": ordinary}
    return cell_from_config(CellConfig.model_validate(section))


def measured(cell, poses, rng):
    """Readings of one arm of the type."""
    q = rng.uniform(-2.5, 2.5, (poses, 6))
    plain = readings_of(q, np.zeros((poses, 3)), np.full(3, NOISE_M))
    model = with_all_effects(
        baseline(cell_of({}), at_nominal(cell, plain), "absolute"), plain.states
    )
    theta, arm = np.zeros(model.size), ARM * rng.standard_normal()
    for f in families_of(model).random:
        log_std = f.prior.mean + np.log(TRUTH.get(f.effect, 1.0)) + arm
        size = np.exp(log_std + FAMILY * rng.standard_normal())
        theta[f.parameters] = size * f.magnitude * rng.standard_normal(len(f.parameters))
    value = model.predict(plain.states, theta).observation.position
    value = value + NOISE_M * rng.standard_normal(value.shape)
    return replace(plain, value=value, scatter_stated=True)


def at_nominal(cell, of):
    """Readings as the arm without any effect would give them, with their noise."""
    exact = Model(cell, ()).predict(of.states, np.zeros(0)).observation.position
    return replace(of, value=exact + NOISE_M * np.random.default_rng(0).normal(size=exact.shape))


def sizes_told(ordinary):
    """Sizes by five arms of a type, whose cell states `ordinary`."""
    cell, evidence = cell_of(ordinary), []
    for arm in range(5):
        readings = measured(cell, 30, np.random.default_rng([arm, 7]))
        mixed = mixed_fit(baseline(cell, readings, "absolute"), readings, "absolute")
        evidence.append(evidence_of(mixed.variances, ordinary))
    return type_sizes(evidence)


@pytest.fixture(scope="module")
def sizes():
    return {s.effect: s for s in sizes_told({})}


def test_the_sizes_of_a_type_are_in_their_intervals(sizes):
    truth = np.array([TRUTH.get(name, 1.0) for name in sizes])
    low, high = (np.array([getattr(s, end) for s in sizes.values()]) for end in ("low", "high"))
    assert np.mean((low < truth) & (truth < high)) >= 0.9
    assert sizes["transmission_error"].differs
    assert sizes["transmission_error"].factor < 0.4
    assert high[truth == 1.0].max() > 2.0  # what no campaign tells stays open


@pytest.mark.long
def test_what_a_cell_says_already_does_not_count_twice(sizes):
    for s in sizes_told(TRUTH):
        assert s.factor == pytest.approx(sizes[s.effect].factor, rel=0.5)


def test_no_campaign_tells_nothing():
    assert type_sizes([]) == ()


def test_the_section_can_be_copied_into_a_cell(sizes):
    heading, *section = size_lines(tuple(sizes.values()))
    assert "another arm of this type" in heading
    ordinary = tomllib.loads("\n".join(map(str, section)))["ordinary"]
    assert cell_of(ordinary).configured().ordinary == ordinary
    assert ordinary["transmission_error"] == pytest.approx(
        sizes["transmission_error"].factor, rel=0.1
    )
