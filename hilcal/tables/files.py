"""Opening a file of any kind that holds a table: text, XLSX, MAT, Parquet.

The first bytes tell the kind. Nothing in a file is ever executed: of a formula the stored value is
read; macros, links and pickles are not.
"""

import csv
import io
import re
import zipfile
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import date, datetime, time
from importlib import import_module
from itertools import zip_longest
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, TYPE_CHECKING, Any
from xml.parsers import expat

import numpy as np

from hilcal import limits
from hilcal.errors import InputError, expect
from hilcal.optional import needed_by
from hilcal.tables import matfile
from hilcal.tables.grid import Cell, Check, Grid, joined, text_of, unique
from hilcal.tables.mapping import FileFormat, PointMapping
from hilcal.toml import suggest
from hilcal.whole_file import replace_file

if TYPE_CHECKING:
    import pandas as pd

NUMPY = 'a NumPy file; save it as CSV: numpy.savetxt("t.csv", array, delimiter=",")'
MAGIC = {
    b"PK\x03\x04": "XLSX",
    b"PAR1": "Parquet",
    b"MATLAB": "MAT",
    b"SQLite format 3\x00": "an SQLite file (a campaign is opened, not imported)",
    b"\x89HDF": "an HDF5 file (MATLAB's -v7.3); save it with -v7, or as CSV",
    b"\xd0\xcf\x11\xe0": "an old Excel file (XLS); save it as XLSX or CSV",
    b"\x1f\x8b": "a gzip file; unpack it first",
    b"\x93NUMPY": NUMPY,
    **dict.fromkeys(
        [b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05"],
        "a Python pickle, which is never loaded; save it as CSV",
    ),
    b"%PDF": "a PDF; save the table as CSV",
    **dict.fromkeys(
        [b'{"', b"{\n", b"{\r", b"[{", b"[[", b"[\n", b"[\r"], "JSON; save the table as CSV"
    ),
    **dict.fromkeys(
        [b"<!", b"<?", b"<html", b"<HTML", b"<table"],
        "HTML or XML, which some programs save as XLS; save it as XLSX or CSV",
    ),
}
"""First bytes of files that are no tables of text: their kind, or why they are not read."""
KINDS = ("XLSX", "Parquet", "MAT", "text")


@contextmanager
def table_file(table: "str | Path | pd.DataFrame") -> Iterator[Path]:
    """Yield the path of a table; a data frame is written as CSV, with its index if that is named.

    Raises:
        InputError: what is no path and no data frame.
    """
    if isinstance(table, str | Path) or not hasattr(table, "to_csv"):
        expect(table, (str, Path), "path", "the path of a table, or a pandas data frame")
        yield Path(table)
        return
    with TemporaryDirectory() as folder:
        path = Path(folder) / "data frame"
        named = any(name is not None for name in table.index.names)
        replace_file(path, table.to_csv(index=named))
        try:
            yield path
        except InputError as error:
            raise InputError(str(error).replace(str(path), path.name)) from None


def open_tables(
    path: str | Path, mapping: PointMapping, second: Path | None = None
) -> tuple[Grid, int]:
    """Open the file or the two files that a mapping is for, as one table."""
    first = open_grid(path, mapping.file)
    if mapping.second_file is None:
        if second is not None:
            raise InputError(f"{second}: the mapping has no section [second_file]")
        return first, 0
    second_path = second or mapping.second_file.path
    if second_path is None:
        raise InputError(
            f"{path}: the mapping has a section [second_file] without path; give it there or by "
            f"--second"
        )
    return joined(first, open_grid(second_path, mapping.second_file), mapping.second_file.match)


@limits.bounded
def open_grid(path: str | Path, file_format: FileFormat, check: Check | None = None) -> Grid:
    """Open one file as a table of cells; `check` is given the names of its columns."""
    name, content = str(path), limits.read_bytes(Path(path), limits.TABLE)
    kind = kind_of(name, content)
    with undamaged(name, "damaged, or not what its first bytes say"):
        if kind == "XLSX":
            return _xlsx(name, content, file_format, check)
        if kind == "Parquet":
            return _parquet(name, content, file_format, check)
        if kind == "MAT":
            return _mat(name, file_format, check)
    if file_format.sheet or file_format.variable:
        key = "sheet" if file_format.sheet else "variable"
        raise InputError(f"{name}: text has no {key}; remove [file] {key}")
    text = decoded(name, content, file_format.encoding)
    return grid_of_rows(name, list(records(name, text, file_format)), file_format, check)


def kind_of(path: str, content: bytes) -> str:
    """Return the kind of a file by its first bytes: one of `KINDS`."""
    if not content.strip(b"\xef\xbb\xbf \t\r\n"):
        raise InputError(f"{path}: the file is empty; expected a table of readings")
    kind = next((kind for magic, kind in MAGIC.items() if content.startswith(magic)), "text")
    if kind not in KINDS:
        raise InputError(f"{path}: {kind}; expected text, XLSX, MAT or Parquet")
    return kind


def is_parquet(path: Path) -> bool:
    """Whether a file begins as Parquet does."""
    try:
        with path.open("rb") as stream:
            return MAGIC.get(stream.read(4)) == "Parquet"
    except OSError:
        return False


@contextmanager
def undamaged(path: str | Path, complaint: str) -> Iterator[None]:
    """Turn exceptions of a reader into one line: which ones damaged files raise is undocumented."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as e:
        reason = " ".join(str(e).split()) or type(e).__name__
        short = reason if len(reason) <= 80 else reason[:77] + "..."
        raise InputError(f"{path}: {complaint} ({short})") from e


def package(path: str | Path, name: str, kind: str) -> Any:
    """Import a package that a kind of file needs."""
    with needed_by(f"{path}: {kind}"):
        return import_module(name)


def _xlsx(path: str, content: bytes, how: FileFormat, check: Check | None) -> Grid:
    book = workbook(path, content)
    sheets = book.sheetnames
    if how.sheet is not None and how.sheet not in sheets:
        raise InputError(
            f"{path}: no sheet '{how.sheet}'{suggest(how.sheet, sheets)}; it has "
            f"{', '.join(sheets)}"
        )
    sheet = how.sheet or sheets[0]
    rows = sheet_rows(path, book, sheet, how.comment)
    if not rows:
        raise InputError(f"{path}: sheet '{sheet}' is empty; it has {', '.join(sheets)}")
    return grid_of_rows(path, rows, how, check)


@dataclass(frozen=True, slots=True, eq=False)
class Workbook:
    """A workbook that is read sheet by sheet."""

    reader: Any  # of openpyxl
    sheetnames: list[str]  # in order
    merged: dict[str, list[str]]  # ranges of merged cells, by the name of a sheet's part


def workbook(path: str, content: bytes) -> Workbook:
    """Open an XLSX file with openpyxl, once its parts are known to fit into memory."""
    with undamaged(path, "damaged, or not an XLSX file"):
        merged: dict[str, list[str]] = {}
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            names = [m.filename for m in members]
            if any(name.endswith(".npy") for name in names):
                raise InputError(f"{path}: {NUMPY}")
            if "xl/workbook.xml" not in names:
                raise InputError(
                    f"{path}: a zip archive that is no XLSX; unpack it, or save as XLSX"
                )
            size = sum(m.file_size for m in members)
            limits.check_size(f"{path}: unpacked", size, limits.UNPACKED)
            for member in members:
                with archive.open(member) as stream, suppress(expat.ExpatError):  # pictures
                    merged[member.filename] = _check_xml(path, member.filename, stream)
        openpyxl = package(path, "openpyxl", "XLSX")
        book = openpyxl.load_workbook(
            io.BytesIO(content), read_only=True, data_only=True, keep_links=False
        )
    names = list(book.sheetnames)
    if len(names) > limits.SHEETS:
        raise InputError(f"{path}: {len(names)} sheets; valid: at most {limits.SHEETS}")
    return Workbook(book, names, merged)


def _check_xml(path: str, name: str, stream: IO[bytes]) -> list[str]:
    """Limit a part of a workbook: openpyxl holds a row of a sheet, any other part as a whole.

    Return the ranges of its merged cells, as "B2:B4".
    """
    where, sheet = f"{path}: {name}", name.startswith("xl/worksheets/")
    most = limits.COLUMNS * 10 if sheet else limits.ELEMENTS
    depth = elements = rows = cells = 0
    merged: list[str] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, elements, rows, cells
        depth += 1
        elements += 1
        tag = tag.rpartition(":")[2]
        if sheet and tag == "row":
            rows, elements = rows + 1, 0
            limits.check_rows(where, rows)
        cells += sheet and tag == "c"
        if sheet and tag == "mergeCell":
            merged.append(attributes.get("ref", ""))
        if depth > limits.XML_DEPTH or elements > most:
            deep = depth > limits.XML_DEPTH
            excess = f"{depth} elements in each other" if deep else f"{elements} elements"
            excess += " in a row" * sheet
            raise InputError(f"{where}: {excess}; valid: a workbook of readings")

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    fed = 0
    while piece := stream.read(1 << 16):
        parser.Parse(piece)
        fed += len(piece)
        limits.check_cells(where, cells)
        limits.check_size(f"{where}: a tag", fed - parser.CurrentByteIndex, limits.LINE)
    parser.Parse(b"", True)
    return merged


def sheet_rows(
    path: str, book: Workbook, sheet: str, comment: str | None
) -> list[tuple[int, list[Cell]]]:
    """Rows of a sheet that are neither empty nor comments, with their numbers from 1.

    What stands in merged cells counts for each of them.
    """
    rows: list[tuple[int, list[Cell]]] = []
    count = 0
    with undamaged(path, "damaged, or not an XLSX file"):
        read = book.reader[sheet]
        read.reset_dimensions()  # the stated dimensions would pad every row
        for row, cells in enumerate(read.iter_rows(values_only=True), start=1):
            limits.check_rows(f"{path}: sheet '{sheet}'", row)
            plain = [_cell(c) for c in cells]
            while plain and plain[-1] is None:
                plain.pop()
            remark = comment is not None and str(plain[0] if plain else "").startswith(comment)
            if plain and not remark:
                count += len(plain)
                limits.check_cells(f"{path}: sheet '{sheet}'", count)
                rows.append((row, plain))
        for ranges in book.merged.get(read._worksheet_path, []):
            count += _fill(rows, ranges)
            limits.check_cells(f"{path}: sheet '{sheet}'", count)
    return rows


def _fill(rows: list[tuple[int, list[Cell]]], merged: str) -> int:
    """Write the first of merged cells, "B2:B4", into the others; return how many cells that are."""
    from openpyxl.utils import range_boundaries

    left, top, right, bottom = range_boundaries(merged)
    row = itemgetter(0)
    covered = rows[bisect_left(rows, top, key=row) : bisect_right(rows, bottom, key=row)]
    width = min(right, limits.COLUMNS) - left + 1
    if not covered or covered[0][0] != top or width < 1 or len(covered[0][1]) < left:
        return 0
    value = covered[0][1][left - 1]
    area: int = width * len(covered)
    for _, cells in covered:
        cells += [None] * (left - 1 + width - len(cells))
        cells[left - 1 : left - 1 + width] = [value] * width
    return area


def _cell(value: object) -> Cell:
    if value is None or isinstance(value, datetime):
        return value
    if isinstance(value, bool):
        return str(value)
    if isinstance(value, int | float):
        return float(value)
    if isinstance(value, date):
        return datetime.combine(value, time())
    if isinstance(value, time):
        return datetime.combine(date(1900, 1, 1), value)
    text = str(value).strip()
    return text or None


def _columns(
    path: str, named: list[tuple[str, list[Cell]]], how: FileFormat, check: Check | None
) -> Grid:
    if not named or not named[0][1]:
        raise InputError(f"{path}: no readings; expected columns of equal length")
    titles = [name for name, _ in named]
    if check is not None:
        check(titles)
    rows = np.arange(1, len(named[0][1]) + 1)
    columns = tuple(cells for _, cells in named)
    grid = Grid(path, unique(titles), rows, columns, (how,) * len(named))
    return grid.rows_with(~np.isin(rows, how.skip_rows))


def _parquet(path: str, content: bytes, how: FileFormat, check: Check | None) -> Grid:
    """Columns of numbers, texts and times of a Parquet file; rows count from 1.

    The metadata give their unpacked size. Texts are read dictionary-encoded, and their total length
    is checked before they expand: a file of 0.3 MB may hold a text of 1 MB in each of 5,000 rows.
    """
    parquet = package(path, "pyarrow.parquet", "Parquet")
    from pyarrow import compute

    schema = parquet.ParquetFile(io.BytesIO(content)).schema_arrow
    names = [f.name for f in schema if is_plain(f.type)]
    texts = [f.name for f in schema if is_text(f.type)]
    if not names:
        listed = ", ".join(schema.names[:3])
        raise InputError(
            f"{path}: a row of {listed} holds several numbers; write each in a column of its own"
        )
    file = parquet.ParquetFile(io.BytesIO(content), read_dictionary=texts)
    meta = file.metadata
    limits.check_cells(path, meta.num_rows, max(len(names), 1))
    # By row groups: pyarrow ends the process where the statistics of a column are damaged.
    sizes = (meta.row_group(k).total_byte_size for k in range(meta.num_row_groups))
    limits.check_size(f"{path}: unpacked", sum(sizes), limits.UNPACKED)
    table = file.read(columns=names)
    for name in texts:
        lengths = (
            compute.sum(compute.binary_length(part.dictionary).take(part.indices)).as_py() or 0
            for part in table[name].chunks
        )
        limits.check_size(f"{path}: column '{name}'", max(lengths, default=0), limits.UNPACKED // 4)
    named = [
        (name, [_cell(v) for v in column.to_pylist()])
        for name, column in zip(table.column_names, table.columns, strict=True)
    ]
    return _columns(path, named, how, check)


def is_text(kind: Any) -> bool:
    """Whether a column of this type of pyarrow holds texts."""
    from pyarrow import types

    return bool(types.is_string(kind) or types.is_large_string(kind))


def is_plain(kind: Any) -> bool:
    """Whether a column of this type of pyarrow holds a number, a text or a time in each row."""
    from pyarrow import types

    numbers = types.is_primitive(kind) or types.is_decimal(kind) or types.is_null(kind)
    return bool(numbers) or is_text(kind)


def _mat(path: str, how: FileFormat, check: Check | None) -> Grid:
    """Columns of a MAT file: those of its matrices that have the same number of rows.

    A matrix A of k > 1 columns gives "A(1)" ... "A(k)", poses T of shape (4, 4, N) give
    "T(1,1)" ..., fields of a structure "s.field".
    """
    variables, matrices = matfile.read(path)
    if how.variable is not None and how.variable not in variables:
        raise InputError(
            f"{path}: no variable '{how.variable}'{suggest(how.variable, variables)}; it has "
            f"{', '.join(variables)}"
        )
    chosen = [how.variable] if how.variable else variables
    blocks = [(name, values) for variable, name, values in matrices if variable in chosen]
    lengths = [len(values) for _, values in blocks]
    if not blocks:
        raise InputError(
            f"{path}: no matrix of numbers in {', '.join(chosen) or 'it'}; tables of MATLAB are "
            f"written by writetable as CSV"
        )
    rows = max(lengths, key=lambda k: (lengths.count(k), k))
    named = []
    for name, values in blocks:
        for k in range(values.shape[1] if len(values) == rows else 0):
            title = name if values.shape[1] == 1 else f"{name}({k + 1})"
            named.append((title, [_cell(v) for v in values[:, k].tolist()]))
    return _columns(path, named, how, check)


SEPARATORS = {"tab": "\t", "blanks": " "}  # Separators that have a name in a mapping file

BYTE_ORDER_MARKS = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}


def guessed_encoding(content: bytes) -> str:
    """Guess the encoding of text without a byte order mark.

    UTF-8 if it is that. A Chinese character of GB 18030 has two bytes above 127; such bytes are
    hardly ever in pairs everywhere in Western text, as "Größe". Latin-1 has no bytes 128 to 159;
    Shift JIS has them beside others above 127, Windows-1252 mostly alone, as dashes and quotes.
    """
    runs = re.findall(rb"[\x80-\xff]+", content)
    candidates = ["utf-8"]
    if all(len(run) % 2 == 0 for run in runs):
        candidates.append("gb18030")
    if re.search(rb"[\x80-\x9f]", content):
        candidates += ["cp932"] * any(len(run) > 1 for run in runs) + ["cp1252"]
    for name in candidates:
        try:
            content.decode(name)
        except UnicodeDecodeError:
            continue
        return name
    return "latin-1"


def decoded(path: str, content: bytes, encoding: str | None) -> str:
    """Text of a file: by its byte order mark, else as stated, else as `guessed_encoding` says."""
    marks = (name for mark, name in BYTE_ORDER_MARKS.items() if content.startswith(mark))
    stated = next(marks, encoding)
    try:
        text = content.decode(stated or guessed_encoding(content))
    except UnicodeError as e:
        raise InputError(
            f"{path}: not {str(stated).upper()} text; a mapping states another in [file] encoding "
            "(--preview proposes one): utf-8, latin-1, utf-16, gb18030, shift_jis, euc_kr ..."
        ) from e
    if "\x00" in text:
        raise InputError(f"{path}: binary data; expected text, XLSX, MAT or Parquet")
    return text


def records(path: str, text: str, file_format: FileFormat) -> Iterator[tuple[int, list[str]]]:
    """Rows of cells that are neither blank nor comments, with their numbers from 1."""
    separator = SEPARATORS.get(file_format.separator or ",", file_format.separator or ",")
    blanks = file_format.separator == "blanks"
    text = text.replace("\t", " ") if blanks else text
    comment, k = file_format.comment, file_format.header_row - 1
    if comment is not None and k >= 0:  # a header as numpy.savetxt writes it
        split = text.splitlines(keepends=True)
        for line in split[k : k + 1]:
            if (head := line.lstrip()).startswith(comment):
                split[k] = head.removeprefix(comment).lstrip()
        text = "".join(split)
    lines = limits.Lines(path, io.StringIO(text, newline=None))
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=blanks, strict=True)
    try:
        next_row = 1
        for cells in reader:
            row, next_row = next_row, reader.line_num + 1
            lines.row(len(cells))
            plain = [c.strip() for c in cells]
            plain = plain[: length_of(plain)] if blanks else plain
            if any(plain) and not (comment and plain[0].startswith(comment)):
                yield row, plain
    except csv.Error as e:
        raise InputError(f"{path}: row {reader.line_num}: not delimited text ({e})") from e


def grid_of_rows(
    path: str,
    numbered_rows: Sequence[tuple[int, Sequence[Cell]]],
    file_format: FileFormat,
    check: Check | None = None,
) -> Grid:
    """Make a grid of rows: checked header, units, rows of one length but for empty ends."""
    by_row = dict(numbered_rows)
    if file_format.header_row and file_format.header_row not in by_row:
        raise InputError(
            f"{path}: row {file_format.header_row} holds no header; set [file] header_row to its "
            f"row, 0 where there is none"
        )
    titles = by_row[file_format.header_row] if file_format.header_row else []
    if check is not None:
        check([text_of(c) for c in titles])
    header = [" ".join(text_of(c).split()) for c in titles]
    if file_format.group_row is not None:
        header = grouped(header, by_row.get(file_format.group_row, ()))
    skipped = {file_format.units_row, *file_format.skip_rows}
    body = [
        (row, c) for row, c in numbered_rows if row > file_format.header_row and row not in skipped
    ]
    if not body:
        raise InputError(f"{path}: no readings below row {file_format.header_row}")
    width = len(header) or max(length_of(c) for _, c in body)
    while header and not header[-1] and all(length_of(c) < width for _, c in body):
        header.pop()
        width -= 1
    for row, cells in body:
        if length_of(cells) > width or (file_format.header_row and len(cells) < width):
            raise InputError(
                f"{path}: row {row} has {length_of(cells)} cells, "
                f"{'the header' if header else 'others'} {width}; a mapping lists rows that are "
                "no readings in [file] skip_rows, or has them begin with [file] comment"
            )
    limits.check_cells(path, len(body), width)
    names = unique(header or [str(k + 1) for k in range(width)])
    padded = [[*cells[:width], *[None] * (width - len(cells))] for _, cells in body]
    columns = tuple(list(column) for column in zip(*padded, strict=True))
    units = {}
    if file_format.units_row is not None and file_format.units_row in by_row:
        units = {n: text_of(c) for n, c in zip(names, by_row[file_format.units_row], strict=False)}
    rows = np.array([row for row, _ in body], dtype=np.int64)
    return Grid(path, names, rows, columns, (file_format,) * len(names), units)


def grouped(header: Sequence[str], groups: Sequence[Cell]) -> list[str]:
    """Return a header whose repeated names begin with the group that stands over them.

    The name of a group stands over its first column, or over each of them.
    """
    names: list[str] = []
    group = ""
    for name, cell in zip_longest(header, groups[: len(header)], fillvalue=None):
        group = " ".join(text_of(cell).split()) or group
        repeated = name and header.count(name) > 1
        names.append(f"{group} {name}".strip() if repeated else name or "")
    return names


def filled(cell: Cell) -> bool:
    """Whether a cell holds anything."""
    return cell is not None and cell != ""


def length_of(cells: Sequence[Cell]) -> int:
    """Cells up to the last one that is not empty."""
    return max((k for k, cell in enumerate(cells, start=1) if filled(cell)), default=0)
