"""Sheets of Excel files (.xlsx, .xls) as tables of text, by python-calamine."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

from smartnav_graph.core.errors import SessionError
from smartnav_graph.readers.text import TextTable

if TYPE_CHECKING:
    from python_calamine import CalamineSheet

_OLE = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1"  # begin of .xls


def is_excel(path: Path) -> bool:
    """Whether a file is an Excel file, by content."""
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            if file.read(8) == _OLE:
                return True
        if not zipfile.is_zipfile(path):
            return False
        with zipfile.ZipFile(path) as archive:
            return "xl/workbook.xml" in archive.namelist()
    except (OSError, ValueError, RuntimeError, LookupError, struct.error, zipfile.BadZipFile):
        return False


def sheet_names(path: Path) -> dict[str, list[str]]:
    """First rows of the sheets by name; none where the file cannot be read."""
    from python_calamine import CalamineError, CalamineWorkbook

    try:
        workbook = CalamineWorkbook.from_path(str(path))
        return {name: [str(c) for c in _rows(workbook.get_sheet_by_name(name))[0]] for name in workbook.sheet_names}
    except (CalamineError, OSError, ValueError, IndexError):
        return {}


def read_sheets(path: Path) -> dict[str, TextTable]:
    """The sheets that have rows, by name; the first row names the columns.

    Raises
    ------
    SessionError
        The file is damaged.
    """
    from python_calamine import CalamineError, CalamineWorkbook

    tables = {}
    try:
        workbook = CalamineWorkbook.from_path(str(path))
        for name in workbook.sheet_names:
            rows = _rows(workbook.get_sheet_by_name(name))
            names = [str(cell) for cell in rows[0]] if rows else []
            if len(rows) > 1 and len(set(names)) == len(names):
                cells = {column: [_text(row[i]) for row in rows[1:]] for i, column in enumerate(names)}
                tables[name] = TextTable.of(path.with_name(f"{path.name}[{name}]"), cells)
    except (CalamineError, OSError, ValueError) as error:
        raise SessionError(path, f"is no Excel file ({error})", "a whole .xlsx or .xls file", "export again") from error
    return tables


def _rows(sheet: CalamineSheet) -> list[list[object]]:
    return [list(row) for row in sheet.to_python(skip_empty_area=True)]


def _text(cell: object) -> str:
    return repr(cell) if isinstance(cell, float) else "" if cell is None else str(cell)
