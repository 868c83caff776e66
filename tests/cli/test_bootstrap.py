"""`bootstrap` on the command line."""

import pytest

from tests.support.cli_cases import CELL, ok, refused, table
from tests.support.cli_cases import run as command


@pytest.fixture(scope="module")
def csv(tmp_path_factory):
    return table(tmp_path_factory.mktemp("bootstrap") / "t.csv", "nothing", poses=12)


def test_words_and_document_and_nothing_is_written(csv, capsys):
    run = csv.with_name("run.hilcal")
    ok(capsys, "import", csv, "--config", CELL, "-o", run)
    before = run.read_bytes()
    words = ok(capsys, "bootstrap", run, "--draws", "20", "--workers", "1")
    assert "20 times to 12 poses drawn from its 12" in " ".join(words.out.split())
    assert "joint_compliance.j2" in words.out
    assert "no revision yet" in words.err
    asked = ("bootstrap", run, "--draws", "20", "--workers", "1", "--json")
    document = ok(capsys, *asked).document
    assert (document["revision"], document["draws"], document["failed"]) == (None, 20, 0)
    names = [p["name"] for p in document["parameters"]]
    assert "joint_compliance.j2" in names
    assert ok(capsys, *asked).document == document
    assert run.read_bytes() == before


def test_what_it_refuses(csv, capsys):
    few = csv.with_name("few.hilcal")
    lines = csv.read_text().splitlines(keepends=True)
    csv.with_name("few.csv").write_text("".join(lines[: 1 + 5 * (len(lines) - 1) // 12]))
    ok(capsys, "import", csv.with_name("few.csv"), "--config", CELL, "-o", few)
    said = refused(capsys, 2, "bootstrap", few, "--draws", "3")
    assert "draws 3, seed 0; valid: at least 20 draws" in said
    ended = command(capsys, "bootstrap", few, "--workers", "1")
    assert (ended.code, ended.out) == (4, "")
    assert "error: 5 distinct poses were fitted" in ended.err
