"""Which revision a command reads, and that commands which only read leave the file alone."""

import hashlib
import re

import pytest

from hilcal.campaign.campaign import Campaign
from hilcal.campaign.revisions import chain
from hilcal.cli.showing import open_command
from hilcal.config import load_config
from hilcal.errors import InputError
from hilcal.store import schema
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.revision import from_text, to_text
from tests.support.cli_cases import CELL, done, imported, ok, table
from tests.support.cli_cases import run as command
from tests.support.rows import first

BASE = ["base_frame", "joint_compliance"]


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """The cell of the demo with few candidates, which makes plans fast."""
    path, text = tmp_path_factory.mktemp("cell") / "cell.toml", CELL.read_text(encoding="utf-8")
    path.write_text(
        re.sub(r"candidates = \d+", "candidates = 60\nagainst = []", text), encoding="utf-8"
    )
    assert load_config(path).planning.candidates == 60
    return path


@pytest.fixture(scope="module")
def fresh(cell):
    """A campaign without revisions."""
    run = cell.with_name("fresh.hilcal")
    csv = table(run.with_suffix(".csv"), "hysteresis", poses=8)
    done("import", csv, "--config", cell, "-o", run)
    return run.read_bytes()


@pytest.fixture(scope="module")
def fitted(fresh, tmp_path_factory):
    """The same with three revisions: the baseline, hysteresis added, another first model."""
    path = tmp_path_factory.mktemp("fitted") / "run.hilcal"
    path.write_bytes(fresh)
    done("identify", path)
    done("add", path, "hysteresis")
    done("identify", path, "--effects", "joint_compliance,base_compliance")
    return path.read_bytes()


@pytest.fixture
def run(fitted, tmp_path):
    path = tmp_path / "run.hilcal"
    path.write_bytes(fitted)
    return path


def state(folder):
    """Hash and time of change of every file in a folder."""
    return {
        p.name: (hashlib.sha256(p.read_bytes()).hexdigest(), p.stat().st_mtime_ns)
        for p in folder.iterdir()
    }


READING = (
    ("diagnose",),
    ("compare",),
    ("view", "--record", "{out}/story.rrd"),
    ("export", "--table", "{out}/t.csv"),
    ("validate", "{run}"),
    ("next", "-o", "{out}/p.json", "--suspects", "creep,hysteresis", "--poses", "2", "--quick"),
)


@pytest.mark.parametrize(("reading", "revisions"), [
    *((c, True) for c in READING[:-1]),
    *first(1, [(c, False) for c in READING[1::-1]]),
    pytest.param(READING[-1], True, marks=pytest.mark.slow),
], ids=lambda x: x[0] if isinstance(x, tuple) else ("fresh", "fitted")[x])  # fmt: skip
def test_a_command_that_reads_writes_nothing_to_the_campaign(
    reading, revisions, fresh, fitted, tmp_path, capsys
):
    home, out = tmp_path / "home", tmp_path / "out"
    home.mkdir()
    out.mkdir()
    run = home / "run.hilcal"
    run.write_bytes(fitted if revisions else fresh)
    run.chmod(0o444)
    home.chmod(0o555)
    before = state(home)
    name, *rest = (part.format(run=run, out=out) for part in reading)
    ok(capsys, name, run, *rest)
    assert state(home) == before
    home.chmod(0o755)


def test_a_reading_connection_can_write_nothing(run):
    with Campaign.open(run, read_only=True) as o:
        record = o.latest()
        assert record is not None
        with pytest.raises(InputError, match="readonly"):
            o.file.append_revision(record)


@pytest.mark.long
def test_every_command_that_reads_a_model_takes_a_revision(run, tmp_path, capsys):
    two = [*BASE, "hysteresis"]
    for name in ("compare", "diagnose"):
        assert ok(capsys, name, run, "--json").document["model"][-1] == "base_compliance"
        d = ok(capsys, name, run, "--revision", "2", "--json").document
        assert (d["revision"], d["model"]) == (2, two)
    d = ok(capsys, "validate", run, run, "--revision", "2", "--json").document
    assert (d["revision"], d["model"]) == (2, two)
    recording = tmp_path / "s.rrd"
    story = ("view", run, "--record", recording, "--json")
    assert (result := ok(capsys, *story)).document["revisions"] == [3]
    assert f"open it with: {open_command(recording)}" in result.err
    assert ok(capsys, *story, "--revision", "2").document["revisions"] == [1, 2]
    parameters = tmp_path / "p.csv"
    ok(capsys, "export", run, "--parameters", parameters, "--revision", "2")
    assert "hysteresis.j2" in parameters.read_text()


@pytest.mark.slow
def test_planning_on_takes_a_revision(run, cell, tmp_path, capsys):
    plan = ("plan", cell, "-o", tmp_path / "plan.json", "--poses", "2", "--quick")
    d = ok(capsys, *plan, "--after", run, "--revision", "2", "--json").document
    assert any("hysteresis" in name for name in d["predicted_std"])


@pytest.mark.long
def test_planning_on_plans_the_kind_of_readings_that_was_fitted(cell, tmp_path, capsys):
    """The cell, which states no [planning] readings, has loads: deflections by default."""
    path = imported(tmp_path / "absolute.hilcal")
    ok(capsys, "identify", path, "--readings", "absolute")
    plan = ("plan", cell, "-o", tmp_path / "plan.json", "--poses", "2", "--quick")
    d = ok(capsys, *plan, "--after", path, "--json").document
    assert d["criterion"] == "I"  # of deflections D


@pytest.mark.long
def test_a_change_of_an_earlier_revision_follows_that_one(run, tmp_path, capsys):
    arguments = ("add", run, "load_point", "--revision", "2", "--json")
    before, after = ok(capsys, *arguments).document["revisions"]
    assert (before["revision"], after["revision"]) == (2, 4)
    assert after["model"] == [*BASE, "hysteresis", "load_point"]
    with Campaign.open(run, read_only=True) as o:
        assert o.file.revision(4).parent == 2
        assert set(o.history(4).added) == {"hysteresis", "load_point"}
    story = ("view", run, "--record", tmp_path / "s.rrd", "--json")
    assert ok(capsys, *story).document["revisions"] == [1, 2, 4]
    d = ok(capsys, "remove", run, "load_point", "--json").document
    assert [r["revision"] for r in d["revisions"]] == [4, 5]
    with Campaign.open(run, read_only=True) as o:
        assert [r.number for r in chain(o.file.revisions())] == [1, 2, 4, 5]


def test_refining_from_a_revision_follows_it(run, capsys):
    d = ok(capsys, "refine", run, "--revision", "1", "--json").document
    assert [r["revision"] for r in d["revisions"]] == [1, 4]
    with Campaign.open(run, read_only=True) as o:
        assert [r.number for r in chain(o.file.revisions())] == [1, 4]


@pytest.mark.long
def test_exploring_does_not_change_what_others_use_once_a_revision_is_accepted(run, capsys):
    words = ok(capsys, "accept", run, "2").out
    assert "Accepted: revision 2" in words
    for name in ("compare", "diagnose"):
        result = ok(capsys, name, run, "--json")
        assert result.document["revision"] == 2
        assert "using revision 2, which is accepted; the latest is 3" in result.err
    result = ok(capsys, "validate", run, run, "--json")
    assert result.document["revision"] == 2
    assert "using revision 2, which is accepted" in result.err
    ok(capsys, "add", run, "load_point")  # from the accepted one; it stays accepted
    ok(capsys, "identify", run)
    assert ok(capsys, "compare", run, "--json").document["revision"] == 2
    with Campaign.open(run) as o:
        assert o.file.revision(4).made_from == 2
        assert o.fit().model.names == (*BASE, "hysteresis")
        assert len(o.file.revisions()) == 5
    d = ok(capsys, "accept", run, "--json").document  # the latest, whatever comes later
    assert d == {"accepted": 5, "in_use": 5, "latest": 5}
    assert ok(capsys, "compare", run, "--json").document["revision"] == 5
    d = ok(capsys, "accept", run, "--release", "--json").document
    assert d == {"accepted": None, "in_use": 5, "latest": 5}
    assert "Revision 5 of" in ok(capsys, "identify", run).out  # the same fit again
    assert ok(capsys, "compare", run, "--json").document["revision"] == 5
    for _ in range(2):
        ok(capsys, "refine", run, "--effects", "joint_compliance,hysteresis")
        with Campaign.open(run) as o:
            assert len(o.file.revisions()) == 6


def outdated(run, capsys):
    """The accepted revision has fewer readings than the campaign, as after run --append."""
    ok(capsys, "accept", run, "2")
    with Campaign.open(run) as o:
        o.file.append_readings(o.file.readings()[:5])
    return "revision 2 was fitted before readings were appended"


def of_another_scaling(run, capsys):
    """The accepted revision cannot be judged."""
    ok(capsys, "identify", run, "--scaling", "none")
    ok(capsys, "accept", run)
    return "revision 4 has scaling none"


def take(said, run, capsys):
    """Do what a message says, in its order: each command in it, as it stands."""
    commands = re.findall(r"hilcal (identify|accept)((?: --?\w+| \S+/\S+)*)", said)
    assert commands, said
    for name, rest in commands:
        ok(capsys, name, *(rest.split() or [run]))


@pytest.mark.parametrize("made", [outdated, of_another_scaling])
@pytest.mark.parametrize("asked", first(1, ["compare", "diagnose", "next -o {out}/p.json"]))
def test_what_is_said_of_an_accepted_revision_that_will_not_do_leads_on(
    run, tmp_path, capsys, made, asked
):
    words = made(run, capsys)
    name, *rest = (part.format(out=tmp_path) for part in asked.split())
    result = command(capsys, name, run, *rest)
    said = result.err.splitlines()[-1]
    assert result.code == 2
    assert words in said
    assert said.endswith(f"hilcal accept {run} --release")
    take(said, run, capsys)
    if name == "next":
        rest += ["--suspects", "creep,hysteresis", "--poses", "2", "--quick"]
    result = ok(capsys, name, run, *rest, "--json")
    assert "accepted" not in result.err
    with Campaign.open(run) as o:
        assert o.in_use() == o.latest()
        assert o.fit().scaling == "gc"
        assert len(o.fit().readings) == len(o.readings)


def version(path):
    with CampaignFile.open(path, read_only=True) as file:
        return int(file.connection.execute("PRAGMA user_version").fetchone()[0])


def test_only_a_file_that_needs_it_is_closed_to_older_programs(run, capsys):
    assert version(run) == schema.ONE_TARGET
    ok(capsys, "add", run, "load_point")  # from the one before: as always
    assert version(run) == schema.ONE_TARGET
    ok(capsys, "accept", run, "2")
    assert version(run) == schema.CHOSEN_REVISION


def test_a_record_of_an_older_program_has_no_parent(run):
    with CampaignFile.open(run, read_only=True) as file:
        record = file.revision(2)
    assert '"parent"' not in to_text(record)
    again = from_text(to_text(record), 2)
    assert (again.parent, again.made_from) == (None, 1)
