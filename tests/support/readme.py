"""What the README tells an operator to paste and to type, in order."""

import re
import shlex

from tests.support.paths import ROOT

CAMPAIGN = "## A real campaign, step by step"
_CODE = re.compile(r"^ {7,}(\S.*)$")
_INLINE = re.compile(r"`(hilcal [^`]*)`")
_OPTIONAL = re.compile(r"\[(--[^\]]*)\]")


def campaign():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return CAMPAIGN + text.split(CAMPAIGN, 1)[1].split("\n## ", 1)[0]


def cell():
    """CELL.toml: every TOML block of the section, pasted one after the other."""
    lines = []
    for block in _blocks(campaign()):
        if block[0].startswith("["):
            lines += block
    return "\n".join(lines) + "\n"


def commands(*, options=False):
    """Commands of the section as words without "hilcal": of the blocks, then of the sentences."""
    typed, mentioned = [], []
    for line in campaign().splitlines():
        code = _CODE.match(line)
        if code is None:
            mentioned += _INLINE.findall(line)
        elif code[1].startswith("hilcal "):
            typed.append(code[1])
    given = (_OPTIONAL.sub(r"\1" if options else "", text) for text in (*typed, *mentioned))
    each = [shlex.split(text, comments=True)[1:] for text in given]
    return [words for words in each if words[0][0].islower()]


def _blocks(text):
    """Indented blocks of code, without their indentation."""
    out = [[]]
    for line in text.splitlines():
        code = _CODE.match(line)
        if code is not None:
            out[-1].append(line[7:])
        elif out[-1]:
            out.append([])
    return [block for block in out if block]
