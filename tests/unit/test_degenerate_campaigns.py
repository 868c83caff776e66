"""Whatever is measured, however little or odd: an answer, or the program's own one-line error."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import hilcal as hc
from hilcal.diagnosis.diagnosis import VERDICTS
from hilcal.errors import HilcalError
from tests.support.campaigns import cell_of, noiseless, plan, with_noise, world_of

EXTRA = ("joint_tilt_compliance", "link_compliance", "transmission_error", "link_geometry")


@st.composite
def odd_campaigns(draw):
    """A campaign with something missing, constant or out of scale."""
    cell = cell_of(registration_known=draw(st.booleans()), target_known=draw(st.booleans()))
    rng, m = np.random.default_rng(draw(st.integers(0, 9))), draw(st.sampled_from([3, 6]))
    whole = with_noise(noiseless(world_of(cell, rng), plan(10, 3), m), rng)
    mode = draw(st.sampled_from(["absolute", "deflection"]))
    kept = whole.pose < draw(st.sampled_from([1, 2, 3, 5, 10]))
    if draw(st.booleans()):
        kept &= whole.unloaded | (whole.load == 1)
    if mode == "absolute" and draw(st.booleans()):
        kept &= whole.unloaded
    some = whole[np.flatnonzero(kept)]
    q = some.states.q.copy()
    still = draw(st.lists(st.integers(0, 5), max_size=6, unique=True))
    q[:, still] = q[0, still]
    time = draw(st.sampled_from([None, np.full(len(q), 3.0), np.arange(len(q), dtype=float)]))
    states = replace(some.states, q=q)
    if time is not None:
        warm = np.tile(time[:, None], 6)
        states = replace(
            states,
            time=time,
            load_time=time,
            air_temperature=time,
            joint_temperature=warm,
            approach=np.where(warm > time.mean(), 1.0, -1.0),
        )
    value = _values(draw(st.sampled_from(["as read", "equal", "one orientation"])), some.value)
    covariance = some.covariance * 10.0 ** draw(st.sampled_from([0, 0, -6, -12, 6, 12]))
    if draw(st.booleans()):
        covariance[::2, 0] = covariance[::2, :, 0] = 0.0
    odd = replace(
        some, states=states, value=value, covariance=covariance, scatter_stated=draw(st.booleans())
    )
    twice = np.append(np.arange(len(q)), np.arange(len(q)))
    return odd[twice] if draw(st.booleans()) else odd, cell, mode


def _values(kind, value):
    out = value.copy()
    if kind == "equal":
        out[:] = out[0]
    elif kind == "one orientation":
        out[:, 3:] = out[:1, 3:]
    return out


def judged_or_refused(of, extra):
    readings, cell, mode = of
    refused = ""
    try:
        model = hc.baseline(cell, readings, mode)
        if extra is None:
            assert hc.refine(model, readings, mode).verdict in VERDICTS.values()
        else:
            fitted = hc.fit(model + hc.effect(extra), readings, mode)
            assert hc.diagnose(fitted).verdict in VERDICTS.values()
    except HilcalError as error:
        refused = str(error)
    assert "\n" not in refused


@pytest.mark.long
@settings(max_examples=6, suppress_health_check=list(HealthCheck))
@given(odd_campaigns(), st.sampled_from(EXTRA))
def test_odd_campaigns_are_judged_or_refused_in_words(of, extra):
    judged_or_refused(of, extra)


def test_a_campaign_in_which_nothing_is_unknown_is_judged():
    """Known frames and no load: the first model has no parameter at all."""
    cell = cell_of(registration_known=True)
    rng = np.random.default_rng(3)
    whole = with_noise(noiseless(world_of(cell, rng), plan(16)), rng)
    some = whole[np.flatnonzero(whole.unloaded)]
    model = hc.baseline(cell, some, "absolute")
    assert model.size == 0
    assert hc.refine(model, some, "absolute").verdict in VERDICTS.values()
