"""Joints that share a parameter, joints that have none: what it means for each effect."""

import json

import numpy as np
import pytest

from hilcal.effects.per_joint import PerJoint, joint_groups
from hilcal.errors import InputError
from hilcal.identification.baseline import with_effects
from hilcal.model.model import Model
from tests.support.campaigns import campaign
from tests.support.effect_cases import (
    CELLS,
    NAMES,
    UR10E,
    effect_class,
    make,
    options_of,
    random_theta,
    some_states,
)
from tests.support.refusals import refusals, refuses

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
