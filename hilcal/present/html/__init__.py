"""The report as one HTML page that loads nothing else: template, style, script and plotly.js."""

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
from hilcal.present.document import Block, Chart, PageSection, captioned, says

HERE = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class FirstScreen:
    """What the first screen says."""

    headline: str  # the verdict in a few words
    tone: str  # "good", "doubt" or "bad", for the colour; the headline says it in words
    answers: tuple[tuple[str, str], ...]  # question and answer
    cards: tuple[tuple[str, str, str], ...]  # numbers: label, value with unit, note
    limit: str = ""  # "PASSED" or "FAILED" and why; empty without a limit
    passed: bool | None = None  # whether the limit is kept; None without one
    verdict: str | None = None  # of the diagnosis; None where nothing was diagnosed


def render(title: str, about: str, first: FirstScreen, parts: tuple[PageSection, ...]) -> str:
    """Return a page of sections below a first screen; `about` is what it is of, in one line."""
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
    """Return blocks as a piece of HTML without style or script, which charts would need."""
    part = _environment().get_template("blocks.html").module.part  # type: ignore[attr-defined]
    return "".join(str(part(block, _figure)) for block in captioned(blocks))


def in_script(json: str) -> str:
    """Return JSON that nothing in it can end the script that holds it, or turn its text."""
    return escaped(json).replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def _figure(chart: Chart) -> dict[str, object]:
    """Return what the template needs of a chart: the figure, its sentence and height."""
    bare = go.Figure(chart.figure)
    bare.layout.template = None
    bare.layout.height = chart.height or chart.figure.layout.height
    return {
        "json": Markup(in_script(bare.to_json())),  # noqa: S704  (escaped by in_script)
        "says": says(chart.figure),
        "height": int(bare.layout.height),
    }


def _shown(value: object) -> object:
    """Return what a page shows of a value; ends of lines are blanks in HTML anyway."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return "\n".join(map(escaped, value.split("\n")))


@cache
def _environment() -> Environment:
    """Every text is escaped; what is markup is named in `render`."""
    return Environment(
        loader=FileSystemLoader(HERE),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )
