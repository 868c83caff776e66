"""Every effect: its law, its derivatives, its options; against mechanics of their own."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from arm_cases import arm_of, slope
from arm_cases import cell_of as odd_cell
from campaigns import campaign, cell_of, plan, true_parameters

from drivers.simulated.tracker import TrackerNoise
from drivers.simulated.truth import Truth
from drivers.simulated.world import World
from hilcal.cell import Cell
from hilcal.data.readings import Readings, States
from hilcal.effects.catalogue import BUILT_IN, catalogue, effect_class, make
from hilcal.effects.protocol import Columns, Effect, Parameter, Situation
from hilcal.errors import InputError
from hilcal.identify.fit import fit
from hilcal.model import Model
from hilcal.robot import chain as chains
from hilcal.robot.deviation import Deviation
from hilcal.robot.statics import Load, slot_wrenches

NAMES = tuple(e.name for e in BUILT_IN)
ELASTIC = tuple(e.name for e in BUILT_IN if e.elastic)
FIELDS = ("dq", "twist", "base", "station", "target", "scale")


def some_states(cell: Cell, count: int = 9, seed: int = 1) -> States:
    rng = np.random.default_rng(seed)
    n = cell.arm.n
    wrench = rng.normal(size=(count, 6)) * [40, 40, 40, 6, 6, 6]
    wrench[::3] = 0.0
    return States(
        q=rng.uniform(-2.5, 2.5, (count, n)),
        wrench=wrench,
        time=np.sort(rng.uniform(0, 4e3, count)),
        approach=rng.choice([-1.0, 1.0], (count, n)),
    )


def options_of(name: str, m: int = 3) -> dict[str, object]:
    if name == "target_offset":
        return {"rotation": m == 6}
    return {"tracker_drift": {"reference_s": 0.0}, "transmission_error": {"harmonics": 3}}.get(
        name, {}
    )


def situation(cell: Cell, seed: int = 2) -> Situation:
    """A configuration that is visibly deflected, under wrenches and weight."""
    states = some_states(cell, seed=seed)
    rng = np.random.default_rng(seed)
    shape = (len(states), cell.arm.n)
    deviation = Deviation(
        dq=1e-2 * rng.normal(size=shape),
        twist=1e-2 * rng.normal(size=(shape[0], shape[1] + 1, 6)),
    )
    chain = chains.evaluate(cell.arm, states.q, deviation)
    load = Load(states.wrench, cell.load_point, cell.tool_mass, cell.tool_com, cell.gravity)
    return Situation(cell, states, states.q, chain, slot_wrenches(cell.arm, chain, load))


CELLS = {"ur10e": cell_of(), "odd": odd_cell(arm_of("odd"))}


def random_theta(effects, rng, elastic=1.0):
    return np.concatenate(
        [
            (elastic if e.elastic else 1.0)
            * rng.normal(size=len(e.parameters))
            * [p.scale for p in e.parameters]
            for e in effects
        ]
    )


# --- derivatives ----------------------------------------------------------------------------


@pytest.mark.parametrize("arm", CELLS)
@pytest.mark.parametrize("name", NAMES)
def test_columns_are_the_derivative_of_the_deviation(name, arm):
    cell = CELLS[arm]
    s = situation(cell)
    effect = make(name, cell, s.states, options_of(name, 6))
    theta = random_theta((effect,), np.random.default_rng(0))
    derived = {field: 0.0 for field in FIELDS}
    size = len(effect.parameters)
    count, n = s.angle.shape
    for c in effect.columns(s):
        values = np.broadcast_to(c.values, (count, *c.values.shape[1:]))
        for k, (parameter, element) in enumerate(zip(c.parameter, c.element, strict=True)):
            if c.field in ("dq", "twist"):
                shape = (count, n) if c.field == "dq" else (count, n + 1, 6)
                block = np.zeros((size, *shape))
                block[parameter, :, element] += values[:, k]
            else:
                block = np.zeros((size, *values[:, k].shape))
                block[parameter] += values[:, k]
            derived[c.field] = derived[c.field] + block
    for p in range(size):
        scale = effect.parameters[p].scale

        def moved(h, p=p, scale=scale):
            return effect.deviation(theta + h * scale * np.eye(size)[p], s)

        for field in FIELDS:
            if getattr(moved(0.0), field) is None:
                assert np.ndim(derived[field]) == 0, field
                continue
            numeric = slope(lambda h, f=field, g=moved: getattr(g(h), f), 1.0)
            # The deviation is linear, so only rounding of it is left.
            size_of_it = np.abs(getattr(moved(0.0), field)).max() + np.abs(numeric).max()
            np.testing.assert_allclose(
                derived[field][p] * scale, numeric, rtol=0, atol=1e-14 * size_of_it + 1e-30
            )


@pytest.mark.parametrize("arm", CELLS)
@pytest.mark.parametrize("name", ELASTIC)
def test_response_is_the_derivative_by_the_slot_wrenches(name, arm):
    cell = CELLS[arm]
    s = situation(cell)
    effect = make(name, cell, s.states, options_of(name))
    rng = np.random.default_rng(3)
    theta = random_theta((effect,), rng)
    change = rng.normal(size=(len(s.states), 4, *s.wrench.shape[1:]))
    response = effect.response(theta, s, change)
    for p in range(4):

        def moved(h, p=p):
            return effect.deviation(theta, replace(s, wrench=s.wrench + h * change[:, p]))

        for field in ("dq", "twist"):
            derived = getattr(response, field)
            if getattr(moved(0.0), field) is None:
                assert derived is None
                continue
            numeric = slope(lambda h, f=field, g=moved: getattr(g(h), f), 1.0)
            size = np.abs(getattr(moved(0.0), field)).max()
            # Laws are polynomials of degree 3, so a difference of fourth order is exact.
            np.testing.assert_allclose(derived[:, p], numeric, rtol=0, atol=1e-13 * size)


@pytest.mark.parametrize("arm", CELLS)
def test_wrench_columns_of_load_point_are_the_derivative_of_the_slot_wrenches(arm):
    cell = CELLS[arm]
    s = situation(cell)
    effect = make("load_point", cell, s.states)
    derived = effect.wrench_columns(s)
    for p in range(3):

        def wrench(h, p=p):
            point = cell.load_point + effect.load_change(h * np.eye(3)[p]).point
            load = Load(s.states.wrench, point, cell.tool_mass, cell.tool_com, cell.gravity)
            return slot_wrenches(cell.arm, s.chain, load)

        numeric = slope(wrench, 1e-2)
        size = np.abs(wrench(0.0)).max() / 1e-2
        np.testing.assert_allclose(derived[:, p], numeric, rtol=0, atol=1e-13 * size)


def numeric_jacobian(model, states, theta, scale, m):
    """Central differences of the readings; rotations as small rotations."""
    base = model.predict(states, theta).observation.rotation
    out = np.empty((len(states), m, len(theta)))
    for p in range(len(theta)):

        def moved(h, p=p):
            o = model.predict(states, theta + h * scale[p] * np.eye(len(theta))[p]).observation
            turn = o.rotation @ np.swapaxes(base, 1, 2)
            skew = 0.5 * (turn - np.swapaxes(turn, 1, 2))
            w = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
            return np.concatenate([o.position, w], axis=1)[:, :m]

        out[:, :, p] = (moved(1.0) - moved(-1.0)) / 2
    return out


def give(model: Model, prediction, theta) -> float:
    """By how much more a unit motion of the arm deflects it: Σ compliance · (f·reach + m).

    What an analytic derivative at fixed wrenches leaves out is a motion's own change of the
    wrenches, so it is this share of the motion, at most.
    """
    s = prediction.situation
    reach = model.cell.arm.reach + np.linalg.norm(model.cell.load_point)
    force = np.linalg.norm(s.wrench[:, :, :3], axis=2).max()
    moment = np.linalg.norm(s.wrench[:, :, 3:], axis=2).max()
    total = 0.0
    for effect, rows in zip(model.effects, model.slices(), strict=True):
        slope = 3 * s.torque.max(axis=0) ** 2 if effect.name == "joint_stiffening" else 1.0
        total += float(np.abs(slope * theta[rows]).sum()) if effect.elastic else 0.0
    return total * (force * reach + moment)


@pytest.mark.parametrize(
    ("arm", "m", "elastic"), [("ur10e", 6, 1.0), ("ur10e", 6, 1e-3), ("odd", 3, 1e-3)]
)
def test_model_jacobian_is_the_derivative_of_the_prediction(arm, m, elastic):
    """All effects at once; what the derivative leaves out is of the order of the deflection."""
    cell = CELLS[arm]
    states = some_states(cell, 4)
    short = {"transmission_error": {"harmonics": 1}}
    model = Model(cell, tuple(make(n, cell, states, short.get(n, options_of(n, m))) for n in NAMES))
    scale = np.array([p.scale for e in model.effects for p in e.parameters])
    theta = random_theta(model.effects, np.random.default_rng(4), elastic)
    prediction = model.predict(states, theta)
    derived = model.jacobian(prediction, theta, m) * scale
    numeric = numeric_jacobian(model, states, theta, scale, m)
    size = np.abs(numeric).max(axis=(0, 1))
    off = np.abs(derived - numeric).max(axis=(0, 1))
    # Beside it the equilibrium's own tolerance, the rounding of readings of some metres, and
    # what a central difference over a milliradian leaves out (h²/6 of the motion).
    slack = 2e-12 + 1e-6 * size
    names = [f"{e.name}.{p.name}" for e in model.effects for p in e.parameters]
    limit = give(model, prediction, theta) * size + slack
    assert {n: (o, b) for n, o, b in zip(names, off, limit, strict=True) if o > b} == {}


def test_jacobian_of_an_effect_that_is_not_in_the_model_is_that_at_zero():
    cell = CELLS["ur10e"]
    states = some_states(cell)
    model = Model(cell, (make("joint_compliance", cell, states),))
    theta = random_theta(model.effects, np.random.default_rng(0))
    prediction = model.predict(states, theta)
    for name in NAMES[1:]:
        if name in model.names:
            continue
        effect = make(name, cell, states, options_of(name))
        outside = model.jacobian_of((effect,), prediction, theta, 3)
        larger = model + effect
        full = np.concatenate([theta, np.zeros(len(effect.parameters))])
        inside = larger.jacobian(larger.predict(states, full), full, 3)[:, :, len(theta) :]
        # The two equilibria may differ by their tolerance of 1e-13 m.
        np.testing.assert_allclose(outside, inside, rtol=1e-11, atol=1e-11, err_msg=name)


# --- laws, against the simulated world ------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Both:
    """A world and a model of the same cell that hold the same parameters."""

    world: World
    model: Model
    theta: np.ndarray


def truth_of(name: str, cell: Cell, rng: np.random.Generator, scale: float) -> np.ndarray:
    """Random parameters, shaped as in the world."""
    zero = getattr(Truth.rigid(cell.arm, 3), name)
    effect = make(name, cell, some_states(cell), options_of(name))
    ordinary = np.array([p.scale for p in effect.parameters])
    drawn = rng.normal(size=len(ordinary))
    if name == "joint_compliance":  # an arm that gives way, also where it stiffens
        drawn = 1 + np.abs(drawn)
    return (scale * ordinary * drawn).reshape(zero.shape)


def both(names: tuple[str, ...], cell: Cell, states: States, scale: float) -> Both:
    rng = np.random.default_rng(11)
    truth = Truth.rigid(cell.arm)
    for name in names:
        truth = truth.with_effect(name, truth_of(name, cell, rng, scale))
    world = World(cell, truth, cell.registration, np.eye(4), TrackerNoise(), np.zeros(cell.arm.n))
    model = Model(cell, tuple(make(n, cell, states, options_of(n)) for n in names))
    theta = np.concatenate([true_parameters(world, n) for n in names])
    return Both(world, model, theta)


def apart(b: Both, states: States) -> tuple[float, float]:
    """Largest distance, m, and angle, rad, of the model's readings from the world's."""
    seen, told = b.model.predict(states, b.theta).observation, b.world.sight(states)
    turn = np.abs(seen.rotation - told.rotation).max()
    return float(np.linalg.norm(seen.position - told.position, axis=1).max()), float(turn)


def order_of_turns(b: Both, states: States) -> float:
    """Sum of the tilts times the sum of all small rotations, rad²: what their order can make out.

    A tilt is one small rotation about the moment's axis in the program and two successive
    rotations about x and y in the world.
    """
    p = b.model.predict(states, b.theta)
    tilt = total = 0.0
    for effect, rows in zip(b.model.effects, b.model.slices(), strict=True):
        d = effect.deviation(b.theta[rows], p.situation)
        if d.twist is not None:
            turn = np.linalg.norm(d.twist[:, :, 3:], axis=2).sum(axis=1).max()
            total += turn
            tilt += turn if effect.name in TILTING else 0.0
        if d.dq is not None:
            total += np.abs(d.dq).sum(axis=1).max()
    return float(tilt * total)


TILTING = ("joint_tilt_compliance", "base_compliance")
ALONE = tuple((n,) for n in NAMES if n not in ("load_point", "joint_stiffening"))
TOGETHER = (("joint_compliance", "load_point"), ("joint_compliance", "joint_stiffening"))


@pytest.mark.parametrize("arm", CELLS)
@pytest.mark.parametrize("names", [*ALONE, *TOGETHER, NAMES], ids="+".join)
def test_prediction_is_what_the_world_shows(names, arm):
    cell = CELLS[arm]
    states = some_states(cell, 6)
    for scale in (1.0, 1e-2):
        b = both(names, cell, states, 0.3 * scale)
        rigid = replace(b.world, physics=Truth.rigid(cell.arm))
        change = b.world.sight(states).position - rigid.sight(states).position
        moved = np.linalg.norm(change, axis=1).max()
        distance, turn = apart(b, states)
        reach = cell.arm.reach + np.linalg.norm(cell.registration[:3, 3])
        limit = order_of_turns(b, states) * reach
        # Equilibria to 1e-12 rad in the world and 1e-13 m here, of an arm of a metre or two.
        assert distance <= limit + 1e-11
        assert turn <= limit / reach + 1e-11
        assert limit < 0.05 * moved
        assert moved > 1e-7


def test_a_tilt_turns_across_the_joint_axis_by_the_moment_there():
    cell = CELLS["odd"]
    s = situation(cell)
    effect = make("joint_tilt_compliance", cell, s.states)
    k = 1e-6 * np.arange(1, cell.arm.n + 1)
    twist = effect.deviation(k, s).twist
    axis = np.swapaxes(s.chain.rotation[:-1, :, :, 2], 0, 1)
    in_slots = np.moveaxis(s.chain.rotation[:-1], 0, 1)
    turn = np.einsum("njab,njb->nja", in_slots, twist[:, :-1, 3:])
    moment = np.einsum("njab,njb->nja", in_slots, s.wrench[:, :-1, 3:])
    across = moment - axis * np.sum(axis * moment, axis=2, keepdims=True)
    np.testing.assert_allclose(turn, k[:, None] * across, rtol=0, atol=1e-15)
    assert np.all(twist[:, :, :3] == 0)
    assert np.all(twist[:, -1] == 0)


@pytest.mark.parametrize("arm", CELLS)
def test_base_compliance_turns_the_arm_about_the_base_origin(arm):
    """To first order the target moves by (B t_0) × x, with t_0 the moment about the origin."""
    cell = CELLS[arm]
    states = some_states(cell)
    model = Model(cell, (make("base_compliance", cell, states),))
    rigid = model.predict(states, np.zeros(3))
    b = 1e-9 * np.array([3.0, 1.0, 2.0])
    bent = model.predict(states, b)
    chain, arm_ = rigid.situation.chain, cell.arm
    weight = cell.gravity
    moment = states.wrench[:, 3:] + np.cross(chain.point(cell.load_point), states.wrench[:, :3])
    moment = moment + np.cross(chain.point(cell.tool_com), cell.tool_mass * weight)
    for mass, com in zip(arm_.masses, chain.com, strict=True):
        moment = moment + np.cross(com, mass * weight)
    turn = b * moment
    expected = np.cross(turn, rigid.observation.base_position)
    moved = bent.observation.position - rigid.observation.position
    reach = arm_.reach + 1.0
    second_order = np.abs(turn).max() ** 2 * reach * 10
    np.testing.assert_allclose(
        moved @ cell.registration[:3, :3], expected, rtol=0, atol=second_order + 1e-14
    )


def test_a_zero_error_of_the_first_joint_is_a_turn_of_the_base_about_z():
    cell = CELLS["ur10e"]
    states = some_states(cell)
    offset = Model(cell, (make("encoder_offset", cell, states),))
    frame = Model(cell, (make("base_frame", cell, states),))
    a = offset.predict(states, 0.01 * np.eye(6)[0]).observation
    b = frame.predict(states, 0.01 * np.eye(6)[5]).observation
    np.testing.assert_allclose(a.position, b.position, rtol=0, atol=1e-14)
    np.testing.assert_allclose(a.rotation, b.rotation, rtol=0, atol=1e-14)


def test_harmonics_and_sides_are_what_they_say():
    cell = CELLS["ur10e"]
    s = situation(cell)
    effect = make("transmission_error", cell, s.states, {"harmonics": 4})
    theta = np.random.default_rng(0).normal(size=48)
    by_name = {p.name: t for p, t in zip(effect.parameters, theta, strict=True)}
    dq = effect.deviation(theta, s).dq
    for j in range(6):
        q = s.angle[:, j]
        expected = sum(
            by_name[f"j{j + 1}.cos{k}"] * np.cos(k * q)
            + by_name[f"j{j + 1}.sin{k}"] * np.sin(k * q)
            for k in range(1, 5)
        )
        np.testing.assert_allclose(dq[:, j], expected, rtol=0, atol=1e-13)
    h = np.arange(1.0, 7.0)
    dq = make("hysteresis", cell, s.states).deviation(h, s).dq
    np.testing.assert_array_equal(dq, h * s.states.approach)


def test_drift_starts_at_its_reference_time():
    cell = CELLS["ur10e"]
    states = some_states(cell)
    rate = 1e-8 * np.arange(1.0, 7.0)
    for reference, start in ((None, states.time.min()), (100.0, 100.0)):
        given = {} if reference is None else {"reference_s": reference}
        effect = make("tracker_drift", cell, states, given)
        station = effect.deviation(rate, situation_of(cell, states)).station
        np.testing.assert_allclose(station, (states.time - start)[:, None] * rate, rtol=1e-13)


def situation_of(cell: Cell, states: States) -> Situation:
    return Model(cell, ()).predict(states, np.zeros(0)).situation


# --- what is refused ------------------------------------------------------------------------


def test_an_unknown_effect_is_refused_with_the_valid_names():
    with pytest.raises(InputError, match="unknown effect 'joint_complience'") as caught:
        effect_class("joint_complience")
    assert all(name in str(caught.value) for name in NAMES)
    assert "joint_compliance" in str(caught.value).split("valid")[0]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", NAMES)
def test_an_unknown_option_is_refused_with_the_valid_ones(name):
    cell = CELLS["ur10e"]
    with pytest.raises(InputError, match=f"{name}: unknown option 'colour'") as caught:
        make(name, cell, some_states(cell), {"colour": 1})
    valid = effect_class(name).option_names or ("none",)
    assert all(option in str(caught.value) for option in valid)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("transmission_error", {"harmonics": 0}, "harmonics = 0; valid: 1 to 1000"),
        ("transmission_error", {"harmonics": 2.5}, "harmonics = 2.5"),
        ("transmission_error", {"harmonics": True}, "harmonics = True"),
        ("target_offset", {"rotation": "yes"}, "rotation = 'yes'; valid: true, false"),
        ("tracker_drift", {"reference_s": "noon"}, "reference_s = 'noon'; valid: a finite number"),
        ("tracker_drift", {"reference_s": float("nan")}, "reference_s = nan"),
        ("tracker_drift", {"span_s": 0.0}, "span_s"),
        ("base_frame", {"prior_m": 1.0}, "prior_m alone"),
        ("base_frame", {"prior_m": 1.0, "prior_rad": -1.0}, "must be positive"),
        ("base_frame", {"prior_m": "wide", "prior_rad": 1.0}, "prior_m = 'wide'"),
    ],
)
def test_an_impossible_option_is_refused(name, options, message):
    cell = CELLS["ur10e"]
    with pytest.raises(InputError, match=message):
        make(name, cell, some_states(cell), options).prior_std()


@pytest.mark.parametrize(
    ("name", "column"), [("hysteresis", "approach"), ("tracker_drift", "time")]
)
def test_a_missing_column_is_named(name, column):
    cell = CELLS["ur10e"]
    states = replace(some_states(cell), **{column: None})
    assert not effect_class(name).computable(states)
    with pytest.raises(InputError, match=f"{name} needs {column}"):
        make(name, cell, states)


def test_the_same_effect_twice_is_refused():
    cell = CELLS["ur10e"]
    states = some_states(cell)
    model = Model(cell, (make("hysteresis", cell, states),))
    with pytest.raises(InputError, match="hysteresis is in the model already"):
        model + make("hysteresis", cell, states)


def test_the_catalogue_has_all_effects_of_the_vocabulary():
    assert set(NAMES) <= set(catalogue())
    for name, kind in catalogue().items():
        assert kind.name == name
        assert kind.summary


# --- a user's own ---------------------------------------------------------------------------


class ForearmGrowth(Effect):
    """The forearm grows along its own axis in time: a twist of slot 2 along x, m/s."""

    name = "forearm_growth"
    summary = "the forearm grows in time"
    needs = ("time",)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("rate", "m/s", 1e-8),)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        values = s.states.time[:, None, None] * np.eye(6)[:1]
        return (Columns("twist", np.array([0]), np.array([2]), values),)


def test_a_users_effect_takes_part_unchanged():
    c = campaign(plan_seed=0, registration_known=True)
    p = plan()
    grown = make("joint_compliance", c.cell, p.states), ForearmGrowth(c.cell, p.states)
    model = Model(c.cell, grown)
    truth = np.append(c.world.physics.joint_compliance, 4e-7)
    prediction = model.predict(p.states, truth)
    numeric = numeric_jacobian(model, p.states, truth, np.array([1e-5] * 6 + [1e-7]), 3)[:, :, 6]
    derived = 1e-7 * model.jacobian(prediction, truth, 3)[:, :, 6]
    size = np.abs(numeric).max()
    np.testing.assert_allclose(
        derived, numeric, rtol=0, atol=give(model, prediction, truth) * size + 1e-12
    )
    clean: Readings = replace(c.readings, value=prediction.observation.position)
    found = fit(model, clean, "absolute")
    np.testing.assert_allclose(found.theta, truth, rtol=1e-8)
