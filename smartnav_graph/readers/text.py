"""Delimited text -> columns, errors name the file, the row and the value."""

from __future__ import annotations

import gzip
import io
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv

from smartnav_graph.core.arrays import Floats, Texts, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, ns_from_text


def read_bytes(path: Path) -> bytes:
    """The bytes of a file; those inside where its name ends in .gz.

    Raises
    ------
    SessionError
        Missing, unreadable or damaged.
    """
    try:
        data = path.read_bytes()
        return gzip.decompress(data) if path.suffix == ".gz" else data
    except FileNotFoundError as error:
        raise SessionError(path, "is missing", "a text file", "check the path") from error
    except (OSError, EOFError, zlib.error) as error:  # the last two: a damaged gzip file
        reason = getattr(error, "strerror", None) or error
        raise SessionError(path, f"cannot be read ({reason})", "a readable file", "check the path") from error


def first_lines(path: Path, count: int = 2) -> list[str]:
    """The first lines of a text file, stripped; none where the file cannot be read as text."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            return [line.strip() for line, _ in zip(file, range(count), strict=False)]
    except (OSError, ValueError):  # ValueError: no UTF-8, or a zero byte in the name
        return []


@dataclass(frozen=True)
class TextTable:
    """Cells of a delimited text file, still as text; conversion on demand, so that stamps keep every digit."""

    path: Path
    cells: dict[str, pa.Array]

    def __len__(self) -> int:
        return len(next(iter(self.cells.values())))

    def require(self, names: Sequence[str]) -> None:
        """Raise SessionError unless every column of `names` is there."""
        missing = [name for name in names if name not in self.cells]
        if missing:
            raise SessionError(
                self.path,
                f"column {', '.join(missing)} is missing",
                f"columns {', '.join(names)}",
                f"the file has {', '.join(self.cells)}; rename or add the column",
            )

    def where(self, name: str, value: str) -> TextTable:
        """The rows whose cell in column `name` reads `value`."""
        mask = pa.compute.equal(self.cells[name], value)
        return TextTable(self.path, {column: cells.filter(mask) for column, cells in self.cells.items()})

    def texts(self, name: str) -> Texts:
        """Cells as text (object array); empty where empty."""
        return np.array(self.cells[name].to_pylist(), dtype=object)

    def floats(self, *names: str) -> Floats:
        """One column (n,) or several (n, k) as numbers; empty cells become NaN."""
        columns = [self._numbers(name, pa.float64()).to_numpy(zero_copy_only=False) for name in names]
        return np.asarray(columns[0] if len(names) == 1 else np.stack(columns, axis=-1), dtype=np.float64)

    def ints(self, name: str) -> Times:
        """One column as int64; every cell must hold a whole number."""
        numbers = self._numbers(name, pa.int64(), "a whole number")
        if numbers.null_count:
            raise self._bad_cell(name, numbers.is_null().index(True).as_py(), "a whole number")
        return np.asarray(numbers.to_numpy(), dtype=np.int64)

    def times(self, name: str, unit_ns: int = NS) -> Times:
        """One column of decimal clock readings in units of `unit_ns` as exact nanoseconds."""
        found = np.empty(len(self), dtype=np.int64)
        for row, text in enumerate(self.cells[name].to_pylist()):
            try:
                found[row] = ns_from_text(text, unit_ns)
            except SessionError as error:
                raise self._bad_cell(name, row, "a decimal number") from error
        return found

    def is_empty(self, name: str) -> bool:
        """Whether no row of the column holds anything."""
        return not any(self.cells[name].to_pylist())

    def _numbers(self, name: str, kind: pa.DataType, what: str = "a number") -> pa.Array:
        cells = self.cells[name]
        filled = pa.compute.if_else(pa.compute.equal(cells, ""), pa.scalar(None, pa.string()), cells)
        try:
            return filled.cast(kind)
        except pa.ArrowInvalid as error:
            row = next(i for i, text in enumerate(filled.to_pylist()) if not _casts(text, kind))
            raise self._bad_cell(name, row, what) from error

    def _bad_cell(self, name: str, row: int, expected: str) -> SessionError:
        found = f"{name} is {self.cells[name][row].as_py()!r} at row {row}"
        return SessionError(self.path, found, expected, "correct or delete the row", row=row)


def _casts(text: str | None, kind: pa.DataType) -> bool:
    try:
        pa.scalar(text, pa.string()).cast(kind)
    except pa.ArrowInvalid:
        return False
    return True


def read_text(path: Path, *, names: Sequence[str] | None = None) -> TextTable:
    """Read comma, semicolon, tab or blank separated text.

    Parameters
    ----------
    path : the file; UTF-8
    names : column names, for files without a heading or with a heading behind #; by default the first line names the
        columns (a leading # is removed)

    Further lines that start with # are comments. Row numbers in errors count data rows from zero.

    Raises
    ------
    SessionError
        Missing, unreadable, no text, no rows, rows of different length, or a column name twice.
    """
    heading, body = _split(path, with_heading=names is None)
    first = heading if names is None else body[:4096].split(b"\n", 1)[0]
    separator = next((mark for mark in ",;\t" if mark.encode() in first), " ")
    columns = list(names) if names is not None else _heading_names(heading, separator)
    if len(set(columns)) != len(columns):
        twice = sorted({name for name in columns if columns.count(name) > 1})
        raise SessionError(path, f"column {', '.join(map(repr, twice))} appears twice", "each column once")
    if not body.strip():
        raise SessionError(path, "has no rows", "at least one row", "delete the file if there was no such sensor")
    if separator == " ":
        body = re.sub(rb"[ \t]+", b" ", body)
        body = re.sub(rb"(?m)^ | (?=\r?$)", b"", body)
    return TextTable(path, _parse(path, body, columns, separator))


def _split(path: Path, *, with_heading: bool) -> tuple[bytes, bytes]:
    data = read_bytes(path).removeprefix(b"\xef\xbb\xbf").lstrip()
    if b"\0" in data[:4096]:
        raise SessionError(path, "is no text (it holds zero bytes)", "a text file", "check the format")
    heading = b""
    if with_heading:
        heading, _, data = data.partition(b"\n")
    if b"#" in data:
        data = re.sub(rb"(?m)^[ \t]*#.*\n?", b"", data)
    return heading.strip(), data


def _heading_names(heading: bytes, separator: str) -> list[str]:
    text = heading.decode("utf-8", errors="replace").lstrip("# ")
    return [name.strip().strip('"') for name in (text.split() if separator == " " else text.split(separator))]


def _parse(path: Path, body: bytes, columns: list[str], separator: str) -> dict[str, pa.Array]:
    try:
        table = pyarrow.csv.read_csv(
            io.BytesIO(body),
            read_options=pyarrow.csv.ReadOptions(column_names=columns, use_threads=False),
            parse_options=pyarrow.csv.ParseOptions(delimiter=separator),
            convert_options=pyarrow.csv.ConvertOptions(column_types=dict.fromkeys(columns, pa.string())),
        )
    except pa.ArrowInvalid as error:
        raise SessionError(path, f"is no table of {len(columns)} columns ({error})", "rows of one length") from error
    trim = pa.compute.utf8_trim_whitespace
    return {name: trim(table.column(name).combine_chunks()) for name in columns}
