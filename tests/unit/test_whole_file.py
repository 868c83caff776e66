"""Files are whole or not there: no writer goes past `hilcal.whole_file`."""

import ast
import os
import threading
from pathlib import Path

import pytest

from hilcal.whole_file import replace_file, replacing
from tests.support.paths import ROOT
from tests.support.refusals import refusal

STRAIGHT = {
    "hilcal/whole_file.py": "it is what all others use",
    "hilcal/robot/catalogue.py": "a file in a temporary folder",
    "hilcal/doctor.py": "a file in a temporary folder",
    "hilcal/workbench/server.py": "a file in a temporary folder",
    "hilcal/cli/__init__.py": "the null device",
    "hilcal/present/live_viewer.py": "a pipe",
    "hilcal/tables/matfile.py": "a buffer in memory",
    "hilcal/present/viewer/live.py": "a recording that grows while it is looked at",
    "hilcal/store/schema.py": "SQLite has a journal of its own",
    "drivers/simulated/cell_processes.py": "a device's log, which grows",
    "drivers/simulated/blackboard.py": "memory shared by the devices of a simulated cell",
    "drivers/simulated/world_server.py": "memory shared by the devices of a simulated cell",
    "drivers/simulated/admin.py": "a socket",
    "drivers/simulated/pty_port.py": "a link to a terminal",
    "studies/corrected.py": "a log, which grows",
    "studies/discover_command.py": "a log, which grows",
    "studies/benchmark/entrants/common.py": "without hilcal, in the runner's temporary folder",
    "studies/benchmark/entrants/figaroh/entrant.py": "files in a temporary folder",
    "studies/benchmark/entrants/hilcal/entrant.py": "a file in a temporary folder",
    "studies/benchmark/entrants/run.py": "without hilcal: beside its place, and put there",
    "studies/records.py": "a log, which grows",
    "studies/discover_peers.py": "a file in a temporary folder, by a program without hilcal",
}
"""Files that write straight, and why they may."""
WRITES = {
    *("write_text", "write_bytes", "touch", "rename", "savez", "savez_compressed", "savetxt"),
    *("tofile", "to_parquet", "to_excel", "write_image", "savefig"),
    *("FileSink", "mkstemp", "NamedTemporaryFile", "copyfile", "copy2"),
    *("urlretrieve", "executescript"),
}
MODULES = {"os", "shutil", "json", "pickle", "np", "tempfile", "rr", "parquet"}


def _direct_writes(tree):
    """Yield lines of calls that write to a file, but for those in a `with replacing(...)`."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.With) and any(
            isinstance(item.context_expr, ast.Call)
            and getattr(item.context_expr.func, "id", None) == "replacing"
            for item in node.items
        ):
            continue
        if isinstance(node, ast.Call) and _writes(node):
            yield node.lineno
        yield from _direct_writes(node)


def _writes(call):
    name = getattr(call.func, "attr", getattr(call.func, "id", None))
    owner = getattr(getattr(call.func, "value", None), "id", None)
    texts = [a.value for a in (*call.args, *(k.value for k in call.keywords)) if _is_text(a)]
    if name in ("open", "fdopen"):
        flags = {getattr(n, "attr", "") for a in call.args for n in ast.walk(a)}
        modes = [t for t in texts if set(t) <= set("rwaxbt+")]
        return bool(flags & {"O_WRONLY", "O_RDWR"}) or any(set(m) & set("wax+") for m in modes)
    if name == "replace":  # of a path it has one argument, of a text two
        return owner == "os" or (len(call.args) == 1 and not call.keywords)
    if name == "connect":
        return owner == "sqlite3"
    if name == "to_csv":
        return owner != "dh_table"  # a text
    if name == "write_table":
        return owner is not None  # our own writes whole files
    if name in ("copy", "dump", "move"):
        return owner in MODULES - {"np"}
    return name in WRITES


def _is_text(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _modules():
    rooms = ("hilcal", "drivers", "studies")
    return sorted(path for room in rooms for path in (ROOT / room).rglob("*.py"))


def test_no_file_is_written_straight_to_its_place():
    found = {
        name: lines
        for path in _modules()
        if (name := path.relative_to(ROOT).as_posix()) not in STRAIGHT
        and (lines := list(_direct_writes(ast.parse(path.read_text(encoding="utf-8")))))
    }
    assert found == {}, "use hilcal.whole_file"


def test_those_that_may_write_straight_still_do():
    idle = [
        name
        for name in STRAIGHT
        if not list(_direct_writes(ast.parse((ROOT / name).read_text(encoding="utf-8"))))
    ]
    assert idle == [], "take them from the list"


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
