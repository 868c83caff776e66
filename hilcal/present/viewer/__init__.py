"""The story in rerun: a recording file, or a server that viewers join."""

from hilcal.errors import InputError

try:
    import rerun  # noqa: F401 - all modules here need it
except ImportError as error:
    raise InputError(
        "the viewer needs rerun-sdk, which is not installed: pip install rerun-sdk"
    ) from error

from hilcal.present.viewer.campaign import Served, record, save, serve

__all__ = ["Served", "record", "save", "serve"]
