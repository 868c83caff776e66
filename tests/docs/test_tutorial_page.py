"""The page of a tutorial: what its cells show, and a failing cell fails the build."""

import importlib.util
import os
from pathlib import Path
from types import ModuleType

import pytest

from tests.support.paths import ROOT

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
def hook() -> ModuleType:
    for name in ("jupytext", "mkdocs", "nbclient", "ipykernel"):
        pytest.importorskip(name, reason="needs the packages of requirements-docs.lock")
    place = ROOT / "docs" / "hooks" / "tutorials.py"
    spec = importlib.util.spec_from_file_location("tutorials_hook", place)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


@pytest.mark.slow
def test_a_page_has_cells_and_outputs(hook: ModuleType, tmp_path: Path) -> None:
    script = tmp_path / "small.py"
    script.write_text(CELLS, encoding="utf-8")
    made = hook.notebook(script, run=True)
    page = hook.page(made, "small")
    assert page.startswith("# A title\n\n[Download this page as a notebook](small.ipynb)")
    assert "<code>a &lt; b</code>" in page
    assert "```sh\necho from the shell\n```" in page
    assert "<code>from the shell</code>" in page
    assert page.rstrip().endswith("![A chart](small-1.svg)")
    assert hook.pictures(made, "small")["small-1.svg"].startswith("<svg")
    assert os.listdir(tmp_path) == ["small.py"]  # it ran in a folder of its own


@pytest.mark.slow
def test_a_cell_that_fails_fails_the_build(hook: ModuleType, tmp_path: Path) -> None:
    script = tmp_path / "wrong.py"
    script.write_text("# %%\nassert 1 == 2\n", encoding="utf-8")
    with pytest.raises(Exception, match="AssertionError"):
        hook.notebook(script, run=True)
