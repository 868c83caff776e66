"""A page of HTML as its tags, attributes and words."""

from html.parser import HTMLParser


class Outline(HTMLParser):
    """The tags of a page with their attributes, and its words."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.tags = [tag for tag, _ in self.found]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, {key: value or "" for key, value in attrs}))

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    def of(self, tag: str, key: str) -> list[str]:
        return [attrs[key] for name, attrs in self.found if name == tag]

    @property
    def text(self) -> str:
        return " ".join("".join(self.words).split())
