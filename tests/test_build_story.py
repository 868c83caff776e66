"""The story of a refinement: base axes, the same readings in every revision, a straight suspect."""

from dataclasses import replace

import numpy as np
import pytest
from cli_cases import rehearsal

from drivers.simulated.rehearsal import Rehearsal
from hilcal.diagnose.verdict import diagnose
from hilcal.errors import InputError
from hilcal.identify.baseline import baseline
from hilcal.identify.everything import everything
from hilcal.identify.fit import fit
from hilcal.refine import add
from hilcal.report.build_story import Chapter, build_story, pose_numbers
from hilcal.report.story import Story, check
from hilcal.robot.chain import evaluate


def chapters_of(r: Rehearsal) -> list[Chapter]:
    first = fit(baseline(r.cell, r.readings, r.mode), r.readings, r.mode)
    second = add(first, r.hidden)
    return [
        Chapter(4, None, first, diagnose(first)),
        Chapter(5, r.hidden, second, diagnose(second)),
    ]


@pytest.fixture(scope="module")
def deflections() -> tuple[Rehearsal, Story]:
    r = rehearsal("hysteresis")
    return r, build_story(chapters_of(r))


@pytest.fixture(scope="module")
def positions() -> tuple[Rehearsal, Story]:
    r = rehearsal("encoder_offset")
    return r, build_story(chapters_of(r))


def test_a_story_holds_together(
    deflections: tuple[Rehearsal, Story], positions: tuple[Rehearsal, Story]
) -> None:
    for r, story in (deflections, positions):
        check(story)
        first, last = story.revisions
        assert (first.revision, last.revision) == (4, 5)
        assert (first.change, last.change) == ("", f"+ {r.hidden}")
        assert first.verdict == "missing_effect"
        assert last.verdict == "adequate"
        assert first.suspects[0].effect == r.hidden
        assert last.suspects == ()
        for revision in story.revisions:
            np.testing.assert_allclose(
                story.measured - revision.predicted, revision.residual, atol=1e-12
            )
        norm = np.mean(last.whitened_norm2)
        assert 2.3 < norm < 3.7  # three elements, only noise
        assert np.mean(first.whitened_norm2) > 2 * norm
        assert story.noise_floor_m == pytest.approx(
            np.sqrt(np.trace(story.covariance, axis1=1, axis2=2).mean())
        )


def test_vectors_are_in_base_axes(deflections: tuple[Rehearsal, Story]) -> None:
    r, story = deflections
    turned = np.swapaxes(r.world.registration[:3, :3], 0, 1)
    e = everything(chapters_of(r)[-1].fit)
    expected = e.whitening.raw(r.readings.value) @ turned.T
    # Deflections leave the base's turning open by what the closed form knows, some mrad.
    off = np.linalg.norm(story.measured - expected, axis=1)
    assert off.max() < 0.01 * np.linalg.norm(expected, axis=1).max()
    loads = np.array(story.load_names)
    down = story.measured[loads == "10kg", 2]
    assert (down < 0).all()  # a weight pulls down


def test_arrows_start_at_the_nominal_target(positions: tuple[Rehearsal, Story]) -> None:
    r, story = positions
    chain = evaluate(r.cell.arm, story.q)
    nominal = chain.point(r.cell.target[:3, 3])
    np.testing.assert_allclose(story.anchor, nominal, atol=1e-12)
    assert np.linalg.norm(story.measured - story.anchor, axis=1).max() < 0.01


def test_the_right_suspect_lies_on_the_line_of_slope_one(
    deflections: tuple[Rehearsal, Story], positions: tuple[Rehearsal, Story]
) -> None:
    for r, story in (deflections, positions):
        g = story.revisions[0].regressor
        assert g is not None
        assert r.hidden in g.x_label
        slope = float(g.x @ g.y / (g.x @ g.x))
        assert slope == pytest.approx(1.0, abs=0.1)
        left = g.y - g.x
        assert np.mean(left**2) < 0.25 * np.mean(g.y**2)
        assert (g.x > 0).any()
        assert (g.x < 0).any()
        assert story.revisions[-1].regressor is None


def test_gross_errors_are_shown_as_well() -> None:
    r = rehearsal("nothing")
    value = r.readings.value.copy()
    value[17] += 0.004
    readings = replace(r.readings, value=value)
    found = fit(baseline(r.cell, readings, "absolute"), readings, "absolute")
    assert found.outlier.any()
    story = build_story([Chapter(1, None, found, None)])
    check(story)
    assert len(story) == len(readings)
    assert int(np.argmax(story.revisions[0].whitened_norm2)) == 17


def test_other_readings_do_not_make_one_story() -> None:
    r = rehearsal("nothing")
    model = baseline(r.cell, r.readings, "absolute")
    one = fit(model, r.readings, "absolute")
    two = fit(baseline(r.cell, r.readings, "deflection"), r.readings, "deflection")
    with pytest.raises(InputError, match="other readings"):
        build_story([Chapter(1, None, one, None), Chapter(2, None, two, None)])
    with pytest.raises(InputError, match="identify"):
        build_story([])


def test_poses_keep_the_numbers_of_their_names() -> None:
    assert pose_numbers(("p3", "p12")).tolist() == [3, 12]
    assert pose_numbers(("row 534", "row 7")).tolist() == [534, 7]
    assert pose_numbers(("a", "b")).tolist() == [1, 2]
    assert pose_numbers(("a1", "b1")).tolist() == [1, 2]
    assert pose_numbers(("p" + "9" * 30, "p1")).tolist() == [1, 2]
