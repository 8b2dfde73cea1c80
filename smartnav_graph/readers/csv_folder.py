"""A folder of CSV files with the session's own columns: imu.csv, gnss.csv, ... and, if there, session.toml."""

from __future__ import annotations

import logging
from dataclasses import MISSING
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Column, Table
from smartnav_graph.core.errors import SessionError
from smartnav_graph.readers.source import Reader, build_session
from smartnav_graph.readers.text import TextTable, read_text
from smartnav_graph.session import repair
from smartnav_graph.session.folder import read_header
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Stream
from smartnav_graph.session.streams import STREAMS

_log = logging.getLogger(__name__)


def _files(folder: Path) -> dict[str, Path]:
    return {name: folder / f"{name}.csv" for name in STREAMS if (folder / f"{name}.csv").is_file()}


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
    tables = {name: (file, _columns(STREAMS[name], read_text(file))) for name, file in files.items()}
    try:
        return build_session(tables, wanted, **header)
    except SessionError as error:
        raise error.located(files[error.where]) if error.where in files else error from error


def _columns(kind: type[Stream], table: TextTable) -> Table:
    """Every column by its kind. An empty optional column counts as missing; unknown ones are kept with a warning."""
    kinds = {name: spec.metadata["kind"] for spec in kind.specs() for name in spec.metadata["columns"]}
    optional = {name for spec in kind.specs() if spec.default is None for name in spec.metadata["columns"]}
    unknown = ", ".join(name for name in table.cells if name not in kinds)
    if unknown:
        _log.warning("%s: unknown column %s; kept, but not used", table.path, unknown)
    columns: Table = {}
    for spec in kind.specs():
        names = spec.metadata["columns"]
        if len(names) > 1 and spec.default is MISSING and set(names) <= set(table.cells):
            rows = table.floats(*names)
            rows.flags.writeable = False  # the stream keeps them as they are
            columns |= dict(zip(names, rows.T, strict=True))
    for name in table.cells:
        if name not in columns and not (name in optional and table.is_empty(name)):
            columns[name] = _column(table, name, kinds.get(name))
    return {name: columns[name] for name in table.cells if name in columns}


def _column(table: TextTable, name: str, kind: str | None) -> Column:
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


READER = Reader(
    name="csv",
    summary="folder of CSV files with the session's own columns",
    recognised_by="a folder with imu.csv, gnss.csv or another stream's name, and optionally session.toml",
    matches=lambda source: bool(_files(Path(source))),
    read_source=_read,
)
