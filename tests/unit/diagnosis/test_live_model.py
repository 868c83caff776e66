"""What an operator is told of each reading while a campaign is measured."""

from functools import cache

import numpy as np
import pytest

from hilcal.diagnosis.live_model import LiveModel
from hilcal.measuring.progress import LiveResidual, ReadingStored
from hilcal.present.progress import reading_text
from hilcal.store.plan import Step
from tests.support.campaigns import campaign, cell_of, configuration

SEEDS = range(5)


def quiet():
    """The demo's cell, for readings whose covariances count the arm's repeatability already."""
    config = configuration()
    scatter = config.repeatability.model_copy(update={"joint_std_rad": 0.0})
    return config.model_copy(update={"repeatability": scatter})


@cache
def judgements(seed):
    """Of each reading: its judgement, itself, its distance from the first unloaded one of its pose.

    The order is load by load; half of the unloaded readings come last, as in a plan against drift.
    """
    c = campaign(seed=seed, poses=16)
    late = c.readings.unloaded & (c.readings.pose % 2 == 1)
    order = np.lexsort((c.readings.pose, c.readings.load, late))
    readings = c.readings[order]
    live = LiveModel(cell_of().with_config(quiet()))
    out = []
    for k in range(len(readings)):
        same = (readings.pose == readings.pose[k]) & readings.unloaded
        moved = readings.value[k, :3] - readings.value[same][0, :3]
        out.append((live(readings[: k + 1]), readings[k : k + 1], float(np.linalg.norm(moved))))
    return out


@pytest.mark.long
def test_sigma_is_about_one_from_the_first_reading_on_where_the_model_is_right():
    early, late, first_loads, unsure = [], [], [], 0
    for seed in SEEDS:
        pairs = [(j, r) for j, r, _ in judgements(seed) if j.sigma is not None]
        known = [j for j, _ in pairs]
        first_loads += [j.sigma for j, r in pairs if not r.unloaded[0]][:12]
        assert not any(j.uncertain for j in known[-12:])
        unsure += sum(j.uncertain for j in known[:12])
        early += [j.sigma for j in known[:12]]
        late += [j.sigma for j in known[-12:]]
    # 60 readings of 3 elements: the mean square scatters by sqrt(2/180) = 0.1 and somewhat more,
    # as readings that share one fit err together.
    assert unsure > 0
    for sigmas in (early, late, first_loads):
        assert 0.6 < np.mean(np.square(sigmas)) < 1.5


@pytest.mark.long
def test_a_deflection_is_told_for_every_load_once_there_is_a_model():
    off = []
    for seed in SEEDS:
        begun = False
        for judged, reading, true in judgements(seed):
            begun = begun or judged.deflection is not None
            if reading.unloaded[0]:
                assert judged.deflection is None
            elif begun:
                off.append((judged.deflection - true) / judged.deflection_std)
    assert len(off) == len(SEEDS) * 16 * 4
    # Lengths err by less than the vectors do, of which `give` is the standard deviation.
    assert 0.2 < np.sqrt(np.mean(np.square(off))) < 1.2


@pytest.mark.long
def test_nothing_is_told_before_there_are_poses_to_learn_from():
    judged = [j for j, _, _ in judgements(0)[:7]]
    assert judged == [LiveResidual()] * len(judged)


def test_words_tell_what_is_measured_from_what_is_inferred():
    def words(**more):
        return reading_text(ReadingStored(Step("p1", "5kg", 0), 1, 2, 0.0, **more))

    assert words() == ""
    residual = LiveResidual(50e-6, 1.04, False, 4.2138e-3, 52e-6)
    assert (
        words(deflection=4.2e-3, live=residual) == ": deflection 4.20 mm, residual 50.0 µm (1.0 σ)"
    )
    expected = ": deflection ≈ 4.214 ± 0.052 mm, residual 50.0 µm (1.0 σ)"
    assert words(live=residual) == expected
    learning = LiveResidual(2e-3, 0.8, True)
    assert words(live=learning) == ": residual 2.00 mm (0.8 σ, few readings yet)"
    assert (
        words(live=LiveResidual(deflection=3e-4, deflection_std=2e-5))
        == ": deflection ≈ 300 ± 20 µm"
    )
