"""Matches and tracks kept in the session folder, with what was asked for and what they were made of.

Beside ``matches.parquet`` (or ``tracks.parquet``) stands a TOML of the same name: the options, a hash of the pictures
and of the calibration they were read with, a hash of the rows themselves, and the report.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import tomli_w

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import replacing, write_table
from smartnav_graph.core.progress import Progress, silent
from smartnav_graph.session import folder as session_folder
from smartnav_graph.session.session import Session
from smartnav_graph.session.stream import Stream
from smartnav_graph.vision import images
from smartnav_graph.vision.front_end import Found, FrontEndConfig, asked, find
from smartnav_graph.vision.front_end_report import FrontEndReport
from smartnav_graph.vision.parallel import ordered, threads

SAME = "the same options, pictures and calibration"
REMEDY = "add --force to replace it"


def match(
    path: str | Path,
    config: FrontEndConfig | None = None,
    *,
    force: bool = False,
    workers: int = 0,
    progress: Progress = silent,
) -> Found:
    """The matches or tracks of a session folder: those it keeps, where they were made alike, else made and kept.

    Raises
    ------
    SessionError
        The session keeps others and `force` is not given; or as `front_end.find`.
    """
    folder, config = Path(path), config or FrontEndConfig()
    session = session_folder.load(folder)
    name = "tracks" if config.tracks else "matches"
    wanted = asked(config) | {"inputs": _inputs(session, config, workers)}
    if (folder / f"{name}.parquet").exists() and not force:
        report = FrontEndReport(**_kept(folder, name, wanted))
        return Found(session.matches, session.tracks, report, computed=False)
    found = find(session, config, workers=workers, progress=progress)
    keep(folder, found.tracks or found.matches, wanted, asdict(found.report))
    return found


def keep(folder: Path, stream: Stream | None, wanted: Mapping[str, Any], report: Mapping[str, Any]) -> None:
    """Write a stream into the session folder, with where it comes from; what stood there is replaced."""
    assert stream is not None
    file = folder / f"{stream.NAME}.parquet"
    with replacing(file) as new:
        write_table(stream.columns(), new)
    told = {"asked": dict(wanted), "rows": _digest(file), "report": dict(report)}
    with replacing(file.with_suffix(".toml")) as new:
        new.write_text(tomli_w.dumps(told), encoding="utf-8")


def refuse_others(folder: Path, name: str, force: bool) -> None:
    """Raise where the session keeps such a stream already, unless it may be replaced."""
    file = folder / f"{name}.parquet"
    if file.exists() and not force:
        raise SessionError(file, "exists already", "a session without it", REMEDY, stream=name)


def _kept(folder: Path, name: str, wanted: Mapping[str, Any]) -> dict[str, Any]:
    """The report of rows that were made as is wanted now."""
    file = folder / f"{name}.parquet"
    try:
        told = tomllib.loads(file.with_suffix(".toml").read_text(encoding="utf-8"))
        before, rows, report = told["asked"], told["rows"], told["report"]
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError, KeyError) as error:
        raise SessionError(file, "does not tell what it was made of", SAME, REMEDY, stream=name) from error
    if rows != _digest(file):
        raise SessionError(file, "was changed since it was made", SAME, REMEDY, stream=name)
    other = [key for key, value in wanted.items() if before.get(key) != value]
    if other:
        raise SessionError(file, _difference(before, wanted, other), SAME, REMEDY, stream=name)
    return dict(report)


def _difference(before: Mapping[str, Any], wanted: Mapping[str, Any], keys: Sequence[str]) -> str:
    if "from_file" in before:
        return f"was taken from {before['from_file']}"
    texts = [f"{key} {before.get(key)} (asked for: {wanted[key]})" for key in keys if key != "inputs"]
    return f"was made with {', '.join(texts) or 'other pictures or another calibration'}"


def _inputs(session: Session, config: FrontEndConfig, workers: int) -> str:
    """Hash of all that the result depends on beside the options."""
    found = hashlib.blake2b(digest_size=16)
    with threads(workers) as pool:
        for picture, told in ordered(pool, lambda one: (one, one.fingerprint()), images.pictures(session)):
            found.update(f"{picture.image_id} {picture.t_ns} {picture.camera} {picture.file} {told.hex()}\n".encode())
    cameras = {} if session.calibration is None else session.calibration.cameras
    found.update(repr(sorted(cameras.items())).encode())
    if config.tracks and session.imu is not None:
        mounts = sorted((name, session.mount(name)) for name in cameras)
        found.update(repr(mounts).encode() + session.imu.t_ns.tobytes() + session.imu.gyro.tobytes())
    return found.hexdigest()


def _digest(file: Path) -> str:
    return hashlib.blake2b(file.read_bytes(), digest_size=16).hexdigest()
