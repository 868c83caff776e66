"""A fleet in rerun: the odd arm is red, in its joint, and stands by its dates."""

import numpy as np
import pytest
import rerun as rr

from hilcal.present.viewer import style
from hilcal.present.viewer.fleet import DrawnType, arm_positions, record_fleet
from hilcal.robot.scene import capsules
from hilcal.transfer.fleet import Fleet, pool
from tests.support.picture import Shot, needs_vulkan, pictures
from tests.support.recordings import chunks, entities, rows
from tests.support.viewer_plan import rgb
from tests.unit.fleet.test_fleet import ARMS, ODD, members, posterior_of, readings_of


@pytest.fixture(scope="module")
def one():
    return posterior_of(readings_of(np.ones(6), 1))


def fleet(one, odd):
    """30 arms in January and March, of which one may have a soft joint 3."""
    mine = members(one, 3, odd=odd)
    of = pool(mine, ())
    return Fleet((of,), tuple(mine), ()), of


def recorded(one, path, odd):
    rr.set_strict_mode(True)
    try:
        record_fleet(fleet(one, odd)[0], path)
    finally:
        rr.set_strict_mode(False)
    return path


def test_campaigns_are_as_far_from_the_type_as_their_arm(one):
    whole, of = fleet(one, 1.5)
    d = DrawnType(of, whole.members)
    assert np.argwhere(d.odd).tolist() == [[ODD, d.names.index("joint_compliance.j3")]]
    assert d.joints == tuple(int(name[-1]) for name in d.names)
    assert (d.pooled.distance.shape, d.campaigns.shape) == (
        (ARMS, len(d.names)),
        (2 * ARMS, len(d.names)),
    )
    assert [d.owner[k] for k in (0, 1, 2)] == [0, 0, 1]
    assert d.seconds[1] - d.seconds[0] == 59 * 86400
    odd = d.campaigns[d.owner == ODD][:, d.names.index("joint_compliance.j3")]
    assert (odd > 5).all()
    apart = np.linalg.norm(arm_positions(d)[:, None] - arm_positions(d), axis=2) + 10 * np.eye(ARMS)
    assert apart.min() > 0.5


@pytest.mark.long
def test_the_odd_joint_alone_is_red_and_its_arm_framed(one, tmp_path):
    path = recorded(one, tmp_path / "fleet.rrd", 1.5)
    d = DrawnType(fleet(one, 1.5)[1], fleet(one, 1.5)[0].members)
    shapes = capsules(d.arm)
    colors = [rgb(c) for c in rows(path, "/arms0/arms", "Capsules3D:colors")[0]]
    red = [k for k, c in enumerate(colors) if c == style.RED]
    assert red == [ODD * len(shapes) + k for k, s in enumerate(shapes) if s.body == 3]
    (centre,) = rows(path, "/arms0/unlike", "Boxes3D:centers")[0]
    np.testing.assert_allclose(centre[:2], arm_positions(d)[ODD, :2], atol=1e-6)
    words = rows(path, "/words/type0", "TextDocument:text")[0][0]
    assert f"arm{ODD} is unlike the others" in words
    drifts = {e for e in entities(path) if e.startswith("/date0/")}
    assert [e for e in drifts if "unlike" in e] == [f"/date0/2/zunlike/{ODD}"]
    told = [c.to_record_batch() for c in chunks(path, f"/date0/2/zunlike/{ODD}")]
    assert sum(b.num_rows for b in told if "date" in b.schema.names) == 2


def test_an_ordinary_fleet_has_nothing_red(one, tmp_path):
    path = recorded(one, tmp_path / "fleet.rrd", 0.0)
    colors = [rgb(c) for c in rows(path, "/arms0/arms", "Capsules3D:colors")[0]]
    assert style.RED not in colors
    assert "/arms0/unlike" not in entities(path)
    assert "No arm is unlike" in rows(path, "/words/type0", "TextDocument:text")[0][0]


@pytest.mark.slow
@needs_vulkan
def test_the_viewer_draws_it_without_a_complaint(one, tmp_path):
    path = recorded(one, tmp_path / "fleet.rrd", 1.5)
    told = pictures(path, [Shot(tmp_path / "fleet.png")], (960, 540), 480)
    assert {v.name: v.problems for v in told if v.problems} == {}
    assert len(told) >= 4
