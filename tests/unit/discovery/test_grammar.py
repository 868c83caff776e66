"""What laws are made of: functions of one variable, quantities, and which are tried."""

import numpy as np
import pytest

from hilcal.discovery import grammar as products
from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Amplitude, Factor, variables
from hilcal.discovery.grammar import grammar
from hilcal.discovery.law import Form, LawPart, effect_class, source_of_form
from hilcal.discovery.sites import sites
from hilcal.effects.check import check_effect, example_cell, example_situation, example_states
from hilcal.effects.force_sensor import recorded


def test_every_function_is_an_effect_with_its_derivative() -> None:
    cell = example_cell()
    s = example_situation(cell, example_states(cell))
    known = {v.kind: v for v in variables(s)}
    torque, angle, side = known["torque"], known["angle"], known["side"]
    made = [
        Factor(torque, shapes.LINEAR),
        Factor(torque, shapes.ODD, (2.0, 0.0)),
        Factor(torque, shapes.ODD, (0.5, 0.3)),
        Factor(torque, shapes.EVEN, (1.0, 0.0)),
        Factor(torque, shapes.EVEN, (1.7, 0.3)),
        Factor(torque, shapes.EVEN, (0.6, 0.3)),
        Factor(torque, shapes.THRESHOLD, (5.0,)),
        Factor(torque, shapes.PLUS),
        Factor(torque, shapes.MINUS),
        Factor(torque, shapes.SATURATION, (20.0,)),
        Factor(torque, shapes.SIN, (0.05,)),
        Factor(torque, shapes.COS, (0.05,)),
    ]
    places = sites(cell.arm.n)
    for k, factor in enumerate(made):
        other = Factor(angle, shapes.COS, (2.0,)) if k % 2 else Factor(side, shapes.LINEAR)
        site = places[(5 * k) % 18]
        if not site.takes(True):
            site = places[0]
        form = Form(
            (
                LawPart(site, Amplitude((factor, other)), 0),
                LawPart(places[1], Amplitude((factor,)), 1),
            )
        )
        check_effect(effect_class(source_of_form(form, "tried"), "tried"))


@pytest.mark.parametrize("joint", [1, 3])
@pytest.mark.parametrize(
    ("shape", "numbers"),
    [
        (shapes.PLUS, ()),
        (shapes.MINUS, ()),
        (shapes.ABOVE, (0.0,)),
        (shapes.ABOVE_POWER, (0.0, 1.5)),
        (shapes.BELOW_POWER, (0.0, 1.2)),
        (shapes.SATURATION, (0.05,)),
    ],
)
def test_a_one_sided_law_is_an_effect_also_where_nothing_hangs(
    shape: shapes.Shape, numbers: tuple[float, ...], joint: int
) -> None:
    """Joint 1 of an unloaded arm has no torque: the states are at the bend itself."""
    cell = example_cell()
    s = example_situation(cell, example_states(cell))
    (torque,) = (v for v in variables(s) if v.symbol == f"τ_{joint}")
    form = Form((LawPart(sites(6)[joint - 1], Amplitude((Factor(torque, shape, numbers),)), 0),))
    check_effect(effect_class(source_of_form(form, "tried"), "tried"))


def test_fine_waves_are_tried_up_to_the_number_of_poses_and_in_no_product(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(products, "MOST", 3)
    cell = example_cell()
    s = example_situation(cell, example_states(cell))
    words = grammar([v for v in variables(s) if v.kind == "angle"][:2], s, 14)
    fine = [a for a in words.amplitudes if any(f.shape.cost == 3 for f in a.factors)]
    assert {a.factors[0].numbers[0] for a in fine} == set(range(5, 15))
    assert all(len(a.factors) == 1 for a in fine)
    place = words.place(fine[0])
    assert place is not None
    partner = words.amplitudes[words.partner[place]].factors[0]
    assert (partner.shape.name, partner.numbers) == ("sin", fine[0].factors[0].numbers)


def test_every_quantity_reads_the_same_in_the_written_effect() -> None:
    cell = example_cell()
    s = example_situation(cell, example_states(cell))
    for v in variables(s):
        read = eval(v.code, {"s": s, "np": np, "recorded": recorded})
        assert np.allclose(read, v.read(s), rtol=1e-12, atol=0), v.names
