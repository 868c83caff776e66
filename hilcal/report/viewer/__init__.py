"""The story in rerun: a recording file, or a server that viewers join."""

from hilcal.report.viewer.digest import Limits
from hilcal.report.viewer.stream import Served, record, save, serve

__all__ = ["Limits", "Served", "record", "save", "serve"]
