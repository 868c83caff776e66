"""RUN.hilcal: one SQLite file with immutable readings and appended model revisions.

If an open file is moved, deleted or replaced, its new path is found, or a copy is written.
"""

import itertools
import json
import os
import sqlite3
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from hilcal import __version__, limits
from hilcal.errors import HilcalError, InputError, MovedFileError, undone_by
from hilcal.names import quoted
from hilcal.readings.readings import ObserverKind, ObserverName, Readings
from hilcal.store import rows, schema
from hilcal.store.codec import decode
from hilcal.store.revision import (
    RevisionRecord,
    fitted_to,
    from_text,
    join,
    split,
    to_text,
    utc_now,
)
from hilcal.store.rows import Layout, content_hash, layout_of, read_layout
from hilcal.store.stored_texts import robot_file_of, running_command
from hilcal.whole_file import replacing

_TARGETS, _OBSERVERS = "targets", "observers"
ACCEPTED = "accepted {}"  # keys of the acceptances, numbered from 1; the last one is valid
_MEANWHILE = 1000  # most readings appended during a fit; a choice: each takes a second
_HASHED = 1_000_000  # most readings that are hashed to find the fitted ones; a choice: seconds
_OTHER_READINGS = (
    "the readings were changed after revision {} had been fitted to them (their SHA-256 differs)"
)
_META = ("config", "base_dir", "source", "created", "program_version")
Identity = tuple[int, int]
_OPEN = Path("/proc/self/fd")


class CampaignFile:
    """An open campaign file; use it in a `with` statement.

    Readings and revisions cannot be changed or deleted. They survive a kill of the process and a
    loss of power once `append_readings` or `append_revision` has returned.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path, self.connection = path, connection
        self._identity = identity(path)
        self._new_place: Path | None = None
        self._measuring: int | None = None
        self._written = False
        self._meta = self.texts()
        self.config_json, self.base_dir = self._meta["config"], self._meta["base_dir"]
        self.source, self.created = self._meta["source"], self._meta["created"]

    @classmethod
    def create(
        cls,
        path: str | Path,
        config_json: str,
        base_dir: str,
        source: str,
        *,
        overwrite: bool = False,
        more_texts: Mapping[str, str] | None = None,
        readings: Readings | None = None,
    ) -> Self:
        """Make a campaign; the file appears only when it is complete.

        It may `overwrite` an existing campaign, never a file of another kind.
        """
        path = Path(path)
        meta = {"config": config_json, "base_dir": base_dir, "source": source}
        meta |= {"created": utc_now(), "program_version": __version__, **running_command()}
        meta |= robot_file_of(config_json, base_dir) | dict(more_texts or {})
        with new_campaign(path, meta, overwrite) as connection:
            if readings is not None:
                cls(path, connection).insert(readings)
        return cls.open(path)

    @classmethod
    def open(
        cls, path: str | Path, *, read_only: bool = False, check_revisions: bool = True
    ) -> Self:
        """Open a campaign and check that it is complete and undamaged.

        Bad revisions (`bad_revision`) are refused with `check_revisions`.
        """
        path = Path(path)
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise InputError(f"{path}: a device or a pipe; valid: a campaign file")
        try:
            with path.open("rb") as stream:
                head = stream.read(len(schema.HEADER))
        except FileNotFoundError as e:
            raise InputError(f"{path}: no such campaign file") from e
        except OSError as e:
            raise InputError(f"{path}: cannot be read ({e.strerror})") from e
        if head != schema.HEADER:
            state = "is empty" if not head else "is not a hilcal campaign (not an SQLite file)"
            raise InputError(f"{path}: the file {state}")
        with schema.sqlite_errors(path):
            connection = schema.connect(path, read_only)
            try:
                schema.check_file(connection, path)
                file = cls(path, connection)
                if check_revisions and (bad := file.bad_revision()) is not None:
                    raise InputError(f"{path}: {bad[1]}; {_repair_hint(path)}")
                return file
            except BaseException:
                connection.close()
                raise

    def measure_alone(self) -> None:
        """Lock the campaign for measuring until `close`; refuse one that is being measured.

        Other processes may still read it, and append revisions.
        """
        if self._measuring is None:
            self._measuring = schema.lock(self.path)

    def close(self) -> None:
        """Close the file."""
        self.connection.close()
        if self._measuring is not None:
            os.close(self._measuring)
            self._measuring = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file; raise as `check_place` does where it was written."""
        try:
            if self._written and self._new_place is None:
                self.check_place()
        finally:
            self.close()

    @property
    def n_readings(self) -> int:
        """Number of readings."""
        with schema.sqlite_errors(self.path):
            (count,) = self.connection.execute("SELECT count(*) FROM readings").fetchone()
        return int(count)

    def about(self, key: str) -> str | None:
        """A text about the campaign, as given to `create`; None if it was not given."""
        return self._meta.get(key)

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Store all changes of the block, or none; raises as `check_place` does, too."""
        self._written = True
        try:
            with schema.sqlite_errors(self.path), schema.transaction(self.connection) as open_file:
                yield open_file
        except HilcalError:
            self.check_place()  # the cause
            raise
        self.check_place()

    def numbered(self, key: str, first: int = 1) -> list[str]:
        """Return the texts about the campaign under a key with successive numbers."""
        meta = self.texts()
        keys = itertools.takewhile(meta.__contains__, map(key.format, itertools.count(first)))
        return [meta[k] for k in keys]

    def check_place(self) -> None:
        """Raise a MovedFileError where the path does not lead to the open file."""
        if identity(self.path) == self._identity:
            return
        if self._new_place is None:
            self._new_place = moved_to(self._identity) or rescue(self.connection, self.path)
        raise MovedFileError(
            f"{self.path}: deleted, replaced or moved while it was open; all {self.n_readings} "
            f"readings stored so far are in {self._new_place}: move that back to {self.path} first"
        )

    def append_readings(self, readings: Readings) -> int:
        """Append readings in one transaction; return the number of all readings."""
        with self.transaction():
            return self.insert(readings)

    def insert(self, readings: Readings) -> int:
        """Append readings within the caller's transaction; covariances are made symmetric."""
        cov = readings.covariance
        readings = replace(readings, covariance=0.5 * (cov + np.swapaxes(cov, -1, -2)))
        if len(readings):
            layout, stored = layout_of(readings), self._layout()
            if stored is None:
                rows.insert_meta(self.connection, "layout", json.dumps(layout))
            elif stored != layout:
                differ = sorted({name for name, _ in set(stored) ^ set(layout)})
                raise InputError(
                    f"{self.path}: the readings differ from those before in {', '.join(differ)}; a "
                    "campaign holds one kind of reading: start another campaign for these"
                )
            readings = self._numbered_targets(readings)
            self._store_observers(readings)
            limits.check_fitted(self.n_readings + len(readings), readings.m, f"{self.path}: ")
        rows.check_poses(self.connection, self.path, readings)
        return rows.insert_readings(self.connection, readings)

    def readings(self) -> Readings:
        """Return all readings in the order in which they were appended."""
        layout = self._layout()
        if layout is None:
            raise InputError(f"{self.path}: the campaign holds no readings yet")
        with schema.sqlite_errors(self.path):
            names, observers = self._stored(_TARGETS, tuple[str, ...]), self._observers()
            return rows.fetch_readings(self.connection, self.path, layout, names, observers)

    def data_hash(self, count: int | None = None) -> str:
        """Return the `content_hash` of the first `count` readings, or of all."""
        return content_hash(self.readings()[:count])

    def append_revision(self, record: RevisionRecord) -> int:
        """Append a model revision; return its number, from 1."""
        with self.transaction():
            return self.insert_revision(record)

    def insert_revision(self, record: RevisionRecord) -> int:
        """Append a model revision within the caller's transaction."""
        last = rows.last_id(self.connection, "revisions")
        if record.parent == last and replace(record, parent=None).has_parent:
            record = replace(record, parent=None)
        record, key, posterior = split(record)
        if key is not None and key not in self.texts():
            rows.insert_meta(self.connection, key, posterior)
        schema.require(
            self.connection,
            schema.CHANGED_CELL * bool(record.cell),
            schema.CARRIED_PRIOR * (key is not None),
            schema.CHOSEN_REVISION * (record.parent is not None),
        )
        return rows.append_text(self.connection, "revisions", to_text(record))

    def accepted(self) -> int | None:
        """Return the number of the accepted revision; None where the latest one is used."""
        return next(reversed(self.acceptances()), None)

    def accept(self, number: int | None) -> None:
        """Make a revision the one that is used; None: always the latest."""
        if number is not None:
            self.revision(number)
        with self.transaction() as connection:
            key = ACCEPTED.format(len(self.acceptances()) + 1)
            rows.insert_meta(connection, key, json.dumps(number))
            schema.require(connection, schema.CHOSEN_REVISION)

    def acceptances(self) -> list[int | None]:
        """Return all acceptances, in order."""
        numbers = [rows.stored_json(self.path, text) for text in self.numbered(ACCEPTED)]
        if any(not isinstance(n, int | None) for n in numbers):
            raise self._damaged("an acceptance")
        return numbers

    def revisions(self) -> tuple[RevisionRecord, ...]:
        """Return all revisions, oldest first; refuse damaged ones."""
        records, damaged = self._undamaged_revisions()
        if damaged is not None:
            raise InputError(f"{self.path}: {damaged[1]}; {_repair_hint(self.path)}")
        return records

    def _undamaged_revisions(self) -> tuple[tuple[RevisionRecord, ...], tuple[int, str] | None]:
        """Return the revisions before the first damaged one, and its number and defect."""
        records: list[RevisionRecord] = []
        with schema.sqlite_errors(self.path), limits.memory(str(self.path)):
            stored = self.connection.execute("SELECT id, content, crc FROM revisions ORDER BY id")
            meta = self.texts()
            for expected, (number, text, crc) in enumerate(stored.fetchall(), start=1):
                try:
                    if number != expected or rows.text_crc(str(number), text) != crc:
                        raise ValueError
                    records.append(join(from_text(text, number), meta))
                except InputError as error:
                    return tuple(records), (expected, str(error))
                except (ValueError, TypeError, AttributeError) as error:
                    why = f" ({error})" if str(error) else ""
                    defect = f"the campaign is damaged at revision {expected}{why}"
                    return tuple(records), (expected, defect)
        return tuple(records), None

    def revision(self, number: int) -> RevisionRecord:
        """Return a revision by its number."""
        records = self.revisions()
        if not 1 <= number <= len(records):
            valid = f"there are 1 to {len(records)}" if records else "there are none yet"
            raise InputError(f"{self.path}: no revision {number}; {valid}")
        return records[number - 1]

    def bad_revision(self) -> tuple[int, str] | None:
        """Return number and defect of the first damaged revision, or of one of other readings.

        A revision stores how many readings were fitted, and their hash. Older programs hashed also
        the readings that were appended during the fit, so that hash is accepted, too.
        """
        records, damaged = self._undamaged_revisions()
        fitted = [(r.number, *basis) for r in records if (basis := fitted_to(r)) is not None]
        if not fitted:
            return damaged
        readings, hashes = self.readings(), dict[int, str]()
        for number, count, stored in fitted:
            for n in range(count, min(len(readings), count + _MEANWHILE) + 1):
                if n > count and sum(hashes) > _HASHED:
                    return number, _OTHER_READINGS.format(number)
                if n not in hashes:
                    hashes[n] = content_hash(readings[:n])
                if hashes[n] == stored:
                    break
            else:
                return number, _OTHER_READINGS.format(number)
        return damaged

    def texts(self) -> dict[str, str]:
        """Return all texts about the campaign by key, as the file has them now."""
        with schema.sqlite_errors(self.path):
            meta = rows.fetch_meta(self.connection, self.path)
        if missing := sorted(set(_META) - set(meta)):
            raise self._damaged(f"no {missing[0]}")
        return meta

    def _damaged(self, detail: object) -> InputError:
        return InputError(f"{self.path}: the campaign file is damaged ({detail})")

    def _layout(self) -> Layout | None:
        text = self.texts().get("layout")
        try:
            return None if text is None else read_layout(text)
        except ValueError as e:
            raise self._damaged(e) from e

    def _stored(self, key: str, kind: Any) -> Any:
        """Return the list, of type `kind`, in a text about the campaign; empty without the text."""
        content = rows.stored_json(self.path, self.texts().get(key, "[]"))
        try:
            return decode(kind, content)
        except (TypeError, ValueError):
            raise self._damaged(f"its {key}") from None

    def _observers(self) -> tuple[ObserverName, ...]:
        stored = self._stored(_OBSERVERS, tuple[tuple[ObserverKind, str], ...])
        if not all(name for _, name in stored):
            raise self._damaged("its observers")
        return tuple(ObserverName(kind, name) for kind, name in stored)

    def _store_observers(self, readings: Readings) -> None:
        """Store the observers of the first readings; refuse later readings of other observers."""
        if readings.states.torque is not None or readings.states.observer is not None:
            schema.require(self.connection, schema.MORE_COLUMNS)
        if readings.whole() is not readings:
            schema.require(self.connection, schema.LOST_TEMPERATURES)
        if readings.states.observer is None:
            return
        if self.texts().get(_OBSERVERS) is None:
            text = json.dumps([[o.kind, o.name] for o in readings.observers])
            rows.insert_meta(self.connection, _OBSERVERS, text)
        if self._observers() != readings.observers:
            raise InputError(f"{self.path}: the observers differ from those of earlier readings")

    def _numbered_targets(self, readings: Readings) -> Readings:
        """Return the readings with targets numbered as in the first readings of the file."""
        if readings.states.target is None:
            return readings
        if self.texts().get(_TARGETS) is None:
            rows.insert_meta(self.connection, _TARGETS, json.dumps(readings.target_names))
            schema.require(self.connection, schema.SEVERAL_TARGETS)
        names: tuple[str, ...] = self._stored(_TARGETS, tuple[str, ...])
        new = [name for name in readings.target_names if name not in names]
        if new:
            raise InputError(
                f"{self.path}: target {new[0]!r} is not one of this campaign: {', '.join(names)}"
            )
        number = np.array([names.index(name) for name in readings.target_names])
        states = replace(readings.states, target=number[readings.target])
        return replace(readings, states=states, target_names=names)


def _repair_hint(path: Path) -> str:
    return f"valid: an untouched copy; or set the revision aside: hilcal repair {quoted(path)}"


def identity(path: Path | str) -> Identity | None:
    """Return device and inode of a file, which identify it by any path; None without a file."""
    with suppress(OSError):
        status = os.stat(path)
        return status.st_dev, status.st_ino
    return None


def moved_to(target: Identity | None) -> Path | None:
    """Return the present path of a file that this process has open; None for a deleted one."""
    with suppress(OSError):
        for descriptor in _OPEN.iterdir():
            if identity(descriptor) == target:
                with suppress(OSError):
                    place = descriptor.readlink()
                    if identity(place) == target:
                        return place
    return None


def rescue(connection: sqlite3.Connection, path: Path) -> Path:
    """Write a copy of an open file that was deleted, in the same directory; return its path."""
    home = path.absolute().parent
    folder = home if home.is_dir() else Path(tempfile.gettempdir())
    place = free_place(folder, f"{path.stem}.rescued", path.suffix)
    with replacing(place, must_be_new=True) as new, closing(sqlite3.connect(new)) as copy:
        connection.backup(copy)
    return place


def free_place(folder: Path, name: str, end: str = "") -> Path:
    """Return a path without a file: name and end, with -2, -3, ... between them where needed."""
    places = (folder / f"{name}{f'-{k}' * (k > 1)}{end}" for k in itertools.count(1))
    return next(place for place in places if not place.exists())


@contextmanager
def new_campaign(
    path: Path, about: Mapping[str, str], overwrite: bool
) -> Iterator[sqlite3.Connection]:
    """Yield an empty campaign to be filled; the file appears at the end of the block."""
    may_write(path, overwrite)
    with replacing(path, campaign=True) as new:
        undo = undone_by(lambda: _remove_journals(new))
        with undo, schema.sqlite_errors(path), closing(schema.connect(new)) as connection:
            connection.execute("PRAGMA journal_mode = DELETE")
            with schema.transaction(connection):
                for statement in schema.statements():
                    connection.execute(statement)
                for key, value in about.items():
                    rows.insert_meta(connection, key, value)
                yield connection
        _remove_journals(Path(os.path.realpath(path)))  # another file's journal


def may_write(path: Path, overwrite: bool) -> None:
    """Refuse to replace a file that is no campaign, or any without `overwrite`."""
    if not path.exists():
        return
    if not overwrite:
        raise InputError(f"{path}: the file exists; choose another name or ask to overwrite it")
    if not path.is_file() or (path.stat().st_size > 0 and not schema.is_campaign(path)):
        raise InputError(f"{path}: exists and is not a campaign; it is not overwritten")


def _remove_journals(path: Path) -> None:
    """Remove journals that SQLite would replay into a new file of this name."""
    for end in ("-journal", "-wal", "-shm"):
        path.with_name(path.name + end).unlink(missing_ok=True)
