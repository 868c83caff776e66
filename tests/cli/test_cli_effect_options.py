"""Options of effects on the command line: given, refused, stored, shown."""

import shutil

import pytest

from hilcal.store.campaign_file import CampaignFile
from tests.support.cli_cases import ok, refused


def names_of(result, effect):
    named = [p["name"] for p in result.document["parameters"]]
    return [n.partition(".")[2] for n in named if n.startswith(f"{effect}.")]


def revisions(path):
    with CampaignFile.open(path) as stored:
        return [(r.effects, r.added, r.options["effects"]) for r in stored.revisions()]


def test_identify_takes_options_and_keeps_them(campaign, tmp_path, capsys):
    text = "joint_compliance(joints=1/2/3/4-6), hysteresis(joints=1-3), transmission_error(harmonics=5; joints='2/3')"  # noqa: E501
    result = ok(capsys, "identify", campaign, "--effects", text, "--json")
    d = result.document
    assert d["model"] == ["base_frame", "joint_compliance", "hysteresis", "transmission_error"]
    assert d["options"]["joint_compliance"] == {"joints": "1/2/3/4-6"}
    assert d["options"]["hysteresis"] == {"joints": "1-3"}
    assert d["options"]["transmission_error"] == {"harmonics": 5, "joints": "2/3"}
    assert names_of(result, "joint_compliance") == ["j1", "j2", "j3", "j4-6"]
    assert names_of(result, "hysteresis") == ["j1-3"]
    said = "hysteresis(joints=1-3), transmission_error(harmonics=5, joints=2/3)."
    assert said in " ".join(result.err.split())
    ((effects, added, options),) = revisions(campaign)
    assert added is None
    assert {e: options[e] for e in effects} == d["options"]

    # The stored revision is the same model in the commands that go on with it.
    shown = " ".join(ok(capsys, "compare", campaign).out.split())
    assert "+ hysteresis(joints=1-3) + transmission_error(harmonics=5, joints=2/3)" in shown
    other = tmp_path / "other.hilcal"
    shutil.copyfile(campaign, other)
    shown = " ".join(ok(capsys, "validate", campaign, other).out.split())
    assert "joint_compliance(joints=1/2/3/4-6) + hysteresis(joints=1-3)" in shown
    parameters = tmp_path / "parameters.csv"
    ok(capsys, "export", campaign, "--parameters", parameters)
    assert "hysteresis.j1-3" in parameters.read_text(encoding="utf-8")


def test_usual_options_are_not_shown(campaign, capsys):
    result = ok(capsys, "identify", campaign, "--effects", "joint_compliance(joints=each)")
    assert "Options" not in result.out
    assert "joints=" not in ok(capsys, "compare", campaign).out


@pytest.mark.long
def test_add_takes_options(campaign, capsys):
    ok(capsys, "identify", campaign)
    result = ok(capsys, "add", campaign, "hysteresis(joints=2/3+4)", "--json")
    last = result.document["revisions"][-1]
    assert last["added"] == "hysteresis"
    assert last["options"]["hysteresis"] == {"joints": "2/3-4"}
    assert "hysteresis(joints=2/3+4)" in result.err
    effects, added, options = revisions(campaign)[-1]
    assert (effects[-1], added) == ("hysteresis", "hysteresis")
    assert options["hysteresis"] == {"joints": "2/3-4"}
    again = ok(capsys, "refine", campaign, "--from-latest", "--json").document
    assert again["revisions"][0]["options"]["hysteresis"] == {"joints": "2/3-4"}
    line = refused(capsys, 2, "add", campaign, "hysteresis(joints=common)")
    assert "in the model already" in line
    ok(capsys, "remove", campaign, "hysteresis")
    assert "hysteresis" not in revisions(campaign)[-1][2]


def test_effects_shows_options_and_defaults(capsys):
    d = {e["name"]: e for e in ok(capsys, "effects", "--json").document["effects"]}
    assert d["backlash"]["options"] == ["joints", "crossing"]
    assert d["backlash"]["defaults"] == {"joints": "each", "crossing": 0.01}
    assert d["creep"]["defaults"] == {"joints": "common"}
    by_readings = {"harmonics": None, "waves": None}
    assert d["transmission_error"]["defaults"] == {"joints": "each", **by_readings}
    assert d["joint_compliance"]["option_help"]["joints"].startswith("which joints have a")
    assert d["link_geometry"]["options"] == []
    assert d["link_geometry"]["defaults"] == {}
    words = " ".join(ok(capsys, "effects").out.split())
    for part in (
        "option orders: periods k per turn",
        "needs load_time; expected 0.01 option joints: which joints share a k",
        "(joints=1-3)",
    ):
        assert part in words
