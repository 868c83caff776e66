"""Power is lost at every write, in every order that the disk allows: nothing stored is lost."""

import shutil
from pathlib import Path

import pytest

from hilcal.errors import InputError
from hilcal.store.campaign_file import CampaignFile
from tests.support import power_loss
from tests.support.paths import ROOT
from tests.support.readings_cases import assert_same, simple

WRITER = """
import os, sys
from pathlib import Path
from hilcal.store.campaign_file import CampaignFile
from tests.support.readings_cases import simple
from tests.unit.data.test_campaign import REVISION
folder = Path(sys.argv[1])
ack = os.open(str(folder / "ack"), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
with CampaignFile.create(folder / "run.hilcal", "{}", "", "a test") as run:
    x = simple(BATCHES)
    for k in range(BATCHES):
        if k == 2:
            run.append_revision(REVISION)
            run.accept(1)
        run.append_readings(x[k : k + 1])
        os.write(ack, b".")
"""
"""Readings go in one by one; a revision comes after the second, is accepted, and is not counted."""


def _lost(tmp_path, batches, tries, writer=WRITER, syncs=4):
    folder = tmp_path / "disk"
    folder.mkdir()
    recorder = power_loss.compiled(tmp_path)
    ops = power_loss.recorded(writer.replace("BATCHES", str(batches)), folder, recorder, ROOT)
    assert sum(op.kind == "sync" for op in ops) >= syncs * batches, "the recorder sees no syncs"
    whole, count, seen = simple(batches), 0, set()
    after = tmp_path / "after"
    for acknowledged, state in power_loss.crashes(ops, folder, "ack", 1, tries):
        content = tuple(sorted(state.items()))
        if (acknowledged, content) in seen:
            continue
        seen.add((acknowledged, content))
        count += 1
        shutil.rmtree(after, ignore_errors=True)
        after.mkdir()
        for path, data in state.items():
            (after / Path(path).name).write_bytes(data)
        run = after / "run.hilcal"
        if not run.exists():
            assert acknowledged == 0, "a campaign with stored readings is gone"
            continue
        with CampaignFile.open(run) as file:
            there = file.n_readings
            assert acknowledged <= there <= acknowledged + 1
            if there:
                assert_same(file.readings(), whole[:there])
            revisions = file.revisions()
            assert len(revisions) == 1 or acknowledged <= 2
            if file.accepted():
                assert len(revisions) == 1
            if there < batches:  # and it goes on
                file.append_readings(whole[there : there + 1])
                assert file.n_readings == there + 1
    return count


@pytest.mark.skipif(shutil.which("gcc") is None, reason="the recorder needs gcc")
def test_power_loss_at_every_write(tmp_path):
    assert _lost(tmp_path, 3, tries=2) > 50


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("gcc") is None, reason="the recorder needs gcc")
def test_power_loss_in_many_orders(tmp_path):
    assert _lost(tmp_path, 6, tries=30) > 1000


def test_the_model_loses_what_was_never_synced(tmp_path):
    folder = tmp_path / "disk"
    make = power_loss.Op
    path = str(folder / "a")
    ops = [
        make("create", path, 0, b""),
        make("write", path, 0, b"x"),
        make("sync", path, 0, b""),
        make("sync", str(folder), 0, b""),
        make("write", path, 1, b"y"),
    ]
    states = [state for _, state in power_loss.crashes(ops, folder, "ack", 0)]
    assert {} in states  # the name was not synced
    assert {path: b"x"} in states[-4:]
    assert {path: b"xy"} in states[-4:]
    assert {} not in states[-4:]


@pytest.mark.skipif(shutil.which("gcc") is None, reason="the recorder needs gcc")
def test_a_program_that_does_not_sync_is_found_out(tmp_path):
    careless = WRITER.replace("    x = simple", "    run.connection.execute(OFF)\n    x = simple")
    careless = 'OFF = "PRAGMA synchronous = OFF"\n' + careless
    with pytest.raises((AssertionError, InputError)):
        _lost(tmp_path, 3, tries=3, writer=careless, syncs=0)
