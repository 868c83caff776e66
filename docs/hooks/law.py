"""Formulas of docstrings as MathML: "dq_j = c_j τ_j" becomes mathematics that a browser draws.

Docstrings hold formulas as plain text, so that `help` shows them. In a sentence a formula is a run
of tokens (letters that stand alone, subscripts, Greek letters, numbers, signs) between words.
Indented lines of a docstring are formulas as a whole.
"""

import html
import re

_GREEK = "αβγδεζηθικλμνξπρστυφχψωΔΣΩ"
_SCRIPT = str.maketrans("⁻¹²³ᵀ", "−123T")
_FUNCTION = r"cos|sin|tanh|sign|log10|exp|diag"
_TOKEN = re.compile(
    rf"(?P<function>(?<![A-Za-z])(?:{_FUNCTION})(?![A-Za-z]))"
    rf"|(?P<name>(?<![A-Za-z'’])(?:dq|EI|GJ|[A-Za-z]|ΔT|[{_GREEK}]0?)(?![A-Za-z'’]))"
    r"(?P<sub>_[A-Za-z0-9]+(?:,[a-z])?|_?⊥)?(?P<sup>[⁻¹²³ᵀ]+)?"
    r"|(?P<number>[0-9]+(?:\.[0-9]+)?)"
    r"|(?P<after>[⁻¹²³ᵀ⊥]+|(?<=\])×)"
    r"|(?P<operator>\.\.|[=+−±×·/()\[\]|<>≤≥∂]|,(?=[^()]*\)))"
)
_RUN = re.compile(rf"(?:{re.sub(r'[?]P<[a-z]+>', '?:', _TOKEN.pattern)}|\s)+")
_APART = re.compile(r"(`[^`]*`|(?:(?<=\s)|^)\[[^\]]*\]|e\.g\.|i\.e\.|(?:[a-z]+|1)/\(N·m²?\))")
"""Code, units in brackets, and what else looks like a formula."""
_WORD = re.compile(r"(?!EI|GJ|dq|cos|sin)[A-Za-z]{2,}(?![_A-Za-z])")
_PROSE = frozenset("aAImN")
"""Letters that, alone, are words or units."""


def inline(text: str) -> str:
    """Return a paragraph of a docstring as Markdown with its formulas as MathML."""
    parts = _APART.split(text)
    return "".join(p if k % 2 else _RUN.sub(_formula, p) for k, p in enumerate(parts))


def display(text: str) -> str:
    """Return indented lines of a docstring as a block of formulas."""
    lines = (
        part
        for line in text.splitlines()
        for part in re.split(r" {3,}(?!=)", re.sub(r" +=", " =", line.strip()))
    )
    return "\n".join(f'<p class="law">{_math(line)}</p>' for line in lines if line)


def _formula(found: re.Match[str]) -> str:
    """Return a run of tokens as mathematics; as it is where it has nothing of a formula."""
    text = found[0]
    core = text.strip()
    at = text.find(core)
    while core and core.count("(") != core.count(")"):  # brackets of the sentence
        if core.startswith("("):
            core, at = core[1:], at + 1
        elif core[-1] in "()":
            core = core[:-1]
        else:  # one that opens within: it belongs to the sentence, too
            k = text.rfind("(")
            if k < 1:
                return _plain(text)
            return _RUN.sub(_formula, text[:k]) + _RUN.sub(_formula, text[k:])
    if core.startswith("(") and core.endswith(")") and core.find(")") == len(core) - 1:
        core, at = core[1:-1], at + 1
    at += len(core) - len(core.lstrip())
    core = core.strip()
    tokens = [t for t in _TOKEN.finditer(core)]
    before = found.string[: found.start() + at][-1:]
    apart = not before or before.isspace() or before in "(|"
    if not any(t["name"] for t in tokens) or core in _PROSE or not apart:
        return _plain(text)
    return f"{_plain(text[:at])}{_math(core)}{_plain(text[at + len(core) :])}"


def _plain(text: str) -> str:
    return html.escape(text, quote=False)


def _math(text: str) -> str:
    """Return a formula; in a span, since to Markdown a line that begins with math is a block."""
    return f"<span><math>{_elements(text)}</math></span>"


def _elements(text: str) -> str:
    """Return the elements of a formula; words in it stay upright."""
    out: list[str] = []
    at = 0
    while at < len(text):
        if text[at].isspace():
            out.append('<mspace width="0.2em"></mspace>')
            at += 1
        elif word := _WORD.match(text, at):
            out.append(f"<mtext>{word[0]}</mtext>")
            at = word.end()
        elif token := _TOKEN.match(text, at):
            out.append(_element(token, out))
            at = token.end()
        else:
            out.append(f"<mtext>{html.escape(text[at])}</mtext>")
            at += 1
    return "".join(out)


def _element(found: re.Match[str], out: list[str]) -> str:
    if found["function"]:
        return f"<mi>{found['function']}</mi>"
    if found["number"]:
        return f"<mn>{found['number']}</mn>"
    if found["operator"]:
        sign = {"..": "…"}.get(found["operator"], found["operator"])
        near = ' lspace="0" rspace="0"' if sign in "/()[]|" else ""
        return f'<mo stretchy="false"{near}>{html.escape(sign)}</mo>'
    if found["after"]:  # of a bracket or a number before it
        kind = "msub" if found["after"] in "⊥×" else "msup"
        return f"<{kind}>{out.pop()}<mn>{found['after'].translate(_SCRIPT)}</mn></{kind}>"
    name, sub = found["name"], (found["sub"] or "").lstrip("_")
    if name[-1] == "0":  # "τ0_j"
        name, sub = name[0], f"0{sub}"
    base = f"<mrow>{''.join(f'<mi>{letter}</mi>' for letter in name)}</mrow>"
    below = f"<mrow>{''.join(map(_letter, sub))}</mrow>" if sub else ""
    above = f"<mn>{found['sup'].translate(_SCRIPT)}</mn>" if found["sup"] else ""
    kind = "msubsup" if below and above else "msub" if below else "msup" if above else ""
    return f"<{kind}>{base}{below}{above}</{kind}>" if kind else base


def _letter(c: str) -> str:
    return f"<mn>{c}</mn>" if c.isdigit() else f"<mo>{c}</mo>" if c in ",⊥" else f"<mi>{c}</mi>"
