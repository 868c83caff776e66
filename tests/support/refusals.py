"""Refusals in files of text: what is given, and the one line that answers it.

    == name of the case
    what is given, on as many lines as it has
    -> the line

After a wanted change of words `HILCAL_REFUSALS=write pytest ...` writes the lines anew.
"""

import os
import re
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "data" / "refusals"
BLOCK = re.compile(r"^== (.*)\n((?:(?!== |-> ).*\n)*)-> (.*)\n", re.MULTILINE)


def refusals(name: str) -> pytest.MarkDecorator:
    """Run a test with `case`, the name of a file's case, and `given`, its text."""
    blocks = BLOCK.findall((FOLDER / f"{name}.txt").read_text(encoding="utf-8"))
    rows = [pytest.param((name, case), given, id=case) for case, given, _ in blocks]
    assert len(dict(row.values[0][::-1] for row in rows)) == len(rows), "two cases of one name"
    return pytest.mark.parametrize(("case", "given"), rows)


def check(case: tuple[str, str], line: str) -> None:
    """Compare the line that a case was refused with to the one that is kept, or keep it."""
    path = FOLDER / f"{case[0]}.txt"
    text = path.read_text(encoding="utf-8")
    assert "\n" not in line
    (found,) = (m for m in BLOCK.finditer(text) if m[1] == case[1])
    if os.environ.get("HILCAL_REFUSALS") == "write":
        path.write_text(text[: found.start(3)] + line + text[found.end(3) :], encoding="utf-8")
    else:
        assert line == found[3]
