"""Foreign logs -> Session. One module per format; `READERS` lists them.

A reader changes units and the sign of specific force, never axes, and keeps the source's own clock. Other packages add
readers by entry points of the group ``smartnav_graph.readers``; see docs/how-to/own-factor.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import file_inside
from smartnav_graph.core.plugins import installed_parts
from smartnav_graph.readers import (
    colmap,
    comma2k19,
    csv_folder,
    euroc,
    foot_dual_zupt,
    gtsam_euroc,
    gtsam_kitti,
    indoor_waypoints,
    kitti_odometry,
    pyshoe,
    smartnav_logger,
    tyrex,
)
from smartnav_graph.readers.apps import APP_READERS
from smartnav_graph.readers.archive import is_archive, unpacked
from smartnav_graph.readers.positions import gpx, gsdc, listed, nmea, rtklib
from smartnav_graph.readers.robotics import kf_gins, kitti_raw, ros, ulog, vectornav
from smartnav_graph.readers.source import Reader
from smartnav_graph.readers.unknown import describe_unknown
from smartnav_graph.session import folder as session_folder
from smartnav_graph.session.session import Session

READERS: dict[str, Reader] = {
    reader.name: reader
    for reader in (
        gtsam_kitti.READER,
        gtsam_euroc.READER,
        euroc.READER,
        comma2k19.READER,
        foot_dual_zupt.READER,
        pyshoe.READER,
        tyrex.READER,
        indoor_waypoints.READER,
        kitti_odometry.READER,
        colmap.READER,
        *APP_READERS,
        csv_folder.READER,
        smartnav_logger.READER,
        nmea.READER,
        gpx.READER,
        rtklib.READER,
        gsdc.READER,
        listed.FIXES,
        listed.CONTROL,
        ros.READER,
        ulog.READER,
        vectornav.READER,
        kf_gins.READER,
        kitti_raw.READER,
    )
}

__all__ = ["READERS", "Reader", "find", "is_unknown", "known_readers", "load", "read"]


@cache
def known_readers() -> Mapping[str, Reader]:
    """`READERS`, and those of other installed packages, by name."""
    return {**READERS, **installed_parts("smartnav_graph.readers", Reader, READERS)}


def load(source: str | Path, *, repairs: Iterable[str] = ()) -> Session:
    """A session folder, or a log of a known format read in memory.

    Parameters
    ----------
    source : session folder, or anything `read` takes
    repairs : names of `smartnav_graph.session.repair` to apply beside those that session.toml asks for

    Raises
    ------
    SessionError
        It is neither, or a file in it is missing, unreadable or faulty.
    """
    folder = Path(source)
    ours = (folder / "session.toml").is_file()
    ours &= (folder / "imu.parquet").is_file() or not any(folder.glob("*.csv"))  # a csv folder may have one, too
    return session_folder.load(folder, repairs=repairs) if ours else read(source, repairs=repairs)


def is_unknown(source: str | Path) -> bool:
    """Whether a file or folder is there, but neither a session nor an archive nor of a known format."""
    path = Path(source)
    if not path.exists() or (path / "session.toml").is_file() or is_archive(path):
        return False
    return not any(reader.matches(str(source)) for reader in known_readers().values())


def find(source: str | Path, name: str | None = None) -> Reader:
    """The reader called `name`, else the one that recognises `source`.

    Raises
    ------
    SessionError
        The name is unknown, the source is missing, or none or several readers recognise it.
    """
    names = ", ".join(known_readers())
    if name is not None and name not in known_readers():
        raise SessionError("--format", f"unknown format {name!r}", f"one of {names}", "see `smartnav formats`")
    found = [reader for reader in known_readers().values() if reader.matches(str(source))]
    if not found and not Path(source).exists():
        raise SessionError(source, "does not exist", "a file, a folder, gtsam-kitti or gtsam-euroc", "check the path")
    if name is not None:
        return known_readers()[name]
    found = [reader for reader in found if not reader.general] or found
    if len(found) > 1:
        several = ", ".join(reader.name for reader in found)
        raise SessionError(source, f"is recognised as {several}", "one format", "choose one with --format")
    if not found:
        seen = describe_unknown(source)
        fitting = f'describe its columns, such as --columns "{seen.columns}"; or ' if seen.columns else ""
        remedy = f"{fitting}write CSV with the columns of `smartnav formats --columns`"
        raise SessionError(source, f"is of no known format ({seen.one_line()})", f"one of {names}", remedy)
    return found[0]


def read(source: str | Path, name: str | None = None, repairs: Iterable[str] = ()) -> Session:
    """The session of a foreign log.

    Parameters
    ----------
    source : file, folder, zip or tar archive, or the literal ``gtsam-kitti`` / ``gtsam-euroc`` (in the gtsam package)
    name : format; by default recognised by content
    repairs : names of `smartnav_graph.session.repair` to apply; what they touched is counted in `Session.dropped`

    Raises
    ------
    SessionError
        Unknown format, missing or unreadable file, wrong column, a cell that is no number, faulty rows.
    """
    if is_archive(Path(source)):
        with unpacked(Path(source)) as (inside, left_out):
            source = _entry(inside)
            found = _without_pictures(find(source, name).read(source, repairs=repairs))
            return found.replace(dropped={**found.dropped, **({"archive": left_out} if left_out else {})})
    return find(source, name).read(source, repairs=repairs)


def _without_pictures(found: Session) -> Session:
    """The session of an archive without its pictures, which are gone with the unpacked folder, and are counted."""
    folder = found.pictures
    files = [] if found.images is None or folder is None else [f for f in map(str, found.images.file) if f]
    lost = sum(file_inside(folder, file) is not None for file in files) if folder is not None else 0
    lost += sum(map(bool, found.images.file)) if found.images is not None and found.write_pictures is not None else 0
    counts = {"images": {"pictures left in the archive (unpack it, and import the folder)": lost}} if lost else {}
    return found.replace(pictures=None, write_pictures=None, dropped={**found.dropped, **counts})


def _entry(folder: Path) -> Path:
    """The only file of an unpacked folder, where a reader recognises it; else the folder."""
    files = list(folder.iterdir())
    alone = len(files) == 1 and any(reader.matches(str(files[0])) for reader in known_readers().values())
    return files[0] if alone else folder
