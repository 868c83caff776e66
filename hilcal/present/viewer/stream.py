"""Recordings: to a file, and to viewers that join when they like."""

import contextlib
import hashlib
import logging
import shutil
import socket
import subprocess
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hilcal.errors import HilcalError, InputError
from hilcal.present.live_viewer import PORT
from hilcal.present.story import Story, StoryRevision
from hilcal.present.viewer import charts, layout, scene, style, words
from hilcal.present.viewer.digest import Digest, digest
from hilcal.present.viewer.markdown import document, markdown
from hilcal.whole_file import replace_file

APPLICATION = "hilcal"
_FLUSH_TIMEOUT = 10.0
_LOG = logging.getLogger(__name__)
Sink = rr.FileSink | rr.GrpcServerSink


@dataclass(frozen=True, slots=True)
class Served:
    """A recording that viewers can open at `url` for as long as it is served."""

    url: str


def record(story: Story, *sinks: Sink) -> rr.RecordingStream:
    """Send a story to sinks, flushed after each revision; equal stories give equal recordings.

    Args:
        story: what is told.
        sinks: where it goes.

    Returns:
        The open stream; it closes, and ends its sinks, when it is dropped.

    Raises:
        HilcalError: a sink does not take the data (disk full, ...).
    """
    d, rec = _open(story)
    rec.set_sinks(*sinks)
    # Active, too: a viewer that has shown another recording would keep the layout of that one.
    rec.send_blueprint(layout.blueprint(d), make_active=True, make_default=True)
    tell(rec, d)
    return rec


def save(story: Story, path: Path) -> None:
    """Write a story as a recording file, whole or not at all; an existing file is replaced.

    Raises:
        InputError: the folder is missing.
        HilcalError: the file cannot be written.
    """
    path = Path(path)
    require_folder(path)
    d, rec = _open(story)
    write(rec, layout.blueprint(d), lambda: tell(rec, d), path)


@contextlib.contextmanager
def serve(story: Story, ip: str = "127.0.0.1", port: int = PORT) -> Iterator[Served]:
    """Serve a story to viewers until the block ends; viewers may join late and rejoin.

    The operator opens `rerun <url>`. The viewer's analytics are switched off for this user.

    Raises:
        InputError: the port is taken.
        HilcalError: the port cannot be served.
    """
    disable_analytics()
    try:
        bind(ip, port)
    except (OSError, OverflowError) as error:
        raise InputError(
            f"viewer server {ip}:{port}: {error}; choose a free port of this machine"
        ) from error
    try:
        rec = record(story, rr.GrpcServerSink(bind_ip=ip, port=port))
    except (OSError, RuntimeError) as error:
        raise HilcalError(f"viewer server {ip}:{port}: {error}") from error
    try:
        yield Served(f"rerun+http://{ip}:{port}/proxy")
    finally:
        rec.disconnect()


def bind(ip: str, port: int) -> None:
    """Bind a port and let it go; the server itself would only log that it is taken.

    Raises:
        OSError: it is taken, or not allowed.
        OverflowError: no port has this number.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind((ip, port))


def free(ip: str, port: int) -> bool:
    """Return whether a port can be bound."""
    try:
        bind(ip, port)
    except (OSError, OverflowError):
        return False
    return True


def opened(*content: object) -> rr.RecordingStream:
    """Return a stream that is equal for equal content, values or arrays: it names the recording."""
    sha = hashlib.sha256()
    for part in content:
        array = isinstance(part, np.ndarray)
        sha.update(np.ascontiguousarray(part).tobytes() if array else repr(part).encode())
    rec = rr.RecordingStream(
        APPLICATION,
        recording_id=str(uuid.UUID(bytes=sha.digest()[:16])),
        send_properties=False,
        # Chunks end where the stream is flushed, not when a clock ticks: equal files.
        batcher_config=rr.ChunkBatcherConfig.NEVER(),
    )
    rec.set_log_time_enabled(False)
    rec.set_log_tick_enabled(False)
    return rec


def require_folder(path: Path) -> None:
    """Refuse a file in a folder that is not there.

    Raises:
        InputError: names the folder.
    """
    if not path.parent.is_dir():
        raise InputError(f"recording {path}: no folder {path.parent}; make it first")


def write(
    rec: rr.RecordingStream, blueprint: rrb.Blueprint, tell: Callable[[], None], path: Path
) -> None:
    """Write what is told to a stream as a file, and close the stream.

    The recording is encoded in memory: rerun's own file sink can wait forever on a full disk.

    Raises:
        InputError: the file cannot be written.
    """
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
        if "timeout" in str(error).lower() or "timed out" in str(error).lower():
            _LOG.warning("recording: a viewer is slow: %s", error)
            return
        raise HilcalError(f"the recording's sink failed: {error}") from error


def disable_analytics() -> None:
    """Switch the viewer's usage statistics off for this user; they are on by default."""
    with contextlib.suppress(OSError, subprocess.SubprocessError, HilcalError):
        subprocess.run(  # noqa: S603 (our own arguments)
            [executable(), "analytics", "disable"],
            check=False,
            capture_output=True,
            timeout=10,
        )


def executable() -> str:
    """Return the path of the rerun viewer that was installed with its SDK."""
    try:
        import rerun_cli  # type: ignore[import-untyped, unused-ignore]
    except ImportError:
        found = shutil.which("rerun")
        if found is None:
            raise HilcalError("no rerun viewer: install rerun-sdk") from None
        return found
    return str(Path(str(rerun_cli.__file__)).parent / "rerun")


def _open(story: Story) -> tuple[Digest, rr.RecordingStream]:
    arrays = (story.q, story.pose, story.anchor, story.measured, story.covariance)
    names = (story.arm.name, story.mode, story.load_names, story.pose_names)
    told = [(r.revision, r.change, r.verdict, r.cells, r.panels) for r in story.revisions]
    rec = opened(names, *arrays, told, *(r.residual for r in story.revisions))
    return digest(story), rec


def tell(rec: rr.RecordingStream, d: Digest) -> None:
    """Log the whole story, flushed after each revision."""
    rec.send_recording_name(f"hilcal: {style.safe(d.story.arm.name)}, {len(d.story)} readings")
    begin(rec, d)
    for r in d.story.revisions:
        rec.set_time("revision", sequence=r.revision)
        tell_revision(rec, d, r)
        flush(rec)
    rec.reset_time()
    _poses(rec, d)
    flush(rec)


def begin(rec: rr.RecordingStream, d: Digest) -> None:
    """Log what is the same in every revision."""
    scene.static_scene(rec, d)
    charts.error_series(rec)
    rec.log("words/guide", document(words.GUIDE), static=True)


def tell_revision(rec: rr.RecordingStream, d: Digest, r: StoryRevision) -> None:
    """Log one revision at the recording's current time."""
    scene.revision_scene(rec, d, r)
    charts.revision_charts(rec, d, r)
    rec.log("words/verdict", document(words.verdict(d, r)))
    rec.log("words/parameters", document(markdown(r.panels.get("parameters", ()))))
    rec.log("words/revisions", document(words.revisions(d, r.revision)))
    rec.log("words/details", document(words.details(d, r)))
    rec.log("log", rr.TextLog(words.log_line(d, r), level="INFO"))


def _poses(rec: rr.RecordingStream, d: Digest) -> None:
    """Tell the last revision on the timeline `pose`, and move the arm along it."""
    last = d.story.revisions[-1]
    rec.set_time("pose", sequence=int(d.poses[0]))
    tell_revision(rec, d, last)
    rec.reset_time()
    scene.pose_scene(rec, d)
    time = [rr.TimeColumn("pose", sequence=d.poses)]
    cards = words.pose_cards(d)
    rec.send_columns(
        "words/verdict",
        indexes=time,
        columns=rr.TextDocument.columns(text=cards, media_type=["text/markdown"] * len(cards)),
    )
    charts.pose_charts(rec, d)
