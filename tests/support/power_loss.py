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
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

SECTOR = 512

SOURCE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <unistd.h>
static char names[1024][512]; static int out = -1; static const char *dir;
__attribute__((constructor)) static void begin(void) {
  dir = getenv("RECORD_DIR"); const char *log = getenv("RECORD_LOG");
  if (log) out = syscall(SYS_openat, AT_FDCWD, log, O_WRONLY|O_CREAT|O_APPEND|O_CLOEXEC, 0600);
}
static void note(const char *op, const char *path, long at, const void *data, long size) {
  char head[1200]; if (out < 0 || !dir || strncmp(path, dir, strlen(dir))) return;
  int n = snprintf(head, sizeof head, "%s\t%s\t%ld\t%ld\n", op, path, at, size);
  syscall(SYS_write, out, head, n); if (data && size > 0) syscall(SYS_write, out, data, size);
}
static void opened(int fd, const char *path, int flags, int fresh) {
  if (fd < 0 || fd >= 1024) return; names[fd][0] = 0;
  if (path[0] == '/') { strncpy(names[fd], path, 511); }
  if (fresh) note("create", path, 0, 0, 0);
  if (flags & O_TRUNC) note("truncate", path, 0, 0, 0);
}
#define OPEN(NAME) int NAME(const char *p, int f, ...) { va_list a; va_start(a, f); \
  int m = va_arg(a, int); va_end(a); int fresh = (f & O_CREAT) && access(p, F_OK); \
  int fd = syscall(SYS_openat, AT_FDCWD, p, f, m); opened(fd, p, f, fresh); return fd; }
OPEN(open) OPEN(open64)
static const char *of(int fd) { return fd >= 0 && fd < 1024 ? names[fd] : ""; }
#define REAL(R, N, ...) static R (*real)(__VA_ARGS__); if (!real) real = dlsym(RTLD_NEXT, N)
#define PWRITE(NAME) ssize_t NAME(int fd, const void *b, size_t n, off_t at) { \
  REAL(ssize_t, #NAME, int, const void *, size_t, off_t); \
  ssize_t r = real(fd, b, n, at); if (r > 0) note("write", of(fd), at, b, r); return r; }
PWRITE(pwrite) PWRITE(pwrite64)
ssize_t write(int fd, const void *b, size_t n) {
  long at = of(fd)[0] ? lseek(fd, 0, SEEK_CUR) : 0; ssize_t r = syscall(SYS_write, fd, b, n);
  if (r > 0 && of(fd)[0]) note("write", of(fd), at < 0 ? 0 : at, b, r); return r; }
#define SYNC(NAME) int NAME(int fd) { REAL(int, #NAME, int); note("sync", of(fd), 0, 0, 0); \
  return real(fd); }
SYNC(fsync) SYNC(fdatasync)
#define TRUNC(NAME) int NAME(int fd, off_t n) { REAL(int, #NAME, int, off_t); \
  note("truncate", of(fd), n, 0, 0); return real(fd, n); }
TRUNC(ftruncate) TRUNC(ftruncate64)
int unlink(const char *p) { REAL(int, "unlink", const char *); int r = real(p);
  if (!r) note("unlink", p, 0, 0, 0); return r; }
int rename(const char *a, const char *b) { REAL(int, "rename", const char *, const char *);
  int r = real(a, b); if (!r) note("rename", a, 0, b, strlen(b)); return r; }
int close(int fd) { if (fd >= 0 && fd < 1024) names[fd][0] = 0; return syscall(SYS_close, fd); }
"""


def compiled(folder: Path) -> Path:
    source, library = folder / "record.c", folder / "record.so"
    source.write_text(SOURCE)
    command = ["gcc", "-shared", "-fPIC", "-O1", "-w", "-o", str(library), str(source), "-ldl"]
    subprocess.run(command, check=True)
    return library


def recorded(code: str, folder: Path, recorder: Path, root: Path) -> list["Op"]:
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


def _read(log: bytes) -> Iterator[Op]:
    at = 0
    while at < len(log):
        end = log.index(b"\n", at)
        kind, path, offset, size = log[at:end].decode().split("\t")
        at = end + 1
        has = kind in ("write", "rename")
        yield Op(kind, path, int(offset), log[at : at + int(size)] if has else b"")
        at += int(size) if has else 0


def _done(content: bytes, op: Op) -> bytes:
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

    def do(self, op: Op) -> None:
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

    def _move(self, op: Op, names: dict[str, int], number: int | None = None) -> None:
        if op.kind == "create":
            names[op.path] = len(self.files) - 1 if number is None else number
        elif op.kind == "unlink":
            names.pop(op.path, None)
        elif op.path in names:
            names[op.data.decode()] = names.pop(op.path)

    def states(self, rng: Random, tries: int) -> Iterator[dict[str, bytes]]:
        """What may be on the disk after a power loss now: contents by path."""
        for k in range(tries):
            names = dict(self.durable)
            upto = (0, len(self.moves))[k] if k < 2 else rng.randint(0, len(self.moves))
            created = len(self.files) - sum(op.kind == "create" for op in self.moves)
            for op in self.moves[:upto]:
                self._move(op, names, created)
                created += op.kind == "create"
            yield {path: self._content(number, rng, k) for path, number in names.items()}

    def _content(self, number: int, rng: Random, k: int) -> bytes:
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


def crashes(
    ops: list[Op], folder: Path, ack: str, seed: int, tries: int = 4
) -> Iterator[tuple[int, dict[str, bytes]]]:
    """Every moment: how many acknowledgements the program had given, and a state of the disk."""
    disk, rng, acknowledged = Disk(str(folder)), Random(seed), 0
    for op in ops:
        if op.path.endswith(ack):
            acknowledged += op.kind == "write"
            continue
        disk.do(op)
        for state in disk.states(rng, tries):
            yield acknowledged, deepcopy(state)
