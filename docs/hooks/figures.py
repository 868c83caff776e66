"""mkdocs hook: the figures of the pages are drawn in the build, see `studies.page_figures`.

With HILCAL_DOCS_QUICK=1 each is an empty picture.
"""

import os
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from studies.page_figures import NAMES, figures
from studies.picture import svgs

EMPTY = '<svg xmlns="http://www.w3.org/2000/svg" width="720" height="400"/>\n'


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pictures."""
    if os.environ.get("HILCAL_DOCS_QUICK") == "1":
        drawn = dict.fromkeys(NAMES, EMPTY)
    else:
        made = figures(Path(config.docs_dir) / "measured")
        drawn = dict(zip(made, svgs(list(made.values())), strict=True))
    for path, svg in drawn.items():
        files.append(File.generated(config, path, content=svg))
    return files
