"""Refusals in files of text: what is given, and the one line that answers it.

    == name of the case
    what is given, on as many lines as it has
    -> the line, or its beginning and … where Python or a library words the rest

A given text that begins with `in NAME` is the text of that name, in which the lines that begin with
- are replaced, once, by those with + after them.

After a wanted change of words `HILCAL_REFUSALS=write pytest ...` writes the lines anew.
"""

import os
import re
from pathlib import Path

import pytest

from hilcal.errors import InputError

FOLDER = Path(__file__).resolve().parents[1] / "data" / "refusals"
BLOCK = re.compile(r"^== (.*)\n((?:(?!== |-> ).*\n)*)-> (.*)\n", re.MULTILINE)
EDIT = re.compile(r"((?:^-.*\n)+)((?:^\+.*\n)*)", re.MULTILINE)


def refusals(name):
    """Run a test with `case`, the name of a file's case, and `given`, its text."""
    blocks = BLOCK.findall((FOLDER / f"{name}.txt").read_text(encoding="utf-8"))
    rows = [pytest.param((name, case), given, id=case) for case, given, _ in blocks]
    assert len(dict(row.values[0][::-1] for row in rows)) == len(rows), "two cases of one name"
    return pytest.mark.parametrize(("case", "given"), rows)


def with_edits(source, **texts):
    """What a case gives: itself, or one of the texts with its edits."""
    if not source.startswith("in "):
        return source
    name, _, edits = source[3:].partition("\n")
    text = texts[name]
    for blocks in EDIT.findall(edits):
        old, new = ("\n".join(line[2:] for line in block.splitlines()) for block in blocks)
        assert old in text
        text = text.replace(old, new, 1)
    return text


def refuses(case, call, path=None):
    """Compare the line that a call is refused with; a path in it is known by its name alone."""
    line = refusal(".", call)
    line = line if path is None else line.replace(str(path), path.name)
    check(case, line)
    return line


def refusal(words, call, /, *given, **more):
    """Call with what is given, which is wrong input: the line that says so, with these words."""
    return refusal_of(InputError, words, call, *given, **more)


def refusal_of(kind, words, call, /, *given, **more):
    """The same where another kind of error is to be raised."""
    with pytest.raises(kind, match=words) as raised:
        call(*given, **more)
    assert raised.value.exit_code == kind.exit_code
    line = str(raised.value)
    assert "\n" not in line
    return line


def check(case, line):
    """Compare the line that a case was refused with to the one that is kept, or keep it."""
    path = FOLDER / f"{case[0]}.txt"
    text = path.read_text(encoding="utf-8")
    assert "\n" not in line
    (blocks,) = (m for m in BLOCK.finditer(text) if m[1] == case[1])
    begun = blocks[3].endswith("…") and line.startswith(blocks[3][:-1])
    if os.environ.get("HILCAL_REFUSALS") == "write" and not begun:
        path.write_text(text[: blocks.start(3)] + line + text[blocks.end(3) :], encoding="utf-8")
    else:
        assert begun or line == blocks[3]
