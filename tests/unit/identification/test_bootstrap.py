"""The bootstrap of whole poses: its spread, its bits, what it notices and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.engine.engine import open_engine
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.bootstrap import Bootstrap, again, bootstrap
from hilcal.identification.fit import Fit, fit
from hilcal.identification.folds import distinct_poses
from hilcal.present.calibration import bootstrap_remarks
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import whitening
from tests.support.campaigns import campaign, noiseless, plan, with_noise

POSES = 40
COMPLIANCE = slice(6, 12)  # behind the base's frame


def fitted(readings: Readings | None = None, poses: int = POSES) -> Fit:
    c = campaign("none", "absolute", poses=poses)
    given = c.readings if readings is None else readings
    return fit(baseline(c.cell, given, "absolute"), given, "absolute")


def drawn(found: Fit, draws: int = 100, seed: int = 0) -> Bootstrap:
    with open_engine(1) as engine:
        return bootstrap(found, engine, draws, seed)


@pytest.mark.long
def test_its_spread_is_that_of_repeated_campaigns() -> None:
    c = campaign("none", "absolute", poses=POSES)
    clean = noiseless(c.world, plan(POSES, 1000))
    repeated = [fitted(with_noise(clean, np.random.default_rng(s))) for s in range(40)]
    true = np.std([f.theta[COMPLIANCE] for f in repeated], axis=0, ddof=1)
    ratios = [drawn(f, 60).std[COMPLIANCE] / true for f in repeated[:3]]
    # 18 ratios, each known to some 18 %, those of one parameter with a common 11 %
    assert 0.85 < np.exp(np.mean(np.log(ratios))) < 1.15


def in_common(clean: Readings, seed: int) -> Readings:
    """Noise of the stated size that all readings of a pose have in common."""
    rng = np.random.default_rng(seed)
    normal = rng.standard_normal((int(clean.pose.max()) + 1, clean.m))[clean.pose]
    root = np.linalg.cholesky(clean.covariance)
    return replace(clean, value=clean.value + np.einsum("nij,nj->ni", root, normal))


@pytest.mark.long
def test_it_notices_readings_of_a_pose_that_are_not_independent() -> None:
    c = campaign("none", "absolute", poses=POSES)
    clean = noiseless(c.world, plan(POSES, 1000))
    frames = slice(0, 6)
    found = [drawn(fitted(in_common(clean, s)), 50) for s in range(2)]
    assert not any(b.fit.uncertainty.inflated for b in found)
    loads = len(clean) / POSES
    # the formal uncertainty is too small by the root of the readings that a pose has
    ratio = np.median([b.ratio[frames] for b in found])
    assert 0.75 * np.sqrt(loads) < ratio < 1.25 * np.sqrt(loads)
    assert any("Stated too small" in line for line in bootstrap_remarks(found[0]))
    crowded = replace(found[0], poses=20)  # for as many parameters
    assert any("does not show that the stated ones" in line for line in bootstrap_remarks(crowded))
    independent = drawn(fitted(), 50)
    assert any("can be used" in line for line in bootstrap_remarks(independent))


@pytest.mark.long
def test_the_bits_depend_on_the_seed_and_not_on_the_workers() -> None:
    found = fitted(poses=12)
    one = drawn(found, 23)
    told: list[int] = []
    with open_engine(2) as engine:
        two = bootstrap(found, engine, 23, advance=told.append)
    assert sum(told) == 23
    assert one.theta.shape == (23, found.model.size)
    np.testing.assert_array_equal(one.theta, two.theta)
    # the first draws are the same however many are asked for
    np.testing.assert_array_equal(drawn(found, 20).theta, one.theta[:20])
    assert not np.array_equal(drawn(found, 20, seed=1).theta, one.theta[:20])


def test_a_draw_has_whole_poses_each_copy_with_its_own_unloaded_reading() -> None:
    readings = campaign("none", "deflection", poses=12).readings
    group = distinct_poses(readings)
    found = again(readings, group, np.random.default_rng(4))
    size = len(readings) // 12
    count = np.bincount(found.pose)
    assert len(count) == 12
    assert (count == size).all()
    assert len(found.pose_names) == 12
    assert len(set(found.pose_names)) < 12  # some are drawn twice
    for k, name in enumerate(found.pose_names):
        of = readings.pose == readings.pose_names.index(name)
        np.testing.assert_array_equal(found.value[found.pose == k], readings.value[of])
    assert len(whitening(found, "deflection")) == 12 * (size - 1)


def test_two_names_of_one_pose_are_drawn_together() -> None:
    readings = campaign("none", "deflection", poses=12).readings
    twice = Readings.joined([readings, replace(readings, pose=readings.pose + 12)])
    twice = replace(twice, pose_names=tuple(f"p{k}" for k in range(24)))
    found = again(twice, distinct_poses(twice), np.random.default_rng(4))
    names = set(found.pose_names)
    assert {f"p{(int(n[1:]) + 12) % 24}" for n in names} == names


def test_what_it_refuses() -> None:
    found = fitted(poses=12)
    with open_engine(1) as engine:
        with pytest.raises(InputError, match="draws 5, seed 0; valid: at least 20"):
            bootstrap(found, engine, 5)
        few = fitted(poses=8)
        with pytest.raises(CannotAnswerError, match=r"8 distinct poses .* at least 10"):
            bootstrap(few, engine)
    with pytest.raises(InputError, match="level 2; valid: between 0 and 1"):
        drawn(found, 20).interval(2)


def test_its_document_says_which_parameters_are_compared() -> None:
    c = campaign("transmission_error", "absolute", poses=20)
    model = baseline(c.cell, c.readings, "absolute")
    found = drawn(fit(model, c.readings, "absolute"), 20)
    document = found.to_dict()
    rows = document["parameters"]
    assert isinstance(rows, list)
    assert [r["name"] for r in rows][:2] == ["base_frame.x", "base_frame.y"]
    for r in rows:
        assert r["interval"][0] <= r["interval"][1]
        if r["ratio"] is not None:
            assert r["ratio"] == pytest.approx(r["bootstrap_std"] / r["std"])
    assert found.fit.uncertainty.inflated
    assert any("larger than the noise" in line for line in bootstrap_remarks(found))
