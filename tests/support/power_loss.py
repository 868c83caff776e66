"""Every state in which a power loss can leave files: what a program wrote, and what was synced.

A small library, preloaded into the program, records each write, truncation, sync, renaming and
deletion in one directory, with the data. From the record every state of the disk is made that a
power loss at any moment allows: what was written before the last sync of a file is there, of what
came later any subset, with writes torn at a sector; names as far as the directory was synced, then
in order (a journaling file system). What SQLite assumes of a disk: sqlite.org/atomiccommit.html.
"""

import os
import subprocess
import sys
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

SECTOR = 512


def compiled(folder):
    library, source = folder / "record.so", Path(__file__).with_suffix(".c")
    command = ["gcc", "-shared", "-fPIC", "-O1", "-w", "-o", str(library), str(source), "-ldl"]
    subprocess.run(command, check=True)
    return library


def recorded(code, folder, recorder, root):
    """Run a Python program and return what it did in `folder`."""
    log = recorder.with_suffix(".log")
    log.unlink(missing_ok=True)
    environment = {
        **os.environ,
        "LD_PRELOAD": str(recorder),
        "RECORD_DIR": str(folder),
        "RECORD_LOG": str(log),
        "PYTHONPATH": str(root),
    }
    subprocess.run([sys.executable, "-c", code, str(folder)], check=True, env=environment)
    return list(_read(log.read_bytes()))


@dataclass(frozen=True)
class Op:
    """One thing that was done: create, write, truncate, sync, unlink, rename."""

    kind: str
    path: str
    at: int
    data: bytes


def _read(log):
    at = 0
    while at < len(log):
        end = log.index(b"\n", at)
        kind, path, offset, size = log[at:end].decode().split("\t")
        at = end + 1
        has = kind in ("write", "rename")
        yield Op(kind, path, int(offset), log[at : at + int(size)] if has else b"")
        at += int(size) if has else 0


def _done(content, op):
    if op.kind == "truncate":
        return content[: op.at].ljust(op.at, b"\0")
    return content[: op.at].ljust(op.at, b"\0") + op.data + content[op.at + len(op.data) :]


@dataclass
class _File:
    synced: bytes = b""
    later: list[Op] = field(default_factory=list)


@dataclass
class Disk:
    """Files with what is durable of them, and what is on its way."""

    folder: str
    files: list[_File] = field(default_factory=list)
    names: dict[str, int] = field(default_factory=dict)
    durable: dict[str, int] = field(default_factory=dict)
    moves: list[Op] = field(default_factory=list)

    def do(self, op):
        match op.kind:
            case "sync" if op.path.rstrip("/") == self.folder:
                self.durable, self.moves = dict(self.names), []
            case "sync" if op.path in self.names:
                file = self.files[self.names[op.path]]
                for one in file.later:
                    file.synced = _done(file.synced, one)
                file.later = []
            case "write" | "truncate" if op.path in self.names:
                self.files[self.names[op.path]].later.append(op)
            case "create":
                self.files.append(_File())
                self._move(op, self.names)
                self.moves.append(op)
            case "unlink" | "rename":
                self._move(op, self.names)
                self.moves.append(op)

    def _move(self, op, names, number=None):
        if op.kind == "create":
            names[op.path] = len(self.files) - 1 if number is None else number
        elif op.kind == "unlink":
            names.pop(op.path, None)
        elif op.path in names:
            names[op.data.decode()] = names.pop(op.path)

    def states(self, rng, tries):
        """What may be on the disk after a power loss now: contents by path."""
        for k in range(tries):
            names = dict(self.durable)
            upto = (0, len(self.moves))[k] if k < 2 else rng.randint(0, len(self.moves))
            created = len(self.files) - sum(op.kind == "create" for op in self.moves)
            for op in self.moves[:upto]:
                self._move(op, names, created)
                created += op.kind == "create"
            yield {path: self._content(number, rng, k) for path, number in names.items()}

    def _content(self, number, rng, k):
        file = self.files[number]
        content = file.synced
        for op in file.later:
            if k == 0 or (k > 1 and rng.random() < 0.5):
                continue  # it did not reach the disk
            if k > 1 and op.kind == "write" and rng.random() < 0.2:  # torn
                cut = rng.randint(0, len(op.data) // SECTOR) * SECTOR
                op = Op("write", op.path, op.at, op.data[:cut])
            content = _done(content, op)
        return content


def crashes(ops, folder, ack, seed, tries=4):
    """Every moment: how many acknowledgements the program had given, and a state of the disk."""
    disk, rng, acknowledged = Disk(str(folder)), Random(seed), 0
    for op in ops:
        if op.path.endswith(ack):
            acknowledged += op.kind == "write"
            continue
        disk.do(op)
        for state in disk.states(rng, tries):
            yield acknowledged, deepcopy(state)
