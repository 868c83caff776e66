"""Fleets of simulated arms: from files to a prior that helps another arm; their picture."""

from dataclasses import replace

import numpy as np
import pytest
import rerun as rr

from hilcal.errors import CannotAnswerError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.carried.carried_prior import carried_prior
from hilcal.identification.carried.posterior import Posterior, information_on
from hilcal.identification.fit import fit
from hilcal.present.html.other_pages import arms_chart, fleet_page
from hilcal.present.viewer import style
from hilcal.present.viewer.fleet import DrawnType, arm_positions, record_fleet
from hilcal.robot.catalogue import configs_dir
from hilcal.robot.scene import capsules
from hilcal.store.campaign_file import CampaignFile
from hilcal.transfer.fleet import Fleet, diagnosed_effects, pool
from hilcal.transfer.members import Failure, Member, SizeEvidence, entries, member_of, type_sizes
from tests.support.campaigns import cell_of, configuration, noiseless, plan, with_noise, world_of
from tests.support.cli_cases import ok, refused
from tests.support.recordings import chunks, entities, rows
from tests.support.refusals import refusal, refusal_of
from tests.support.viewer_plan import rgb

SPREAD = 0.15
"""Standard deviation of the arms' joint compliances, relative."""
ARMS, ODD = 30, 4


def compliances(rng):
    """Factors (6,) of one arm's joint compliances."""
    return np.asarray(1 + SPREAD * rng.normal(size=6))


def readings_of(factors, seed, poses=8):
    """A campaign of an arm, by mechanics that the model does not share."""
    world = world_of(cell_of(), np.random.default_rng(7))
    soft = world.physics.joint_compliance * factors
    world = replace(world, physics=world.physics.with_effect("joint_compliance", soft))
    return with_noise(noiseless(world, plan(poses, 40 + seed)), np.random.default_rng(seed))


def posterior_of(readings):
    model = baseline(cell_of(), readings, "deflection")
    return Posterior.of(fit(model, readings, "deflection"))


@pytest.fixture(scope="module")
def one():
    return posterior_of(readings_of(np.ones(6), 1))


def members(one, seed, odd=0.0, arms=ARMS):
    """Arms, two months each, whose fits scatter as the posterior of one says."""
    rng = np.random.default_rng(seed)
    scaled = one.information * (one.scale[:, None] * one.scale)
    values, vectors = np.linalg.eigh(scaled)
    root = vectors[:, values > 1e-6] / np.sqrt(values[values > 1e-6])
    campaigns = []
    for a in range(arms):
        factors = compliances(rng)
        if a == ODD:
            factors[2] += odd
        for month in (1, 3):
            noise = one.scale * (root @ rng.normal(size=root.shape[1]))
            posterior = replace(one, mean=one.mean * factors + noise)
            added = ("creep",) if a == ODD else ()
            date = f"2026-0{month}-01"
            name = f"arm{a}-{month}.hilcal"
            campaigns.append(
                Member(name, f"arm{a}", "list", "ur10e", date, posterior, added, "adequate", 0)
            )
    return campaigns


@pytest.fixture(scope="module")
def with_odd(one):
    fleet = members(one, 3, odd=1.5)
    return fleet, pool(fleet, diagnosed_effects(fleet))


def test_a_campaign_more_of_an_arm_is_no_arm_more(with_odd):
    fleet_members, _ = with_odd
    more = SizeEvidence(("creep",), np.array([[0.5]]), np.array([0.4]))
    less = SizeEvidence(("creep",), np.array([[0.2]]), np.array([0.1]))
    twice = [replace(m, sizes=(more, less)[k % 2]) for k, m in enumerate(fleet_members)]
    assert len({m.arm for m in twice[:6]}) == 3
    sizes = pool(twice[:6], []).sizes
    assert sizes == type_sizes([more] * 3)
    assert sizes[0].high < type_sizes([more])[0].high


def test_shrunk_effects_are_pooled_by_what_the_readings_say_of_them(one):
    plain = members(one, 3)[:20]
    shrunk = []
    for m in plain:
        p, shrinkage = m.posterior, (0.5 * one.scale) ** -2.0
        information = p.information + np.diag(shrinkage)
        mean = np.linalg.solve(information, p.information @ p.mean)
        p = replace(p, information=information, mean=mean, own_precision=shrinkage)
        shrunk.append(replace(m, posterior=p))
    known = [p for p in pool(plain, []).parameters if p.mean_std < 0.1 * p.mean]
    pooled = {p.parameter: p for p in pool(shrunk, []).parameters}
    assert known
    for p in known:
        assert pooled[p.parameter].mean == pytest.approx(p.mean, rel=0.01)
        assert pooled[p.parameter].between == pytest.approx(p.between, rel=0.05)
    unnamed = [replace(m, background=frozenset({"joint_compliance"})) for m in shrunk]
    with pytest.raises(CannotAnswerError, match="no parameter"):
        pool(unnamed, [])


def test_the_spread_of_arms_is_recovered_and_the_odd_one_named(one, with_odd):
    pooled = with_odd[1]
    assert pooled.parameters
    for p in pooled.parameters:
        mean = one.mean[one.names.index(p.parameter)]
        assert abs(p.mean - mean) < 4.5 * p.mean_std
        assert abs(p.between - SPREAD * abs(mean)) < 4 * p.between_std
    assert [(o.arm, o.campaign, o.parameter) for o in pooled.unlike] == [
        (f"arm{ODD}", "", "joint_compliance.j3")
    ]
    odd, mean = pooled.unlike[0], one.mean[one.names.index("joint_compliance.j3")]
    assert odd.off == pytest.approx(1.5 * mean, abs=3 * odd.off / odd.sigma)
    assert [(s.effect, s.kind, s.arms) for s in pooled.effects_added] == [
        ("creep", "defect", (f"arm{ODD}",))
    ]
    assert not pooled.wear


@pytest.mark.long
def test_the_prior_of_a_few_arms_is_as_wide_as_their_spread_is_uncertain(one):
    rng, inside = np.random.default_rng(8), []
    for seed in range(18):
        prior = pool(members(one, 200 + seed, arms=4), ()).prior
        joint = [one.names.index(name) for name in prior.names]
        std = np.sqrt(np.diag(np.linalg.inv(prior.information)))
        factors = dict(zip(one.names, compliances(rng), strict=False))
        true = one.mean[joint] * [factors[name] for name in prior.names]
        inside += (np.abs(true - prior.mean) < 1.96 * std).tolist()
    assert len(inside) > 100
    assert 0.9 < np.mean(inside) < 1.0


@pytest.mark.long
def test_in_an_ordinary_fleet_nobody_is_named(one):
    for seed in (11, 12, 13):
        assert pool(members(one, seed), ()).unlike == ()


def test_the_page_shows_who_is_unlike(with_odd):
    fleet, of = with_odd
    drawn = arms_chart(of)
    assert [(len(trace.y), trace.name) for trace in drawn.data] == [
        (ARMS * len(of.parameters) - 1, "like its type"),
        (1, "unlike its type"),
    ]
    lost = (Failure("x<b>.hilcal", "no campaign"),)
    html = fleet_page(Fleet((of,), tuple(fleet), lost), "fleet", "2026-04-01T00:00:00", "1")
    assert f"Different from their type: arm{ODD}" in html
    assert "joint_compliance.j3" in html
    assert "x&lt;b&gt;.hilcal: no campaign" in html
    like = Fleet((replace(of, unlike=()),), tuple(fleet), ())
    like = fleet_page(like, "fleet", "2026-04-01T00:00:00", "1")
    assert f"Different from their type: arm{ODD}" in like  # by its defect alone
    assert f"arm{ODD}: creep, a defect of single arms" in like


def test_two_arms_have_no_spread(one):
    refusal_of(CannotAnswerError, "at least 3 arms", pool, members(one, 3)[:4], ())


def error_of(readings, factors, prior):
    """Root mean square error of the joint compliances, relative."""
    carried = None if prior is None else carried_prior(prior)
    model = baseline(cell_of(), readings, "deflection", prior=carried)
    theta = fit(model, readings, "deflection").theta
    at = model.slices()[model.names.index("joint_compliance")]
    truth = world_of(cell_of(), np.random.default_rng(7)).physics.joint_compliance * factors
    return float(np.sqrt(np.mean((theta[at] / truth - 1)[1:] ** 2)))


def test_with_the_prior_a_new_arm_needs_fewer_poses(one):
    prior = pool(members(one, 3), ()).prior
    rng = np.random.default_rng(50)
    with_it, without = [], []
    for seed in range(4):
        factors = compliances(rng)
        few = readings_of(factors, 60 + seed, poses=4)
        with_it.append(error_of(few, factors, prior))
        without.append(error_of(few, factors, None))
    assert np.mean(with_it) < 0.8 * np.mean(without)


def store(path, *readings):
    base = str(configs_dir() / "cells")
    with CampaignFile.create(path, configuration().to_json(), base, "a test") as file:
        for some in readings:
            file.append_readings(some)


def write(folder, names):
    """Campaign files of arms, not fitted yet."""
    rng = np.random.default_rng(5)
    for k, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        store(folder / name, readings_of(compliances(rng), k))


@pytest.mark.slow
def test_a_directory_of_campaigns_gives_a_prior_that_identify_takes(capsys, tmp_path):
    folder = tmp_path / "fleet"
    write(folder, ("a/1.hilcal", "b/1.hilcal", "c/1.hilcal", "c/2.hilcal"))
    (folder / "broken.hilcal").write_bytes(b"no campaign")
    prior, shown = tmp_path / "prior.json", tmp_path / "fleet.html"
    recording = tmp_path / "fleet.rrd"
    options = ("--json", "--workers", "2", "--report", shown, "--record", recording)
    outcome = ok(capsys, "fleet", folder, "-o", prior, *options)
    assert outcome.document["recording"] == str(recording)
    assert recording.stat().st_size > 10_000
    assert "A fleet of arms" in shown.read_text(encoding="utf-8")
    (of,) = outcome.document["types"]
    assert of["arms"] == ["a", "b", "c"]
    assert {c["arm_known_by"] for c in outcome.document["campaigns"]} == {"folder"}
    assert [f["name"] for f in outcome.document["failed"]] == ["broken.hilcal"]
    assert "broken.hilcal: " in outcome.err
    new = tmp_path / "fresh.hilcal"
    store(new, readings_of(np.ones(6), 77, poses=4))
    fitted = ok(capsys, "identify", new, "--prior", prior, "--json").document
    assert fitted["prior"]["source"]["campaign"].startswith("4 campaigns of 3 arms")
    assert ok(capsys, "refine", new, "--prior", prior, "--json").document["verdict"]
    again = refused(capsys, 2, "identify", folder / "a/1.hilcal", "--prior", prior)
    assert "count twice" in again


def test_the_list_beside_the_campaigns_names_arms_and_dates(tmp_path):
    (tmp_path / "x.hilcal").write_bytes(b"")
    (tmp_path / "arms.csv").write_text("campaign,arm,date\nx.hilcal,left,2026-03-01\n")
    (entry,) = entries(tmp_path)
    assert (entry.name, entry.arm, entry.date) == ("x.hilcal", "left", "2026-03-01")
    failed = member_of(entry)
    assert isinstance(failed, Failure)
    assert failed.name == "x.hilcal"
    (tmp_path / "arms.csv").write_text("campaign,arm,date\nx.hilcal,left,March\n")
    refusal(r"row 2, column 'date': 'March'", entries, tmp_path)
    (tmp_path / "arms.csv").write_text("campaign,arm\ny.hilcal,left\n")
    refusal(r"y\.hilcal: no such campaign", entries, tmp_path)


@pytest.mark.parametrize(
    "how", ["a copy", "a link", "imported again", "extended", "two extensions", "many copies"]
)
def test_campaigns_of_the_same_readings_are_refused(how, capsys, tmp_path):
    """They would make an arm look like several, and its spread like none."""
    folder, names = tmp_path / "fleet", ("a.hilcal", "b.hilcal", "c.hilcal")
    write(folder, names)
    rng, other = np.random.default_rng(3), folder / "d.hilcal"
    with CampaignFile.open(folder / "b.hilcal", read_only=True) as file:
        x = file.readings()
    again = replace(x, value=x.value + rng.normal(0, 1e-5, x.value.shape), cycle=x.cycle + 1)

    def extended(path):
        moved = (again.value + rng.normal(0, 1e-5, x.value.shape) for _ in range(4))
        more = (replace(again, value=v, cycle=again.cycle + k) for k, v in enumerate(moved))
        store(path, x, *more)

    content = (folder / "b.hilcal").read_bytes()
    if how == "a copy":
        other.write_bytes(content)
    elif how == "a link":
        other.symlink_to("b.hilcal")
    elif how == "imported again":  # other names, another order, six decimals
        poses = tuple(f"P {k}" for k in range(len(x.pose_names)))
        renamed = replace(x, value=x.value.round(8), pose_names=poses)
        store(other, renamed[np.random.default_rng(1).permutation(len(x))])
    elif how == "extended":
        extended(other)
    elif how == "two extensions":
        (folder / "b.hilcal").unlink()
        extended(other)
        extended(folder / "e.hilcal")
    else:
        for k in range(25):
            (folder / f"d{k:02d}.hilcal").write_bytes(content)
    message = refused(capsys, 2, "fleet", folder, "-o", tmp_path / "p.json", "--workers", "1")
    assert "have readings in common" in message
    first = "d.hilcal" if how == "two extensions" else "b.hilcal"
    assert first in message or how == "many copies"
    assert not (tmp_path / "p.json").exists()


def fleet(one, odd):
    """30 arms in January and March, of which one may have a soft joint 3."""
    campaigns = members(one, 3, odd=odd)
    of = pool(campaigns, ())
    return Fleet((of,), tuple(campaigns), ()), of


def recorded(drawn, path):
    rr.set_strict_mode(True)
    try:
        record_fleet(drawn, path)
    finally:
        rr.set_strict_mode(False)
    return path


def test_the_odd_joint_alone_is_red_and_its_arm_framed(one, tmp_path):
    drawn, of = fleet(one, 1.5)
    path = recorded(drawn, tmp_path / "fleet.rrd")
    d = DrawnType(of, drawn.members)
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
    batches = [c.to_record_batch() for c in chunks(path, f"/date0/2/zunlike/{ODD}")]
    assert sum(b.num_rows for b in batches if "date" in b.schema.names) == 2


def test_an_ordinary_fleet_has_nothing_red(one, tmp_path):
    path = recorded(fleet(one, 0.0)[0], tmp_path / "fleet.rrd")
    colors = [rgb(c) for c in rows(path, "/arms0/arms", "Capsules3D:colors")[0]]
    assert style.RED not in colors
    assert "/arms0/unlike" not in entities(path)
    assert "No arm is unlike the others\n" in rows(path, "/words/type0", "TextDocument:text")[0][0]


def test_what_others_imitate_only_far_off_is_known():
    """Geometry imitates a joint's compliance, moved by a thousand times its ordinary magnitude."""
    rng = np.random.default_rng(5)
    columns, others = rng.normal(size=(40, 2)), rng.normal(size=(40, 3))
    others[:, 0] = 1e-3 * (columns[:, 0] + 0.1 * columns[:, 1])
    x = np.column_stack([columns, others])
    information = information_on(x.T @ x, np.arange(2))
    free = columns - others[:, 1:] @ np.linalg.lstsq(others[:, 1:], columns, rcond=None)[0]
    np.testing.assert_allclose(information, free.T @ free, rtol=0.01)
    imitating = np.column_stack([columns, 1e3 * others])
    information = information_on(imitating.T @ imitating, np.arange(2))
    assert information @ [1.0, 0.1] == pytest.approx(0.0, abs=1e-2)


@pytest.mark.long
def test_arms_with_all_their_geometry_have_compliances_near_the_truth():
    """In the fits' over-complete geometry a frame that moves a little moves the compliances."""
    arms, fleet_members, truth = 4, [], []
    for a in range(arms):
        rng = np.random.default_rng(a)
        truth.append(compliances(rng))
        readings = readings_of(truth[-1], a, poses=12)
        start = baseline(cell_of(), readings, "absolute")
        model = with_effects(cell_of(), readings, "absolute", (*start.names, "link_geometry"))
        posterior = Posterior.of(fit(model, readings, "absolute"))
        name, date = f"arm{a}.hilcal", "2026-01-01"
        fleet_members.append(
            Member(name, f"arm{a}", "list", "ur10e", date, posterior, (), "adequate", 0)
        )
    soft = world_of(cell_of(), np.random.default_rng(7)).physics.joint_compliance
    pooled = pool(fleet_members, ())
    places = {p.parameter: k for k, p in enumerate(pooled.parameters)}
    for j in (1, 2, 3, 4):
        k = places[f"joint_compliance.j{j + 1}"]
        off = pooled.off[:, k] + pooled.parameters[k].mean - soft[j] * np.array(truth)[:, j]
        assert np.all(np.abs(off) < 4.5 * pooled.off_std[:, k])
        assert np.all(pooled.off_std[:, k] < 0.2 * soft[j])
        mean, std = soft[j] * np.mean(truth, axis=0)[j], pooled.parameters[k].mean_std
        assert abs(pooled.parameters[k].mean - mean) < 4.5 * std < 0.9 * mean
    assert pooled.unlike == ()
