"""The folder of a session on disk: session.toml, calibration.toml, one Parquet file a stream, and the pictures."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import tomli_w

from smartnav_graph.core.arrays import Column
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import file_inside, name_inside, read_table, read_toml, replacing, write_table
from smartnav_graph.core.frames import Origin
from smartnav_graph.core.progress import Progress, silent, watched
from smartnav_graph.core.tables import structured
from smartnav_graph.session import repair
from smartnav_graph.session.calibration.model import calibration_toml, load_calibration
from smartnav_graph.session.session import Device, Mount, Session
from smartnav_graph.session.stream import Stream
from smartnav_graph.session.streams import STREAMS

SCHEMA = 1
# Keys of session.toml and what they mean.
HEADER_KEYS = {
    "schema": "version of this format",
    "device": "name, axes that point forward and up, what carries the device, whether it is mounted on a foot",
    "clock": "`epoch` of t_ns: Unix, GPS (since 1980-01-06, no leap seconds), start of the device, or unknown",
    "origin": "of the local frame, WGS84; without it positions are local e_m, n_m, u_m",
    "gravity_m_s2": "magnitude of gravity, 9.0 to 10.5; by default normal gravity at the origin",
    "sensors": "mount of each stream, camera, or instrument of a control point",
    "calibration": "file with the calibration of the device, `calibration.toml`",
    "repair": "repairs of faulty rows whenever the session is loaded",
}
PICTURES = "images"  # the folder of the pictures in that of the session


def save(session: Session, path: str | Path, *, force: bool = False, progress: Progress = silent) -> None:
    """Write a session folder: session.toml and one Parquet file a stream. Replaces nothing without `force`."""
    with replacing(path, force=force) as folder:
        folder.mkdir()
        for name, stream in watched("writing streams", list(session.streams().items()), progress):
            write_table(stream.columns(), folder / f"{name}.parquet")
        if session.calibration is not None:
            (folder / "calibration.toml").write_text(calibration_toml(session.calibration), encoding="utf-8")
        _copy_pictures(session, folder / PICTURES, progress)
        if session.write_pictures is not None:
            session.write_pictures(folder / PICTURES)
        (folder / "session.toml").write_text(tomli_w.dumps(header_of(session)), encoding="utf-8")


def _copy_pictures(session: Session, folder: Path, progress: Progress) -> None:
    if session.images is None or session.pictures is None:
        return
    for file in watched("copying pictures", list(map(str, session.images.file)), progress):
        source = file_inside(session.pictures, file)
        if source is not None:
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, folder / file)


def header_of(session: Session) -> dict[str, object]:
    """The tables of session.toml."""
    header: dict[str, object] = {"schema": SCHEMA}
    if session.gravity_m_s2 is not None:
        header["gravity_m_s2"] = session.gravity_m_s2
    if session.repairs:
        header["repair"] = list(session.repairs)
    header["device"] = dataclasses.asdict(session.device)
    header["clock"] = {"epoch": session.clock_epoch}
    if session.origin is not None:
        header["origin"] = dataclasses.asdict(session.origin)
    if session.sensors:
        header["sensors"] = {name: _mount_table(mount) for name, mount in session.sensors.items()}
    if session.calibration is not None:
        header["calibration"] = "calibration.toml"
    return header


def _mount_table(mount: Mount) -> dict[str, object]:
    table = dataclasses.asdict(mount)
    return table if np.isfinite(mount.geoid_m) else {name: value for name, value in table.items() if name != "geoid_m"}


def build_stream(
    kind: type[Stream], table: Mapping[str, Column], where: Path | str, repairs: Iterable[str] = ()
) -> tuple[Stream, dict[str, int]]:
    """A checked stream of file columns, after the repairs asked for, with their counts; errors name the file."""
    try:
        rows, counts = repair.repair(kind, table, repairs)
        return kind.from_columns(rows), counts
    except SessionError as error:
        raise error.located(where) from error
    except (ValueError, TypeError) as error:
        raise SessionError(where, f"a column holds no numbers ({error})", "numbers", stream=kind.NAME) from error


def read_header(folder: Path, name: str = "session.toml") -> dict[str, Any]:
    """session.toml, or a file of the same keys, as keyword arguments of Session (without streams)."""
    path = folder / name
    if not path.exists():
        raise SessionError(folder, "holds no session.toml", "a session folder", "make one with `smartnav import`")
    header = structured(_Header, read_toml(path, SessionError, "a session.toml"), SessionError, path)
    if header.schema != SCHEMA:
        raise SessionError(path, f"schema = {header.schema}", f"{SCHEMA}", "import the log again with this version")
    gravity, calibration = header.gravity_m_s2, header.calibration
    if gravity is not None and not 9.0 < gravity < 10.5:
        raise SessionError(path, f"gravity_m_s2 = {gravity}", "9.0 to 10.5 m/s^2", "give SI units")
    if calibration and not name_inside(calibration):
        raise SessionError(
            path, f"calibration = {calibration[:200]!r}", "a file in the session folder", "copy it there"
        )
    return {
        "device": header.device,
        "clock_epoch": header.clock.epoch,
        "origin": header.origin,
        "gravity_m_s2": gravity,
        "sensors": header.sensors,
        "calibration": load_calibration(folder / calibration) if calibration else None,
        "repairs": repair.check_names(header.repair),
    }


@dataclass(frozen=True)
class _Clock:
    epoch: str = "unknown"


@dataclass(frozen=True)
class _Header:
    """session.toml, see `HEADER_KEYS`."""

    schema: int = SCHEMA
    device: Device = Device()
    clock: _Clock = _Clock()
    origin: Origin | None = None
    gravity_m_s2: float | None = None
    sensors: Mapping[str, Mount] = field(default_factory=dict)
    calibration: str = ""
    repair: tuple[str, ...] = ()


def load(path: str | Path, *, repairs: Iterable[str] = ()) -> Session:
    """Read a session folder.

    Parameters
    ----------
    path : the folder
    repairs : names of `smartnav_graph.session.repair` to apply beside those that session.toml asks for

    Raises
    ------
    SessionError
        Folder or file missing, unreadable or empty; wrong column; non-finite value; stamps not increasing.
    """
    from smartnav_graph.session.health.units import in_right_units

    folder = Path(path)
    if not folder.is_dir():
        raise SessionError(folder, "is no folder", "a session folder", "make one with `smartnav import`")
    header = read_header(folder)
    wanted = repair.check_names({*header["repairs"], *repairs})
    streams: dict[str, Stream] = {}
    dropped: dict[str, dict[str, int]] = {}
    for name, kind in STREAMS.items():
        file = folder / f"{name}.parquet"
        if file.exists():
            streams[name], counts = build_stream(kind, read_table(file), file, wanted)
            dropped |= {name: counts} if counts else {}
    header["repairs"] = wanted
    try:
        session = Session(path=folder, pictures=folder / PICTURES, dropped=dropped, **{**header, **streams})
    except SessionError as error:
        raise error.located(folder / f"{error.stream}.parquet" if error.stream else folder) from error
    pa.default_memory_pool().release_unused()  # as much as the tables
    return in_right_units(session) if "units" in wanted else session
