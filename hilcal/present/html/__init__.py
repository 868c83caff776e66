"""The report as one HTML page that needs nothing else: parts, sections, template."""

from hilcal.optional import needed_by

with needed_by("pages"):
    import jinja2  # noqa: F401 - modules here need both
    import plotly  # noqa: F401
