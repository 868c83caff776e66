"""Shifts are projected off one after the other as if P were written out."""

import numpy as np
import pytest

from hilcal.data.whitening import MODES, Mode, whitening
from hilcal.identify import wide_effects
from hilcal.identify.baseline import baseline
from hilcal.identify.data_snooping import _candidates, _Elimination, _inverse_root, _projection
from hilcal.identify.fit import fit
from hilcal.regression.factored import Factored, written
from tests.support.campaigns import campaign


@pytest.mark.parametrize(("mode", "least"), [*((mode, 64) for mode in MODES), ("absolute", 4)])
def test_selected_shifts_are_projected_off_exactly(
    mode: Mode, least: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(wide_effects, "WIDE", least)
    c = campaign("joint_compliance", mode, poses=12)
    model = baseline(c.cell, c.readings, mode)
    for name in ("transmission_error", "joint_compliance"):
        if name not in model.names:
            states = c.readings.states
            model += model.catalogue.make(name, model.cell, states, {}, c.readings.m)
    found = fit(model, c.readings, mode)
    w = whitening(c.readings, mode)
    e, columns, root = _projection(model, found.solution, c.readings, w)
    assert isinstance(columns, Factored) == (least == 4)
    b = written(columns)
    p = np.eye(len(b)) - b @ root.T @ root @ b.T
    pull = np.zeros(len(root))
    pull[: len(found.solution.ridge)] = found.solution.ridge * found.solution.coordinates()
    left = p @ found.solution.white + b @ root.T @ root @ pull
    np.testing.assert_allclose(e, left, rtol=0, atol=1e-10)
    shifts = _candidates(w)
    s = np.swapaxes(shifts.gradients(np.eye(len(b))), 1, 2)  # (N, R, m)
    off = _Elimination(shifts, columns, root)
    a = off.information()
    exact = np.swapaxes(s, 1, 2) @ p @ s
    np.testing.assert_allclose(a, exact, rtol=0, atol=1e-11 * np.abs(exact).max())
    last = len(s) - 1
    for k in (3, 4, last, 3 + len(s) // 2, last - 1):
        inner = np.swapaxes(s, 1, 2) @ p @ s
        chosen = _inverse_root(inner[k], float(np.trace(inner[k])))
        slope = np.swapaxes(s, 1, 2) @ p @ s[k] @ chosen
        seen = off.eliminate(k, chosen)
        np.testing.assert_allclose(seen, slope, rtol=0, atol=1e-9 * np.abs(slope).max())
        gone = p @ s[k] @ chosen
        p = p - gone @ gone.T
