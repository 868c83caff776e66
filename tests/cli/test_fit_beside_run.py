"""Two programs on one campaign: one measures into it, the other one fits it and stores the fit."""

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import hilcal as hc
from hilcal.errors import InputError
from hilcal.readings.covariance import INSTRUMENT_AND_ARM
from hilcal.store import rows, schema
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.revision import STORED_HASH, fitted_to, from_text, to_text
from hilcal.store.rows import content_hash
from tests.support.appending import appending, repeated_deflection
from tests.support.cli_cases import CELL, ok, refused, rehearsal, stored_readings
from tests.support.unguarded import unguarded


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """A campaign without revisions."""
    path = tmp_path_factory.mktemp("fresh") / "run.hilcal"
    readings = rehearsal("nothing", poses=8).readings
    return stored_readings(path, readings, covers=INSTRUMENT_AND_ARM).read_bytes()


@pytest.fixture(scope="module")
def found(fresh, tmp_path_factory):
    """A fit of it."""
    path = tmp_path_factory.mktemp("fitted") / "run.hilcal"
    path.write_bytes(fresh)
    with hc.Campaign.open(path, read_only=True) as o:
        return hc.fit(hc.baseline(o.cell, o.readings, "absolute"), o.readings, "absolute")


@pytest.fixture
def run(fresh, tmp_path):
    path = tmp_path / "run.hilcal"
    path.write_bytes(fresh)
    return path


def more(path, cycle):
    """Measure one pose again, by another connection."""
    with CampaignFile.open(path) as file:
        x = file.readings()
        file.append_readings(repeated_deflection(x, np.random.default_rng(cycle), cycle))


def checked(path):
    """Return how many revisions there are; each tells the readings that it was fitted to."""
    with CampaignFile.open(path, read_only=True) as file:
        readings, records = file.readings(), file.revisions()
    for record in records:
        count, stored = fitted_to(record) or (0, "")
        assert content_hash(readings[:count]) == stored
    return len(records)


@pytest.mark.parametrize("order", ["append, store", "store, append", "append, store, append"])
def test_a_revision_is_of_the_readings_that_were_fitted(run, found, order):
    with hc.Campaign.open(run) as o:
        before = len(o.readings)
        for k, step in enumerate(order.split(", "), start=1):
            if step == "append":
                more(run, k)
            else:
                assert o.append(found) == 1
                assert o.fit(1).theta == pytest.approx(found.theta)  # by this very program
    assert checked(run) == 1
    with hc.Campaign.open(run) as o:
        assert len(o.readings) > before
        with pytest.raises(InputError, match="fitted before readings were appended"):
            o.fit()
        o.append(hc.fit(found.model, o.readings, "absolute"))
        assert o.fit(2).readings.value.shape == o.readings.value.shape
    assert checked(run) == 2


def test_what_a_refinement_stores_follows_itself(run, found):
    """Another program's revision comes between two of a chain."""
    with hc.Campaign.open(run) as one, hc.Campaign.open(run) as other:
        grown = hc.fit(found.model + hc.effect("hysteresis"), one.readings, "absolute")
        first = one.store(found)
        other.store(found)
        made = one.store(grown, None, "hysteresis", None, first)
        assert one.file.revision(made).made_from == first


def test_commands_beside_a_run(run, capsys):
    """Each fits what it read, whatever comes meanwhile."""
    with appending(run, 1, pause=0.1) as process:
        with CampaignFile.open(run, read_only=True) as file:
            there = file.n_readings
        ok(capsys, "identify", run)
        assert checked(run) == 1
        with CampaignFile.open(run, read_only=True) as file:
            count, _ = fitted_to(file.revision(1)) or (0, "")
        while count == len(readings_of(run)):
            assert process.poll() is None
        assert there <= count < len(readings_of(run))
        # a revision to which readings came is not gone on with, which is told
        assert "run hilcal identify again" in refused(capsys, 2, "add", run, "hysteresis")
    ok(capsys, "identify", run)
    ok(capsys, "add", run, "hysteresis")  # nothing is appended any more
    assert checked(run) == 3


def readings_of(path):
    with CampaignFile.open(path, read_only=True) as file:
        return file.readings()


# what programs before left behind


def _mixed(path, found):
    """As programs before stored it: the count of what was fitted, the hash of what was there."""
    with hc.Campaign.open(path) as o:
        record = o.record(found)
        more(path, 1)
        record = replace(record, options={**record.options, STORED_HASH: o.file.data_hash()})
        o.file.append_revision(record)
    more(path, 2)


def test_a_count_and_a_hash_of_two_moments_stop_nothing(run, found, capsys):
    """Its hash proves the readings that it was fitted to, and those that came meanwhile."""
    _mixed(run, found)
    ok(capsys, "info", run)
    assert "run hilcal identify again" in refused(capsys, 2, "compare", run)
    ok(capsys, "identify", run)
    ok(capsys, "compare", run)


def test_what_was_fitted_is_not_searched_for_ever(run, found, monkeypatch):
    """A received file could tell hashes that take hours to find."""
    hashed: list[int] = []

    def counting(readings):
        hashed.append(len(readings))
        return content_hash(readings)

    with hc.Campaign.open(run) as o:
        first = o.record(found)
    for k in range(5):
        more(run, k + 1)
    with CampaignFile.open(run) as file:
        file.append_revision(replace(first, options={**first.options, STORED_HASH: "0" * 64}))
        monkeypatch.setattr("hilcal.store.campaign_file.content_hash", counting)
        monkeypatch.setattr("hilcal.store.campaign_file._HASHED", 3 * len(found.readings))
        assert file.bad_revision() is not None
    assert len(hashed) <= 4


def spoil(path, found, how):
    """Make revision 2 of three a bad one."""
    with hc.Campaign.open(path) as o:
        for _ in range(3):
            o.store(found)
        o.accept(1)
        o.accept(3)
        wrong = replace(o.file.revision(2), parent=None)
    wrong = replace(wrong, options={**wrong.options, STORED_HASH: "0" * 64})
    with closing(sqlite3.connect(path, isolation_level=None)) as db, unguarded(db):
        text = to_text(wrong) if how == "hash" else "{"
        crc = rows.text_crc("2", text) if how == "hash" else 0
        db.execute("UPDATE revisions SET content = ?, crc = ? WHERE id = 2", (text, crc))


def test_a_revision_before_the_first_one_is_set_aside(run, found, capsys):
    with hc.Campaign.open(run) as o:
        o.append(found)
    with closing(sqlite3.connect(run, isolation_level=None)) as db, unguarded(db):
        db.execute("UPDATE revisions SET id = -3")
    assert f"hilcal repair {run}" in refused(capsys, 2, "identify", run)
    assert ok(capsys, "repair", run, "--json").document["set_aside"] == [-3]
    assert checked(run) == 0


@pytest.mark.parametrize("how", ["hash", "damage"])
def test_a_bad_revision_is_set_aside_and_no_reading(run, found, capsys, how):
    spoil(run, found, how)
    original = run.read_bytes()
    for command in ("info", "identify", "compare", "export"):
        words = ["--readings", str(run.with_suffix(".csv"))] if command == "export" else []
        assert f"hilcal repair {run}" in refused(capsys, 2, command, run, *words)
    refusal_text = refused(capsys, 2, "run", CELL, "-o", run, "--resume")  # it looks at no revision
    assert "was not measured with `hilcal run`" in refusal_text
    with CampaignFile.open(run, check_revisions=False) as file:
        readings = file.readings()
        more_hash = content_hash(readings)
    refusal_text = ok(capsys, "repair", run, "--json").document
    assert refusal_text["set_aside"] == [2, 3]
    beside = Path(refusal_text["original"])
    assert beside.read_bytes() == original
    assert beside.parent == run.parent
    with CampaignFile.open(run) as file:
        assert file.data_hash() == more_hash
        assert [r.number for r in file.revisions()] == [1]
        assert file.accepted() == 1
        with pytest.raises(InputError, match="append only"), schema.sqlite_errors(run):
            file.connection.execute("DELETE FROM revisions")
    assert from_text(to_text(_first(run)), 1) == _first(run)
    ok(capsys, "compare", run)
    ok(capsys, "identify", run, "--scaling", "gu")
    assert checked(run) == 2
    before = run.read_bytes()
    assert ok(capsys, "repair", run, "--json").document["set_aside"] == []
    assert run.read_bytes() == before
    assert len(list(run.parent.iterdir())) == 2


def _first(path):
    with CampaignFile.open(path, read_only=True) as file:
        return file.revision(1)


def test_a_second_repair_keeps_both_originals(run, found, capsys):
    spoil(run, found, "damage")
    first = Path(ok(capsys, "repair", run, "--json").document["original"])
    kept = first.read_bytes()
    with hc.Campaign.open(run) as o:
        o.append(found)
    spoil(run, found, "damage")
    second = Path(ok(capsys, "repair", run, "--json").document["original"])
    assert first != second
    assert first.read_bytes() == kept
