"""A reader: its name, how it recognises a source, and how it converts one to a session."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from smartnav_graph.core.arrays import Floats, Table, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.session.folder import build_stream
from smartnav_graph.session.session import Mount, Session
from smartnav_graph.session.stream import Stream
from smartnav_graph.session.streams import STREAMS


@dataclass(frozen=True)
class Reader:
    """One foreign format.

    name : what ``--format`` calls it
    summary : what it is, one line
    recognised_by : how a source of this format is recognised, one line
    matches : cheap check of names and first lines; never raises for a source of another format
    read_source : the conversion itself, of a source and the names of repairs
    general : gives way to every other format that recognises the source
    """

    name: str
    summary: str
    recognised_by: str
    matches: Callable[[str], bool]
    read_source: Callable[[str, tuple[str, ...]], Session]
    general: bool = False

    def read(self, source: str | Path, *, repairs: Iterable[str] = ()) -> Session:
        """The session of `source`.

        Parameters
        ----------
        source : file, folder or literal name
        repairs : names of `smartnav_graph.session.repair`, applied to every stream and counted in `Session.dropped`

        Raises
        ------
        SessionError
            Missing or unreadable file, wrong or missing column, a cell that is no number, faulty rows.
        """
        return self.read_source(str(source), tuple(repairs))


def first_bytes(source: str, count: int = 8192) -> bytes:
    """The first bytes of a file; none where there is no such file."""
    try:
        with open(source, "rb") as file:
            return file.read(count)
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return b""


def only_folder(source: str, holds: Callable[[Path], bool], depth: int = 1) -> Path | None:
    """The folder that `holds` what is wanted: `source`, or the only one in it, down to `depth` levels; never raises."""
    try:
        folders = [Path(source), *(f for level in range(depth) for f in sorted(Path(source).glob("*/" * (level + 1))))]
        found = [folder for folder in folders if holds(folder)]
    except (OSError, ValueError):  # ValueError: a zero byte in the name
        return None
    return found[0] if len(found) == 1 else None


def vector_columns(template: str, rows: Floats, axes: str = "xyz") -> Table:
    """Columns of the rows (n, k) of a vector: ``{}`` in `template` becomes the axis."""
    return {template.format(axis): column for axis, column in zip(axes, rows.T, strict=True)}


def inertial_columns(t_ns: Times, gyro: Floats, accel: Floats) -> Table:
    """Columns of inertial samples: stamps (n,), angular rate (n, 3) rad/s, specific force (n, 3) m/s^2."""
    return {"t_ns": t_ns} | vector_columns("gyro_{}_rad_s", gyro) | vector_columns("accel_{}_m_s2", accel)


def mount(body_t: ArrayLike, body_R: ArrayLike) -> Mount:
    """A mount of arrays: sensor origin (3,) m and axes (3, 3) in body axes."""
    x, y, z = (float(value) for value in np.asarray(body_t, dtype=np.float64))
    rows = tuple((float(a), float(b), float(c)) for a, b, c in np.asarray(body_R, dtype=np.float64))
    return Mount(body_t=(x, y, z), body_R=rows)


def build_session(tables: Mapping[str, tuple[Path, Table]], repairs: tuple[str, ...], **header: Any) -> Session:
    """A session of file columns: stream name -> (file they came from, columns).

    The repairs are done here and counted in `Session.dropped`; `Session.repairs` stays empty, because a session
    saved from this needs none.

    Raises
    ------
    SessionError
        A column is missing or a row is faulty; the error names the file.
    """
    streams: dict[str, Stream] = {}
    dropped: dict[str, dict[str, int]] = {}
    for name, (file, columns) in tables.items():
        if "t_ns" in columns and not len(columns["t_ns"]):
            raise SessionError(file, "has no rows", "at least one row", stream=name)
        streams[name], counts = build_stream(STREAMS[name], columns, file, repairs)
        dropped |= {name: counts} if counts else {}
    session = Session(dropped=dropped, **{**header, **streams})
    if "units" not in repairs:
        return session
    from smartnav_graph.session.health.units import in_right_units  # which loads what `formats` does not need

    return in_right_units(session)


def example_file(name: str) -> Path:
    """Path of a data file inside the gtsam package.

    Raises
    ------
    SessionError
        The installed gtsam does not ship it.
    """
    import gtsam

    find: Callable[[str], str] = gtsam.findExampleDataFile
    try:
        return Path(find(name))
    except RuntimeError as error:
        raise SessionError(
            name, "is not among the data files of the installed gtsam", "gtsam 4.3", "pip install 'gtsam>=4.3,<4.4'"
        ) from error
