"""Recordings of rerun: opening, sending, flushing and writing; and the viewer's executable."""

import contextlib
import hashlib
import logging
import shutil
import socket
import subprocess
import uuid
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hilcal.errors import HilcalError, InputError
from hilcal.whole_file import RECORDING, replace_file, spare_other

APPLICATION, LOOPBACK = "hilcal", "127.0.0.1"
_FLUSH_TIMEOUT = 10.0
_LOG = logging.getLogger(__name__)


def bind_error(port: int) -> Exception | None:
    """Return why a port cannot be bound, None if it can; a server would only log the error."""
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((LOOPBACK, port))
    except (OSError, OverflowError) as error:
        return error
    return None


def content_stream(*content: object) -> rr.RecordingStream:
    """Return a stream whose identifier is a hash of the content, values or arrays."""
    sha = hashlib.sha256()
    for part in content:
        array = isinstance(part, np.ndarray)
        sha.update(np.ascontiguousarray(part).tobytes() if array else repr(part).encode())
    # Chunks end at a flush, not at a clock tick, so that equal content gives equal files.
    return stream(str(uuid.UUID(bytes=sha.digest()[:16])), rr.ChunkBatcherConfig.NEVER())


def stream(identifier: str, batches: rr.ChunkBatcherConfig | None) -> rr.RecordingStream:
    """Return a recording without the default timelines of log time and log tick."""
    rec = rr.RecordingStream(
        APPLICATION, recording_id=identifier, send_properties=False, batcher_config=batches
    )
    rec.set_log_time_enabled(False)
    rec.set_log_tick_enabled(False)
    return rec


def is_timeout(error: Exception) -> bool:
    """Return whether an error is only a timeout of the receiver."""
    return "timeout" in str(error).lower() or "timed out" in str(error).lower()


def write(
    rec: rr.RecordingStream, blueprint: rrb.Blueprint, log: Callable[[], None], path: Path
) -> None:
    """Write what `log` logs to a file, atomically, and close the stream.

    The recording is encoded in memory, since rerun's file sink can wait forever on a full disk.
    Raises InputError if the folder is missing, or the file cannot be written.
    """
    if not path.parent.is_dir():
        raise InputError(f"recording {path}: no folder {path.parent}; make it first")
    spare_other(path, "a recording", RECORDING)
    memory = rec.memory_recording()
    rec.send_blueprint(blueprint, make_active=True, make_default=True)
    log()
    try:
        replace_file(path, memory.drain_as_bytes())
    finally:
        rec.disconnect()


def flush(rec: rr.RecordingStream) -> None:
    """Send what was logged to the sinks; HilcalError if one has failed, a slow one may time out."""
    try:
        rec.flush(timeout_sec=_FLUSH_TIMEOUT)
    except (ValueError, RuntimeError, OSError) as error:
        if not is_timeout(error):
            raise HilcalError(f"the recording's sink failed: {error}") from error
        _LOG.warning("recording: a viewer is slow: %s", error)


def disable_analytics() -> None:
    """Disable the viewer's usage statistics for this user; they are enabled by default."""
    with contextlib.suppress(OSError, subprocess.SubprocessError, HilcalError):
        command = [executable(), "analytics", "disable"]
        subprocess.run(command, check=False, capture_output=True, timeout=10)  # noqa: S603


def executable() -> str:
    """Return the path of the rerun viewer, preferably that of the installed SDK."""
    try:
        import rerun_cli  # type: ignore[import-untyped, unused-ignore]
    except ImportError:
        path = shutil.which("rerun")
        if path is None:
            raise HilcalError("no rerun viewer: install rerun-sdk") from None
        return path
    return str(Path(str(rerun_cli.__file__)).parent / "rerun")
