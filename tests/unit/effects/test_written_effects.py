"""Effects with options as they are typed."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.effects.catalogue import BUILT_IN, installed
from hilcal.effects.written import chosen_options, option_defaults, read_effects_text, write_effect
from hilcal.errors import InputError
from tests.support.effect_cases import CELLS, VARIANTS, make, some_states


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", {}),
        ("hysteresis", {"hysteresis": {}}),
        (" creep , hysteresis,,", {"creep": {}, "hysteresis": {}}),
        ("creep()", {"creep": {}}),
        (
            "joint_compliance, transmission_error(harmonics=20), backlash(joints=common)",
            {
                "joint_compliance": {},
                "transmission_error": {"harmonics": 20},
                "backlash": {"joints": "common"},
            },
        ),
        (
            "backlash ( joints = 2/3/4-6 ; crossing = .5e-1, )",
            {"backlash": {"joints": "2/3/4-6", "crossing": 0.05}},
        ),
        ("creep(joints=1+2)", {"creep": {"joints": "1+2"}}),
        ("creep(joints=3)", {"creep": {"joints": 3}}),
        ("creep(joints='a, (b)]; \"c')", {"creep": {"joints": 'a, (b)]; "c'}}),
        ('creep(joints="20")', {"creep": {"joints": "20"}}),
        ("target_offset(rotation=true)", {"target_offset": {"rotation": True}}),
        ("creep(joints=nan)", {"creep": {"joints": "nan"}}),
        (
            "periodic_joint_compliance(orders=[1, 2;4],joints=each),creep",
            {"periodic_joint_compliance": {"orders": [1, 2, 4], "joints": "each"}, "creep": {}},
        ),
        ("wrench_bias(rotvec_rad=[-1, +2., 3e-1])", {"wrench_bias": {"rotvec_rad": [-1, 2, 0.3]}}),
        ("periodic_joint_compliance(orders=[])", {"periodic_joint_compliance": {"orders": []}}),
    ],
)
def test_what_is_typed_is_what_is_read(text, expected):
    found = read_effects_text(text, "--effects", installed())
    assert found == expected
    assert list(found) == list(expected)
    for name, options in expected.items():
        for key, value in options.items():
            assert type(found[name][key]) is type(value)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("histeresis", "unknown effect 'histeresis'"),
        ("histeresis(joints=1)", "unknown effect 'histeresis'"),
        ("creep,creep(joints=1)", "creep is there twice"),
        ("creep(joints=1", ") is missing at the end"),
        ("creep(orders=[1)", "closes nothing"),
        ("creep joints=1)", ") at character 15 closes nothing"),
        ("creep(joints='1)", "' is missing at the end"),
        ("creep(joints=1)x", "is not an effect with its options"),
        ("creep(joints=1)(joints=2)", "creep: ) at character 9 closes nothing"),
        ("creep((joints=1))", "is not an option with a value"),
        ("creep(joints)", "'joints' is not an option with a value"),
        ("creep(=1)", "'=1' is not an option with a value"),
        ("creep(a b=1)", "is not an option with a value"),
        ("creep(joints=)", "joints = nothing; valid: a number"),
        ("creep(joints=1 2)", "joints = 1 2; valid: a number"),
        ("creep(joints==1)", "joints = =1; valid: a number"),
        ("creep(joints=1e999)", "joints = 1e999; valid: a number"),
        (f"creep(joints={'9' * 5000})", "valid: a number"),
        ("creep(joints='a'b)", "valid: a number"),
        ("creep(joints=[1, [2]])", "valid: a number"),
        ("creep(joints=1; joints=2)", "option joints is there twice"),
        ("creep(joints=\n)", "valid: a number"),
        ("creep\nhysteresis", "unknown effect"),
        ("(joints=1)", "unknown effect ''"),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_line(text, wrong):
    with pytest.raises(InputError) as caught:
        read_effects_text(text, "--effects", installed())
    line = str(caught.value)
    assert wrong in line
    assert "\n" not in line
    assert "valid" in line or "twice" in line


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
    found = read_effects_text(text, "x", installed())
    assert found == {"hysteresis": {}, "creep": options}
    assert repr(found["creep"]) == repr(options)


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
    cell = CELLS["ur10e"]
    states = some_states(cell)
    effect = make(name, cell, states, options)
    told = chosen_options(effect, states, 3)
    renamed = {"joints" if key == "form" else key: value for key, value in options.items()}
    assert told == renamed
    assert chosen_options(make(name, cell, states), states, 3) == {}


def test_priors_and_what_the_readings_choose_are_no_choice():
    cell = CELLS["ur10e"]
    states = some_states(cell)
    turned = make("target_offset", cell, states, {"rotation": True, "prior_m": 1, "prior_rad": 1})
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


def test_help_is_that_of_the_class_before_that_of_its_base():
    assert "Unless given, each." in installed()["hysteresis"].option_help["joints"]
    assert "given, common." in installed()["creep"].option_help["joints"]
    assert {"joints", "crossing"} == set(installed()["backlash"].option_help)


def test_a_default_that_follows_from_the_readings_is_not_told():
    cell = CELLS["ur10e"]
    states = some_states(cell, 60)
    drift = option_defaults(installed()["thermal_joint_drift"], cell, states)
    assert drift == {"joints": "each", "reference_degC": None}
    assert option_defaults(installed()["transmission_error"], cell, states)["harmonics"] is None
    assert option_defaults(installed()["creep"], cell, states) == {"joints": "common"}
