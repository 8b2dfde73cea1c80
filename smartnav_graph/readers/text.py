"""Delimited text -> columns, errors name the file, the row and the value."""

from __future__ import annotations

import gzip
import itertools
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv

from smartnav_graph.core.arrays import Floats, Mask, Texts, Times
from smartnav_graph.core.errors import SessionError, warn
from smartnav_graph.core.timebase import NS, ns_from_text
from smartnav_graph.readers.stamps import is_date, ns_from_date
from smartnav_graph.readers.text_lines import (
    UTF16_MARKS,
    TextRows,
    head_of,
    missing_marks,
    names_in_heading,
    text_rows,
)

_COMMA, _POINT = r"^[-+]?\d*,\d+([eE][-+]?\d+)?$", r"^[-+]?\d*\.\d+([eE][-+]?\d+)?$"

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
    return [line.strip() for line in head_of(path).splitlines()[:count]]


@dataclass(frozen=True)
class TextTable:
    """Cells of a delimited text file, still as text; conversion on demand, so that stamps keep every digit.

    skipped : lines that are no rows and were left out, by reason
    """

    path: Path
    cells: Mapping[str, pa.ChunkedArray]
    skipped: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, path: Path, columns: Mapping[str, Sequence[str]]) -> TextTable:
        """Of columns of text that a reader has taken apart itself."""
        return cls(path, {name: pa.chunked_array([pa.array(cells, pa.string())]) for name, cells in columns.items()})

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

    def _column(self, name: str) -> pa.ChunkedArray:
        self.require([name])
        return self.cells[name]

    def where(self, name: str, value: str) -> TextTable:
        """The rows whose cell in column `name` reads `value`."""
        return self.rows(pa.compute.equal(self._column(name), value))

    def rows(self, mask: Mask | pa.ChunkedArray) -> TextTable:
        """The rows of a mask (n,)."""
        kept = pa.array(mask) if isinstance(mask, np.ndarray) else mask
        return TextTable(self.path, {name: cells.filter(kept) for name, cells in self.cells.items()}, self.skipped)

    def known(self, name: str) -> Mask:
        """Mask (n,) of the rows whose cell holds something, be it no number."""
        return np.asarray(_filled(self._column(name)).is_valid().to_numpy(), dtype=bool)

    def texts(self, name: str) -> Texts:
        """Cells as text (object array); empty where empty."""
        return np.array(self._column(name).to_pylist(), dtype=object)

    def floats(self, *names: str) -> Floats:
        """One column (n,) or several (n, k) as numbers; empty cells, and marks such as N/A, become NaN.

        A comma is read as decimal mark, unless the file also has numbers with a decimal point.
        """
        rows = np.zeros((0, len(names)))
        for column, name in enumerate(names):
            numbers = self._numbers(name, pa.float64()).to_numpy()
            if column == 0:
                rows = np.empty((len(numbers), len(names)))
            rows[:, column] = numbers
        return rows if len(names) > 1 else rows[:, 0]

    def optional(self, name: str) -> Floats | None:
        """A column (n,) as numbers, as `floats`; None where the file has none of this name."""
        return self.floats(name) if name in self.cells else None

    def ints(self, name: str) -> Times:
        """One column as int64; every cell must hold a whole number, be it written with an exponent."""
        try:
            numbers = self._numbers(name, pa.int64(), "a whole number")
        except SessionError as error:
            try:
                numbers = pa.array([_whole(text) for text in self.texts(name)], pa.int64())
            except (InvalidOperation, ValueError, OverflowError):
                raise error from None
        if numbers.null_count:
            raise self._bad_cell(name, numbers.is_null().index(True).as_py(), "a whole number")
        return np.asarray(numbers.to_numpy(), dtype=np.int64)

    def times(self, name: str, unit_ns: int = NS) -> Times:
        """One column of decimal clock readings in units of `unit_ns` as exact nanoseconds; dates as Unix nanoseconds
        (`stamps.ns_from_date`)."""
        cells = self._column(name)
        dates = len(cells) > 0 and is_date(cells[0].as_py())
        if not dates and len(cells) and "," in cells[0].as_py():
            cells = self._with_point(name, cells)
        found = np.empty(len(cells), dtype=np.int64)
        for first in range(0, len(cells), ROWS):
            for row, text in enumerate(cells[first : first + ROWS].to_pylist(), first):
                try:
                    found[row] = ns_from_date(text) if dates else ns_from_text(text, unit_ns)
                except SessionError as error:
                    what = "a date as in the first row" if dates else "a decimal number"
                    raise self._bad_cell(name, row, what) from error
        return found

    def is_empty(self, name: str) -> bool:
        """Whether no row of the column holds anything."""
        return not self.known(name).any()

    def _numbers(self, name: str, kind: pa.DataType, what: str = "a number") -> pa.ChunkedArray:
        cells = self._column(name)
        try:
            return _cast(cells, kind)
        except pa.ArrowInvalid:
            cells = self._with_point(name, cells)
        try:
            return _cast(cells, kind)
        except pa.ArrowInvalid as error:
            row = next(i for i, text in enumerate(_filled(cells).to_pylist()) if text and not _casts(text, kind))
            raise self._bad_cell(name, row, what) from error

    def _with_point(self, name: str, cells: pa.ChunkedArray) -> pa.ChunkedArray:
        """The cells with a decimal point where they have a decimal comma.

        Raises
        ------
        SessionError
            The file has numbers with a comma and numbers with a point: one of them is no decimal mark.
        """
        commas = pa.compute.match_substring_regex(cells, _COMMA)
        if not pa.compute.any(commas).as_py():
            return cells
        for other, column in self.cells.items():
            if pa.compute.any(pa.compute.match_substring_regex(column, _POINT)).as_py():
                row = commas.index(True).as_py()
                found = f"{name} is {cells[row].as_py()!r} at row {row}, but {other} has decimal points"
                remedy = "export it with decimal points"
                raise SessionError(self.path, found, "one decimal mark in the file", remedy, row=row)
        return pa.compute.replace_substring(cells, ",", ".", max_replacements=1)

    def _bad_cell(self, name: str, row: int, expected: str) -> SessionError:
        found = f"{name} is {self._column(name)[row].as_py()!r} at row {row}"
        return SessionError(self.path, found, expected, "correct the cell, or leave it empty if unknown", row=row)


def _filled(cells: pa.ChunkedArray) -> pa.ChunkedArray:
    """Cells of a column, null where they hold nothing."""
    short = pa.compute.less_equal(pa.compute.binary_length(cells), 9)
    marks = pa.array(missing_marks())
    lower = pa.compute.utf8_lower(pa.compute.if_else(short, cells, pa.scalar("1")))
    return pa.compute.if_else(pa.compute.is_in(lower, marks), pa.scalar(None, pa.string()), cells)


def _cast(cells: pa.ChunkedArray, kind: pa.DataType) -> pa.ChunkedArray:
    return pa.chunked_array([_filled(chunk).cast(kind) for chunk in cells.chunks], kind)


def _whole(text: str) -> int | None:
    """A whole number, written with an exponent perhaps; None where it is none."""
    value = Decimal(text)
    return int(value) if value.is_finite() and value % 1 == 0 else None


def _casts(text: str, kind: pa.DataType) -> bool:
    try:
        pa.scalar(text, pa.string()).cast(kind)
    except pa.ArrowInvalid:
        return False
    return True


def read_text(path: Path, *, names: Sequence[str] | None = None, comments: str = "#", whole: bool = False) -> TextTable:
    """Read comma, semicolon, tab, bar or blank separated text.

    Parameters
    ----------
    path : the file; UTF-8, UTF-16 with its mark, or a Windows code page
    names : column names, for files without a heading or with a heading behind #; by default the first line names the
        columns (a leading # is removed)
    comments : characters that start a line of remarks
    whole : leave out a last row without line end: it may be cut; counts are in `skipped`, without a warning

    What else is no row is left out, and counted: see `text_lines.TextRows`. Row numbers in errors count data rows from
    zero.

    Raises
    ------
    SessionError
        Missing, unreadable, no text, no rows, rows of different length, or a column name twice.
    """
    rows = text_rows(path, lambda: _blocks(path), with_heading=names is None, comments=comments, whole=whole)
    heading = rows.heading.decode("utf-8", errors="replace")
    columns = list(names) if names is not None else names_in_heading(heading, rows.separator)
    if len(set(columns)) != len(columns):
        twice = sorted({name for name in columns if columns.count(name) > 1})
        raise SessionError(path, f"column {', '.join(map(repr, twice))} appears twice", "each column once")
    start = list(itertools.islice(rows.blocks(), 3))
    if not start:
        raise SessionError(path, "has no rows", "at least one row", "delete the file if there was no such sensor")
    if names is None and _ends_empty(start[0], rows.separator, len(columns)):
        columns.append(f"column {len(columns) + 1}")
    cells = _Cells(path, tuple(columns), rows)
    long = len(start) > 2 or sum(map(len, start)) >= BLOCK
    table = TextTable(path, cells if long else cells.parse(columns, start), rows.skipped)
    if table.skipped and not whole:
        warn(f"{path}: {', '.join(f'{count} {what}' for what, count in table.skipped.items())}")
    return table


def _ends_empty(block: bytes, separator: str, columns: int) -> bool:
    """Whether rows end in a separator that the heading lacks."""
    first = block.lstrip(b"\r\n ").split(b"\n", 1)[0].strip(b"\r ")
    mark = separator.encode()
    return separator != " " and first.endswith(mark) and re.sub(rb'"[^"]*"', b"", first).count(mark) == columns


def _blocks(path: Path) -> Iterator[bytes]:
    """The whole lines of a file, about `BLOCK` bytes at a time; all at once in UTF-16, whose lines end otherwise."""
    rest: list[bytes] = []
    if b"".join(itertools.islice(_chunks(path), 1))[:2] in UTF16_MARKS:
        yield read_bytes(path)
        return
    for data in _chunks(path):
        lines, end, begun = data.rpartition(b"\n")
        if end:
            yield b"".join([*rest, lines, end])
            rest = []
        rest.append(begun)
    if last := b"".join(rest):
        yield last


@dataclass(frozen=True)
class _Cells(Mapping[str, "pa.ChunkedArray"]):
    """The cells of a file by column, parsed from the file each time that a column is asked for."""

    path: Path
    columns: tuple[str, ...]
    rows: TextRows

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __len__(self) -> int:
        return len(self.columns)

    def __getitem__(self, name: str) -> pa.ChunkedArray:
        if name not in self.columns:
            raise KeyError(name)
        pa.default_memory_pool().release_unused()  # what the column before took
        return self.parse([name], self.rows.blocks())[name]

    def parse(self, names: Sequence[str], blocks: Iterable[bytes]) -> dict[str, pa.ChunkedArray]:
        """The cells of the columns `names` in rows of text.

        Raises
        ------
        SessionError
            Rows of different length, or no UTF-8.
        """
        parts: list[pa.Table] = []
        for block in blocks:
            if self.rows.separator == " ":
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
                parse_options=pyarrow.csv.ParseOptions(delimiter=self.rows.separator),
                convert_options=pyarrow.csv.ConvertOptions(
                    column_types=dict.fromkeys(names, pa.string()), include_columns=names
                ),
            )
        except pa.ArrowInvalid as error:
            text = re.sub(r"Row #(\d+)", lambda row: f"Row #{int(row[1]) + before}", str(error))
            found = f"is no table of {len(self.columns)} columns ({text})"
            remedy = "complete the row"
            if self.rows.separator == "," and re.match(rb"[^\n]*\d,\d+,-?\d+,\d", block):
                remedy += "; if commas are decimal marks, export with decimal points, or with ; between the cells"
            raise SessionError(self.path, found, "rows of one length", remedy) from error
