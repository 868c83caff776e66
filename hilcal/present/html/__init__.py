"""Self-contained HTML pages: template, style, script and plotly.js in one file."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from hilcal.optional import needed_by

with needed_by("pages"):
    import plotly.graph_objects as go
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs
    from plotly.utils import PlotlyJSONEncoder

from hilcal.names import escaped
from hilcal.present import charts as style
from hilcal.present.document import Block, Chart, PageSection, captioned, description_of

HERE = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class FirstScreen:
    """Contents of the first screen."""

    headline: str  # the verdict in a few words
    tone: str  # "good", "doubt" or "bad"; sets the colour of the headline
    answers: tuple[tuple[str, str], ...]  # question and answer
    cards: tuple[tuple[str, str, str], ...]  # numbers: label, value with unit, note
    limit: str = ""  # "PASSED" or "FAILED" with the reason; empty without a limit
    passed: bool | None = None  # whether the limit is kept; None without one
    verdict: str | None = None  # of the diagnosis; None without one


def render(title: str, about: str, first: FirstScreen, parts: tuple[PageSection, ...]) -> str:
    """Return a page of sections below a first screen; `about` is its subject in one line."""
    looks = {"light": style.template(dark=False), "dark": style.template(dark=True)}
    return (
        _environment()
        .get_template("page.html")
        .render(
            title=title,
            about=about,
            first=first,
            sections=[replace(s, blocks=captioned(s.blocks)) for s in parts],
            figure=_figure,
            looks=Markup(in_script(json.dumps(looks, cls=PlotlyJSONEncoder))),  # noqa: S704  (escaped by in_script)
            config=Markup(in_script(json.dumps(style.CONFIG))),  # noqa: S704
            plotly=Markup(get_plotlyjs()),  # noqa: S704  (the library's own text)
            css=Markup((HERE / "style.css").read_text(encoding="utf-8")),  # noqa: S704
            script=Markup((HERE / "script.js").read_text(encoding="utf-8")),  # noqa: S704
        )
    )


def fragment(blocks: Iterable[Block]) -> str:
    """Return blocks as a fragment of HTML without style and script, hence without charts."""
    part = _environment().get_template("blocks.html").module.part  # type: ignore[attr-defined]
    return "".join(str(part(block, _figure)) for block in captioned(blocks))


def in_script(json: str) -> str:
    """Return JSON escaped for a script element: it cannot end the element or reverse its text."""
    return escaped(json).replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _figure(chart: Chart) -> dict[str, object]:
    bare = go.Figure(chart.figure)
    bare.layout.template = None
    bare.layout.height = chart.height or chart.figure.layout.height
    return {
        "json": Markup(in_script(bare.to_json())),  # noqa: S704  (escaped by in_script)
        "says": description_of(chart.figure),
        "height": int(bare.layout.height),
    }


def _shown(value: object) -> object:
    """Return a text with its control characters escaped, except line breaks; other values as is."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return "\n".join(map(escaped, value.split("\n")))


@cache
def _environment() -> Environment:
    """Return the environment of the templates; it escapes all text except `Markup`."""
    return Environment(
        loader=FileSystemLoader(HERE),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )
