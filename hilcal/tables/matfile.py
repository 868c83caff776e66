"""Matrices of a MAT file, read in a process of their own.

The compiled reader of scipy crashes on some damaged files (found by `python -m tests.fuzz mat`) and
may ask for any amount of memory that a damaged header states. In a process of its own, with limits,
neither ends the program. It returns matrices of numbers and lists of texts, no objects.
"""

import io
import json
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hilcal import limits
from hilcal.errors import InputError

LIMIT_S = 60  # Time that reading may take; a choice: 1 GB takes a few seconds
MEMORY = 8 << 30  # Address space of the process, bytes; a choice: several times the largest file

Block = tuple[str, str, np.ndarray]  # Variable, name, matrix (N, k) of numbers or (N, 1) of texts


def read(path: str) -> tuple[list[str], list[Block]]:
    """Return the names of all variables, and the matrices of N > 1 rows in them."""
    command = [sys.executable, "-P", "-m", __name__, str(Path(path).absolute())]
    root = str(Path(__file__).resolve().parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([root, *sys.path[1:]])}
    try:
        process = subprocess.run(  # noqa: S603 - our own interpreter and module
            command, capture_output=True, timeout=LIMIT_S, check=False, env=environment
        )
    except subprocess.TimeoutExpired:
        raise InputError(f"{path}: damaged: not read within {LIMIT_S} s") from None
    if process.returncode == 0:
        return unpacked(process.stdout)
    message = process.stderr.decode(errors="replace").strip().rpartition("\n")[2]
    if process.returncode == InputError.exit_code:
        raise InputError(message)
    message = message[:80]
    why = "its reader crashed" if process.returncode < 0 or not message else message
    raise InputError(f"{path}: damaged, or not what its first bytes say ({why})")


def packed(path: str) -> bytes:
    """Return the variables and matrices of a file as bytes, for `unpacked`."""
    from scipy.io import loadmat

    loaded = loadmat(path, appendmat=False, squeeze_me=False, struct_as_record=True)
    variables = [name for name in loaded if not name.startswith("__")]
    blocks = [(v, *b) for v in variables for b in _blocks(v, np.asarray(loaded[v]))]
    limits.check_cells(path, sum(block.size for _, _, block in blocks))
    for _, name, block in blocks:
        if block.dtype.kind == "O":
            size = 4 * block.size * max(map(len, block.flat))
            limits.check_size(f"{path}: {name}", size, limits.UNPACKED)
    names = {"variables": variables, "blocks": [[v, name] for v, name, _ in blocks]}
    values = {
        f"b{k}": np.array(block, dtype=str) if block.dtype.kind == "O" else block
        for k, (_, _, block) in enumerate(blocks)
    }
    out = io.BytesIO()
    np.savez(out, allow_pickle=False, names=np.array(json.dumps(names)), **values)
    return out.getvalue()


def unpacked(data: bytes) -> tuple[list[str], list[Block]]:
    """Return the variables and matrices in the bytes of `packed`."""
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        names: dict[str, Any] = json.loads(str(archive["names"]))
        blocks = [(v, name, archive[f"b{k}"]) for k, (v, name) in enumerate(names["blocks"])]
    return names["variables"], blocks


def _blocks(name: str, value: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Matrices (N, k) of a variable, N > 1, by name."""
    if value.dtype.names and value.size == 1:
        for field in value.dtype.names:
            yield from _blocks(f"{name}.{field}", np.asarray(value[field].flat[0]))
    elif value.dtype.kind in "fiu" and value.ndim == 3:
        last = value.shape[2]
        flat = np.moveaxis(value, 2, 0).reshape(last, -1)
        for k, index in enumerate(np.ndindex(value.shape[:2])):
            yield f"{name}({index[0] + 1},{index[1] + 1})", flat[:, k : k + 1]
    elif value.dtype.kind in "fiu" and value.ndim == 2 and value.size > 1:
        yield name, value.T if value.shape[0] == 1 else value
    elif value.dtype.kind == "O" and value.ndim == 2 and min(value.shape) == 1:
        cells = [v.item() if isinstance(v, np.ndarray) and v.size == 1 else v for v in value.flat]
        if len(cells) > 1 and all(isinstance(c, str) for c in cells):
            yield name, np.array(cells, dtype=object)[:, None]


def main() -> None:
    """Read the file that the argument names, within the limits, to standard output."""
    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_S, LIMIT_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        import scipy.io  # noqa: F401 - its own memory does not count

        with limits.memory(sys.argv[1]):
            data = packed(sys.argv[1])
    except InputError as error:
        print(error, file=sys.stderr)
        raise SystemExit(InputError.exit_code) from None
    except BaseException as error:  # which exceptions damaged files raise is undocumented
        print(" ".join(str(error).split()) or type(error).__name__, file=sys.stderr)
        raise SystemExit(1) from None
    sys.stdout.buffer.write(data)


if __name__ == "__main__":
    main()
