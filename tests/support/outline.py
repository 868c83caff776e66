"""A page of HTML as its tags, attributes and words."""

from html.parser import HTMLParser


class Outline(HTMLParser):
    """The tags of a page with their attributes, and its words."""

    def __init__(self, text):
        super().__init__()
        self.found = []
        self.words = []
        self.feed(text)
        self.tags = [tag for tag, _ in self.found]

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, {key: value or "" for key, value in attrs}))

    def handle_data(self, data):
        self.words.append(data)

    def of(self, tag, key):
        return [attrs[key] for name, attrs in self.found if name == tag]

    @property
    def text(self):
        return " ".join("".join(self.words).split())
