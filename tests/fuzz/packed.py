"""Parsers of packed tables, given damaged ones: XLSX, Parquet and MAT."""

import io
import os
import zipfile
from pathlib import Path
from random import Random
from typing import Any
from unittest import mock

import numpy as np

from hilcal.errors import InputError
from hilcal.tables import matfile
from hilcal.tables.files import open_grid
from hilcal.tables.mapping import FileFormat
from tests.fuzz.bench import Bench
from tests.fuzz.damage import NUMBERS, ODD, bytes_damaged, text_damaged
from tests.fuzz.harness import Parser

COLUMNS = (
    [[1.0], [2.0]], [{"a": 1}, None], [b"x", b"y"], ["a", "b"], [True, None], [None, None],
    [1 << 62, -1], [float("nan"), float("inf")],
)  # fmt: skip


def packed(bench: Bench) -> list[Parser]:
    """XLSX, Parquet and MAT: as files, and with odd things in them."""
    import openpyxl
    import pyarrow as pa
    import pyarrow.parquet as pq
    from scipy.io import savemat

    how = FileFormat()
    numbers = np.array([[float(c) for c in row[2:8]] for row in bench.rows[1:9]])

    def xlsx(cells: list[list[Any]]) -> bytes:
        book = openpyxl.Workbook()
        for row in cells:
            book.active.append(row)
        out = io.BytesIO()
        book.save(out)
        return out.getvalue()

    def parquet(columns: dict[str, Any]) -> bytes:
        out = io.BytesIO()
        pq.write_table(pa.table(columns), out)
        return out.getvalue()

    def mat(content: dict[str, Any]) -> bytes:
        out = io.BytesIO()
        savemat(out, content)
        return out.getvalue()

    sound = {
        "xlsx": xlsx([["a", "b"], *numbers[:, :2].tolist()]),
        "parquet": parquet({f"c{k}": numbers[:, k] for k in range(6)}),
        "mat": mat({"A": numbers, "s": {"x": numbers, "n": np.array(["a", "b"], dtype=object)}}),
    }

    def rezipped(data: bytes, by: Random) -> bytes:
        """One member damaged, with its checksum mended."""
        out = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
            chosen = by.choice(old.namelist())
            for name in old.namelist():
                content = old.read(name)
                new.writestr(
                    name, text_damaged(content.decode(), by) if name == chosen else content
                )
        return out.getvalue()

    def odd(kind: str, by: Random) -> bytes:
        values = [by.choice((*NUMBERS[:8], 0.5, "x", None)) for _ in range(4)]
        match kind:
            case "xlsx":
                texts = [v for v in ODD if isinstance(v, int | float | str) and v == v]
                cells = [[by.choice(texts) for _ in range(3)] for _ in range(3)]
                try:
                    return xlsx(cells)
                except Exception:  # openpyxl writes no control characters
                    return rezipped(sound["xlsx"], by)
            case "parquet":
                return parquet({"a": by.choice(COLUMNS), "b": [0.0, 1.0]})
            case _:
                shape = by.choice(((1, 1), (0, 3), (3, 0), (2, 3, 4), (1, 1, 1, 2), (5, 1)))
                if None in values:
                    return mat({"A": np.zeros(shape)})
                other = {"o": np.array(values, dtype=object), "z": np.zeros((2, 2), complex)}
                return mat({"A": np.zeros(shape), "e": {}, **other})

    def parser(kind: str) -> Parser:
        def make(by: Random) -> bytes:
            if by.random() < 0.3:
                return odd(kind, by)
            if kind == "xlsx" and by.random() < 0.6:
                return rezipped(sound[kind], by)
            return bytes_damaged(sound[kind], by)

        def read(path: Path) -> None:
            with mock.patch.object(matfile, "read", _forked):  # as quick as that, and as safe
                open_grid(path, how)

        return bench.reader(kind, f"t.{kind}", make, read)

    return [parser(kind) for kind in sound]


def _forked(path: str) -> Any:
    """Read a MAT file in a fork, which begins at once; a new interpreter takes 0.3 s."""
    out = Path(path + ".npz")
    child = os.fork()
    if not child:
        try:
            out.write_bytes(matfile.packed(path))
            os._exit(0)
        except BaseException:
            os._exit(1)
    if os.waitpid(child, 0)[1]:
        raise InputError("damaged")
    return matfile.unpacked(out.read_bytes())
