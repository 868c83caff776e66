"""Names that people, files and devices give: the characters that are refused, and escaping.

A name is written into programs, tables, pages, command lines and terminals. Characters that end a
line, move a cursor or change the direction of text would change the meaning of the text after them;
invisible characters would make two names look the same. They are refused in input and escaped in
output.
"""

import re
import shlex

from hilcal.errors import InputError

_REFUSED = re.compile(
    "[\x00-\x1f\x7f-\x9f"  # control characters, among them all ends of lines of C0 and C1
    "\u2028\u2029"  # ends of lines and paragraphs
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # direction of text
    "\u00ad\u180e\u200b\u2060-\u2065\u206a-\u206f"  # invisible characters (the joiners
    "\ufff9-\ufffb\U000e0000-\U000e0fff"  # U+200C and U+200D are letters of several scripts)
    "\ud800-\udfff\ufeff\ufffe\uffff]"  # halves of characters, byte order marks
)
_FORMULA = r"(?=['\" ]*[=+@\uff1d\uff0b\uff0d\uff20-])"
"""Beginning of a text that a spreadsheet takes for a formula (tab and carriage return are escaped).
"""
_TO_MARK, _MARKED = re.compile(f"(^|;){_FORMULA}"), re.compile(f"(^|;)'{_FORMULA}")
"""Where the decimal separator is a comma, a semicolon separates the cells of a spreadsheet."""


def escaped(text: str) -> str:
    r"""Return a text with `\u….` in place of each refused character."""
    return _REFUSED.sub(lambda match: _code(match[0]), text)


def _code(sign: str) -> str:
    return f"\\u{ord(sign):04x}" if ord(sign) < 0x10000 else f"\\U{ord(sign):08x}"


def check_name(text: str, where: str) -> str:
    r"""Return a text; refuse one with a refused character. `where` names its origin."""
    if match := _REFUSED.search(text):
        begin = max(match.start() - 20, 0)
        excerpt = ("…" if begin else "") + escaped(text[begin : match.start() + 20])
        raise InputError(
            f"{where}: '{excerpt}' holds the character {escaped(match[0])}; valid: text of one "
            "line without control characters"
        )
    return text


def check_names(value: object, where: str) -> None:
    """Check all texts in lists and dictionaries, including keys."""
    pending = [(value, where)]  # no recursion: a document may be nested deeper than Python's limit
    while pending:
        inner, place = pending.pop()
        if isinstance(inner, str):
            check_name(inner, place)
        elif isinstance(inner, dict):
            for key in inner:
                check_name(str(key), place)
            pending += [(item, f"{place}: {key}") for key, item in inner.items()]
        elif isinstance(inner, list | tuple):
            texts = ((k, x) for k, x in enumerate(inner, start=1) if not isinstance(x, float | int))
            pending += [(item, f"{place} {k}") for k, item in texts]


def quoted(name: object) -> str:
    """Return a name as one word of a shell's command line."""
    return shlex.quote(escaped(str(name)))


def csv_text(text: str) -> str:
    """Return a text for a cell of CSV, with an apostrophe before the beginning of a formula.

    A text that already has such an apostrophe gets another one, so that `from_csv` restores each
    text. Source: OWASP, "CSV Injection".
    """
    return _TO_MARK.sub(r"\1'", escaped(text))


def from_csv(cell: str) -> str:
    """Return the text of a cell that `csv_text` wrote."""
    return _MARKED.sub(r"\1", cell)
