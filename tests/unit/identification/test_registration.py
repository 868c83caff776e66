"""Where tracker and targets are; readings that do not fit the description, or of another arm."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hilcal.cell import cell_from_config
from hilcal.config import CellConfig, load_config
from hilcal.config.sections import Conventions
from hilcal.diagnosis.misfit_breakdown import misfit_breakdown
from hilcal.errors import CannotAnswerError
from hilcal.identification.baseline import baseline
from hilcal.identification.linearisation import linearise
from hilcal.identification.prediction.full_prediction import gross_errors
from hilcal.identification.registration.hypotheses import Description, Hypothesis
from hilcal.identification.registration.misdescription import (
    BEYOND_NOISE,
    examine,
    other_arm,
    other_arm_of,
)
from hilcal.identification.registration.registration import register
from hilcal.identification.registration.table_preview import clearly_best, rank_conventions
from hilcal.present.registration import registration_lines
from hilcal.readings.whitening import MODES
from hilcal.robot import se3
from hilcal.robot.arm import with_controller_conventions
from hilcal.robot.catalogue import load_arm, robot_names
from hilcal.robot.se3 import rotation_vector
from studies.random_descriptions import draw, judge, read, readings_of
from tests.support import foreign_tables
from tests.support.arm_cases import slots_of
from tests.support.campaigns import cell_of, configuration, plan
from tests.support.fit_cases import fitted_model
from tests.support.reflector_cases import OFFSETS, reflectors
from tests.support.refusals import refusal
from tests.support.rows import first

CELL = replace(cell_of(), target_known=False)
KNOWN = [(False, False), (False, True), (True, False), (True, True)]
EITHER = pytest.mark.parametrize("m", [3, 6])

angles = st.floats(-np.pi, np.pi)
turns = st.tuples(angles, angles, angles).map(lambda a: Rotation.from_euler("ZYX", a).as_matrix())
places = st.tuples(*[st.floats(-8.0, 8.0)] * 3).map(np.array)
offsets = st.tuples(*[st.floats(-0.3, 0.3)] * 3).map(np.array)


def pose_of(turn, place):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, place
    return pose


def at(*place):
    return pose_of(np.eye(3), place)


def poses(count=12):
    p = plan(count)
    return p.states.q[np.unique(p.pose, return_index=True)[1]]


def flanges_at(q):
    return np.array([slots_of(CELL.arm, each)[-1] for each in q])


def rigid_readings(registration, target, m, q=None, noise=0.0, seed=0):
    """Readings of the rigid arm, by products of homogeneous matrices."""
    q = poses() if q is None else q
    there = registration @ flanges_at(q) @ target
    rng = np.random.default_rng(seed)
    value = there[:, :3, 3] + noise * rng.normal(size=(len(q), 3))
    if m == 6:
        turned = Rotation.from_rotvec(noise * rng.normal(size=(len(q), 3)))
        value = np.hstack([value, (turned * Rotation.from_matrix(there[:, :3, :3])).as_rotvec()])
    return readings_of(q, value, np.full(m, 1e-5))


def cell_with_frames(registration, target, registration_known, target_known):
    """A cell that knows what it is said to know, and something wrong of the rest."""
    return replace(
        CELL,
        registration=registration if registration_known else np.eye(4),
        target=target if target_known else np.eye(4),
        registration_known=registration_known,
        target_known=target_known,
    )


def registered(readings, target=None):
    """Readings from an unknown base, of a target that is unknown unless given."""
    known = target is not None
    return register(
        cell_with_frames(np.eye(4), target if known else np.eye(4), False, known), readings
    )


@pytest.mark.parametrize("m", first(1, [6, 3]))
@pytest.mark.parametrize(("registration_known", "target_known"), KNOWN)
@given(turn=turns, place=places, tool=turns, offset=offsets)
def test_what_is_unknown_is_found_exactly(
    m, registration_known, target_known, turn, place, tool, offset
):
    registration, target = pose_of(turn, place), pose_of(tool, offset)
    cell = cell_with_frames(registration, target, registration_known, target_known)
    if m == 3 and not target_known:  # the target's axes cannot be seen in positions
        target = at(*offset)
    registered_cell = register(cell, rigid_readings(registration, target, m)).cell
    # Rounding of readings up to 14 m away, through a few well-conditioned systems; the
    # alternation for positions stops when it moves by less than 1e-12 m.
    np.testing.assert_allclose(registered_cell.registration, registration, rtol=0, atol=2e-9)
    np.testing.assert_allclose(registered_cell.target, target, rtol=0, atol=2e-9)


@EITHER
def test_too_few_poses_cannot_answer(m):
    for q in (poses()[:3], np.repeat(poses()[:3], 5, axis=0)):
        with pytest.raises(CannotAnswerError, match="3 distinct poses; measure at least 4"):
            registered(rigid_readings(at(1.0, 0.0, 0.0), np.eye(4), m, q))


@pytest.mark.parametrize("noise", [0.0, 1e-5])
def test_positions_on_a_line_or_in_one_point_cannot_answer(noise):
    """The last joint turns about the target; or about one tip on the first joint's axis."""
    line = np.repeat(poses()[:2], 3, axis=0)
    line[:, 5] += np.tile([0.0, 1.0, 2.0], 2)
    point = np.tile(np.array([0.0, -np.pi / 2, 0.1, -np.pi / 2, 0.2, 0.3]), (8, 1))
    point[:, 0] = np.linspace(-2, 2, 8)
    tip = np.linalg.inv(flanges_at(point)[0]) @ np.array([0.0, 0.0, 1.0, 1.0])
    for q, target in ((line, at(0.0, 0.0, 0.2)), (point, at(*tip[:3]))):
        with pytest.raises(CannotAnswerError, match="spread in space"):
            registered(rigid_readings(at(1.0, 0.0, 0.0), target, 3, q, noise), target)


BASE = pose_of(Rotation.from_rotvec([0.4, -0.2, 2.0]).as_matrix(), [0.4, -0.4, 1.9])
OFFSET = np.array([0.1, 0.05, 0.2])


def target_of(m):
    turn = Rotation.from_rotvec([0.3, -1.0, 0.6]).as_matrix() if m == 6 else np.eye(3)
    return pose_of(turn, OFFSET)


def pointing_down(count, jitter=0.0):
    """Poses of the UR10e whose tool has one orientation: q2 + q3 + q4 and q1 − q6 are constant."""
    rng = np.random.default_rng(3)
    q = np.empty((count, 6))
    q[:, 0], q[:, 1], q[:, 2] = rng.uniform([-0.8, -1.8, 0.8], [0.8, -1.0, 1.8], (count, 3)).T
    q[:, 3] = -np.pi / 2 - q[:, 1] - q[:, 2]
    q[:, 4], q[:, 5] = -np.pi / 2, q[:, 0]
    q[:, 3:] += jitter * rng.normal(size=(count, 3))
    return q


@EITHER
@pytest.mark.parametrize("noise", [0.0, 2e-5])
def test_one_orientation_registers_to_the_noise_and_holds_the_target(m, noise):
    result = registered(rigid_readings(BASE, target_of(m), m, pointing_down(40), noise))
    assert result.rms < 2 * noise + 1e-9
    assert len(result.undetermined) == 3
    np.testing.assert_allclose(result.cell.target[:3, 3], 0, atol=1e-3)
    assert np.linalg.norm(result.cell.registration[:3, 3] - BASE[:3, 3]) < 0.3
    for u in result.undetermined:
        shifts = [np.linalg.norm(x) for x in (u.target_shift, u.base_shift)]
        assert shifts[0] == pytest.approx(shifts[1], rel=0.1)
    words = " ".join(registration_lines(result))
    assert "the target's offset along the flange's z from the height of the base" in words


@EITHER
def test_one_axis_registers_to_the_noise_at_ordinary_places(m):
    q = np.tile([0.1, -1.3, 1.2, -1.0, -1.2, 0.4], (12, 1))
    q[:, 0] += np.linspace(0, 1.5, 12)
    result = registered(rigid_readings(BASE, target_of(m), m, q, 1e-5))
    assert result.rms < 3e-5
    assert result.undetermined
    assert np.linalg.norm(result.cell.target[:3, 3]) < 1.0
    assert np.linalg.norm(result.cell.registration[:3, 3]) < 5.0
    assert "joints 2 to 6 never turned" in " ".join(registration_lines(result))


def test_positions_count_although_attitudes_of_one_axis_are_blind():
    """Attitudes alone leave the base's turn about the common axis open; positions tell it."""
    q = pointing_down(40)
    q[:, 5] += np.linspace(0, 2, 40)  # turns about the vertical only
    result = registered(rigid_readings(BASE, np.eye(4), 6, q, 1e-5), np.eye(4))
    assert result.rms < 3e-5
    np.testing.assert_allclose(result.cell.registration, BASE, atol=2e-4)


@EITHER
def test_an_undetermined_target_costs_no_accuracy(m):
    """Orientations that scatter by 0.1 mrad do not tell the target's offset but depend on it."""
    target = target_of(m)
    readings = rigid_readings(BASE, target, m, pointing_down(80, 1e-4), 1e-5)
    some, other = readings[:40], readings[40:]
    error = []
    for known in (True, False):
        fitted = fitted_model(cell_with_frames(BASE, target, False, known), some, "absolute", [])
        off = fitted.predict(other.states).position - other.value[:, :3]
        error.append(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    assert error[1] < 1.15 * error[0]


def test_a_known_frame_is_left_alone():
    readings = rigid_readings(BASE, target_of(3), 3, pointing_down(10), 1e-5)
    cell = cell_with_frames(BASE, target_of(3), True, True)
    result = register(cell, readings)
    assert result.cell is cell
    assert not result.estimated
    assert register(replace(cell, registration=np.eye(4)), readings).rms > 1.0


OF_THREE = [(True, True, True), (False, True, False), (False, False, False)]


@EITHER
@pytest.mark.parametrize("known", OF_THREE)
def test_base_and_targets_are_registered_together(known, m):
    c = reflectors(known=known, joint_std=0.0, m=m)
    cell = register(c.cell, c.readings).cell
    off = cell.all_targets[:, :3, 3] - (OFFSETS + c.world.offsets)
    # The nominal arm is rigid: its loads move the targets by up to 1 mm.
    assert np.abs(off).max() < 5e-4
    assert np.all(off[list(known)] == 0.0)
    turn = cell.registration[:3, :3] @ c.world.registration[:3, :3].T
    assert np.linalg.norm(rotation_vector(turn)) < 1e-3


@pytest.mark.parametrize(("mode", "known"), [(MODES[0], OF_THREE[0]), (MODES[1], OF_THREE[-1])])
def test_swapped_names_and_a_displaced_reading_are_named(mode, known):
    c = reflectors("base_compliance", known=known, seed=1, joint_std=1e-5, poses=14, strength=4.0)
    r = c.readings
    one, other, _ = np.flatnonzero((r.pose == 4) & (r.load == 2))
    lone = np.flatnonzero((r.pose == 7) & (r.load == 1))[2]
    number, value = r.target.copy(), r.value.copy()
    number[[one, other]] = number[[other, one]]
    value[lone] += [1e-3, 0.0, 0.0]
    wrong = replace(r, states=replace(r.states, target=number), value=value)
    reasons = {g.row: g.reason for g in gross_errors(fitted_model(c.cell, wrong, mode))}
    assert set(reasons) == {one, other, lone}
    assert reasons[one] == "target R2: lies where R1 is: were they swapped?"
    assert reasons[other] == "target R1: lies where R2 is: were they swapped?"
    assert reasons[lone].startswith("target R3: ")


PLAIN = cell_with_frames(BASE, np.eye(4), False, False)


def of_arm(change=None, m=3):
    """Readings by an arm that is otherwise than the catalogue's, at the same joint values."""
    q = np.random.default_rng(2).uniform(-2, 2, (40, 6))
    nothing = Description(CELL.arm, q, q[:, :3], None, True, True)
    return by_arm(CELL.arm if change is None else change.applied(nothing).arm, q, m)


def by_arm(arm, q, m=3):
    value = read(arm, q, BASE, pose_of(np.eye(3), OFFSET), m)
    noise = 5e-5 * np.random.default_rng(3).normal(size=value.shape)
    return readings_of(q, value + noise, np.full(m, 5e-5))


def found_in(readings, cell=PLAIN):
    """What is wrong, and in words."""
    finding = examine(register(cell, readings), readings)
    return finding, "" if finding is None else finding.words(cell, readings)


def moved(rows, order):
    good = of_arm()
    value = good.value.copy()
    value[rows] = value[order]
    return replace(good, value=value)


@pytest.mark.parametrize("m", [3, 6])
def test_a_right_description_passes(m):
    readings = of_arm(m=m)
    assert found_in(readings)[0] is None
    assert baseline(PLAIN, readings, "absolute").names == ("base_frame", "target_offset")


@pytest.mark.parametrize("joint", [1, 6])
def test_a_gauge_is_not_proposed(joint):
    """The zero of joint 1 goes into the base, that of the last joint into the target."""
    assert found_in(of_arm(Hypothesis("joint", joint, 1, 0.7)))[0] is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            Hypothesis("joint", 4, -1),
            "joint 4 turns the other way in these data: .* in CELL.toml: "
            r"\[robot\] joint_sign = \[1, 1, 1, -1, 1, 1\]",
        ),
        (
            Hypothesis("joint", 3, 1, np.radians(7.0)),
            r"joint 3's zero is 7.*° elsewhere .*joint_offset_deg = \[0.0, 0.0, [67]\.\d+, 0.0",
        ),
        (
            Hypothesis("coupling", 3, follows=2, factor=1.0),
            r"joint_coupling = \[\{ joint = 3, follows = 2, factor = 1.0 \}\]",
        ),
        (Hypothesis("convention"), 'the DH rows .* in the arm\'s file: convention = "modified"'),
    ],
)
def test_the_reason_is_named_with_the_line_to_write(change, said):
    refusal(said, baseline, PLAIN, of_arm(change), "absolute")


@pytest.mark.long
def test_millimetres_and_swapped_rows_are_named():
    good = of_arm()
    assert "the positions are millimetres" in found_in(replace(good, value=1e3 * good.value))[1]
    assert "the positions are inches" in found_in(replace(good, value=good.value / 25.4))[1]
    finding, said = found_in(moved([4, 19], [19, 4]))
    assert finding.swapped == ((4, 19),)
    assert "rows are swapped (p5/none with p20/none)" in said


def test_one_joint_in_another_unit_is_named():
    """The values of joint 1 alone are degrees, and were taken for such with all others."""
    good = of_arm()
    q = np.radians(good.states.q)
    q[:, 0] = good.states.q[:, 0]
    said = found_in(replace(good, states=replace(good.states, q=q)))[1]
    assert "joint 1's values alone are as described: the others are radians" in said


@pytest.mark.parametrize(("noise_m", "digits", "said"), [(0, 6, 1), (2e-5, 9, 0), (0, 4, 0)])
def test_positions_that_scatter_less_than_any_arm_are_no_measurements(noise_m, digits, said):
    """Desired ones, by other link lengths than the nominal; said, but not refused."""
    good = of_arm()
    arm = replace(CELL.arm, links=CELL.arm.links * [1, 1, 1, 1.0001])
    value = read(arm, good.states.q, BASE, pose_of(np.eye(3), OFFSET), 3)
    value = value + noise_m * np.random.default_rng(1).standard_normal(value.shape)
    finding, words = found_in(replace(good, value=np.round(value, digits)))
    assert ("no arm repeats to that" in words) == said
    assert finding is None or not finding.refused


@pytest.mark.parametrize(("digits", "computed"), [(9, True), (4, True), (4, False)])
def test_positions_computed_from_the_joints_are_refused(digits, computed):
    """Whatever their digits are; measured ones of as few digits are not."""
    good = of_arm()
    arm = CELL.arm if computed else replace(CELL.arm, links=CELL.arm.links * [1, 1, 1, 1.001])
    value = read(arm, good.states.q, BASE, pose_of(np.eye(3), OFFSET), 3)
    readings = replace(good, value=np.round(value, digits))
    finding, said = found_in(readings)
    assert computed == (finding is not None and finding.computed)
    if computed:
        refusal(
            "computed from the joint values, not measured", baseline, PLAIN, readings, "absolute"
        )
        assert finding.refused
        assert "not measured" in said
        exact = replace(good, value=value)  # a simulation without noise
        assert baseline(PLAIN, exact, "absolute").size > 0


def test_two_reflectors_read_as_one_are_no_shifted_rows():
    """Rows of one state that are far apart, in turn."""
    a = of_arm()
    there = read(CELL.arm, a.states.q, BASE, pose_of(np.eye(3), np.array([0.1, -0.05, 0.1])), 3)
    both = a[np.repeat(np.arange(40), 2)]
    value = both.value.copy()
    value[1::2] = there
    finding, said = found_in(replace(both, value=value))
    assert finding.refused
    assert not finding.explanations
    assert "column 'target'" in said


@pytest.mark.parametrize(("shift", "words"), first(1, [(-2, "2 rows before"), (1, "1 row after")]))
def test_positions_of_other_rows_are_named(shift, words):
    """Also where three of four readings of a pose are the same, and look right."""
    good = of_arm()
    finding, said = found_in(replace(good, value=np.roll(good.value, shift, axis=0)))
    assert finding.refused
    assert f"each position stands {words} the joint values it belongs to" in said
    assert said.endswith("correct it in the table")
    four = good[np.repeat(np.arange(40), 8)]
    said = found_in(replace(four, value=np.roll(four.value, 1, axis=0)))[1]
    assert "each position stands 1 row after" in said


@pytest.mark.long
@pytest.mark.parametrize(
    ("order", "words"),
    [
        ([0, 4, 2, 3, 1, 5], "the columns of joints 2 and 5 are exchanged"),
        ([0, 1, 2, 3, 5, 4], "the columns of joints 5 and 6 are exchanged"),
        ([1, 2, 3, 4, 5, 0], "joint 1's values are in the column of joint 6"),
    ],
)
def test_exchanged_columns_of_joints_are_named(order, words):
    good = of_arm()
    off = replace(good, states=replace(good.states, q=good.states.q[:, order]))
    finding, said = found_in(off)
    assert finding.refused
    assert words in said


@pytest.mark.long
def test_a_tracker_that_was_moved_on_the_way_is_asked_for():
    readings, m = of_arm(), se3.matrix(se3.rotation(np.array([0.0, 0.1, 0.4])), np.ones(3))
    value = readings.value.copy()
    value[17:, :3] = value[17:, :3] @ m[:3, :3].T + m[:3, 3]
    finding, said = found_in(replace(readings, value=value))
    assert (finding.moved, finding.refused) == (17, True)
    assert "the readings up to p17/none and those from p18/none on fit, but not together" in said
    assert "column 'station'" in said


@pytest.mark.long
def test_zeros_of_all_joints_that_are_a_little_elsewhere_are_named():
    """But not those of the first and the last, which base and target have."""
    zeros = np.radians([0.0, 4.5, -6.0, -2.0, 5.0, 0.0])
    arm = with_controller_conventions(CELL.arm, Conventions(joint_offset_deg=np.degrees(zeros)))
    q = np.random.default_rng(2).uniform(-2, 2, (40, 6))
    finding, said = found_in(by_arm(arm, q))
    (explanation,) = finding.explanations
    assert [h.joint for h in explanation.changes] == [2, 3, 4, 5]
    assert explanation.rms < 1e-3
    estimates = [h.offset for h in explanation.changes]
    np.testing.assert_allclose(estimates, zeros[1:5], rtol=0, atol=2e-3)
    assert "[robot] joint_offset_deg = [0.0, 4.5" in said


@pytest.mark.long
def test_nonsense_is_refused_with_what_was_tried():
    finding, said = found_in(moved(list(range(40)), np.random.default_rng(0).permutation(40)))
    assert finding.refused
    assert not finding.explanations
    assert "Nothing that was tried explains it" in said


@pytest.mark.parametrize("seed", [0, 1, 4, 5])
def test_random_arms_register_or_are_refused_for_the_right_reason(seed):
    """A small sample of `studies/random_descriptions.py`."""
    outcome, _ = judge(draw(np.random.default_rng(seed)))
    assert outcome.right
    assert outcome.named is not False


def test_another_arm_counts_its_joints_as_the_cell_says():
    """The controller's signs are the cell's, whatever arm it is."""
    config = configuration()
    robot = config.robot.model_copy(update={"joint_sign": (1, 1, -1, 1, 1, 1)})
    cell = cell_from_config(config.model_copy(update={"robot": robot}))
    cell = replace(cell, registration_known=False, target_known=False)
    q = np.random.default_rng(2).uniform(-2, 2, (40, 6))
    _, said = found_in(by_arm(with_controller_conventions(load_arm("ur5e"), robot), q), cell)
    assert "the arm is another one, ur5e" in said
    assert "turns the other way" not in said


TARGET = np.array([0.03, -0.02, 0.1])
NOISE = 3e-5


def rotation(rng, angle=None):
    """About a random axis."""
    axis = rng.standard_normal(3)
    a = rng.uniform(0, 3) if angle is None else angle
    return Rotation.from_rotvec(a * axis / np.linalg.norm(axis)).as_matrix()


def measured(name, seed, off, poses=30, noise=NOISE, errs=np.zeros_like):
    """Positions of an arm each of whose links is off by `off` mm and mrad, by matrix products.

    Its joints err by `errs` (poses, n) of their angles.
    """
    rng, arm = np.random.default_rng(seed), load_arm(name)
    q = rng.uniform(-2.5, 2.5, (poses, arm.n))
    links = arm.links.copy()
    for link in links:
        link[:3, :3] = link[:3, :3] @ rotation(rng, 1e-3 * off * rng.standard_normal())
        link[:3, 3] += 1e-3 * off * rng.standard_normal(3)
    base = pose_of(rotation(rng), 2 * rng.standard_normal(3))
    x = read(replace(arm, links=links), q + errs(q), base, pose_of(np.eye(3), TARGET), 3)
    return readings_of(q, x + noise * rng.standard_normal((poses, 3)), np.full(3, noise))


def cell(name, known=False, **robot):
    tool = {"target_m": TARGET.tolist()} if known else {}
    return cell_from_config(
        CellConfig.model_validate({"robot": {"model": name, **robot}, "tool": tool})
    )


@pytest.mark.parametrize("known", first(1, [False, True]))
@pytest.mark.parametrize(("true", "configured"), [("ur10", "ur10e"), ("ur10e", "ur10")])
def test_the_other_generation_is_noticed(true, configured, known):
    """Of 100 such arms, off by 1 mm and mrad, 97 were."""
    named = []
    for seed in range(4):
        suggestion = other_arm_of(cell(configured, known), measured(true, seed, 1.0))
        named.append(None if suggestion is None else suggestion.name)
        if suggestion is not None:
            assert suggestion.rms_with < suggestion.rms / 2
    assert named.count(true) >= 3
    assert set(named) <= {true, None}


@pytest.mark.parametrize("off", first(1, [3.0, 1.0]))
@pytest.mark.parametrize("name", first(6, robot_names()))
def test_an_arm_before_calibration_is_not_taken_for_another(name, off):
    for seed in range(2):
        readings = measured(name, 100 + seed, off, (12, 40)[seed])
        registered = register(cell(name, known=bool(seed)), readings)
        assert registered.rms > BEYOND_NOISE * NOISE  # the others are tried
        assert other_arm(registered, readings) is None


def test_too_few_poses_say_nothing():
    assert other_arm_of(cell("ur10e"), measured("ur10", 0, 1.0, poses=3)) is None


ARM = load_arm(load_config(foreign_tables.CELL).robot.model)
C = foreign_tables.campaign(30)
# an arm's own errors: about a milliradian
ATTITUDE = C.attitude * Rotation.from_rotvec(1e-3 * np.random.default_rng(2).normal(size=(30, 3)))


@pytest.mark.parametrize("order", ["XYZ", "ZYX", "xyz", "zyx", "ZYZ", "zxz", "YZX"])
def test_three_angles(order):
    ranked = rank_conventions(ARM, C.q, C.position, ATTITUDE.as_euler(order), 1.0)
    kind = "intrinsic" if order.isupper() else "fixed"
    assert clearly_best(ranked) == f"{kind}-{order.lower()}"
    assert ranked[0].angle < 3e-3
    assert ranked[0].position < 1e-3


def test_rotation_vectors_and_quaternions():
    ranked = rank_conventions(ARM, C.q, C.position, ATTITUDE.as_rotvec(degrees=True), np.pi / 180)
    assert clearly_best(ranked) == "rotation-vector"
    for shift, name in ((0, "quaternion-xyzw"), (1, "quaternion-wxyz")):
        numbers = np.roll(ATTITUDE.as_quat(), shift, axis=1)
        ranked = rank_conventions(ARM, C.q, C.position, numbers, 1.0)
        assert clearly_best(ranked) == name


def test_one_axis_tells_nothing():
    """All conventions turn about z in the same way."""
    angle = np.linspace(-1, 1, 12)
    q = np.zeros((12, 6))
    q[:, 0] = angle
    numbers = np.stack([0 * angle, 0 * angle, angle], axis=1)
    ranked = rank_conventions(ARM, q, C.position[:12], numbers, 1.0)
    assert clearly_best(ranked) is None


def test_what_is_no_orientation_is_not_decided():
    noise = np.random.default_rng(0).uniform(-3, 3, (30, 3))
    ranked = rank_conventions(ARM, C.q, C.position, noise, 1.0)
    assert clearly_best(ranked) is None
    assert rank_conventions(ARM, C.q[:4], C.position[:4], noise[:4], 1.0) == ()


def test_the_misfit_of_a_displaced_reflector_follows_the_target():
    c = reflectors(seed=2, joint_std=1e-5)
    moved, by = c.cell.all_targets.copy(), np.array([2e-4, -1e-4, 1e-4])
    moved[1, :3, 3] += by
    cell = c.cell.with_targets(moved)
    share = misfit_breakdown(linearise(fitted_model(cell, c.readings, "absolute")))[0]
    assert share.variable == "target"
    assert share.share > 0.9
    fitted = fitted_model(cell, c.readings, "absolute", ["joint_compliance", "target_offset"])
    rows = fitted.model.slices()[fitted.model.names.index("target_offset")]
    theta = fitted.theta[rows].reshape(3, 3)
    # A common displacement of all targets is hardly told from one of the base; a single one is.
    np.testing.assert_allclose(theta[1] - theta[[0, 2]].mean(axis=0), -by, atol=1.5e-5)
