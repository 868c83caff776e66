"""Recordings of any subject: opened, handed on, written whole; and the viewer that shows them."""

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
from hilcal.whole_file import replace_file

APPLICATION = "hilcal"
_FLUSH_TIMEOUT = 10.0
_LOG = logging.getLogger(__name__)


def refused(ip: str, port: int) -> Exception | None:
    """Return why a port cannot be bound; None where it can. A server itself would only log it."""
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((ip, port))
    except (OSError, OverflowError) as error:
        return error
    return None


def opened(*content: object) -> rr.RecordingStream:
    """Return a stream that is equal for equal content, values or arrays: it names the recording."""
    sha = hashlib.sha256()
    for part in content:
        array = isinstance(part, np.ndarray)
        sha.update(np.ascontiguousarray(part).tobytes() if array else repr(part).encode())
    identifier = str(uuid.UUID(bytes=sha.digest()[:16]))
    # Chunks end where the stream is flushed, not when a clock ticks: equal files.
    return stream(identifier, rr.ChunkBatcherConfig.NEVER())


def stream(identifier: str, batches: rr.ChunkBatcherConfig | None) -> rr.RecordingStream:
    """Return a recording that has no other times than those that are set."""
    rec = rr.RecordingStream(
        APPLICATION, recording_id=identifier, send_properties=False, batcher_config=batches
    )
    rec.set_log_time_enabled(False)
    rec.set_log_tick_enabled(False)
    return rec


def slow(error: Exception) -> bool:
    """Whether a failure is only that somebody did not take the data in time."""
    return "timeout" in str(error).lower() or "timed out" in str(error).lower()


def fixed(rec: rr.RecordingStream, path: str, *drawn: rr.AsComponents) -> None:
    """Log what never changes."""
    rec.log(path, *drawn, static=True)


def along(
    rec: rr.RecordingStream, path: str, time: rr.TimeColumn, columns: rr.ComponentColumnList
) -> None:
    """Send what an entity is at each of some times."""
    rec.send_columns(path, indexes=[time], columns=columns)


def write(
    rec: rr.RecordingStream, blueprint: rrb.Blueprint, tell: Callable[[], None], path: Path
) -> None:
    """Write what is told to a stream as a file, whole or not at all, and close the stream.

    The recording is encoded in memory: rerun's own file sink can wait forever on a full disk.

    Raises:
        InputError: the folder is missing, or the file cannot be written.
    """
    if not path.parent.is_dir():
        raise InputError(f"recording {path}: no folder {path.parent}; make it first")
    memory = rec.memory_recording()
    rec.send_blueprint(blueprint, make_active=True, make_default=True)
    tell()
    try:
        replace_file(path, memory.drain_as_bytes())
    finally:
        rec.disconnect()


def flush(rec: rr.RecordingStream) -> None:
    """Hand everything logged so far to the sinks; a slow viewer only costs the time-out.

    Raises:
        HilcalError: a sink has failed: a full disk shows only here.
    """
    try:
        rec.flush(timeout_sec=_FLUSH_TIMEOUT)
    except (ValueError, RuntimeError, OSError) as error:
        if not slow(error):
            raise HilcalError(f"the recording's sink failed: {error}") from error
        _LOG.warning("recording: a viewer is slow: %s", error)


def disable_analytics() -> None:
    """Switch the viewer's usage statistics off for this user; they are on by default."""
    with contextlib.suppress(OSError, subprocess.SubprocessError, HilcalError):
        command = [executable(), "analytics", "disable"]
        subprocess.run(command, check=False, capture_output=True, timeout=10)  # noqa: S603


def executable() -> str:
    """Return the path of the rerun viewer that was installed with its SDK."""
    try:
        import rerun_cli  # type: ignore[import-untyped, unused-ignore]
    except ImportError:
        path = shutil.which("rerun")
        if path is None:
            raise HilcalError("no rerun viewer: install rerun-sdk") from None
        return path
    return str(Path(str(rerun_cli.__file__)).parent / "rerun")
