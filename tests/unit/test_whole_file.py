"""Files are whole or not there."""

import os
import threading
from pathlib import Path

import pytest

from hilcal.whole_file import replace_file, replacing
from tests.support.refusals import refusal


def test_a_file_that_could_not_be_written_is_as_it_was(tmp_path):
    path = tmp_path / "a.csv"

    def fill():
        with replacing(path) as new:
            new.write_text("half")
            raise OSError(28, "No space left on device")

    for before in (None, "old"):
        if before is not None:
            path.write_text(before)
        refusal(r"a\.csv: cannot be written \(No space", fill)
        assert [p.name for p in tmp_path.iterdir()] == ([] if before is None else ["a.csv"])
        assert before is None or path.read_text() == before


def test_a_link_is_followed_and_permissions_stay(tmp_path):
    (tmp_path / "there").mkdir()
    real, link = tmp_path / "there" / "real.json", tmp_path / "link.json"
    link.symlink_to("there/real.json")
    replace_file(link, "new")  # where nothing is yet
    assert real.read_text() == "new"
    old = os.umask(0o027)
    try:
        replace_file(tmp_path / "fresh", b"")
    finally:
        os.umask(old)
    assert (tmp_path / "fresh").stat().st_mode & 0o777 == 0o640
    real.chmod(0o604)
    replace_file(link, "newer")
    assert link.is_symlink()
    assert real.read_text() == "newer"
    assert real.stat().st_mode & 0o777 == 0o604
    assert sorted(p.name for p in tmp_path.rglob("*.json")) == ["link.json", "real.json"]


def test_what_is_no_file_is_written_straight(tmp_path):
    pipe, heard = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: heard.append(pipe.read_text()), daemon=True)
    reader.start()
    replace_file(pipe, "told")
    reader.join(10.0)
    assert heard == ["told"]
    assert pipe.is_fifo()
    replace_file("/dev/null", "lost")
    assert Path("/dev/null").is_char_device()


def test_what_cannot_be_written_is_one_line(tmp_path):
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    for place in (tmp_path, tmp_path / "none" / "a", loop, tmp_path / ("a" * 300)):
        refusal("cannot be written", replace_file, place, "x")
    refusal("not valid Unicode", replace_file, tmp_path / "a", "\ud800")
    replace_file(tmp_path / "a", "first", must_be_new=True)
    refusal("exists; choose another name", replace_file, tmp_path / "a", "second", must_be_new=True)
    assert (tmp_path / "a").read_text() == "first"


@pytest.mark.skipif(os.geteuid() == 0, reason="for the superuser nothing is read-only")
def test_a_file_that_may_not_be_written_is_not_replaced(tmp_path):
    path = tmp_path / "a"
    path.write_text("kept")
    path.chmod(0o444)
    refusal("Permission denied", replace_file, path, "x")
    assert path.read_text() == "kept"
