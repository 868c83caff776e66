"""The page of a tutorial: what its cells show, and a failing cell fails the build."""

import os
from pathlib import Path
from types import ModuleType

import pytest

from tests.support.hooks import hook

CELLS = """# %% [markdown]
# # A title
#
# Words.

# %%
print("a < b")

# %%
# !echo from the shell

# %%
import plotly.graph_objects as go

go.Figure(go.Scatter(y=[1, 2]), {"title": "A chart"})
"""


@pytest.fixture(scope="module")
def tutorials() -> ModuleType:
    for name in ("jupytext", "mkdocs", "nbclient", "ipykernel"):
        pytest.importorskip(name, reason="needs the packages of requirements-docs.lock")
    return hook("tutorials")


@pytest.mark.slow
def test_a_page_has_cells_and_outputs(tutorials: ModuleType, tmp_path: Path) -> None:
    script = tmp_path / "small.py"
    script.write_text(CELLS, encoding="utf-8")
    made = tutorials.notebook(script, run=True)
    page = tutorials.page(made, "small")
    assert page.startswith("# A title\n\n[Download this page as a notebook](small.ipynb)")
    assert "<code>a &lt; b</code>" in page
    assert "```sh\necho from the shell\n```" in page
    assert "<code>from the shell</code>" in page
    assert page.rstrip().endswith("![A chart](small-1.svg)")
    assert tutorials.pictures(made, "small")["small-1.svg"].startswith("<svg")
    assert os.listdir(tmp_path) == ["small.py"]  # it ran in a folder of its own


@pytest.mark.slow
def test_a_cell_that_fails_fails_the_build(tutorials: ModuleType, tmp_path: Path) -> None:
    script = tmp_path / "wrong.py"
    script.write_text("# %%\nassert 1 == 2\n", encoding="utf-8")
    with pytest.raises(Exception, match="AssertionError"):
        tutorials.notebook(script, run=True)
