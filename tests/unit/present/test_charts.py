"""The values that charts draw are those of the fit, the diagnosis or the story."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hilcal import numbers
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.background import FamilySize
from hilcal.present import charts
from hilcal.present.document import description_of
from hilcal.present.story import LEVEL_NAMES, regressor, round_factor
from tests.support.campaigns import campaign
from tests.support.fit_cases import fitted_model
from tests.support.observer_cases import base_cell, observed, stated
from tests.support.picture import contrast
from tests.support.viewer_story import ANGLE, LOAD, story


@cache
def judged():
    made = campaign("joint_tilt_compliance", "deflection", poses=12, strength=6.0)
    return diagnose(fitted_model(made.cell, made.readings, made.mode))


@pytest.fixture(scope="module")
def example_story():
    return story()


@pytest.fixture
def first(example_story):
    return example_story, example_story.revisions[0]


def points(figure, axis):
    """Sorted values of the points that have a name."""
    values = [np.asarray(getattr(t, axis), float) for t in figure.data if t.text]
    return np.sort(np.concatenate(values))


def test_each_revision_has_a_bar_for_both_errors_and_the_noise_is_shown(example_story):
    figure = charts.error_per_revision(example_story)
    for trace, key in zip(figure.data[:2], ("error", "holdout"), strict=True):
        rms = [1e6 * getattr(r, key).rms_m for r in example_story.revisions]
        np.testing.assert_allclose(np.asarray(trace.x), rms)
        assert list(trace.text) == [numbers.digits(v) for v in rms]
    (floor,) = figure.layout.shapes
    assert floor.x0 == pytest.approx(1e6 * example_story.noise_floor_m)
    assert description_of(figure).startswith("The rms error fell from")


@pytest.mark.parametrize("mode", ["deflection", "absolute"])
def test_measured_over_predicted_differs_by_the_residual(mode):
    example_story = story(mode=mode)
    r = example_story.revisions[0]
    line, *axes = charts.measured_predicted(example_story, r).data
    assert line.name == "exact"
    for k, trace in enumerate(axes):
        off = np.asarray(trace.y, float) - np.asarray(trace.x, float)
        np.testing.assert_allclose(off, 1e6 * r.residual[:, k], atol=1e-3)


def test_residuals_are_mahalanobis_distances_with_their_names_colours_and_marks(first):
    example_story, r = first
    timed = replace(example_story, time_s=60.0 * np.arange(len(example_story)))
    by_joint = charts.residual_by_joint(example_story, r, 1)
    limits = (0.0, *charts.sigma_limits(3), np.inf)
    for figure in (
        charts.residual_by_pose(example_story, r),
        charts.residual_by_load(example_story, r),
        by_joint,
        charts.residual_by_time(example_story, r),
        charts.residual_by_time(timed, r),
    ):
        np.testing.assert_allclose(points(figure, "y"), np.sort(r.sigma), rtol=1e-6)
        assert description_of(figure)
        for trace in figure.data:
            k, y = LEVEL_NAMES.index(trace.name), np.asarray(trace.y, float)
            assert (trace.marker.color, trace.marker.symbol) == (
                charts.LEVELS[k],
                charts.SYMBOLS[k],
            )
            assert ((y >= limits[k] - 1e-5) & (y <= limits[k + 1] + 1e-5)).all()
    np.testing.assert_allclose(
        points(by_joint, "x"), np.sort(np.degrees(example_story.q[:, 1])), rtol=1e-6
    )
    worst = int(np.argmax(r.whitened_norm2))
    size = 1e6 * np.linalg.norm(r.residual[worst])
    name = f"{example_story.pose_name(worst)}, {example_story.load_names[worst]}: {size:.0f} µm"
    assert any(text.startswith(name) for trace in by_joint.data for text in trace.text)


def test_a_distance_has_one_element(first):
    """The rms in σ, the levels and the limit lines are those of readings with one element."""
    example_story, r = first
    one = replace(r, elements=np.ones(len(example_story), dtype=int))
    assert one.level.sum() > r.level.sum()
    figure = charts.residual_by_load(example_story, one)
    rms = np.sqrt([np.mean(one.whitened_norm2[of]) for of in _by_load(example_story)])
    assert f"with {numbers.digits(max(rms), 2)} times the noise rms" in description_of(figure)
    lines = [shape.y0 for shape in figure.layout.shapes]
    np.testing.assert_allclose(lines, [2.5758, 3.8906], atol=1e-4)  # of a normal distribution


def test_gross_errors_are_drawn_and_in_no_sentence(first):
    example_story, r = first
    off = np.arange(len(example_story)) == 3
    measured, norm2 = example_story.measured + off[:, None], np.where(off, 1e8, r.whitened_norm2)
    wrong = replace(r, residual=r.residual + off[:, None], whitened_norm2=norm2)
    story = replace(example_story, measured=measured, set_aside=off)
    for draw in (charts.residual_by_pose, charts.residual_by_load):
        figure = draw(story, wrong)
        assert points(figure, "y").max() == pytest.approx(1e4)
        assert not re.search(r"\d{3,} times", description_of(figure))
    share = re.search(r"for ([0-9.]+) %", description_of(charts.measured_predicted(story, wrong)))
    before = re.search(
        r"for ([0-9.]+) %", description_of(charts.measured_predicted(example_story, r))
    )
    assert float(share[1]) == pytest.approx(float(before[1]), abs=2.0)


def _by_load(example_story):
    return [np.array(example_story.load_names) == name for name in set(example_story.load_names)]


@pytest.mark.parametrize("plane", ["xy", "xz"])
def test_arrows_are_the_residuals_enlarged(plane, first):
    example_story, r = first
    largest = float(r.size_m.max())
    times = round_factor(charts.LONGEST / largest, (1, 2, 5))
    assert 0.4 * charts.LONGEST <= times * largest <= charts.LONGEST
    lengths = []
    for trace in charts.workspace(example_story, r, plane).data:
        if trace.mode == "lines":
            xy = np.stack([np.asarray(getattr(trace, a), float) for a in "xy"], 1)
            lengths.append(np.linalg.norm(xy[1::3] - xy[::3], axis=1))
    in_plane = r.residual[:, ["xyz".index(a) for a in plane]]
    expected = np.sort(times * np.linalg.norm(in_plane, axis=1))
    np.testing.assert_allclose(np.sort(np.concatenate(lengths)), expected, atol=1e-6)


def test_of_very_many_readings_the_worst_are_drawn_and_it_is_said():
    example_story = story(poses=100)
    r = example_story.revisions[0]
    some = charts.chart_readings(example_story, r, max_points=50)
    assert set(np.argsort(-r.whitened_norm2)[:10]) <= set(some.index.tolist())
    assert len(some.index) == 50
    assert "Of 300 readings 50 are drawn" in some.note


def test_a_pose_named_like_markup_stays_text():
    example_story = story(names="<script>alert(1)</script>")
    figure = charts.residual_by_load(example_story, example_story.revisions[0])
    words = [*figure.layout.xaxis.ticktext, *(n for t in figure.data for n in t.text)]
    assert words
    assert not any("<" in w for w in words)


def test_an_added_variable_plot_shows_its_slope():
    d = judged()
    variable = regressor(d.fit, d.suspects[0])
    figure = charts.added_variable(variable, "joint_tilt_compliance")
    assert np.polyfit(variable.x, variable.y, 1)[0] == pytest.approx(1.0, abs=0.2)
    assert (
        f"slope {float(variable.x @ variable.y / (variable.x @ variable.x)):.2f}"
        in description_of(figure)
    )
    np.testing.assert_allclose(np.asarray(figure.data[0].y, float), variable.y, atol=1e-3)


def test_shares_and_curves_of_the_misfit():
    d = judged()
    (bar,) = charts.misfit_shares(d).data
    shares = [100 * v.share for v in d.misfit_breakdown if v.share >= 0.01][:12]
    np.testing.assert_allclose(np.asarray(bar.x, float), shares)
    for curve in (ANGLE, LOAD):
        (trace,) = charts.curve_chart(curve).data
        np.testing.assert_allclose(np.asarray(trace.y, float), curve.y)
        np.testing.assert_allclose(np.asarray(trace.error_y.array, float), curve.error)


def test_correlations_are_those_of_the_normal_equations():
    f = judged().fit
    names, of = charts.parameter_correlations(f)
    assert set(names) == {p.name for p in f.parameters if p.identifiable}
    np.testing.assert_allclose(np.diag(of), 1.0)
    np.testing.assert_allclose(of, of.T)
    # The same from a Jacobian by differences of the predictions, over the determined parameters;
    # the frame, which deflections hardly determine, is held here and not in the fit.
    scale = {f"{e.name}.{p.name}": p.scale for e in f.model.effects for p in e.parameters}
    every, columns = list(scale), []
    for name in names:
        step = np.zeros(len(every))
        step[every.index(name)] = 1e-3 * scale[name]
        ends = [f.model.predict(f.readings.states, f.theta + s * step) for s in (1, -1)]
        moved = (ends[0].observation.position - ends[1].observation.position) / 2e-3
        columns.append(f.fitted.whiten(f.fitted.raw(moved)).reshape(-1))
    inverse = np.linalg.inv(np.stack(columns, 1).T @ np.stack(columns, 1))
    std = np.sqrt(np.diag(inverse))
    np.testing.assert_allclose(of, inverse / np.outer(std, std), atol=0.05)
    (heat,) = charts.correlations(f).data
    assert np.asarray(heat.z).shape == (min(len(names), 30),) * 2


def test_the_noise_check_counts_every_element():
    f = judged().fit
    bar, normal = charts.noise_check(f).data
    assert int(np.sum(bar.y)) == len(f.white)
    step, width = float(normal.x[1] - normal.x[0]), float(bar.x[1] - bar.x[0])
    assert np.sum(normal.y) * step == pytest.approx(width * len(f.white), rel=1e-3)
    assert "larger than the stated noise" in description_of(charts.noise_check(f))


def test_the_noise_check_of_distances_counts_what_is_read():
    c = observed(["A"], 2, poses=8, cell=base_cell(stated("A")), base=True)
    f = fitted_model(c.cell, c.readings, "deflection")
    chart = charts.noise_check(f)
    assert int(np.sum(chart.data[0].y)) == len(f.raw) == f.whitening.rank
    assert f"of {len(f.raw)} elements" in description_of(chart)


def test_the_middle_of_a_variable_has_no_negative_zero(first):
    example_story, r = first
    values = np.linspace(-50.0, 50.0, len(example_story)) - 0.01
    assert " up to 0.0°" in description_of(
        charts.residual_over(example_story, r, values, "angle", "°")
    )


def test_a_long_name_of_a_load_is_shortened_at_the_axis(first):
    example_story, r = first
    names = tuple(f"a load that is pulled to the side, {name}" for name in example_story.load_names)
    ticks = charts.residual_by_load(
        replace(example_story, load_names=names), r
    ).layout.xaxis.ticktext
    assert all(t.startswith("…") and len(t) == charts.LONGEST_NAME for t in ticks)


@pytest.mark.parametrize("color", [charts.MEASURED, charts.NOISE, charts.HOLDOUT, *charts.LEVELS])
@pytest.mark.parametrize("paper", [charts.LIGHT, charts.DARK])
def test_colours_stand_out_on_both_papers(color, paper):
    rgb = (tuple(bytes.fromhex(c.removeprefix("#"))) for c in (color, paper))
    assert contrast(*rgb) >= 3.0


def test_a_scheme_changes_the_look_and_nothing_else(example_story):
    figure = charts.error_per_revision(example_story)
    dark = charts.in_scheme(figure, dark=True)
    assert dark.layout.template.layout.font.color != figure.layout.template.layout.font.color
    assert (dark.data, description_of(dark)) == (figure.data, description_of(figure))


def test_the_sizes_of_families_are_drawn_by_those_of_an_ordinary_arm_with_their_intervals():
    sizes = [
        FamilySize(f"f{k}", f"f{k}", k == 0, 2.0, 1.0, 6.0, 4.0, "rad", 1e-3 / (k + 1))
        for k in range(charts.MOST_FAMILIES + 3)
    ]
    figure = charts.family_sizes(sizes)
    named, other = figure.data
    assert [*named.y, *other.y] == [s.name for s in sizes[: charts.MOST_FAMILIES]]
    for trace in figure.data:
        np.testing.assert_allclose(trace.x, 0.5)
        np.testing.assert_allclose(trace.x + trace.error_x.array, 1.5)
        np.testing.assert_allclose(trace.x - trace.error_x.arrayminus, 0.25)
    assert figure.layout.yaxis.categoryarray[-1] == "f0"  # on top
    assert "f0 moves the target most, by 1.00 mm rms" in description_of(figure)
    assert f"The {charts.MOST_FAMILIES} of {charts.MOST_FAMILIES + 3} families" in description_of(
        figure
    )
