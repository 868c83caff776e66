"""Minimum detectable size of a family that the number of poses limits."""

import numpy as np

from hilcal.diagnosis.effect_ranking import candidates, rank_suspects
from hilcal.diagnosis.minimum_detectable_effect import least_strength
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.linearisation import effect_columns, linearise
from hilcal.present.diagnosis import detectable_sizes
from hilcal.regression.evidence import spectrum
from tests.support.campaigns import campaign
from tests.support.diagnosis_cases import fitted_baseline

ERROR = "transmission_error"


def found(poses):
    c = campaign("none", "absolute", 0, poses=poses, plan_seed=0)
    return fitted_baseline(c)


def test_a_family_is_seen_from_where_poses_left_out_show_it_and_not_finer_than_poses_resolve():
    f = found(12)
    p = linearise(f)
    (e,) = (e for e in candidates(f) if e.name == ERROR)
    (s,) = rank_suspects(p, [e])
    of = effect_columns(f, e)
    units = tuple(q.unit for q in e.parameters)
    known = p.information(of.white)
    rank = spectrum(known).rank
    alone = least_strength(known, of.motion, of.scale, units, f.dof, 1.0, 1e-3, rank)
    assert s.least.visible
    assert s.least.displacement_m > alone.displacement_m
    assert s.least.finest_m == np.inf
    assert s.least.to_dict()["finer_than_poses"] == {"visible": False, "displacement_m": None}
    said = [line for line in detectable_sizes(diagnose(f)) if isinstance(line, str)]
    assert f"A {ERROR} finer than these poses resolve would be seen at no size.\n" in said


def test_more_poses_show_smaller_ones():
    sizes = []
    for poses in (12, 30):
        f = found(poses)
        (e,) = (e for e in candidates(f) if e.name == ERROR)
        sizes.append(rank_suspects(linearise(f), [e])[0].least.displacement_m)
    assert sizes[1] < 0.6 * sizes[0]
