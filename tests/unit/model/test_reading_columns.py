"""The derivative by many effects at once is the sum of its products, column by column."""

from typing import get_args

import numpy as np
import pytest

from hilcal.effects.protocol import Columns, Field
from hilcal.model.equilibrium import WIDE, ReadingColumns
from hilcal.model.observe import ReadingDerivative
from hilcal.types import Floats, Ints
from tests.unit.model.test_observe import COUNT, FULL, NO_LOAD, motion_of

SIZE = WIDE + 30
PER_ELEMENT = {"dq": 6, "twist": 7}


def drawn(rng: np.random.Generator) -> list[tuple[Columns, Ints]]:
    """Blocks of all fields: parameters left out, in any order, twice in one block, in several."""
    out = []
    for _ in range(30):
        field = rng.choice(get_args(Field))
        count = int(rng.integers(1, 9))
        element = np.sort(rng.integers(0, PER_ELEMENT.get(field, 1), count))
        parameter = rng.integers(0, count, count) if rng.random() < 0.3 else np.arange(count)
        place = rng.permutation(SIZE - 10)[:count]
        if rng.random() < 0.5:
            place = np.arange(count) + int(rng.integers(SIZE - 20))
        place[rng.random(count) < 0.2] = -1
        tail = () if field in ("dq", "scale") else (6,)
        values = rng.normal(size=(COUNT if rng.random() < 0.6 else 1, count, *tail))
        if tail:
            values[..., rng.random(6) < 0.5] = 0.0
        out.append((Columns(field, parameter, element, values), place))
    return out


def expected(moves: ReadingDerivative, blocks: list[tuple[Columns, Ints]], scale: Floats) -> Floats:
    """Sum them one by one."""
    out = np.zeros((COUNT, moves.m, SIZE))
    fields = ("base", "station", "target", "observer")
    sides = {field: getattr(moves, f"by_{field}") for field in fields}
    for c, place in blocks:
        for k, at in enumerate(place[c.parameter]):
            if at < 0:
                continue
            values = np.broadcast_to(c.values[:, k], (COUNT, *c.values.shape[2:])) * scale[at]
            if c.field == "dq":
                out[:, :, at] += moves.dq[:, :, c.element[k]] * values[:, None]
            elif c.field == "scale":
                out[:, :, at] += moves.by_scale()[:, :, 0] * values[:, None]
            else:
                moved = moves.by_slot(c.element[k]) if c.field == "twist" else sides[c.field]()
                out[:, :, at] += np.einsum("nme,ne->nm", moved, values)
    return out


def written(
    moves: ReadingDerivative, blocks: list[tuple[Columns, Ints]], scale: Floats | None
) -> Floats:
    out = np.full((COUNT, moves.m, SIZE), np.nan)
    columns = ReadingColumns(moves, [], NO_LOAD, out, scale)
    for c, place in blocks:
        columns.add(c, place)
    columns.write()
    return out


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("seed", range(4))
def test_columns_of_all_fields_together_are_those_one_by_one(seed: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    moves, blocks = motion_of(FULL, m), drawn(rng)
    if seed % 2:  # many of one joint, which are written at once
        many = np.arange(WIDE)
        wide = Columns("dq", many, np.full(WIDE, 4), rng.normal(size=(COUNT, WIDE)))
        blocks.insert(seed, (wide, many + 20))
    scale = rng.uniform(0.5, 2.0, SIZE)
    for units in (None, scale):
        found = written(moves, blocks, units)
        aim = expected(moves, blocks, np.ones(SIZE) if units is None else units)
        np.testing.assert_allclose(found, aim, rtol=0, atol=1e-13 * np.abs(aim).max())


def test_nothing_added_is_zero() -> None:
    assert not written(motion_of(FULL), [], None).any()
