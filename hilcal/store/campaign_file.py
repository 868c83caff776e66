"""RUN.hilcal: one SQLite file with immutable readings and appended model revisions.

A file that is not the one of its name any more while it is open is found again, or rescued.
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
from hilcal.errors import HilcalError, InputError, MovedFileError
from hilcal.names import quoted
from hilcal.readings.readings import ObserverKind, ObserverName, Readings
from hilcal.store import rows, schema
from hilcal.store.codec import decode
from hilcal.store.kept_texts import robot_file_of, typed_now
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
from hilcal.whole_file import replacing

_TARGETS, _OBSERVERS = "targets", "observers"
ACCEPTED = "accepted {}"
"""Keys of the acceptances, numbered from 1; the last one holds."""
_MEANWHILE = 1000
"""Readings that were appended during a fit, at most; a choice: each takes a second."""
_HASHED = 1_000_000
"""Readings that are hashed, at most, to find how many they were; a choice: it takes seconds."""
_OTHER_READINGS = (
    "the readings were changed after revision {} had been fitted to them (their SHA-256 is another)"
)
_META = ("config", "base_dir", "source", "created", "program_version")
Identity = tuple[int, int]
_OPEN = Path("/proc/self/fd")


class CampaignFile:
    """An open campaign file; use it in a `with` statement.

    What `append_readings` and `append_revision` have returned from survives a kill of the
    process and a loss of power. Readings and revisions cannot be changed or deleted.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        """Take over an open connection; use `create` or `open`."""
        self.path, self.connection = path, connection
        self._identity = identity(path)
        self._now: Path | None = None
        self._written = False
        self._meta = self._read_meta()
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
        more: Mapping[str, str] | None = None,
        readings: Readings | None = None,
    ) -> Self:
        """Make a campaign; the file appears only when it is complete.

        It may `overwrite` an existing campaign, never a file of another kind.
        """
        path = Path(path)
        meta = {"config": config_json, "base_dir": base_dir, "source": source}
        meta |= {"created": utc_now(), "program_version": __version__, **typed_now()}
        meta |= {**robot_file_of(config_json, base_dir), **(more or {})}
        with new_campaign(path, meta, overwrite) as connection:
            if readings is not None:
                cls(path, connection).insert(readings)
        return cls.open(path)

    @classmethod
    def open(
        cls, path: str | Path, *, read_only: bool = False, check_revisions: bool = True
    ) -> Self:
        """Open a campaign and check that it is whole.

        Bad revisions (`bad_revision`) are refused, unless the readings alone are needed.
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
            what = "is empty" if not head else "is not a hilcal campaign (not an SQLite file)"
            raise InputError(f"{path}: the file {what}")
        with schema.sqlite_errors(path):
            connection = schema.connect(path, read_only)
            try:
                schema.check_file(connection, path)
                file = cls(path, connection)
                if check_revisions and (bad := file.bad_revision()) is not None:
                    raise InputError(f"{path}: {bad[1]}; {_mend(path)}")
                return file
            except BaseException:
                connection.close()
                raise

    def close(self) -> None:
        """Close the file."""
        self.connection.close()

    def __enter__(self) -> Self:
        """Return the campaign."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file; what was written is not left in one that is not in its place."""
        try:
            if self._written and self._now is None:
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
        """A further text about the campaign, as given to `create`; None where there is none."""
        return self._meta.get(key)

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Store everything of a block, or nothing; raises as `check_place` does, too."""
        self._written = True
        try:
            with schema.sqlite_errors(self.path), schema.transaction(self.connection) as open_file:
                yield open_file
        except HilcalError:
            self.check_place()  # which is why
            raise
        self.check_place()

    def check_place(self) -> None:
        """Raise a MovedFileError where the open file is not the one of its name any more."""
        if identity(self.path) == self._identity:
            return
        if self._now is None:
            self._now = moved_to(self._identity) or rescued(self.connection, self.path)
        raise MovedFileError(
            f"{self.path}: deleted, replaced or moved while it was open; all {self.n_readings} "
            f"readings stored so far are in {self._now}: move that back to {self.path} first"
        )

    def append_readings(self, readings: Readings) -> int:
        """Append readings in one transaction; names already known keep their numbers."""
        with self.transaction():
            return self.insert(readings)

    def insert(self, readings: Readings) -> int:
        """Do the same inside a transaction that the caller has begun.

        Covariances are stored exactly symmetric, as tables hold them, whatever rounding made them.
        """
        cov = readings.covariance
        readings = replace(readings, covariance=0.5 * (cov + np.swapaxes(cov, -1, -2)))
        if len(readings):
            self._claim_layout(layout_of(readings))
            readings = self._numbered_targets(readings)
            self._claim_observers(readings)
            limits.check_fitted(self.n_readings + len(readings), readings.m, f"{self.path}: ")
        rows.check_poses(self.connection, self.path, readings)
        return rows.insert_readings(self.connection, readings)

    def readings(self) -> Readings:
        """All readings in the order in which they were appended."""
        layout = self._layout()
        if layout is None:
            raise InputError(f"{self.path}: the campaign holds no readings yet")
        with schema.sqlite_errors(self.path):
            names, by = self._stored(_TARGETS, tuple[str, ...]), self._observers()
            return rows.fetch_readings(self.connection, self.path, layout, names, by)

    def data_hash(self, count: int | None = None) -> str:
        """SHA-256 of the readings, or of the first ones; see `content_hash`."""
        return content_hash(self.readings()[:count])

    def append_revision(self, record: RevisionRecord) -> int:
        """Append a model revision; returns its number, 1, 2, ..., whatever the record has."""
        with self.transaction():
            return self.insert_revision(record)

    def insert_revision(self, record: RevisionRecord) -> int:
        """Do the same inside a transaction that the caller has begun."""
        number = rows.last_id(self.connection, "revisions") + 1
        if record.parent == number - 1 and replace(record, parent=None).follows:
            record = replace(record, parent=None)
        record, key, posterior = split(record)
        text = to_text(record)
        if key is not None and key not in self._read_meta():
            rows.insert_meta(self.connection, key, posterior)
        schema.require(
            self.connection,
            schema.CHANGED_CELL * bool(record.cell),
            schema.CARRIED_PRIOR * (key is not None),
            schema.CHOSEN_REVISION * (record.parent is not None),
        )
        row = (number, text, rows.text_crc(str(number), text))
        rows.insert(self.connection, "revisions", [row])
        return number

    def accepted(self) -> int | None:
        """Number of the accepted revision; None where the latest one is used."""
        return next(reversed(self.acceptances()), None)

    def accept(self, number: int | None) -> None:
        """Make a revision the one that is used; None lets the latest one be used again."""
        if number is not None:
            self.revision(number)
        with self.transaction():
            key = ACCEPTED.format(len(self.acceptances()) + 1)
            rows.insert_meta(self.connection, key, json.dumps(number))
            schema.require(self.connection, schema.CHOSEN_REVISION)

    def acceptances(self) -> list[int | None]:
        """All that was accepted, in order."""
        with schema.sqlite_errors(self.path):
            meta = self._read_meta()
        found: list[int | None] = []
        while (text := meta.get(ACCEPTED.format(len(found) + 1))) is not None:
            number = rows.stored_json(self.path, text)
            if number is not None and not isinstance(number, int):
                raise self._damaged("an acceptance")
            found.append(number)
        return found

    def revisions(self) -> tuple[RevisionRecord, ...]:
        """All revisions, oldest first."""
        records, damaged = self._sound_revisions()
        if damaged is not None:
            raise InputError(f"{self.path}: {damaged[1]}; {_mend(self.path)}")
        return records

    def _sound_revisions(self) -> tuple[tuple[RevisionRecord, ...], tuple[int, str] | None]:
        """Return the revisions before the first damaged one; and its number, and what it is."""
        records: list[RevisionRecord] = []
        with schema.sqlite_errors(self.path), limits.memory(str(self.path)):
            stored = self.connection.execute("SELECT id, content, crc FROM revisions ORDER BY id")
            meta = self._read_meta()
            for expected, (number, text, crc) in enumerate(stored.fetchall(), start=1):
                try:
                    if number != expected or rows.text_crc(str(number), text) != crc:
                        raise ValueError
                    records.append(join(from_text(text, number), meta))
                except InputError as error:
                    return tuple(records), (expected, str(error))
                except (ValueError, TypeError, AttributeError) as error:
                    what = f"the campaign is damaged at revision {expected}"
                    why = f" ({error})" if str(error) else ""
                    return tuple(records), (expected, what + why)
        return tuple(records), None

    def revision(self, number: int) -> RevisionRecord:
        """One revision."""
        records = self.revisions()
        if not 1 <= number <= len(records):
            valid = f"there are 1 to {len(records)}" if records else "there are none yet"
            raise InputError(f"{self.path}: no revision {number}; {valid}")
        return records[number - 1]

    def bad_revision(self) -> tuple[int, str] | None:
        """Return the first revision that is damaged, or was fitted to other readings, and why.

        Its hash is that of the first readings: of those that it was fitted to, or, as programs
        before stored it, of some more, which were appended while it was fitted. Either proves that
        they are as they were.
        """
        records, damaged = self._sound_revisions()
        fitted = [(r.number, *of) for r in records if (of := fitted_to(r)) is not None]
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

    def _read_meta(self) -> dict[str, str]:
        meta = rows.fetch_meta(self.connection, self.path)
        if missing := sorted(set(_META) - set(meta)):
            raise self._damaged(f"no {missing[0]}")
        return meta

    def _damaged(self, what: object) -> InputError:
        return InputError(f"{self.path}: the campaign file is damaged ({what})")

    def _layout(self) -> Layout | None:
        with schema.sqlite_errors(self.path):
            text = self._read_meta().get("layout")
        try:
            return None if text is None else read_layout(text)
        except ValueError as e:
            raise self._damaged(e) from e

    def _stored(self, key: str, kind: Any) -> Any:
        """A list about the campaign, of some type; empty where there is none."""
        content = rows.stored_json(self.path, self._read_meta().get(key, "[]"))
        try:
            return decode(kind, content)
        except (TypeError, ValueError):
            raise self._damaged(f"its {key}") from None

    def _claim_layout(self, layout: Layout) -> None:
        """Fix the quantities of a reading with the first ones; refuse others later."""
        known = self._layout()
        if known is None:
            rows.insert_meta(self.connection, "layout", json.dumps(layout))
        elif known != layout:
            differ = sorted({name for name, _ in set(known) ^ set(layout)})
            raise InputError(
                f"{self.path}: the readings differ from those before in {', '.join(differ)}; "
                f"a campaign holds one kind of reading, start another for these"
            )

    def _observers(self) -> tuple[ObserverName, ...]:
        stored = self._stored(_OBSERVERS, tuple[tuple[ObserverKind, str], ...])
        if not all(name for _, name in stored):
            raise self._damaged("its observers")
        return tuple(ObserverName(kind, name) for kind, name in stored)

    def _claim_observers(self, readings: Readings) -> None:
        """Name the observers with the first readings; refuse others later."""
        if readings.states.torque is not None or readings.states.observer is not None:
            schema.require(self.connection, schema.MORE_COLUMNS)
        if readings.states.observer is None:
            return
        if self._read_meta().get(_OBSERVERS) is None:
            text = json.dumps([[o.kind, o.name] for o in readings.observers])
            rows.insert_meta(self.connection, _OBSERVERS, text)
        if self._observers() != readings.observers:
            raise InputError(f"{self.path}: the readings are by other observers than those before")

    def _numbered_targets(self, readings: Readings) -> Readings:
        """Return the readings with targets numbered as in the file; the first ones name them."""
        if readings.states.target is None:
            return readings
        if self._read_meta().get(_TARGETS) is None:
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


def _mend(path: Path) -> str:
    return f"valid: an untouched copy; or set the revision aside: hilcal repair {quoted(path)}"


def identity(path: Path | str) -> Identity | None:
    """Device and number of a file, by which it is the same under every name; None for none."""
    with suppress(OSError):
        found = os.stat(path)
        return found.st_dev, found.st_ino
    return None


def moved_to(known: Identity | None) -> Path | None:
    """Return where a file that this process has open is now; None for a deleted one."""
    with suppress(OSError):
        for descriptor in _OPEN.iterdir():
            if identity(descriptor) == known:
                with suppress(OSError):
                    now = descriptor.readlink()
                    if identity(now) == known:
                        return now
    return None


def rescued(connection: sqlite3.Connection, path: Path) -> Path:
    """Write a copy of an open file that has no name any more, beside where it was."""
    home = path.absolute().parent
    folder = home if home.is_dir() else Path(tempfile.gettempdir())
    place = free_place(folder, f"{path.stem}.rescued", path.suffix)
    with replacing(place, must_be_new=True) as new, closing(sqlite3.connect(new)) as copy:
        connection.backup(copy)
    return place


def free_place(folder: Path, name: str, end: str = "") -> Path:
    """Return a path that no file has: name and end, with -2, -3, ... between them where needed."""
    places = (folder / f"{name}{f'-{k}' * (k > 1)}{end}" for k in itertools.count(1))
    return next(place for place in places if not place.exists())


@contextmanager
def new_campaign(
    path: Path, about: Mapping[str, str], overwrite: bool
) -> Iterator[sqlite3.Connection]:
    """Give an empty campaign to the block; the file appears when the block has filled it."""
    may_write(path, overwrite)
    with replacing(path) as new:
        try:
            with schema.sqlite_errors(path):
                connection = schema.connect(new)
                try:
                    connection.execute("PRAGMA journal_mode = DELETE")
                    with schema.transaction(connection):
                        for statement in schema.statements():
                            connection.execute(statement)
                        for key, value in about.items():
                            rows.insert_meta(connection, key, value)
                        yield connection
                finally:
                    connection.close()
        except BaseException:
            _without_sidecars(new)
            raise
        _without_sidecars(Path(os.path.realpath(path)))  # another file's journal


def may_write(path: Path, overwrite: bool) -> None:
    """Refuse to replace a file that is no campaign, or any without `overwrite`."""
    if not path.exists():
        return
    if not overwrite:
        raise InputError(f"{path}: the file exists; choose another name or ask to overwrite it")
    if not path.is_file() or (path.stat().st_size > 0 and not schema.is_campaign(path)):
        raise InputError(f"{path}: exists and is not a campaign; it is not overwritten")


def _without_sidecars(path: Path) -> None:
    """Remove what would be rolled back into a new file of this name."""
    for end in ("-journal", "-wal", "-shm"):
        path.with_name(path.name + end).unlink(missing_ok=True)
