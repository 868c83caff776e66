"""Hook of mkdocs: pages that are made from the code, links that leave docs/, patterns in `nav`.

Links to other sites are listed in external-links.txt of the site; no network is asked for them.
"""

import html
import os
import re
from fnmatch import fnmatch
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import api_pages
import command_pages
import effect_pages
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

OVERVIEWS = {
    "commands": command_pages.overview,
    "effects": effect_pages.overview,
    "api": api_pages.overview,
}
"""What stands in place of `<!-- made by the build: NAME -->`."""
OF_THE_TREE = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "security.md",
    "studies/benchmark/README.md": "benchmark.md",
}
"""Documents beside docs/ by their page in the site."""
_ATTRIBUTES = re.compile(r"<!-- attributes of ([A-Za-z_.]+) -->")
_MADE = re.compile(r"<!-- made by the build: ([a-z]+) -->")
_EXTERNAL = re.compile(r'<a [^>]*href="([a-z]+:[^"]*)"')
_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)#\s:]+)(#[^)\s]*)?\)")


@event_priority(-100)
def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages of the reference, and say in `nav` what its patterns stand for."""
    docs = Path(config.docs_dir)
    made = {
        **{f"reference/commands/{n}.md": text for n, text in command_pages.pages(docs).items()},
        **{f"reference/effects/{n}.md": text for n, text in effect_pages.pages().items()},
        **{f"reference/api/{n}.md": text for n, text in api_pages.pages().items()},
    }
    for source, page in OF_THE_TREE.items():
        path = docs.parent / source
        if page not in {f.src_uri for f in files} and path.is_file():
            made[page] = _from_docs(path.read_text(encoding="utf-8"), Path(source).parent)
    for uri, text in made.items():
        files.append(File.generated(config, uri, content=text))
    pages = [f.src_uri for f in files.documentation_pages()]
    config.nav = _resolved(config.nav or [], pages, set(_listed(config.nav or [])))
    return files


def _from_docs(text: str, folder: Path) -> str:
    """Let the links of a document of another folder begin in docs/."""

    def moved(link: re.Match[str]) -> str:
        words, path, anchor = link.groups()
        return f"[{words}]({os.path.relpath(folder / path, 'docs')}{anchor or ''})"

    return _LINK.sub(moved, text)


def _listed(nav: Any) -> list[str]:
    """Return all paths and patterns of a navigation."""
    if isinstance(nav, str):
        return [nav]
    parts = nav.values() if isinstance(nav, dict) else nav
    return [path for part in parts for path in _listed(part)]


def _resolved(nav: Any, pages: list[str], listed: set[str]) -> Any:
    """Put the pages in place of each pattern: those that nothing else lists."""
    if isinstance(nav, dict):
        return {title: _resolved(part, pages, listed) for title, part in nav.items()}
    if isinstance(nav, str):
        return nav
    out: list[Any] = []
    for item in nav:
        if isinstance(item, str) and "*" in item:
            depth = item.count("/")
            found = [p for p in pages if fnmatch(p, item) and p.count("/") == depth]
            out += sorted(set(found) - listed)
            listed |= set(found)
        else:
            out.append(_resolved(item, pages, listed))
    return out


def on_page_markdown(text: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Fill in overviews; let links to files beside docs/ lead to their page, or name the file."""
    text = _MADE.sub(lambda found: OVERVIEWS[found[1]](), text)
    text = _ATTRIBUTES.sub(lambda found: api_pages.attributes(found[1]), text)
    if page.is_homepage:
        page.meta["hide"] = ["navigation", "toc"]
    docs, here = Path(config.docs_dir), Path(page.file.src_uri).parent

    def mended(link: re.Match[str]) -> str:
        words, path, anchor = link.groups()
        there = (docs / here / path).resolve()
        if there.is_relative_to(docs) or not there.exists():
            return link[0]
        inside = there.relative_to(docs.parent).as_posix()
        if inside in OF_THE_TREE:
            up = "../" * len(here.parts)
            return f"[{words}]({up}{OF_THE_TREE[inside]}{anchor or ''})"
        if config.repo_url:
            return f"[{words}]({config.repo_url.rstrip('/')}/blob/HEAD/{inside}{anchor or ''})"
        return f"{words} (`{inside}` of the source)" if f"`{inside}`" != words else words

    return _LINK.sub(mended, text)


def on_post_build(*, config: MkDocsConfig) -> None:
    """List the links to other sites.

    Raises:
        PluginError: one is no address of a page that others can reach.
    """
    site = Path(config.site_dir)
    found: dict[str, set[str]] = {}
    for path in sorted(site.rglob("*.html")):
        for link in _EXTERNAL.findall(path.read_text(encoding="utf-8")):
            found.setdefault(html.unescape(link), set()).add(path.relative_to(site).as_posix())
    for link, pages in found.items():
        address = urlsplit(link)
        if address.scheme not in ("https", "mailto") or (
            address.scheme == "https" and "." not in (address.hostname or "")
        ):
            raise PluginError(f"{', '.join(sorted(pages))}: {link}; valid: https://host/...")
    text = "".join(f"{link}\t{_some(sorted(found[link]))}\n" for link in sorted(found))
    (site / "external-links.txt").write_text(text, encoding="utf-8")


def _some(pages: list[str]) -> str:
    return ", ".join(pages[:3]) + f" and {len(pages) - 3} more" * (len(pages) > 3)
