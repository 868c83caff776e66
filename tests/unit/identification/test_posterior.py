"""What a campaign taught of an arm: marginal over the setup, without information where unseen."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from hilcal.effects.catalogue import installed
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.identification.posterior import Posterior, Source
from hilcal.identification.posterior_document import read, write
from hilcal.identification.predictive import predictive
from hilcal.readings.same_readings import among
from tests.support.campaigns import campaign


@cache
def fitted(*names: str) -> Fit:
    c = campaign("link_geometry", "absolute", 2, poses=30, strength=2.0, target_known=False)
    return fit(with_effects(c.cell, c.readings, "absolute", names), c.readings, "absolute")


def test_the_setup_is_marginalised_out() -> None:
    found = fitted("joint_compliance", "encoder_offset")
    assert {"base_frame", "target_offset"} < set(found.model.names)
    p = Posterior.of(found, Source("a.hilcal", 3))
    assert [e.name for e in p.effects] == ["joint_compliance", "encoder_offset"]
    names = [f"{e.name}.{q.name}" for e in found.model.effects for q in e.parameters]
    mine = [names.index(n) for n in p.names]
    # The whole covariance's part is the inverse of the Schur complement of the whole information:
    # that of a fit to readings whose noise has the misfit, since the geometry is missing here.
    used, s = found.readings, found.solution
    left_out = found.holdout.rms_sigma
    more = predictive(found.model, s.theta, s.prior, used, "absolute", left_out).excess
    assert more.position > 0
    wide = fit(found.model, more.of_readings(used, "absolute"), "absolute", start=s.theta)
    std, seen = wide.uncertainty.formal[mine], np.isfinite(p.std)
    ratio = p.std[seen] / std[seen]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-3)
    assert ratio[0] > 1.0
    # A joint's zero that a turn of the base or the target hides is not known.
    assert not seen[p.index("encoder_offset")].all()
    assert seen[p.index("joint_compliance")].all()
    assert p.source.n_readings == len(found.readings)


def test_a_misfit_widens_what_is_stated() -> None:
    """The geometry is missing in this model."""
    found = fitted("joint_compliance", "encoder_offset")
    p = Posterior.of(found)
    names = [f"{e.name}.{q.name}" for e in found.model.effects for q in e.parameters]
    std = found.uncertainty.formal[[names.index(n) for n in p.names]]
    seen = np.isfinite(p.std)
    assert found.variance_factor > 1.2**2
    assert (p.std[seen] > np.sqrt(found.variance_factor) * std[seen]).all()


def test_it_comes_back_exactly(tmp_path: Path) -> None:
    p = Posterior.of(fitted("joint_compliance", "transmission_error", "link_geometry"))
    again = Posterior.from_json(json.loads(json.dumps(p.to_json())))
    for name in ("mean", "information", "own_precision", "scale", "links", "prints"):
        np.testing.assert_array_equal(getattr(again, name), getattr(p, name))
    for name in ("arm", "mode", "effects", "names", "units", "scatter", "ranges", "source"):
        assert getattr(again, name) == getattr(p, name)
    path = tmp_path / "a.json"
    write(p, path)
    np.testing.assert_array_equal(read(path).information, p.information)


def test_what_was_not_determined_has_no_information() -> None:
    p = Posterior.of(fitted("joint_compliance", "link_geometry"))
    geometry = p.index("link_geometry")
    information = p.marginal(geometry) * 1e-6
    values, vectors = np.linalg.eigh(information)
    assert abs(values[0]) < 1e-12 * values[-1]
    null = vectors[:, values < 1e-12 * values[-1]]
    # A shift of the first link is one of the base.
    frames = [0, 1, 2]
    np.testing.assert_allclose(np.linalg.norm(null[frames], axis=1), 1.0, atol=1e-3)
    assert np.isinf(p.std[geometry[frames]]).all()
    assert np.isfinite(p.std[p.index("joint_compliance")]).all()


def test_a_harmonic_that_was_dropped_is_not_known_to_be_zero() -> None:
    found = fitted("joint_compliance", "transmission_error")
    family = found.model.slices()[found.model.names.index("transmission_error")]
    dropped = np.flatnonzero(found.solution.prior[family] == 0)
    assert len(dropped)
    p = Posterior.of(found)
    std = p.std[p.index("transmission_error")][dropped]
    assert (std > 0).all()
    assert np.isfinite(std).all()


def test_its_readings_are_known_again() -> None:
    found = fitted("joint_compliance")
    p = Posterior.of(found)
    assert among(found.readings[5:9], p.prints).all()
    other = campaign("link_geometry", "absolute", 3, poses=30, strength=2.0, target_known=False)
    assert not among(other.readings, p.prints).any()


def test_refusals() -> None:
    c = campaign("link_geometry", "absolute", 2, poses=30, strength=2.0, target_known=False)
    bare = fit(with_effects(c.cell, c.readings, "absolute", ()), c.readings, "absolute")
    with pytest.raises(CannotAnswerError, match="no effect of the arm"):
        Posterior.of(bare)
    model = with_effects(c.cell, c.readings, "absolute", ("joint_compliance",))
    with pytest.raises(InputError, match="scaling gc"):
        Posterior.of(fit(model, c.readings, "absolute", "none"))
    p = Posterior.of(fitted("joint_compliance")).to_json()
    for damaged, words in (
        ({}, "format"),
        ({**p, "version": 9}, "version 9"),
        ({**p, "mean": [1.0]}, "damaged"),
    ):
        with pytest.raises(InputError, match=words):
            Posterior.from_json(damaged)


def test_every_effect_says_whose_it_is() -> None:
    setup = {kind.name for kind in installed().effects if kind.of_setup}
    assert {"base_frame", "target_offset", "tracker_drift", "wrench_bias", "load_point"} <= setup
    assert not {"joint_compliance", "link_geometry", "transmission_error"} & setup
