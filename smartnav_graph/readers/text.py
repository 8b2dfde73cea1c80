"""Delimited text -> columns, errors name the file, the row and the value."""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv

from smartnav_graph.core.arrays import Floats, Texts, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, ns_from_text

BLOCK = 32 << 20  # bytes that are parsed at once; of a longer file one column at a time is held as text
ROWS = 1 << 16  # stamps that are converted at once


def read_bytes(path: Path) -> bytes:
    """The bytes of a file; those inside where its name ends in .gz.

    Raises
    ------
    SessionError
        Missing, unreadable or damaged.
    """
    return b"".join(_chunks(path))


def _chunks(path: Path) -> Iterator[bytes]:
    """The bytes of `read_bytes`, `BLOCK` at a time."""
    try:
        with cast(BinaryIO, gzip.open(path)) if path.suffix == ".gz" else path.open("rb") as file:
            while data := file.read(BLOCK):
                yield data
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
    cells: Mapping[str, pa.ChunkedArray]

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
        rows = np.zeros((0, len(names)))
        for column, name in enumerate(names):
            numbers = self._numbers(name, pa.float64()).to_numpy()
            if column == 0:
                rows = np.empty((len(numbers), len(names)))
            rows[:, column] = numbers
        return rows if len(names) > 1 else rows[:, 0]

    def ints(self, name: str) -> Times:
        """One column as int64; every cell must hold a whole number."""
        numbers = self._numbers(name, pa.int64(), "a whole number")
        if numbers.null_count:
            raise self._bad_cell(name, numbers.is_null().index(True).as_py(), "a whole number")
        return np.asarray(numbers.to_numpy(), dtype=np.int64)

    def times(self, name: str, unit_ns: int = NS) -> Times:
        """One column of decimal clock readings in units of `unit_ns` as exact nanoseconds."""
        cells = self.cells[name]
        found = np.empty(len(cells), dtype=np.int64)
        for first in range(0, len(cells), ROWS):
            for row, text in enumerate(cells[first : first + ROWS].to_pylist(), first):
                try:
                    found[row] = ns_from_text(text, unit_ns)
                except SessionError as error:
                    raise self._bad_cell(name, row, "a decimal number") from error
        return found

    def is_empty(self, name: str) -> bool:
        """Whether no row of the column holds anything."""
        return not pa.compute.any(pa.compute.not_equal(self.cells[name], "")).as_py()

    def _numbers(self, name: str, kind: pa.DataType, what: str = "a number") -> pa.ChunkedArray:
        def cast(cells: pa.Array) -> pa.Array:
            filled = pa.compute.if_else(pa.compute.equal(cells, ""), pa.scalar(None, pa.string()), cells)
            return filled.cast(kind)

        cells = self.cells[name]
        try:
            return pa.chunked_array([cast(chunk) for chunk in cells.chunks], kind)
        except pa.ArrowInvalid as error:
            row = next(i for i, text in enumerate(cells.to_pylist()) if text and not _casts(text, kind))
            raise self._bad_cell(name, row, what) from error

    def _bad_cell(self, name: str, row: int, expected: str) -> SessionError:
        found = f"{name} is {self.cells[name][row].as_py()!r} at row {row}"
        return SessionError(self.path, found, expected, "correct or delete the row", row=row)


def _casts(text: str, kind: pa.DataType) -> bool:
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
    blocks = _blocks(path)
    start = next(blocks, b"").removeprefix(b"\xef\xbb\xbf").lstrip()
    if b"\0" in start[:4096]:
        raise SessionError(path, "is no text (it holds zero bytes)", "a text file", "check the format")
    heading = b""
    if names is None:
        heading, _, start = start.partition(b"\n")
    start = _without_comments(start)
    first = heading.strip() if names is None else start[:4096].split(b"\n", 1)[0]
    separator = next((mark for mark in ",;\t" if mark.encode() in first), " ")
    columns = list(names) if names is not None else _heading_names(first, separator)
    if len(set(columns)) != len(columns):
        twice = sorted({name for name in columns if columns.count(name) > 1})
        raise SessionError(path, f"column {', '.join(map(repr, twice))} appears twice", "each column once")
    more = next(blocks, b"")
    if not start.strip() and not more:
        raise SessionError(path, "has no rows", "at least one row", "delete the file if there was no such sensor")
    cells = _Cells(path, tuple(columns), separator, with_heading=names is None)
    return TextTable(path, cells if more else cells.parse(columns, [start]))


def _blocks(path: Path) -> Iterator[bytes]:
    """The whole lines of a file, about `BLOCK` bytes at a time."""
    rest: list[bytes] = []
    for data in _chunks(path):
        lines, end, begun = data.rpartition(b"\n")
        if end:
            yield b"".join([*rest, lines, end])
            rest = []
        rest.append(begun)
    if last := b"".join(rest):
        yield last


def _without_comments(block: bytes) -> bytes:
    return re.sub(rb"(?m)^[ \t]*#.*\n?", b"", block) if b"#" in block else block


@dataclass(frozen=True)
class _Cells(Mapping[str, "pa.ChunkedArray"]):
    """The cells of a file by column, parsed from the file each time that a column is asked for."""

    path: Path
    columns: tuple[str, ...]
    separator: str
    with_heading: bool

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def __getitem__(self, name: str) -> pa.ChunkedArray:
        if name not in self.columns:
            raise KeyError(name)
        pa.default_memory_pool().release_unused()  # what the column before took
        return self.parse([name], self._blocks())[name]

    def _blocks(self) -> Iterator[bytes]:
        """The rows of the file, without byte order mark, heading and comments."""
        blocks = _blocks(self.path)
        start = next(blocks).removeprefix(b"\xef\xbb\xbf").lstrip()
        yield _without_comments(start.partition(b"\n")[2] if self.with_heading else start)
        yield from map(_without_comments, blocks)

    def parse(self, names: Sequence[str], blocks: Iterable[bytes]) -> dict[str, pa.ChunkedArray]:
        """The cells of the columns `names` in rows of text.

        Raises
        ------
        SessionError
            Rows of different length, or no UTF-8.
        """
        parts: list[pa.Table] = []
        for block in blocks:
            if self.separator == " ":
                block = re.sub(rb"[ \t]+", b" ", block)
                block = re.sub(rb"(?m)^ | (?=\r?$)", b"", block)
            if block.strip():
                parts.append(self._parse(names, block, sum(map(len, parts))))
        table = pa.concat_tables(parts)
        return {name: pa.compute.utf8_trim_whitespace(table.column(name)) for name in names}

    def _parse(self, names: Sequence[str], block: bytes, before: int) -> pa.Table:
        try:
            return pyarrow.csv.read_csv(
                pa.BufferReader(block),
                read_options=pyarrow.csv.ReadOptions(column_names=self.columns, use_threads=False),
                parse_options=pyarrow.csv.ParseOptions(delimiter=self.separator),
                convert_options=pyarrow.csv.ConvertOptions(
                    column_types=dict.fromkeys(names, pa.string()), include_columns=names
                ),
            )
        except pa.ArrowInvalid as error:
            text = re.sub(r"Row #(\d+)", lambda row: f"Row #{int(row[1]) + before}", str(error))
            found = f"is no table of {len(self.columns)} columns ({text})"
            raise SessionError(self.path, found, "rows of one length") from error


def _heading_names(heading: bytes, separator: str) -> list[str]:
    text = heading.decode("utf-8", errors="replace").lstrip("# ")
    return [name.strip().strip('"') for name in (text.split() if separator == " " else text.split(separator))]
