"""Charts as SVG, drawn by plotly in a headless chromium without a network."""

import json
import shutil
from collections.abc import Sequence
from urllib.parse import unquote

import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from hilcal.errors import InputError
from hilcal.present.charts import LIGHT

WIDTH, HEIGHT = 720, 400
"""Default size of a figure, CSS pixels."""
_DRAW = """async figures => {
  const out = [];
  for (const f of figures) {
    const size = {format: 'svg', width: f.layout.width, height: f.layout.height};
    const div = document.createElement('div');
    document.body.appendChild(div);
    out.push(await Plotly.toImage(await Plotly.newPlot(div, f.data, f.layout), size));
    div.remove();
  }
  return out;
}"""


def svgs(figures: Sequence[go.Figure]) -> list[str]:
    """Draw figures as SVG texts, on a white background unless their layout has another one.

    Args:
        figures: with the size of their layout, or else `WIDTH` × `HEIGHT`.

    Raises:
        InputError: no chromium, or no playwright.
    """
    chromium = shutil.which("chromium")
    if chromium is None:
        raise InputError("no chromium found, which draws charts: on Debian install chromium")
    try:
        from playwright.sync_api import sync_playwright  # a package of the tests
    except ImportError:
        raise InputError(
            "no playwright found, which draws charts: pip install playwright"
        ) from None
    documents = []
    for f in figures:
        size = {"width": f.layout.width or WIDTH, "height": f.layout.height or HEIGHT}
        sized = go.Figure(f).update_layout(paper_bgcolor=f.layout.paper_bgcolor or LIGHT, **size)
        documents.append(json.loads(sized.to_json()))
    with sync_playwright() as p:
        browser = p.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page()
        page.add_script_tag(content=get_plotlyjs())
        drawn: list[str] = page.evaluate(_DRAW, documents)
        browser.close()
    return [unquote(text.partition(",")[2]) + "\n" for text in drawn]
