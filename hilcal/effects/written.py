"""Effects with their options as people write them: "creep, hysteresis(joints=1-3)"."""

import math
import re
from collections.abc import Iterator

from hilcal.cell import Cell
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.options import Options
from hilcal.effects.protocol import Effect
from hilcal.errors import InputError
from hilcal.readings.readings import States

EXAMPLE = "valid: NAME or NAME(option=value, option=value), as hysteresis(joints=1-3)"
_VALUES = 'a number, true, false, a word, "quoted text", or a list of them, as [2, 4]'
_CLOSING = {"(": ")", "[": "]"}
_QUOTES = "\"'"
_PART = re.compile(r"([^()]*)(?:\((.*)\))?", re.DOTALL)
_KEY = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_WHOLE = re.compile(r"[+-]?[0-9]+")
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_WORD = re.compile(r"[^\s\"'()\[\]{}=,;]+")
_TRUTH = {"true": True, "false": False}


def read_effects_text(text: str, where: str, catalogue: Catalogue) -> dict[str, dict[str, object]]:
    """Read names of effects, with their options in parentheses, separated by commas, by name.

    E.g. "joint_compliance, transmission_error(harmonics=20)". Options are separated by "," or ";".
    A value is a number, true or false, a word, text in quotes, or a list of them in brackets.
    `where` begins a refusal, e.g. "--effects".
    """
    out: dict[str, dict[str, object]] = {}
    for part in _split(text, ",", f"{where} {text!r}", EXAMPLE):
        match = _PART.fullmatch(part)
        if match is None:
            raise InputError(f"{where}: {part!r} is not an effect with its options; {EXAMPLE}")
        name = match[1].strip()
        catalogue[name]
        if name in out:
            raise InputError(f"{where}: {name} is there twice")
        out[name] = {} if match[2] is None else _options(match[2], f"{where}: {name}")
    return out


def write_effect(name: str, options: Options) -> str:
    """Write an effect with options so that `read_effects_text` reads the same."""
    inside = ", ".join(f"{key}={option_text(value)}" for key, value in options.items())
    return f"{name}({inside})" if inside else name


def option_text(value: object) -> str:
    """Write the value of an option; nothing for None."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        try:
            plain = _single(value, "") == value
        except InputError:
            plain = False
        quote = "'" if '"' in value else '"'
        return value if plain else f"{quote}{value}{quote}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(option_text(v) for v in value)}]"
    return repr(value)


def chosen_options(effect: Effect, states: States, m: int) -> dict[str, object]:
    """Options of an effect that differ from its defaults on its states, without its priors."""
    usual = type(effect)(effect.cell, states, effect.usual_options(m)).options
    return {
        key: value
        for key, value in effect.options.items()
        if not key.startswith("prior_")
        and (key not in usual or option_text(usual[key]) != option_text(value))
    }


def option_defaults(kind: type[Effect], cell: Cell, states: States) -> dict[str, object]:
    """Return the value of each option unless given; None where it follows from the readings."""
    if not kind.option_help:
        return {}
    full = kind(cell, states).options
    try:
        part = kind(cell, states[len(states) // 3 :]).options
    except InputError:  # too few readings for the effect
        part = {}
    same = {name: option_text(full.get(name)) == option_text(part.get(name)) for name in full}
    return {name: full[name] if same.get(name) else None for name in kind.option_help}


def _options(text: str, where: str) -> dict[str, object]:
    out: dict[str, object] = {}
    for part in _split(text, ",;", where, EXAMPLE):
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or not _KEY.fullmatch(key):
            raise InputError(f"{where}: {part!r} is not an option with a value; {EXAMPLE}")
        if key in out:
            raise InputError(f"{where}: option {key} is there twice")
        place = f"{where}: {key}"
        if value.startswith("[") and value.endswith("]"):
            values = _split(value[1:-1], ",;", place, f"valid: {_VALUES}")
            out[key] = [_single(v, place) for v in values]
        else:
            out[key] = _single(value, place)
    return out


def _single(text: str, where: str) -> object:
    if len(text) > 1 and text[0] in _QUOTES and text.find(text[0], 1) == len(text) - 1:
        return text[1:-1]
    if text in _TRUTH:
        return _TRUTH[text]
    try:
        if _WHOLE.fullmatch(text):
            return int(text)
        if _NUMBER.fullmatch(text) and math.isfinite(float(text)):
            return float(text)
    except ValueError:  # thousands of digits
        pass
    if _WORD.fullmatch(text) and not _NUMBER.fullmatch(text):
        return text
    raise InputError(f"{where} = {text or 'nothing'}; valid: {_VALUES}")


def _split(text: str, separators: str, where: str, valid: str) -> list[str]:
    """Split outside of quotes, parentheses and brackets; empty parts are left out."""
    parts, start = [], 0
    for k in _outside(text, where, valid):
        if text[k] in separators:
            parts.append(text[start:k])
            start = k + 1
    parts.append(text[start:])
    return [part.strip() for part in parts if part.strip()]


def _outside(text: str, where: str, valid: str) -> Iterator[int]:
    """Yield the positions of characters that no quotes, parentheses or brackets enclose."""
    awaited: list[str] = []
    quote = ""
    for k, character in enumerate(text):
        if quote:
            quote = "" if character == quote else quote
        elif character in _QUOTES:
            quote = character
        elif character in _CLOSING:
            awaited.append(_CLOSING[character])
        elif character in _CLOSING.values():
            if not awaited or awaited.pop() != character:
                raise InputError(
                    f"{where}: {character} at character {k + 1} closes nothing; {valid}"
                )
        elif not awaited:
            yield k
    if quote or awaited:
        raise InputError(f"{where}: {quote or awaited[-1]} is missing at the end; {valid}")
