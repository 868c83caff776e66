"""Every file is written beside its place, and put there when it is complete and on the disk."""

import errno
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hilcal.errors import InputError


def replace_file(path: str | Path, content: str | bytes, *, must_be_new: bool = False) -> None:
    """Write a file, UTF-8 where it is text; raises as `replacing` does."""
    with replacing(path, must_be_new=must_be_new) as new:
        new.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def replacing(path: str | Path, *, must_be_new: bool = False) -> Iterator[Path]:
    """Give an empty file to be written in the block, which then takes the place of `path`.

    Whatever ends the block or the process before, the file that was there is as it was. It is the
    file that a link points to; the new one has the permissions of the old one. A device, a pipe,
    and the file that this program prints to have no place to be put at: they are given themselves.

    Args:
        path: the file.
        must_be_new: refuse to replace one.

    Raises:
        InputError: it cannot be written, or there is one already.
    """
    try:
        old = _status(Path(path))
        if old is not None and must_be_new:
            raise InputError(f"{path}: the file exists; choose another name")
        if old is not None and _written_straight(old):
            yield Path(path)
            return
        place = Path(os.path.realpath(path))
        if old is not None and not os.access(place, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        new = place.with_name(f".{place.stem[:40]}-{secrets.token_hex(4)}{place.suffix[-20:]}")
        os.close(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
        try:
            yield new
            _finish(new, old)
            new.replace(place)
        except BaseException:
            new.unlink(missing_ok=True)
            raise
    except OSError as error:
        words = os.strerror(error.errno) if error.errno else error  # libraries add their own
        raise InputError(f"{path}: cannot be written ({words})") from error
    except UnicodeEncodeError as error:
        raise InputError(f"{path}: a text is not valid Unicode ({error.object!r:.80})") from error


def _status(path: Path) -> os.stat_result | None:
    """Return what is there, or where a link leads; None for nothing."""
    try:
        return path.stat()
    except FileNotFoundError:
        return None


def _written_straight(old: os.stat_result) -> bool:
    """Whether a file is no place for another one: a device, a pipe, or our own output."""
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
    """Bring a written file to the disk, with owner and permissions of the one it replaces."""
    if old is not None:
        with suppress(PermissionError):  # only root gives files away
            os.chown(new, old.st_uid, old.st_gid)
        new.chmod(stat.S_IMODE(old.st_mode))
    handle = os.open(new, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
