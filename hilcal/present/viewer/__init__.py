"""The story in rerun, as a recording file or from a server for viewers."""

from hilcal.optional import needed_by

with needed_by("the viewer"):
    import rerun  # noqa: F401 - all modules here need it

from hilcal.present.viewer.campaign import save, serve

__all__ = ["save", "serve"]
