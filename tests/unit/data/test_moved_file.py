"""A campaign that is deleted, replaced or moved while it is written: said, and nothing is lost."""

import os
import shutil
from pathlib import Path

import pytest

from hilcal.errors import HilcalError, MovedFileError
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.run_log import RunLog
from tests.unit.data.test_run_log import STEPS, _campaign, _reading


def _replace(path):
    other = path.with_name("other")
    _campaign(other).close()
    other.replace(path)


def _rename_folder(path):
    path.parent.rename(path.parent.with_name("renamed"))


LOST = {
    "deleted": Path.unlink,
    "replaced by another campaign": _replace,
    "replaced by a text": lambda p: (p.unlink(), p.write_text("x")),
    "moved": lambda p: p.rename(p.with_name("moved.hilcal")),
    "its folder moved": _rename_folder,
    "its folder deleted": lambda p: shutil.rmtree(p.parent),
}


def _found(error):
    return Path(str(error).partition(" are in ")[2].partition(": move that back")[0])


@pytest.mark.parametrize("how", LOST)
@pytest.mark.parametrize("when", ["before a store", "at the end"])
def test_what_was_measured_is_found_again(how, when, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    path = tmp_path / "folder" / "run.hilcal"
    path.parent.mkdir()

    def measure():
        with _campaign(path) as file:
            log = RunLog(file)
            for step in STEPS[:2]:
                log.record(_reading(step), step, {})
            LOST[how](path)
            if when == "before a store":
                log.record(_reading(STEPS[2]), STEPS[2], {})

    with pytest.raises(MovedFileError) as told:
        measure()
    assert str(told.value).startswith(f"{path}: deleted, replaced or moved")
    assert "all 2 readings" in str(told.value)
    place = _found(told.value)
    assert place != path
    with CampaignFile.open(place) as file:
        assert RunLog(file).done() == frozenset(STEPS[:2])
        log = RunLog(file)
        log.record(_reading(STEPS[2]), STEPS[2], {})  # and it goes on
    if how == "replaced by a text":
        assert path.read_text() == "x"


def test_a_rescued_copy_replaces_no_file(tmp_path):
    path, there = tmp_path / "run.hilcal", tmp_path / "run.rescued.hilcal"
    there.write_text("kept")
    file = _campaign(path)
    log = RunLog(file)
    log.record(_reading(STEPS[0]), STEPS[0], {})
    path.unlink()
    with pytest.raises(MovedFileError) as told, file:
        pass
    assert there.read_text() == "kept"
    assert _found(told.value).name == "run.rescued-2.hilcal"


def test_a_link_to_a_campaign_is_its_place(tmp_path):
    real, link = tmp_path / "real.hilcal", tmp_path / "link.hilcal"
    _campaign(real).close()
    link.symlink_to(real)
    with CampaignFile.open(link) as file:
        log = RunLog(file)
        log.record(_reading(STEPS[0]), STEPS[0], {})
        real.rename(tmp_path / "renamed.hilcal")
        with pytest.raises(MovedFileError, match=r"renamed\.hilcal"):
            log.event("x", {})
    assert link.is_symlink()


def test_a_killed_transaction_of_a_linked_campaign_is_undone(tmp_path):
    """Its journal lies beside the file, not beside the link."""
    real, link = tmp_path / "a" / "real.hilcal", tmp_path / "link.hilcal"
    real.parent.mkdir()
    _campaign(real).close()
    link.symlink_to(real)
    pid = os.fork()
    if pid == 0:  # dies within a transaction that has reached the file
        file = CampaignFile.open(link)
        file.connection.execute("PRAGMA cache_size = 1")
        file.connection.execute("BEGIN IMMEDIATE")
        for k in range(200):
            file.connection.execute("INSERT INTO loads VALUES (?, ?)", (k, "x" * 1000 + str(k)))
        os._exit(0)
    os.waitpid(pid, 0)
    assert real.with_name("real.hilcal-journal").exists()
    with CampaignFile.open(link, read_only=True) as file:
        assert file.connection.execute("SELECT count(*) FROM loads").fetchone() == (0,)


@pytest.mark.skipif(os.geteuid() == 0, reason="for the superuser nothing is read-only")
def test_a_folder_made_read_only_is_said(tmp_path):
    path = tmp_path / "run.hilcal"
    with _campaign(path) as file:
        log = RunLog(file)
        log.record(_reading(STEPS[0]), STEPS[0], {})
        tmp_path.chmod(0o555)
        try:
            with pytest.raises(HilcalError, match="read-only"):
                log.record(_reading(STEPS[1]), STEPS[1], {})
        finally:
            tmp_path.chmod(0o755)
        assert file.n_readings == 1
