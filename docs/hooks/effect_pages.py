"""A page for each effect: law, parameters with ordinary sizes, options, picture."""

import inspect
import io
import json
import os
import re
from contextlib import redirect_stderr, redirect_stdout, suppress
from typing import Any

import law
from effect_picture import SHOWN, Picture, picture_of

from hilcal.cli import main
from hilcal.effects.catalogue import BUILT_IN
from hilcal.effects.protocol import Effect, Parameter
from hilcal.numbers import unit_for
from hilcal.present.charts import template
from studies.picture import svgs

PICTURE = (
    "How it moves the target of {arm} in base axes, at one pose with 5 kg on the tool: x (solid), "
    "y (dashed) and z (dotted), by {which} at its ordinary size of {size}."
)
ALL_PARAMETERS = (
    " On the right: how far each parameter of ordinary size moves the target, root mean square "
    "over poses{most}."
)
ROLES = {
    "registration": "It is in every model while the registration of the tracker is unknown.",
    "target": "It is in every model while the target's place on the flange is unknown.",
    "observer": "It is in every model while the place of one of several observers is unknown.",
    "baseline": "It is in every starting model where a load acts.",
    "effect": "It is added by name, or where a diagnosis finds it missing.",
}


def documents() -> dict[str, dict[str, Any]]:
    """Return what `hilcal effects --json` says of each effect."""
    out, words = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(words), suppress(SystemExit):
        main(["effects", "--json"])
    return {e["name"]: e for e in json.loads(out.getvalue())["effects"]}


def pages() -> dict[str, str]:
    """Return the pages by name of the effect."""
    known = documents()
    pictures = [picture_of(kind) for kind in BUILT_IN]
    quick = bool(os.environ.get("HILCAL_DOCS_QUICK"))
    drawn = [""] * len(pictures) if quick else svgs([p.figure for p in pictures])
    return {
        kind.name: _page(kind, known[kind.name], picture, _themed(svg))
        for kind, picture, svg in zip(BUILT_IN, pictures, drawn, strict=True)
    }


def overview() -> str:
    """Return the table of all effects."""
    rows = ["| effect | law |", "|---|---|"]
    rows += [f"| [`{k.name}`]({k.name}.md) | {_cell(law.inline(k.summary))} |" for k in BUILT_IN]
    return "\n".join(rows)


def _page(kind: type[Effect], told: dict[str, Any], picture: Picture, svg: str) -> str:
    drawn = f'<div class="picture" data-search-exclude>\n{svg}</div>\n\n*{_caption(picture)}*'
    more = [ROLES[kind.role]]
    if told["elastic"]:
        more.append("It depends on the forces in the arm, and is solved for at equilibrium.")
    if told["needs"]:
        needs = " and ".join(f"`{n}`" for n in told["needs"])
        more.append(f"The readings must have the column {needs.replace(' or ', '` or `')}.")
    if kind.of_setup or kind.role in ("registration", "target", "observer"):
        more.append("It belongs to how a campaign is set up: each campaign learns it anew.")
    parts = [
        f"# {kind.name}",
        _sentence(law.inline(kind.summary)),
        drawn if svg else "",
        "## Law",
        _described(kind),
        " ".join(more),
        "## Parameters",
        _parameters(picture.parameters),
        _sizes(told),
        _options(told),
        "## In the code",
        f"Class `{kind.__name__}` of `{kind.__module__}`.",
    ]
    return "\n\n".join(p for p in parts if p) + "\n"


def _sentence(text: str) -> str:
    return (text if text.startswith("<") else text[0].upper() + text[1:]) + "."


def _described(kind: type[Effect]) -> str:
    """Return the class's docstring, with its formulas as mathematics."""
    paragraphs = (inspect.getdoc(kind) or "").split("\n\n")
    return "\n\n".join(
        law.display(p) if p.startswith("    ") else _linked(law.inline(p), kind.name)
        for p in paragraphs
        if p.strip()
    )


def _linked(text: str, but: str) -> str:
    """Let names of effects lead to their pages."""
    names = {k.name for k in BUILT_IN} - {but}
    return re.sub(
        r"`([a-z_]+)`", lambda f: f"[`{f[1]}`]({f[1]}.md)" if f[1] in names else f[0], text
    )


def _parameters(parameters: tuple[Parameter, ...]) -> str:
    """Return the table of parameters; those that differ by a number alone share a row."""
    alike: dict[tuple[str, str], list[Parameter]] = {}
    for p in parameters:
        alike.setdefault((_bare(p.name), p.unit), []).append(p)
    said = any(p.meaning for p in parameters)
    rows = ["| parameter | ordinary size |" + " meaning |" * said, "|---|---|" + "---|" * said]
    for group in alike.values():
        first, last = group[0], group[-1]
        names = f"`{first.name}`" if first is last else f"`{first.name}` … `{last.name}`"
        sizes = [p.scale for p in group]
        least, most = _measured(first.unit, min(sizes)), _measured(first.unit, max(sizes))
        size = least if least == most else f"{least} to {most}"
        meaning = first.meaning if first is last else _bare(first.meaning, "*n*")
        rows.append(f"| {names} | {size} |" + f" {_cell(meaning)} |" * said)
    return "\n".join(rows)


def _bare(text: str, number: str = "#") -> str:
    return re.sub(r"(?<=[a-z ])[0-9]+", number, text)


def _measured(unit: str, value: float) -> str:
    """Write a value in a unit for people."""
    name, factor = unit_for(unit, [value])
    return f"{float(f'{factor * value:.2g}'):g} {name}".removesuffix(" 1")


def _sizes(told: dict[str, Any]) -> str:
    out = []
    if told["expected"]:
        sizes = (_measured(e["unit"], e["std"]) for e in told["expected"])
        expected = ", ".join(dict.fromkeys(sizes))
        out.append(
            "Before anything is measured their standard deviation is expected to be "
            f"{expected}, known to a factor of 7."
        )
    if told["plausible"]:
        most = ", ".join(_measured(unit, value) for unit, value in told["plausible"].items())
        out.append(f"A suspect whose parameters have to be larger than {most} is not named.")
    if out:
        out.append("`[ordinary]` and `[plausible]` of a cell change these sizes.")
    return " ".join(out)


def _options(told: dict[str, Any]) -> str:
    if not told["options"]:
        return ""
    rows = ["## Options", "| option | what it chooses | default |\n|---|---|---|"]
    for name in told["options"]:
        given = told["defaults"].get(name)
        default = "–" if given is None else f"`{given}`"
        rows[-1] += f"\n| `{name}` | {_cell(told['option_help'][name])} | {default} |"
    return "\n\n".join(rows)


def _caption(picture: Picture) -> str:
    p, several = picture.parameters[picture.strongest], len(picture.parameters) > 1
    which = f"the parameter that moves it most, {p.name}," if several else f"its parameter {p.name}"
    most = f", the largest {SHOWN}" if len(picture.parameters) > SHOWN else ""
    words = PICTURE.format(arm=picture.arm, which=which, size=_measured(p.unit, p.scale))
    return words + ALL_PARAMETERS.format(most=most) * several


def _themed(svg: str) -> str:
    """Return a picture that takes the ink of its page, in light and dark."""
    look = template(False).layout
    for colour, var in (
        (look.font.color, "var(--md-default-fg-color)"),
        (look.xaxis.gridcolor, "var(--md-default-fg-color--lightest)"),
    ):
        r, g, b = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
        svg = svg.replace(f"rgb({r}, {g}, {b})", var)
    return svg


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
