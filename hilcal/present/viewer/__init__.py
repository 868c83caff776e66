"""The story in rerun: a recording file, or a server that viewers join."""

from hilcal.optional import needed_by

with needed_by("the viewer"):
    import rerun  # noqa: F401 - all modules here need it

from hilcal.present.viewer.campaign import save, serve

__all__ = ["save", "serve"]
