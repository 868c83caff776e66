"""`hilcal doctor`: text, JSON and exit codes."""

from pathlib import Path

from tests.support.cli_cases import CELL, ok, run


def test_the_document_and_the_words_say_the_same(tmp_path, capsys):
    d = ok(capsys, "doctor", "--folder", tmp_path, "--json").document
    assert d["ok"] is True
    names = {f["name"] for f in d["findings"]}
    assert {"hilcal", "Python", "packages", "clock", "writing", "processors"} <= names
    words = " ".join(ok(capsys, "doctor", CELL, "--folder", tmp_path).out.split())
    assert "Nothing hinders a campaign" in words
    assert "can be read" in words


def test_what_hinders_a_campaign_is_named_and_ends_with_3(tmp_path, capsys):
    cell = tmp_path / "cell.toml"
    text = Path(CELL).read_text(encoding="utf-8")
    port = tmp_path / "ttyUSB0"
    text = text.replace('port = "simulated"', f'port = "{port}"')
    assert str(port) in text
    cell.write_text(text, encoding="utf-8")
    result = run(capsys, "doctor", cell, "--folder", tmp_path, "--json")
    assert result.code == 3
    assert result.document["ok"] is False
    (bad,) = [f for f in result.document["findings"] if f["state"] == "problem"]
    assert (bad["name"], bad["topic"]) == ("force sensor", "serial ports")
    assert str(port) in bad["said"]
    assert "1 of " in result.err.splitlines()[-1]

    cell.write_text("[robot]\nmodel = 3\n", encoding="utf-8")
    result = run(capsys, "doctor", cell, "--folder", tmp_path)
    assert result.code == 3
    assert "mend the file" in result.out
