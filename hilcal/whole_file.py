"""Atomic writing: a file takes its place when it is complete and on the disk."""

import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hilcal.errors import InputError, undone_by

SQLITE = b"SQLite format 3\x00"  # first bytes of a campaign
RECORDING, PAGE = "RRF", "<!DOCTYPE html>"  # first bytes of a recording, and of a page
_HEAD = 10_000  # bytes


def replace_file(path: str | Path, content: str | bytes, *, must_be_new: bool = False) -> None:
    """Write a file, UTF-8 where it is text; raises as `replacing` does."""
    with replacing(path, must_be_new=must_be_new) as new:
        new.write_bytes(content.encode() if isinstance(content, str) else content)


def spare_campaign(path: str | Path) -> None:
    """Refuse to overwrite a campaign, whose readings cannot be measured again."""
    if _head(path).startswith(SQLITE):
        raise InputError(f"{path}: a campaign is there, which is kept; choose another name")


def spare_other(path: str | Path, kind: str, mark: str) -> None:
    """Refuse to overwrite a file that is neither empty nor of a kind.

    Args:
        path: the file that is to be written; any name is valid for a new one.
        kind: the kind, such as "a plan".
        mark: a text near the beginning of every file of this kind.
    """
    spare_campaign(path)
    if (head := _head(path)) and mark.encode() not in head:
        raise InputError(f"{path}: exists and is not {kind}; it is not overwritten")


def _head(path: str | Path) -> bytes:
    """Return the beginning of a file; empty if it is no file or cannot be read."""
    with suppress(OSError):  # reported when it is written
        if Path(path).is_file():
            with Path(path).open("rb") as stream:
                return stream.read(_HEAD)
    return b""


@contextmanager
def replacing(
    path: str | Path, *, must_be_new: bool = False, campaign: bool = False
) -> Iterator[Path]:
    """Yield the path of an empty file, which replaces `path` at the end of the block.

    If the block or the process ends early, an existing file is unchanged. Of a link, the file that
    it points to is replaced. The new file has the permissions of the old one. A device, a
    pipe and the file that this program prints to cannot be replaced: their own path is yielded.

    Args:
        must_be_new: refuse to replace a file.
        campaign: the new file is a campaign, which alone may replace a campaign.

    Raises:
        InputError: the file cannot be written, exists and `must_be_new`, or is a campaign.
    """
    try:
        old = _status(Path(path))
        if old is not None and must_be_new:
            raise InputError(f"{path}: the file exists; choose another name")
        if old is not None and _written_in_place(old):
            yield Path(path)
            return
        if not campaign:
            spare_campaign(path)
        place = Path(os.path.realpath(path))
        if old is not None and not os.access(place, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        new = place.with_name(f".{place.stem[:40]}-{secrets.token_hex(4)}{place.suffix[-20:]}")
        os.close(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        with undone_by(lambda: new.unlink(missing_ok=True)):
            yield new
            _finish(new, old)
            new.replace(place)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else error  # libraries set no number
        raise InputError(f"{path}: cannot be written ({reason})") from error
    except UnicodeEncodeError as error:
        raise InputError(f"{path}: a text is not valid Unicode ({error.object!r:.80})") from error


def _status(path: Path) -> os.stat_result | None:
    """Return the status of a file, or of a link's file; None without a file."""
    try:
        return path.stat()
    except FileNotFoundError:
        return None


def _written_in_place(old: os.stat_result) -> bool:
    """Whether a file cannot be replaced: a device, a pipe, or the output of this program."""
    if stat.S_ISDIR(old.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not stat.S_ISREG(old.st_mode):
        return True
    for stream in (1, 2):
        with suppress(OSError):  # closed
            if os.path.samestat(old, os.fstat(stream)):
                return True
    return False


def _finish(new: Path, old: os.stat_result | None) -> None:
    """Flush a new file to the disk, with owner and permissions of the file that it replaces."""
    if old is not None:
        with suppress(PermissionError):  # only root may change the owner
            os.chown(new, old.st_uid, old.st_gid)
        new.chmod(stat.S_IMODE(old.st_mode))
    handle = os.open(new, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
