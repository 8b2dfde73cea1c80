"""What surrounds the rows of a text file: encoding, ``sep=`` and comment lines, repeated headings, a torn last row."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from smartnav_graph.core.errors import SessionError

HEAD_BYTES = 1 << 16
UTF16_MARKS = (b"\xff\xfe", b"\xfe\xff")
_UTF8 = b"\xef\xbb\xbf"
_SEPARATORS = ",;\t|"
NO_TEXT = re.compile("[\x00-\x08\x0e-\x1f\x7f-\x9f\ufffd]")  # also what is left of bytes that are no UTF-8


@dataclass(frozen=True)
class TextRows:
    """Heading (empty for a file read without one) and separator of a delimited text, and its rows in UTF-8.

    read : gives the lines of the file, some whole lines at a time; above : lines down to the heading;
    skipped : lines that are no rows, by reason, of the last time that all were read
    """

    read: Callable[[], Iterator[bytes]]
    heading: bytes
    separator: str
    above: int
    comments: bytes
    whole: bool
    skipped: dict[str, int]

    def blocks(self) -> Iterator[bytes]:
        """The rows, some whole lines at a time.

        A heading that comes again is left out; so is a last row without line end that has too few cells, with `whole`
        any last row without line end: its last number may be cut.
        """
        self.skipped.clear()
        damaged = NO_TEXT.search(self.heading.decode("utf-8", "replace")) is not None
        self._skip("line with column names damaged", int(damaged))
        before = b""
        for i, lines in enumerate(self.read()):
            block = in_utf8(lines)
            block = _below(block.lstrip(), self.above) if i == 0 else block
            block = _without_comments(block, self.comments)
            if self.heading and self.heading in block:
                again = rb"(?m)^[ \t]*" + re.escape(self.heading) + rb"[ \t]*\r?(?:\n|\Z)"
                block, times = re.subn(again, b"", block)
                self._skip("that repeat the heading left out", times)
            kept = self._without_torn_row(block, before)
            self._skip("cut at the end of the file left out", int(len(kept) < len(block)))
            before = _last_line(block) or before
            if kept.strip():
                yield kept

    def _skip(self, reason: str, count: int) -> None:
        if count:
            self.skipped[reason] = self.skipped.get(reason, 0) + count

    def _without_torn_row(self, block: bytes, before: bytes) -> bytes:
        start = block.rfind(b"\n") + 1
        last, before = block[start:].strip(), _last_line(block[:start]) or before
        if not last or not before:
            return block
        least = min(_cells(before, self.separator), _cells(self.heading or before, self.separator))
        return block[:start] if self.whole or _cells(last, self.separator) < least else block


def in_utf8(data: bytes) -> bytes:
    """Bytes of a text in UTF-8, UTF-16 with its mark, or a Windows code page, as UTF-8; line ends of old Macs become
    those of Unix."""
    if data.startswith(UTF16_MARKS):
        data = data[: len(data) // 2 * 2].decode("utf-16", errors="replace").encode()
    data = data.removeprefix(_UTF8)
    if not data.isascii():
        try:
            data.decode("utf-8")
        except UnicodeDecodeError as error:
            if len(data) - error.start > 3 or error.reason != "unexpected end of data":
                data = data.decode("cp1252", errors="replace").encode()
    return data if b"\n" in data else data.replace(b"\r", b"\n")


def head_of(path: Path) -> str:
    """The begin of a text file, at most `HEAD_BYTES`; empty where it cannot be read, or is no text."""
    try:
        with path.open("rb") as file:
            data = in_utf8(file.read(HEAD_BYTES))
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return ""
    return "" if b"\0" in data else data.decode("utf-8", errors="ignore")


def heading_of(path: Path, comments: str = "#") -> list[str]:
    """Column names of a delimited text file, as `text_rows` finds them; none where it is no text."""
    text = head_of(path)
    if not text.strip():
        return []
    _, heading, separator = _to_heading(text.lstrip().encode(), comments)
    return names_in_heading(heading.decode("utf-8", errors="replace"), separator)


def names_in_heading(heading: str, separator: str) -> list[str]:
    """Names of a heading, without quotes; columns without a name are called ``column 3``."""
    text = heading.lstrip("# ")
    try:
        row = next(csv.reader([text], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:  # no text at all
        row = text.split(separator)
    cells = text.split() if separator == " " else row
    names = [name.strip().strip('"').strip() for name in cells]
    return [name or f"column {i + 1}" for i, name in enumerate(names)]


def text_rows(
    path: Path, read: Callable[[], Iterator[bytes]], *, with_heading: bool, comments: str, whole: bool
) -> TextRows:
    """How the lines of a delimited text are arranged. Lines before the heading that are blank, hold separators only, or
    say ``sep=``, and lines that start with one of `comments`, are no rows.

    Raises
    ------
    SessionError
        It is no text.
    """
    start = in_utf8(next(read(), b"")).lstrip()
    if b"\0" in start[:4096]:
        raise SessionError(path, "is no text (it holds zero bytes)", "a text file", "check the format")
    above, heading, separator = 0, b"", ""
    if with_heading:
        above, heading, separator = _to_heading(start, comments)
    else:
        separator = _separator(_without_comments(start[:HEAD_BYTES], comments.encode()).lstrip().split(b"\n", 1)[0])
    return TextRows(read, heading, separator, above, comments.encode(), whole, {})


def _below(block: bytes, lines: int) -> bytes:
    for _ in range(lines):
        block = block.partition(b"\n")[2]
    return block


def _last_line(block: bytes) -> bytes:
    text = block.rstrip()
    return text[text.rfind(b"\n") + 1 :]


def _without_comments(data: bytes, comments: bytes) -> bytes:
    for mark in comments:
        if bytes([mark]) in data:
            data = re.sub(rb"(?m)^[ \t]*" + re.escape(bytes([mark])) + rb".*\n?", b"", data)
    return data


def _to_heading(data: bytes, comments: str) -> tuple[int, bytes, str]:
    """Number of lines down to the heading, the heading, the separator. A line behind # that names the columns is the
    heading."""
    lines, said = 0, ""
    while data:
        first, _, rest = data.partition(b"\n")
        lines += 1
        text = first.strip()
        declared = re.match(rb'"?sep=(.?)', text, re.IGNORECASE)
        if declared:
            said = declared[1].decode("utf-8", errors="replace")
        blank = not text.strip(b',;\t| "')
        remark = text[:1].decode("latin-1") in comments and (text[:1] != b"#" or not _names_columns(text, rest))
        if not (declared or blank or (text and remark)):
            known = said and said in _SEPARATORS and said.encode() in text
            return lines, text, said if known else _separator(text)
        data = rest
    return lines, b"", ","


def _names_columns(text: bytes, rest: bytes) -> bool:
    """Whether a line behind # is a heading: it has as many cells as the row below it."""
    below = next(
        (row.strip() for row in rest[:HEAD_BYTES].split(b"\n") if row.strip() and row.strip()[:1] != b"#"), b""
    )
    mark = _separator(below)
    cells = (
        [len(names_in_heading(row.decode("utf-8", errors="replace"), mark)) for row in (text, below)] if below else []
    )
    return len(cells) == 2 and cells[0] == cells[1] and cells[0] > 1


def _separator(row: bytes) -> str:
    """Of the separators outside quotes the first of `_SEPARATORS` that a row has; semicolon and tab before a decimal
    comma; else blanks."""
    bare = re.sub(rb'"[^"]*"', b"", row)
    if b";" in bare and bare.count(b";") >= bare.count(b","):
        return ";"
    if b"\t" in bare and bare.count(b"\t") >= bare.count(b","):
        return "\t"
    return next((mark for mark in _SEPARATORS if mark.encode() in bare), "," if b'"' in row else " ")


def _cells(row: bytes, separator: str) -> int:
    if separator == " ":
        return len(row.split())
    return re.sub(rb'"[^"]*"', b"", row).count(separator.encode()) + 1


def missing_marks() -> Sequence[str]:
    """Cells that hold no value, in small letters."""
    return ("", "na", "n/a", "#n/a", "nan", "null", "none", "nil", "-", "--", "undefined", "(null)")
