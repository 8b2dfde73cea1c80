"""A folder of CSV files with the session's own columns: imu.csv, gnss.csv, ... and, if there, session.toml."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Column, Table, Times
from smartnav_graph.core.errors import SessionError, warn
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers.source import Reader, build_session
from smartnav_graph.readers.stamps import is_date
from smartnav_graph.readers.text import TextTable, read_text
from smartnav_graph.readers.text_lines import heading_of
from smartnav_graph.session import repair
from smartnav_graph.session.folder import read_header
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Stream
from smartnav_graph.session.streams import STREAMS

_STAMPS = {"t_s": NS, "t_ms": NS // 10**3, "t_us": NS // 10**6}  # columns that give t_ns in another unit


def _files(folder: Path) -> dict[str, Path]:
    return {name: folder / f"{name}.csv" for name in STREAMS if (folder / f"{name}.csv").is_file()}


def _matches(source: str) -> bool:
    """Whether a file of a stream's name has a column of that stream: apps use such names too."""
    for name, file in _files(Path(source)).items():
        columns = {column for spec in STREAMS[name].specs() for column in spec.metadata["columns"]}
        if {column.lower() for column in heading_of(file)} & {*columns, *_STAMPS}:
            return True
    return False


def _read(source: str, repairs: tuple[str, ...]) -> Session:
    folder = Path(source)
    files = _files(folder)
    known = ", ".join(f"{name}.csv" for name in STREAMS)
    if not files:
        raise SessionError(folder, "holds no stream", f"some of {known}", "name each file after its stream")
    for other in sorted(set(folder.glob("*.csv")) - set(files.values())):
        raise SessionError(other, "is no stream of a session", f"some of {known}", "rename the file or move it away")
    header = read_header(folder) if (folder / "session.toml").exists() else {}
    wanted = repair.check_names({*header.pop("repairs", ()), *repairs})
    texts = {name: read_text(file) for name, file in files.items()}
    tables = {name: (files[name], _columns(STREAMS[name], text)) for name, text in texts.items()}
    skipped = {name: text.skipped for name, text in texts.items() if text.skipped}
    try:
        session = build_session(tables, wanted, **header)
        counts = {name: {**skipped.get(name, {}), **session.dropped.get(name, {})} for name in texts}
        return session.replace(dropped={name: count for name, count in counts.items() if count})
    except SessionError as error:
        raise error.located(files[error.where]) if error.where in files else error from error


def _columns(kind: type[Stream], table: TextTable) -> Table:
    """Every column by its kind, in small or capital letters. An empty optional column counts as missing; unknown ones
    are kept with a warning. Stamps may be ``t_s``, ``t_ms`` or ``t_us`` instead of ``t_ns``, or dates."""
    kinds = {name: spec.metadata["kind"] for spec in kind.specs() for name in spec.metadata["columns"]}
    optional = {name for spec in kind.specs() if spec.default is None for name in spec.metadata["columns"]}
    table = _small_letters(table, kinds)
    unknown = ", ".join(name for name in table.cells if name not in kinds and name not in _STAMPS)
    if unknown:
        warn(f"{table.path}: unknown column {unknown}; kept, but not used")
    columns: Table = {}
    for spec in kind.specs():
        names = spec.metadata["columns"]
        if len(names) > 1 and spec.default is MISSING and set(names) <= set(table.cells):
            rows = table.floats(*names)
            rows.flags.writeable = False  # the stream keeps them as they are
            columns |= dict(zip(names, rows.T, strict=True))
    for name in table.cells:
        if name in _STAMPS and "t_ns" not in table.cells:
            columns["t_ns"] = table.times(name, _STAMPS[name])
        elif name not in columns and not (name in optional and table.is_empty(name)):
            columns[name] = _column(table, name, kinds.get(name))
    return {name: columns[name] for name in (*table.cells, "t_ns") if name in columns}


def _small_letters(table: TextTable, kinds: Mapping[str, str]) -> TextTable:
    """The table with names in small letters where only so a name is known."""
    small = {name: name.lower() for name in table.cells if name not in kinds and name.lower() in {*kinds, *_STAMPS}}
    names = [small.get(name, name) for name in table.cells]
    if not small or len(set(names)) < len(names):
        return table
    return TextTable(table.path, dict(zip(names, table.cells.values(), strict=True)), table.skipped)


def _column(table: TextTable, name: str, kind: str | None) -> Column:
    if name == "t_ns":
        return _stamps(table)
    if kind == "int":
        return table.ints(name)
    if kind == "float":
        return table.floats(name)
    if kind == "text":
        return table.texts(name)
    try:
        return np.asarray(table.floats(name))
    except SessionError:  # an unknown column is kept as whatever it holds
        return table.texts(name)


def _stamps(table: TextTable) -> Times:
    cells = table.cells["t_ns"]
    if len(cells) and is_date(cells[0].as_py()):
        return table.times("t_ns")
    try:
        return table.ints("t_ns")
    except SessionError as error:
        remedy = f"name the column {', '.join(_STAMPS)} where it holds seconds, milli- or microseconds"
        raise SessionError(error.where, error.found, "a whole number of nanoseconds", remedy, row=error.row) from error


READER = Reader(
    name="csv",
    summary="folder of CSV files with the session's own columns",
    recognised_by="a folder with imu.csv, gnss.csv or another stream's name, and optionally session.toml",
    matches=_matches,
    read_source=_read,
)
