"""Ways to damage bytes, texts and documents; every one returns what a parser is then given."""

import json
import tomllib
from collections.abc import Sequence
from copy import deepcopy
from random import Random
from typing import Any

NUMBERS: tuple[object, ...] = (
    0, -0.0, -1, 1, 2, 255, 65535, 2**31 - 1, -(2**31), 2**63, 10**30, 1e-320, 1e-12, 1e12, 1e154,
    1e300, -1e300, 1.7976931348623157e308, float("nan"), float("inf"), float("-inf"),
)  # fmt: skip
ODD: tuple[object, ...] = (
    *NUMBERS, 1 << 70, 10**400, None, True, False, "", "x", "nan", "1e999", "../../x",
    "/etc/passwd", "\x00", "\ud800",
    "a" * 300, [], {}, [[]], [None], {"": None}, [0.0] * 6, [0.0] * 37, "é\u202e",
)  # fmt: skip
WORDS = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e999", "1e-320", "0", "-1", "0x10", "99999999999999",
    "", " ", "\x00", "\"", "'", ",", ";", "\t", "\n", "\r\n", "=", "[", "]", "[[", "{", "}", "#",
    "9" * 5000, "0x" + "f" * 5000,
    "null", "true", "é", "１", "1_0", "../../x", "$(x)", "<!ENTITY a 'b'>", "&a;", "<", ">", "/",
)  # fmt: skip


def bytes_damaged(data: bytes, rng: Random, others: Sequence[bytes] = ()) -> bytes:
    """Bits flipped, pieces cut, doubled, moved, overwritten, or spliced with another input's."""
    out = bytearray(data)
    for _ in range(1 if rng.random() < 0.6 else rng.randint(2, 6)):
        n = len(out)
        at, to = (rng.randrange(n), rng.randrange(n)) if n else (0, 0)
        match rng.randrange(9):
            case 0 | 1 if n:
                out[at] ^= 1 << rng.randrange(8)
            case 2 if n:
                out[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFE, 0xFF, 10, 13, 32, 44))
            case 3:
                del out[at:]
            case 4:
                del out[at : at + rng.randint(1, 16)]
            case 5:
                out[at:at] = out[to : to + rng.randint(1, 64)]
            case 6:
                out[at:at] = rng.randbytes(rng.randint(1, 16))
            case 7 if n:
                size = rng.choice((2, 4, 8))
                value = rng.choice((0, 1, -1, 1 << (8 * size - 1), (1 << (8 * size - 1)) - 1))
                order = rng.choice(("little", "big"))
                out[at : at + size] = (value % (1 << 8 * size)).to_bytes(size, order)
            case _ if others:
                other = rng.choice(others)
                cut = rng.randrange(len(other) + 1)
                out[at:] = other[cut:]
    return bytes(out)


def words_damaged(text: str, rng: Random) -> str:
    """Numbers and words of a text replaced, lines dropped, doubled and swapped."""
    for _ in range(1 if rng.random() < 0.6 else rng.randint(2, 6)):
        lines = text.split("\n")
        at, to = rng.randrange(len(lines)), rng.randrange(len(lines))
        match rng.randrange(7):
            case 0:
                del lines[at]
            case 1:
                lines.insert(to, lines[at])
            case 2:
                lines[at], lines[to] = lines[to], lines[at]
            case 3:
                cut = rng.randrange(len(lines[at]) + 1)
                lines[at] = lines[at][:cut] + rng.choice(WORDS) + lines[at][cut:]
            case 4:
                lines[at] = (lines[at] * rng.randint(2, 40))[:10_000]
            case _:
                sign = rng.choice(" ,;=\t")
                parts = lines[at].split(sign)
                parts[rng.randrange(len(parts))] = rng.choice(WORDS)
                lines[at] = sign.join(parts)
        text = "\n".join(lines) if lines else ""
    return text


def text_damaged(
    text: str, rng: Random, *, by_words: bool = False, encoding: str = "utf-8"
) -> bytes:
    """Bytes of a text damaged, or its lines; `by_words`, each word counts as a line."""
    if rng.random() < 0.4:
        return bytes_damaged(text.encode(encoding), rng)
    if not by_words:
        return words_damaged(text, rng).encode(encoding, "replace")
    damaged = words_damaged(text.replace(" ", "\n"), rng)
    return damaged.replace("\n", " ").encode(encoding, "replace")


def _place(root: list[Any], rng: Random) -> tuple[Any, Any]:
    """A (container, key) in a document, each depth as likely as the others."""
    holder: Any = root
    while True:
        key = rng.choice(list(holder)) if isinstance(holder, dict) else rng.randrange(len(holder))
        inner = holder[key]
        if not (isinstance(inner, dict | list) and inner) or (
            holder is not root and rng.random() < 0.25
        ):
            return holder, key
        holder = inner


def document_damaged(document: str, rng: Random) -> bytes:
    """A JSON document with values, types, lengths and keys changed, or its text damaged."""
    kind = rng.random()
    if kind < 0.1:
        return bytes_damaged(document.encode(), rng)
    if kind < 0.12:
        deep = rng.choice((50, 2000, 100_000))
        return ("[" * deep + "]" * deep).encode()
    text = json.dumps(tree_damaged(json.loads(document), rng))
    if rng.random() < 0.05 and text.startswith("{") and len(text) > 2:  # duplicate keys
        text = text[:-1] + "," + text[1:]
    return text.encode()


def toml_damaged(document: str, rng: Random) -> bytes:
    """A TOML document with values, types, lengths and keys changed, or its text damaged."""
    kind = rng.random()
    if kind < 0.2:
        return bytes_damaged(document.encode(), rng)
    if kind < 0.5:
        return words_damaged(document, rng).encode("utf-8", "replace")
    if kind < 0.51:
        return rng.choice((b"a = " + b"[" * 5000, b"a." * 5000 + b"b = 1"))
    root = tree_damaged(tomllib.loads(document), rng)
    lines = (
        (f"{json.dumps(k)} = {_toml(v)}" for k, v in root.items()) if isinstance(root, dict) else ()
    )
    return "\n".join(lines).encode("utf-8", "replace")


def _toml(value: Any) -> str:
    """A value as TOML writes it within a line; it has no null."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(k)} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, int) and abs(value) >= 1 << 63:
        return f"0x{abs(value) << 20_000:x}"
    return json.dumps("" if value is None else value)


def tree_damaged(document: Any, rng: Random) -> Any:
    """A document with values, types, lengths and keys changed; None where all of it went."""
    root = [document]
    for _ in range(1 if rng.random() < 0.6 else rng.randint(2, 5)):
        holder, key = _place(root, rng)
        value = holder[key]
        match rng.randrange(8):
            case 0 if isinstance(holder, dict):
                del holder[key]
            case 1 if isinstance(holder, dict):
                holder[rng.choice(("x", "", str(key) + "_", "version"))] = deepcopy(value)
            case 2 if isinstance(value, list) and value:
                value.pop(rng.randrange(len(value)))
            case 3 if isinstance(value, list) and value:
                value.append(deepcopy(value[rng.randrange(len(value))]))
            case 4 if isinstance(value, list) and value:
                _all_to(value, rng.choice(NUMBERS))
            case 5 if isinstance(value, int | float) and abs(value) < 1e300:
                holder[key] = value * rng.choice((-1, 0, 1e6, 1e-6, 1e200))
            case 6:
                other, name = _place(root, rng)
                holder[key] = deepcopy(other[name])
            case _:
                holder[key] = deepcopy(rng.choice(ODD))
        if not isinstance(root, list) or not root:
            break
    return root[0] if root else None


def _all_to(values: list[Any], to: object) -> None:
    """A zero matrix, one of infinities, ..."""
    for k, value in enumerate(values):
        if isinstance(value, list):
            _all_to(value, to)
        else:
            values[k] = to
