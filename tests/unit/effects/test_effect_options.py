"""What options choose and what is refused of them; joints that share; the catalogue as a value."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.diagnosis.effect_ranking import candidates
from hilcal.effects.catalogue import BUILT_IN, installed
from hilcal.effects.per_joint import PerJoint, joint_groups
from hilcal.effects.protocol import Columns, Effect, Parameter, Role, effect, failure_of
from hilcal.effects.written import chosen_options, option_defaults, read_effects_text, write_effect
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import fit
from hilcal.model.model import Model
from tests.support.campaigns import campaign
from tests.support.effect_cases import (
    CELLS,
    NAMES,
    UR10E,
    VARIANTS,
    effect_class,
    make,
    options_of,
    random_theta,
    situation,
    some_states,
)
from tests.support.refusals import refusal, refusals, refuses


@pytest.mark.parametrize("name", NAMES)
def test_an_unknown_option_is_refused_with_the_valid_ones(name):
    with pytest.raises(InputError, match=f"{name}: unknown option 'colour'") as caught:
        make(name, UR10E, some_states(UR10E), {"colour": 1})
    valid = effect_class(name).option_help or ("none",)
    assert all(option in str(caught.value) for option in valid)


@refusals("options")
def test_an_impossible_option_is_refused(case, given):
    name, options = given.split(maxsplit=1)
    refuses(case, lambda: make(name, UR10E, some_states(UR10E), json.loads(options)).prior_std())


@pytest.mark.parametrize("name", ["hysteresis", "tracker_drift", "creep"])
def test_a_missing_column_is_named(name):
    (column,) = effect_class(name).needs
    states = replace(some_states(UR10E), **{column: None})
    assert not effect_class(name).computable(states)
    refusal(f"{name} needs {column}", make, name, UR10E, states)


def test_growth_needs_one_of_two_temperatures():
    cell, kind = CELLS["ur10e"], effect_class("thermal_growth")
    both = some_states(cell)
    air, joints = replace(both, joint_temperature=None), replace(both, air_temperature=None)
    neither = replace(air, air_temperature=None)
    assert [kind.computable(s) for s in (both, air, joints, neither)] == [True, True, True, False]
    chosen = [make("thermal_growth", cell, s).options["temperature"] for s in (both, air, joints)]
    assert chosen == ["air", "air", "joints"]
    with pytest.raises(
        InputError, match="needs air_temperature or joint_temperature, which not all"
    ):
        make("thermal_growth", cell, neither)
    with pytest.raises(InputError, match="'air', which not all readings have; valid: joints"):
        make("thermal_growth", cell, joints, {"temperature": "air"})
    with pytest.raises(InputError, match="'joints', which not all readings have; valid: air"):
        make("thermal_growth", cell, air, {"temperature": "joints"})


def test_a_thermometer_once_chosen_is_kept():
    """What a fit read from the air is not compared with joints when it predicts others."""
    both = some_states(UR10E)
    fitted = make("thermal_growth", UR10E, both)
    again = make("thermal_growth", UR10E, both[:3], fitted.options)
    assert again.options == fitted.options == {
        "reference_degC": 20.0, "temperature": "air", "links": "common",
    }  # fmt: skip
    with pytest.raises(InputError, match="temperature = 'air', which not all readings have"):
        Model(UR10E, (fitted,)).predict(replace(both, air_temperature=None), np.zeros(1))
    with pytest.raises(InputError, match="temperature = 'air'"):
        make("thermal_growth", UR10E, replace(both, air_temperature=None), fitted.options)


def test_joints_drift_from_where_they_were_at_first():
    s = situation(UR10E)
    order = np.random.default_rng(0).permutation(len(s.states))
    shuffled = s.states[order]
    first = s.states.joint_temperature[np.argmin(s.states.time)]
    kappa = 1e-6 * np.arange(1.0, 7.0)
    for options, reference in (({}, first), ({"reference_degC": 25}, np.full(6, 25.0))):
        effect = make("thermal_joint_drift", UR10E, shuffled, options)
        dq = effect.deviation(kappa, replace(s, states=shuffled)).dq
        expected = kappa * (shuffled.joint_temperature - reference)
        np.testing.assert_allclose(dq, expected, rtol=0, atol=1e-18)
        kept = make("thermal_joint_drift", UR10E, s.states[5:], effect.options)
        np.testing.assert_allclose(kept.reference, reference, rtol=0, atol=0)
    untimed = replace(shuffled, time=None)
    effect = make("thermal_joint_drift", UR10E, untimed)
    np.testing.assert_array_equal(effect.reference, shuffled.joint_temperature[0])


def test_joints_without_temperatures_warm_up_with_the_time():
    s = situation(UR10E)
    hot, timed = s.states, replace(s.states, joint_temperature=None)
    effect = make("thermal_joint_drift", UR10E, timed)
    kappa = 1e-6 * np.arange(1.0, 7.0)
    dq = effect.deviation(kappa, replace(s, states=timed)).dq
    elapsed = timed.time - timed.time.min()
    rise = 10.0 * (1.0 - np.exp(-elapsed[:, None] / 2400.0))
    np.testing.assert_allclose(dq, kappa * rise, rtol=0, atol=1e-18)
    kept = make("thermal_joint_drift", UR10E, hot[5:], effect.options)  # not by temperatures now
    np.testing.assert_array_equal(kept.deviation(kappa, s).dq, dq)
    by_temperature = make("thermal_joint_drift", UR10E, hot)
    for states, options in (
        (timed, by_temperature.options),
        (replace(hot, time=None), kept.options),
    ):
        with pytest.raises(InputError, match="which not all readings have; valid: "):
            make("thermal_joint_drift", UR10E, states, options)
    with pytest.raises(InputError, match="needs joint_temperature or time, which not all"):
        make("thermal_joint_drift", UR10E, replace(timed, time=None))


@pytest.mark.parametrize("name", NAMES)
def test_an_effect_is_made_again_from_its_options(name):
    """As a revision keeps them: a fit and its copy have the same parameters and predictions."""
    states = some_states(UR10E)
    model = Model(UR10E, (make(name, UR10E, states, options_of(name)),))
    again = Model(UR10E, (make(name, UR10E, states[2:7], model.effects[0].options),))
    assert again.effects[0].parameters == model.effects[0].parameters
    theta = random_theta(model.effects, np.random.default_rng(0))
    a, b = model.predict(states[2:7], theta), again.predict(states[2:7], theta)
    np.testing.assert_array_equal(a.observation.position, b.observation.position)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", {}),
        (" creep , hysteresis,,", {"creep": {}, "hysteresis": {}}),
        ("creep()", {"creep": {}}),
        (
            "backlash ( joints = 2/3/4-6 ; crossing = .5e-1, )",
            {"backlash": {"joints": "2/3/4-6", "crossing": 0.05}},
        ),
        ("creep(joints=1+2)", {"creep": {"joints": "1+2"}}),
        ("creep(joints='a, (b)]; \"c')", {"creep": {"joints": 'a, (b)]; "c'}}),
        ("creep(joints=nan)", {"creep": {"joints": "nan"}}),
        (
            "periodic_joint_compliance(orders=[1, 2;4],joints=each),creep",
            {"periodic_joint_compliance": {"orders": [1, 2, 4], "joints": "each"}, "creep": {}},
        ),
        ("wrench_bias(rotvec_rad=[-1, +2., 3e-1])", {"wrench_bias": {"rotvec_rad": [-1, 2, 0.3]}}),
    ],
)
def test_what_is_typed_is_what_is_read(text, expected):
    effects = read_effects_text(text, "--effects", installed())
    assert effects == expected
    assert list(effects) == list(expected)
    for name, options in expected.items():
        for key, value in options.items():
            assert type(effects[name][key]) is type(value)


@refusals("typed_effects")
def test_what_cannot_be_read_is_refused_in_one_line(case, given):
    refuses(case, lambda: read_effects_text(given[:-1], "--effects", installed()))


def test_a_number_of_many_digits_is_refused():
    with pytest.raises(InputError, match="valid: a number"):
        read_effects_text(f"creep(joints={'9' * 5000})", "--effects", installed())


values = st.one_of(
    st.booleans(),
    st.integers(-(10**6), 10**6),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(st.characters(exclude_characters='"', exclude_categories=("Cs",)), max_size=12),
)


@given(st.dictionaries(st.from_regex(r"[a-z]\w*", fullmatch=True).filter(str.isascii),
                       st.one_of(values, st.lists(values, max_size=3)), max_size=3))  # fmt: skip
def test_what_is_written_reads_the_same(options):
    text = f"hysteresis, {write_effect('creep', options)}"
    effects = read_effects_text(text, "x", installed())
    assert effects == {"hysteresis": {}, "creep": options}
    assert repr(effects["creep"]) == repr(options)


@given(st.text(st.sampled_from("creep(joints=1-3,;'\"[]) \n2.e/+"), max_size=30))
def test_nothing_that_is_typed_fails_otherwise(text):
    said = ""
    try:
        read_effects_text(text, "--effects", installed())
    except InputError as error:
        said = str(error)
    assert "\n" not in said


@pytest.mark.parametrize(("name", "options"), VARIANTS)
def test_options_that_are_not_the_usual_ones_are_told(name, options):
    states = some_states(UR10E)
    effect = make(name, UR10E, states, options)
    unusual = chosen_options(effect, states, 3)
    renamed = {"joints" if key == "form" else key: value for key, value in options.items()}
    assert unusual == renamed
    assert chosen_options(make(name, UR10E, states), states, 3) == {}


def test_priors_and_what_the_readings_choose_are_no_choice():
    states = some_states(UR10E)
    turned = make("target_offset", UR10E, states, {"rotation": True, "prior_m": 1, "prior_rad": 1})
    assert chosen_options(turned, states, 6) == {}
    assert chosen_options(turned, states, 3) == {"rotation": True}


@pytest.mark.parametrize("kind", BUILT_IN)
def test_options_are_explained_and_defaults_are_valid(kind):
    cell = CELLS["ur10e" if kind.applies(CELLS["ur10e"]) else "rails"]
    states = some_states(cell)
    assert all(kind.option_help.values())
    defaults = option_defaults(kind, cell, states)
    assert tuple(defaults) == tuple(kind.option_help)
    known = {name: value for name, value in defaults.items() if value is not None}
    usual = kind(cell, states)
    assert kind(cell, states, known).parameters == usual.parameters
    assert kind(cell, states, known).options == usual.options


def test_a_default_that_follows_from_the_readings_is_not_told():
    states = some_states(UR10E, 60)
    drift = option_defaults(installed()["thermal_joint_drift"], UR10E, states)
    assert drift == {
        "joints": "each", "temperature": "joints", "reference_degC": None, "start_s": None,
        "time_constant_s": None,
    }  # fmt: skip
    assert option_defaults(installed()["transmission_error"], UR10E, states)["harmonics"] is None
    assert option_defaults(installed()["creep"], UR10E, states) == {"joints": "common"}


class Sag(Effect):
    """dq_1 = a cos(q_2)."""

    name = "sag"
    summary = "dq_1 = a cos(q_2)"
    role: Role = "baseline"

    @property
    def parameters(self):
        return (Parameter("a", "rad", 1e-5),)

    def columns(self, s):
        return (Columns("dq", np.array([0]), np.array([0]), np.cos(s.angle[:, 1:2])),)


def test_an_effect_is_added_by_name_and_options():
    c = campaign()
    model = baseline(c.cell, c.readings, "absolute") + effect("hysteresis", joints="1-3")
    assert model.names[-1] == "hysteresis"
    assert model.effects[-1].options == {"joints": "1-3"}
    with pytest.raises(InputError, match=r"unknown effect 'hysteresys' \(did you mean"):
        model + effect("hysteresys")
    with pytest.raises(InputError, match=r"already: (?!.*hysteresis.*hysteresis)"):
        model + effect("hysteresis")
    with pytest.raises(InputError, match="unknown option 'joint'; valid: joints"):
        model + effect("encoder_offset", joint=1)


def test_an_effect_is_added_by_its_class_and_is_in_the_catalogue_then():
    c = campaign()
    model = baseline(c.cell, c.readings, "absolute") + effect(Sag)
    assert model.names[-1] == "sag"
    assert model.catalogue.names[-1] == "sag"
    assert "sag" not in installed().names


def test_a_model_without_readings_takes_effects_that_are_built_only():
    with pytest.raises(InputError, match="creep: this model was made without readings"):
        Model(campaign().cell, ()) + effect("creep")


def test_what_a_model_could_have_is_what_its_catalogue_holds():
    c = campaign()
    with_sag = installed().with_effects(Sag)
    assert "sag" in baseline(c.cell, c.readings, "absolute", with_sag).names  # by its role
    bare = (
        Model(c.cell, (), with_sag, c.readings) + effect("joint_compliance") + effect("base_frame")
    )
    fitted = fit(bare, c.readings, "absolute")
    assert "sag" in {e.name for e in candidates(fitted)}
    refusal("class Sag: effect sag is in the catalogue already", with_sag.with_effects, Sag)


class Fails(Sag):
    """Raises where there are many states."""

    name = "fails"

    def columns(self, s):
        return super().columns([s][len(s.angle) > 40])


def test_what_an_effect_raises_in_use_is_traced_to_its_line():
    c = campaign()
    model = baseline(c.cell, c.readings, "absolute") + effect(Fails)
    with pytest.raises(IndexError) as caught:
        model.predict(c.readings.states, np.zeros(model.size))
    line = Fails.columns.__code__.co_firstlineno + 1
    start = f"{__file__}, line {line}: effect fails: columns raises IndexError: list index out of"
    assert str(failure_of(caught.value)).startswith(start)


def test_what_hilcal_raises_is_no_failure_of_a_users_effect():
    c = campaign()
    model = baseline(c.cell, c.readings, "absolute")
    with pytest.raises(IndexError) as caught:
        model.predict(c.readings.states, np.zeros(0))  # no parameters
    assert failure_of(caught.value) is None


PER_JOINT = tuple(name for name in NAMES if issubclass(effect_class(name), PerJoint))
GROUPS = ("common", "2/3/4-6", "1+4/2-3", "5")


def membership(groups, count):
    """(n, G) 1 where a joint belongs to a group; written out by hand, not read."""
    known = {
        "common": [range(count)],
        "each": [[j] for j in range(count)],
        "2/3/4-6": [[1], [2], [3, 4, 5]],
        "1+4/2-3": [[0, 3], [1, 2]],
        "2-3/5+6": [[1, 2], [4, 5]],
        "5": [[4]],
        "1-3": [[0, 1, 2]],
    }[groups]
    out = np.zeros((count, len(known)))
    for k, group in enumerate(known):
        out[list(group), k] = 1.0
    return out


def options(name, groups):
    few = {"harmonics": 2} if name == "transmission_error" else options_of(name)
    return {**few, "joints": groups}


def spread(effect, groups):
    """(P each, P groups) parameters of every joint by those of the groups."""
    member = membership(groups, effect.cell.arm.n)
    return np.kron(member, np.eye(len(effect.parameters) // member.shape[1]))


@pytest.mark.parametrize(
    ("given", "text", "labels", "joint", "group"),
    [
        ("each", "each", "1 2 3 4 5 6", [0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5]),
        ("common", "common", "1-6", [0, 1, 2, 3, 4, 5], [0] * 6),
        ("2/3/4-6", "2/3/4-6", "2 3 4-6", [1, 2, 3, 4, 5], [0, 1, 2, 2, 2]),
        ("4-6/3/2", "2/3/4-6", "2 3 4-6", [1, 2, 3, 4, 5], [0, 1, 2, 2, 2]),
        ("1+4+5/ 2", "1+4-5/2", "1+4-5 2", [0, 1, 3, 4], [0, 1, 0, 0]),
        ("1+2+3", "1-3", "1-3", [0, 1, 2], [0, 0, 0]),
        (3, "3", "3", [2], [0]),
        ("6/5/4/3/2/1", "each", "1 2 3 4 5 6", [0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 4, 5]),
        ("1-6", "common", "1-6", [0, 1, 2, 3, 4, 5], [0] * 6),
        ("1-5/6", "1-5/6", "1-5 6", [0, 1, 2, 3, 4, 5], [0, 0, 0, 0, 0, 1]),
    ],
)
def test_groups_are_read_and_written_in_one_way(given, text, labels, joint, group):
    g = joint_groups("hysteresis", {"joints": given}, 6)
    assert (g.text, " ".join(g.labels)) == (text, labels)
    assert (g.joint.tolist(), g.group.tolist()) == (joint, group)
    again = joint_groups("hysteresis", {"joints": g.text}, 6)
    assert (again.text, again.labels) == (g.text, g.labels)
    assert (again.joint.tolist(), again.group.tolist()) == (joint, group)


@refusals("joints")
def test_other_groups_are_refused_with_what_would_be_valid(case, given):
    refuses(case, lambda: joint_groups("hysteresis", {"joints": json.loads(given)}, 6))


@pytest.mark.parametrize("groups", GROUPS)
@pytest.mark.parametrize("name", PER_JOINT)
def test_a_shared_parameter_is_the_same_number_at_each_of_its_joints(name, groups):
    """Same readings; and the derivative is the sum of theirs, also of another effect's by it."""
    cell = CELLS["odd"]
    states = some_states(cell, 5)
    others = [n for n in ("load_point", "joint_compliance") if n != name]
    rest = [make(n, cell, states) for n in others]
    one = make(name, cell, states, options(name, groups))
    every = make(name, cell, states, options(name, "each"))
    m = spread(one, groups)
    assert m.shape == (len(every.parameters), len(one.parameters))
    rng = np.random.default_rng(1)
    theta = random_theta((one,), rng)
    fixed = random_theta(rest, rng)
    a, b = Model(cell, (*rest, one)), Model(cell, (*rest, every))
    at, bt = np.concatenate([fixed, theta]), np.concatenate([fixed, m @ theta])
    pa, pb = a.predict(states, at), b.predict(states, bt)
    np.testing.assert_allclose(pa.observation.position, pb.observation.position, rtol=0, atol=1e-12)
    ja, jb = a.jacobian(pa, at, 6), b.jacobian(pb, bt, 6)
    k = len(fixed)
    expected = np.concatenate([jb[:, :, :k], jb[:, :, k:] @ m], axis=2)
    size = np.abs(expected).max(axis=(0, 1)) + 1e-300
    np.testing.assert_allclose(ja / size, expected / size, rtol=0, atol=1e-10)
    assert np.all(np.abs(ja).max(axis=(0, 1)) > 0)


@pytest.mark.parametrize("name", PER_JOINT)
def test_names_and_magnitudes(name):
    states = some_states(UR10E)
    every = make(name, UR10E, states, options(name, "each")).parameters
    some = make(name, UR10E, states, options(name, "1+4-5/2/3")).parameters
    kinds = len(every) // 6
    assert len(some) == 3 * kinds
    heads = [p.name.split(".")[0] for p in some[::kinds]]
    assert heads == ["j1+4-5", "j2", "j3"]
    tails = [p.name.partition(".")[2] for p in some]
    assert tails == [p.name.partition(".")[2] for p in every][: len(some)]
    first = [every[kinds * j].scale for j in (0, 3, 4)]
    assert some[0].scale == pytest.approx(np.exp(np.mean(np.log(first))), rel=1e-12)
    assert some[kinds].scale == every[kinds].scale
    assert some[0].meaning == every[0].meaning.replace("joint 1", "joints 1+4-5")
    assert {p.unit for p in some} == {p.unit for p in every}


def test_creep_takes_the_older_name_of_its_groups():
    states = some_states(UR10E)
    for form in ("common", "each"):
        old = make("creep", UR10E, states, {"form": form})
        new = make("creep", UR10E, states, {"joints": form})
        assert old.parameters == new.parameters
        assert old.options == new.options == {"joints": form}
    assert [p.name for p in make("creep", UR10E, states).parameters] == ["k"]
    with pytest.raises(InputError, match="form and joints; valid: joints alone"):
        make("creep", UR10E, states, {"form": "each", "joints": "each"})


def test_frames_take_options_too():
    c = campaign(plan_seed=0)
    usual = with_effects(c.cell, c.readings, "absolute", ("hysteresis",))
    given = {"base_frame": {"prior_m": 2e-3, "prior_rad": 4e-3}}
    known = with_effects(c.cell, c.readings, "absolute", ("base_frame", "hysteresis"), given)
    assert known.names == usual.names == ("base_frame", "hysteresis")
    assert usual.effects[0].prior_std() is None
    assert known.effects[0].prior_std().tolist() == [2e-3] * 3 + [4e-3] * 3
