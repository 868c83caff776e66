"""mkdocs hook: each script of docs/tutorials becomes a page with its outputs, and a notebook.

A tutorial is a script with cells (`# %%`, as jupytext, Jupyter and editors read it). The build runs
it as a notebook in a folder of its own; a cell that fails, fails the build. Charts become SVG. With
HILCAL_DOCS_QUICK=1 nothing is run, and pages have no outputs.
"""

import logging
import os
import re
import shutil
import sys
import tempfile
import time
from html import escape
from pathlib import Path

import jupytext
import nbformat
import plotly.graph_objects as go
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbclient import NotebookClient
from nbformat import NotebookNode
from traitlets.config import Config

from studies.picture import svgs

PLOTLY, SVG, HTML, TEXT = (
    "application/vnd.plotly.v1+json",
    "image/svg+xml",
    "text/html",
    "text/plain",
)
SOURCES = (".py", ".toml")
"""Of files that are of no use to a reader: the scripts, and how they are formatted."""
LONGEST = 300
"""s that a cell may take."""
log = logging.getLogger("mkdocs.hooks.tutorials")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Tell outputs from the text of the page."""
    config.extra_css.append("tutorials/output.css")
    return config


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages and notebooks; leave out the scripts that they are made of."""
    folder = Path(config.docs_dir) / "tutorials"
    for script in sorted(folder.glob("*.py")):
        begun = time.monotonic()
        made = notebook(script, run=os.environ.get("HILCAL_DOCS_QUICK") != "1")
        log.info("%s took %.0f s", script.name, time.monotonic() - begun)
        for name, content in (
            (f"{script.stem}.ipynb", nbformat.writes(made)),
            *pictures(made, script.stem).items(),
            (f"{script.stem}.md", page(made, script.stem)),
        ):
            files.append(File.generated(config, f"tutorials/{name}", content=content))
    for file in list(files):
        if Path(file.src_uri).parent == Path("tutorials") and Path(file.src_uri).suffix in SOURCES:
            files.remove(file)
    return files


def on_page_markdown(text: str, *, config: MkDocsConfig, **_: object) -> str:
    """Let links to a script, which lead somewhere in the source, lead to its page."""
    names = "|".join(path.stem for path in (Path(config.docs_dir) / "tutorials").glob("*.py"))
    return re.sub(rf"(\]\([^)]*\b(?:{names}))\.py\)", r"\1.md)", text)


def notebook(script: Path, *, run: bool) -> NotebookNode:
    """Return a script as a notebook, with outputs where it is run."""
    made = jupytext.read(script)
    for k, cell in enumerate(made.cells):
        cell.id = f"cell-{k}"  # else another one in every build
    if not run:
        return made
    with tempfile.TemporaryDirectory(prefix="hilcal-tutorial-") as place:
        shutil.copytree(script.parent, place, dirs_exist_ok=True)
        here = str(Path(sys.executable).parent)  # of the command hilcal
        environment = {
            **os.environ,
            "PATH": f"{here}{os.pathsep}{os.environ.get('PATH', '')}",
            "PLOTLY_RENDERER": "plotly_mimetype",
            "TERM": "dumb",
            "COLUMNS": "100",
        }
        client = NotebookClient(
            made,
            timeout=LONGEST,
            kernel_name="python3",
            resources={"metadata": {"path": place}},
            config=Config(KernelManager={"transport": "ipc", "ip": f"{place}/kernel"}),
        )
        client.execute(env=environment)
    for cell in made.cells:
        cell.metadata.pop("execution", None)  # times, another each build
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if HTML in data or PLOTLY in data:
                data.pop(TEXT, None)  # of a value that shows itself
    return made


def _charts(made: NotebookNode) -> list[dict[str, object]]:
    outputs = (o for cell in made.cells for o in cell.get("outputs", ()))
    return [o["data"][PLOTLY] for o in outputs if PLOTLY in o.get("data", {})]


def pictures(made: NotebookNode, name: str) -> dict[str, str]:
    """Return the charts of a notebook as SVG, by file name."""
    drawn = svgs([go.Figure(c) for c in charts]) if (charts := _charts(made)) else []
    return {f"{name}-{k}.svg": svg for k, svg in enumerate(drawn, start=1)}


def page(made: NotebookNode, name: str) -> str:
    """Return the page of a notebook as Markdown; its charts are the files of `pictures`."""
    parts, charts = [], 0
    for cell in made.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        shell = all(line.startswith("!") for line in cell.source.splitlines())
        code = re.sub(r"^!", "", cell.source, flags=re.MULTILINE) if shell else cell.source
        parts.append(f"```{'sh' if shell else 'python'}\n{code}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if PLOTLY in data:
                charts += 1
                title = data[PLOTLY]["layout"].get("title", {}).get("text", "chart")
                parts.append(f"![{title}]({name}-{charts}.svg)")
            elif HTML in data:
                parts.append(f'<div class="tutorial-output">\n{data[HTML]}\n</div>')
            else:
                text = data.get(TEXT) or output.get("text", "")
                inner = f"<code>{escape(text.strip())}</code>"
                parts.append(f'<pre class="tutorial-output">{inner}</pre>')
    title, _, rest = "\n\n".join(parts).partition("\n")
    note = f"[Download this page as a notebook]({name}.ipynb){{ download }}"
    return f"{title}\n\n{note}\n{rest}\n"
