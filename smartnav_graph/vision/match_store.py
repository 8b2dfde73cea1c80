"""Matches and tracks stored in the session folder, with their options and inputs.

Beside ``matches.parquet`` (or ``tracks.parquet``) lies a TOML of the same name: the options, a hash of the pictures and
of the calibration, a hash of the rows, and the report.
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
from smartnav_graph.vision.front_end import (
    FrontEndConfig,
    FrontEndReport,
    FrontEndResult,
    result_options,
    run_front_end,
)
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
) -> FrontEndResult:
    """The matches or tracks of a session folder: the stored ones if made with the same options, else new ones, stored.

    Raises
    ------
    SessionError
        The session holds others and `force` is not given; or as `front_end.run_front_end`.
    """
    folder, config = Path(path), config or FrontEndConfig()
    session = session_folder.load(folder)
    name = "tracks" if config.tracks else "matches"
    wanted = result_options(config) | {"inputs": _inputs(session, config, workers)}
    if (folder / f"{name}.parquet").exists() and not force:
        report = FrontEndReport(**_stored_report(folder, name, wanted))
        return FrontEndResult(session.matches, session.tracks, report, computed=False)
    found = run_front_end(session, config, workers=workers, progress=progress)
    store(folder, found.tracks or found.matches, wanted, asdict(found.report))
    return found


def store(folder: Path, stream: Stream | None, wanted: Mapping[str, object], report: Mapping[str, object]) -> None:
    """Write a stream into the session folder, with its origin; an existing one is replaced."""
    assert stream is not None
    file = folder / f"{stream.NAME}.parquet"
    with replacing(file) as new:
        write_table(stream.columns(), new)
    content = {"asked": dict(wanted), "rows": _digest(file), "report": dict(report)}
    with replacing(file.with_suffix(".toml")) as new:
        new.write_text(tomli_w.dumps(content), encoding="utf-8")


def refuse_existing_stream(folder: Path, name: str, force: bool) -> None:
    """Raise if the session has such a stream already, unless it may be replaced."""
    file = folder / f"{name}.parquet"
    if file.exists() and not force:
        raise SessionError(file, "exists already", "a session without it", REMEDY, stream=name)


def stored_report(folder: Path) -> FrontEndReport | None:
    """What became of the pictures that the matches or tracks of a session folder were made of, where it says so."""
    for file in (folder / "matches.toml", folder / "tracks.toml"):
        try:
            return FrontEndReport(**tomllib.loads(file.read_text(encoding="utf-8"))["report"])
        except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError, KeyError, TypeError):
            continue
    return None


def _stored_report(folder: Path, name: str, wanted: Mapping[str, object]) -> dict[str, Any]:
    """The report of stored rows, if they were made with the options wanted."""
    file = folder / f"{name}.parquet"
    try:
        content = tomllib.loads(file.with_suffix(".toml").read_text(encoding="utf-8"))
        before, rows, report = content["asked"], content["rows"], content["report"]
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError, KeyError) as error:
        raise SessionError(file, "does not say how it was made", SAME, REMEDY, stream=name) from error
    if rows != _digest(file):
        raise SessionError(file, "was changed since it was made", SAME, REMEDY, stream=name)
    other = [key for key, value in wanted.items() if before.get(key) != value]
    if other:
        raise SessionError(file, _difference(before, wanted, other), SAME, REMEDY, stream=name)
    return dict(report)


def _difference(before: Mapping[str, object], wanted: Mapping[str, object], keys: Sequence[str]) -> str:
    if "from_file" in before:
        return f"was taken from {before['from_file']}"
    texts = [f"{key} {before.get(key)} (asked for: {wanted[key]})" for key in keys if key != "inputs"]
    return f"was made with {', '.join(texts) or 'other pictures or another calibration'}"


def _inputs(session: Session, config: FrontEndConfig, workers: int) -> str:
    """Hash of all inputs of the result besides the options."""
    found = hashlib.blake2b(digest_size=16)
    with threads(workers) as executor:
        for picture, digest in ordered(executor, lambda one: (one, one.fingerprint()), images.pictures(session)):
            found.update(f"{picture.image_id} {picture.t_ns} {picture.camera} {picture.file} {digest.hex()}\n".encode())
    cameras = {} if session.calibration is None else session.calibration.cameras
    found.update(repr(sorted(cameras.items())).encode())
    if config.tracks and session.imu is not None:
        mounts = sorted((name, session.mount(name)) for name in cameras)
        found.update(repr(mounts).encode() + session.imu.t_ns.tobytes() + session.imu.gyro.tobytes())
    return found.hexdigest()


def _digest(file: Path) -> str:
    return hashlib.blake2b(file.read_bytes(), digest_size=16).hexdigest()
