"""Names that people, files and devices give: what none of them may hold, and how it is written.

A name ends up in programs, tables, pages, command lines and on terminals.
Characters that end a line, move a cursor or turn the direction of text would make something else of
what stands after them there, and with those that nobody sees two names would look the same.
They are refused where names come in, and escaped where text goes out.
"""

import re
import shlex

from hilcal.errors import InputError

_REFUSED = re.compile(
    "[\x00-\x1f\x7f-\x9f"  # control characters, among them all ends of lines of C0 and C1
    "\u2028\u2029"  # ends of lines and paragraphs
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # direction of text
    "\u00ad\u180e\u200b\u2060-\u2065\u206a-\u206f"  # nothing is seen of them (the joiners
    "\ufff9-\ufffb\U000e0000-\U000e0fff"  # U+200C and U+200D are letters of several scripts)
    "\ud800-\udfff\ufeff\ufffe\uffff]"  # halves of characters, byte order marks
)
_FORMULA = r"(?=['\" ]*[=+@\uff1d\uff0b\uff0d\uff20-])"
"""What a spreadsheet takes a text for a formula by (a tab and a carriage return are escaped)."""
_TO_MARK, _MARKED = re.compile(f"(^|;){_FORMULA}"), re.compile(f"(^|;)'{_FORMULA}")
"""Where the decimal sign is a comma, spreadsheets begin a cell after a semicolon."""


def escaped(text: str) -> str:
    r"""Return a text with `\u….` in the place of each character that no name may hold."""
    return _REFUSED.sub(lambda found: _code(found[0]), text)


def _code(sign: str) -> str:
    return f"\\u{ord(sign):04x}" if ord(sign) < 0x10000 else f"\\U{ord(sign):08x}"


def check_name(text: str, where: str) -> str:
    r"""Return a text if it is of one line, without control characters; `where` names its origin."""
    if found := _REFUSED.search(text):
        begin = max(found.start() - 20, 0)
        shown = ("…" if begin else "") + escaped(text[begin : found.start() + 20])
        raise InputError(
            f"{where}: '{shown}' holds the character {escaped(found[0])}; valid: text of one line "
            "without control characters"
        )
    return text


def check_names(value: object, where: str) -> None:
    """Check all texts in lists and dictionaries, keys too."""
    pending = [(value, where)]  # documents of others are nested deeper than Python calls itself
    while pending:
        inner, at = pending.pop()
        if isinstance(inner, str):
            check_name(inner, at)
        elif isinstance(inner, dict):
            for key in inner:
                check_name(str(key), at)
            pending += [(one, f"{at}: {key}") for key, one in inner.items()]
        elif isinstance(inner, list | tuple):
            texts = ((k, x) for k, x in enumerate(inner, start=1) if not isinstance(x, float | int))
            pending += [(one, f"{at} {k}") for k, one in texts]


def quoted(name: object) -> str:
    """Return a name as it stands in a command line that somebody is to run: one word of a shell."""
    return shlex.quote(escaped(str(name)))


def csv_text(text: str) -> str:
    """Return a text for a cell of CSV: an apostrophe before what spreadsheets take for a formula.

    Source: OWASP, "CSV Injection". A further apostrophe stands before a text that looks so, so that
    `from_csv` returns each text as it was.
    """
    return _TO_MARK.sub(r"\1'", escaped(text))


def from_csv(cell: str) -> str:
    """Return the text of a cell that `csv_text` wrote."""
    return _MARKED.sub(r"\1", cell)
